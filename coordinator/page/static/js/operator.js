// The operator's controls: mission commands, who holds the controls, and the emergency stop that is always there.

import { attribute, fill, h, Press, seconds, text, words } from "./dom.js";
import { listTasks, startForm, stopPastTheLink } from "./files.js";
import { icon } from "./icons.js";
import { clearDialog, startDialog } from "./start.js";
import { toast } from "./toast.js";

const ESTOP_KEY = "F9";
const SLOW_MS = 2000; // a command that waits longer, such as for a slow disk, says so
const STOP_MS = 1500; // without an answer for so long, an emergency stop takes another way

const ABOUT_CONTROLS = ["take_controls", "ask_controls", "release_controls"]; // all other commands take free controls
const DONE = {
  start: "Started", pause: "Paused", resume: "Continued", step: "Continued for one firing", abort: "Aborted", estop: "Emergency stop sent",
  add_tokens: "Token added", remove_tokens: "Token removed", raise_event: "Event raised", force_exit: "Transition forced",
  take_controls: "You hold the controls", ask_controls: "Asked for the controls", release_controls: "Controls released",
  load: "Task loaded", clear_estop: "Emergency stop cleared", override_selector: "Selector set", breakpoint: "Breakpoint set",
};
const STATE_WORD = {
  idle: "Idle", preparing: "Preparing", running: "Running", stopping: "Stopping", paused: "Paused", success: "Success",
  failure: "Failure", error: "Error", aborted: "Aborted", stopped: "Emergency stop",
};
const PAUSE_WORD = { step: "Paused after one firing" };
const HELD_WORD = { held: "held", idle: "no action to hold", cannot_hold: "cannot hold", stopped: "stopped", lost: "no answer" };

/** What a pause was answered by each node, for people. */
const heldWords = (nodes) => Object.entries(nodes ?? {}).map(([node, answer]) => `${node}: ${HELD_WORD[answer] ?? answer}`).join(", ");

const stateOf = (state) => (state.paused && ["running", "stopping"].includes(state.mission.state) ? "paused" : state.mission.state);
const stateWord = (state) => STATE_WORD[stateOf(state)] ?? words(stateOf(state));

export class Operator {
  constructor(link) {
    this.link = link;
    const button = (verb, name, label, extra = {}) =>
      h("button", { type: "button", class: "command", onclick: () => this.give(verb, {}), ...extra }, icon(name), h("span", {}, label));
    this.buttons = {
      start: button("start", "play", "Start", { class: "command primary" }),
      pause: button("pause", "pause", "Pause"),
      step: button("step", "step", "Step"),
      resume: button("resume", "resume", "Continue"),
      abort: button("abort", "abort", "Abort", { class: "command danger", onclick: () => this.confirm(this.buttons.abort, "Abort the mission?", () => this.give("abort", {})) }),
    };
    this.clear = button("clear_estop", "check", "Clear the stop", { hidden: true, onclick: () => this.clearStop() });
    this.options = h("button", { type: "button", class: "command", hidden: true, "aria-haspopup": "dialog", onclick: () => this.startWith() }, icon("more"), h("span", {}, "Start with"));
    this.picker = h("select", { class: "pick-task", "aria-label": "Task to start", onchange: () => (this.loading = this.load()), onfocus: () => this.listTasks() });
    this.controls = h("div", { class: "holder" });
    this.press = new Press(this.controls);
    this.answer = h("p", { class: "pause-note", role: "status" });
    this.bar = h("div", { class: "operator", role: "toolbar", "aria-label": "Mission" }, this.picker, this.clear, this.buttons.start, this.options, Object.values(this.buttons).slice(1), this.controls);
    this.estop = h("button", { type: "button", class: "estop", "aria-keyshortcuts": ESTOP_KEY, onclick: () => this.stopNow() },
      icon("stop"), h("span", {}, "Emergency stop"), h("kbd", {}, ESTOP_KEY));
    addEventListener("keydown", (event) => {
      if (event.key !== ESTOP_KEY) return;
      event.preventDefault();
      if (!event.repeat) this.stopNow();
    }, { capture: true });
  }

  /** Give a command and tell how it was answered. */
  async give(verb, data, silent = false, shown = false) {
    const name = this.buttons[verb]?.textContent || words(verb);
    const held = ABOUT_CONTROLS.includes(verb) ? { ok: true } : await this.hold();
    let waits = null;
    const slow = setTimeout(() => (waits = toast("waiting", `${name}: waiting for the coordinator's answer`)), SLOW_MS);
    const answer = held.ok ? await this.link.command(verb, data) : held;
    clearTimeout(slow);
    waits?.remove();
    if (!answer.ok && shown) return answer; // the dialog that asked shows why
    if (!answer.ok) toast("error", `${name}: ${answer.text ?? answer.code ?? "refused"}`);
    else if (!silent) toast("ok", [DONE[verb] ?? words(verb), answer.text, verb === "pause" ? heldWords(answer.nodes) : ""].filter(Boolean).join(" · "));
    return answer;
  }

  /** Take the controls if they are free. */
  async hold() {
    const { controls, you } = this.link.state;
    if (controls.holder === you) return { ok: true };
    return controls.holder === null ? this.link.command("take_controls", {}) : { ok: false, text: this.link.barred };
  }

  async stopNow() {
    this.estop.classList.add("given");
    setTimeout(() => this.estop.classList.remove("given"), STOP_MS);
    // A connection that breaks is noticed seconds later. A stop is sent twice rather than that late: it changes nothing twice
    const late = new Promise((resolve) => setTimeout(resolve, STOP_MS, {}));
    const answer = await Promise.race([this.link.command("estop"), late]);
    if (answer.ok) toast("ok", [DONE.estop, answer.text].filter(Boolean).join(" · "));
    else if (answer.code && answer.code !== "lost") toast("error", `${answer.text}. Use the emergency stop of the hardware.`);
    else if (await stopPastTheLink()) toast("ok", this.link.connected ? DONE.estop : `${DONE.estop}; this page cannot see its effect`);
    else toast("error", "No connection to the coordinator. Use the emergency stop of the hardware.");
  }

  /** Ask how the run is to go before it is started. */
  async startWith() {
    if (this.asking) return; // a second press, while the server is asked for the options
    this.asking = true;
    try {
      await this.loading; // of the task that was picked just now
      const { file, revision } = this.link.state.mission;
      const about = file ? await startForm(file) : null;
      if (about) startDialog(about, file, (data) => this.give("start", { ...data, revision }, false, true));
    } finally {
      this.asking = false; // also when an answer fails: the button must work again
    }
  }

  clearStop() {
    clearDialog(this.link.state.mission.reason, () => this.give("clear_estop", {}, false, true));
  }

  /** A second press within three seconds carries out what cannot be undone. */
  confirm(button, question, act) {
    const label = button.querySelector("span") ?? button.lastChild;
    const rest = () => {
      label.textContent = button.dataset.asked;
      delete button.dataset.asked;
    };
    if (button.dataset.asked) {
      rest();
      act();
      return;
    }
    button.dataset.asked = label.textContent;
    label.textContent = question;
    setTimeout(() => button.dataset.asked && rest(), 3000);
  }

  update(state) {
    const may = !this.link.barred;
    const now = stateOf(state);
    const live = ["running", "paused", "stopping"].includes(now);
    const set = { start: may && !live && now !== "preparing" && now !== "stopped", pause: may && now === "running", step: may && now === "paused", resume: may && now === "paused", abort: may && live };
    for (const [verb, on] of Object.entries(set)) this.buttons[verb].disabled = !on;
    this.showTasks(state, may && !live && now !== "preparing");
    this.buttons.start.hidden = state.mission.starts === false || now === "stopped"; // in its place: Clear the stop
    this.buttons.start.disabled ||= !state.task;
    this.options.hidden = this.buttons.start.hidden || !state.mission.file;
    this.options.disabled = this.buttons.start.disabled;
    this.clear.hidden = now !== "stopped";
    this.clear.disabled = !may;
    for (const button of [...Object.values(this.buttons), this.options, this.clear]) attribute(button, "title", (button.disabled && this.link.barred) || null);
    this.estop.disabled = false;
    this.showPause(state);
    this.showHolder(state);
  }

  /** The tasks that can be started, where this coordinator stays for more than one run. */
  showTasks(state, may) {
    const { mission } = state;
    this.picker.hidden = mission.file === undefined;
    this.picker.disabled = !may;
    attribute(this.picker, "title", this.link.barred || null);
    const key = `${mission.file}`;
    if (this.picker.hidden || this.tasksKey === key) return;
    this.tasksKey = key;
    this.listTasks();
  }

  async listTasks() {
    const tasks = await listTasks();
    const { file } = this.link.state.mission;
    const known = tasks.map((t) => [t.name, t.own === false ? `${words(t.name)} (shipped)` : words(t.name)]);
    if (file && !tasks.some((t) => t.name === file)) known.unshift([file, words(file)]);
    fill(this.picker, h("option", { value: "" }, "Choose a task"), known.map(([value, label]) => h("option", { value }, label)));
    this.picker.value = file ?? "";
  }

  async load() {
    const task = this.picker.value;
    const answer = task ? await this.give("load", { task }, true) : { ok: false };
    if (!answer.ok) this.picker.value = this.link.state.mission.file ?? "";
  }

  showPause(state) {
    const { paused, you } = state;
    const reason = paused?.reason === `by ${you}` ? "Paused by you" : PAUSE_WORD[paused?.reason] ?? (paused?.reason ? `Paused: ${words(paused.reason)}` : "Paused");
    text(this.answer, paused ? [reason, heldWords(paused.nodes)].filter(Boolean).join(". ") : "");
  }

  showHolder(state) {
    const { controls, you } = state;
    const key = JSON.stringify([controls, you, this.link.connected]);
    if (this.holderKey === key || this.press.holds(() => this.showHolder(this.link.state))) return;
    this.holderKey = key;
    const mine = controls.holder === you;
    const asking = (controls.asking ?? []).filter((who) => who !== you);
    // Beside "Hand over to ..." it goes without saying, and a small window has no room for both
    const held = asking.length ? "" : "You hold the controls";
    const label = controls.holder === null ? "The controls are free" : mine ? held : `${controls.holder} holds the controls`;
    const actions = [];
    if (controls.holder === null) actions.push(this.small("Take controls", () => this.give("take_controls", {})));
    else if (mine) {
      for (const who of asking) actions.push(this.small(`Hand over to ${who}`, () => this.give("release_controls", { to: who })));
      actions.push(this.small("Release", () => this.give("release_controls", {})));
    } else if ((controls.asking ?? []).includes(you)) actions.push(h("span", { class: "muted" }, "asked"));
    else actions.push(this.small("Ask for controls", () => this.give("ask_controls", {})));
    fill(this.controls, h("span", { class: mine ? "mine" : "theirs" }, icon(mine ? "hand" : "eye"), label), actions);
  }

  small(label, onclick) {
    return h("button", { type: "button", class: "small", onclick }, label);
  }
}

/** The mission in one line: state, task, time. */
export class Banner {
  constructor() {
    this.state = h("span", { class: "state" });
    this.task = h("span", { class: "task-name" });
    this.time = h("span", { class: "time", "aria-live": "off" }); // read out with each change of the rest, not each second
    this.mode = h("span", { class: "mode", hidden: true });
    this.root = h("div", { class: "banner", role: "status", "aria-label": "Mission state" }, this.state, this.task, this.mode, this.time);
  }

  tick(now) {
    text(this.time, now < 100 ? `${now.toFixed(1)} s` : seconds(now));
  }

  update(state) {
    attribute(this.root, "data-state", stateOf(state));
    text(this.state, stateWord(state));
    text(this.task, words(state.task?.name ?? "no task"));
    const { from, mode, id, plant } = state.mission;
    const unreal = { mock: "scripted actions", "dry-run": "dry run" }[plant];
    this.mode.hidden = (mode !== "lockstep" && !unreal) || !id;
    text(this.mode, [from ? `from record ${from.record}` : mode === "lockstep" ? "simulated" : "", unreal].filter(Boolean).join(", "));
    attribute(this.mode, "title", from ? `simulated from ${from.run}` : null);
  }
}
