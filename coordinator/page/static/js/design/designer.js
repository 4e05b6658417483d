// The designer: draw a task's net with mouse or keyboard. Puts its parts together and passes on what was edited.

import { Canvas } from "../canvas.js";
import { attribute, h, words } from "../dom.js";
import { loadOffers } from "../files.js";
import { READABLE } from "../geometry.js";
import { placed } from "../layout.js";
import { toast } from "../toast.js";
import { guides } from "./arrange.js";
import { Bar } from "./bar.js";
import { clip, keep, kept, paste } from "./clip.js";
import { Desk } from "./desk.js";
import { Findings } from "./findings.js";
import { Inspector } from "./inspector.js";
import { KeyHelp, Keys } from "./keys.js";
import { chooseInside } from "./inside.js";
import { around, groups } from "./macros.js";
import { MADE, Model } from "./model.js";
import { Pointer } from "./pointer.js";
import { Selection } from "./selection.js";
import { Toolbox } from "./toolbox.js";
import { Verdicts } from "./verdicts.js";

const PASTE_STEP = [40, 60];

export class Designer {
  constructor(link, operator) {
    Object.assign(this, { link, operator, offers: [], offersAsked: 0, works: 0 });
    this.pointer = new Pointer(this);
    this.canvas = new Canvas("Drawing of the task", { keyed: true, down: (event) => this.pointer.down(event), chosen: (e, event) => this.pick(e.name, event), opened: (e) => this.opened(e), moved: () => this.canvas?.map.follow(), elsewhere: (matches) => this.elsewhere(matches) });
    this.canvas.view.fold(false);
    this.canvas.errors.setAttribute("aria-pressed", "true");
    this.selected = new Selection(this);
    this.tools = new Toolbox(this);
    this.keys = new Keys(this);
    this.help = new KeyHelp();
    this.inspector = new Inspector(this);
    this.desk = new Desk(this);
    this.bar = new Bar(this);
    this.findings = new Findings(this);
    this.verdicts = new Verdicts(this);
    this.canvas.root.append(this.tools.hint);
    this.root = h("div", { class: "designer" }, this.bar.root, this.tools.root, this.canvas.root, this.inspector.root, h("div", { class: "below" }, this.findings.root, this.verdicts.root));
    this.model = new Model((why) => this.changed(why));
    this.tools.use("select");
    addEventListener("beforeunload", (event) => this.model.dirty && this.model.past.length && event.preventDefault());
  }

  get view() {
    return this.canvas.view;
  }

  get selection() {
    return { names: this.selected.names, arc: this.selected.arc };
  }

  shown() {
    return this.during(this.begin());
  }

  async begin() {
    await Promise.all([this.askOffers(), this.link.met]); // which task runs decides what is opened first
    await this.desk.first();
    this.inspector.show(this.selection);
  }

  /** Mark the page as busy until `work` is done: the drawing may change and move by itself. */
  async during(work) {
    this.works += 1;
    attribute(this.root, "aria-busy", "true");
    try {
      return await work;
    } finally {
      this.works -= 1;
      attribute(this.root, "aria-busy", this.works ? "true" : null);
    }
  }

  /** Offers of the nodes: of several outstanding requests, the newest one counts, in whichever order the answers arrive. */
  async askOffers() {
    const asked = ++this.offersAsked;
    const offers = await loadOffers();
    if (asked === this.offersAsked) this.offers = offers;
  }

  /** A node joined or left: the available actions have changed. */
  async nodesChanged() {
    const states = JSON.stringify(Object.entries(this.link.state.nodes).map(([name, node]) => [name, node.state]));
    if (states === this.nodeStates || this.root.hidden) return;
    this.nodeStates = states;
    await this.askOffers();
    this.inspector.show(this.selection);
    this.findings.soon();
  }

  // ---- what changed -------------------------------------------------------------------------------------------------

  changed(why) {
    if (!this.model) return; // its own first document
    this.pointer.stop();
    if (why === "load") this.selected.choose(new Set());
    this.verdicts.forget();
    this.draw();
    this.inspector.show(this.selection, why === "load");
    this.bar.paint();
    this.findings.soon();
  }

  draw() {
    const { model } = this;
    this.picture = placed(model.picture());
    this.selected.prune(this.picture);
    this.canvas.show(this.picture);
    for (const place of this.picture.places) this.view.tokens(place.name, place.tokens);
    this.verdicts.paint();
    const path = [["", ""], ...(model.sheet ? [[model.sheet, ""]] : []), ...model.opened.map((macro) => [model.sheet, macro])];
    this.canvas.trail(path.map(([sheet, macro]) => macro || sheet || model.data.task?.name || "task"), (i) => this.openSheet(...path[i]));
    this.selected.paint();
    this.findings.paint();
  }

  // ---- selection and sheets -----------------------------------------------------------------------------------------

  pick(name, event) {
    this.choose(this.selected.pick(name, event));
  }

  choose(names, arc = null) {
    this.selected.choose(names, arc);
    this.inspector.show(this.selection, true);
  }

  /** Go to an element of the drawn net, opening the macro places around it. */
  goTo(name) {
    const macro = around(this.model.net, name)[0] ?? "";
    if (macro !== this.model.inside) this.openSheet(this.model.sheet, macro);
    if (this.canvas.goTo(name)) this.choose(new Set([name]));
  }

  /** What a search finds inside macro places that are closed here: [{name, kind, go}]. */
  elsewhere(matches) {
    const { net } = this.model;
    const hidden = ([name, e]) => !this.view.elements.has(name) && matches(name, e.label ?? "");
    const found = (table, kind) => Object.entries(table ?? {}).filter(hidden).map(([name, e]) => ({ name, kind: `${e.kind ?? kind} in ${words(e.macro ?? "the task")}`, go: () => this.goTo(name) }));
    return [...found(net.places), ...found(net.transitions, "transition")];
  }

  opened(element) {
    const place = this.model.place(element.name);
    if (place?.subnet) this.openSheet(place.subnet);
    else if (groups(place)) this.openSheet(this.model.sheet, element.name);
    else this.inspector.focusName();
  }

  /** From an opened macro place or subnet to what is around it. */
  up() {
    const { sheet, inside, opened } = this.model;
    if (inside) this.openSheet(sheet, opened.at(-2) ?? "");
    else if (sheet) this.openSheet("");
  }

  /** Draw a subnet, or the task's own net for "", with one of its macro places opened. */
  openSheet(sheet, inside = "") {
    if (!this.model.hasSheet(sheet)) return;
    this.model.open(sheet, inside);
    this.choose(new Set());
    this.draw();
    this.inspector.show(this.selection, true);
    this.view.fit(READABLE);
  }

  // ---- edits --------------------------------------------------------------------------------------------------------

  /** Draw an arc; one that ends at a macro place goes to a place inside it, chosen by the person if there are several. */
  async connect(from, to) {
    const inhibit = this.tools.tool === "inhibit";
    const end = (name) => (groups(this.model.place(name)) ? chooseInside(this.model, name) : name);
    const [a, b] = [await end(from), await end(to)];
    if (a === null || b === null) return false;
    const fault = this.model.connect(a, b, inhibit);
    if (fault) toast("warning", fault);
    return !fault;
  }

  changeArc(arc, change) {
    this.model.setArc(arc, change);
    const same = this.picture.arcs.find((a) => a.place === arc.place && a.transition === arc.transition && a.direction === arc.direction && (change.end === undefined ? a.end === arc.end : a.end === change.end));
    this.choose(new Set(), same ?? null);
  }

  removeChosen() {
    const { names, arc } = this.selection;
    if (!names.size && !arc) return;
    if ([...names, ...(arc ? [arc.transition] : [])].every((name) => !this.model.has(name))) {
      toast("info", MADE);
      return;
    }
    this.model.remove(names, arc ? [arc] : []);
    this.choose(new Set());
  }

  group() {
    const made = this.model.group(this.selected.names);
    if (typeof made === "string") return toast("warning", made);
    if (made.left.length) toast("info", `${made.left.map(words).join(", ")} ${made.left.length > 1 ? "stay" : "stays"} outside: connected to places that were not selected.`);
    return this.choose(new Set([made.name]));
  }

  ungroup() {
    const names = this.model.ungroup(this.selected.names);
    if (names?.length) this.choose(new Set(names));
  }

  undo() {
    const label = this.model.undo();
    if (label) toast("info", `Undone: ${label}`);
  }

  redo() {
    const label = this.model.redo();
    if (label) toast("info", `Redone: ${label}`);
  }

  copy() {
    const { names } = this.selected;
    if (!names.size) return;
    keep(clip(this.model, names));
    this.pasted = 0;
    toast("ok", `${names.size} copied`);
  }

  paste() {
    const made = kept();
    if (!made) return;
    this.pasted = (this.pasted ?? 0) + 1;
    this.choose(new Set(paste(this.model, made, ...PASTE_STEP.map((d) => d * this.pasted)) ?? []));
  }

  guides(lines) {
    guides(this.view, lines);
  }
}
