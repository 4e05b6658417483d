// The mouse in the designer: place, connect, drag with snapping, choose by a band.

import { attribute, s } from "../dom.js";
import { border, snap } from "../geometry.js";
import { isMovable } from "./arrange.js";

const NEAR = 7;
const MOVED = 4;

export class Pointer {
  constructor(designer) {
    this.designer = designer;
    this.space = false;
    addEventListener("keydown", (e) => e.code === "Space" && (this.space = true));
    addEventListener("keyup", (e) => e.code === "Space" && (this.space = false));
  }

  /** End the current gesture without any effect: the drawing was changed under the pointer. */
  stop() {
    this.cancel?.();
  }

  get view() {
    return this.designer.view;
  }

  /** True when the press was taken here; false leaves it to the view (panning). */
  down(event) {
    const { designer, view } = this;
    if (event.button === 1 || this.space) return false;
    const element = view.elementAt(event.target);
    view.svg.focus({ preventScroll: true });
    const { tools } = designer;
    if (tools.draws) return this.arcDown(event, element);
    if (tools.tool !== "select") {
      tools.insertNear(tools.tool, ...view.at(event.clientX, event.clientY));
      return true;
    }
    const arc = event.target.closest?.("[data-arc]");
    if (element) this.dragElements(event, element);
    else if (arc) designer.choose(new Set(), designer.picture.arcs.find((a) => a.id === arc.dataset.arc));
    else this.band(event);
    return true;
  }

  follow(event, move, end) {
    const { view } = this;
    const { svg } = view;
    svg.setPointerCapture(event.pointerId);
    const over = new AbortController();
    this.cancel = () => {
      over.abort();
      this.cancel = null;
      view.layers.over.replaceChildren();
    };
    const up = (e) => {
      this.cancel?.();
      end(e);
    };
    svg.addEventListener("pointermove", move, { signal: over.signal });
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, up, { signal: over.signal });
  }

  // ---- arcs ---------------------------------------------------------------------------------------------------------

  /**
   * A drag draws from where it began to where it ended, whatever is selected. A press without a drag chooses: where the arc
   * begins, or where the one that has begun ends. So the meaning of a press is known only at its end.
   */
  arcDown(event, element) {
    const { designer, view } = this;
    const { tools } = designer;
    const begun = tools.arcFrom;
    const [x0, y0] = [event.clientX, event.clientY];
    if (!element && !begun) return true;
    if (element && !begun) tools.from(element.name, `From ${element.name}: choose where the arc goes.`);
    const line = s("path", { class: "draft" });
    view.layers.over.append(line);
    let far = false;
    const move = (e) => {
      const [x, y] = view.at(e.clientX, e.clientY);
      far ||= element ? Math.hypot(x - element.x, y - element.y) > 26 : Math.hypot(e.clientX - x0, e.clientY - y0) > MOVED;
      const [ax, ay] = element ? border(element, x, y, 2) : [x, y];
      attribute(line, "d", far && element ? `M${ax} ${ay}L${x} ${y}` : null);
    };
    this.follow(event, move, (e) => {
      line.remove();
      if (e.type === "pointercancel") return;
      const under = view.elementAt(document.elementFromPoint(e.clientX, e.clientY) ?? view.svg);
      const there = under?.name ?? null;
      if (element && (there ? there !== element.name : far)) this.arcTo(element.name, there, e);
      else if (element ? begun && begun !== element.name : !far) this.arcTo(begun, element?.name ?? null, e);
      else if (element) tools.from(element.name, `From ${element.name}: choose where the arc goes.`);
    });
    return true;
  }

  /** End an arc at an element, or on free ground at a new element of the other kind. */
  async arcTo(from, name, event) {
    const { designer, view } = this;
    const kept = designer.tools.tool;
    let to = name;
    if (!to && designer.model.has(from)) {
      const [x, y] = view.at(event.clientX, event.clientY);
      const isPlace = Boolean(designer.model.place(from));
      to = isPlace ? designer.model.addTransition(snap(x), snap(y)) : designer.model.addPlace("action", snap(x), snap(y));
    }
    await designer.connect(from, to);
    designer.tools.use(kept);
    designer.choose(new Set([to ?? from]));
  }

  // ---- elements -----------------------------------------------------------------------------------------------------

  dragElements(event, element) {
    const { designer, view } = this;
    if (event.shiftKey) return designer.pick(element.name, event);
    if (!designer.selection.names.has(element.name)) designer.choose(new Set([element.name]));
    view.focusable(element.name);
    const [x0, y0] = view.at(event.clientX, event.clientY);
    const moved = new Map([...designer.selection.names].map((n) => view.elements.get(n)).filter((e) => e && isMovable(e)).map((e) => [e.name, { x: e.x, y: e.y }]));
    if (!moved.has(element.name)) return designer.choose(new Set([element.name]));
    const others = [...view.elements.values()].filter((e) => !moved.has(e.name) && !view.isFolded(e));
    let going = false;
    let positions = null;
    this.follow(event, (e) => {
      const [x, y] = view.at(e.clientX, e.clientY);
      if (!going && Math.hypot(x - x0, y - y0) * view.view.zoom < MOVED) return;
      going = true;
      positions = this.dragged(moved, element.name, x - x0, y - y0, others, e.altKey);
      for (const [name, [nx, ny]] of Object.entries(positions)) {
        const shown = view.elements.get(name);
        Object.assign(shown, { x: nx, y: ny });
        view.put(shown);
      }
      view.reroute(new Set(moved.keys()));
    }, () => {
      designer.guides([]);
      if (positions) {
        // the view has moved already: let the document follow, so that undo has one step
        designer.model.move(positions);
        view.reroute(new Set(), true);
      } else if (!event.shiftKey) designer.choose(new Set([element.name]));
    });
    return null;
  }

  dragged(moved, lead, dx, dy, others, free) {
    const { designer, view } = this;
    const start = moved.get(lead);
    let [x, y] = free ? [start.x + dx, start.y + dy] : [snap(start.x + dx), snap(start.y + dy)];
    const lines = [];
    const inX = others.find((o) => Math.abs(o.x - (start.x + dx)) < NEAR / view.view.zoom);
    const inY = others.find((o) => Math.abs(o.y - (start.y + dy)) < NEAR / view.view.zoom);
    if (inX && !free) lines.push([(x = inX.x), Math.min(y, inX.y) - 40, inX.x, Math.max(y, inX.y) + 40]);
    if (inY && !free) lines.push([Math.min(x, inY.x) - 40, (y = inY.y), Math.max(x, inY.x) + 40, inY.y]);
    designer.guides(lines);
    const [mx, my] = [x - start.x, y - start.y];
    return Object.fromEntries([...moved].map(([name, at]) => [name, [Math.round(at.x + mx), Math.round(at.y + my)]]));
  }

  band(event) {
    const { designer, view } = this;
    const [x0, y0] = view.at(event.clientX, event.clientY);
    const kept = event.shiftKey ? designer.selection.names : new Set();
    const box = s("rect", { class: "band", visibility: "hidden" });
    view.layers.over.append(box);
    designer.choose(new Set(kept));
    this.follow(event, (e) => {
      const [x, y] = view.at(e.clientX, e.clientY);
      const [left, top, right, bottom] = [Math.min(x, x0), Math.min(y, y0), Math.max(x, x0), Math.max(y, y0)];
      for (const [key, value] of Object.entries({ x: left, y: top, width: right - left, height: bottom - top, visibility: "visible" })) box.setAttribute(key, value);
      const inside = [...view.elements.values()].filter((el) => !view.isFolded(el) && el.x >= left && el.x <= right && el.y >= top && el.y <= bottom);
      designer.selected.choose(new Set([...kept, ...inside.map((el) => el.name)]));
    }, () => {
      box.remove();
      designer.choose(designer.selection.names);
    });
  }
}
