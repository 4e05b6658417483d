// The drawing tools: which one is chosen, its hint, and where a new element is put.

import { attribute, h, text } from "../dom.js";
import { snap } from "../geometry.js";
import { icon } from "../icons.js";

const NEARLY = 16;
const APART = 70;
const TOOLS = [
  ["select", "select", "Select", "V"], ["action", "action", "Action place", "1"], ["resource", "resource", "Resource place", "2"],
  ["control", "control", "Control place", "3"], ["macro", "macro", "Macro place", "4"],
  ["plain", "plain", "Plain place", "5"], ["transition", "transition", "Transition", "T"],
  ["arc", "arc", "Arc", "A"], ["inhibit", "inhibitor", "Inhibitor arc", "I"],
];
const SAID = { select: "", arc: "Drag from a place to a transition, or choose one after the other.", inhibit: "Drag from a place to the transition that its tokens block." };

export class Toolbox {
  constructor(designer) {
    Object.assign(this, { designer, tool: "select", arcFrom: null, buttons: {} });
    this.root = h("nav", { class: "toolbox", role: "toolbar", "aria-label": "Drawing tools", "aria-orientation": "vertical" }, TOOLS.map(([key, sign, label, letter]) => {
      const button = h("button", { type: "button", class: "draw-tool", "aria-label": label, "aria-keyshortcuts": letter, "aria-pressed": "false", onclick: (event) => this.pressed(key, event) }, icon(sign), h("span", {}, label), h("kbd", {}, letter));
      this.buttons[key] = button;
      return button;
    }));
    this.hint = h("p", { class: "hint", role: "status" });
  }

  get view() {
    return this.designer.view;
  }

  get draws() {
    return this.tool === "arc" || this.tool === "inhibit";
  }

  use(name) {
    this.designer.pointer.stop(); // a drag that was begun with another tool
    this.tool = name;
    this.arcFrom = null;
    this.view.only("target", new Set());
    for (const [key, button] of Object.entries(this.buttons)) attribute(button, "aria-pressed", String(key === name));
    this.view.svg.dataset.tool = name;
    this.tell(SAID[name] ?? "Click where to put it, or press Enter to put it in the middle.");
  }

  tell(message) {
    text(this.hint, message);
    this.hint.hidden = !message;
  }

  /** Begin an arc at an element. */
  from(name, message) {
    this.arcFrom = name;
    this.view.only("target", new Set([name]));
    this.tell(message);
  }

  /** A tool chosen by keyboard acts at once: there is no pointer that could choose the point. */
  pressed(key, event) {
    this.use(key);
    if (event.detail === 0 && key !== "select" && !this.draws) this.insertFree(key);
  }

  /** Put a new element where the pointer says, in line with those that are nearly in line already. */
  insertNear(kind, x, y) {
    const all = [...this.view.elements.values()];
    const near = (axis, value) => all.filter((e) => Math.abs(e[axis] - value) < NEARLY).sort((a, b) => Math.abs(a[axis] - value) - Math.abs(b[axis] - value))[0]?.[axis] ?? snap(value);
    return this.insert(kind, near("x", x), near("y", y));
  }

  /** A free position next to the selection, or in the middle of the view. */
  insertFree(kind) {
    const [first] = this.designer.selection.names;
    const near = this.view.elements.get(first);
    const box = this.view.svg.getBoundingClientRect();
    let [x, y] = near ? [near.x + 120, near.y] : this.view.at(box.left + box.width / 2, box.top + box.height / 2);
    while (this.taken(x, y, APART)) y += 90;
    return this.insert(kind, x, y);
  }

  taken(x, y, apart) {
    return [...this.view.elements.values()].some((e) => Math.hypot(e.x - x, e.y - y) < apart);
  }

  insert(kind, x, y) {
    const { model } = this.designer;
    const name = kind === "transition" ? model.addTransition(Math.round(x), Math.round(y)) : model.addPlace(kind, Math.round(x), Math.round(y));
    this.use("select");
    this.designer.choose(new Set([name]));
    this.view.elements.get(name)?.node.focus({ preventScroll: true });
    return name;
  }

  /** Make a transition for an end of an action place that has no outgoing arc yet. */
  addExit(place, end) {
    const { model } = this.designer;
    const at = this.view.elements.get(place);
    let y = snap(end === "error" ? at.y + 110 : at.y);
    while (this.taken(at.x + 110, y, 50)) y += 70;
    this.designer.choose(new Set([model.addExit(place, end, snap(at.x + 110), y)]));
  }
}
