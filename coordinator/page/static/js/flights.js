// Tokens that fly along arcs: constant flight time, frozen on pause, thinned at high rates.

import { s } from "./dom.js";
import { at } from "./geometry.js";

const HALF_MS = 210; // into the transition, and again out of it
const AT_ONCE = 48;
const SAME_ARC_MS = 140;

export class Flights {
  constructor(layer, landed) {
    this.layer = layer;
    this.landed = landed;
    this.going = [];
    this.spare = [];
    this.lastOn = new WeakMap();
    this.frame = 0;
    this.frozen = false;
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** Begin a flight; `second` is the half after the transition. False when it is left out: too many, or motion unwanted. */
  start(arc, second, failed) {
    const now = performance.now();
    const soon = now - (this.lastOn.get(arc) ?? -Infinity) < SAME_ARC_MS;
    if (this.calm.matches || document.hidden || this.going.length >= AT_ONCE || soon) return false;
    this.lastOn.set(arc, now);
    const dot = this.spare.pop() ?? s("circle", { r: 5.5 });
    dot.setAttribute("class", failed ? "flight failed" : "flight");
    dot.setAttribute("visibility", "hidden");
    this.layer.append(dot);
    // one that begins during a pause is the operator's own step: it is not held
    this.going.push({ arc, dot, done: second ? -HALF_MS : 0, held: !this.frozen });
    this.wake();
    return true;
  }

  freeze(frozen) {
    if (this.frozen === frozen) return;
    this.frozen = frozen;
    if (frozen) for (const flight of this.going) flight.held = true;
    this.wake();
  }

  /** End all flights now, as after a snapshot. */
  clear() {
    for (const flight of this.going.splice(0)) this.end(flight);
  }

  wake() {
    if (this.frame || !this.going.some((flight) => this.moves(flight))) return;
    this.before = performance.now();
    this.frame = requestAnimationFrame((now) => this.step(now));
  }

  moves(flight) {
    return !this.frozen || !flight.held;
  }

  step(now) {
    this.frame = 0;
    const passed = Math.min(100, Math.max(0, now - this.before));
    this.before = now;
    this.going = this.going.filter((flight) => this.advance(flight, passed));
    if (this.going.some((flight) => this.moves(flight))) this.frame = requestAnimationFrame((next) => this.step(next));
  }

  /** Returns false when the flight has ended. */
  advance(flight, passed) {
    if (!this.moves(flight)) return true;
    flight.done += passed;
    if (flight.done >= HALF_MS) {
      this.end(flight);
      return false;
    }
    if (flight.done >= 0) {
      const [x, y] = at(flight.arc.curve, flight.done / HALF_MS);
      flight.dot.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
      if (!flight.seen) {
        flight.seen = true;
        flight.dot.removeAttribute("visibility");
      }
    }
    return true;
  }

  end(flight) {
    flight.dot.remove();
    this.spare.push(flight.dot);
    this.landed(flight.arc);
  }
}
