// Short messages at the lower edge; refusals stay longer than confirmations.

import { h } from "./dom.js";
import { icon } from "./icons.js";

const LEVELS = { ok: ["check", 2600], info: ["info", 4000], warning: ["warning", 7000], error: ["error", 9000], waiting: ["info", 60000] };

const place = h("div", { class: "toasts", role: "status", "aria-live": "polite" });
document.body.append(place);

export function toast(level, message) {
  const [sign, duration] = LEVELS[level] ?? LEVELS.info;
  const node = h("div", { class: `toast ${level}` }, icon(sign), h("span", {}, message), h("button", { type: "button", class: "tool", "aria-label": "Dismiss", onclick: () => node.remove() }, icon("close")));
  const said = [...place.children].find((other) => other.title === message);
  if (said) return said;
  node.title = message;
  if (level === "ok") place.querySelector(".toast.ok")?.remove(); // the newest confirmation is enough
  place.append(node);
  while (place.children.length > 4) place.firstChild.remove();
  setTimeout(() => node.remove(), duration);
  return node;
}
