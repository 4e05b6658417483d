// What a run learns: curves of each alternative, what is known of them, and the places coloured by J = 1 - R + rho C.

import { Chart } from "./charts.js";
import { attribute, fill, h, text, words } from "./dom.js";

const MEASURES = [["probability", "probability of choice"], ["J", "objective J"]];
const figure = (value, digits = 3) => (value === undefined || value === null || !Number.isFinite(value) ? "–" : String(+value.toPrecision(digits)));
/** A figure with its 95 % interval, as far as that is known. */
const measured = (value, low, high) => (Number.isFinite(value) && Number.isFinite(low) && Number.isFinite(high) ? `${figure(value)} (${figure(low)} to ${figure(high)})` : figure(value));

/** J of each primitive task as it is chosen now: by its override, else by its probabilities. */
export function objectives(selectors) {
  const found = {};
  for (const [name, selector] of Object.entries(selectors)) {
    const known = (selector.alternatives ?? []).filter((a) => Number.isFinite(a.j));
    const fixed = known.find((a) => a.action === selector.override);
    const weight = known.reduce((sum, a) => sum + (a.probability ?? 0), 0);
    if (fixed) found[name] = fixed.j;
    else if (weight > 0) found[name] = known.reduce((sum, a) => sum + a.j * (a.probability ?? 0), 0) / weight;
  }
  return found;
}

export class Learning {
  /** `heated()` is called when the colouring of the places is switched. */
  constructor(heated) {
    this.charts = new Map();
    this.measure = h("select", { "aria-label": "Curves of", onchange: () => this.update(this.state) }, MEASURES.map(([value, label]) => h("option", { value }, label)));
    this.heat = h("button", { type: "button", class: "small", "aria-pressed": "false", onclick: () => {
      this.hot = !this.hot;
      attribute(this.heat, "aria-pressed", String(this.hot));
      heated();
    } }, "Colour places by J");
    this.note = h("p", { class: "muted", role: "status" });
    this.curves = h("div", { class: "curves" });
    this.notes = h("div", { class: "notes" });
    this.table = h("table", { class: "known" });
    this.bar = h("div", { class: "learning-bar" }, h("label", {}, "Curves of", this.measure), this.heat, this.note);
    this.root = h("div", { class: "learning" }, this.bar, this.curves, this.table, this.notes);
  }

  update(state) {
    this.state = state;
    if (!state) return;
    const reports = Object.entries(state.reports);
    const all = reports.filter(([, r]) => r.kind === "curve");
    const several = new Set(all.map(([, r]) => r.y)).size > 1;
    const curves = several ? all.filter(([, r]) => r.y === this.measure.value || !MEASURES.some(([m]) => m === r.y)) : all;
    const others = reports.filter(([, r]) => r.kind !== "curve");
    this.paintCurves(curves);
    this.paintKnown(state.selectors);
    const learned = Object.keys(objectives(state.selectors)).length > 0;
    const empty = !all.length && !others.length && !learned;
    this.bar.hidden = empty;
    this.measure.parentElement.hidden = !several;
    this.heat.disabled = !learned;
    text(this.note, this.hot && learned ? "Pale: good. Strong: costly or unreliable." : "");
    fill(this.notes, others.map(([name, r]) => h("article", {}, h("h3", {}, r.title ?? words(name)), h("p", {}, r.text ?? ""))),
      empty ? h("p", { class: "empty" }, "Nothing has been learned yet. Curves appear here when a run learns: Start with, Learning.") : null);
  }

  paintCurves(curves) {
    const shown = new Set(curves.map(([name]) => name));
    for (const [name, chart] of this.charts) {
      if (shown.has(name)) continue;
      chart.root.remove();
      this.charts.delete(name);
    }
    for (const [name, report] of curves) {
      if (!this.charts.has(name)) {
        const chart = new Chart(report.title ?? words(name), report.x ?? "runs", report.y ?? "");
        this.charts.set(name, chart);
        this.curves.append(chart.root);
      }
      this.charts.get(name).set(report.series, report.columns);
    }
  }

  paintKnown(selectors) {
    const known = Object.entries(selectors).filter(([, s]) => (s.alternatives ?? []).some((a) => Number.isFinite(a.j)));
    this.table.hidden = !known.length;
    if (!known.length) return;
    const head = ["Primitive task", "Alternative", "Probability", "R", "C", "J", ""].map((name) => h("th", { scope: "col" }, name));
    const rows = known.flatMap(([name, selector]) => {
      const lowest = Math.min(...selector.alternatives.map((a) => a.j).filter(Number.isFinite));
      return selector.alternatives.map((a, i) => h("tr", {}, h("th", { scope: "row" }, i ? "" : words(name)), h("td", {}, words(a.action)),
        [figure(a.probability), measured(a.reliability, a.reliability_low, a.reliability_high), figure(a.cost), measured(a.j, a.j_low, a.j_high)].map((value) => h("td", { class: "number" }, value)),
        h("td", {}, [a.action === selector.override ? "fixed by the operator" : "", a.j !== lowest ? "" : a.best ? "lowest J" : "lowest J, but the difference may be chance"].filter(Boolean).join(", "))));
    });
    fill(this.table, h("caption", {}, "What is known about the alternatives (J = 1 − R + ρC, the lowest is best; with 95 % intervals)"), h("thead", {}, h("tr", {}, head)), h("tbody", {}, rows));
  }
}
