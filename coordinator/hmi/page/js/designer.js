// The designer: draw a task's net with mouse or keyboard, with every step undoable and faults shown where they are.

import { Canvas, tool } from "./canvas.js";
import { openDialog } from "./dialog.js";
import { attribute, fill, h, s, text, words } from "./dom.js";
import { askName, checkDocument, exportAs, importNet, listTasks, loadOffers, openTask, saveTask } from "./files.js";
import { GRID } from "./geometry.js";
import { icon } from "./icons.js";
import { Inspector } from "./inspector.js";
import { KeyHelp, Keys } from "./keys.js";
import { automatic, placed } from "./layout.js";
import { emptyDocument, Model } from "./model.js";
import { Pointer } from "./pointer.js";
import { toast } from "./toast.js";
import { Verdicts } from "./verdicts.js";

const CHECK_MS = 300;
const NEARLY = 16;
const TOOLS = [
  ["select", "select", "Select", "V"], ["action", "action", "Action place", "1"], ["resource", "resource", "Resource place", "2"],
  ["control", "control", "Control place", "3"], ["macro", "macro", "Macro place", "4"], ["transition", "transition", "Transition", "T"],
  ["arc", "arc", "Arc", "A"], ["inhibit", "inhibitor", "Inhibitor arc", "I"],
];
export const snap = (value) => Math.round(value / GRID) * GRID;

export class Designer {
  constructor(link, operator) {
    Object.assign(this, { link, operator, offers: [], findings: [], text: "", tool: "select", documents: 0 });
    this.selection = { names: new Set(), arc: null };
    this.pointer = new Pointer(this);
    this.canvas = new Canvas("Drawing of the task", { keyed: true, down: (event) => this.pointer.down(event), chosen: (e, event) => this.pick(e.name, event), opened: (e) => this.opened(e), moved: () => this.canvas?.map.follow() });
    this.canvas.view.fold(false);
    this.canvas.errors.setAttribute("aria-pressed", "true");
    this.keys = new Keys(this);
    this.help = new KeyHelp();
    this.inspector = new Inspector(this);
    this.buildBars();
    this.strip = h("section", { class: "strip", "aria-label": "Findings" });
    this.verdicts = new Verdicts(this);
    this.hint = h("p", { class: "hint", role: "status" });
    this.canvas.root.append(this.hint);
    this.root = h("div", { class: "designer" }, this.bar, this.box, this.canvas.root, this.inspector.root, h("div", { class: "below" }, this.strip, this.verdicts.root));
    this.model = new Model((why) => this.changed(why));
    this.use("select");
  }

  get view() {
    return this.canvas.view;
  }

  buildBars() {
    this.buttons = {};
    this.box = h("nav", { class: "toolbox", role: "toolbar", "aria-label": "Drawing tools", "aria-orientation": "vertical" }, TOOLS.map(([key, sign, label, letter]) => {
      const button = h("button", { type: "button", class: "draw-tool", "aria-label": label, "aria-keyshortcuts": letter, "aria-pressed": "false", onclick: (event) => this.toolPressed(key, event) }, icon(sign), h("span", {}, label), h("kbd", {}, letter));
      this.buttons[key] = button;
      return button;
    }));
    this.picker = h("select", { "aria-label": "Task", onchange: () => this.pickTask() });
    this.state = h("span", { class: "saved", role: "status" });
    this.undoButton = tool("undo", "Undo", () => this.undo());
    this.redoButton = tool("redo", "Redo", () => this.redo());
    this.more = h("select", { "aria-label": "Import and export", onchange: () => this.exchange() },
      [["", "Import, export"], ["in", "Import PNML or TOML"], ["svg", "Export SVG"], ["png", "Export PNG"], ["pnml", "Export PNML"], ["toml", "Export TOML"]].map(([v, t]) => h("option", { value: v }, t)));
    this.file = h("input", { type: "file", accept: ".pnml,.xml,.toml", hidden: true, "aria-label": "File to import", onchange: () => this.importFile() });
    this.bar = h("div", { class: "design-bar", role: "toolbar", "aria-label": "Task file" },
      this.picker, tool("plus", "New task", () => this.newTask()),
      h("button", { type: "button", class: "small", onclick: () => this.save() }, icon("save"), "Save"), this.state,
      h("div", { class: "gap" }), this.undoButton, this.redoButton,
      tool("copy", "Copy", () => this.copy()), tool("paste", "Paste", () => this.paste()), tool("trash", "Delete", () => this.removeChosen()),
      h("button", { type: "button", class: "small", onclick: () => this.layout() }, icon("layout"), "Layout"),
      this.more, this.file, tool("info", "Keyboard", () => this.help.open()), h("div", { class: "spacer" }),
      h("button", { type: "button", class: "command primary", onclick: () => this.run() }, icon("play"), "Run this task"));
  }

  // ---- files --------------------------------------------------------------------------------------------------------

  async shown() {
    this.offers = await loadOffers();
    await this.refreshTasks();
    if (!this.everShown) {
      this.everShown = true;
      const running = this.link.state.task?.name;
      const known = [...this.picker.options].map((o) => o.value).filter(Boolean);
      // who began something else while the list came in keeps that
      if (known.length && !this.documents) await this.open(known.includes(running) ? running : known[0]);
      else if (!this.documents) this.view.fit();
    }
    this.inspector.show(this.selection, true);
  }

  async refreshTasks() {
    const tasks = await listTasks();
    const names = tasks.map((t) => t.name);
    const whose = new Map(tasks.map((t) => [t.name, t.own === false ? " (shipped)" : t.shipped ? " (my copy)" : ""]));
    const own = this.model.name && !names.includes(this.model.name) ? [this.model.name] : [];
    fill(this.picker, this.model.name ? null : h("option", { value: "" }, "(new task)"), [...own, ...names].map((n) => h("option", { value: n }, `${words(n)}${whose.get(n) ?? ""}`)));
    this.picker.value = this.model.name;
  }

  /** Open a task; of several documents asked for, the last one is shown whichever answer comes last. */
  async open(name) {
    const asked = ++this.documents;
    const task = await openTask(name);
    if (!task || asked !== this.documents) return;
    this.selection = { names: new Set(), arc: null };
    this.findings = task.findings;
    this.text = task.text;
    this.isShipped = task.own === false;
    this.model.load(task);
    await this.refreshTasks();
    this.view.fit();
  }

  async pickTask() {
    const wanted = this.picker.value;
    if (this.model.dirty && !(await this.sure("Leave without saving?"))) {
      this.picker.value = this.model.name;
      return;
    }
    if (wanted) await this.open(wanted);
  }

  async newTask() {
    if (this.model.dirty && !(await this.sure("Leave without saving?"))) return;
    this.documents += 1;
    this.selection = { names: new Set(), arc: null };
    this.isShipped = false;
    this.model.load({ name: "", revision: null, document: emptyDocument("new_task") });
    this.refreshTasks();
    this.view.look(0, 0, 1);
  }

  sure(question) {
    return new Promise((resolve) => {
      const end = (answer) => {
        dialog.close();
        resolve(answer);
      };
      const dialog = h("dialog", { "aria-label": question }, h("h2", {}, question), h("p", { class: "muted" }, "There are changes that are not saved."),
        h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => end(false) }, "Stay"), h("button", { type: "button", class: "command danger", onclick: () => end(true) }, "Leave")));
      dialog.addEventListener("cancel", () => end(false));
      openDialog(dialog);
    });
  }

  async save() {
    const name = this.model.name || (await askName("Save the task as", this.model.data.task?.name ?? "new_task"));
    if (!name) return false;
    if (!this.model.name && this.model.data.task?.name === "new_task") this.model.edit("name", (data) => (data.task.name = name));
    const sent = { data: this.model.data, renames: this.model.renames };
    const documents = this.documents;
    const saved = await saveTask(this.model, name);
    if (!saved || documents !== this.documents) return false;
    this.isShipped = saved.own === false;
    if (saved.reload) this.model.load(saved);
    else this.model.savedAs(saved, sent);
    this.findings = saved.findings;
    this.text = saved.text;
    await this.refreshTasks();
    this.paintFindings();
    toast("ok", saved.reload ? "Loaded their version" : "Saved");
    return !saved.reload;
  }

  async run() {
    if ((this.model.dirty || !this.model.name) && !(await this.save())) return;
    if (this.findings.some((f) => f.severity === "error")) {
      toast("error", "The task has faults: they are listed below the drawing.");
      return;
    }
    const answer = await this.operator.give("start", { task: this.model.name });
    if (answer.ok) location.hash = "#Live";
  }

  async exchange() {
    const form = this.more.value;
    this.more.value = "";
    if (form === "in") this.file.click();
    else if (form) await exportAs(form, this.model, this.view, this.text);
  }

  async importFile() {
    const [file] = this.file.files;
    this.file.value = "";
    if (!file) return;
    const form = file.name.endsWith(".toml") ? "toml" : "pnml";
    const made = await importNet(form, await file.text());
    if (!made) return;
    this.documents += 1;
    this.isShipped = false;
    this.model.load({ name: "", revision: null, document: made.document });
    await this.refreshTasks();
    this.view.fit();
    toast("ok", `Imported ${file.name}; it is not saved yet`);
  }

  // ---- what changed -------------------------------------------------------------------------------------------------

  changed() {
    this.model ??= null;
    if (!this.model) return;
    this.pruneSelection();
    this.verdicts.forget();
    this.draw();
    this.inspector.show(this.selection);
    this.paintState();
    clearTimeout(this.checking);
    this.checking = setTimeout(() => this.check(), CHECK_MS);
  }

  paintState() {
    const { model } = this;
    text(this.state, model.dirty ? "not saved" : !model.name ? "" : this.isShipped ? "shipped, saving makes your copy" : "saved");
    attribute(this.state, "data-dirty", model.dirty ? "" : null);
    this.undoButton.disabled = !model.past.length;
    this.redoButton.disabled = !model.future.length;
    attribute(this.undoButton, "title", model.past.length ? `Undo: ${model.past.at(-1).label}` : "Undo");
  }

  pruneSelection() {
    const names = new Set([...this.selection.names].filter((n) => this.model.has(n)));
    this.selection = { names, arc: this.selection.arc };
  }

  draw() {
    this.picture = placed(this.model.picture());
    if (this.selection.arc) this.selection.arc = this.picture.arcs.find((a) => a.id === this.selection.arc.id) ?? null;
    this.canvas.show(this.picture);
    for (const place of this.picture.places) this.view.tokens(place.name, place.tokens);
    this.verdicts.paint();
    this.canvas.trail([this.model.data.task?.name || "task", ...(this.model.sheet ? [this.model.sheet] : [])], () => this.openSheet(""));
    this.paintSelection();
    this.paintFindings();
  }

  async check() {
    const { model } = this;
    const checked = model.data;
    const said = await checkDocument(model.name, checked, model.renames);
    if (!said || checked !== this.model.data) return;
    this.findings = said.findings;
    this.text = said.text;
    this.paintFindings();
    if (!this.findings.some((f) => f.severity === "error")) this.verdicts.soon();
    this.inspector.show(this.selection);
  }

  /** Findings of one element of this sheet; "" gives those of the task itself. */
  findingsOf(name) {
    return this.findings.filter((f) => this.elementOf(f) === name);
  }

  elementOf(finding) {
    const parts = (finding.key ?? "").split(".");
    const at = this.model.sheet ? 2 : 0;
    if (this.model.sheet ? parts[0] !== "subnets" || parts[1] !== this.model.sheet : parts[0] === "subnets") return null;
    if (parts[at] === "places" || parts[at] === "transitions") return parts[at + 1] ?? "";
    if (parts[0] === "primitive_tasks") return this.picture.places.find((p) => this.model.place(p.name)?.task === parts[1])?.name ?? "";
    return "";
  }

  paintFindings() {
    const worst = new Map();
    for (const finding of this.findings) {
      const name = this.elementOf(finding);
      if (name && worst.get(name)?.severity !== "error") worst.set(name, finding);
    }
    for (const element of this.view.elements.values()) {
      const finding = worst.get(element.name);
      this.view.mark(element.name, "fault", ["error", "warning"].includes(finding?.severity) ? finding.severity : null, finding?.text ?? "");
    }
    const errors = this.findings.filter((f) => f.severity === "error").length;
    const order = { error: 0, warning: 1 };
    const list = [...this.findings].sort((a, b) => (order[a.severity] ?? 2) - (order[b.severity] ?? 2));
    fill(this.strip, h("h2", {}, icon(errors ? "error" : "check"), errors ? `${errors} ${errors === 1 ? "fault" : "faults"}` : "May run", h("span", { class: "muted" }, this.findings.length > errors ? `${this.findings.length - errors} to look at` : "")),
      h("ul", {}, list.map((f) => h("li", { class: f.severity }, h("button", { type: "button", onclick: () => this.goTo(f) }, icon(f.severity === "error" ? "error" : f.severity === "warning" ? "warning" : "info"), h("strong", {}, words(this.elementOf(f) || f.key)), h("span", {}, f.text, f.remedy ? `. ${f.remedy.replace(/^./, (c) => c.toUpperCase())}.` : ""))))));
    attribute(this.strip, "data-state", errors ? "error" : "ok");
  }

  goTo(finding) {
    const parts = (finding.key ?? "").split(".");
    if (parts[0] === "subnets" && this.model.sheet !== parts[1]) this.openSheet(parts[1]);
    const name = this.elementOf(finding);
    if (name && this.canvas.goTo(name)) this.choose(new Set([name]));
  }

  // ---- selection ----------------------------------------------------------------------------------------------------

  pick(name, event) {
    if (event?.shiftKey) {
      const names = new Set(this.selection.names);
      if (!names.delete(name)) names.add(name);
      this.choose(names);
    } else this.choose(new Set([name]));
  }

  choose(names, arc = null) {
    this.selection = { names, arc };
    this.paintSelection();
    this.inspector.show(this.selection, true);
  }

  paintSelection() {
    this.view.only("chosen", this.selection.names);
    const [first] = this.selection.names;
    this.view.focusable(first ?? null);
    for (const arc of this.view.arcs.values()) {
      const on = this.selection.arc?.id === arc.id;
      if (Boolean(arc.chosen) !== on) {
        arc.chosen = on;
        arc.node.classList.toggle("chosen", on);
      }
    }
  }

  opened(element) {
    const subnet = this.model.place(element.name)?.subnet;
    if (element.kind === "macro" && subnet) this.openSheet(subnet);
    else this.inspector.root.querySelector("input.name")?.focus();
  }

  openSheet(sheet) {
    if (!this.model.hasSheet(sheet)) return;
    this.model.sheet = sheet;
    this.choose(new Set());
    this.draw();
    this.inspector.show(this.selection, true);
    this.view.fit();
  }

  // ---- edits --------------------------------------------------------------------------------------------------------

  use(name) {
    this.tool = name;
    this.arcFrom = null;
    this.view.only("target", new Set());
    for (const [key, button] of Object.entries(this.buttons)) button.setAttribute("aria-pressed", String(key === name));
    this.view.svg.dataset.tool = name;
    this.tell({ select: "", arc: "Drag from a place to a transition, or choose one after the other.", inhibit: "Drag from a place to the transition that its tokens stop." }[name] ?? "Click where it goes; Enter puts it in the middle.");
  }

  tell(message) {
    text(this.hint, message);
    this.hint.hidden = !message;
  }

  /** A tool chosen by the keyboard acts at once: there is no pointer to say where. */
  toolPressed(key, event) {
    this.use(key);
    if (event.detail === 0 && !["select", "arc", "inhibit"].includes(key)) this.insertFree(key);
  }

  /** Put a new element where the pointer says, in line with those that are nearly in line already. */
  insertNear(kind, x, y) {
    const all = [...this.view.elements.values()];
    const near = (axis, value) => all.filter((e) => Math.abs(e[axis] - value) < NEARLY).sort((a, b) => Math.abs(a[axis] - value) - Math.abs(b[axis] - value))[0]?.[axis] ?? snap(value);
    return this.insert(kind, near("x", x), near("y", y));
  }

  insert(kind, x, y) {
    const name = kind === "transition" ? this.model.addTransition(Math.round(x), Math.round(y)) : this.model.addPlace(kind, Math.round(x), Math.round(y));
    this.use("select");
    this.choose(new Set([name]));
    this.view.elements.get(name)?.node.focus({ preventScroll: true });
    return name;
  }

  /** Beside the selection, or in the middle of what is seen, where nothing stands yet. */
  insertFree(kind) {
    const [first] = this.selection.names;
    const near = this.view.elements.get(first);
    const box = this.view.svg.getBoundingClientRect();
    let [x, y] = near ? [near.x + 120, near.y] : this.view.at(box.left + box.width / 2, box.top + box.height / 2);
    const taken = () => [...this.view.elements.values()].some((e) => Math.hypot(e.x - x, e.y - y) < 70);
    while (taken()) y += 90;
    return this.insert(kind, x, y);
  }

  connect(from, to) {
    const fault = this.model.connect(from, to, this.tool === "inhibit");
    if (fault) toast("warning", fault);
    return !fault;
  }

  /** A transition for a way out of an action place that has none yet. */
  addExit(place, end) {
    const at = this.view.elements.get(place);
    const stem = end === "error" ? `${place}_error` : `${place}_done`;
    let y = snap(end === "error" ? at.y + 110 : at.y);
    while ([...this.view.elements.values()].some((e) => Math.hypot(e.x - at.x - 110, e.y - y) < 50)) y += 70;
    const name = this.model.addTransition(snap(at.x + 110), y, stem);
    this.model.connect(place, name);
    const arc = this.picture.arcs.find((a) => a.place === place && a.transition === name);
    if (arc && arc.end !== end) this.model.setArc(arc, { end });
    this.choose(new Set([name]));
  }

  changeArc(arc, change) {
    this.model.setArc(arc, change);
    const same = this.picture.arcs.find((a) => a.place === arc.place && a.transition === arc.transition && a.direction === arc.direction && (change.end === undefined ? a.end === arc.end : a.end === change.end));
    this.choose(new Set(), same ?? null);
  }

  removeChosen() {
    const { names, arc } = this.selection;
    if (!names.size && !arc) return;
    this.model.remove(names, arc ? [arc] : []);
    this.choose(new Set());
  }

  undo() {
    const label = this.model.undo();
    if (label) toast("info", `Undone: ${label}`);
  }

  redo() {
    const label = this.model.redo();
    if (label) toast("info", `Done again: ${label}`);
  }

  copy() {
    if (!this.selection.names.size) return;
    localStorage.setItem("petrobot.clip", JSON.stringify(this.model.clip(this.selection.names)));
    this.pasted = 0;
    toast("ok", `${this.selection.names.size} copied`);
  }

  paste() {
    const clip = JSON.parse(localStorage.getItem("petrobot.clip") ?? "null");
    if (!clip) return;
    this.pasted = (this.pasted ?? 0) + 1;
    const names = this.model.paste(clip, 40 * this.pasted, 60 * this.pasted);
    this.choose(new Set(names ?? []));
  }

  chosenElements() {
    return [...this.selection.names].map((n) => this.view.elements.get(n)).filter(Boolean);
  }

  align(axis) {
    const chosen = this.chosenElements();
    if (chosen.length < 2) return;
    const middle = snap(chosen.reduce((sum, e) => sum + e[axis], 0) / chosen.length);
    this.model.move(Object.fromEntries(chosen.map((e) => [e.name, axis === "x" ? [middle, e.y] : [e.x, middle]])));
  }

  distribute() {
    const chosen = this.chosenElements();
    if (chosen.length < 3) return;
    const span = (axis) => Math.max(...chosen.map((e) => e[axis])) - Math.min(...chosen.map((e) => e[axis]));
    const axis = span("x") >= span("y") ? "x" : "y";
    chosen.sort((a, b) => a[axis] - b[axis]);
    const [first, last] = [chosen[0][axis], chosen.at(-1)[axis]];
    const at = (i) => snap(first + ((last - first) * i) / (chosen.length - 1));
    this.model.move(Object.fromEntries(chosen.map((e, i) => [e.name, axis === "x" ? [at(i), e.y] : [e.x, at(i)]])));
  }

  layout() {
    const all = automatic(this.picture);
    const { names } = this.selection;
    const positions = names.size > 1 ? Object.fromEntries(Object.entries(all).filter(([n]) => names.has(n))) : all;
    this.model.move(positions);
    this.view.reroute(new Set(), true);
    this.view.fit();
  }

  /** Lines that show what a dragged element is in line with. */
  guides(lines) {
    fill(this.view.layers.over, lines.map(([x0, y0, x1, y1]) => s("line", { class: "guide", x1: x0, y1: y0, x2: x1, y2: y1 })));
  }
}
