// Asks which place inside a macro place an arc goes to.

import { openDialog } from "../dialog.js";
import { h, words } from "../dom.js";
import { groups, within } from "./macros.js";

/** The name of a place within the macro place: its only one, else the one that is chosen; null when the question is cancelled. */
export function chooseInside(model, macro) {
  const places = within(model.net, macro).filter((n) => model.place(n) && !groups(model.place(n)));
  if (places.length < 2) return Promise.resolve(places[0] ?? macro);
  return new Promise((resolve) => {
    const end = (name) => {
      dialog.close();
      resolve(name);
    };
    const choice = h("select", { "aria-label": "Place" }, places.map((n) => h("option", { value: n }, words(model.place(n).label || n))));
    const title = `Which place inside ${words(macro)}?`;
    const form = h("form", { method: "dialog", onsubmit: (e) => { e.preventDefault(); end(choice.value); } }, h("h2", {}, title), choice,
      h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => end(null) }, "Cancel"), h("button", { type: "submit", class: "command primary" }, "OK")));
    const dialog = h("dialog", { "aria-label": title }, form);
    dialog.addEventListener("cancel", () => end(null));
    openDialog(dialog);
    choice.focus();
  });
}
