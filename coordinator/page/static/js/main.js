// Puts the page together: header, tabs, theme, and one painter for all that the link brings.

import { Designer } from "./design/designer.js";
import { attribute, h, text } from "./dom.js";
import { History } from "./history.js";
import { icon } from "./icons.js";
import { Link } from "./link.js";
import { Live } from "./live.js";
import { Banner, Operator } from "./operator.js";
import { toast } from "./toast.js";

const TICK_MS = 100;
const BEAT_MS = 800; // of what blinks while it lasts; an endless animation would draw sixty times a second
const PATIENCE_MS = 2000; // a page that has just been opened may still be on its way
const LOST = "Connection to the coordinator lost. What you see is old. Trying again …";
const NEVER = "Not connected to the coordinator yet. Nothing on this page shows its real state. Trying again …";
const ENDED = "This coordinator has shut down normally. This page no longer reaches its nodes or their emergency stop. What you see is its last state.";
const REFUSED = "The coordinator was restarted and has a new key, so it refuses this page. What you see is old. Open the address that it printed when it started, in this browser or here:";

const calm = matchMedia("(prefers-reduced-motion: reduce)");

class App {
  constructor(root) {
    this.link = new Link((changed, changes) => this.paint(changed, changes));
    this.operator = new Operator(this.link);
    this.banner = new Banner();
    this.tabs = { Live: new Live(this.link, this.operator), Design: new Designer(this.link, this.operator), History: new History(this.link, this.operator) };
    this.lost = new LostBar(this.link);
    this.switch = h("nav", { class: "switch", role: "tablist", "aria-label": "Views" }, Object.keys(this.tabs).map((name) => h("button", { type: "button", role: "tab", onclick: () => this.show(name), onkeydown: (e) => this.step(e) }, name)));
    this.theme = h("button", { type: "button", class: "tool", onclick: () => this.setTheme(this.dark ? "light" : "dark") });
    this.wall = h("button", { type: "button", class: "tool", "aria-label": "Wall screen: larger type", title: "Wall screen: larger type", "aria-pressed": "false", onclick: () => this.setWall(!this.isWall) }, icon("wall"));
    this.header = h("header", { class: "top" }, h("span", { class: "brand" }, mark(), "petrobot"), this.switch, this.banner.root, h("div", { class: "spacer" }), this.wall, this.theme, this.operator.estop);
    this.stage = h("main", { class: "main" }, Object.values(this.tabs).map((tab) => tab.root));
    root.replaceChildren(this.header, this.lost.root, this.operator.bar, this.operator.answer, this.stage);
    this.setTheme(localStorage.getItem("petrobot.theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
    this.setWall(localStorage.getItem("petrobot.wall") === "yes");
    this.show(this.addressed() ?? "Live");
    setInterval(() => this.tick(), TICK_MS);
    new ResizeObserver(() => document.documentElement.style.setProperty("--head", `${this.header.offsetHeight}px`)).observe(this.header); // dialogs leave it free
    addEventListener("hashchange", () => this.addressed() && this.show(this.addressed()));
  }

  /** Go to the next view by the arrow keys. */
  step(event) {
    const way = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const all = [...this.switch.children];
    const next = all[(all.indexOf(event.currentTarget) + way + all.length) % all.length];
    next?.click();
    next?.focus();
  }

  /** The tab that the address names (…#design). */
  addressed() {
    return Object.keys(this.tabs).find((name) => `#${name}`.toLowerCase() === location.hash.toLowerCase());
  }

  get dark() {
    return document.documentElement.dataset.theme === "dark";
  }

  setTheme(theme) {
    document.documentElement.dataset.theme = theme;
    localStorage.setItem("petrobot.theme", theme);
    const label = theme === "dark" ? "Light colours" : "Dark colours";
    attribute(this.theme, "aria-label", label);
    attribute(this.theme, "title", label);
    this.theme.replaceChildren(icon(theme === "dark" ? "sun" : "moon"));
  }

  get isWall() {
    return document.documentElement.dataset.wall === "yes";
  }

  setWall(on) {
    document.documentElement.dataset.wall = on ? "yes" : "no";
    localStorage.setItem("petrobot.wall", on ? "yes" : "no");
    attribute(this.wall, "aria-pressed", on);
  }

  show(name) {
    this.shown = name;
    Object.entries(this.tabs).forEach(([key, tab], i) => {
      this.switch.children[i].setAttribute("aria-selected", String(key === name));
      tab.root.hidden = key !== name;
    });
    document.documentElement.dataset.view = name.toLowerCase();
    if (location.hash !== `#${name}`) history.replaceState(null, "", `#${name}`);
    this.tabs[name].shown?.();
  }

  paint(changed, changes) {
    const { state } = this.link;
    this.lost.update(); // before all that may fail
    this.banner.update(state);
    this.banner.tick(this.link.now());
    this.operator.update(state);
    this.tabs.Live.paint(changed, changes);
    if (["all", "controls", "connection", "mission"].some((p) => changed.has(p))) for (const tab of Object.values(this.tabs)) tab.controlsChanged?.();
    for (const change of changes) if (change.kind === "notice" && (this.shown === "Live" || change.notice.level === "error")) toast(change.notice.level, change.notice.text);
    if (changed.has("nodes") || changed.has("all")) this.tabs.Design.nodesChanged();
    for (const change of changes) this.tabs.History.follow(change);
    if (changed.has("all")) this.tabs.History.restart();
  }

  tick() {
    this.lost.update();
    const now = this.link.now();
    this.banner.tick(now);
    attribute(document.documentElement, "data-beat", !calm.matches && Math.floor(performance.now() / BEAT_MS) % 2 ? "off" : "on");
    if (this.shown === "Live") this.tabs.Live.tick(now);
  }
}

/** The bar that says that what is shown is old, why, and what to do about it. */
class LostBar {
  constructor(link) {
    this.link = link;
    this.text = h("span");
    this.key = h("input", { type: "text", "aria-label": "Printed address", placeholder: "…/?token=…", autocomplete: "off", spellcheck: "false" });
    this.form = h("form", { class: "row", hidden: true, onsubmit: (event) => this.enter(event) }, this.key, h("button", { type: "submit", class: "small" }, "Open"), h("a", { href: "/" }, "or load this page again"));
    this.root = h("div", { class: "lost", role: "alert", hidden: true }, icon("link"), this.text, this.form);
  }

  /** What keeps this page from showing what is so now; empty when nothing does. */
  get reason() {
    const { connected, everConnected, fault, goodbye, refused, tries } = this.link;
    if (fault) return `This page could not show what the coordinator sent (${fault}). What you see is old. Connecting again …`;
    if (connected) return "";
    if (refused) return REFUSED;
    if (goodbye) return ENDED;
    if (everConnected) return LOST;
    return tries || performance.now() > PATIENCE_MS ? NEVER : "";
  }

  update() {
    const { reason } = this;
    const { connected, goodbye, refused } = this.link;
    const calm = goodbye && !refused;
    attribute(this.root, "hidden", reason ? null : ""); // `hidden =` would lay out at each tick
    text(this.text, reason);
    attribute(this.form, "hidden", refused ? null : "");
    attribute(this.root, "data-ended", calm ? "" : null);
    attribute(document.documentElement, "data-connected", connected ? "yes" : calm ? "ended" : "no");
  }

  enter(event) {
    event.preventDefault();
    const typed = this.key.value.trim();
    const token = /[?&]token=([^&#\s]+)/.exec(typed)?.[1] ?? encodeURIComponent(typed);
    if (token) location.assign(`/?token=${token}`);
  }
}

function mark() {
  const node = icon("layout");
  node.classList.add("mark");
  return node;
}

/** A fault of the page's own, anywhere: it must not go unseen. Notices of the browser come without an error. */
addEventListener("error", (event) => event.error && toast("error", `This page has a fault: ${event.error.message ?? event.error}. Load it again.`));
addEventListener("unhandledrejection", (event) => toast("error", `This page has a fault: ${event.reason?.message ?? event.reason}. Load it again.`));

window.petrobot = new App(document.getElementById("app"));
