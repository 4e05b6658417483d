// Automatic layout, on demand only, by the vendored dagre.

import { Graph, layout } from "../vendor/dagre/dagre.esm.js";
import { BAR_H, PLACE_R, snap } from "./geometry.js";

/** Positions {name: [x, y]} for a net {places, transitions, arcs}, left to right; error branches come last in each rank. */
export function automatic(net) {
  const graph = new Graph();
  graph.setGraph({ rankdir: "LR", nodesep: 58, ranksep: 62, edgesep: 22, marginx: 60, marginy: 60 });
  graph.setDefaultEdgeLabel(() => ({}));
  for (const place of net.places) graph.setNode(place.name, { width: PLACE_R * 2 + 34, height: PLACE_R * 2 + 30 });
  for (const transition of net.transitions) graph.setNode(transition.name, { width: 58, height: BAR_H + 36 });
  for (const arc of net.arcs) {
    const [from, to] = arc.direction === "out" ? [arc.transition, arc.place] : [arc.place, arc.transition];
    if (graph.hasNode(from) && graph.hasNode(to)) graph.setEdge(from, to, { weight: arc.end === "error" ? 1 : 3 });
  }
  layout(graph);
  return Object.fromEntries(graph.nodes().map((name) => [name, [snap(graph.node(name).x), snap(graph.node(name).y)]]));
}

/** The net with a position for every element: its own where it has one, else beside the others by automatic layout. */
export function placed(net) {
  const around = net.transitions.filter((t) => t.outside);
  if (around.length) return beside(placed({ ...net, transitions: net.transitions.filter((t) => !t.outside) }), around);
  const all = [...net.places, ...net.transitions];
  if (all.every((e) => Number.isFinite(e.x) && Number.isFinite(e.y))) return net;
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
