// Task files on the server: open, save with revision, resolve a conflict with both versions in view, import and export.

import { askDialog, askValue, openDialog } from "./dialog.js";
import { h, words } from "./dom.js";
import { toast } from "./toast.js";

const STOP_ANSWER_MS = 4000; // by then all devices have come to rest, or the operator must know that they may not

async function ask(method, path, body, signal) {
  const response = await fetch(path, { method, signal, headers: body ? { "Content-Type": "application/json" } : {}, body: body ? JSON.stringify(body) : undefined });
  const isJson = response.headers.get("Content-Type")?.startsWith("application/json");
  const value = isJson ? await response.json() : await response.text();
  return { status: response.status, ok: response.ok, value };
}

/** The answer's value; after a fault, which is shown, null. */
async function need(method, path, body) {
  try {
    const answer = await ask(method, path, body);
    if (answer.ok) return answer.value;
    toast("error", typeof answer.value === "string" ? answer.value : "the server refused");
  } catch {
    toast("error", "the server cannot be reached");
  }
  return null;
}

/** Give the emergency stop without the live connection. Returns whether it was answered that it is carried out. */
export async function stopPastTheLink() {
  try {
    return (await ask("POST", "/api/command", { verb: "estop", name: "operator" }, AbortSignal.timeout(STOP_ANSWER_MS))).ok;
  } catch {
    return false;
  }
}

/** The present revision of a task file; null if it is unknown. */
export async function revisionOf(name) {
  try {
    const answer = await ask("GET", `/api/revisions/${encodeURIComponent(name)}`);
    return answer.ok ? answer.value.revision : null;
  } catch {
    return null;
  }
}

export const listTasks = async () => (await need("GET", "/api/tasks")) ?? [];
export const openTask = (name) => need("GET", `/api/tasks/${encodeURIComponent(name)}`);
export const loadOffers = async () => (await need("GET", "/api/offers")) ?? [];
export const listRuns = async () => (await need("GET", "/api/runs")) ?? [];
export const openRun = (run) => need("GET", `/api/runs/${encodeURIComponent(run)}`);
export const startForm = (name) => need("GET", `/api/start/${encodeURIComponent(name)}`);
export const importNet = (form, text) => need("POST", "/api/import", { form, text });

/** Name of this window's desk: a newer drawing from it replaces the one that is being checked or analysed. */
const DESK = Array.from(crypto.getRandomValues(new Uint8Array(8)), (b) => b.toString(16).padStart(2, "0")).join("");

/** Findings for a document; null if the server gave none, or was sent a newer document. */
export async function checkDocument(name, document, renames) {
  try {
    const answer = await ask("POST", "/api/check", { name, document, renames, desk: DESK });
    if (answer.value.superseded) return null;
    return answer.ok ? answer.value : { findings: [{ severity: "error", key: "", text: String(answer.value), remedy: "" }], text: "" };
  } catch {
    return null;
  }
}

/** Verdicts on a document; a text says why there are none; null if a newer drawing was checked meanwhile. */
export async function analyseDocument(name, document, renames) {
  try {
    const answer = await ask("POST", "/api/analyse", { name, document, renames, desk: DESK });
    if (answer.value.superseded) return null;
    return answer.ok ? answer.value : String(answer.value);
  } catch {
    return "the server cannot be reached";
  }
}

/** Save; on a conflict the user chooses. Returns what the server then has, or null. */
export async function saveTask(model, name) {
  const path = `/api/tasks/${encodeURIComponent(name)}`;
  const base = name === model.name ? model.base : null;
  let answer;
  try {
    answer = await ask("PUT", path, { base, document: model.data, renames: model.renames });
  } catch {
    toast("error", "Not saved: the server cannot be reached");
    return null;
  }
  if (answer.ok) return answer.value;
  if (answer.status !== 409) {
    toast("error", `Not saved: ${typeof answer.value === "string" ? answer.value : "refused"}`);
    return null;
  }
  const choice = await settle(name, answer.value);
  if (choice === "theirs") return { ...answer.value.theirs, reload: true };
  if (choice !== "yours") return null;
  return need("PUT", path, { base: answer.value.theirs.revision, text: answer.value.yours });
}

/** Lines of two texts side by side; lines that only one has are marked. */
function differences(left, right) {
  const [a, b] = [left.split("\n"), right.split("\n")];
  const table = Array.from({ length: a.length + 1 }, () => new Uint16Array(b.length + 1));
  for (let i = a.length - 1; i >= 0; i--) for (let j = b.length - 1; j >= 0; j--) table[i][j] = a[i] === b[j] ? table[i + 1][j + 1] + 1 : Math.max(table[i + 1][j], table[i][j + 1]);
  const rows = [];
  let [i, j] = [0, 0];
  while (i < a.length || j < b.length) {
    if (i < a.length && j < b.length && a[i] === b[j]) rows.push([a[i++], b[j++], false]);
    else if (j >= b.length || (i < a.length && table[i + 1][j] >= table[i][j + 1])) rows.push([a[i++], null, true]);
    else rows.push([null, b[j++], true]);
  }
  return rows;
}

function settle(name, { yours, theirs }) {
  const rows = differences(theirs.text, yours);
  const near = rows.map((_, i) => rows.slice(Math.max(0, i - 2), i + 3).some((r) => r[2]));
  const cell = (line, changed, side) => h("td", { class: changed && line !== null ? side : "" }, line ?? "");
  return askDialog({ class: "conflict", "aria-label": "Conflict" }, (end) => [
    h("h2", {}, `${name} was changed elsewhere since you opened it`),
    h("p", { class: "muted" }, "Nothing has been written. These are the lines that differ."),
    h("div", { class: "sides" }, h("table", {}, h("thead", {}, h("tr", {}, h("th", {}, "On the server"), h("th", {}, "Yours"))), h("tbody", {}, rows.filter((_, i) => near[i]).map(([l, r, changed]) => h("tr", {}, cell(l, changed, "theirs"), cell(r, changed, "yours")))))),
    h("div", { class: "buttons" },
      h("button", { type: "button", class: "small", onclick: () => end(null) }, "Keep editing"),
      h("button", { type: "button", class: "small", onclick: () => end("theirs") }, "Discard mine, load theirs"),
      h("button", { type: "button", class: "command danger", onclick: () => end("yours") }, "Replace theirs by mine"))]);
}

function download(name, content, type) {
  const link = h("a", { href: URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type })), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 5000);
}

const DRAWN = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "stroke-linejoin", "font-size", "font-weight", "font-style", "font-family", "text-anchor", "paint-order", "opacity"];

/** The drawing of a view as a self-contained SVG text: styles written out, in light colours, only the net. */
function svgOf(view) {
  const box = view.extent ?? [0, 0, 100, 100];
  const theme = document.documentElement.dataset.theme;
  document.documentElement.dataset.theme = "light";
  const clone = view.svg.cloneNode(true);
  clone.append(...view.moving.cloneNode(true).children);
  const [from, to] = [[...view.svg.querySelectorAll("*"), ...view.moving.querySelectorAll("*")], clone.querySelectorAll("*")];
  from.forEach((node, i) => {
    const style = getComputedStyle(node);
    for (const key of DRAWN) {
      const value = style.getPropertyValue(key);
      if (value) to[i].setAttribute(key, value);
    }
    if (style.display === "none") to[i].setAttribute("display", "none");
    for (const key of ["class", "tabindex", "role", "aria-label", "data-name", "data-arc"]) to[i].removeAttribute(key);
  });
  document.documentElement.dataset.theme = theme;
  const [w, tall] = [box[2] - box[0], box[3] - box[1]];
  for (const name of clone.getAttributeNames()) clone.removeAttribute(name);
  clone.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  clone.setAttribute("viewBox", [box[0], box[1], w, tall].map(Math.round).join(" "));
  clone.setAttribute("width", Math.round(w));
  clone.setAttribute("height", Math.round(tall));
  for (const node of clone.querySelectorAll("[display=none]")) node.remove();
  for (const world of clone.children) if (world.tagName === "g") world.removeAttribute("transform");
  return new XMLSerializer().serializeToString(clone);
}

async function pngOf(view) {
  const svg = svgOf(view);
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
  await image.decode();
  const canvas = h("canvas", { width: image.width * 2, height: image.height * 2 });
  const pen = canvas.getContext("2d");
  pen.fillStyle = "#ffffff";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}

export async function exportAs(form, model, view, text) {
  const name = model.name || "task";
  if (form === "svg") return download(`${name}.svg`, svgOf(view), "image/svg+xml");
  if (form === "png") return download(`${name}.png`, await pngOf(view), "image/png");
  if (form === "toml") return download(`${name}.toml`, text, "application/toml");
  if (!model.name || model.dirty) return toast("warning", "Save the task first: it is exported from its file.");
  const exported = await need("GET", `/api/tasks/${encodeURIComponent(model.name)}/export/${form}`);
  if (exported === null) return null;
  if (form === "gspn.svg") return showPicture("Stochastic view", name, exported);
  return download(`${name}.${form}`, exported, "text/xml");
}

/** Show an SVG in a dialog: the whole of it, or at full size around the point that was clicked. As an image, no script in it can run. */
function showPicture(title, name, svg) {
  const address = URL.createObjectURL(new Blob([svg], { type: "image/svg+xml" }));
  const resize = (x, y) => {
    size.setAttribute("aria-pressed", String(dialog.classList.toggle("full")));
    sheet.scrollTo(x * sheet.scrollWidth - sheet.clientWidth / 2, y * sheet.scrollHeight - sheet.clientHeight / 2);
  };
  const size = h("button", { type: "button", class: "small", "aria-pressed": "false", onclick: () => resize(0, 0) }, "Full size");
  const image = h("img", { src: address, alt: "Timed transitions are boxes, immediate ones bars", onclick: (e) => resize(e.offsetX / image.clientWidth, e.offsetY / image.clientHeight) });
  const sheet = h("div", { class: "sheet" }, image);
  const dialog = h("dialog", { "aria-label": title, class: "picture" }, h("h2", {}, `${title} of ${words(name)}`),
    sheet, h("div", { class: "buttons" }, size,
      h("button", { type: "button", class: "small", onclick: () => download(`${name}.gspn.svg`, svg, "image/svg+xml") }, "Save"),
      h("button", { type: "button", class: "small", onclick: () => dialog.close() }, "Close")));
  dialog.addEventListener("close", () => URL.revokeObjectURL(address));
  openDialog(dialog);
}

/** Ask for a name; null when it was cancelled. */
export function askName(title, value) {
  const input = h("input", { value, "aria-label": "Name", pattern: "[A-Za-z0-9_][A-Za-z0-9_\\-]{0,63}", required: true });
  const answer = askValue(title, input, h("p", { class: "muted" }, "Letters, digits, underscores and hyphens."));
  input.select();
  return answer;
}
