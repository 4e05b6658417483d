// A task file's document while it is drawn: plain data, edits with undo, and the net that it describes.

import { words } from "./dom.js";
import { caption, onlyErrors } from "./sheet.js";

const ARC = /^(!?)\s*([\p{L}\p{N}_.]+)(?::(\w+)(?:=(\w+))?)?(?:\s*\*\s*(\d+))?$/u;
const UNDO_KEPT = 300;
const NAME = /^[\p{L}_][\p{L}\p{N}_]*$/u;

/** One arc of `in` or `out`: {place, end, counts, weight, inhibit}; null when the text is none. */
export function readArc(text) {
  const found = ARC.exec(String(text).trim());
  return found ? { inhibit: Boolean(found[1]), place: found[2], end: found[3] ?? null, counts: found[4] ?? null, weight: Number(found[5] ?? 1) } : null;
}

export function writeArc({ place, end, counts, weight, inhibit }) {
  const way = end ? `:${end}${counts ? `=${counts}` : ""}` : "";
  return `${inhibit ? "!" : ""}${place}${inhibit ? "" : way}${weight > 1 ? `*${weight}` : ""}`;
}

export const emptyDocument = (name) => ({ schema: 1, task: { name, final: "false" }, primitive_tasks: {}, events: {}, places: {}, transitions: {} });

const listed = (value) => (Array.isArray(value) ? value : value === undefined || value === "" ? [] : [value]);
const copy = (value) => structuredClone(value);

/** Rename an identifier in a condition; text in quotes and parts after a dot stay. */
function renamed(condition, from, to) {
  return String(condition).replace(/"[^"]*"|'[^']*'|(?<![\p{L}\p{N}_.])[\p{L}_][\p{L}\p{N}_]*/gu, (word) => (word === from ? to : word));
}

export class Model {
  constructor(changed) {
    this.changed = changed;
    this.load({ name: "", revision: null, document: emptyDocument("new_task") });
  }

  load({ name, revision, document }) {
    this.name = name;
    this.base = revision;
    this.data = document;
    this.renames = [];
    this.saved = JSON.stringify(document);
    this.past = [];
    this.future = [];
    this.sheet = "";
    this.changed("load");
  }

  /** The server has what was `sent`; undo goes on to work across a save, and what was drawn meanwhile stays. */
  savedAs({ name, revision, document }, sent) {
    this.name = name;
    this.base = revision;
    this.saved = JSON.stringify(document);
    if (this.data === sent.data) this.data = document;
    for (const state of [this, ...this.past, ...this.future]) state.renames = state.renames.slice(sent.renames.length);
    this.changed("saved");
  }

  get dirty() {
    return JSON.stringify(this.data) !== this.saved;
  }

  // ---- edits --------------------------------------------------------------------------------------------------------

  /** Alter the document by `change(data, net)`; edits of one `group` in a row are one step of undo. */
  edit(label, change, group = null) {
    const before = { data: this.data, renames: this.renames, label, sheet: this.sheet };
    const data = copy(this.data);
    this.renames = [...this.renames];
    const result = change(data, this.netOf(data));
    if (JSON.stringify(data) === JSON.stringify(this.data)) return result;
    this.data = data;
    const last = this.past.at(-1);
    if (!group || last?.group !== group) this.past.push({ ...before, group });
    if (this.past.length > UNDO_KEPT) this.past.shift();
    this.future = [];
    this.changed("edit");
    return result;
  }

  endGroup() {
    const last = this.past.at(-1);
    if (last) last.group = null;
  }

  undo() {
    return this.swap(this.past, this.future);
  }

  redo() {
    return this.swap(this.future, this.past);
  }

  swap(from, to) {
    const state = from.pop();
    if (!state) return null;
    to.push({ data: this.data, renames: this.renames, label: state.label, sheet: this.sheet });
    this.data = state.data;
    this.renames = state.renames;
    if (this.hasSheet(state.sheet)) this.sheet = state.sheet;
    this.changed("edit");
    return state.label;
  }

  hasSheet(sheet) {
    return !sheet || Boolean(this.data.subnets?.[sheet]);
  }

  /** The part of the document that is drawn on this sheet. */
  netOf(data = this.data) {
    const net = this.sheet ? (data.subnets[this.sheet] ??= {}) : data;
    net.places ??= {};
    net.transitions ??= {};
    return net;
  }

  get net() {
    return this.sheet ? (this.data.subnets?.[this.sheet] ?? {}) : this.data;
  }

  get path() {
    return this.sheet ? ["subnets", this.sheet] : [];
  }

  place(name) {
    return this.net.places?.[name];
  }

  transition(name) {
    return this.net.transitions?.[name];
  }

  has(name) {
    return Boolean(this.place(name) ?? this.transition(name));
  }

  freeName(stem, net = this.net) {
    const taken = (n) => net.places?.[n] !== undefined || net.transitions?.[n] !== undefined;
    if (!taken(stem)) return stem;
    const root = stem.replace(/_\d+$/, "");
    let i = 2;
    while (taken(`${root}_${i}`)) i += 1;
    return `${root}_${i}`;
  }

  addPlace(kind, x, y) {
    const stem = { action: "action", resource: "resource", control: "control", macro: "macro" }[kind];
    return this.edit(`add ${kind} place`, (_, net) => {
      const name = this.freeName(stem, net);
      net.places[name] = { kind, ...(kind === "resource" ? { tokens: 1, capacity: 1 } : {}), ...(kind === "control" ? { capacity: 10 } : {}), x, y };
      return name;
    });
  }

  addTransition(x, y, stem = "transition") {
    return this.edit("add transition", (_, net) => {
      const name = this.freeName(stem, net);
      net.transitions[name] = { in: [], out: [], x, y };
      return name;
    });
  }

  /** Draw an arc; a text says why it cannot be drawn, null that it was. */
  connect(from, to, inhibit = false) {
    const [a, b] = [this.place(from), this.place(to)];
    if (from === to) return "An arc joins two different elements.";
    if (a && b) return "An arc joins a place and a transition, never two places: put a transition between them.";
    if (!a && !b) return "An arc joins a place and a transition, never two transitions: put a place between them.";
    if (inhibit && !a) return "An inhibitor arc goes from a place to a transition.";
    const place = a ? from : to;
    const transition = this.transition(a ? to : from);
    const same = listed(a ? transition.in : transition.out).map(readArc).find((arc) => arc?.place === place && arc.inhibit === inhibit);
    if (same) {
      this.setArc({ direction: inhibit ? "inhibit" : a ? "in" : "out", place, transition: a ? to : from }, { weight: same.weight + 1 });
      return null;
    }
    this.edit("add arc", (_, net) => {
      const t = net.transitions[a ? to : from];
      const arc = { place, weight: 1, inhibit, end: !inhibit && a ? this.nextEnd(net, place) : null, counts: null };
      if (a) t.in = [...listed(t.in), writeArc(arc)];
      else t.out = [...listed(t.out), writeArc(arc)];
    });
    return null;
  }

  /** The first way out of an action place is the normal one, the second the error branch. */
  nextEnd(net, place) {
    if (!["action", "macro"].includes(net.places[place].kind)) return null;
    const ends = new Set(Object.values(net.transitions).flatMap((t) => listed(t.in).map(readArc)).filter((a) => a?.place === place).map((a) => a.end));
    return ends.has("normal") && !ends.has("error") ? "error" : "normal";
  }

  /** Alter an arc ({direction, place, transition}); `null` takes it away. */
  setArc(arc, change) {
    this.edit(change ? "change arc" : "delete arc", (_, net) => {
      const t = net.transitions[arc.transition];
      const key = arc.direction === "out" ? "out" : "in";
      t[key] = listed(t[key]).flatMap((text) => {
        const read = readArc(text);
        if (!read || read.place !== arc.place || read.inhibit !== (arc.direction === "inhibit") || (arc.end !== undefined && read.end !== arc.end)) return [text];
        return change ? [writeArc({ ...read, ...change })] : [];
      });
    });
  }

  remove(names, arcs = []) {
    this.edit("delete", (_, net) => {
      for (const arc of arcs) this.dropArc(net, arc);
      for (const name of names) {
        delete net.places[name];
        delete net.transitions[name];
      }
      for (const t of Object.values(net.transitions)) {
        for (const key of ["in", "out"]) if (t[key]) t[key] = listed(t[key]).filter((text) => !names.has(readArc(text)?.place));
      }
    });
  }

  dropArc(net, arc) {
    const t = net.transitions[arc.transition];
    const key = arc.direction === "out" ? "out" : "in";
    t[key] = listed(t[key]).filter((text) => {
      const read = readArc(text);
      return !read || read.place !== arc.place || read.inhibit !== (arc.direction === "inhibit") || read.end !== (arc.end ?? null);
    });
  }

  move(positions, group) {
    this.edit("move", (_, net) => {
      for (const [name, [x, y]] of Object.entries(positions)) Object.assign(net.places[name] ?? net.transitions[name] ?? {}, { x, y });
    }, group);
  }

  /** Set fields of an element; undefined, "" and null take a field away. */
  set(name, fields, group = null) {
    this.edit("change", (_, net) => {
      const element = net.places[name] ?? net.transitions[name];
      for (const [key, value] of Object.entries(fields)) {
        if (value === undefined || value === null || value === "" || (Array.isArray(value) && !value.length && key === "event")) delete element[key];
        else element[key] = value;
      }
    }, group && `${group} ${name}`);
  }

  /** Give an element another name, wherever it is named; a text says why not. */
  rename(from, to) {
    if (to === from) return null;
    if (!NAME.test(to)) return "A name begins with a letter and has letters, digits and _ only.";
    if (this.has(to)) return `There is already something called ${to} here.`;
    this.edit("rename", (data, net) => {
      const kind = net.places[from] ? "places" : "transitions";
      net[kind] = Object.fromEntries(Object.entries(net[kind]).map(([name, value]) => [name === from ? to : name, value]));
      this.renames.push({ path: [...this.path, kind], old: from, new: to });
      if (kind === "places") this.renamePlace(data, net, from, to);
      else if (!this.sheet && data.task.goal_transitions) data.task.goal_transitions = listed(data.task.goal_transitions).map((n) => (n === from ? to : n));
    });
    return null;
  }

  renamePlace(data, net, from, to) {
    for (const t of Object.values(net.transitions)) {
      for (const key of ["in", "out"]) {
        if (!t[key]) continue;
        t[key] = listed(t[key]).map((text) => {
          const arc = readArc(text);
          return arc?.place === from ? writeArc({ ...arc, place: to }) : text;
        });
      }
      if (t.when) t.when = renamed(t.when, from, to);
    }
    if (this.sheet) {
      for (const key of ["entry", "normal", "error"]) if (net[key] === from) net[key] = to;
      return;
    }
    for (const key of ["final", "final_error"]) if (data.task[key]) data.task[key] = renamed(data.task[key], from, to);
    if (data.task.runs_place === from) data.task.runs_place = to;
  }

  /** Use a primitive task in an action place; one that only the nodes know is written into the document. */
  choosePrimitiveTask(place, primitive, offers) {
    this.edit("choose primitive task", (data, net) => {
      data.primitive_tasks ??= {};
      if (!data.primitive_tasks[primitive]) {
        const alternatives = offers.filter((o) => o.primitive_task === primitive).map((o) => o.action);
        data.primitive_tasks[primitive] = { goal: words(primitive), alternatives: alternatives.length ? alternatives : [primitive], deadline: 10 };
      }
      net.places[place].task = primitive;
    });
  }

  /** Copy elements with the arcs among them; gives plain data for `paste`. */
  clip(names) {
    const pick = (table) => Object.fromEntries(Object.entries(table ?? {}).filter(([name]) => names.has(name)).map(([name, value]) => [name, copy(value)]));
    const clip = { places: pick(this.net.places), transitions: pick(this.net.transitions) };
    for (const t of Object.values(clip.transitions)) for (const key of ["in", "out"]) t[key] = listed(t[key]).filter((text) => names.has(readArc(text)?.place));
    return clip;
  }

  paste(clip, dx, dy) {
    return this.edit("paste", (_, net) => {
      const names = new Map();
      for (const kind of ["places", "transitions"]) {
        for (const [name, value] of Object.entries(clip[kind] ?? {})) {
          const free = this.freeName(name, net);
          names.set(name, free);
          net[kind][free] = { ...copy(value), x: (value.x ?? 0) + dx, y: (value.y ?? 0) + dy };
        }
      }
      for (const name of Object.keys(clip.transitions ?? {})) {
        const t = net.transitions[names.get(name)];
        for (const key of ["in", "out"]) t[key] = listed(t[key]).map((text) => this.repointed(text, names));
      }
      return [...names.values()];
    });
  }

  repointed(text, names) {
    const arc = readArc(text);
    return arc ? writeArc({ ...arc, place: names.get(arc.place) ?? arc.place }) : text;
  }

  /** A new subnet with one entry and one exit for a macro place. */
  addSubnet(place) {
    return this.edit("new subnet", (data, net) => {
      data.subnets ??= {};
      let name = `${place}_net`;
      for (let i = 2; data.subnets[name]; i++) name = `${place}_net_${i}`;
      data.subnets[name] = { entry: "begin", normal: "end", places: { begin: { kind: "control", x: 80, y: 160 }, end: { kind: "control", x: 480, y: 160 } }, transitions: {} };
      net.places[place].subnet = name;
      return name;
    });
  }

  // ---- the drawing --------------------------------------------------------------------------------------------------

  /** The sheet's net for a view: elements with their meaning, arcs, and which of it error branches alone reach. */
  picture() {
    const { net, data } = this;
    const events = data.events ?? {};
    const arcs = [];
    for (const [name, t] of Object.entries(net.transitions ?? {})) {
      for (const text of listed(t.in)) {
        const arc = readArc(text);
        if (arc) arcs.push({ ...arc, transition: name, direction: arc.inhibit ? "inhibit" : "in", id: `in|${text}|${name}` });
      }
      for (const text of listed(t.out)) {
        const arc = readArc(text);
        if (arc) arcs.push({ ...arc, transition: name, direction: "out", id: `out|${text}|${name}` });
      }
    }
    const error = this.errorElements(arcs);
    const places = Object.entries(net.places ?? {}).map(([name, p]) => ({ name, kind: p.kind ?? "control", label: p.label ?? "", x: p.x, y: p.y, tokens: p.tokens ?? 0, sub: p.kind === "action" ? words(p.task && p.task !== name ? p.task : "") : p.kind === "macro" ? words(p.subnet) : "", error: error.has(name), hint: name }));
    const transitions = Object.entries(net.transitions ?? {}).map(([name, t]) => ({
      name, label: t.label ?? "", x: t.x, y: t.y, error: error.has(name), when: t.when ?? "", after: t.after, hint: name,
      events: listed(t.event).map((e) => ({ name: e, scope: events[e]?.scope ?? "external" })),
    }));
    return onlyErrors({ places, transitions: transitions.map((t) => ({ ...t, sub: caption(t) })), arcs });
  }

  errorElements(arcs) {
    const transitions = new Set(Object.entries(this.net.transitions ?? {}).filter(([, t]) => t.error_branch).map(([name]) => name));
    for (const arc of arcs) if (arc.end === "error") transitions.add(arc.transition);
    const places = new Set();
    for (let grew = true; grew; ) {
      grew = false;
      for (const [name, place] of Object.entries(this.net.places ?? {})) {
        if (places.has(name) || place.tokens) continue;
        const feeders = arcs.filter((a) => a.direction === "out" && a.place === name);
        if (feeders.length && feeders.every((a) => transitions.has(a.transition))) grew = Boolean(places.add(name));
      }
      for (const arc of arcs) if (arc.direction === "in" && places.has(arc.place) && !transitions.has(arc.transition)) grew = Boolean(transitions.add(arc.transition));
    }
    return new Set([...places, ...transitions]);
  }
}
