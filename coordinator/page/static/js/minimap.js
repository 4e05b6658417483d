// The whole net in a corner, with a frame around the part in view; a click goes there.

import { s } from "./dom.js";

const W = 168;
const H = 104;

export class Minimap {
  constructor(host) {
    this.dots = s("g");
    this.frame = s("rect", { class: "frame", rx: 3 });
    this.svg = s("svg", { class: "minimap", width: W, height: H, "aria-hidden": "true" }, this.dots, this.frame);
    this.svg.addEventListener("pointerdown", (event) => this.go(event));
    this.svg.addEventListener("pointermove", (event) => event.buttons && this.go(event));
    host.append(this.svg);
  }

  /** Draw all elements of a view again (after its structure changed). */
  draw(view) {
    this.view = view;
    const box = view.box;
    this.svg.parentElement.hidden = !box;
    if (!box) return;
    this.scale = Math.min(W / (box[2] - box[0]), H / (box[3] - box[1]));
    this.left = (W - (box[2] - box[0]) * this.scale) / 2 - box[0] * this.scale;
    this.top = (H - (box[3] - box[1]) * this.scale) / 2 - box[1] * this.scale;
    this.dots.replaceChildren(
      ...[...view.elements.values()].filter((e) => !view.isFolded(e)).map((e) => {
        const [x, y] = [e.x * this.scale + this.left, e.y * this.scale + this.top];
        return e.shape === "place"
          ? s("circle", { class: `dot ${e.kind}`, cx: x, cy: y, r: 2.6 })
          : s("rect", { class: "bar", x: x - 1, y: y - 3, width: 2, height: 6 });
      }),
    );
    this.follow();
  }

  follow() {
    if (!this.view?.box || !this.scale) return;
    const { x, y, zoom } = this.view.view;
    const { clientWidth: w, clientHeight: h } = this.view.svg;
    const box = this.view.box;
    const whole = box[0] * zoom + x > -60 && box[1] * zoom + y > -40 && box[2] * zoom + x < w + 60 && box[3] * zoom + y < h + 40;
    this.svg.parentElement.hidden = whole; // nothing to find: all is in view
    const set = { x: (-x / zoom) * this.scale + this.left, y: (-y / zoom) * this.scale + this.top, width: (w / zoom) * this.scale, height: (h / zoom) * this.scale };
    for (const [key, value] of Object.entries(set)) this.frame.setAttribute(key, value.toFixed(1));
  }

  go(event) {
    if (!this.scale) return;
    const box = this.svg.getBoundingClientRect();
    const [mx, my] = [(event.clientX - box.left - this.left) / this.scale, (event.clientY - box.top - this.top) / this.scale];
    const { clientWidth: w, clientHeight: h } = this.view.svg;
    const zoom = this.view.view.zoom;
    this.view.look(w / 2 - mx * zoom, h / 2 - my * zoom, zoom);
  }
}
