// Dialogs that leave the header free: the emergency stop stays in sight and within reach whatever is asked.

import { h } from "./dom.js";

/** Show a dialog over everything but the header; Escape cancels, Tab stays inside. It is gone when closed. */
export function openDialog(dialog) {
  const veil = h("div", { class: "veil" });
  const before = document.activeElement;
  const within = () => [...dialog.querySelectorAll("button, input, select, a[href]")].filter((node) => !node.disabled);
  dialog.addEventListener("keydown", (event) => {
    event.stopPropagation();
    if (event.key === "Escape") dialog.dispatchEvent(new Event("cancel"));
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
