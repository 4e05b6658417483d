// A task file's document while it is drawn: plain data, edits with undo, and the net that it describes.

import { listed, readArc, repoint, writeArc } from "./arcs.js";
import { drawn } from "./drawn.js";
import { around, group, groups, members, own, ungroup, within } from "./macros.js";

const UNDO_KEPT = 300;
/** What to do about a transition that only the table `errors` makes. */
export const MADE = "This error branch is made by the table errors of the file. To draw another one, choose its place and press Add error branch.";
const NAME = /^[\p{L}_][\p{L}\p{N}_]*$/u;

export const emptyDocument = (name) => ({ schema: 1, task: { name, final: "false" }, primitive_tasks: {}, events: {}, places: {}, transitions: {} });

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
    this.inside = "";
    this.changed("load");
  }

  /** The server has stored what was `sent`. Undo still works across a save, and what was drawn meanwhile stays. */
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

  /** Change the document with `change(data, net)`; consecutive edits of one `group` are one step of undo. */
  edit(label, change, group = null) {
    const before = { ...this.state, label };
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

  undo() {
    return this.swap(this.past, this.future);
  }

  redo() {
    return this.swap(this.future, this.past);
  }

  swap(from, to) {
    const state = from.pop();
    if (!state) return null;
    to.push({ ...this.state, label: state.label });
    this.data = state.data;
    this.renames = state.renames;
    this.open(state.sheet, state.inside);
    this.changed("edit");
    return state.label;
  }

  /** What undo brings back. */
  get state() {
    return { data: this.data, renames: this.renames, sheet: this.sheet, inside: this.inside };
  }

  hasSheet(sheet) {
    return !sheet || Boolean(this.data.subnets?.[sheet]);
  }

  /** Draw a subnet ("" for the task's own net) with one of its macro places opened ("" for none), as far as they exist. */
  open(sheet, inside = "") {
    this.sheet = this.hasSheet(sheet) ? sheet : "";
    this.inside = groups(this.place(inside)) ? inside : "";
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
    return own(this.net.places, name);
  }

  transition(name) {
    return own(this.net.transitions, name);
  }

  has(name) {
    return Boolean(this.place(name) ?? this.transition(name));
  }

  freeName(stem, net = this.net) {
    const taken = (n) => Boolean(own(net.places, n) ?? own(net.transitions, n));
    if (!taken(stem)) return stem;
    const root = stem.replace(/_\d+$/, "");
    let i = 2;
    while (taken(`${root}_${i}`)) i += 1;
    return `${root}_${i}`;
  }

  /** The field that puts a new element into the opened macro place. */
  get here() {
    return this.inside ? { macro: this.inside } : {};
  }

  addPlace(kind, x, y) {
    const stem = { action: "action", resource: "resource", control: "control", macro: "macro", plain: "place" }[kind];
    return this.edit(`add ${kind} place`, (_, net) => {
      const name = this.freeName(stem, net);
      net.places[name] = { ...(kind === "plain" ? {} : { kind }), ...(kind === "resource" ? { tokens: 1, capacity: 1 } : {}), ...(kind === "control" ? { capacity: 10 } : {}), ...this.here, x, y };
      return name;
    });
  }

  addTransition(x, y, stem = "transition") {
    return this.edit("add transition", (_, net) => {
      const name = this.freeName(stem, net);
      net.transitions[name] = { in: [], out: [], ...this.here, x, y };
      return name;
    });
  }

  /** Draw an arc; returns null, or why it cannot be drawn. */
  connect(from, to, inhibit = false) {
    const [a, b] = [this.place(from), this.place(to)];
    if (![from, to].every((name) => this.has(name))) return MADE;
    if (from === to) return "An arc connects two different elements.";
    if (a && b) return "An arc connects a place and a transition, never two places. Put a transition between them.";
    if (!a && !b) return "An arc connects a place and a transition, never two transitions. Put a place between them.";
    if (inhibit && !a) return "An inhibitor arc goes from a place to a transition.";
    if (groups(a ?? b)) return "An arc ends at a place inside the macro place. Put a place into it first.";
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

  /** The first outgoing arc of an action place is the normal one, the second the error branch. */
  nextEnd(net, place) {
    if (!["action", "macro"].includes(net.places[place].kind)) return null;
    const ends = new Set(Object.values(net.transitions).flatMap((t) => listed(t.in).map(readArc)).filter((a) => a?.place === place).map((a) => a.end));
    return ends.has("normal") && !ends.has("error") ? "error" : "normal";
  }

  /** Make a transition for one outgoing arc of an action place. Returns its name. */
  addExit(place, end, x, y) {
    return this.edit(end === "error" ? "add error branch" : "add exit", (_, net) => {
      const name = this.freeName(end === "error" ? `${place}_error` : `${place}_done`, net);
      net.transitions[name] = { in: [writeArc({ place, weight: 1, end })], out: [], ...this.here, x, y };
      return name;
    });
  }

  /** Change an arc ({direction, place, transition}); `null` deletes it. */
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

  /** Delete elements with their arcs, macro places with everything inside, and arcs. */
  remove(names, arcs = []) {
    this.edit("delete", (_, net) => {
      for (const arc of arcs) for (const place of arc.inner?.length ? arc.inner : [arc.place]) this.dropArc(net, { ...arc, place });
      const gone = new Set([...names].flatMap((name) => [name, ...(groups(net.places[name]) ? within(net, name) : [])]));
      for (const name of gone) {
        delete net.places[name];
        delete net.transitions[name];
      }
      for (const t of Object.values(net.transitions)) repoint(t, new Map(), gone);
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

  /** Rename an element wherever it is named; returns null, or why it cannot be renamed. */
  rename(from, to) {
    if (to === from) return null;
    if (!NAME.test(to) || to === "__proto__") return "A name must start with a letter and contain only letters, digits and _.";
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
    if (net.places[to].kind === "action" && data.primitive_tasks?.[from]) net.places[to].task ??= from;
    for (const t of Object.values(net.transitions)) {
      repoint(t, new Map([[from, to]]));
      if (t.when) t.when = renamed(t.when, from, to);
    }
    for (const e of [...Object.values(net.places), ...Object.values(net.transitions)]) if (e.macro === from) e.macro = to;
    for (const p of Object.values(net.places)) {
      if (p.holds) p.holds = listed(p.holds).map((n) => (n === from ? to : n));
      const kinds = p.kind === "macro" ? data.subnets?.[p.subnet]?.parameters : null;
      for (const [name, kind] of Object.entries(kinds ?? {})) if (kind === "place" && p.args?.[name] === from) p.args[name] = to;
    }
    const errors = this.sheet ? net.errors : data.errors;
    if (errors?.to === from) errors.to = to;
    if (this.inside === from) this.inside = to;
    if (this.sheet) {
      for (const key of ["entry", "normal", "error"]) if (net[key] === from) net[key] = to;
      return;
    }
    for (const key of ["final", "final_error"]) if (data.task[key]) data.task[key] = renamed(data.task[key], from, to);
    if (data.task.runs_place === from) data.task.runs_place = to;
  }

  /** Use a primitive task in an action place; one that only the nodes know is added to the document. */
  choosePrimitiveTask(place, primitive, offers) {
    this.edit("choose primitive task", (data, net) => {
      data.primitive_tasks ??= {};
      if (!data.primitive_tasks[primitive]) {
        const alternatives = offers.filter((o) => o.primitive_task === primitive).map((o) => o.action);
        data.primitive_tasks[primitive] = { ...(alternatives.length ? { alternatives } : {}), deadline: 10 };
      }
      net.places[place].task = primitive;
    });
  }

  /** Put the chosen elements into a new macro place: {name, left}, or a text that says why not. */
  group(names) {
    const chosen = members(this.net, names, this.inside);
    if (!chosen.members.some((n) => this.place(n))) return "First select the places for the macro place, with the transitions between them.";
    const name = this.edit("group", (_, net) => {
      const macro = this.freeName("macro", net);
      group(net, chosen.members, macro, this.inside);
      return macro;
    });
    return { name, left: chosen.left };
  }

  /** Dissolve macro places that group; returns the names of their elements. */
  ungroup(names) {
    const macros = [...names].filter((n) => groups(this.place(n)));
    return macros.length ? this.edit("ungroup", (_, net) => macros.flatMap((macro) => ungroup(net, macro))) : [];
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

  /** The macro places opened on the way to what is drawn, outermost first. */
  get opened() {
    return this.inside ? [...around(this.net, this.inside).reverse(), this.inside] : [];
  }

  /** What of the opened sheet is drawn. */
  picture() {
    return drawn(this.data, this.net, this.inside);
  }
}
