// Copy and paste: elements with the arcs among them, and what they need to mean the same in another task.

import { listed, readArc, repoint } from "./arcs.js";
import { taskOf } from "./drawn.js";
import { groups, within } from "./macros.js";

const SHARED = ["primitive_tasks", "events", "variables", "subnets"];
const KEY = "petrobot.clip";

const pick = (table, names) => Object.fromEntries(Object.entries(table ?? {}).filter(([name]) => names.has(name)).map(([name, value]) => [name, structuredClone(value)]));

/** The chosen elements of the drawn net as plain data for `paste`. */
export function clip(model, chosen) {
  const { net, data } = model;
  const names = new Set([...chosen].flatMap((n) => [n, ...(groups(net.places?.[n]) ? within(net, n) : [])]));
  const made = { places: pick(net.places, names), transitions: pick(net.transitions, names) };
  for (const t of Object.values(made.transitions)) for (const key of ["in", "out"]) t[key] = listed(t[key]).filter((text) => names.has(readArc(text)?.place));
  for (const e of [...Object.values(made.places), ...Object.values(made.transitions)]) if (!names.has(e.macro)) delete e.macro;
  return { ...made, shared: needed(data, made) };
}

/** Primitive tasks, events, variables and subnets that the copied elements name, and those that these name in turn. */
function needed(data, net, found = Object.fromEntries(SHARED.map((group) => [group, {}]))) {
  const add = (group, name) => {
    if (!name || found[group][name] || !data[group]?.[name]) return;
    found[group][name] = structuredClone(data[group][name]);
    if (group === "subnets") needed(data, data.subnets[name], found);
    if (group === "events") add("primitive_tasks", data.events[name].by);
  };
  for (const [name, place] of Object.entries(net.places ?? {})) {
    add("primitive_tasks", taskOf(name, place));
    add("subnets", place.subnet);
    for (const value of Object.values(place.args ?? {})) add("variables", value?.var);
    for (const variable of Object.values(place.out ?? {})) add("variables", variable);
  }
  for (const t of Object.values(net.transitions ?? {})) {
    for (const event of listed(t.event)) add("events", event);
    for (const [word] of String(t.when ?? "").matchAll(/[\p{L}_][\p{L}\p{N}_]*/gu)) add("variables", word);
  }
  return found;
}

/** Put copied elements into the drawn net, moved by (dx, dy); returns the names of those on this sheet. */
export function paste(model, made, dx, dy) {
  return model.edit("paste", (data, net) => {
    for (const group of SHARED) for (const [name, value] of Object.entries(made.shared?.[group] ?? {})) (data[group] ??= {})[name] ??= structuredClone(value);
    const names = new Map();
    for (const kind of ["places", "transitions"]) {
      for (const [name, value] of Object.entries(made[kind] ?? {})) {
        const free = model.freeName(name, net);
        names.set(name, free);
        const where = Object.fromEntries([["x", dx], ["y", dy]].filter(([axis]) => Number.isFinite(value[axis])).map(([axis, d]) => [axis, value[axis] + d]));
        const task = free !== name && data.primitive_tasks?.[taskOf(name, value)] ? { task: taskOf(name, value) } : {};
        net[kind][free] = { ...structuredClone(value), ...task, ...where };
      }
    }
    for (const [name, free] of names) {
      const element = net.places[free] ?? net.transitions[free];
      const macro = (made.places[name] ?? made.transitions[name]).macro;
      if (macro || model.inside) element.macro = macro ? names.get(macro) : model.inside;
    }
    for (const name of Object.keys(made.transitions ?? {})) repoint(net.transitions[names.get(name)], names);
    return [...names].filter(([name]) => !(made.places[name] ?? made.transitions[name]).macro).map(([, free]) => free);
  });
}

export const keep = (made) => localStorage.setItem(KEY, JSON.stringify(made));

/** What was copied last, in this window or another; null when nothing was. */
export function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEY) ?? "null");
  } catch {
    return null;
  }
}
