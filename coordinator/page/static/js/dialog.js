// Dialogs that leave the header free: the emergency stop stays in sight and within reach whatever is asked.

import { h } from "./dom.js";

/** Show a dialog over everything but the header; Escape cancels, Tab stays inside. It is gone when closed. */
export function openDialog(dialog) {
  const veil = h("div", { class: "veil" });
  const before = document.activeElement;
  const within = () => [...dialog.querySelectorAll("button, input, select, a[href]")].filter((node) => !node.disabled);
  dialog.addEventListener("keydown", (event) => {
    event.stopPropagation();
    if (event.key === "Escape") dialog.close();
    if (event.key !== "Tab") return;
    const all = within();
    const edge = event.shiftKey ? all[0] : all.at(-1);
    if (document.activeElement !== edge) return;
    event.preventDefault();
    (event.shiftKey ? all.at(-1) : all[0])?.focus();
  });
  dialog.addEventListener("close", () => {
    veil.remove();
    dialog.remove();
    before?.focus?.({ preventScroll: true });
  });
  dialog.setAttribute("aria-modal", "true");
  document.body.append(veil, dialog);
  dialog.show();
  // Pressing Enter at once must do no harm: the focus is on a button that neither destroys nor sends anything
  const harmless = within().find((node) => !node.matches(".danger, [type=submit]"));
  (dialog.querySelector("input") ?? harmless ?? within()[0])?.focus();
}

/** Ask in a dialog that shows `content(end)`; resolves with what `end` is given, null when the dialog is cancelled. */
export function askDialog(properties, content) {
  return new Promise((resolve) => {
    const end = (answer) => {
      resolve(answer);
      dialog.close();
    };
    const dialog = h("dialog", properties, content(end));
    dialog.addEventListener("close", () => resolve(null));
    openDialog(dialog);
  });
}

/** Ask for the value of a field; null when it is cancelled. */
export function askValue(title, field, note = null) {
  const answer = askDialog({ "aria-label": title }, (end) => h("form", { method: "dialog", onsubmit: (e) => { e.preventDefault(); end(field.value.trim()); } },
    h("h2", {}, title), note, field,
    h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => end(null) }, "Cancel"), h("button", { type: "submit", class: "command primary" }, "OK"))));
  field.focus();
  return answer;
}
