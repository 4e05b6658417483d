// History: any journal's markings forwards and backwards, jump to an error, two runs side by side, a new run from here.

import { Canvas, tool } from "./canvas.js";
import { attribute, fill, h, Press, seconds, text, words } from "./dom.js";
import { listRuns, openRun } from "./files.js";
import { READABLE } from "./geometry.js";
import { icon } from "./icons.js";
import { reasonText } from "./live.js";
import { simulateDialog } from "./start.js";
import { alarms, drawnOn, labelsOf, sheetOf, tokensOf, trailOf } from "./sheet.js";

const SESSION = "(this run)";
const ROWS_AROUND = 120;
const SESSION_KEPT = 5000;

/** A run's records with a marking reachable at any index: changes are kept, and whole markings every so often. */
class Reel {
  constructor(run) {
    this.run = run;
    this.records = run.records;
    this.kept = new Map([[0, run.initial]]);
  }

  /** The marking after `index` records (0: the beginning). */
  marking(index) {
    let from = index - (index % 64);
    while (!this.kept.has(from)) from -= 64;
    const marking = { ...this.kept.get(from) };
    for (let i = from; i < index; i++) {
      Object.assign(marking, this.records[i].marking);
      if ((i + 1) % 64 === 0 && !this.kept.has(i + 1)) this.kept.set(i + 1, { ...marking });
    }
    return marking;
  }

  get firings() {
    this.flat ??= this.records.flatMap((r, i) => r.firings.map((f) => ({ ...f, index: i + 1, t: r.t })));
    return this.flat;
  }

  /** The index at which so many firings have happened. */
  atFirings(count) {
    return count > 0 ? (this.firings[count - 1]?.index ?? this.records.length) : this.run.from?.record ? 1 : 0;
  }

  /** How many firings of this run another one has behind it that set out from it; null if it did not. */
  before(made) {
    const { from } = made.run;
    return from?.run === this.run.id ? this.firings.filter((f) => this.records[f.index - 1].number <= from.record).length : null;
  }

  firingsUpTo(index) {
    return this.firings.filter((f) => f.index <= index).length;
  }
}

class Screen {
  constructor(label) {
    this.canvas = new Canvas(label, { opened: (e) => e.kind === "macro" && this.open(e.name) });
    this.canvas.folded = () => this.reel && this.show(this.index, false);
    this.inside = "";
    this.tag = h("span", { class: "tag" });
    this.canvas.bar.append(this.tag);
  }

  load(reel) {
    this.reel = reel;
    this.inside = "";
    text(this.tag, reel.run.id);
    this.draw();
    this.canvas.view.fit(READABLE);
  }

  open(macro) {
    this.inside = macro;
    this.draw();
    this.canvas.view.fit(READABLE);
  }

  draw() {
    const { task } = this.reel.run;
    if (!task) return;
    this.canvas.show(sheetOf(task, this.inside));
    const path = trailOf(task, this.inside);
    this.canvas.trail([task.name, ...path.map((p) => p.label)], (i) => this.open(i ? path[i - 1].name : ""));
    this.show(this.index ?? 0, false);
  }

  show(index, moving) {
    const { task } = this.reel.run;
    this.index = Math.max(0, Math.min(index, this.reel.records.length));
    if (!task) return;
    const marking = this.reel.marking(this.index);
    const shown = tokensOf(task, marking);
    const { view } = this.canvas;
    const fired = this.reel.firings.filter((f) => f.index <= this.index).map((f) => f.transition);
    this.canvas.alarm(alarms(task, marking, this.inside, (name) => view.sees(name), fired));
    const drawn = drawnOn(task, this.inside);
    const as = (name) => (view.elements.has(name) ? name : drawn(name));
    if (moving && this.index) for (const firing of this.reel.records[this.index - 1].firings) view.fire(as(firing.transition), firing.error);
    for (const element of view.elements.values()) if (element.shape === "place") view.tokens(element.name, shown[element.name] ?? 0);
  }
}

export class History {
  constructor(link, operator) {
    Object.assign(this, { link, operator, index: 0, runs: [] });
    this.list = h("div", { class: "list" });
    this.press = new Press(this.list);
    this.runsBox = h("nav", { class: "runs", "aria-label": "Runs" }, h("h2", {}, "Runs"), this.list);
    this.screens = [new Screen("Net at this record"), new Screen("Net of the compared run")];
    this.pair = h("div", { class: "pair" }, this.screens.map((s) => s.canvas.root));
    this.screens[1].canvas.root.hidden = true;
    this.buildScrub();
    this.rowsBox = h("ol", { class: "rows" });
    this.every = h("input", { type: "checkbox", onchange: () => this.paintRows() });
    this.about = h("p", { class: "about", role: "status" });
    this.recordsBox = h("aside", { class: "records", "aria-label": "Records" }, h("h2", {}, "Records"), this.about,
      h("label", { class: "every tick" }, this.every, "every record, also those that changed nothing"), this.rowsBox);
    this.root = h("div", { class: "history" }, this.runsBox, h("div", { class: "middle" }, this.pair, this.scrub), this.recordsBox);
    this.session = null;
  }

  buildScrub() {
    this.range = h("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "Record", oninput: () => this.go(Number(this.range.value)) });
    this.where = h("span", { class: "where" });
    this.startHere = h("button", { type: "button", class: "small", onclick: () => this.simulate() }, icon("play"), "Simulate from here");
    this.scrub = h("div", { class: "scrub", role: "toolbar", "aria-label": "Scrub" },
      this.range,
      tool("first", "First record", () => this.go(0)), tool("back", "Previous record", () => this.step(-1)),
      tool("next", "Next record", () => this.step(1)), tool("last", "Last record", () => this.go(Infinity)),
      this.where, h("div", { class: "spacer" }),
      h("button", { type: "button", class: "small", "aria-label": "Previous error", onclick: () => this.toError(-1) }, icon("back"), "Error"),
      h("button", { type: "button", class: "small", "aria-label": "Next error", onclick: () => this.toError(1) }, "Error", icon("next")), this.startHere);
  }

  async shown() {
    const before = this.opening;
    await this.refresh();
    if (this.opening !== before) return;
    if (!this.reel) await this.open(this.runs[0]?.id ?? SESSION);
    else if (this.reel.run.id === SESSION) this.open(SESSION, true);
    else for (const screen of this.screens) if (screen.reel) screen.canvas.view.fit(READABLE);
  }

  controlsChanged() {
    const { mission } = this.link.state;
    const seen = this.reel?.run.id === SESSION;
    const live = ["running", "paused", "stopping", "preparing"].includes(mission.state);
    const why = this.link.barred || (seen ? "Open the recorded run in the list" : live ? "A run is active. Wait until it has finished." : "");
    this.startHere.hidden = mission.starts === false;
    this.startHere.disabled = Boolean(why) || !this.reel?.run.task;
    attribute(this.startHere, "title", why || null);
  }

  async refresh() {
    this.runs = await listRuns();
    this.paintRuns();
  }

  // ---- the active run, as this page has seen it ----------------------------------------------------------------------

  restart() {
    const { task, marking, mission } = this.link.state;
    this.session = task ? { id: SESSION, task, initial: { ...marking }, records: [], now: { ...marking }, name: mission.id } : null;
  }

  follow(change) {
    const { session } = this;
    if (!this.root.hidden && change.kind === "mission") this.paintRuns();
    if (!this.root.hidden && change.kind === "result") this.refresh();
    if (!session) return;
    if (change.kind === "fired") this.addFiring(session, change.firing);
    else if (change.kind === "marking") this.addDifference(session, change.marking);
    if (session.records.length > SESSION_KEPT) this.restart();
  }

  addFiring(session, firing) {
    const marking = {};
    for (const arc of session.task.arcs) {
      if (arc.transition !== firing.transition || arc.direction === "inhibit" || arc.end === "going") continue;
      const before = marking[arc.place] ?? session.now[arc.place] ?? 0;
      marking[arc.place] = before + (arc.direction === "out" ? arc.weight : -arc.weight);
    }
    Object.assign(session.now, marking);
    session.records.push({ number: session.records.length + 1, t: firing.at, text: firing.cause, firings: [firing], marking, notes: [], error: firing.error });
  }

  addDifference(session, marking) {
    const changed = Object.fromEntries(Object.entries(marking).filter(([place, n]) => session.now[place] !== n));
    if (!Object.keys(changed).length) return;
    Object.assign(session.now, changed);
    session.records.push({ number: session.records.length + 1, t: this.link.now(), text: "tokens were changed", firings: [], marking: changed, notes: [], error: false });
  }

  // ---- runs ---------------------------------------------------------------------------------------------------------

  paintRuns() {
    if (this.press.holds(() => this.paintRuns())) return;
    const own = this.session ? [{ id: SESSION, task: this.session.task.name, state: this.link.state.mission.state, seconds: null }] : [];
    fill(this.list, [...own, ...this.runs].map((run) => {
      const chosen = run.id === this.reel?.run.id;
      const compared = run.id === this.other?.run.id;
      return h("div", { class: "run-row", "aria-current": chosen ? "true" : null },
        h("button", { type: "button", onclick: () => this.open(run.id) }, h("strong", {}, run.id === SESSION ? "This run, as seen here" : run.id),
          h("span", { class: "line" }, h("span", { class: `outcome ${run.state}` }, words(run.state)), h("span", { class: "number" }, run.seconds === null || run.seconds === undefined ? "" : seconds(run.seconds)))),
        tool("compare", compared ? `Stop comparing with ${run.id}` : `Compare with ${run.id}`, () => this.compare(compared ? null : run.id), { "aria-pressed": String(compared), disabled: chosen }));
    }));
    if (!own.length && !this.runs.length) fill(this.list, h("p", { class: "about" }, "No run has been recorded yet."));
  }

  async fetchReel(id) {
    const run = id === SESSION ? this.session && { ...this.session, records: [...this.session.records] } : await openRun(id);
    return run ? new Reel(run) : null;
  }

  async open(id, keep = false) {
    const ticket = (this.opening = (this.opening ?? 0) + 1);
    attribute(this.root, "aria-busy", "true");
    if (!this.reel) fill(this.about, "Opening the run …"); // replaying a long journal takes seconds
    const reel = await this.fetchReel(id);
    if (ticket !== this.opening) return; // another run was chosen meanwhile
    attribute(this.root, "aria-busy", null);
    if (!reel && !this.reel) fill(this.about);
    if (!reel) return;
    this.reel = reel;
    this.screens[0].load(reel);
    this.range.max = String(reel.records.length);
    this.controlsChanged();
    this.paintRuns();
    this.paintAbout();
    this.go(keep ? this.index : reel.records.length, false);
  }

  async compare(id) {
    const ticket = (this.comparing = (this.comparing ?? 0) + 1);
    const other = id ? await this.fetchReel(id) : null;
    if (ticket !== this.comparing) return; // another run, or none, was chosen meanwhile
    this.other = other;
    this.screens[1].canvas.root.hidden = !this.other;
    if (this.other) this.screens[1].load(this.other);
    this.screens[0].canvas.view.fit(READABLE);
    this.paintRuns();
    this.paintAbout();
    this.go(this.index, false);
  }

  /** Firings of the shown run before the other one sets out from it; negative: the other way round; 0: both begin alike. */
  get shift() {
    return this.reel.before(this.other) ?? -(this.other.before(this.reel) ?? 0);
  }

  /** The first firing in which two runs differ, counted from 1 in the shown one; 0 when they do not. */
  firstDifference() {
    const [a, b, shift] = [this.reel.firings, this.other.firings, this.shift];
    for (let i = Math.max(0, shift); i < Math.max(a.length, b.length + shift); i++) if (a[i]?.transition !== b[i - shift]?.transition) return i + 1;
    return 0;
  }

  paintAbout() {
    const { run } = this.reel;
    const from = run.from ? `from ${run.from.run}, ${run.from.record ? `record ${run.from.record}` : "beginning"}` : "";
    const facts = [`${run.records.length} records`, `${this.reel.firings.length} firings`, run.seed !== undefined && run.seed !== null ? `seed ${run.seed}` : "", run.mode, run.plant, from].filter(Boolean).join(", ");
    if (!this.other) return fill(this.about, run.fault ? h("span", {}, icon("warning"), ` ${run.fault}. `) : null, facts);
    const [first, shift] = [this.firstDifference(), this.shift];
    const since = shift ? `One run started from a record of the other; they are compared from there on. ` : "";
    if (!first) return fill(this.about, `${since}Both runs fired the same transitions in the same order.`);
    const name = (firing) => (firing ? this.labelOf(firing.transition) : "no further firing");
    return fill(this.about, `${since}The runs differ from firing ${first} on: ${name(this.reel.firings[first - 1])} here, ${name(this.other.firings[first - 1 - shift])} there. `, h("button", { type: "button", class: "small", onclick: () => this.go(this.reel.atFirings(first)) }, "Go there"));
  }

  // ---- scrubbing ----------------------------------------------------------------------------------------------------

  go(index, moving = true) {
    if (!this.reel) return;
    const { records } = this.reel;
    const next = Math.max(0, Math.min(index, records.length));
    const flies = moving && next > this.index && next <= this.index + 200;
    this.index = next;
    this.range.value = String(next);
    this.screens[0].show(next, flies);
    if (this.other) this.screens[1].show(this.other.atFirings(this.reel.firingsUpTo(next) - this.shift), flies);
    const record = records[next - 1];
    text(this.where, next ? `${next} of ${records.length}, ${seconds(record.t)}` : `beginning of ${records.length}`);
    attribute(this.range, "aria-valuetext", next ? `record ${next}: ${record.text}` : "beginning");
    this.screens[0].canvas.view.only("chosen", new Set(record?.firings.map((f) => f.transition) ?? []));
    this.paintRows();
  }

  /** To the next record in that direction that the list shows. */
  step(direction) {
    let index = this.index + direction;
    while (index > 0 && index < this.reel.records.length && !this.isShown(this.reel.records[index - 1])) index += direction;
    this.go(index, direction > 0);
  }

  isShown(record) {
    return this.every.checked || record.firings.length > 0 || Object.keys(record.marking).length > 0 || record.notes?.length > 0;
  }

  /** How an element is called on the drawing. */
  labelOf(name) {
    const { task } = this.reel.run;
    this.reel.labels ??= task && labelsOf(task);
    return this.reel.labels?.get(name) ?? words(name);
  }

  toError(step) {
    for (let i = this.index + step; i >= 1 && i <= this.reel.records.length; i += step) if (this.reel.records[i - 1].error) return this.go(i, false);
    return null;
  }

  paintRows() {
    const { records } = this.reel;
    const listed = records.map((record, i) => [record, i + 1]).filter(([record, at]) => at === this.index || this.isShown(record));
    const here = Math.max(0, listed.findIndex(([, at]) => at >= this.index));
    const from = Math.max(0, Math.min(here - ROWS_AROUND, listed.length - 2 * ROWS_AROUND));
    let current = null;
    fill(this.rowsBox, listed.slice(from, from + 2 * ROWS_AROUND).map(([record, at]) => {
      const row = h("li", {}, h("button", { type: "button", class: `record${record.error ? " error" : ""}${at > this.index ? " future" : ""}`, "aria-current": at === this.index ? "true" : null, onclick: () => this.go(at, false) },
        h("span", { class: "line" }, h(record.firings.length ? "strong" : "span", {}, record.firings.length ? record.firings.map((f) => this.labelOf(f.transition)).join(", ") : words(record.text)), h("span", { class: "number muted" }, seconds(record.t))),
        record.firings.length ? h("span", { class: "detail" }, words(record.text)) : null,
        record.firings.map(reasonText).filter(Boolean).map((r) => h("span", { class: "detail reason" }, r)),
        (record.notes ?? []).map((note) => h("span", { class: "detail" }, words(note)))));
      if (at === this.index) current = row;
      return row;
    }));
    if (!current) return;
    const box = [this.rowsBox, this.recordsBox].find((b) => b.scrollHeight > b.clientHeight + 1) ?? this.recordsBox; // in a small window the rows scroll
    const top = current.getBoundingClientRect().top - box.getBoundingClientRect().top;
    if (top < 40 || top + current.offsetHeight > box.clientHeight - 40) box.scrollTop += top - box.clientHeight / 2;
  }

  simulate() {
    const { run, records } = this.reel;
    const record = this.index ? records[this.index - 1] : null;
    simulateDialog(run, record?.number ?? 0, record?.going ?? [], (place) => this.labelOf(place), async (data) => {
      const answer = await this.operator.give("start", data, false, true);
      if (answer.ok) location.hash = "#Live";
      return answer;
    });
  }
}
