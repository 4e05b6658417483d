// Tokens that fly along arcs: constant flight time, frozen on pause, thinned at high rates.

import { s } from "./dom.js";
import { at } from "./geometry.js";

const FLIGHT_MS = 420; // into the transition and out of it, half each
const AT_ONCE = 48;
const SAME_ARC_MS = 140;

export class Flights {
  constructor(layer, landed) {
    this.layer = layer;
    this.landed = landed;
    this.going = [];
    this.free = [];
    this.lastOn = new WeakMap();
    this.clock = 0;
    this.before = 0;
    this.frame = 0;
    this.frozen = false;
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** Begin a flight; `second` is the half after the transition. False when it is left out: too many, or motion unwanted. */
  start(arc, second, failed) {
    if (!this.frame && !this.frozen) this.clock += performance.now() - this.before;
    if (!this.frame) this.before = performance.now();
    const last = this.lastOn.get(arc) ?? -Infinity;
    if (this.calm.matches || document.hidden || this.going.length >= AT_ONCE || this.clock - last < SAME_ARC_MS) return false;
    this.lastOn.set(arc, this.clock);
    const dot = this.free.pop() ?? s("circle", { r: 5.5 });
    dot.setAttribute("class", failed ? "flight failed" : "flight");
    dot.setAttribute("visibility", "hidden");
    this.layer.append(dot);
    this.going.push({ arc, dot, begins: this.clock + (second ? FLIGHT_MS / 2 : 0) });
    this.wake();
    return true;
  }

  freeze(frozen) {
    this.frozen = frozen;
    if (!frozen) this.wake();
  }

  /** End all flights now, as after a snapshot. */
  clear() {
    for (const flight of this.going.splice(0)) this.end(flight);
  }

  wake() {
    if (this.frame || this.frozen) return;
    this.before = performance.now();
    this.frame = requestAnimationFrame((now) => this.step(now));
  }

  step(now) {
    this.frame = 0;
    this.clock += Math.min(100, Math.max(0, now - this.before));
    this.before = now;
    const going = [];
    for (const flight of this.going) {
      const part = (this.clock - flight.begins) / (FLIGHT_MS / 2);
      if (part >= 1) {
        this.end(flight);
        continue;
      }
      if (part >= 0) {
        const [x, y] = at(flight.arc.curve, part);
        flight.dot.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
        if (!flight.seen) {
          flight.seen = true;
          flight.dot.removeAttribute("visibility");
        }
      }
      going.push(flight);
    }
    this.going = going;
    if (going.length && !this.frozen) this.frame = requestAnimationFrame((next) => this.step(next));
  }

  end(flight) {
    flight.dot.remove();
    this.free.push(flight.dot);
    this.landed(flight.arc);
  }
}
