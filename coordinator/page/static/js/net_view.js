// Draws one net as SVG and alters only what changed. Shared by the live view, the designer and the history.

import { attribute, s, text, words } from "./dom.js";
import { at, BAR_H, BAR_W, bounds, fitting, labelAt, path, pips, PLACE_R, route, ZOOM } from "./geometry.js";
import { Flights } from "./flights.js";
import { iconPath } from "./icons.js";
import { Ground } from "./labels.js";

const KIND_WORD = { action: "Action place", resource: "Resource place", control: "Control place", macro: "Macro place", plain: "Plain place" };
const LABEL_MOST = 24;
const FLASH_MS = 550;

const tokens = (n) => (n === 1 ? "1 token" : `${n} tokens`);
const short = (label) => (label.length > LABEL_MOST ? `${label.slice(0, LABEL_MOST - 1)}…` : label);

let views = 0;

export class NetView {
  /** `host` is filled by the drawing. `events` may hold chosen(name), opened(name), background(event), moved(view). */
  constructor(host, label, events = {}) {
    this.events = events;
    this.id = `net${++views}`;
    this.elements = new Map();
    this.arcs = new Map();
    this.folded = true;
    this.view = { x: 0, y: 0, zoom: 1 };
    this.layers = Object.fromEntries(["arcs", "nodes", "over", "live", "flights"].map((n) => [n, s("g", { class: n })]));
    const { arcs, nodes, over, live, flights } = this.layers;
    this.worlds = [[arcs, nodes, over], [live], [flights]].map((layers) => s("g", { class: "world" }, layers));
    this.svg = s("svg", { class: "net", role: "application", "aria-label": label, tabindex: "0" }, this.defs(), this.worlds[0]);
    // what changes many times a second is in separate drawings, so that the browser need not lay out 300 elements each time
    [this.moving, this.flying] = this.worlds.slice(1).map((world) => s("svg", { class: "net moving", "aria-hidden": "true" }, world));
    this.flights = new Flights(flights, (arc) => this.landed(arc));
    host.append(this.svg, this.moving, this.flying);
    this.host = host;
    this.pointers();
    new ResizeObserver(() => this.resized()).observe(host);
  }

  defs() {
    const head = (name) =>
      s("marker", { id: `${this.id}-${name}`, class: `head ${name}`, viewBox: "0 0 10 10", refX: 8.5, refY: 5, markerWidth: 7, markerHeight: 7, orient: "auto-start-reverse" }, s("path", { d: "M0.5 1L9.5 5L0.5 9z" }));
    const ring = s("marker", { id: `${this.id}-ring`, class: "head ring", viewBox: "0 0 10 10", refX: 8.5, refY: 5, markerWidth: 8, markerHeight: 8 }, s("circle", { cx: 5, cy: 5, r: 3.5 }));
    return s("defs", {}, ["plain", "error", "preempt", "lit"].map(head), ring);
  }

  // ---- what is drawn ------------------------------------------------------------------------------------------------

  /** Show a net {places, transitions, arcs}; elements that stay keep their SVG nodes. */
  show(net) {
    const wanted = new Map();
    for (const place of net.places) wanted.set(place.name, { ...place, shape: "place" });
    for (const transition of net.transitions) wanted.set(transition.name, { ...transition, shape: "transition" });
    for (const [name, element] of this.elements) {
      if (!wanted.has(name) || wanted.get(name).shape !== element.shape || wanted.get(name).kind !== element.kind) {
        element.node.remove();
        element.live.remove();
        this.elements.delete(name);
      }
    }
    for (const [name, given] of wanted) this.place(name, given);
    this.showArcs(net.arcs);
    this.hideFolded();
  }

  place(name, given) {
    let element = this.elements.get(name);
    if (!element) {
      element = { tokens: 0, incoming: 0, ...given };
      element.node = given.shape === "place" ? this.placeNode(element) : this.transitionNode(element);
      element.live = s("g", { class: `live-part ${element.kind ?? "transition"}` }, element.parts.tint, element.parts.progress, element.parts.tokens);
      this.layers.nodes.append(element.node);
      this.layers.live.append(element.live);
      this.elements.set(name, element);
    }
    const moved = element.x !== given.x || element.y !== given.y || !element.drawn;
    Object.assign(element, given);
    if (moved) this.put(element);
    element.drawn = true;
    this.describe(element);
  }

  put(element) {
    const where = `translate(${element.x} ${element.y})`;
    element.node.setAttribute("transform", where);
    element.live.setAttribute("transform", where);
  }

  placeNode(element) {
    const parts = {
      body: s("circle", { class: "body", r: PLACE_R }),
      inner: element.kind === "control" ? s("circle", { class: "inner", r: PLACE_R - 4.5 }) : null,
      square: element.kind === "macro" ? s("rect", { class: "inner", x: -13, y: -13, width: 26, height: 26, rx: 4 }) : null,
      label: s("text", { class: "label", y: PLACE_R + 18 }),
      sub: s("text", { class: "sub", y: PLACE_R + 32 }),
      marks: s("g", { class: "marks" }),
    };
    const node = s("g", { class: `element place ${element.kind}` }, Object.values(parts));
    const runs = ["action", "macro"].includes(element.kind);
    element.parts = {
      ...parts,
      tint: runs ? s("circle", { class: "tint", r: PLACE_R - 1 }) : "",
      progress: runs ? s("circle", { class: "progress", r: PLACE_R + 4, pathLength: 100, transform: "rotate(-90)" }) : "",
      tokens: s("g", { class: "tokens" }),
    };
    return this.wire(element, node);
  }

  transitionNode(element) {
    const parts = {
      area: s("rect", { class: "area", x: -18, y: -BAR_H / 2 - 4, width: 36, height: BAR_H + 8, rx: 6 }),
      body: s("rect", { class: "body", x: -BAR_W / 2, y: -BAR_H / 2, width: BAR_W, height: BAR_H, rx: 3 }),
      label: s("text", { class: "label", y: BAR_H / 2 + 17 }),
      sub: s("text", { class: "sub", y: -BAR_H / 2 - 9 }),
      marks: s("g", { class: "marks" }),
    };
    element.parts = { ...parts, tint: "", progress: "", tokens: "" };
    return this.wire(element, s("g", { class: "element transition" }, Object.values(parts)));
  }

  wire(element, node) {
    const title = s("title");
    element.parts.title = title;
    node.append(title);
    node.setAttribute("tabindex", "-1");
    node.setAttribute("role", "button");
    node.dataset.name = element.name;
    return node;
  }

  describe(element) {
    const { parts } = element;
    element.said = short(words(element.label || element.name));
    element.subSaid = short(element.sub ?? "");
    text(parts.label, element.said);
    text(parts.sub, element.subSaid);
    text(parts.title, element.hint ?? element.name);
    this.name(element);
    attribute(element.node, "data-error", element.error ? "" : null);
    attribute(element.node, "data-outside", element.outside ? "" : null);
  }

  name(element) {
    const what = element.shape === "place" ? KIND_WORD[element.kind ?? "plain"] : "Transition";
    const held = element.shape === "place" ? `, ${tokens(element.tokens)}` : "";
    const more = element.state ? `, ${element.state}` : "";
    const alarm = element.alarm ? `, ${element.alarm} in an error branch` : "";
    attribute(element.node, "aria-label", `${what} ${element.label || element.name}${held}${more}${alarm}`);
  }

  showArcs(arcs) {
    const list = [...this.elements.values()].filter((e) => !this.isFolded(e));
    const twins = new Set(arcs.map((a) => `${a.direction}|${a.place}|${a.transition}`));
    const wanted = new Set();
    for (const arc of arcs) {
      const [place, transition] = [this.elements.get(arc.place), this.elements.get(arc.transition)];
      if (!place || !transition) continue;
      const id = arc.id ?? `${arc.direction}|${arc.place}|${arc.transition}|${arc.end ?? ""}`;
      wanted.add(id);
      const other = arc.direction === "out" ? "in" : "out";
      const twin = twins.has(`${other}|${arc.place}|${arc.transition}`) && arc.direction !== "inhibit";
      this.arc(id, arc, place, transition, list, twin);
    }
    for (const [id, arc] of this.arcs) {
      if (wanted.has(id)) continue;
      arc.node.remove();
      this.arcs.delete(id);
    }
    this.label(this.elements.keys());
  }

  /** Put labels where they cover nothing, as far as there is such a place. */
  label(names) {
    const shown = (name) => !this.isFolded(this.elements.get(name));
    const labelled = [...names].map((name) => this.elements.get(name)).filter((e) => e && !this.isFolded(e));
    for (const element of labelled) element.boxes = null;
    const ground = new Ground([...this.elements.values()].filter((e) => !this.isFolded(e)), [...this.arcs.values()].filter((a) => shown(a.place) && shown(a.transition)));
    for (const element of labelled) ground.settle(element);
    for (const element of labelled) {
      const side = ground.settle(element); // again: the first ones did not know where the last ones would be
      const [x, y, below, anchor] = labelAt(element, side);
      const { label, sub } = element.parts;
      attribute(label, "y", y);
      attribute(sub, "y", side === "below" || side === "above" || element.shape === "place" ? below : y - 14);
      for (const node of [label, sub]) attribute(node, "x", x);
      for (const node of [label, sub]) attribute(node, "text-anchor", anchor);
    }
  }

  arc(id, given, place, transition, list, twin) {
    let arc = this.arcs.get(id);
    if (!arc) {
      const parts = { reach: s("path", { class: "reach" }), line: s("path", { class: "line" }), weight: s("text", { class: "weight" }) };
      arc = { parts, node: s("g", { class: "arc", "data-arc": id, role: "button", tabindex: "-1" }, Object.values(parts)) };
      this.arcs.set(id, arc);
      this.layers.arcs.append(arc.node);
    }
    Object.assign(arc, { id, ...given, twin });
    const [from, to] = given.direction === "out" ? [transition, place] : [place, transition];
    const key = `${from.x} ${from.y} ${to.x} ${to.y}`;
    const crowd = this.crowd;
    if (arc.key !== key || arc.crowd !== crowd) {
      arc.curve = route(from, to, list, twin);
      arc.key = key;
      arc.crowd = crowd;
      const d = path(arc.curve);
      arc.parts.line.setAttribute("d", d);
      arc.parts.reach.setAttribute("d", d);
    }
    this.dress(arc, from, to);
  }

  dress(arc, from, to) {
    const style = arc.direction === "inhibit" ? "inhibit" : (arc.end ?? "plain");
    const head = arc.direction === "inhibit" ? "ring" : style === "error" || style === "preempt" ? style : "plain";
    attribute(arc.node, "class", `arc ${style}${arc.chosen ? " chosen" : ""}`);
    attribute(arc.parts.line, "marker-end", `url(#${this.id}-${head})`);
    text(arc.parts.weight, arc.weight > 1 ? arc.weight : "");
    const [x, y] = at(arc.curve, 0.5);
    attribute(arc.parts.weight, "x", x.toFixed(1));
    attribute(arc.parts.weight, "y", (y - 5).toFixed(1));
    const how = arc.direction === "inhibit" ? "Inhibitor arc" : `Arc${arc.end ? ` (${arc.end})` : ""}`;
    attribute(arc.node, "aria-label", `${how} from ${from.name} to ${to.name}${arc.weight > 1 ? `, weight ${arc.weight}` : ""}`);
  }

  /** Draw the arcs of moved elements again; with `all`, route all arcs again. */
  reroute(names, all = false) {
    if (all) this.crowd = (this.crowd ?? 0) + 1;
    const list = [...this.elements.values()].filter((e) => !this.isFolded(e));
    for (const arc of this.arcs.values()) {
      if (!all && !names.has(arc.place) && !names.has(arc.transition)) continue;
      this.arc(arc.id, arc, this.elements.get(arc.place), this.elements.get(arc.transition), list, arc.twin);
    }
    this.label(all ? this.elements.keys() : names);
  }

  // ---- folding of error branches ------------------------------------------------------------------------------------

  isFolded(element) {
    return this.folded && element.error;
  }

  fold(folded) {
    this.folded = folded;
    this.hideFolded();
    this.reroute(new Set(), true);
  }

  hideFolded() {
    const badges = new Map();
    for (const element of this.elements.values()) for (const part of [element.node, element.live]) attribute(part, "display", this.isFolded(element) ? "none" : null);
    for (const arc of this.arcs.values()) {
      const [place, transition] = [this.elements.get(arc.place), this.elements.get(arc.transition)];
      const hidden = this.isFolded(place) || this.isFolded(transition);
      attribute(arc.node, "display", hidden ? "none" : null);
      const begins = arc.end === "error" || ["action", "macro"].includes(place.kind);
      if (hidden && begins && arc.direction === "in" && !this.isFolded(place)) badges.set(place.name, place);
    }
    for (const element of this.elements.values()) this.mark(element.name, "fold", badges.has(element.name) ? "fold" : null);
  }

  /** Whether an element is drawn here and not folded away. */
  sees(name) {
    const element = this.elements.get(name);
    return Boolean(element) && !this.isFolded(element);
  }

  /** Say how many tokens are in error branches: at the badges of folded ones, and at macro places that are closed. */
  alarm({ folded, inside }) {
    for (const element of this.elements.values()) {
      const [away, within] = [folded.get(element.name) ?? 0, inside.get(element.name) ?? 0];
      const known = element.marksByKey;
      if (away && !known?.get("fold")) this.mark(element.name, "fold", "fold");
      const badge = element.marksByKey?.get("fold");
      if (badge) this.count(badge, away, `mark fold${away ? " alarm" : ""}`, away ? `${tokens(away)} in this error branch, folded: choose to show it` : MARK_HINT.fold);
      this.mark(element.name, "inside", within ? "error" : null, within ? `${tokens(within)} in an error branch inside` : "");
      const mark = element.marksByKey?.get("inside");
      if (mark) this.count(mark, within, "mark error alarm");
      const alarm = away + within;
      if ((element.alarm ?? 0) === alarm) continue;
      element.alarm = alarm;
      this.name(element);
    }
  }

  /** A number in the place of a mark's sign. */
  count(mark, number, style, hint = null) {
    attribute(mark, "class", style);
    mark.number ??= mark.appendChild(s("text", { class: "number", y: 4 }));
    text(mark.number, number || "");
    attribute(mark.querySelector("path"), "display", number ? "none" : null);
    if (hint) text(mark.querySelector("title"), hint);
  }

  /** Small signs at an element: a breakpoint, a fault, a folded branch. `sign` null takes it away. */
  mark(name, key, sign, hint = "") {
    const element = this.elements.get(name);
    if (!element) return;
    const known = (element.marksByKey ??= new Map());
    const old = known.get(key);
    if (old?.dataset.sign === `${sign} ${hint}`) return;
    old?.remove();
    known.delete(key);
    if (!sign) return;
    const [x, y] = MARK_AT[element.shape][key] ?? [0, 0];
    const glyph = MARK_GLYPH[sign] ?? iconPath(sign);
    const node = s("g", { class: `mark ${sign}`, transform: `translate(${x} ${y})` }, s("circle", { r: 8 }), glyph ? s("path", { d: glyph, transform: "translate(-6.5 -6.5) scale(0.54)" }) : null, s("title", {}, hint || MARK_HINT[sign] || sign));
    node.dataset.sign = `${sign} ${hint}`;
    known.set(key, node);
    element.parts.marks.append(node);
  }

  // ---- tokens -------------------------------------------------------------------------------------------------------

  /** Set the tokens of one place; those still in flight to it are drawn when they land. */
  tokens(name, count) {
    const element = this.elements.get(name);
    if (!element || element.shape !== "place") return;
    if (element.tokens !== count) {
      element.tokens = count;
      this.name(element);
    }
    this.drawTokens(element);
  }

  drawTokens(element) {
    const shown = Math.max(0, element.tokens - element.incoming);
    if (element.shown === shown) return;
    element.shown = shown;
    const places = pips(shown);
    element.parts.tokens.replaceChildren(
      ...(places ? places.map(([x, y]) => s("circle", { class: "token", cx: x, cy: y, r: 5 })) : [s("text", { class: "count", y: 6 }, String(shown))]),
    );
  }

  /** Let tokens fly along the arcs of a firing, and light its transition. */
  fire(transition, failed = false) {
    const element = this.elements.get(transition);
    if (!element) return;
    this.flash(element, failed);
    if (this.isFolded(element)) return;
    for (const arc of this.arcs.values()) {
      if (arc.transition !== transition || arc.direction === "inhibit" || this.isFolded(this.elements.get(arc.place))) continue;
      const incoming = arc.direction === "out";
      if (this.flights.start(arc, incoming, failed) && incoming) this.elements.get(arc.place).incoming += arc.weight ?? 1;
    }
  }

  landed(arc) {
    if (arc.direction !== "out") return;
    const place = this.elements.get(arc.place);
    if (!place) return;
    place.incoming = Math.max(0, place.incoming - (arc.weight ?? 1));
    this.drawTokens(place);
  }

  flash(element, failed) {
    element.flash ??= element.shape === "place" ? s("circle", { r: PLACE_R }) : s("rect", { x: -BAR_W / 2, y: -BAR_H / 2, width: BAR_W, height: BAR_H, rx: 3 });
    attribute(element.flash, "class", `flash ${element.shape} ${failed ? "failed" : ""}`);
    if (!element.flash.parentNode) element.live.prepend(element.flash);
    clearTimeout(element.flashTimer);
    element.flashTimer = setTimeout(() => element.flash.remove(), FLASH_MS);
  }

  /** How far the run in an action place is: {state, progress} or null for none. */
  run(name, run) {
    const element = this.elements.get(name);
    if (!element?.parts.progress) return;
    attribute(element.live, "data-run", run ? run.state || "running" : null);
    const part = run ? Math.round(Math.max(0.02, run.progress ?? 0) * 100) : 0;
    attribute(element.parts.progress, "stroke-dasharray", run ? `${part} 100` : null);
    if (element.state !== (run?.state ?? "")) {
      element.state = run?.state ?? "";
      this.name(element);
    }
  }

  /** Put a class on exactly the named elements. */
  only(className, names) {
    for (const element of this.elements.values()) {
      const on = names.has(element.name);
      if (element.node.classList.contains(className) !== on) element.node.classList.toggle(className, on);
    }
  }

  focusable(name) {
    for (const element of this.elements.values()) attribute(element.node, "tabindex", element.name === name ? "0" : "-1");
  }

  // ---- view ---------------------------------------------------------------------------------------------------------

  get box() {
    return bounds([...this.elements.values()].filter((e) => !this.isFolded(e)));
  }

  /** `box` enlarged by the labels and arcs outside it. It reads the browser's layout, so do not call it for every change. */
  get extent() {
    const { box } = this;
    const { x, y, width, height } = this.worlds[0].getBBox();
    return box && [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x + width), Math.max(box[3], y + height)];
  }

  resized() {
    const { clientWidth: w, clientHeight: h } = this.svg;
    if ((!this.size || this.view === this.fitted) && w && this.elements.size) this.fit(this.least); // the user has not moved or zoomed it
    this.size = [w, h];
    this.events.moved?.(this);
  }

  /** Show the whole net, or with `least`, where that would make it smaller, the part around an active place. */
  fit(least = 0) {
    const box = this.extent;
    const { clientWidth: w, clientHeight: h } = this.svg;
    this.least = least;
    if (!w || !h) this.fitted = this.view; // on a tab that is not shown: fitted when it is
    if (!box || !w || !h) return;
    this.look(...fitting(box, w, h, least, this.active[0]));
    this.fitted = this.view;
  }

  /** Places with tokens: those with a running action first, resources last. */
  get active() {
    const rank = (e) => (e.live.dataset.run ? 0 : e.kind === "resource" ? 2 : 1);
    return [...this.elements.values()].filter((e) => e.tokens && !this.isFolded(e)).sort((a, b) => rank(a) - rank(b));
  }

  look(x, y, zoom) {
    this.view = { x, y, zoom: Math.max(ZOOM[0], Math.min(ZOOM[1], zoom)) };
    for (const world of this.worlds) world.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)}) scale(${this.view.zoom.toFixed(4)})`);
    this.svg.classList.toggle("far", this.view.zoom < 0.45);
    this.events.moved?.(this);
  }

  zoomBy(factor, px, py) {
    const { clientWidth: w, clientHeight: h } = this.svg;
    const { x, y, zoom } = this.view;
    const next = Math.max(ZOOM[0], Math.min(ZOOM[1], zoom * factor));
    const [cx, cy] = [px ?? w / 2, py ?? h / 2];
    this.look(cx - ((cx - x) / zoom) * next, cy - ((cy - y) / zoom) * next, next);
  }

  centre(name) {
    const element = this.elements.get(name);
    if (!element) return false;
    const { clientWidth: w, clientHeight: h } = this.svg;
    const [x, y] = [element.x * this.view.zoom + this.view.x, element.y * this.view.zoom + this.view.y];
    if (this.view.zoom > 0.5 && x > 70 && x < w - 70 && y > 90 && y < h - 70) return true; // in good view already
    const zoom = Math.max(this.view.zoom, 0.9);
    this.look(w / 2 - element.x * zoom, h / 2 - element.y * zoom, zoom);
    return true;
  }

  /** Drawing units at a point of the window. */
  at(clientX, clientY) {
    const box = this.svg.getBoundingClientRect();
    return [(clientX - box.left - this.view.x) / this.view.zoom, (clientY - box.top - this.view.y) / this.view.zoom];
  }

  elementAt(target) {
    const node = target.closest?.("[data-name]");
    return node && this.svg.contains(node) ? this.elements.get(node.dataset.name) : null;
  }

  pointers() {
    this.svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      const box = this.svg.getBoundingClientRect();
      this.zoomBy(Math.exp(-event.deltaY * 0.0015), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
    this.svg.addEventListener("pointerdown", (event) => this.down(event));
    this.svg.addEventListener("dblclick", (event) => {
      // a press that was followed as a drag makes the whole drawing the target of its click
      const element = this.elementAt(document.elementFromPoint(event.clientX, event.clientY) ?? event.target);
      if (element) this.events.opened?.(element, event);
    });
    this.svg.addEventListener("keydown", (event) => {
      if (this.events.keyed || (event.key !== "Enter" && event.key !== " ")) return;
      const element = this.elementAt(event.target);
      if (element && !event.defaultPrevented) {
        event.preventDefault();
        this.events.chosen?.(element, event);
      }
    });
  }

  down(event) {
    if (event.button > 1) return;
    if (this.events.down?.(event)) return;
    const element = this.elementAt(event.target);
    if (element && event.button === 0) {
      const fold = event.target.closest(".mark.fold");
      if (fold) this.events.foldClicked?.(element);
      else this.events.chosen?.(element, event);
      return;
    }
    if (event.button === 0 && !element) this.events.background?.(event);
    this.pan(event);
  }

  pan(event) {
    const start = { ...this.view, px: event.clientX, py: event.clientY };
    this.svg.setPointerCapture(event.pointerId);
    this.svg.classList.add("panning");
    const move = (e) => this.look(start.x + e.clientX - start.px, start.y + e.clientY - start.py, start.zoom);
    const up = () => {
      this.svg.removeEventListener("pointermove", move);
      this.svg.classList.remove("panning");
    };
    this.svg.addEventListener("pointermove", move);
    this.svg.addEventListener("pointerup", up, { once: true });
    this.svg.addEventListener("pointercancel", up, { once: true });
  }
}

const MARK_AT = {
  place: { inside: [-26, 21], fold: [26, 21], fault: [25, -21], breakpoint: [-25, -21], reason: [25, -21] },
  transition: { fold: [14, 20], fault: [14, -24], breakpoint: [-14, -24], reason: [14, -24] },
};
const MARK_GLYPH = { fold: "M12 4.5v9M12 17.5v.6", breakpoint: "", failed: "M12 4.5v9M12 17.5v.6" };
const MARK_HINT = { fold: "Error branch, folded: choose to show it", breakpoint: "Breakpoint", error: "Fault", warning: "Warning" };
