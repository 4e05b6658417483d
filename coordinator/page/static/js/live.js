// The live view: tokens on the net, what runs now and why, what fired and why it failed, and the operator's hand.

import { Cameras, Devices } from "./camera.js";
import { Canvas, panel } from "./canvas.js";
import { Chart } from "./charts.js";
import { attribute, fill, h, Press, rows, seconds, text, valueText, words } from "./dom.js";
import { READABLE } from "./geometry.js";
import { icon } from "./icons.js";
import { Learning, objectives } from "./learning.js";
import { Selected } from "./selected.js";
import { Selectors } from "./selectors.js";
import { alarms, drawnOn, labelsOf, runsOn, sheetOf, tokensOf, trailOf } from "./sheet.js";
import { activeTime, Timeline } from "./timeline.js";

const FIRINGS_SHOWN = 25;
const FIRINGS_MS = 240;
const STATUS_ICON = { success: "check", failure: "warning", error: "error" };

export class Live {
  constructor(link, operator) {
    Object.assign(this, { link, operator, inside: "", stale: new Set() });
    this.canvas = new Canvas("Task net", {
      chosen: (element) => this.choose(element.name),
      opened: (element) => element.kind === "macro" && this.open(element.name),
      background: () => this.choose(null),
    });
    this.selected = new Selected(link, operator, (name) => this.open(name));
    this.running = panel("Running now", h("ul", { class: "cards" }));
    this.firings = panel("Last firings", h("ol", { class: "firings" }));
    this.press = new Press(this.firings.content);
    this.nodes = panel("Nodes", h("ul", { class: "nodes" }));
    this.selectors = new Selectors(link, operator);
    this.result = h("section", { class: "result", role: "status", hidden: true });
    this.side = h("aside", { class: "side", "aria-label": "Mission details" }, this.result, this.selected.root, this.running.root, this.firings.root, this.selectors.root, this.nodes.root);
    this.dock = new Dock(link, (place) => this.goTo(place), () => this.paintHeat());
    this.notice = h("p", { class: "empty-net" }, "No task is loaded.");
    this.canvas.root.append(this.notice);
    this.root = h("div", { class: "live" }, h("div", { class: "stage" }, this.canvas.root, this.dock.root), this.side);
    this.canvas.folded = () => this.paintMarks();
  }

  get view() {
    return this.canvas.view;
  }

  choose(name) {
    this.selected.choose(name);
    this.view.only("chosen", new Set(name ? [name] : []));
    this.view.focusable(name);
    this.selected.update(this.link.state, this.link.now());
  }

  open(macro) {
    this.inside = macro;
    this.draw();
    this.view.fit(READABLE);
  }

  draw() {
    const { task } = this.link.state;
    this.notice.hidden = Boolean(task);
    this.canvas.corner.hidden = !task;
    if (!task) this.canvas.errors.hidden = true;
    text(this.notice, this.link.state.mission.file === undefined ? "No task is loaded." : "Choose a task above, or draw one under Design.");
    if (!task) return;
    if (this.inside && !task.places.some((p) => p.name === this.inside)) this.inside = "";
    this.canvas.show(sheetOf(task, this.inside));
    const path = trailOf(task, this.inside);
    this.canvas.trail([task.name, ...path.map((p) => p.label)], (i) => this.open(i ? path[i - 1].name : ""));
    this.paintTokens();
    this.paintRuns();
    this.paintMarks();
    this.paintHeat();
  }

  /** Called at most once a frame with what has changed. */
  paint(changed, changes) {
    const all = changed.has("all");
    if (all) {
      this.view.flights.clear();
      for (const element of this.view.elements.values()) element.incoming = 0;
      const key = JSON.stringify(this.link.state.task);
      const first = this.taskKey !== key;
      this.taskKey = key;
      this.draw();
      if (first) this.view.fit(READABLE);
    }
    for (const change of changes) if (change.kind === "fired") this.fired(change.firing);
    if (all || changed.has("marking") || changed.has("firings")) this.paintTokens();
    if (all || changed.has("runs")) this.paintRuns();
    this.view.flights.freeze(Boolean(this.link.state.paused));
    for (const part of changed) this.stale.add(part);
    if (all || changed.has("paused") || changed.has("controls")) this.paintText();
  }

  /** Update lists and text ten times a second at most: people read no faster, and laying out text costs most. */
  paintText() {
    const changed = this.stale;
    if (!changed.size) return;
    this.canvas.follow();
    this.stale = new Set();
    const dirty = (...parts) => changed.has("all") || parts.some((part) => changed.has(part));
    if (dirty("firings", "breakpoints", "marking")) this.paintMarks();
    if (dirty("runs")) this.paintCards();
    if (dirty("firings")) this.paintFirings(changed.has("all"));
    if (dirty("nodes")) this.paintNodes();
    if (dirty("selectors")) this.selectors.paint();
    if (dirty("selectors")) this.paintHeat();
    if (dirty("result", "mission")) this.paintResult();
    if (dirty("marking", "runs", "breakpoints", "events", "controls", "firings", "variables", "connection")) this.selected.update(this.link.state, this.link.now());
    this.dock.paint(changed);
  }

  /** Called a few times a second for what moves with the clock. */
  tick(now) {
    this.paintText();
    this.paintClocks(now);
    this.dock.tick(now);
  }

  fired(firing) {
    const name = this.drawnAs(firing.transition);
    if (name) this.view.fire(name, Boolean(firing.error)); // a closed macro place lights up
  }

  /** How an element is called on the drawing. */
  labelOf(name) {
    const { task } = this.link.state;
    if (this.labelled !== task) [this.labelled, this.labels] = [task, task && labelsOf(task)];
    return this.labels?.get(name) ?? words(name);
  }

  /** What represents an element on the open sheet; null if it is outside. */
  drawnAs(name) {
    const { task } = this.link.state;
    if (this.view.elements.has(name) || !task) return this.view.elements.has(name) ? name : null;
    if (this.drawnKey !== `${this.taskKey} ${this.inside}`) {
      this.drawnKey = `${this.taskKey} ${this.inside}`;
      this.drawn = drawnOn(task, this.inside);
    }
    return this.drawn(name);
  }

  /** Go to an element, opening the macro place that it is in. */
  goTo(name) {
    const { task } = this.link.state;
    const element = [...(task?.places ?? []), ...(task?.transitions ?? [])].find((e) => e.name === name);
    if (element && !this.view.elements.has(name)) this.open(element.in_macro ?? "");
    return this.canvas.goTo(element?.made_from || name);
  }

  paintTokens() {
    const { task, marking } = this.link.state;
    if (!task) return;
    const shown = task.places.some((p) => p.kind === "macro") ? tokensOf(task, marking) : marking;
    for (const element of this.view.elements.values()) if (element.shape === "place") this.view.tokens(element.name, shown[element.name] ?? 0);
  }

  paintRuns() {
    const { runs, task } = this.link.state;
    if (!task) return;
    const shown = runsOn(task, runs, this.inside);
    for (const element of this.view.elements.values()) if (["action", "macro"].includes(element.kind)) this.view.run(element.name, shown.get(element.name));
  }

  paintCards() {
    const list = Object.values(this.link.state.runs);
    this.running.count(list.length || "");
    rows(this.running.content, list, (run) => run.id, (run) => this.runCard(run), (node, run) => this.updateCard(node, run));
    if (!list.length) this.running.content.dataset.empty = "No action is running.";
    else delete this.running.content.dataset.empty;
  }

  runCard(run) {
    const node = h("li", { class: "card", onclick: () => this.goTo(run.place) });
    node.parts = { action: h("strong"), where: h("span", { class: "chip" }), why: h("p", { class: "why" }), bar: h("progress", { max: 1 }), time: h("span", { class: "number" }), state: h("span", { class: "muted" }) };
    const { action, where, why, bar, time, state } = node.parts;
    node.append(h("div", { class: "line" }, action, where), why, bar, h("div", { class: "line" }, state, time));
    return node;
  }

  updateCard(node, run) {
    node.run = run;
    const { action, where, why, bar, state } = node.parts;
    text(action, words(run.action));
    text(where, run.node);
    text(why, [run.primitive_task && run.primitive_task !== run.action ? `for ${words(run.primitive_task)}` : "", run.why].filter(Boolean).join(": "));
    bar.hidden = (run.progress ?? null) === null; // an empty bar would look like an action that is stuck
    if (!bar.hidden && bar.value !== run.progress) bar.value = run.progress;
    text(state, words(run.state ?? "running"));
    attribute(node, "data-state", run.state ?? "running");
    this.cardClock(node, this.link.now());
  }

  cardClock(node, now) {
    const { run } = node;
    const limit = run.deadline ? ` of ${seconds(run.deadline)}` : "";
    const used = activeTime(run, now);
    text(node.parts.time, Number.isFinite(run.started) ? `${seconds(used)}${limit}` : "");
    attribute(node, "data-late", run.deadline && used > 0.8 * run.deadline ? "" : null);
  }

  paintClocks(now) {
    for (const node of this.running.content.children) if (node.run) this.cardClock(node, now);
  }

  paintMarks() {
    const { breakpoints, firings, marking, task } = this.link.state;
    const stops = new Set(breakpoints.map((b) => b.replace(/^(places|transitions)\./, "")));
    const failed = new Map();
    for (const firing of firings.slice(-FIRINGS_SHOWN)) if (firing.error) failed.set(this.drawnAs(firing.transition), firing);
    for (const element of this.view.elements.values()) {
      this.view.mark(element.name, "breakpoint", stops.has(element.name) ? "breakpoint" : null, "Breakpoint");
      const why = failed.get(element.name);
      if (element.shape === "transition" || element.kind === "macro") this.view.mark(element.name, "reason", why ? "failed" : null, why ? reasonText(why) : "");
    }
    if (task) this.canvas.alarm(alarms(task, marking, this.inside, (name) => this.view.sees(name), firings.map((f) => f.transition)));
  }

  paintFirings(now = true) {
    if (this.press.holds(() => this.paintFirings())) return null;
    // each new row shifts all others: a busy net is read at four lists a second
    if (!now && performance.now() - (this.firingsAt ?? 0) < FIRINGS_MS) return this.stale.add("firings");
    this.firingsAt = performance.now();
    const { firings, mission } = this.link.state;
    const list = firings.slice(-FIRINGS_SHOWN).reverse();
    this.firings.count(mission.firings ?? "");
    rows(this.firings.content, list, (f) => `${mission.id} ${f.number}`, (f) => this.firingRow(f)); // each run counts from 1
    if (!list.length) this.firings.content.dataset.empty = "Nothing has fired yet.";
    else delete this.firings.content.dataset.empty;
    return null;
  }

  firingRow(firing) {
    const reason = reasonText(firing);
    const what = firing.error ? "error" : firing.reason?.status === "failure" ? "failure" : "plain";
    return h("li", { class: `firing ${what}` },
      h("button", { type: "button", onclick: () => this.goTo(firing.transition) },
        h("span", { class: "line" }, h("strong", {}, this.labelOf(firing.transition)), h("span", { class: "number" }, seconds(firing.at))),
        h("span", { class: "cause" }, words(firing.cause ?? "")),
        reason ? h("span", { class: "reason" }, icon(firing.error ? "error" : "warning"), h("span", {}, reason)) : null));
  }

  paintNodes() {
    const list = Object.entries(this.link.state.nodes);
    this.nodes.count(list.length ? `${list.filter(([, n]) => n.state === "up").length} of ${list.length} up` : "");
    rows(this.nodes.content, list, ([name]) => name, () => h("li", { class: "node" }, h("i", { class: "lamp" }), h("strong"), h("span", { class: "detail" }), h("span", { class: "number" })), (row, [name, node]) => {
      attribute(row, "data-state", node.state);
      const [, title, detail, number] = row.children;
      text(title, name);
      text(detail, node.state === "up" ? (node.held ? words(node.held) : "") : `${words(node.state)}${node.text ? `: ${node.text}` : ""}`);
      text(number, Number.isFinite(node.round_trip) && node.state === "up" ? `${(node.round_trip * 1000).toFixed(1)} ms` : "");
    });
    if (!list.length) this.nodes.content.dataset.empty = "No node is known.";
    else delete this.nodes.content.dataset.empty;
  }

  /** The places coloured by the J of their primitive task, while that is switched on. */
  paintHeat() {
    const { task, selectors } = this.link.state;
    const shares = this.dock.learning.hot ? objectives(selectors) : {};
    const primitive = new Map((task?.places ?? []).map((p) => [p.name, p.primitive_task]));
    for (const element of this.view.elements.values()) {
      if (element.kind !== "action") continue;
      const share = shares[primitive.get(element.name)];
      element.node.classList.toggle("hot", share !== undefined);
      element.node.style.setProperty("--heat", `${Math.round(70 * Math.max(0, Math.min(1, share ?? 0)))}%`);
    }
    this.dock.learning.update(this.link.state);
  }

  paintResult() {
    const { result, mission } = this.link.state;
    const over = ["success", "failure", "error", "aborted", "stopped"].includes(mission.state);
    this.result.hidden = !over;
    if (!over) return;
    attribute(this.result, "data-state", mission.state);
    const head = { success: "The task reached its final marking", failure: "The task ended in failure", error: "The task ended in error", aborted: "The task was aborted", stopped: "Emergency stop" }[mission.state];
    const said = ["task", "status", "reason"]; // above already
    const facts = Object.entries(result ?? {}).filter(([k, v]) => !said.includes(k) && ["number", "string", "boolean"].includes(typeof v));
    const value = (k, v) => (typeof v !== "number" ? String(v) : k.endsWith("_s") ? seconds(v) : +v.toPrecision(4));
    fill(this.result, h("h2", {}, icon(STATUS_ICON[mission.state] ?? "error"), head), mission.reason ? h("p", {}, mission.reason) : null,
      facts.length ? h("dl", {}, facts.map(([k, v]) => h("div", {}, h("dt", {}, k === "sim_s" ? "took" : words(k.replace(/_s$/, ""))), h("dd", {}, value(k, v))))) : null);
  }

  controlsChanged() {
    this.selectors.paint();
    this.selected.update(this.link.state, this.link.now(), true);
  }
}

/** Why a firing came from a run that did not succeed, as one sentence. */
export function reasonText(firing) {
  const { reason } = firing;
  if (!reason || (!reason.code && !reason.text)) return "";
  const who = firing.action ? `${words(firing.action)}${firing.node ? ` on ${firing.node}` : ""}: ` : "";
  const done = reason.executed && reason.executed !== "yes" ? ` (executed: ${reason.executed})` : "";
  return `${who}${reason.text || words(reason.code)}${reason.code && reason.text ? ` [${reason.code}]` : ""}${done}`;
}

/** The variables, and then a line for each place: how its last run ended, as conditions read it. */
function valuesShown({ variables }) {
  const runs = new Map();
  for (const [name, value] of Object.entries(variables)) {
    const place = name.includes(".") ? name.slice(0, name.lastIndexOf(".")) : "";
    if (place && value !== "") runs.set(place, [...(runs.get(place) ?? []), `${name.slice(place.length + 1)} ${valueText(value)}`]);
  }
  const own = Object.entries(variables).filter(([name]) => !name.includes("."));
  return Object.fromEntries([...own, ...[...runs].map(([place, said]) => [`last run of ${place}`, said.join(", ")])]);
}

/** The lower part: timeline, set points, images, devices, learning, variables. */
class Dock {
  constructor(link, chosen, heated) {
    this.link = link;
    this.timeline = new Timeline(chosen);
    this.latency = new Chart("Age of the newest set point when it was used", "mission time (s)", "age (ms)");
    this.cameras = new Cameras();
    this.devices = new Devices();
    this.learning = new Learning(heated);
    this.table = h("div", { class: "variables" });
    this.events = h("div", { class: "variables" });
    const pages = { Timeline: this.timeline.root, "Set points": this.latency.root, Camera: this.cameras.root, Devices: this.devices.root, Learning: this.learning.root, Variables: this.table, Events: this.events };
    this.pages = pages;
    this.tabs = h("div", { class: "tabs", role: "tablist", "aria-label": "Details" }, Object.keys(pages).map((name) =>
      h("button", { type: "button", role: "tab", id: `tab-${name.replace(" ", "-")}`, onclick: () => this.show(name), onkeydown: (e) => this.move(e) }, name)));
    this.tabs.append(this.timeline.choice);
    this.body = h("div", { class: "dock-body" }, Object.entries(pages).map(([name, page]) => h("div", { role: "tabpanel", "aria-labelledby": `tab-${name.replace(" ", "-")}`, hidden: true }, page)));
    this.root = h("section", { class: "dock", "aria-label": "Details" }, this.tabs, this.body);
    this.show("Timeline");
  }

  show(name) {
    this.shown = name;
    this.timeline.choice.hidden = name !== "Timeline";
    Object.keys(this.pages).forEach((key, i) => {
      this.tabs.children[i].setAttribute("aria-selected", String(key === name));
      this.tabs.children[i].tabIndex = key === name ? 0 : -1;
      this.body.children[i].hidden = key !== name;
    });
    this.paint(new Set(["all"]));
    this.tick(this.link.now());
  }

  move(event) {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const names = Object.keys(this.pages);
    const next = names[(names.indexOf(this.shown) + step + names.length) % names.length];
    this.show(next);
    this.tabs.children[names.indexOf(next)].focus();
  }

  paint(changed) {
    const { state } = this.link;
    const dirty = (part) => changed.has("all") || changed.has(part);
    if (this.shown === "Set points" && dirty("setpoints")) this.paintLatency(state.setpoints);
    if (this.shown === "Camera" && dirty("images")) this.cameras.update(state.images);
    if (this.shown === "Devices" && dirty("devices")) this.devices.update(state.devices);
    if (this.shown === "Learning" && (dirty("reports") || dirty("selectors"))) this.learning.update(state);
    if (this.shown === "Variables" && dirty("variables")) this.paintTable(this.table, valuesShown(state), "No variable is known.");
    if (this.shown === "Events" && dirty("events")) this.paintEvents(state);
  }

  tick(now) {
    if (this.shown !== "Timeline") return;
    const { state } = this.link;
    const key = `${now.toFixed(2)} ${state.sequence} ${document.documentElement.dataset.theme}`;
    if (key === this.timelineKey) return;
    this.timelineKey = key;
    const lanes = (state.task?.places ?? []).filter((p) => p.kind === "action");
    this.timeline.set(lanes, state.ended, Object.values(state.runs), now);
  }

  paintLatency(setpoints) {
    const streams = Object.keys(setpoints);
    const times = [...new Set(streams.flatMap((n) => setpoints[n].samples.map(([t]) => t)))].sort((a, b) => a - b);
    const columns = streams.map((n) => {
      const by = new Map(setpoints[n].samples);
      return times.map((t) => (Number.isFinite(by.get(t)) ? by.get(t) * 1000 : null));
    });
    this.latency.set(streams.length ? streams : ["no stream yet"], streams.length ? [times, ...columns] : [[0, 1], [null, null]]);
  }

  paintTable(host, values, empty) {
    const list = Object.entries(values);
    if (!list.length) return fill(host, h("p", { class: "empty" }, empty));
    return fill(host, h("table", {}, h("tbody", {}, list.map(([name, value]) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, valueText(value)))))));
  }

  paintEvents(state) {
    const list = Object.entries(state.events);
    if (!list.length) return fill(this.events, h("p", { class: "empty" }, "This task declares no events."));
    return fill(this.events, h("table", {}, h("tbody", {}, list.map(([name, e]) => h("tr", {}, h("th", { scope: "row" }, words(name)), h("td", {}, `${e.scope ?? "external"}, ${e.memory ?? "pulse"}`), h("td", {}, e.armed ? "set" : ""), h("td", {}, e.last !== undefined && e.last !== null ? `last at ${seconds(e.last)}` : "never came"), h("td", {}, e.count ? `${e.count} times` : ""))))));
  }
}
