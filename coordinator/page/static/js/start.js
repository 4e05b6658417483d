// Dialogs before a start: the options of `petrobot run` as a form; a point of a recorded run; clearing an emergency stop.

import { openDialog } from "./dialog.js";
import { fill, h, words } from "./dom.js";

const MODE_WORD = { realtime: "on the cell, in real time", lockstep: "simulated, in lock step" };
const PACE = [["1", "real time"], ["10", "ten times as fast"], ["0", "as fast as possible"]];
const CREDIT_WORD = { action: "how its own run ended", task: "whether the task met its goal" };
const GOING = [["again", "starts again"], ["success", "finished: success"], ["failure", "finished: failure"], ["error", "finished: error"]];

const select = (label, options, chosen, onchange) =>
  h("select", { "aria-label": label, onchange }, options.map(([value, text]) => h("option", { value, selected: value === chosen }, text)));
const field = (label, control, remark = "") => h("label", { class: "field" }, h("span", {}, label), control, remark ? h("small", {}, remark) : null);
const whole = (label, value, least) => h("input", { type: "number", step: 1, min: least, value: value ?? "", "aria-label": label });

/** A number field's value; undefined when it is empty. Throws an error that says what is wrong. */
function numberIn(input, label) {
  if (input.validity.badInput) throw new Error(`${label}: expected a number`);
  return input.value.trim() === "" ? undefined : Number(input.value);
}

/** A dialog with a form; `send(values)` resolves with the server's answer. It stays open with the reason when it was refused. */
function formDialog(title, label, content, values, send) {
  const fault = h("p", { class: "refused", role: "alert", hidden: true });
  const submit = h("button", { type: "submit", class: "command primary" }, label);
  const tell = (text) => {
    fault.hidden = !text;
    fault.textContent = text;
  };
  const form = h("form", { method: "dialog", class: "start-form", novalidate: true, onsubmit: async (event) => {
    event.preventDefault();
    submit.disabled = true;
    tell("");
    try {
      const answer = await send(values());
      if (answer.ok) return dialog.close();
      tell(answer.text ?? answer.code ?? "refused");
    } catch (error) {
      tell(error.message);
    } finally {
      submit.disabled = false;
    }
    return undefined;
  } }, h("h2", {}, title), content,
  h("div", { class: "foot" }, fault, h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => dialog.close() }, "Cancel"), submit)));
  const dialog = fill(h("dialog", { "aria-label": title }), form);
  openDialog(dialog);
  return dialog;
}

class Parameter {
  constructor(about) {
    this.about = about;
    const label = words(about.name);
    const text = { value: String(about.default), "aria-label": label };
    if (about.type === "bool") this.input = h("input", { type: "checkbox", checked: about.default, "aria-label": label });
    else if (about.type === "str") this.input = h("input", { type: "text", ...text });
    else this.input = h("input", { type: "number", step: about.type === "int" ? 1 : "any", ...text });
    this.root = about.type === "bool"
      ? h("label", { class: "tick" }, this.input, label, about.text ? h("small", {}, about.text) : null)
      : field(label, this.input, about.text);
  }

  get value() {
    if (this.about.type === "bool") return this.input.checked;
    return this.about.type === "str" ? this.input.value : numberIn(this.input, words(this.about.name));
  }
}

/** The options for starting a run; `send(data)` gives the command. */
export function startDialog(about, task, send) {
  const runs = about.runs && whole("Number of runs", about.runs.default, 1);
  const seed = whole("Seed", about.seed, 0);
  const pace = select("Pace", PACE, "1");
  const paced = field("Pace", pace);
  const mode = select("Where", about.modes.map((m) => [m, MODE_WORD[m] ?? m]), about.modes[0], () => (paced.hidden = mode.value !== "lockstep"));
  paced.hidden = true;
  const parameters = about.parameters.map((p) => new Parameter(p));
  const learning = new LearningPart(about.learn);
  const values = () => {
    const data = { task, mode: mode.value, seed: numberIn(seed, "Seed"), runs: runs ? numberIn(runs, "Number of runs") : undefined };
    data.parameters = Object.fromEntries(parameters.map((p) => [p.about.name, p.value]).filter(([, v]) => v !== undefined));
    if (mode.value === "lockstep") data.pace = Number(pace.value);
    if (learning.wanted) data.learn = learning.value;
    return data;
  };
  const group = (name, list) => (list.length ? h("fieldset", {}, h("legend", {}, name), list) : null);
  return formDialog(`Start ${words(task)}`, "Start", [
    h("div", { class: "two" }, field("Where", mode), paced), h("div", { class: "two" }, runs ? field("Number of runs", runs) : null, field("Random seed", seed)),
    group("Parameters of the task", parameters.map((p) => p.root)), learning.root,
  ], values, send);
}

class LearningPart {
  constructor(about) {
    this.on = h("input", { type: "checkbox", onchange: () => this.show() });
    this.file = h("input", { type: "text", "aria-label": "Estimates file", list: "estimates-known", value: about.estimates[0] ?? "learned" });
    this.selector = select("Selector", about.selectors.map((name) => [name, words(name)]), about.selector);
    this.credit = select("Credit", about.credits.map((name) => [name, CREDIT_WORD[name] ?? name]), about.credits[0]);
    this.target = h("input", { type: "number", min: 0, max: 1, step: "any", "aria-label": "Target reliability", placeholder: "none" });
    this.contexts = h("input", { type: "text", "aria-label": "Learn separately for each", value: about.contexts.join(", ") });
    this.frozen = h("input", { type: "checkbox" });
    this.inner = h("div", { class: "inner", hidden: true },
      h("div", { class: "two" }, field("Estimates file", this.file, "a name without a path; the coordinator keeps the file"), field("Selector", this.selector)),
      h("div", { class: "two" }, field("Credit", this.credit, "what judges a choice"), field("Target reliability", this.target, "choose only among alternatives that reach it")),
      field("Learn separately for each", this.contexts, "parameters, variables or conditions"),
      h("label", { class: "tick" }, this.frozen, "Frozen: use the best alternatives learned so far, learn nothing new"),
      h("datalist", { id: "estimates-known" }, about.estimates.map((name) => h("option", { value: name }))));
    this.root = h("fieldset", {}, h("legend", {}, "Learning"), h("label", { class: "tick" }, this.on, "Learn which actions are best"), this.inner);
  }

  show() {
    this.inner.hidden = !this.on.checked;
  }

  get wanted() {
    return this.on.checked;
  }

  get value() {
    const contexts = this.contexts.value.split(",").map((c) => c.trim()).filter(Boolean);
    return { file: this.file.value.trim(), selector: this.selector.value, credit: this.credit.value, target: numberIn(this.target, "Target reliability"), contexts, frozen: this.frozen.checked };
  }
}

/** A simulated run from a record: how the actions that were active then continue. */
export function simulateDialog(run, record, going, labelOf, send) {
  const chosen = going.map((place) => [place, select(`Run in ${labelOf(place)}`, GOING, "again")]);
  const seed = whole("Seed", run.seed, 0);
  const pace = select("Pace", PACE, "1");
  const values = () => ({
    mode: "lockstep", seed: numberIn(seed, "Seed"), pace: Number(pace.value),
    from: { run: run.id, record, going: Object.fromEntries(chosen.map(([place, box]) => [place, box.value])) },
  });
  const told = record ? `after record ${record}` : "from its beginning";
  return formDialog("Simulate from here", "Simulate", [
    h("p", { class: "muted" }, `A new run in lock step continues the task of ${run.id} ${told}. Tokens, finished actions, variables and latched events are as they were then. The simulated world is not: it starts from its usual beginning.`),
    chosen.length ? h("fieldset", {}, h("legend", {}, "Actions that were running"), chosen.map(([place, box]) => field(labelOf(place), box))) : h("p", {}, "No action was running at that moment."),
    h("div", { class: "two" }, field("Random seed", seed), field("Pace", pace)),
  ], values, send);
}

/** Ask for confirmation before devices accept orders again. */
export function clearDialog(reason, send) {
  return formDialog("Clear the emergency stop?", "Clear the stop", [
    reason ? h("p", {}, reason) : null,
    h("p", { class: "muted" }, "Devices accept commands again; clearing the stop moves nothing by itself. First make sure that no one is within reach of the devices and that the cause of the stop is repaired. You must hold the controls."),
  ], () => ({}), send);
}
