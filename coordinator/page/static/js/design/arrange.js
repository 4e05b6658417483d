// Arranging: align, space evenly, automatic layout; and lines that show with which elements a dragged one is aligned.

import { fill, s } from "../dom.js";
import { READABLE, snap } from "../geometry.js";
import { automatic } from "../layout.js";

const mean = (values) => values.reduce((sum, v) => sum + v, 0) / values.length;
const span = (elements, axis) => Math.max(...elements.map((e) => e[axis])) - Math.min(...elements.map((e) => e[axis]));

/** Whether an element has a position of its own here: those around an opened macro place, and what `errors` makes, are put by themselves. */
export const isMovable = (e) => !e.outside && !e.made;

const movable = (designer) => designer.selected.elements.filter(isMovable);

const place = (elements, axis, at) => Object.fromEntries(elements.map((e, i) => [e.name, axis === "x" ? [at(i), e.y] : [e.x, at(i)]]));

export function align(designer, axis) {
  const chosen = movable(designer);
  if (chosen.length < 2) return;
  const middle = snap(mean(chosen.map((e) => e[axis])));
  designer.model.move(place(chosen, axis, () => middle));
}

/** Space the chosen elements evenly along the longer side. */
export function distribute(designer) {
  const chosen = movable(designer);
  if (chosen.length < 3) return;
  const axis = span(chosen, "x") >= span(chosen, "y") ? "x" : "y";
  chosen.sort((a, b) => a[axis] - b[axis]);
  const [first, last] = [chosen[0][axis], chosen.at(-1)[axis]];
  designer.model.move(place(chosen, axis, (i) => snap(first + ((last - first) * i) / (chosen.length - 1))));
}

/** Automatic layout of the sheet, or of the chosen elements around their present position. */
export function layOut(designer) {
  const { picture } = designer;
  const net = { ...picture, transitions: picture.transitions.filter(isMovable) };
  const names = new Set(movable(designer).map((e) => e.name));
  const some = names.size > 1;
  const chosen = (e) => !some || names.has(e.name);
  const part = { ...net, places: net.places.filter(chosen), transitions: net.transitions.filter(chosen) };
  const positions = automatic(part);
  designer.model.move(some ? about(positions, movable(designer)) : positions);
  designer.view.reroute(new Set(), true);
  if (!some) designer.view.fit(READABLE);
}

/** Positions moved as a whole so that their middle is where that of the elements is. */
function about(positions, elements) {
  const shift = [0, 1].map((i) => snap(mean(elements.map((e) => (i ? e.y : e.x))) - mean(Object.values(positions).map((p) => p[i]))));
  return Object.fromEntries(Object.entries(positions).map(([name, [x, y]]) => [name, [x + shift[0], y + shift[1]]]));
}

/** Move the chosen elements by (dx, dy). */
export function nudge(designer, dx, dy) {
  const chosen = movable(designer);
  if (!chosen.length) return false;
  designer.model.move(Object.fromEntries(chosen.map((e) => [e.name, [e.x + dx, e.y + dy]])), "nudge");
  designer.view.reroute(new Set(), true);
  return true;
}

/** Draw guide lines [[x0, y0, x1, y1], ...] over the net. */
export const guides = (view, lines) =>
  fill(view.layers.over, lines.map(([x0, y0, x1, y1]) => s("line", { class: "guide", x1: x0, y1: y0, x2: x1, y2: y1 })));
