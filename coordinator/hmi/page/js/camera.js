// An image of a camera with what was seen in it drawn over it: circles, boxes, points and paths in pixels.

import { attribute, fill, h, s, seconds, text, words } from "./dom.js";

const COLOUR = { predicted: "predicted", found: "found" };

function shape(d) {
  const common = { class: `detection ${COLOUR[d.role] ?? "found"}` };
  if (d.kind === "circle") return s("circle", { ...common, cx: d.x, cy: d.y, r: d.r });
  if (d.kind === "box") return s("rect", { ...common, x: d.x, y: d.y, width: d.width, height: d.height });
  if (d.kind === "path") return s("polyline", { ...common, points: (d.points ?? []).map((p) => p.join(",")).join(" ") });
  return s("path", { ...common, d: `M${d.x - 9} ${d.y}h18M${d.x} ${d.y - 9}v18` });
}

class Frame {
  constructor(source) {
    this.image = h("img", { alt: `Image of ${words(source)}` });
    this.over = s("svg", { preserveAspectRatio: "xMidYMid meet" });
    this.note = h("span", {});
    this.root = h("figure", { class: "camera" }, h("div", { class: "picture" }, this.image, this.over), h("figcaption", {}, h("strong", {}, words(source)), this.note));
  }

  update(image) {
    attribute(this.image, "src", `data:${/^image\/(jpeg|png|webp)$/.test(image.mime) ? image.mime : "image/jpeg"};base64,${image.data}`);
    attribute(this.over, "viewBox", `0 0 ${Number(image.width)} ${Number(image.height)}`);
    const seen = image.detections ?? [];
    fill(this.over, seen.map(shape), seen.filter((d) => d.label).map((d) => s("text", { class: "detection-label", x: (d.x ?? 0) + (d.r ?? 0) + 6, y: (d.y ?? 0) - 6 }, d.label)));
    text(this.note, [image.age !== undefined ? `${Math.round(image.age * 1000)} ms old` : "", image.note].filter(Boolean).join(" · "));
  }
}

export class Cameras {
  constructor() {
    this.frames = new Map();
    this.empty = h("p", { class: "empty" }, "No images come in. They appear here while a camera's action runs.");
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
      const [low, high] = device.limits?.[i] ?? [-Math.PI, Math.PI];
      const part = Math.max(0, Math.min(1, (angle - low) / (high - low || 1)));
      return h("li", {}, h("span", {}, `J${i + 1}`), h("meter", { min: 0, max: 1, value: part.toFixed(3) }), h("span", { class: "number" }, `${((angle * 180) / Math.PI).toFixed(1)}°`));
    });
    const values = Object.entries(device.values ?? {}).map(([key, value]) => h("div", {}, h("dt", {}, words(key)), h("dd", {}, typeof value === "number" ? value.toPrecision(4) : String(value))));
    return h("article", { class: "device" }, h("h3", {}, words(name), h("span", { class: `chip ${device.level ?? ""}` }, words(device.state ?? ""))), joints.length ? h("ol", { class: "joints" }, joints) : null, values.length ? h("dl", {}, values) : null, device.age !== undefined ? h("p", { class: "muted" }, `${seconds(device.age)} old`) : null);
  }
}
