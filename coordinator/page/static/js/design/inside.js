// Asks which place inside a macro place an arc goes to.

import { askValue } from "../dialog.js";
import { h, words } from "../dom.js";
import { groups, within } from "./macros.js";

/** The name of a place within the macro place: its only one, else the one that is chosen; null when the question is cancelled. */
export function chooseInside(model, macro) {
  const places = within(model.net, macro).filter((n) => model.place(n) && !groups(model.place(n)));
  if (places.length < 2) return Promise.resolve(places[0] ?? macro);
  const choice = h("select", { "aria-label": "Place" }, places.map((n) => h("option", { value: n }, words(model.place(n).label || n))));
  return askValue(`Which place inside ${words(macro)}?`, choice);
}
