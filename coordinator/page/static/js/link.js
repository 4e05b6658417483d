// The WebSocket to the coordinator: snapshot, numbered deltas merged once a frame, commands and their answers.

import { apply, emptyState, PART } from "./state.js";

const LOST_AFTER_MS = 3500; // the coordinator says each second that it is alive
const RETRY_MS = [250, 500, 1000, 2000, 4000];
const ANSWER_MS = 20000;
const GOING_AWAY = 1001;
const UNKNOWN_HERE = 401;

/** A tab's secret: it stays the same operator after a refresh. It is stored only while the page is away, since the
 * browser copies what is stored into a duplicate of the tab, which is another operator. */
const SECRET = "petrobot.tab";
const made = () => Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
const tabSecret = sessionStorage.getItem(SECRET) ?? made();
sessionStorage.removeItem(SECRET);
addEventListener("pagehide", () => sessionStorage.setItem(SECRET, tabSecret));
addEventListener("pageshow", () => sessionStorage.removeItem(SECRET));

export class Link {
  /** `painted(changed, changes)` is called at most once a frame with the set of altered parts. */
  constructor(painted) {
    this.state = emptyState();
    this.connected = false;
    this.everConnected = false;
    this.goodbye = false; // the server said that it ends, so nothing was lost
    this.refused = false; // a coordinator answers, but it does not know this browser: it was started again with another key
    this.fault = ""; // why a message could not be read or shown
    this.behind = false; // changes are missing, and a snapshot has been asked for
    this.gaps = 0;
    this.deltas = 0;
    this.receivedAt = 0;
    this.painted = painted;
    this.waiting = [];
    this.changed = new Set();
    this.frame = 0;
    this.answers = new Map();
    this.number = 0;
    this.tries = 0;
    this.heardAt = 0;
    this.met = new Promise((resolve) => (this.meet = resolve)); // the first snapshot has come, or will not soon
    setInterval(() => this.watch(), 500);
    document.addEventListener("visibilitychange", () => this.reschedule());
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/live`);
    this.socket = socket;
    this.heardAt = performance.now();
    let met = false;
    socket.onopen = () => {
      met = true;
      this.refused = false;
      socket.send(JSON.stringify({ type: "hello", protocol: 1, name: "operator", tab: tabSecret }));
    };
    socket.onmessage = (event) => this.receive(socket, event.data);
    socket.onclose = (event) => {
      if (socket === this.socket && event.code === GOING_AWAY && event.reason) this.goodbye = true;
      if (socket === this.socket && !met) this.askWhy();
      this.lost(socket);
    };
  }

  lost(socket) {
    if (!socket || socket !== this.socket) return;
    this.socket = null;
    this.meet();
    this.state.time = this.now(this.heardAt); // the clock stops where it was heard of last
    this.connected = false;
    this.note("connection");
    for (const answer of this.answers.values()) answer({ ok: false, code: "lost", text: "the connection was lost" });
    this.answers.clear();
    setTimeout(() => this.open(), RETRY_MS[Math.min(this.tries++, RETRY_MS.length - 1)]);
  }

  /** A browser does not learn why its WebSocket was refused; a plain request shows whether the key is the reason. */
  async askWhy() {
    try {
      const { status } = await fetch(new URL("../icon.svg", import.meta.url), { method: "HEAD", cache: "no-store" });
      this.refused = status === UNKNOWN_HERE;
    } catch {
      this.refused = false; // no answer at all
    }
    this.note("connection");
  }

  /** A message that cannot be read is a lost connection: what it said is missing from here on. */
  receive(socket, data) {
    if (socket !== this.socket) return;
    try {
      this.hear(JSON.parse(data));
    } catch (fault) {
      this.broken(fault);
    }
  }

  /** A message cannot be read or shown: report it, and start again with a new snapshot. */
  broken(fault) {
    console.error(fault);
    this.fault = String(fault?.message ?? fault);
    const { socket } = this;
    this.waiting = [];
    this.lost(socket);
    socket?.close();
  }

  watch() {
    const { socket } = this;
    if (!socket || performance.now() - this.heardAt <= LOST_AFTER_MS) return;
    this.lost(socket); // at once: without a network, closing takes long
    socket.close();
  }

  hear(message) {
    this.heardAt = performance.now();
    if (message.type === "answer") {
      this.answers.get(message.id)?.(message);
      this.answers.delete(message.id);
      return;
    }
    if (message.type === "alive") return;
    this.waiting.push(message);
    this.schedule();
  }

  note(part) {
    this.changed.add(part);
    this.schedule();
  }

  schedule() {
    if (this.frame) return;
    // a hidden window gets no frames; its messages must not pile up
    this.hidden = document.hidden;
    this.frame = this.hidden ? setTimeout(() => this.paint(), 400) : requestAnimationFrame(() => this.paint());
  }

  reschedule() {
    if (!this.frame) return;
    if (this.hidden) clearTimeout(this.frame);
    else cancelAnimationFrame(this.frame);
    this.frame = 0;
    this.schedule();
  }

  paint() {
    this.frame = 0;
    const messages = this.waiting;
    this.waiting = [];
    const changes = [];
    try {
      for (const message of messages) {
        if (message.type === "snapshot") this.takeSnapshot(message, changes);
        else if (message.type === "delta") this.takeDelta(message, changes);
      }
      const changed = this.changed;
      this.changed = new Set();
      this.painted(changed, changes);
    } catch (fault) {
      this.broken(fault);
      return;
    }
    if (!this.connected) return;
    this.tries = 0; // only now: a snapshot that cannot be shown must not be asked for four times a second
    if (this.fault) {
      this.fault = "";
      this.note("connection");
    }
  }

  takeSnapshot(message, changes) {
    const { type, protocol, ...state } = message;
    this.state = { ...emptyState(), ...state };
    this.clock(this.state.time);
    changes.length = 0; // they are part of the snapshot already
    this.behind = false;
    this.changed.add("all");
    this.connected = this.everConnected = true;
    this.goodbye = false;
    this.meet();
    document.documentElement.dataset.sequence = String(this.state.sequence);
  }

  takeDelta(message, changes) {
    if (message.first !== this.state.sequence + 1) {
      // asked for once: more deltas arrive before the snapshot, and each request would bring one more
      if (!this.behind) this.socket?.send(JSON.stringify({ type: "resync" }));
      this.behind = true;
      this.gaps += 1;
      return;
    }
    for (const change of message.changes) {
      apply(this.state, change);
      this.changed.add(PART[change.kind] ?? "unknown");
      changes.push(change);
    }
    this.deltas += 1;
    this.state.sequence = message.last;
    this.clock(message.time);
    document.documentElement.dataset.sequence = String(message.last);
  }

  clock(time) {
    this.state.time = Math.max(0, [time, this.state.time, 0].find(Number.isFinite));
    this.receivedAt = performance.now();
  }

  /** The mission's clock now (s): in real time it advances between messages, in lock step only with messages. */
  now(at = performance.now()) {
    const { mission, time } = this.state;
    const goes = mission.mode === "realtime" && ["running", "stopping"].includes(mission.state) && this.connected; // in a pause, too
    return goes ? time + Math.max(0, at - this.receivedAt) / 1000 : time;
  }

  /** Send a command; resolves with the server's answer {ok, code, text, ...}. */
  command(verb, data = {}) {
    if (!this.connected || !this.socket) {
      return Promise.resolve({ ok: false, code: "lost", text: "there is no connection to the coordinator" });
    }
    const id = ++this.number;
    this.socket.send(JSON.stringify({ type: "command", id, verb, data }));
    return new Promise((resolve) => {
      this.answers.set(id, resolve);
      setTimeout(() => {
        if (this.answers.delete(id)) resolve({ ok: false, code: "silent", text: `not confirmed within ${ANSWER_MS / 1000} s; it may still take effect` });
      }, ANSWER_MS);
    });
  }

  /** Why this page can give no command now; empty if it can. Free controls are taken with the first command. */
  get barred() {
    const { controls, you } = this.state;
    if (!this.connected) return "No connection";
    return controls.holder === null || controls.holder === you ? "" : `${controls.holder} holds the controls. Ask for them under Live.`;
  }
}
