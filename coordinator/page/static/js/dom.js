// Builds elements. Text only ever becomes text nodes, so a name or a reason can hold no markup.

const SVG = "http://www.w3.org/2000/svg";

function put(element, properties, children) {
  for (const [key, value] of Object.entries(properties ?? {})) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "class") element.setAttribute("class", value);
    else if (key === "value" || key === "checked" || key === "disabled" || key === "hidden") element[key] = value;
    else element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** An HTML element: h("button", {class: "quiet", onclick: f}, "Pause"). */
export const h = (tag, properties, ...children) => put(document.createElement(tag), properties, children);

/** An SVG element. */
export const s = (tag, properties, ...children) => put(document.createElementNS(SVG, tag), properties, children);

/** Set an attribute only when it changes; null removes it. */
export function attribute(element, name, value) {
  if (value === null || value === undefined || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, String(value));
}

/** Set an element's text only when it changes. */
export function text(element, value) {
  const wanted = String(value);
  if (element.textContent !== wanted) element.textContent = wanted;
}

/** What is typed into a field is not meant for the drawing; what is pressed with Ctrl, such as save, still is. */
export function keep(event) {
  if (!event.ctrlKey && !event.metaKey) event.stopPropagation();
}

const CONTROLS = "input, textarea, select, button, a[href]";
const calledOf = (control) => control.getAttribute("aria-label") ?? control.closest("label")?.firstChild?.textContent ?? control.textContent;

/** Replace an element's children. A control that had the focus gives it to the new one of the same name. */
export function fill(element, ...children) {
  const at = element.contains(document.activeElement) ? document.activeElement : null;
  const called = at?.matches(CONTROLS) ? calledOf(at) : null;
  const alike = () => [...element.querySelectorAll(CONTROLS)].filter((control) => calledOf(control) === called);
  const turn = called === null ? 0 : alike().indexOf(at);
  element.replaceChildren(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  if (called === null || element.contains(document.activeElement)) return element;
  const control = alike()[turn] ?? alike()[0];
  control?.focus({ preventScroll: true });
  control?.select?.(); // as Tab does
  return element;
}

/**
 * Keep a list of rows in step with a list of items: rows are made once for each key, updated in place and reordered.
 * `make(item)` gives an element, `update(element, item)` alters it.
 */
export function rows(parent, items, key, make, update) {
  const known = (parent.rowsByKey ??= new Map());
  const wanted = new Set();
  let before = null;
  for (const item of items) {
    const id = key(item);
    wanted.add(id);
    let element = known.get(id);
    if (!element) {
      element = make(item);
      known.set(id, element);
    }
    update?.(element, item);
    const next = before ? before.nextSibling : parent.firstChild;
    if (next !== element) parent.insertBefore(element, next);
    before = element;
  }
  for (const [id, element] of known) {
    if (wanted.has(id)) continue;
    element.remove();
    known.delete(id);
  }
}

/** Whether something in a part of the page is pressed just now: a button that is replaced before its release swallows the press. */
export class Press {
  constructor(root) {
    Object.assign(this, { number: 0, going: 0, later: null });
    root.addEventListener("pointerdown", (event) => this.begin(event));
    root.addEventListener("click", () => this.end(this.going), { capture: true }); // what the press itself alters is shown at once
    for (const kind of ["pointerup", "pointercancel"]) addEventListener(kind, () => this.released(this.going), { capture: true });
  }

  begin(event) {
    const pressed = event.button === 0 && event.target.closest("button, label") && !event.target.closest("select");
    if (pressed) this.going = ++this.number;
  }

  /** The click that belongs to a release comes before anything else. */
  released(press) {
    if (press) setTimeout(() => this.end(press));
  }

  end(press) {
    if (!press || press !== this.going) return;
    this.going = 0;
    setTimeout(() => this.draw());
  }

  /** True during a press: the last `draw` that was requested is then called when the press ends. */
  holds(draw) {
    this.later = this.going ? draw : null;
    return Boolean(this.going);
  }

  draw() {
    const { later } = this;
    if (this.going || !later) return;
    this.later = null;
    later();
  }
}

/** Seconds for people: 0.42 s, 12.3 s, 2:05 min. */
export function seconds(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "";
  if (value < 10) return `${value.toFixed(2)} s`;
  if (value < 100) return `${value.toFixed(1)} s`;
  const whole = Math.floor(value);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")} min`;
}

/** A value for people: a text as it is, a missing one as a dash. */
export const valueText = (value) => (typeof value === "string" ? value : value === null || value === undefined ? "–" : JSON.stringify(value));

/** A name for people: underscores become spaces. */
export const words = (name) => String(name ?? "").replaceAll("_", " ");
