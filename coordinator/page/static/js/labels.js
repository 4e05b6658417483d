// Positions of labels: on the side where they cover no arc, no other element and no other label.

import { at, BAR_H, BAR_W, labelAt, PLACE_R } from "./geometry.js";

const SIDES = ["below", "above", "right", "left"];
const CELL = 120;
const SAMPLES = 16;
const COST = { arc: 3, node: 25, words: 14, side: 0.5 }; // of what is covered; of each side behind the preferred one
const WIDTH = { place: 7.2, transition: 6.2, sub: 5.8 }; // of a character, about
const UP = 11;
const DOWN = 4;

const touch = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

/** The boxes [left, top, right, bottom] of an element's words on one side of it. */
function boxesAt(element, side) {
  const [x, y, below, anchor] = labelAt(element, side);
  const subY = side === "below" || side === "above" || element.shape === "place" ? below : y - 14;
  const box = (words, width, line) => {
    const wide = words.length * width;
    const left = element.x + x - (anchor === "middle" ? wide / 2 : anchor === "end" ? wide : 0);
    return [left, element.y + line - UP, left + wide, element.y + line + DOWN];
  };
  return [box(element.said ?? "", WIDTH[element.shape], y), ...(element.subSaid ? [box(element.subSaid, WIDTH.sub, subY)] : [])];
}

const bodyOf = (e) => (e.shape === "place" ? [e.x - PLACE_R, e.y - PLACE_R, e.x + PLACE_R, e.y + PLACE_R] : [e.x - BAR_W / 2, e.y - BAR_H / 2, e.x + BAR_W / 2, e.y + BAR_H / 2]);

/** What is drawn, by where it is: arcs as points, elements as boxes. */
export class Ground {
  constructor(elements, arcs) {
    this.cells = new Map();
    for (const element of elements) this.put(bodyOf(element), { element });
    for (const arc of arcs) {
      for (let i = 1; i < SAMPLES; i++) {
        const [x, y] = at(arc.curve, i / SAMPLES);
        this.put([x, y, x, y], { arc, x, y });
      }
    }
    for (const element of elements) for (const box of element.boxes ?? []) this.put(box, { words: element, box });
  }

  put(box, what) {
    for (let cx = Math.floor(box[0] / CELL); cx <= Math.floor(box[2] / CELL); cx++) {
      for (let cy = Math.floor(box[1] / CELL); cy <= Math.floor(box[3] / CELL); cy++) {
        const key = `${cx} ${cy}`;
        if (this.cells.has(key)) this.cells.get(key).push(what);
        else this.cells.set(key, [what]);
      }
    }
  }

  /** How much boxes of an element's words would cover. */
  cost(element, boxes) {
    const found = new Set();
    let cost = 0;
    for (const box of boxes) {
      for (let cx = Math.floor(box[0] / CELL); cx <= Math.floor(box[2] / CELL); cx++) {
        for (let cy = Math.floor(box[1] / CELL); cy <= Math.floor(box[3] / CELL); cy++) {
          for (const what of this.cells.get(`${cx} ${cy}`) ?? []) cost += this.covered(element, box, what, found);
        }
      }
    }
    return cost;
  }

  covered(element, box, what, found) {
    const other = what.arc ?? what.words ?? what.element;
    if (other === element || found.has(what) || (what.arc && found.has(other))) return 0;
    if (what.arc) {
      if (what.x < box[0] || what.x > box[2] || what.y < box[1] || what.y > box[3]) return 0;
      found.add(other);
      return COST.arc;
    }
    // words that have been put elsewhere since do not count here any more
    if (what.words ? !what.words.boxes?.includes(what.box) || !touch(box, what.box) : !touch(box, bodyOf(other))) return 0;
    found.add(what);
    return what.words ? COST.words : COST.node;
  }

  /** Choose the side for an element's words, and keep them in mind for the next one. */
  settle(element) {
    let least = Infinity;
    let chosen = SIDES[0];
    let there = [];
    SIDES.forEach((side, i) => {
      const boxes = boxesAt(element, side);
      const cost = this.cost(element, boxes) + COST.side * i;
      if (cost < least) [least, chosen, there] = [cost, side, boxes];
    });
    element.boxes = there;
    for (const box of there) this.put(box, { words: element, box });
    return chosen;
  }
}
