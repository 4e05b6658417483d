// Automatic layout, on demand only, by the vendored dagre.

import { Graph, layout } from "../vendor/dagre/dagre.esm.js";
import { BAR_H, GRID, PLACE_R } from "./geometry.js";

const snap = (value) => Math.round(value / GRID) * GRID;

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
  const all = [...net.places, ...net.transitions];
  if (all.every((e) => Number.isFinite(e.x) && Number.isFinite(e.y))) return net;
  const positions = automatic(net);
  const set = (e) => ({ ...e, x: positions[e.name][0], y: positions[e.name][1] });
  const some = all.some((e) => Number.isFinite(e.x));
  const low = some ? Math.max(...all.filter((e) => Number.isFinite(e.y)).map((e) => e.y)) + 120 : 0;
  const shift = (e) => (Number.isFinite(e.x) && Number.isFinite(e.y) ? e : { ...set(e), y: positions[e.name][1] + low });
  return { ...net, places: net.places.map(some ? shift : set), transitions: net.transitions.map(some ? shift : set) };
}
