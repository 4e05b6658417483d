// Which part of a task is drawn: the whole with its macro places closed, or the inside of one macro place.

import { placed } from "./layout.js";
import { seconds, words } from "./dom.js";

/** What stands above a transition: its events, condition and timer. */
export function caption(transition) {
  const parts = (transition.events ?? []).map((e) => `${e.scope === "internal" ? "int" : "ext"}: ${words(e.name)}`);
  if (transition.after !== null && transition.after !== undefined) parts.push(`after ${seconds(transition.after)}`);
  if (transition.when) parts.push(`[${transition.when}]`);
  return parts.join(" · ");
}

const hintPlace = (p) => [p.name, p.primitive_task && `primitive task ${p.primitive_task}`, p.capacity && `capacity ${p.capacity}`].filter(Boolean).join("\n");
const hintTransition = (t) => [t.name, caption(t), t.priority ? `priority ${t.priority}` : ""].filter(Boolean).join("\n");

/** The net with those places marked as error branches, too, that nothing but error branches uses. */
export function onlyErrors(net) {
  const error = new Set(net.transitions.filter((t) => t.error).map((t) => t.name));
  const used = new Map();
  for (const arc of net.arcs) used.set(arc.place, (used.get(arc.place) ?? true) && error.has(arc.transition));
  return { ...net, places: net.places.map((p) => (used.get(p.name) ? { ...p, error: true } : p)) };
}

/** The net {places, transitions, arcs} of one sheet; `inside` is the name of a macro place, "" for the whole. */
export function sheetOf(task, inside) {
  const macros = new Set(task.places.filter((p) => p.kind === "macro").map((p) => p.name));
  const shownAs = (name) => {
    // the outermost macro place that closes over an element on this sheet
    const prefix = inside ? inside.length + 1 : 0;
    const rest = name.slice(prefix).split(".");
    for (let n = 1; n < rest.length; n++) {
      const macro = name.slice(0, prefix) + rest.slice(0, n).join(".");
      if (macros.has(macro)) return macro;
    }
    return name;
  };
  const here = (e) => (e.in_macro ?? "") === inside;
  const transitions = task.transitions.filter(here);
  const names = new Set(transitions.map((t) => t.name));
  const arcs = task.arcs.filter((a) => names.has(a.transition)).map((a) => ({ ...a, place: shownAs(a.place) }));
  const places = task.places.filter(here);
  const known = new Set(places.map((p) => p.name));
  const base = (e) => (e.label ? e : { ...e, label: e.name.slice(inside ? inside.length + 1 : 0) });
  return placed(onlyErrors({
    places: places.map((p) => base({ ...p, sub: p.kind === "action" && p.primitive_task !== p.name ? words(p.primitive_task) : "", hint: hintPlace(p) })),
    transitions: transitions.map((t) => base({ ...t, sub: caption(t), hint: hintTransition(t) })),
    arcs: arcs.filter((a) => known.has(a.place)),
  }));
}

/** Tokens of what is drawn: a macro place shows all that its inside holds. */
export function tokensOf(task, marking) {
  const shown = { ...marking };
  for (const place of task.places) {
    if (place.kind !== "macro") continue;
    const prefix = `${place.name}.`;
    shown[place.name] = Object.entries(marking).reduce((sum, [name, n]) => sum + (name.startsWith(prefix) ? n : 0), 0);
  }
  return shown;
}

/** Places whose folded error branch holds a token now; `fired` are the last firings, newest last, and tell which of several. */
export function alarmed(task, marking, fired = []) {
  const inError = new Set(task.places.filter((p) => p.error).map((p) => p.name));
  const held = [...inError].filter((name) => marking[name]);
  const begins = held.length ? task.arcs.filter((a) => a.direction === "in" && a.end === "error" && !inError.has(a.place)) : [];
  const last = (arc) => fired.lastIndexOf(arc.transition);
  const alarms = new Set();
  for (const place of held) {
    const ways = begins.filter((arc) => reaches(task, arc.transition, inError, place));
    const newest = Math.max(-1, ...ways.map(last));
    for (const arc of ways) if (newest < 0 || last(arc) === newest) alarms.add(arc.place);
  }
  return alarms;
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
