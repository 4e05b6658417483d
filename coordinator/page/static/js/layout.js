// Automatic layout: by the button, and for elements without a position.

import { snap } from "./geometry.js";
import { filledIn, layered } from "./layers.js";

let last = { key: "", positions: {} }; // a net without positions is drawn again at each edit

/** The arcs as pairs of names [from, to], those of elements that are not drawn left out. */
function edgesOf(net) {
  const known = new Set([...net.places, ...net.transitions].map((e) => e.name));
  return net.arcs.filter((a) => known.has(a.place) && known.has(a.transition)).map((a) => (a.direction === "out" ? [a.transition, a.place] : [a.place, a.transition]));
}

/** Positions {name: [x, y]} for a net {places, transitions, arcs}, left to right along the flow of tokens. */
export function automatic(net) {
  const names = [...net.places, ...net.transitions].map((e) => e.name);
  const edges = edgesOf(net);
  const sources = net.places.filter((p) => p.tokens).map((p) => p.name);
  const aside = net.places.filter((p) => p.kind === "resource" && p.tokens).map((p) => p.name);
  const key = JSON.stringify([names, edges, sources, aside]);
  if (last.key !== key) last = { key, positions: layered(names, edges, sources, aside) };
  return Object.fromEntries(Object.entries(last.positions).map(([name, [x, y]]) => [name, [snap(x), snap(y)]]));
}

/** The net with a position for every element: its own if it has one. Where most have one, the others go next to their neighbours, else below, by automatic layout. */
export function placed(net) {
  const around = net.transitions.filter((t) => t.outside);
  if (around.length) return beside(placed({ ...net, transitions: net.transitions.filter((t) => !t.outside) }), around);
  const all = [...net.places, ...net.transitions];
  const given = all.filter((e) => Number.isFinite(e.x) && Number.isFinite(e.y));
  if (given.length === all.length) return net;
  if (2 * given.length >= all.length) {
    const at = filledIn(all.map((e) => e.name), Object.fromEntries(given.map((e) => [e.name, [e.x, e.y]])), edgesOf(net));
    const put = (e) => ({ ...e, x: Math.round(at[e.name][0]), y: Math.round(at[e.name][1]) });
    return { ...net, places: net.places.map(put), transitions: net.transitions.map(put) };
  }
  const positions = automatic(net);
  const set = (e) => ({ ...e, x: positions[e.name][0], y: positions[e.name][1] });
  const some = all.some((e) => Number.isFinite(e.x));
  const low = some ? Math.max(...all.filter((e) => Number.isFinite(e.y)).map((e) => e.y)) + 120 : 0;
  const shift = (e) => (Number.isFinite(e.x) && Number.isFinite(e.y) ? e : { ...set(e), y: positions[e.name][1] + low });
  return { ...net, places: net.places.map(some ? shift : set), transitions: net.transitions.map(some ? shift : set) };
}

const ASIDE = 130;
const APART = 80;

/** The net of an opened macro place with the transitions around it: those that feed it on its left, the others on its right. */
function beside(net, around) {
  const inner = new Map([...net.places, ...net.transitions].map((e) => [e.name, e]));
  const xs = [...inner.values()].map((e) => e.x);
  const side = (t) => (net.arcs.some((a) => a.transition === t.name && a.direction === "out") ? -1 : 1);
  const level = (t) => {
    const ys = net.arcs.filter((a) => a.transition === t.name && inner.has(a.place)).map((a) => inner.get(a.place).y);
    return ys.reduce((sum, y) => sum + y, 0) / Math.max(1, ys.length);
  };
  const put = [-1, 1].flatMap((way) => {
    const column = around.filter((t) => side(t) === way).map((t) => ({ ...t, x: snap(way < 0 ? Math.min(...xs) - ASIDE : Math.max(...xs) + ASIDE), y: snap(level(t)) })).sort((a, b) => a.y - b.y);
    column.forEach((t, i) => i && (t.y = Math.max(t.y, column[i - 1].y + APART)));
    return column;
  });
  return { ...net, transitions: [...net.transitions, ...put] };
}
