// What is chosen in the drawing: elements by name, or one arc.

import { attribute } from "../dom.js";

export class Selection {
  constructor(designer) {
    Object.assign(this, { designer, names: new Set(), arc: null });
  }

  get view() {
    return this.designer.view;
  }

  /** The chosen elements as they are drawn. */
  get elements() {
    return [...this.names].map((n) => this.view.elements.get(n)).filter(Boolean);
  }

  choose(names, arc = null) {
    Object.assign(this, { names, arc });
    this.paint();
  }

  /** As after a click on an element; with Shift it joins or leaves the others. */
  pick(name, event) {
    if (!event?.shiftKey) return new Set([name]);
    const names = new Set(this.names);
    if (!names.delete(name)) names.add(name);
    return names;
  }

  /** Deselect elements that are no longer drawn. */
  prune(picture) {
    const drawn = new Set([...picture.places, ...picture.transitions].map((e) => e.name));
    this.names = new Set([...this.names].filter((n) => drawn.has(n)));
    if (this.arc) this.arc = picture.arcs.find((a) => a.id === this.arc.id) ?? null;
  }

  paint() {
    this.view.only("chosen", this.names);
    const [first] = this.names;
    this.view.focusable(first ?? null);
    for (const arc of this.view.arcs.values()) {
      const on = this.arc?.id === arc.id;
      if (Boolean(arc.chosen) !== on) {
        arc.chosen = on;
        arc.node.classList.toggle("chosen", on);
        attribute(arc.node, "aria-pressed", on ? "true" : null);
      }
    }
  }
}
