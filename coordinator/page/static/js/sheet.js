// Which part of a task is drawn: the whole with its macro places closed, or the inside of one macro place.

import { placed } from "./layout.js";
import { seconds, words } from "./dom.js";

/** The text above a transition: its events, condition and timer. */
export function caption(transition) {
  const parts = (transition.events ?? []).map((e) => `${e.scope === "internal" ? "int" : "ext"}: ${words(e.name)}`);
  if (transition.after !== null && transition.after !== undefined) parts.push(`after ${seconds(transition.after)}`);
  if (transition.when) parts.push(`[${transition.when}]`);
  return parts.join(" · ");
}

/** The text under a place: its subnet, or its primitive task if that has another name, and what its short forms declare. */
export const underPlace = (p) => [words(p.subnet ?? ""), p.kind === "action" && p.primitive_task !== p.name && words(p.primitive_task), p.in_short].filter(Boolean).join(", ");

const hintPlace = (p) => [p.name, p.in_short, p.primitive_task && `primitive task ${p.primitive_task}`, p.capacity && `capacity ${p.capacity}`].filter(Boolean).join("\n");
const hintTransition = (t) => [t.name, caption(t), t.priority ? `priority ${t.priority}` : ""].filter(Boolean).join("\n");

/** The net with those places marked as error branches, too, that nothing but error branches uses. */
export function onlyErrors(net) {
  const error = new Set(net.transitions.filter((t) => t.error).map((t) => t.name));
  const used = new Map();
  for (const arc of net.arcs) used.set(arc.place, (used.get(arc.place) ?? true) && error.has(arc.transition));
  return { ...net, places: net.places.map((p) => (used.get(p.name) ? { ...p, error: true } : p)) };
}

/** What each element is drawn within: what it was made from, else its macro place. */
const macrosOf = (task) => new Map([...task.places, ...task.transitions].map((e) => [e.name, e.made_from || (e.in_macro ?? "")]));

/** The macro places around an element of the whole net, innermost first. */
function around(macros, name) {
  const found = [];
  for (let macro = macros.get(name); macro && !found.includes(macro); macro = macros.get(macro)) found.push(macro);
  return found;
}

/** What people call each element of the whole net, by name. Copies of a transition are called as it is; what else a short form adds, by what it is for. */
export function labelsOf(task) {
  const labels = new Map([...task.places, ...task.transitions].map((e) => [e.name, words(e.label || e.name)]));
  const places = new Set(task.places.map((p) => p.name));
  for (const { name, label, made_from: origin } of task.transitions) {
    if (origin && !label) labels.set(name, `${labels.get(origin) ?? words(origin)}${places.has(origin) ? `: ${words(name.slice(origin.length + 1))}` : ""}`);
  }
  return labels;
}

/** The way to an opened macro place: [{name, label}], outermost first. */
export function trailOf(task, inside) {
  const labels = new Map(task.places.map((p) => [p.name, p.label || p.name.split(".").at(-1)]));
  return inside ? [...around(macrosOf(task), inside).reverse(), inside].map((name) => ({ name, label: labels.get(name) ?? name })) : [];
}

/**
 * The net {places, transitions, arcs} of one sheet; `inside` is the name of a macro place, "" for the whole. Transitions that
 * join what is inside with what is around it are drawn beside it, as `outside`.
 */
export function sheetOf(task, inside) {
  const macros = macrosOf(task);
  const shownAs = (name) => {
    const chain = [name, ...around(macros, name)];
    return inside ? chain[chain.indexOf(inside) - 1] : chain.at(-1);
  };
  const here = (e) => !e.made_from && (e.in_macro ?? "") === inside;
  const made = new Set([...task.places, ...task.transitions].filter((e) => e.made_from).map((e) => e.name));
  const arcs = task.arcs.filter((a) => !a.made && !made.has(a.place) && !made.has(a.transition)).map((a) => ({ ...a, place: shownAs(a.place), end: a.end ?? (shownAs(a.place) === a.place ? null : a.macro_end) })).filter((a) => a.place);
  const joined = new Set(arcs.map((a) => a.transition));
  const outside = (t) => inside && joined.has(t.name) && !around(macros, t.name).includes(inside);
  const transitions = task.transitions.filter((t) => here(t) || outside(t)).map((t) => (here(t) ? t : { ...t, x: undefined, y: undefined, outside: true }));
  const names = new Set(transitions.map((t) => t.name));
  const base = (e) => (e.label ? e : { ...e, label: e.outside ? e.name : !inside ? e.name : e.name.startsWith(`${inside}.`) ? e.name.slice(inside.length + 1) : e.name.split(".").at(-1) });
  return placed(onlyErrors({
    places: task.places.filter(here).map((p) => base({ ...p, sub: underPlace(p), hint: hintPlace(p) })),
    transitions: transitions.map((t) => base({ ...t, sub: caption(t), hint: hintTransition(t) })),
    arcs: summed(arcs.filter((a) => names.has(a.transition))),
  }));
}

/** Arcs that end alike in one macro place are one, with their weights summed. */
function summed(arcs) {
  const joined = new Map();
  for (const arc of arcs) {
    const id = `${arc.direction}|${arc.place}|${arc.transition}|${arc.end ?? ""}`;
    joined.set(id, { ...arc, weight: (arc.weight ?? 1) + (joined.get(id)?.weight ?? 0) });
  }
  return [...joined.values()];
}

/** Tokens of what is drawn: a macro place shows all that its inside holds. */
export function tokensOf(task, marking) {
  const shown = { ...marking };
  const macros = macrosOf(task);
  for (const place of task.places) if (place.kind === "macro") shown[place.name] = 0;
  const made = new Set(task.places.filter((p) => p.made_from).map((p) => p.name));
  for (const [name, n] of Object.entries(marking)) for (const macro of made.has(name) ? [] : around(macros, name)) shown[macro] += n;
  return shown;
}

/** How each element is drawn on a sheet: as itself, or as the closed macro place around it; null for what is not on it. */
export function drawnOn(task, inside) {
  const macros = macrosOf(task);
  return (name) => {
    const chain = [name, ...around(macros, name)];
    return inside ? (chain[chain.indexOf(inside) - 1] ?? null) : chain.at(-1);
  };
}

/** Where the error branch begins that led to each place with tokens: [{place, count, begins}]; `fired` are the last firings. */
function errorTokens(task, marking, fired) {
  const inError = new Set(task.places.filter((p) => p.error).map((p) => p.name));
  const held = [...inError].filter((name) => marking[name]);
  const begins = held.length ? beginnings(task, inError) : [];
  const last = (arc) => fired.lastIndexOf(arc.transition);
  return held.map((place) => {
    const ways = begins.filter((arc) => reaches(task, arc.transition, inError, place));
    const newest = Math.max(-1, ...ways.map(last));
    return { place, count: marking[place], begins: new Set(ways.filter((arc) => newest < 0 || last(arc) === newest).map((arc) => arc.place)) };
  });
}

/** The arcs by which a token comes into an error branch: those of an end in error, else from an action, else all there are. */
function beginnings(task, inError) {
  const kinds = new Map(task.places.map((p) => [p.name, p.kind]));
  return task.transitions.filter((t) => t.error).flatMap((t) => {
    const arcs = task.arcs.filter((a) => a.transition === t.name && a.direction === "in" && !inError.has(a.place));
    const [errors, actions] = [arcs.filter((a) => a.end === "error"), arcs.filter((a) => kinds.get(a.place) === "action")];
    return errors.length ? errors : actions.length ? actions : arcs;
  });
}

/**
 * Tokens in error branches that are not seen as such on a sheet: {folded: tokens by the element at which their branch begins,
 * inside: tokens by closed macro place, hidden: how many are shown by nothing else}. `seen(name)` says whether an element is drawn.
 */
export function alarms(task, marking, inside, seen, fired = []) {
  const drawn = drawnOn(task, inside);
  const found = { folded: new Map(), inside: new Map(), hidden: 0 };
  const add = (where, name, n) => where.set(name, (where.get(name) ?? 0) + n);
  for (const { place, count, begins } of errorTokens(task, marking, fired)) {
    const shown = drawn(place);
    if (shown !== null && seen(shown)) {
      if (shown !== place) add(found.inside, shown, count);
      continue;
    }
    found.hidden += count;
    for (const name of new Set([...begins].map(drawn))) if (name !== null && seen(name)) add(found.folded, name, count);
  }
  return found;
}

const WORST = ["running", "held", "holding", "stopping"];

/** The run that is shown at each place of a sheet; a closed macro place shows the worst state and the least progress inside. */
export function runsOn(task, runs, inside) {
  const drawn = drawnOn(task, inside);
  const found = new Map();
  for (const run of Object.values(runs)) {
    const name = drawn(run.place);
    const [before, state] = [found.get(name), run.state ?? "running"];
    if (!before) found.set(name, { state, progress: run.progress });
    else found.set(name, { state: WORST.indexOf(state) > WORST.indexOf(before.state) ? state : before.state, progress: Math.min(before.progress ?? 0, run.progress ?? 0) });
  }
  return found;
}

function reaches(task, first, inError, wanted) {
  const seen = new Set();
  const open = [first];
  while (open.length) {
    const transition = open.pop();
    for (const arc of task.arcs) {
      if (arc.transition !== transition || arc.direction !== "out" || seen.has(arc.place) || !inError.has(arc.place)) continue;
      if (arc.place === wanted) return true;
      seen.add(arc.place);
      for (const next of task.arcs) if (next.direction === "in" && next.place === arc.place) open.push(next.transition);
    }
  }
  return false;
}
