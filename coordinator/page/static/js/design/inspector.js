// The form for what is chosen in the designer: an element, an arc, several elements, or the task itself.

import { fill, h, keep, Press, words } from "../dom.js";
import { icon } from "../icons.js";
import { toast } from "../toast.js";
import { align, distribute, layOut } from "./arrange.js";
import { events, variables } from "./declared.js";
import { actionsOf, scopeOf, taskOf } from "./drawn.js";
import { around, groups, within } from "./macros.js";
import { MADE } from "./model.js";
import { readValue, writeValue } from "./values.js";

const KINDS = ["plain", "action", "resource", "control", "macro"];
const ENDS = { normal: "normal: the run ended in success or failure", error: "error: the run ended in error", preempt: "preempt: cancel a run that is still active", going: "going: only while a run is active; it continues" };
const COUNTS = ["success", "failure", "error", "none"];
const VALUE_HINT = "a number, \"text\", true, or $variable";

export class Inspector {
  constructor(designer) {
    this.designer = designer;
    this.root = h("aside", { class: "inspector", "aria-label": "Properties" });
    this.press = new Press(this.root);
    this.root.addEventListener("focusin", () => this.later && this.draw()); // before anything is typed into the next field
  }

  get model() {
    return this.designer.model;
  }

  /** Draw the form for the selection {names, arc}; a form that is being typed into stays, one that is pressed stays until then. */
  show(selection, force = false) {
    const typing = this.root.contains(document.activeElement) && ["INPUT", "TEXTAREA"].includes(document.activeElement.tagName);
    const key = JSON.stringify([[...selection.names], selection.arc?.id, this.model.sheet]);
    const same = key === this.key && !force;
    if (same && (typing || this.press.holds(() => this.show(this.designer.selection)))) return;
    // a field reports its change before the focus moves to the next field, which must still exist then
    if (this.changing) this.later = setTimeout(() => this.draw());
    else this.draw();
    this.key = key;
  }

  draw() {
    clearTimeout(this.later);
    this.later = 0;
    const { selection } = this.designer;
    const [name] = selection.names;
    const chosen = selection.arc?.transition ?? (selection.names.size === 1 ? name : null);
    if (chosen && !this.model.has(chosen)) fill(this.root, [this.head("Transition", chosen), h("p", { class: "muted" }, MADE)]);
    else if (selection.arc) fill(this.root, this.arc(selection.arc));
    else if (selection.names.size > 1) fill(this.root, this.several(selection.names));
    else if (name && this.model.place(name)) fill(this.root, this.place(name, this.model.place(name)));
    else if (name && this.model.transition(name)) fill(this.root, this.transition(name, this.model.transition(name)));
    else fill(this.root, this.task());
  }

  // ---- fields -------------------------------------------------------------------------------------------------------

  field(label, control, hint) {
    return h("label", { class: "field" }, h("span", {}, label), control, hint ? h("small", {}, hint) : null);
  }

  input(value, onchange, properties = {}) {
    const put = (event) => {
      this.changing = true;
      onchange(event.target.value, event);
      this.changing = false;
    };
    return h("input", { value: value ?? "", onchange: put, onkeydown: (e) => { keep(e); if (e.key === "Enter") e.target.blur(); if (e.key === "Escape") { e.target.value = value ?? ""; e.target.blur(); } }, spellcheck: "false", autocomplete: "off", ...properties });
  }

  number(value, onchange, properties = {}) {
    return this.input(value, (text) => onchange(text.trim() === "" ? null : Number(text)), { type: "number", ...properties });
  }

  choice(value, options, onchange, properties = {}) {
    const select = h("select", { onchange: (e) => onchange(e.target.value), ...properties }, options.map(([key, label]) => h("option", { value: key }, label)));
    select.value = value ?? "";
    return select;
  }

  name(name) {
    return this.field("Name", this.input(name, (to, event) => {
      const fault = this.model.rename(name, to.trim());
      if (fault) {
        toast("warning", fault);
        event.target.value = name;
      } else this.designer.choose(new Set([to.trim()]));
    }, { class: "name" }));
  }

  head(kind, name) {
    return h("h2", {}, h("span", { class: "kind" }, kind), words(name), this.findings(name));
  }

  findings(name) {
    const list = this.designer.findings.of(name);
    return list.length ? h("ul", { class: "faults" }, list.map((f) => h("li", { class: f.severity }, icon(f.severity === "error" ? "error" : "warning"), h("span", {}, f.text, f.remedy ? h("em", {}, f.remedy) : null)))) : null;
  }

  // ---- forms --------------------------------------------------------------------------------------------------------

  place(name, place) {
    const set = (fields) => this.model.set(name, fields);
    const kind = this.field("Kind", this.choice(place.kind ?? "plain", KINDS.map((k) => [k, k]), (k) => set({ kind: k === "plain" ? null : k })));
    const common = [
      this.field("Tokens at the start", this.number(place.tokens ?? 0, (n) => set({ tokens: n || null }), { min: 0 })),
      place.kind === "action" ? this.field("Runs at once", this.number(place.servers, (n) => set({ servers: n }), { min: 1, placeholder: "1" })) : this.field("Capacity", this.number(place.capacity, (n) => set({ capacity: n }), { min: 1, placeholder: "unlimited" })),
    ];
    const own = place.kind === "action" ? this.actionFields(name, place) : place.kind === "macro" ? this.macroFields(name, place) : [];
    const holds = place.kind === "macro" ? null : h("div", { class: "two" }, common);
    return [this.head(`${place.kind ?? "plain"} place`, place.label || name), this.name(name), this.label(name, place), kind, own, holds, this.macro(name, place)];
  }

  /** Within which macro place an element is drawn, where there is one to choose. */
  macro(name, element) {
    const { net } = this.model;
    const free = Object.entries(net.places ?? {}).filter(([n, p]) => groups(p) && n !== name && !around(net, n).includes(name)).map(([n, p]) => [n, words(p.label || n)]);
    return free.length ? this.field("Drawn in macro place", this.choice(element.macro ?? "", [["", "none"], ...free], (macro) => this.model.set(name, { macro }))) : null;
  }

  focusName() {
    this.root.querySelector("input.name")?.focus();
  }

  label(name, element) {
    return this.field("Shown as", this.input(element.label, (label) => this.model.set(name, { label }), { placeholder: words(name) }));
  }

  actionFields(name, place) {
    const { data } = this.model;
    const offers = this.designer.offers;
    const known = new Set([...Object.keys(data.primitive_tasks ?? {}), ...offers.map((o) => o.primitive_task)]);
    const label = (p) => {
      const nodes = [...new Set(offers.filter((o) => o.primitive_task === p).map((o) => o.node))];
      return nodes.length ? `${words(p)} (on ${nodes.join(", ")})` : words(p);
    };
    const options = [["", "choose …"], ...[...known].sort().map((p) => [p, label(p)])];
    const exits = new Set(this.designer.picture.arcs.filter((a) => a.direction === "in" && a.place === name && this.model.has(a.transition)).map((a) => a.end));
    const add = (end, text) => (exits.has(end) ? null : h("button", { type: "button", class: "small", onclick: () => this.designer.tools.addExit(name, end) }, icon("plus"), text));
    const task = taskOf(name, place);
    const primitive = data.primitive_tasks?.[task];
    return [
      this.field("Primitive task", this.choice(primitive ? task : place.task, options, (p) => p && this.model.choosePrimitiveTask(name, p, offers))),
      primitive ? this.primitive(task, primitive, offers) : null,
      this.pairs("Arguments", place.args ?? {}, this.argumentNames(task, offers), (args) => this.model.set(name, { args: Object.keys(args).length ? args : null })),
      h("div", { class: "buttons" }, add("normal", "Add normal transition"), add("error", "Add error branch")),
    ];
  }

  argumentNames(task, offers) {
    const actions = new Set(actionsOf(task, this.model.data.primitive_tasks?.[task]));
    return [...new Set(offers.filter((o) => actions.has(o.action)).flatMap((o) => Object.keys(o.args ?? {})))];
  }

  primitive(name, primitive, offers) {
    const set = (key, value) => this.model.edit("change primitive task", (data) => {
      if (value === null || value === "") delete data.primitive_tasks[name][key];
      else data.primitive_tasks[name][key] = value;
    });
    const offered = new Set(offers.map((o) => o.action));
    const chosen = actionsOf(name, primitive);
    const all = [...new Set([...chosen, ...offers.filter((o) => o.primitive_task === name).map((o) => o.action)])];
    const toggle = (action, on) => set("alternatives", all.filter((a) => (a === action ? on : chosen.includes(a))));
    return h("fieldset", {}, h("legend", {}, words(name)),
      this.field("Goal", this.input(primitive.goal, (v) => set("goal", v))),
      this.field("Deadline (s)", this.number(primitive.deadline, (v) => set("deadline", v), { min: 0, step: "any" })),
      h("div", { class: "field", role: "group", "aria-label": "Alternatives" }, h("span", {}, "Alternatives"), all.map((action) => h("label", { class: "tick" }, h("input", { type: "checkbox", checked: chosen.includes(action), onchange: (e) => toggle(action, e.target.checked) }), words(action), offers.length && !offered.has(action) ? h("em", { class: "warn" }, "no node offers it") : null))));
  }

  pairs(title, values, known, onchange) {
    const put = (key, text) => {
      const next = { ...values };
      if (text.trim() === "") delete next[key];
      else next[key] = readValue(text);
      onchange(next);
    };
    const names = [...new Set([...Object.keys(values), ...known])];
    const fresh = h("input", { placeholder: "name", "aria-label": `New ${title.toLowerCase()} name`, onkeydown: keep });
    const add = () => fresh.value.trim() && onchange({ ...values, [fresh.value.trim()]: 0 });
    return h("fieldset", {}, h("legend", {}, title),
      names.map((key) => this.field(key, this.input(key in values ? writeValue(values[key]) : "", (text) => put(key, text), { placeholder: "default" }))),
      h("div", { class: "row" }, fresh, h("button", { type: "button", class: "small", onclick: add }, icon("plus"), "Add")), names.length ? h("small", {}, VALUE_HINT) : null);
  }

  macroFields(name, place) {
    const subnets = Object.keys(this.model.data.subnets ?? {});
    const inside = within(this.model.net, name).length;
    if (!place.subnet && (inside || !subnets.length)) return this.groupFields(name, inside);
    return [
      this.field("Subnet", this.choice(place.subnet, [["", "choose …"], ...subnets.map((n) => [n, words(n)])], (n) => this.model.set(name, { subnet: n }))),
      h("div", { class: "buttons" },
        place.subnet ? h("button", { type: "button", class: "small", onclick: () => this.designer.openSheet(place.subnet) }, icon("open"), "Open") : null,
        place.subnet ? null : h("button", { type: "button", class: "small", onclick: () => this.designer.openSheet(this.model.sheet, name) }, icon("open"), "Draw inside"),
        h("button", { type: "button", class: "small", onclick: () => this.designer.openSheet(this.model.addSubnet(name)) }, icon("plus"), "New subnet")),
    ];
  }

  groupFields(name, inside) {
    const { designer } = this;
    return [
      h("p", { class: "muted" }, inside ? `Shows ${inside} ${inside === 1 ? "element" : "elements"} as one place, with the sum of their tokens.` : "Nothing is inside it yet: open it and draw."),
      h("div", { class: "buttons" },
        h("button", { type: "button", class: "small", onclick: () => designer.openSheet(this.model.sheet, name) }, icon("open"), "Open"),
        inside ? h("button", { type: "button", class: "small", onclick: () => designer.ungroup() }, icon("close"), "Ungroup") : null,
        inside ? null : h("button", { type: "button", class: "small", onclick: () => designer.openSheet(this.model.addSubnet(name)) }, icon("plus"), "New subnet")),
    ];
  }

  transition(name, t) {
    const set = (fields) => this.model.set(name, fields);
    const events = this.model.data.events ?? {};
    const chosen = Array.isArray(t.event) ? t.event : t.event ? [t.event] : [];
    const free = Object.keys(events).filter((e) => !chosen.includes(e));
    const setEvents = (list) => set({ event: list.length > 1 ? list : list[0] ?? "" });
    return [
      this.head("Transition", t.label || name), this.name(name), this.label(name, t),
      h("fieldset", {}, h("legend", {}, "Events"),
        chosen.map((e) => h("div", { class: "row" }, h("span", { class: "chip" }, `${scopeOf(events[e]) === "internal" ? "int" : "ext"}: ${words(e)}`), h("button", { type: "button", class: "tool", "aria-label": `Remove event ${words(e)}`, onclick: () => setEvents(chosen.filter((x) => x !== e)) }, icon("close")))),
        h("div", { class: "row" }, this.choice("", [["", "add event …"], ...free.map((e) => [e, words(e)])], (e) => e && setEvents([...chosen, e]), { "aria-label": "Add event" })),
        this.newEvent((e) => setEvents([...chosen, e]))),
      this.field("Condition", this.input(t.when, (when) => set({ when }), { placeholder: "visible and distance < 1.5" }), "names of variables, comparisons, and, or, not"),
      this.field("After (s)", this.number(t.after, (after) => set({ after }), { min: 0, step: "any", placeholder: "no timer" })),
      h("div", { class: "two" }, this.field("Priority", this.number(t.priority, (n) => set({ priority: n || null }), { placeholder: "0" })), this.field("Weight", this.number(t.weight, (weight) => set({ weight }), { min: 0, step: "any", placeholder: "none" }))),
      h("label", { class: "tick" }, h("input", { type: "checkbox", checked: Boolean(t.error_branch), onchange: (e) => set({ error_branch: e.target.checked || null }) }), "belongs to an error branch"),
      this.macro(name, t),
    ];
  }

  newEvent(use) {
    const name = h("input", { placeholder: "new event", "aria-label": "New event name", onkeydown: keep });
    const scope = this.choice("external", [["external", "external"], ["internal", "internal"]], () => {}, { "aria-label": "New event scope" });
    const by = this.choice("", [["", "raised by …"], ...Object.keys(this.model.data.primitive_tasks ?? {}).map((p) => [p, words(p)])], () => {}, { "aria-label": "Raised by", hidden: true });
    scope.addEventListener("change", () => (by.hidden = scope.value !== "internal"));
    const add = () => {
      const key = name.value.trim().replaceAll(" ", "_");
      if (!key) return;
      this.model.edit("add event", (data) => {
        data.events ??= {};
        data.events[key] ??= { scope: scope.value, ...(scope.value === "internal" && by.value ? { by: by.value } : {}) };
      }, "new event");
      use(key);
    };
    return h("div", { class: "row" }, name, scope, by, h("button", { type: "button", class: "small", "aria-label": "Add new event", onclick: add }, icon("plus")));
  }

  arc(arc) {
    const set = (change) => this.designer.changeArc(arc, change);
    const kind = this.model.place(arc.place)?.kind;
    if (arc.inner?.length) return this.innerArcs(arc);
    const fromAction = arc.direction === "in" && ["action", "macro"].includes(kind);
    const ends = Object.entries(ENDS).filter(([key]) => kind === "action" || key === "normal" || key === "error");
    return [
      h("h2", {}, h("span", { class: "kind" }, arc.direction === "inhibit" ? "Inhibitor arc" : "Arc"), arc.direction === "out" ? `${words(arc.transition)} to ${words(arc.place)}` : `${words(arc.place)} to ${words(arc.transition)}`),
      this.field(arc.direction === "inhibit" ? "Blocks from (tokens)" : "Weight", this.number(arc.weight, (weight) => set({ weight: Math.max(1, weight || 1) }), { min: 1 })),
      fromAction ? this.field("Takes the token of", this.choice(arc.end ?? "normal", ends, (end) => set({ end, counts: end === "preempt" ? "success" : null }))) : null,
      arc.end === "preempt" ? this.field("The cancelled run counts as", this.choice(arc.counts ?? "none", COUNTS.map((c) => [c, c]), (counts) => set({ counts }))) : null,
      h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => this.designer.removeChosen() }, icon("trash"), "Delete arc")),
    ];
  }

  /** An arc of a macro place represents arcs of the places inside it. */
  innerArcs(arc) {
    return [
      h("h2", {}, h("span", { class: "kind" }, arc.inner.length > 1 ? `${arc.inner.length} arcs` : "Arc"), `${words(arc.transition)} with ${arc.inner.map(words).join(", ")}`),
      h("div", { class: "buttons" },
        h("button", { type: "button", class: "small", onclick: () => this.designer.openSheet(this.model.sheet, arc.place) }, icon("open"), "Open the macro place"),
        h("button", { type: "button", class: "small", onclick: () => this.designer.removeChosen() }, icon("trash"), "Delete")),
    ];
  }

  several(names) {
    const { designer } = this;
    const button = (name, label, act) => h("button", { type: "button", class: "small", onclick: act }, icon(name), label);
    return [
      h("h2", {}, `${names.size} elements`),
      h("div", { class: "buttons" }, button("alignRow", "Align in a row", () => align(designer, "y")), button("alignLeft", "Align in a column", () => align(designer, "x")), button("distribute", "Space evenly", () => distribute(designer)), button("layout", "Lay out", () => layOut(designer)), button("macro", "Group into a macro place", () => designer.group()), button("copy", "Copy", () => designer.copy()), button("trash", "Delete", () => designer.removeChosen())),
    ];
  }

  task() {
    const { model } = this;
    if (model.sheet) return this.subnet();
    const { task } = model.data;
    const set = (key, value) => model.edit("change task", (data) => {
      data.task ??= {};
      if (value === "" || value === null) delete data.task[key];
      else data.task[key] = value;
    });
    const controls = Object.entries(model.data.places ?? {}).filter(([, p]) => p.kind === "control").map(([name]) => [name, words(name)]);
    return [
      h("h2", {}, h("span", { class: "kind" }, "Task"), words(task?.name ?? "")),
      this.findings(""),
      this.field("Name", this.input(task?.name, (v) => set("name", v))),
      this.field("Goal", this.input(task?.goal, (v) => set("goal", v), { placeholder: "when a run of the task counts as good" })),
      this.field("Ends when", this.input(task?.final, (v) => set("final", v), { placeholder: "runs == 0 and arm_free == 1" }), "a condition on the tokens of places"),
      this.field("Gives up when", this.input(task?.final_error, (v) => set("final_error", v), { placeholder: "never" })),
      this.errorsTo(),
      this.field("Remaining runs in", this.choice(task?.runs_place, [["", "no place"], ...controls], (v) => set("runs_place", v))),
      events(this), variables(this),
      h("p", { class: "muted" }, "Choose an element to see its properties. Press ? for the keyboard."),
    ];
  }

  /** Where the error branches go that nobody draws. */
  errorsTo() {
    const { model } = this;
    const places = Object.entries(model.net.places ?? {}).filter(([, p]) => p.kind !== "macro").map(([n]) => [n, words(n)]);
    const set = (to) => model.edit("change error branches", (_, net) => {
      if (to) net.errors = { ...net.errors, to };
      else delete net.errors;
    });
    return this.field("Errors without a branch go to", this.choice(model.net.errors?.to, [["", "no place"], ...places], set));
  }

  subnet() {
    const { model } = this;
    const places = Object.keys(model.net.places ?? {}).map((n) => [n, words(n)]);
    const set = (key, value) => model.edit("change subnet", (_, net) => {
      if (value) net[key] = value;
      else delete net[key];
    });
    return [
      h("h2", {}, h("span", { class: "kind" }, "Subnet"), words(model.sheet)),
      this.field("Tokens enter", this.choice(model.net.entry, places, (v) => set("entry", v))),
      this.field("Tokens leave after success or failure from", this.choice(model.net.normal, places, (v) => set("normal", v))),
      this.field("Tokens leave after an error from", this.choice(model.net.error, [["", "none"], ...places], (v) => set("error", v))),
      this.errorsTo(),
    ];
  }
}

