// Findings of the check for the drawn task: a mark on the element, and a list with links to it.

import { attribute, fill, h, Press, words } from "../dom.js";
import { checkDocument } from "../files.js";
import { icon } from "../icons.js";
import { taskOf } from "./drawn.js";
import { around, drawnAs } from "./macros.js";

const CHECK_MS = 300;
const ORDER = { error: 0, warning: 1 };
const SIGN = { error: "error", warning: "warning" };

export class Findings {
  constructor(designer) {
    Object.assign(this, { designer, list: [], text: "" });
    this.root = h("section", { class: "strip", "aria-label": "Findings" });
    this.press = new Press(this.root);
  }

  get errors() {
    return this.list.filter((f) => f.severity === "error").length;
  }

  /** The server's answer for a text: its findings, and the text itself. Some findings come only with the analysis. */
  take({ findings, text }) {
    Object.assign(this, { list: findings, text, searched: false });
    attribute(this.root, "aria-busy", null);
    this.paint();
  }

  /** The findings of the analysis, which replace those of the check. */
  takeAll(list) {
    Object.assign(this, { list, searched: true });
    this.paint();
    this.designer.inspector.show(this.designer.selection);
  }

  /** Ask when the drawing has not changed for a moment; until the answer the list shows the earlier findings. */
  soon() {
    clearTimeout(this.checking);
    attribute(this.root, "aria-busy", "true");
    this.checking = setTimeout(() => this.check(), CHECK_MS);
  }

  async check() {
    const { model } = this.designer;
    const checked = model.data;
    const asked = (this.asked = (this.asked ?? 0) + 1);
    const said = await checkDocument(model.name, checked, model.renames);
    if (checked !== model.data || asked !== this.asked) return; // a later question is on its way
    if (!said) {
      attribute(this.root, "aria-busy", null);
      return;
    }
    this.take(said);
    if (!this.errors) this.designer.verdicts.soon();
    this.designer.inspector.show(this.designer.selection);
  }

  /** Findings of one element of this sheet; "" gives those of the task itself. */
  of(name) {
    return this.list.filter((f) => this.shownAt(f) === name || (name && this.elementOf(f) === name));
  }

  /** The element of the drawn net that a finding is about; "" for none, null when it is in another net. */
  elementOf(finding) {
    const { model } = this.designer;
    const parts = (finding.key ?? "").split(".");
    const at = model.sheet ? 2 : 0;
    if (model.sheet ? parts[0] !== "subnets" || parts[1] !== model.sheet : parts[0] === "subnets") return null;
    if (parts[at] === "places" || parts[at] === "transitions") return parts[at + 1] ?? "";
    if (parts[0] === "primitive_tasks") return Object.entries(model.net.places ?? {}).find(([name, p]) => taskOf(name, p) === parts[1])?.[0] ?? "";
    return "";
  }

  /** Where that is drawn: the element itself, or the macro place around it. */
  shownAt(finding) {
    const { model } = this.designer;
    const name = this.elementOf(finding);
    if (!name || this.designer.view.elements.has(name)) return name;
    const shown = drawnAs(model.net, model.inside);
    return shown.get(name) ?? around(model.net, name).map((macro) => shown.get(macro)).find(Boolean) ?? null;
  }

  paint() {
    const worst = new Map();
    for (const finding of this.list) {
      const name = this.shownAt(finding);
      if (name && worst.get(name)?.severity !== "error") worst.set(name, finding);
    }
    for (const { name } of this.designer.view.elements.values()) {
      const finding = worst.get(name);
      this.designer.view.mark(name, "fault", SIGN[finding?.severity] ?? null, finding?.text ?? "");
    }
    this.paintList();
  }

  paintList() {
    if (this.press.holds(() => this.paintList())) return;
    const { errors } = this;
    const list = [...this.list].sort((a, b) => (ORDER[a.severity] ?? 2) - (ORDER[b.severity] ?? 2));
    fill(this.root, h("h2", {}, icon(errors ? "error" : "check"), errors ? `${errors} ${errors === 1 ? "fault" : "faults"}` : "May run", h("span", { class: "muted" }, [list.length > errors ? `${list.length - errors} to look at` : "", errors || this.searched ? "" : "states not searched yet"].filter(Boolean).join("; "))),
      h("ul", {}, list.map((f) => h("li", { class: f.severity }, h("button", { type: "button", onclick: () => this.goTo(f) }, icon(SIGN[f.severity] ?? "info"), h("strong", {}, words(this.elementOf(f) || f.key)), h("span", {}, f.text, f.remedy ? `. ${f.remedy.replace(/^./, (c) => c.toUpperCase())}.` : ""))))));
    attribute(this.root, "data-state", errors ? "error" : "ok");
  }

  goTo(finding) {
    const { designer } = this;
    const parts = (finding.key ?? "").split(".");
    if (parts[0] === "subnets" && designer.model.sheet !== parts[1]) designer.openSheet(parts[1]);
    const name = this.elementOf(finding);
    if (name) designer.goTo(name);
  }
}
