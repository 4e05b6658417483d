// Gantt chart to now: one lane for each action place, a bar for each run; bars of active runs reach the present.

import { h, seconds, text, words } from "./dom.js";

let [LANE, LEFT, HEAD] = [24, 150, 20]; // px at the usual type size; all grow with the type of a wall screen
const LANES_AT_MOST = 12;
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600];

/** How long a run was active until then (s). While it is held its deadline stands still, and so does this. */
export const activeTime = (run, until) => Math.max(0, (run.held_since ?? until) - run.started - (run.held_for ?? 0));

export class Timeline {
  constructor(chosen) {
    this.canvas = h("canvas", { class: "timeline", role: "img", "aria-label": "Timeline of the runs up to now" });
    this.tip = h("div", { class: "tip", hidden: true });
    this.span = h("select", { "aria-label": "Time shown", onchange: () => this.draw() }, [["10", "10 s"], ["30", "30 s"], ["120", "2 min"], ["0", "all"]].map(([v, t]) => h("option", { value: v, selected: v === "30" }, t)));
    this.choice = h("label", { class: "span" }, "Show the last", this.span);
    this.root = h("div", { class: "timeline-box" }, this.canvas, this.tip);
    this.chosen = chosen;
    this.bars = [];
    this.canvas.addEventListener("pointermove", (event) => this.hover(event));
    this.canvas.addEventListener("pointerleave", () => (this.tip.hidden = true));
    this.canvas.addEventListener("click", (event) => this.under(event) && this.chosen?.(this.under(event).run.place));
    new ResizeObserver(([entry]) => this.sized(entry.contentRect.width)).observe(this.root);
  }

  /** Sizes and colours are read when they change, not at each drawing: reading them makes the browser lay out first. */
  sized(width) {
    this.width = width;
    this.em = width ? parseFloat(getComputedStyle(this.root).fontSize) / 14 : 1;
    [LANE, LEFT, HEAD] = [24 * this.em, 150 * this.em, 20 * this.em];
    this.draw();
  }

  colour(name) {
    const { theme } = document.documentElement.dataset;
    if (this.theme !== theme) [this.theme, this.colours] = [theme, new Map()];
    if (!this.colours.has(name)) this.colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
    return this.colours.get(name);
  }

  /** Lanes are the action places; of many, only those that have had runs are shown. */
  set(lanes, ended, going, now) {
    const used = new Set([...ended, ...going].map((run) => run.place));
    const shown = lanes.length > LANES_AT_MOST ? lanes.filter((lane) => used.has(lane.name)).slice(0, 2 * LANES_AT_MOST) : lanes;
    Object.assign(this, { lanes: shown, ended, going, now });
    this.draw();
  }

  draw() {
    const { width } = this;
    if (!this.lanes || !width) return;
    const height = HEAD + Math.max(1, this.lanes.length) * LANE + 4;
    const ratio = devicePixelRatio || 1;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
      this.canvas.style.width = `${width}px`;
      this.canvas.style.height = `${height}px`;
    }
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const chosen = Number(this.span.value);
    const first = Math.min(...this.ended.map((r) => r.started), ...this.going.map((r) => r.started), this.now);
    const from = chosen ? Math.max(0, this.now - chosen) : Math.max(0, first);
    const length = chosen || Math.max(1, this.now - from);
    const scale = (width - LEFT - 14) / length;
    this.axis(pen, from, length, scale, width, height);
    this.lanesOf(pen, width);
    this.barsOf(pen, from, scale, width);
  }

  axis(pen, from, length, scale, width, height) {
    pen.font = `${11 * this.em}px system-ui, sans-serif`;
    const step = STEPS.find((s) => s * scale >= 64 * this.em) ?? 7200;
    for (let t = Math.ceil(from / step) * step; t <= from + length + 1e-9; t += step) {
      const x = LEFT + (t - from) * scale;
      pen.fillStyle = this.colour("line");
      pen.fillRect(Math.round(x), HEAD - 4, 1, height);
      pen.fillStyle = this.colour("muted");
      pen.textAlign = "center";
      if (x < width - 24) pen.fillText(`${t.toFixed(step < 1 ? 1 : 0)} s`, x, 11 * this.em);
    }
  }

  lanesOf(pen, width) {
    pen.textAlign = "left";
    pen.font = `${12 * this.em}px system-ui, sans-serif`;
    this.lanes.forEach((lane, i) => {
      const y = HEAD + i * LANE;
      pen.fillStyle = this.colour("line");
      pen.fillRect(0, y + LANE - 1, width, 1);
      pen.fillStyle = this.colour("text");
      const label = words(lane.label || lane.name);
      pen.fillText(label.length > 21 ? `${label.slice(0, 20)}…` : label, 12, y + 16 * this.em);
    });
  }

  barsOf(pen, from, scale, width) {
    this.bars = [];
    const lane = new Map(this.lanes.map((l, i) => [l.name, i]));
    const draw = (run, end, colour) => {
      const i = lane.get(run.place);
      const x0 = Math.max(LEFT, LEFT + (run.started - from) * scale);
      const x1 = Math.min(width - 12, LEFT + (end - from) * scale);
      if (i === undefined || x1 < LEFT) return;
      const bar = { x: x0, y: HEAD + i * LANE + 4, w: Math.max(2, x1 - x0), h: LANE - 9 * this.em, run, end };
      pen.fillStyle = this.colour(colour);
      pen.beginPath();
      pen.roundRect(bar.x, bar.y, bar.w, bar.h, 3);
      pen.fill();
      this.barLabel(pen, bar);
      this.bars.push(bar);
    };
    for (const run of this.ended) draw(run, run.ended, { success: "ok", failure: "warn", error: "bad" }[run.status] ?? "muted");
    for (const run of this.going) draw(run, this.now, run.state === "held" ? "hold" : "accent");
    pen.fillStyle = this.colour("accent");
    pen.fillRect(Math.min(width - 12, LEFT + (this.now - from) * scale), HEAD - 4, 1.5, HEAD + this.lanes.length * LANE);
  }

  barLabel(pen, bar) {
    pen.fillStyle = this.colour("on-colour");
    pen.font = `${11 * this.em}px system-ui, sans-serif`;
    const said = words(bar.run.action);
    if (pen.measureText(said).width <= bar.w - 12) pen.fillText(said, bar.x + 6, bar.y + 11.5 * this.em);
  }

  under(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    return this.bars.findLast((b) => x >= b.x - 2 && x <= b.x + b.w + 2 && y >= b.y && y <= b.y + b.h);
  }

  hover(event) {
    const bar = this.under(event);
    this.tip.hidden = !bar;
    if (!bar) return;
    const { run } = bar;
    const reason = run.reason?.text || run.reason?.code;
    const active = activeTime(run, bar.end);
    const held = bar.end - run.started - active;
    text(this.tip, [`${words(run.action)} on ${run.node}`, `${seconds(active)}, ${run.deferred ? "provisional " : ""}${run.status ?? run.state ?? "running"}`, held >= 0.01 ? `held for ${seconds(held)}` : "", reason].filter(Boolean).join(" · "));
    const box = this.root.getBoundingClientRect();
    this.tip.style.left = `${Math.min(event.clientX - box.left + 12, box.width - 260)}px`;
    this.tip.style.top = `${event.clientY - box.top + 14}px`;
  }
}
