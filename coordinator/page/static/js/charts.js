// Curves over time or over runs, by the vendored uPlot: set-point latency, learning, anything a report carries.

import { h, words } from "./dom.js";

// steps between the ticks of what is counted
const WHOLE = [0, 1, 2, 3, 4, 5, 6].flatMap((power) => [1, 2, 5].map((n) => n * 10 ** power));
/** Room for the longest number beside the axis. */
const wide = (_, values) => Math.max(42, 20 + 6.5 * Math.max(0, ...(values ?? []).map((value) => String(value ?? "").length)));

const SERIES = ["accent", "ok", "warn", "hold", "bad", "muted"];

export class Chart {
  /** `y` is the axis' label with its unit; `x` likewise. */
  constructor(title, x, y) {
    this.box = h("div", { class: "chart" });
    this.root = h("figure", { class: "chart-box", "aria-label": title }, h("figcaption", {}, title), this.box);
    this.title = title;
    this.axes = [x, y];
    new ResizeObserver(() => this.resize()).observe(this.box);
  }

  /** Columns: x values, then one column for each named series. */
  set(names, columns) {
    this.names = names;
    this.columns = columns;
    const key = names.join("|") + document.documentElement.dataset.theme;
    if (!this.box.clientWidth) return;
    if (this.key !== key) this.make(key);
    else this.plot.setData(columns);
  }

  make(key) {
    this.plot?.destroy();
    this.key = key;
    const css = getComputedStyle(document.documentElement);
    const colour = (name) => css.getPropertyValue(`--${name}`).trim();
    const axis = (label) => ({ label, stroke: colour("muted"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line"), width: 1 }, font: "11px system-ui", labelFont: "11px system-ui", labelSize: 18, size: 42 });
    const series = this.names.map((name, i) => ({ label: words(name), stroke: colour(SERIES[i % SERIES.length]), width: 1.8, points: { show: false } }));
    const whole = this.columns[0].every(Number.isInteger);
    const options = { ...this.measure(), scales: { x: { time: false } }, axes: [{ ...axis(this.axes[0]), size: 34, ...(whole && { incrs: WHOLE }) }, { ...axis(this.axes[1]), size: wide }], series: [{ label: this.axes[0] }, ...series], cursor: { y: false }, legend: { live: true } };
    this.plot = new uPlot(options, this.columns, this.box);
  }

  measure() {
    return { width: Math.max(200, this.box.clientWidth), height: Math.max(110, this.box.clientHeight - 26) };
  }

  resize() {
    if (!this.box.clientWidth || !this.columns) return;
    if (this.plot) this.plot.setSize(this.measure());
    else this.set(this.names, this.columns);
  }
}
