// The bar above the drawing: the open task, whether it is saved, and buttons that also have keys.

import { tool } from "../canvas.js";
import { attribute, fill, h, text, words } from "../dom.js";
import { icon } from "../icons.js";
import { layOut } from "./arrange.js";

const FORMS = [["", "Import, export"], ["in", "Import PNML or TOML"], ["svg", "Export SVG"], ["png", "Export PNG"], ["gspn.svg", "Show stochastic view"], ["pnml", "Export PNML"], ["toml", "Export TOML"]];

export class Bar {
  constructor(designer) {
    this.designer = designer;
    const { desk } = designer;
    this.picker = h("select", { "aria-label": "Task", onchange: () => designer.during(desk.pick(this.picker.value)) });
    this.state = h("span", { class: "saved", role: "status" });
    this.again = h("button", { type: "button", class: "small", hidden: true, onclick: () => designer.during(desk.loadAgain()) }, "Load it");
    this.undo = tool("undo", "Undo", () => designer.undo());
    this.redo = tool("redo", "Redo", () => designer.redo());
    this.more = h("select", { "aria-label": "Import and export", onchange: () => this.exchange() }, FORMS.map(([v, t]) => h("option", { value: v }, t)));
    this.root = h("div", { class: "design-bar", role: "toolbar", "aria-label": "Task file" },
      this.picker, tool("plus", "New task", () => desk.begin()),
      h("button", { type: "button", class: "small", onclick: () => desk.save() }, icon("save"), "Save"), this.state, this.again,
      h("div", { class: "gap" }), this.undo, this.redo,
      tool("copy", "Copy", () => designer.copy()), tool("paste", "Paste", () => designer.paste()), tool("trash", "Delete", () => designer.removeChosen()),
      h("button", { type: "button", class: "small", onclick: () => layOut(designer) }, icon("layout"), "Layout"),
      this.more, desk.file, tool("info", "Keyboard", () => designer.help.open()), h("div", { class: "spacer" }),
      h("button", { type: "button", class: "command primary", onclick: () => desk.run() }, icon("play"), "Run this task"));
  }

  exchange() {
    const form = this.more.value;
    this.more.value = "";
    return this.designer.desk.exchange(form);
  }

  /** List the tasks; a new one that is not saved yet comes first. */
  list(tasks) {
    const { model } = this.designer;
    const names = tasks.map((t) => t.name);
    const whose = new Map(tasks.map((t) => [t.name, t.own === false ? " (shipped)" : t.shipped ? " (my copy)" : ""]));
    const own = model.name && !names.includes(model.name) ? [model.name] : [];
    fill(this.picker, model.name ? null : h("option", { value: "" }, "(new task)"), [...own, ...names].map((n) => h("option", { value: n }, `${words(n)}${whose.get(n) ?? ""}`)));
    this.picker.value = model.name;
  }

  /** Show the open task, and what undo would take back. */
  paint() {
    const { model, desk } = this.designer;
    this.picker.value = model.name;
    this.again.hidden = !desk.isOld;
    text(this.state, desk.isOld ? `changed by another program${model.dirty ? ", and not saved" : ""}` : model.dirty ? "not saved" : !model.name ? "" : desk.isShipped ? "shipped, saving makes your copy" : "saved");
    attribute(this.state, "data-dirty", model.dirty || desk.isOld ? "" : null);
    for (const [button, states, word] of [[this.undo, model.past, "Undo"], [this.redo, model.future, "Redo"]]) {
      button.disabled = !states.length;
      attribute(button, "title", states.length ? `${word}: ${states.at(-1).label}` : word);
    }
  }
}
