// Macro places that group elements: which part of a net is inside which, adding elements and removing them.

import { arcsOf } from "./arcs.js";

const SNAP = 10;

/** An entry of a table, not what every object inherits: an element may be called `constructor`. */
export const own = (table, name) => (table && Object.hasOwn(table, name) ? table[name] : undefined);

const elementOf = (net, name) => own(net.places, name) ?? own(net.transitions, name);

/** Whether a place only groups what names it: a macro place without a subnet of its own. */
export const groups = (place) => place?.kind === "macro" && !place.subnet;

/** The macro places around an element, innermost first. */
export function around(net, name) {
  const found = [];
  for (let macro = elementOf(net, name)?.macro; macro && !found.includes(macro); macro = own(net.places, macro)?.macro) found.push(macro);
  return found;
}

/** Names of all elements inside a macro place, at any depth. */
export const within = (net, macro) => [...Object.keys(net.places ?? {}), ...Object.keys(net.transitions ?? {})].filter((name) => around(net, name).includes(macro));

/** What each place is drawn as where `inside` is opened ("" for the whole): itself or the macro place around it. */
export function drawnAs(net, inside) {
  const shown = new Map();
  for (const name of Object.keys(net.places ?? {})) {
    const chain = [name, ...around(net, name)];
    if (!inside) shown.set(name, chain.at(-1));
    else if (chain.indexOf(inside) > 0) shown.set(name, chain[chain.indexOf(inside) - 1]);
  }
  return shown;
}

/** What would go into a macro place of the chosen elements: {members, left}; transitions with places elsewhere are left. */
export function members(net, names, inside) {
  const places = new Set([...names].filter((n) => own(net.places, n)));
  const inner = new Set([...places, ...[...places].flatMap((n) => within(net, n))]);
  const here = Object.entries(net.transitions ?? {}).filter(([, t]) => (t.macro ?? "") === inside);
  const fits = (t) => arcsOf(t).every((arc) => inner.has(arc.place));
  const joined = here.filter(([name, t]) => fits(t) && (names.has(name) || arcsOf(t).length)).map(([name]) => name);
  return { members: [...places, ...joined], left: [...names].filter((n) => own(net.transitions, n) && !joined.includes(n)) };
}

const middle = (net, names, axis) => {
  const all = names.map((n) => elementOf(net, n)?.[axis]).filter(Number.isFinite);
  return all.length ? Math.round(all.reduce((sum, v) => sum + v, 0) / all.length / SNAP) * SNAP : undefined;
};

/** Put elements into a new macro place at their centre. */
export function group(net, names, macro, inside) {
  const at = Object.fromEntries(["x", "y"].map((axis) => [axis, middle(net, names, axis)]).filter(([, value]) => value !== undefined));
  for (const name of names) elementOf(net, name).macro = macro;
  net.places[macro] = { kind: "macro", ...(inside ? { macro: inside } : {}), ...at };
}

/** Dissolve a macro place: its elements are placed around its position. */
export function ungroup(net, macro) {
  const place = net.places[macro];
  const names = [...Object.keys(net.places), ...Object.keys(net.transitions)].filter((n) => elementOf(net, n).macro === macro);
  const shift = Object.fromEntries(["x", "y"].map((axis) => [axis, (place[axis] ?? 0) - (middle(net, names, axis) ?? place[axis] ?? 0)]));
  for (const name of names) {
    const element = elementOf(net, name);
    if (place.macro) element.macro = place.macro;
    else delete element.macro;
    for (const axis of ["x", "y"]) if (Number.isFinite(element[axis])) element[axis] += shift[axis];
  }
  delete net.places[macro];
  return names;
}
