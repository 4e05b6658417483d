// Results of the analysis of the drawn task: verdicts, firings that lead to a counterexample, and how its time is spent.

import { attribute, fill, h, s } from "../dom.js";
import { analyseDocument } from "../files.js";
import { icon } from "../icons.js";
import { around, groups } from "./macros.js";

const SETTLED_MS = 1500;
const SIGN = { true: "check", false: "error", null: "info" };
const SAID = { true: "holds", false: "does not hold", null: "not known" };

export class Verdicts {
  constructor(designer) {
    this.designer = designer;
    this.list = h("ul", {});
    this.head = h("span", { class: "muted", role: "status" });
    this.button = h("button", { type: "button", class: "small", onclick: () => this.analyse() }, "Analyse");
    this.heatButton = h("button", { type: "button", class: "small", "aria-pressed": "false", hidden: true, onclick: () => this.toggleHeat() }, "Bottleneck");
    this.root = h("section", { class: "strip verdicts", "aria-label": "Analysis" }, h("h2", {}, "Analysis", this.head, h("div", { class: "spacer" }), this.heatButton, this.button), this.list);
    this.heat = {};
  }

  /** The document changed: earlier verdicts no longer hold. */
  forget() {
    clearTimeout(this.later);
    this.asked = null;
    this.shown = null;
    this.hot = false;
    this.heat = {};
    this.heatButton.hidden = true;
    attribute(this.heatButton, "aria-pressed", "false");
    this.head.textContent = "";
    attribute(this.root, "data-state", null);
    fill(this.list);
  }

  /** The check found no fault: analyse when the drawing stays unchanged, unless a mission is active. */
  soon() {
    clearTimeout(this.later);
    const busy = () => ["running", "preparing", "stopping"].includes(this.designer.link.state.mission.state);
    this.later = setTimeout(() => !this.designer.root.hidden && !busy() && this.analyse(), SETTLED_MS);
  }

  async analyse() {
    clearTimeout(this.later);
    const { model } = this.designer;
    const document = model.data;
    if (this.asked === document) return;
    this.asked = document;
    this.head.textContent = "working …";
    const answer = await analyseDocument(model.name, document, model.renames);
    if (this.asked !== document) return; // it was edited meanwhile
    this.asked = null;
    if (answer === null) {
      this.head.textContent = ""; // the check that took its place asks again
      return;
    }
    if (typeof answer === "string") {
      this.head.textContent = answer;
      return;
    }
    this.designer.findings.takeAll(answer.findings);
    const against = answer.verdicts.filter((v) => v.problem).length;
    this.head.textContent = `${against ? `${against} ${against === 1 ? "problem" : "problems"}` : "no problem"} found in ${answer.markings} markings${answer.complete ? "" : " (not all were examined)"}`;
    attribute(this.root, "data-state", against ? "error" : null);
    this.heat = answer.heat;
    this.heatButton.hidden = !Object.keys(answer.heat).length;
    fill(this.list, [...answer.verdicts.map((v) => this.row(v)), ...answer.notes.map((text) => h("li", { class: "muted" }, text))]);
  }

  row(verdict) {
    const { witness } = verdict;
    const button = h("button", { type: "button", disabled: verdict.holds !== false || !witness, "aria-pressed": "false", onclick: () => this.show(verdict, button) },
      icon(SIGN[verdict.holds]), h("strong", {}, `${verdict.words}: ${SAID[verdict.holds]}`), h("span", {}, [verdict.reason, ...verdict.details].join("; "), witness && verdict.holds === false ? `. Example: ${witness.firings.join(", ") || "the initial marking"}.` : ""));
    return h("li", { class: verdict.problem ? "error" : "" }, button);
  }

  /** The marking of the counterexample, with the order in which transitions fired; a second click removes it. */
  show(verdict, button) {
    const again = this.shown === verdict;
    this.shown = again ? null : verdict;
    for (const other of this.list.querySelectorAll("button")) attribute(other, "aria-pressed", String(other === button && !again));
    this.designer.openSheet("");
    this.paint();
  }

  toggleHeat() {
    this.hot = !this.hot;
    attribute(this.heatButton, "aria-pressed", String(this.hot));
    this.paint();
  }

  /** Show the chosen verdict on the drawing. */
  paint() {
    const { view, picture } = this.designer;
    const witness = this.shown?.witness;
    const turns = new Map();
    [...(witness?.firings ?? []), ...(witness?.loop ?? [])].forEach((name, i) => turns.set(name, [...(turns.get(name) ?? []), i + 1]));
    const { net } = this.designer.model;
    const covers = (name, place) => place === name || around(net, place.split(".")[0]).includes(name) || (place.startsWith(`${name}.`) && !groups(net.places?.[name]));
    const inside = (name) => Object.entries(witness.marking).reduce((sum, [place, n]) => sum + (covers(name, place) ? n : 0), 0);
    for (const place of picture.places) view.tokens(place.name, witness ? inside(place.name) : place.tokens);
    for (const element of view.elements.values()) {
      const share = this.hot ? this.heat[element.name] : undefined;
      element.node.classList.toggle("hot", share !== undefined);
      element.node.style.setProperty("--heat", `${Math.round(100 * (share ?? 0))}%`);
      element.turns?.remove();
      element.turns = turns.has(element.name) ? s("text", { class: "turns", y: 4 }, turns.get(element.name).join(", ")) : null;
      if (element.turns) element.node.append(element.turns);
    }
  }
}
