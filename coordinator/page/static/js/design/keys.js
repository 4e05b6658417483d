// The designer by keyboard alone, and the list of its keys.

import { openDialog } from "../dialog.js";
import { h } from "../dom.js";
import { nudge } from "./arrange.js";

const STEP = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const TOOL = { v: "select", 1: "action", 2: "resource", 3: "control", 4: "macro", 5: "plain", t: "transition", a: "arc", i: "inhibit" };

const LIST = [
  ["1 2 3 4 5", "tool for an action, resource, control, macro or plain place; Enter adds one next to the selection"],
  ["T", "tool for a transition"], ["A, I", "arc or inhibitor arc from the selected element: go to the target with Ctrl and arrows, press Enter"],
  ["V, Esc", "back to the selection tool; Esc never deletes anything"],
  ["Ctrl + arrows", "select the nearest element in that direction"], ["[ and ]", "previous and next element"],
  ["Ctrl G, Ctrl Shift G", "put the selection into a macro place; dissolve the macro place"], ["O, Backspace", "open the selected macro place; with nothing selected, leave the open one"],
  ["Arrows", "move the selection by one grid step; with Shift by five"], ["Enter", "properties of the selected element"],
  ["Delete", "delete the selection"], ["Ctrl Z, Ctrl Y", "undo, redo"], ["Ctrl C, X, V, D", "copy, cut, paste, duplicate"],
  ["Ctrl A", "select everything"], ["Ctrl S", "save"], ["Ctrl F", "find"], ["+ and -, 0", "zoom, whole net"],
  ["Drag", "on an element: move it (Alt: off the grid); on the ground: select; with Space or the middle button: move the view"],
];

export class Keys {
  constructor(designer) {
    this.designer = designer;
    addEventListener("keydown", (event) => this.pressed(event));
  }

  get active() {
    return document.documentElement.dataset.view === "design" && !document.querySelector("dialog[open]");
  }

  pressed(event) {
    if (!this.active || event.defaultPrevented) return;
    const typing = event.target.closest?.("input, textarea, select");
    const done = event.ctrlKey || event.metaKey ? this.withControl(event, typing) : !typing && this.plain(event);
    if (done) event.preventDefault();
  }

  withControl(event, typing) {
    const { designer } = this;
    const key = event.key.toLowerCase();
    if (key === "s") {
      if (typing) event.target.blur(); // the text in the field belongs to what is saved
      return designer.desk.save() ?? true;
    }
    if (key === "f") return designer.canvas.query.focus() ?? true;
    if (typing) return false;
    if (STEP[event.key]) return this.nearest(...STEP[event.key]);
    const acts = {
      z: () => (event.shiftKey ? designer.redo() : designer.undo()), y: () => designer.redo(), c: () => designer.copy(),
      x: () => { designer.copy(); designer.removeChosen(); }, v: () => designer.paste(), d: () => { designer.copy(); designer.paste(); },
      g: () => (event.shiftKey ? designer.ungroup() : designer.group()),
      a: () => designer.choose(new Set(designer.view.elements.keys())),
    };
    if (!acts[key]) return false;
    acts[key]();
    return true;
  }

  plain(event) {
    const { designer } = this;
    const button = event.target.closest?.("button") && !event.target.closest("svg");
    if (event.key === "Escape") return designer.tools.use("select") ?? true;
    if (button && ["Enter", " "].includes(event.key)) return false;
    if (STEP[event.key]) return this.nudge(STEP[event.key], event.shiftKey ? 50 : 10);
    if (event.key === "Backspace" && !designer.selected.names.size && !designer.selected.arc) return designer.up() ?? true;
    if (event.key === "Delete" || event.key === "Backspace") return designer.removeChosen() ?? true;
    if (event.key === "[" || event.key === "]") return this.next(event.key === "]" ? 1 : -1);
    if (event.key === "?") return designer.help.open() ?? true;
    if (event.key === "+" || event.key === "-") return designer.view.zoomBy(event.key === "+" ? 1.25 : 0.8) ?? true;
    if (event.key === "0") return designer.view.fit() ?? true;
    if (event.key === "Enter") return this.enter();
    if (event.key.toLowerCase() === "o") return this.open();
    const tool = TOOL[event.key.toLowerCase()];
    if (!tool) return false;
    this.useTool(tool);
    return true;
  }

  useTool(tool) {
    const { designer } = this;
    const [first] = designer.selection.names;
    designer.tools.use(tool);
    if (designer.tools.draws && first) designer.tools.from(first, `From ${first}: go to the target with Ctrl and the arrow keys, then press Enter.`);
  }

  enter() {
    const { designer } = this;
    const [first] = designer.selection.names;
    const { tools } = designer;
    if (tools.draws) {
      if (!tools.arcFrom && first) tools.from(first, `From ${first}: go to the target with Ctrl and the arrow keys, then press Enter.`);
      else if (first && first !== tools.arcFrom) this.endArc(first);
      return true;
    }
    if (tools.tool !== "select") {
      tools.insertFree(tools.tool);
      return true;
    }
    if (first) designer.inspector.focusName();
    return Boolean(first);
  }

  open() {
    const [first] = this.designer.selected.elements;
    if (first) this.designer.opened(first);
    return Boolean(first);
  }

  async endArc(target) {
    const { designer } = this;
    if (!(await designer.connect(designer.tools.arcFrom, target))) return;
    designer.tools.use("select");
    designer.choose(new Set([target]));
  }

  nudge([dx, dy], step) {
    return nudge(this.designer, dx * step, dy * step);
  }

  nearest(dx, dy) {
    const { designer } = this;
    const [first] = designer.selection.names;
    const all = [...designer.view.elements.values()].filter((e) => !designer.view.isFolded(e));
    const from = designer.view.elements.get(first);
    if (!from) return this.select(all[0]);
    let best = null;
    let least = Infinity;
    for (const e of all) {
      const along = (e.x - from.x) * dx + (e.y - from.y) * dy;
      const aside = Math.abs((e.x - from.x) * dy) + Math.abs((e.y - from.y) * dx);
      if (along > 5 && along + 2 * aside < least) [best, least] = [e, along + 2 * aside];
    }
    return this.select(best);
  }

  next(step) {
    const { designer } = this;
    const all = [...designer.view.elements.values()].filter((e) => !designer.view.isFolded(e)).sort((a, b) => a.x - b.x || a.y - b.y);
    const [first] = designer.selection.names;
    const i = all.findIndex((e) => e.name === first);
    return this.select(all[(i + step + all.length) % all.length]);
  }

  select(element) {
    if (!element) return true;
    this.designer.choose(new Set([element.name]));
    element.node.focus({ preventScroll: true });
    return true;
  }
}

export class KeyHelp {
  open() {
    const dialog = h("dialog", { class: "key-help", "aria-label": "Keyboard" }, h("h2", {}, "Keyboard"),
      h("dl", {}, LIST.map(([keys, what]) => h("div", {}, h("dt", {}, keys), h("dd", {}, what)))),
      h("div", { class: "buttons" }, h("button", { type: "button", class: "command primary", onclick: () => dialog.close() }, "Close")));
    openDialog(dialog);
  }
}
