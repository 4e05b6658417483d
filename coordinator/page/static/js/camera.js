// An image of a camera with what was seen in it drawn over it: circles, boxes, points and paths in pixels.

import { attribute, fill, h, s, seconds, text, words } from "./dom.js";

const GLYPH = 0.62; // widths of a letter and heights of a line, in font sizes
const LINE = 1.15;
const NO_VALUE = "–";
const COLOUR = { predicted: "predicted", found: "found" };

function shape(d) {
  const common = { class: `detection ${COLOUR[d.role] ?? "found"}` };
  if (d.kind === "circle") return s("circle", { ...common, cx: d.x, cy: d.y, r: d.r });
  if (d.kind === "box") return s("rect", { ...common, x: d.x, y: d.y, width: d.width, height: d.height });
  if (d.kind === "path") return s("polyline", { ...common, points: (d.points ?? []).map((p) => p.join(",")).join(" ") });
  return s("path", { ...common, d: `M${d.x - 9} ${d.y}h18M${d.x} ${d.y - 9}v18` });
}

/** Labels next to what they name, inside the image and without overlap: later ones move to another corner, then up or down. */
export function labels(seen, width, height) {
  const size = Math.max(10, height / 18);
  const taken = [];
  return seen.map((d) => {
    const [x, y, gap] = [d.x ?? 0, d.y ?? 0, (d.r ?? 0) + 8];
    const wide = d.label.length * size * GLYPH;
    const right = x + (d.width ?? 0) + gap;
    const sides = right + wide < width ? [right, x - gap - wide] : [x - gap - wide, right];
    const rows = [0, 1, -1, 2, -2, 3, -3, 4, -4].map((n) => y - 8 + n * size * LINE);
    const inside = (left) => Math.max(2, Math.min(left, width - wide - 2));
    const spots = rows.flatMap((base) => sides.map((left) => ({ left: inside(left), base: Math.max(size, Math.min(base, height - 4)) })));
    const free = (spot) => taken.every((t) => spot.left >= t.left + t.wide || t.left >= spot.left + wide || Math.abs(spot.base - t.base) >= size * LINE * 0.98);
    const spot = spots.find(free) ?? spots[0];
    taken.push({ ...spot, wide });
    return s("text", { class: "detection-label", "font-size": size, x: spot.left, y: spot.base }, d.label);
  });
}

class Frame {
  constructor(source) {
    this.image = s("image", { x: 0, y: 0 });
    this.over = s("g");
    this.picture = s("svg", { class: "picture", role: "img", "aria-label": `Image of ${words(source)}`, preserveAspectRatio: "xMinYMid meet" }, this.image, this.over);
    this.note = h("span", {});
    this.root = h("figure", { class: "camera" }, this.picture, h("figcaption", {}, h("strong", {}, words(source)), this.note));
  }

  update(image) {
    const [width, height] = [Number(image.width) || 1, Number(image.height) || 1];
    attribute(this.picture, "viewBox", `0 0 ${width} ${height}`);
    this.picture.style.aspectRatio = `${width} / ${height}`;
    attribute(this.image, "width", width);
    attribute(this.image, "height", height);
    const mime = /^image\/(jpeg|png|webp)$/.test(image.mime) ? image.mime : "image/jpeg";
    attribute(this.image, "href", `data:${mime};base64,${image.data}`);
    const seen = image.detections ?? [];
    fill(this.over, seen.map(shape), labels(seen.filter((d) => d.label), width, height));
    text(this.note, [Number.isFinite(image.age) ? `${Math.round(image.age * 1000)} ms old` : "", image.note].filter(Boolean).join(" · "));
  }
}

export class Cameras {
  constructor() {
    this.frames = new Map();
    this.empty = h("p", { class: "empty" }, "No images are arriving. They appear here while a camera's action runs.");
    this.root = h("div", { class: "cameras" }, this.empty);
  }

  update(images) {
    const names = Object.keys(images);
    this.empty.hidden = names.length > 0;
    for (const name of names) {
      if (!this.frames.has(name)) {
        this.frames.set(name, new Frame(name));
        this.root.append(this.frames.get(name).root);
      }
      if (this.frames.get(name).shown !== images[name]) {
        this.frames.get(name).update(images[name]);
        this.frames.get(name).shown = images[name];
      }
    }
    for (const [name, frame] of this.frames) {
      if (names.includes(name)) continue;
      frame.root.remove();
      this.frames.delete(name);
    }
  }
}

/** Joint angles or any values of devices, as small gauges. */
export class Devices {
  constructor() {
    this.root = h("div", { class: "devices" });
  }

  update(devices) {
    const entries = Object.entries(devices);
    if (!entries.length) fill(this.root, h("p", { class: "empty" }, "No device has reported its state."));
    else fill(this.root, entries.map(([name, device]) => this.card(name, device)));
  }

  card(name, device) {
    const joints = (device.joints ?? []).map((angle, i) => {
      if (!Number.isFinite(angle)) return h("li", {}, h("span", {}, `J${i + 1}`), h("span"), h("span", { class: "number" }, NO_VALUE));
      const [low, high] = device.limits?.[i]?.every(Number.isFinite) ? device.limits[i] : [-Math.PI, Math.PI];
      const part = Math.max(0, Math.min(1, (angle - low) / (high - low || 1)));
      return h("li", {}, h("span", {}, `J${i + 1}`), h("meter", { min: 0, max: 1, value: part.toFixed(3) }), h("span", { class: "number" }, `${((angle * 180) / Math.PI).toFixed(1)}°`));
    });
    const values = Object.entries(device.values ?? {}).map(([key, value]) => h("div", {}, h("dt", {}, words(key)), h("dd", {}, typeof value === "number" ? value.toPrecision(4) : String(value ?? NO_VALUE))));
    return h("article", { class: "device" }, h("h3", {}, words(name), h("span", { class: `chip ${device.level ?? ""}` }, words(device.state ?? ""))), joints.length ? h("ol", { class: "joints" }, joints) : null, values.length ? h("dl", {}, values) : null, Number.isFinite(device.age) ? h("p", { class: "muted" }, `${seconds(device.age)} old`) : null);
  }
}
