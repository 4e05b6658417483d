// What of a task file's document is drawn: one sheet's places, transitions and arcs, with what they mean to a reader.

import { words } from "../dom.js";
import { caption, onlyErrors, underPlace } from "../sheet.js";
import { arcsOf, listed, readArc } from "./arcs.js";
import { around, drawnAs, groups, within } from "./macros.js";

/** What a file may leave out: an action place does the primitive task of its name, the action of its name does that, and an event that names who raises it is internal. */
export const taskOf = (name, place) => place.task ?? (place.kind === "action" ? name : "");
export const actionsOf = (name, primitive) => primitive?.alternatives ?? [name];
export const scopeOf = (event) => event?.scope ?? (event?.by === undefined ? "external" : "internal");

/** The drawing {places, transitions, arcs} of a net of the document, where the macro place `inside` is opened. */
export function drawn(data, written, inside) {
  const net = withErrorBranches(data, written);
  const shown = drawnAs(net, inside);
  const errors = errorElements(net);
  const names = new Set(shown.values());
  const here = (t) => (t.macro ?? "") === inside;
  const border = (name, t) => inside && !around(net, name).includes(inside) && arcsOf(t).some((a) => shown.has(a.place));
  const transitions = Object.entries(net.transitions ?? {}).filter(([name, t]) => here(t) || border(name, t))
    .map(([name, t]) => transitionOf(data, name, t, errors.has(name), !here(t)));
  const places = Object.entries(net.places ?? {}).filter(([name]) => names.has(name)).map(([name, p]) => placeOf(data, net, name, p, errors));
  return onlyErrors({ places, transitions: transitions.map((t) => ({ ...t, sub: caption(t) })), arcs: arcs(net, transitions, shown) });
}

/** The net with the error branches that its table `errors` makes: one for each place that can end in error and has none. */
function withErrorBranches(data, net) {
  const to = net.errors?.to;
  if (!to || !net.places?.[to]) return net;
  const handled = new Set(Object.values(net.transitions ?? {}).flatMap((t) => listed(t.in).map(readArc)).filter((a) => a?.end === "error").map((a) => a.place));
  const canFail = (p) => p.kind === "action" || (p.kind === "macro" && Boolean(data.subnets?.[p.subnet]?.error));
  const made = Object.entries(net.places).filter(([name, p]) => name !== to && canFail(p) && !handled.has(name))
    .map(([name, p]) => [`${name}.error`, { in: [`${name}:error`], out: [to], macro: p.macro, made: true }]);
  return { ...net, transitions: { ...net.transitions, ...Object.fromEntries(made) } };
}

/** Arcs of the drawn transitions; those that end in one macro place alike are one, with their weights summed. */
function arcs(net, transitions, shown) {
  const joined = new Map();
  for (const { name } of transitions) {
    for (const arc of arcsOf(net.transitions[name])) {
      if (!shown.has(arc.place)) continue;
      const as = shown.get(arc.place);
      const id = as === arc.place ? `${arc.direction}|${arc.text}|${name}` : `${arc.direction}|${as}:${arc.end ?? ""}|${name}`;
      const before = joined.get(id);
      const inner = as === arc.place ? [] : [...(before?.inner ?? []), arc.place];
      joined.set(id, { ...arc, id, transition: name, place: as, weight: arc.weight + (before?.weight ?? 0), inner });
    }
  }
  return [...joined.values()];
}

/** What the short forms of a place declare, as `Task.in_short` words it. */
function inShort(data, p) {
  const own = listed(p.holds);
  const inside = heldInside(data, p).filter((name) => !own.includes(name));
  const parts = [p.tries > 1 && `${p.tries} tries`, p.timeout !== undefined && `${p.timeout} s`, own.length && `holds ${own.join(", ")}`, inside.length && `holds ${inside.join(", ")} inside`, p.listen && "listens"];
  return parts.filter(Boolean).join(", ");
}

/** The resources around a macro place that places of its subnet hold; a subnet within itself is a mistake that `check` tells. */
function heldInside(data, macro, path = []) {
  const places = data.subnets?.[macro.subnet]?.places;
  if (macro.kind !== "macro" || !places || path.includes(macro.subnet)) return [];
  const held = Object.values(places).flatMap((p) => [...listed(p.holds), ...heldInside(data, p, [...path, macro.subnet])]);
  return [...new Set(held)].filter((name) => !places[name]).map((name) => macro.args?.[name] ?? name);
}

function placeOf(data, net, name, p, errors) {
  const inside = groups(p) ? within(net, name) : [];
  const isError = errors.has(name) || (inside.some((n) => errors.has(n)) && inside.every((n) => errors.has(n) || groups(net.places?.[n])));
  const hint = inside.length ? `${name}\nholds ${inside.join(", ")}` : name;
  const sub = underPlace({ name, kind: p.kind, subnet: p.subnet, primitive_task: p.task ?? name, in_short: inShort(data, p) });
  return { name, kind: p.kind ?? "plain", label: p.label ?? "", x: p.x, y: p.y, tokens: tokensIn(data, net, name), sub, error: isError, hint };
}

function transitionOf(data, name, t, error, outside) {
  const events = data.events ?? {};
  const when = { events: listed(t.event).map((e) => ({ name: e, scope: scopeOf(events[e]) })), when: t.when ?? "", after: t.after };
  // the automatic layout puts an element outside next to the opened macro place
  const where = outside ? { x: undefined, y: undefined, outside } : { x: t.x, y: t.y };
  const hint = t.made ? `${name}\nmade by the table errors` : name;
  return { name, label: t.label ?? "", error, made: Boolean(t.made), hint, ...where, ...when };
}

/** Tokens at the start in a place; a macro place has those of all within it. */
function tokensIn(data, net, name, path = []) {
  const place = net.places?.[name];
  if (place?.kind !== "macro") return place?.tokens ?? 0;
  const inner = place.subnet ? data.subnets?.[place.subnet] : net;
  if (!inner || path.includes(place.subnet)) return 0;
  const names = place.subnet ? Object.keys(inner.places ?? {}) : within(net, name).filter((n) => net.places[n]);
  const once = names.filter((n) => !groups(inner.places[n]));
  return once.reduce((sum, n) => sum + tokensIn(data, inner, n, place.subnet ? [...path, place.subnet] : path), 0);
}

/** Names of what only error branches reach. */
function errorElements(net) {
  const all = Object.entries(net.transitions ?? {}).flatMap(([transition, t]) => arcsOf(t).map((arc) => ({ ...arc, transition })));
  const transitions = new Set(Object.entries(net.transitions ?? {}).filter(([, t]) => t.error_branch).map(([name]) => name));
  for (const arc of all) if (arc.end === "error") transitions.add(arc.transition);
  const places = new Set();
  for (let grew = true; grew; ) {
    grew = false;
    for (const [name, place] of Object.entries(net.places ?? {})) {
      if (places.has(name) || place.tokens) continue;
      const feeders = all.filter((a) => a.direction === "out" && a.place === name);
      if (feeders.length && feeders.every((a) => transitions.has(a.transition))) grew = Boolean(places.add(name));
    }
    for (const arc of all) if (arc.direction === "in" && places.has(arc.place) && !transitions.has(arc.transition)) grew = Boolean(transitions.add(arc.transition));
  }
  return new Set([...places, ...transitions]);
}
