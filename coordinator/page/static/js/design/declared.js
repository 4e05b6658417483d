// What a task declares apart from its net: events and variables, as forms in the task's properties.

import { h, keep, words } from "../dom.js";
import { icon } from "../icons.js";
import { toast } from "../toast.js";
import { scopeOf } from "./drawn.js";
import { readValue, writeValue } from "./values.js";

const NAME = /^[\p{L}_][\p{L}\p{N}_]*$/u;
const TYPES = ["bool", "int", "float", "str", "any"].map((t) => [t, t]);
const MEMORY = [["pulse", "pulse: only for transitions that are ready when it comes"], ["latched", "latched: stored until a firing uses it"]];

/** A fieldset with a row for each entry of a table of the document, and one for a new name. */
function table(form, title, key, row, fresh) {
  const { model } = form;
  const one = title.toLowerCase().replace(/s$/, "");
  const name = h("input", { placeholder: `new ${one}`, "aria-label": `New ${one}`, onkeydown: (e) => { keep(e); if (e.key === "Enter") add(); } });
  const add = () => {
    const wanted = name.value.trim().replaceAll(" ", "_");
    if (!NAME.test(wanted)) return toast("warning", "A name must start with a letter and contain only letters, digits and _.");
    if (model.data[key]?.[wanted]) return toast("warning", `There is already a ${one} called ${wanted}.`);
    return model.edit(`add ${one}`, (data) => ((data[key] ??= {})[wanted] = { ...fresh }));
  };
  const remove = (entry) => model.edit(`delete ${one}`, (data) => delete data[key][entry]);
  const rows = Object.entries(model.data[key] ?? {}).map(([entry, value]) =>
    h("div", { class: "declared", role: "group", "aria-label": `${one} ${words(entry)}` }, h("span", { class: "chip" }, words(entry)), row(entry, value), h("button", { type: "button", class: "tool", "aria-label": `Delete ${one} ${words(entry)}`, onclick: () => remove(entry) }, icon("trash"))));
  return h("fieldset", {}, h("legend", {}, title), rows, h("div", { class: "row" }, name, h("button", { type: "button", class: "small", "aria-label": `Add ${one}`, onclick: add }, icon("plus"), "Add")));
}

const setter = (form, key, entry, label) => (field, value) => form.model.edit(label, (data) => {
  if (value === null || (value === "" && field !== "initial")) delete data[key][entry][field];
  else data[key][entry][field] = value;
});

/** The task's events. */
export function events(form) {
  const primitives = Object.keys(form.model.data.primitive_tasks ?? {}).map((p) => [p, `int, by ${words(p)}`]);
  return table(form, "Events", "events", (entry, event) => {
    const set = setter(form, "events", entry, "change event");
    const source = (value) => form.model.edit("change event", (data) => {
      const { text, mean_wait: wait } = data.events[entry];
      data.events[entry] = { ...(value ? { scope: "internal", by: value } : { scope: "external" }), ...(text ? { text } : {}), ...(wait && !value ? { mean_wait: wait } : {}) };
    });
    return [
      form.choice(scopeOf(event) === "internal" ? event.by : "", [["", "external"], ...primitives], source, { "aria-label": `Where ${words(entry)} comes from` }),
      scopeOf(event) === "internal" ? null : form.choice(event.memory ?? "pulse", MEMORY, (memory) => set("memory", memory), { "aria-label": `How ${words(entry)} is remembered` }),
    ];
  }, { scope: "external" });
}

/** The task's variables, which conditions and arguments read. */
export function variables(form) {
  return table(form, "Variables", "variables", (entry, variable) => {
    const set = setter(form, "variables", entry, "change variable");
    const initial = "initial" in variable ? writeValue(variable.initial) : "";
    // Without quotes everything is text; with them it may be empty, or begin with one.
    const read = (text) => (variable.type === "str" && !text.startsWith('"') ? text : readValue(text));
    return [
      form.choice(variable.type ?? "any", TYPES, (type) => set("type", type), { "aria-label": `Type of ${words(entry)}` }),
      form.input(initial, (text) => set("initial", text.trim() === "" ? null : read(text)), { placeholder: "initial", title: '"" is an empty text', "aria-label": `Initial value of ${words(entry)}` }),
    ];
  }, { type: "bool", initial: false });
}
