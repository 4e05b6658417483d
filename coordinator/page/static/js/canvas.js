// A net view with its controls, the same on every tab: zoom, search, error branches, minimap, the path of opened macros.

import { attribute, fill, h, keep, text, words } from "./dom.js";
import { icon } from "./icons.js";
import { Minimap } from "./minimap.js";
import { NetView } from "./net_view.js";

const HITS = 9;

export const tool = (name, label, onclick, properties = {}) =>
  h("button", { type: "button", class: "tool", "aria-label": label, title: label, onclick, ...properties }, icon(name));

export class Canvas {
  constructor(label, events = {}) {
    this.drawing = h("div", { class: "drawing" });
    this.path = h("nav", { class: "path", "aria-label": "Opened macro places" });
    this.errors = h("button", { type: "button", class: "tool wide", "aria-pressed": "false", onclick: () => this.fold(!this.view.folded) }, icon("fold"), h("span", {}, "Error branches"));
    this.query = h("input", { type: "search", placeholder: "Find", "aria-label": "Find a place or transition", oninput: () => this.find(), onkeydown: (e) => this.searchKey(e) });
    this.hits = h("ul", { class: "hits", role: "listbox", "aria-label": "Found" });
    this.bar = h("div", { class: "canvas-bar" },
      h("div", { class: "group" }, tool("minus", "Zoom out", () => this.view.zoomBy(1 / 1.25)), tool("plus", "Zoom in", () => this.view.zoomBy(1.25)), tool("fit", "Show the whole net", () => this.view.fit())),
      h("div", { class: "group" }, this.errors),
      h("label", { class: "find" }, icon("search"), this.query, this.hits));
    this.corner = h("div", { class: "corner", hidden: true });
    this.root = h("section", { class: "canvas", "aria-label": label }, this.drawing, this.bar, this.path, this.corner);
    this.view = new NetView(this.drawing, label, { ...events, foldClicked: () => this.fold(false), moved: () => this.map?.follow() });
    this.map = new Minimap(this.corner);
  }

  show(net) {
    this.view.show(net);
    this.errors.hidden = ![...this.view.elements.values()].some((e) => e.error);
    this.map.draw(this.view);
  }

  /** Show where tokens are in error branches; those that nothing on this sheet shows are counted on the button that unfolds. */
  alarm(found) {
    this.view.alarm(found);
    attribute(this.errors, "data-alarm", found.hidden || null);
    text(this.errors.lastChild, found.hidden ? `Error branches: ${found.hidden}` : "Error branches");
    attribute(this.errors, "title", found.hidden ? `${found.hidden === 1 ? "1 token is" : `${found.hidden} tokens are`} in error branches that are not shown` : null);
    if (found.hidden) this.errors.hidden = false;
  }

  fold(folded) {
    this.view.fold(folded);
    this.errors.setAttribute("aria-pressed", String(!folded));
    this.view.fit(this.view.least);
    this.map.draw(this.view);
    this.folded?.(folded);
  }

  /** Show the path: `names` from the task to the innermost opened macro; `go(index)` returns to one of them. */
  trail(names, go) {
    this.path.hidden = names.length < 2;
    fill(this.path, names.map((name, i) => h("button", { type: "button", disabled: i === names.length - 1, onclick: () => go(i) }, words(name))));
  }

  find() {
    const typed = this.query.value.trim().toLowerCase();
    const matches = (name, label) => Boolean(typed) && (name.toLowerCase().includes(typed.replaceAll(" ", "_")) || label.toLowerCase().includes(typed));
    const here = [...this.view.elements.values()].filter((e) => matches(e.name, e.label ?? ""));
    this.view.only("hit", new Set(here.map((e) => e.name)));
    this.found = [...here.map((e) => ({ name: e.name, kind: e.shape === "place" ? e.kind : "transition", go: () => this.goTo(e.name) })), ...(this.view.events.elsewhere?.(matches) ?? [])];
    this.turn = -1;
    fill(this.hits, this.found.slice(0, HITS).map((e) =>
      h("li", { role: "option", onpointerdown: (event) => { event.preventDefault(); e.go(); } }, words(e.name), h("span", {}, words(e.kind)))),
      this.found.length > HITS ? h("li", { class: "more" }, `${this.found.length - HITS} more: Enter goes through all`) : null);
  }

  searchKey(event) {
    if (event.key === "Enter" && this.found?.length) {
      this.turn = (this.turn + 1) % this.found.length;
      this.found[this.turn].go();
      fill(this.hits); // the list would cover what was found, which is now in the middle
    } else if (event.key === "Escape") {
      this.query.value = "";
      this.find();
      this.query.blur();
    }
    keep(event);
  }

  /** Until the user moves or zooms: keep what is active in sight. */
  follow() {
    const { active: [first], fitted, least, size, view } = this.view;
    if (view !== fitted || !least || !size || !first) return;
    const inSight = ["x", "y"].every((axis, i) => first[axis] * view.zoom + view[axis] > 0 && first[axis] * view.zoom + view[axis] < size[i]);
    if (!inSight) this.view.fit(least);
  }

  goTo(name) {
    const element = this.view.elements.get(name);
    if (!element) return false;
    if (this.view.isFolded(element)) this.fold(false);
    this.view.centre(name);
    this.view.flash(element, false);
    this.view.events.chosen?.(element, {});
    return true;
  }
}

/** A titled part of a side panel; `count` is shown next to the title. */
export function panel(title, content, properties = {}) {
  const count = h("span", { class: "count" });
  const head = h("h2", {}, title, count);
  const root = h("section", { class: "panel", "aria-label": title, ...properties }, head, content);
  return { root, content, count: (value) => text(count, value ?? "") };
}
