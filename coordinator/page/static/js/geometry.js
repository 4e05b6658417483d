// Shapes and arcs of a net in drawing units: borders, curves that go around other elements, points along them.

export const PLACE_R = 22;
export const BAR_W = 14;
export const BAR_H = 44;
const GRID = 10;
export const snap = (value) => Math.round(value / GRID) * GRID;

const CLEAR = 9; // units between an arc and an element that it passes
const BENDS = [0, 36, -36, 72, -72, 120, -120, 180, -180]; // the straight line first
const TWIN_BENDS = [14, 40, 76, 120, -40]; // to one side: the arc back is bent to the other
const REACH = 230; // the widest bend, and half of an element that it might touch
const COST = { bend: 0.12, over: 8 }; // per unit; to touch an element at all is worse than most bends

/** The point where the ray from an element's centre to (x, y) leaves its shape; `gap` units further out. */
export function border(element, x, y, gap = 0) {
  const dx = x - element.x;
  const dy = y - element.y;
  const length = Math.hypot(dx, dy) || 1;
  if (element.shape === "place") {
    const r = PLACE_R + gap;
    return [element.x + (dx / length) * r, element.y + (dy / length) * r];
  }
  const halfW = BAR_W / 2 + gap;
  const halfH = BAR_H / 2 + gap;
  const scale = Math.min(halfW / Math.max(Math.abs(dx), 1e-9), halfH / Math.max(Math.abs(dy), 1e-9));
  return [element.x + dx * scale, element.y + dy * scale];
}

/** A quadratic curve from one element to another, bent sideways by `bend` units at its middle. */
export function curve(from, to, bend) {
  const mx = (from.x + to.x) / 2;
  const my = (from.y + to.y) / 2;
  const dx = to.x - from.x;
  const dy = to.y - from.y;
  const length = Math.hypot(dx, dy) || 1;
  const cx = mx - (dy / length) * bend * 2;
  const cy = my + (dx / length) * bend * 2;
  const [ax, ay] = border(from, cx, cy, 1);
  const [bx, by] = border(to, cx, cy, 3);
  return bend ? [ax, ay, cx, cy, bx, by] : [ax, ay, (ax + bx) / 2, (ay + by) / 2, bx, by];
}

/** The point at fraction f of a curve. */
export function at(c, f) {
  const g = 1 - f;
  return [g * g * c[0] + 2 * g * f * c[2] + f * f * c[4], g * g * c[1] + 2 * g * f * c[3] + f * f * c[5]];
}

export const path = (c) =>
  `M${c[0].toFixed(1)} ${c[1].toFixed(1)}Q${c[2].toFixed(1)} ${c[3].toFixed(1)} ${c[4].toFixed(1)} ${c[5].toFixed(1)}`;

/** How far a curve comes too near to an element, in units; 0 when it passes clear of it. */
function hits(c, element) {
  let worst = 0;
  const steps = Math.max(10, Math.min(60, Math.round(Math.hypot(c[4] - c[0], c[5] - c[1]) / 16)));
  for (let i = 1; i < steps; i++) {
    const [x, y] = at(c, i / steps);
    const reach = element.shape === "place" ? PLACE_R : BAR_H / 2;
    const wide = element.shape === "place" ? PLACE_R : BAR_W / 2;
    const over = Math.min(wide + CLEAR - Math.abs(x - element.x), reach + CLEAR - Math.abs(y - element.y));
    if (over > 0) worst = Math.max(worst, over);
  }
  return worst;
}

/** The smallest bend that passes no other element; `twin` arcs (there and back) keep to their own side. */
export function route(from, to, elements, twin) {
  const left = Math.min(from.x, to.x) - REACH;
  const right = Math.max(from.x, to.x) + REACH;
  const top = Math.min(from.y, to.y) - REACH;
  const bottom = Math.max(from.y, to.y) + REACH;
  const near = elements.filter(
    (e) => e !== from && e !== to && e.x > left && e.x < right && e.y > top && e.y < bottom,
  );
  let best = null;
  let bestCost = Infinity;
  for (const bend of twin ? TWIN_BENDS : BENDS) {
    const c = curve(from, to, bend);
    const least = Math.abs(bend) * COST.bend;
    let cost = least;
    for (const element of near) {
      cost += hits(c, element) * COST.over;
      if (cost >= bestCost) break;
    }
    if (cost < bestCost) [best, bestCost] = [c, cost];
    if (cost === least) break; // it touches nothing, and those that follow are bent more, or to the wrong side
  }
  return best;
}

/** The rectangle around elements with their labels, or null. */
export function bounds(elements) {
  let box = null;
  for (const e of elements) {
    const half = e.shape === "place" ? 60 : 64;
    const [x0, y0, x1, y1] = [e.x - half, e.y - 48, e.x + half, e.y + 60];
    if (!box) box = [x0, y0, x1, y1];
    else box = [Math.min(box[0], x0), Math.min(box[1], y0), Math.max(box[2], x1), Math.max(box[3], y1)];
  }
  return box;
}

/** Where the tokens of a place are drawn: up to five dots, as on a die. */
export function pips(count) {
  const d = 8;
  return [
    [],
    [[0, 0]],
    [[-d * 0.8, 0], [d * 0.8, 0]],
    [[-d, d * 0.7], [d, d * 0.7], [0, -d * 0.8]],
    [[-d * 0.85, -d * 0.85], [d * 0.85, -d * 0.85], [-d * 0.85, d * 0.85], [d * 0.85, d * 0.85]],
  ][count] ?? null;
}

/** Positions of label and caption for a side: [x, y of label, y of caption, text-anchor]. */
export function labelAt(element, side) {
  const isPlace = element.shape === "place";
  const half = isPlace ? PLACE_R : BAR_H / 2;
  if (side === "right" || side === "left") {
    const out = (isPlace ? PLACE_R : BAR_W / 2) + 8;
    return side === "right" ? [out, 0, 14, "start"] : [-out, 0, 14, "end"];
  }
  if (side === "above") return [0, isPlace && element.sub ? -half - 24 : -half - 10, isPlace ? -half - 10 : -half - 24, "middle"];
  return [0, half + (isPlace ? 18 : 17), isPlace ? half + 32 : -half - 9, "middle"];
}

/** Least and most zoom of a view. */
export const ZOOM = [0.12, 3];
/** Zoom at which names can still be read. */
export const READABLE = 0.6;
const COMFORTABLE = 0.8;
const TOP = 46; // the bar lies over the drawing
const EDGE = 12;

/** The view [x, y, zoom] of a drawing in a window of w by h: all of it, or where that would be smaller than `least`, the part around `active`. */
export function fitting(box, w, h, least, active) {
  const whole = Math.min(1.5, (w - 2 * EDGE) / (box[2] - box[0]), (h - TOP - EDGE) / (box[3] - box[1]));
  const zoom = whole < least ? COMFORTABLE : Math.max(ZOOM[0], whole);
  // in the middle, but with no empty margin where the drawing continues at the other side
  const from = (i, room, at) => {
    const [first, last] = [EDGE - box[i] * zoom, room - EDGE - box[i + 2] * zoom];
    return first < last || at === undefined ? (first + last) / 2 : Math.min(first, Math.max(last, room / 2 - at * zoom));
  };
  return [from(0, w, active?.x), TOP + from(1, h - TOP, active?.y), zoom];
}
