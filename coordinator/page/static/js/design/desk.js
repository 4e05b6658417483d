// The open task file: open, new, save, import and export; unsaved work is never lost.

import { askDialog } from "../dialog.js";
import { h } from "../dom.js";
import { askName, exportAs, importNet, listTasks, openTask, revisionOf, saveTask } from "../files.js";
import { READABLE } from "../geometry.js";
import { toast } from "../toast.js";
import { emptyDocument } from "./model.js";

const CHANGED = "changed";
const LOOK_MS = 2000;

export class Desk {
  constructor(designer) {
    Object.assign(this, { designer, documents: 0, isShipped: false, outside: null, last: Promise.resolve() });
    setInterval(() => this.look(), LOOK_MS);
    this.file = h("input", { type: "file", accept: ".pnml,.xml,.toml", hidden: true, "aria-label": "File to import", onchange: () => this.importFile() });
  }

  get model() {
    return this.designer.model;
  }

  /** Open a document in place of the one before; returns its number. */
  put(task, isShipped = false) {
    this.documents += 1;
    this.isShipped = isShipped;
    this.model.load(task);
    return this.documents;
  }

  /** When the designer is first shown, open the running task, or the first one, unless another document was begun. */
  async first() {
    const tasks = await this.refresh();
    if (this.everShown || this.documents) return;
    this.everShown = true;
    const running = this.designer.link.state.task?.name;
    const known = tasks.map((t) => t.name);
    for (const name of known.includes(running) ? [running, ...known] : known) {
      if (await this.open(name)) return; // one that cannot be read does not keep the others closed
    }
    this.designer.view.fit(READABLE);
  }

  async refresh() {
    const tasks = await listTasks();
    this.designer.bar.list(tasks);
    return tasks;
  }

  /**
   * Open a task; of several documents asked for, the last one is shown whichever answer comes last. False when it cannot be
   * read: what was open stays, and so does its name.
   */
  async open(name) {
    const asked = ++this.documents;
    const task = await openTask(name);
    if (asked !== this.documents) return true;
    if (!task) {
      this.designer.bar.paint();
      return false;
    }
    const put = this.put(task, task.own === false);
    this.designer.findings.take(task);
    await this.refresh();
    if (put === this.documents) this.designer.view.fit(READABLE); // what was begun meanwhile stays where the hand is
    return true;
  }

  async pick(wanted) {
    if (!(await this.mayLeave())) this.designer.bar.paint();
    else if (wanted) await this.open(wanted);
  }

  async begin() {
    if (!(await this.mayLeave())) return;
    this.put({ name: "", revision: null, document: emptyDocument("new_task") });
    this.refresh();
    this.designer.view.look(0, 0, 1);
  }

  /** Whether the open document may be closed; asks if it is not saved. */
  mayLeave() {
    if (!this.model.dirty) return Promise.resolve(true);
    const question = "Leave without saving?";
    return askDialog({ "aria-label": question }, (end) => [
      h("h2", {}, question), h("p", { class: "muted" }, "There are changes that are not saved."),
      h("div", { class: "buttons" }, h("button", { type: "button", class: "small", onclick: () => end(null) }, "Stay"), h("button", { type: "button", class: "command danger", onclick: () => end(true) }, "Leave"))]);
  }

  /** Notice that the file was edited by another program or person since it was opened here. */
  async look() {
    const { name, base } = this.model;
    if (!name || !base || this.looking || this.designer.root.hidden || document.hidden || !this.designer.link.connected) return;
    this.looking = true;
    const now = await revisionOf(name);
    this.looking = false;
    if (now === null || name !== this.model.name || base !== this.model.base) return; // not known, or saved meanwhile
    const outside = now === base ? null : now;
    if (outside && outside !== this.outside) toast("warning", `${name} was changed by another program since you opened it`);
    this.outside = outside;
    this.designer.bar.paint();
  }

  /** Whether the file has changed since it was opened here. */
  get isOld() {
    return Boolean(this.outside) && this.outside !== this.model.base;
  }

  /** Open the file's present content. */
  async loadAgain() {
    if (await this.mayLeave()) await this.open(this.model.name);
  }

  /** Run requests one after the other: one made during a save or an import is about the document that is open after it. */
  inTurn(step) {
    this.last = this.last.then(step, step);
    return this.last;
  }

  save() {
    return this.inTurn(() => this.saveNow());
  }

  async saveNow() {
    const { model } = this;
    const name = model.name || (await askName("Save the task as", model.data.task?.name ?? "new_task"));
    if (!name) return false;
    if (!model.name && model.data.task?.name === "new_task") model.edit("name", (data) => (data.task.name = name));
    const sent = { data: model.data, renames: model.renames };
    const { documents } = this;
    const saved = await saveTask(model, name);
    if (!saved || documents !== this.documents) return false;
    this.isShipped = saved.own === false;
    if (saved.reload) model.load(saved);
    else model.savedAs(saved, sent);
    this.designer.findings.take(saved);
    await this.refresh();
    toast("ok", saved.reload ? "Loaded their version" : "Saved");
    return !saved.reload;
  }

  /** Save what is drawn and start it. */
  async run() {
    if ((this.model.dirty || !this.model.name) && !(await this.save())) return;
    if (this.designer.findings.errors) {
      toast("error", "The task has faults: they are listed below the drawing.");
      return;
    }
    const answer = await this.designer.operator.give("start", { task: this.model.name, revision: this.model.base });
    if (answer.ok) location.hash = "#Live";
    else if (answer.code === CHANGED) await this.look();
  }

  async exchange(form) {
    if (form === "in") this.file.click();
    else if (form) await this.inTurn(() => exportAs(form, this.model, this.designer.view, this.designer.findings.text));
  }

  async importFile() {
    const [file] = this.file.files;
    this.file.value = "";
    if (file) await this.inTurn(() => this.importNow(file));
  }

  async importNow(file) {
    if (await this.mayLeave()) await this.designer.during(this.bringIn(file));
  }

  async bringIn(file) {
    const asked = ++this.documents;
    const made = await importNet(file.name.endsWith(".toml") ? "toml" : "pnml", await file.text());
    if (asked !== this.documents) return; // another document was asked for meanwhile
    if (!made) {
      this.designer.bar.paint();
      return;
    }
    const put = this.put({ name: "", revision: null, document: made.document });
    await this.refresh();
    if (put === this.documents) this.designer.view.fit(READABLE);
    toast("ok", `Imported ${file.name}; it is not saved yet`);
  }
}
