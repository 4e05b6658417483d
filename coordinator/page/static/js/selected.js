// What is known of the chosen place or transition, what it waits for, and what the operator may do with it.

import { fill, h, Press, seconds, valueText, words } from "./dom.js";
import { icon } from "./icons.js";
import { caption } from "./sheet.js";

/** A button; `why` says why it cannot be pressed now. */
const action = (name, label, onclick, why = "") =>
  h("button", { type: "button", class: "small", onclick, disabled: Boolean(why), title: why || null }, icon(name), label);

/** Whether the run that an arc waits for has ended as the arc wants: none is active in its place, and the last one ended so. */
const ended = (state, { place, end }) =>
  !Object.values(state.runs).some((run) => run.place === place) && (state.ended.findLast((run) => run.place === place)?.status === "error") === (end === "error");

const NAMES = /"[^"]*"|'[^']*'|[\p{L}_][\p{L}\p{N}_.]*/gu;

/** The present values of the variables that a text of the element `name` reads, by their names; in a subnet, those inside it come first. */
function valuesIn(state, text, name) {
  const inside = name.slice(0, name.lastIndexOf(".") + 1);
  const found = new Map();
  for (const [word] of String(text).matchAll(NAMES)) {
    const key = [inside + word, word].find((one) => Object.hasOwn(state.variables, one));
    if (key) found.set(word, valueText(state.variables[key]));
  }
  return found;
}

export class Selected {
  constructor(link, operator, open) {
    Object.assign(this, { link, operator, open, name: null });
    this.root = h("section", { class: "panel selected", "aria-label": "Selected", hidden: true });
    this.press = new Press(this.root);
  }

  choose(name) {
    this.name = name;
    this.key = "";
  }

  update(state, now) {
    const place = state.task?.places.find((p) => p.name === this.name);
    const transition = state.task?.transitions.find((t) => t.name === this.name);
    this.root.hidden = !place && !transition;
    if (this.root.hidden) return;
    const run = place ? Object.values(state.runs).find((r) => r.place === this.name) : null;
    const stop = state.breakpoints.includes(`${place ? "places" : "transitions"}.${this.name}`);
    const key = JSON.stringify([this.name, state.marking[this.name], run?.id, run?.state, stop, this.link.barred, state.mission.id, state.mission.state, transition && this.missing(state, transition), transition && this.values(state, transition), place && this.arguments(state, place), this.lastFiring(state)?.number]);
    if (key === this.key) return;
    if (this.drawn === this.name && this.press.holds(() => this.update(this.link.state, this.link.now()))) return;
    Object.assign(this, { key, drawn: this.name });
    fill(this.root, place ? this.place(state, place, run, stop) : this.transition(state, transition, stop, now));
  }

  head(kind, name, label) {
    return h("h2", {}, h("span", { class: "kind" }, kind), words(label || name));
  }

  stopButton(element, stop) {
    const label = stop ? "Remove breakpoint" : "Set breakpoint";
    return action("dot", label, () => this.operator.give("breakpoint", { element, on: !stop }), this.link.barred);
  }

  place(state, place, run, stop) {
    const { barred } = this.link;
    const tokens = state.marking[place.name] ?? 0;
    const full = place.capacity !== null && place.capacity !== undefined && tokens >= place.capacity;
    const facts = [["Tokens", place.capacity ? `${tokens} of ${place.capacity}` : tokens]];
    const left = state.marking[`${place.name}.left`];
    if (left !== undefined && state.task.places.some((p) => p.made_from === place.name)) facts.push(["Tries left", left]);
    if (place.in_short) facts.push(["Short forms", place.in_short]);
    if (place.primitive_task) facts.push(["Primitive task", words(place.primitive_task)]);
    const given = this.arguments(state, place);
    if (given) facts.push(["Arguments", given]);
    const primitive = state.task.primitive_tasks[place.primitive_task];
    if (primitive?.goal) facts.push(["Goal", primitive.goal]);
    if (primitive?.deadline) facts.push(["Deadline", seconds(primitive.deadline)]);
    if (run) facts.push(["Action", `${words(run.action)} on ${run.node}`], ["Why this one", run.why || "the only alternative"]);
    const give = (verb) => this.operator.give(verb, { place: place.name, count: 1 });
    const buttons = [this.stopButton(`places.${place.name}`, stop)];
    if (place.kind === "control") {
      buttons.unshift(action("plus", "Add token", () => give("add_tokens"), barred || (full ? "The place is full" : "")),
        action("minus", "Remove token", () => give("remove_tokens"), barred || (tokens < 1 ? "The place is empty" : "")));
    }
    if (run) buttons.push(...this.exits(state, place, run));
    if (place.kind === "macro") buttons.push(action("macro", "Open", () => this.open(place.name)));
    return [this.head(place.kind === "action" ? "Action place" : `${words(place.kind)} place`.replace(/^./, (c) => c.toUpperCase()), place.name, place.label), this.facts(facts), h("div", { class: "buttons" }, buttons)];
  }

  /** A button for each outgoing transition of a place whose run is active. */
  exits(state, place, run) {
    const made = new Set(state.task.transitions.filter((t) => t.made_from).map((t) => t.name));
    return state.task.arcs.filter((a) => a.direction === "in" && a.place === place.name && !made.has(a.transition)).map((a) => {
      const force = () => this.operator.give("force_exit", { run: run.id, transition: a.transition });
      const button = action("exit", `Force ${words(a.transition)}`, () => this.operator.confirm(button, `Leave ${words(place.name)} by force?`, force), this.link.barred);
      return button;
    });
  }

  transition(state, transition, stop) {
    const facts = [];
    const text = caption(transition);
    if (text) facts.push(["Fires on", text]);
    const values = this.values(state, transition);
    if (values) facts.push(["Values", values]);
    facts.push(["Now", this.missing(state, transition) || "can fire"]);
    const last = this.lastFiring(state);
    if (last) facts.push(["Last fired", `at ${seconds(last.at)}: ${last.cause ?? ""}`]);
    if (last?.reason?.text || last?.reason?.code) facts.push(["Reason", `${last.reason.text ?? ""}${last.reason.code ? ` [${last.reason.code}]` : ""}`]);
    const buttons = [this.stopButton(`transitions.${transition.name}`, stop)];
    for (const event of transition.events ?? []) {
      if (event.scope === "internal") continue;
      buttons.push(action("bolt", `Raise ${words(event.name)}`, () => this.operator.give("raise_event", { event: event.name }), this.link.barred));
    }
    return [this.head("Transition", transition.name, transition.label), this.facts(facts), h("div", { class: "buttons" }, buttons)];
  }

  facts(list) {
    return h("dl", {}, list.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, String(value)))));
  }

  lastFiring(state) {
    return state.firings.findLast((f) => f.transition === this.name);
  }

  values(state, transition) {
    return [...valuesIn(state, transition.when, transition.name)].map(([name, value]) => `${name} = ${value}`).join(", ");
  }

  /** What the runs of a place are given, with the present values of variables among it. */
  arguments(state, place) {
    return Object.entries(place.args ?? {}).map(([key, value]) => {
      const [now] = String(value).startsWith("$") ? valuesIn(state, value.slice(1), place.name).values() : [];
      return `${key} = ${valueText(value)}${now === undefined ? "" : ` (now ${now})`}`;
    }).join(", ");
  }

  /** What keeps a transition from firing, in words. */
  missing(state, transition) {
    const waits = [];
    for (const arc of state.task.arcs.filter((a) => a.transition === transition.name)) {
      const tokens = state.marking[arc.place] ?? 0;
      if (arc.direction === "in" && tokens < arc.weight) waits.push(`a token in ${words(arc.place)}`);
      else if (arc.direction === "in" && ["normal", "error"].includes(arc.end) && !ended(state, arc)) waits.push(`the end of the run in ${words(arc.place)}${arc.end === "error" ? " in error" : ""}`);
      else if (arc.direction === "inhibit" && tokens >= arc.weight) waits.push(`${words(arc.place)} to hold ${arc.weight > 1 ? `fewer than ${arc.weight} tokens` : "no token"}`);
    }
    for (const event of transition.events ?? []) if (!state.events[event.name]?.armed) waits.push(`the event ${words(event.name)}`);
    if (!waits.length && transition.when) return "can fire when its condition holds";
    if (!waits.length && transition.after) return `can fire after ${seconds(transition.after)}`;
    return waits.length ? `waits for ${waits.join(", ")}` : "";
  }
}
