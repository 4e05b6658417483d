// Which alternative each primitive task takes: how probable each is, and the operator's own choice.

import { panel } from "./canvas.js";
import { h, rows, text, words } from "./dom.js";

export class Selectors {
  constructor(link, operator) {
    Object.assign(this, { link, operator });
    const { root, content } = panel("Selectors", h("ul", { class: "selectors" }));
    Object.assign(this, { root, content });
  }

  /** Keep a row while its task offers the same actions: an operator may be choosing from it while a run learns. */
  paint() {
    const list = Object.entries(this.link.state.selectors).filter(([, selector]) => (selector.alternatives ?? []).length > 1);
    this.root.hidden = !list.length;
    const key = ([name, { alternatives }]) => [name, ...alternatives.map((a) => a.action)].join(" ");
    rows(this.content, list, key, ([name, selector]) => this.row(name, selector), (row, [, selector]) => this.update(row, selector));
  }

  row(name, { alternatives }) {
    const choose = h("select", { "aria-label": `Alternative for ${words(name)}`, onchange: () => this.choose(name, choose) },
      h("option", { value: "" }, "automatic choice"), alternatives.map((a) => h("option", { value: a.action }, words(a.action))));
    const bars = alternatives.map((a) => h("li", {}, h("span", {}, words(a.action)), h("meter", { min: 0, max: 1 }), h("span", { class: "number" })));
    return h("li", { class: "selector" }, h("div", { class: "line" }, h("strong", {}, words(name)), choose), h("ul", { class: "bars" }, bars));
  }

  update(row, { alternatives, override }) {
    const choose = row.querySelector("select");
    choose.disabled = Boolean(this.link.barred);
    const told = override ?? "";
    if (row.dataset.override !== told) choose.value = row.dataset.override = told;
    alternatives.forEach(({ probability }, i) => {
      const [, meter, share] = row.querySelector(".bars").children[i].children;
      meter.value = probability ?? 0;
      text(share, Number.isFinite(probability) ? `${Math.round(probability * 100)} %` : "");
    });
  }

  async choose(name, choose) {
    const answer = await this.operator.give("override_selector", { primitive_task: name, action: choose.value || null });
    if (!answer.ok) choose.value = this.link.state.selectors[name]?.override ?? "";
  }
}
