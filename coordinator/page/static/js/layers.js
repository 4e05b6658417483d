// Layers along the flow of tokens: circles cut, every node in a column, few crossings, and level lines.
// The same rules as coordinator/drawing/layout.py, where they are explained; a test compares the two.

const HUB = 14;
const SWEEPS = 10;
const TIGHTENINGS = 12;
const COLUMN = 120;
const APART = [105, 58, 24]; // between nodes, node and way point, way points
const MARGIN = 80;
const WIDEST = 14;
const FOLDED_FROM = 28;
const SETTLINGS = 20;
const STRAIGHT = [1, 3, 9];

const point = (a, b, column) => `\u0000${a}\u0000${b}\u0000${column}`;
const isPoint = (spot) => spot.startsWith("\u0000");

/**
 * Positions {name: [x, y]} of nodes joined by `edges` [[from, to], ...]; the flow begins at `sources`. A wide layout leaves the
 * nodes `aside` out of its layers.
 */
export function layered(names, edges, sources, aside = []) {
  const layers = new Layers(names, edges, sources);
  if (layers.columns.length < FOLDED_FROM) return named(names, spotsOf(layers));
  const beside = new Set(aside);
  const inner = names.filter((name) => !beside.has(name));
  const joined = edges.filter((edge) => !edge.some((end) => beside.has(end)));
  const long = new Layers(inner, joined, sources.filter((name) => !beside.has(name)));
  return filledIn(names, named(inner, folded(spotsOf(long), long.columns.length)), edges);
}

const named = (names, spots) => Object.fromEntries(names.map((name) => [name, spots.get(name)]));

/** Positions of all nodes and way points: Map(spot -> [x, y]). */
function spotsOf(layers) {
  const row = settled(layers);
  const top = row.size ? Math.min(...row.values()) : 0;
  return new Map(layers.columns.flatMap((column, i) => column.map((spot) => [spot, [MARGIN + i * COLUMN, MARGIN + row.get(spot) - top]])));
}

/** The same in bands of equally many columns; each second one runs to the left. */
function folded(spots, columns) {
  const bands = Math.ceil(columns / WIDEST);
  const per = Math.ceil(columns / bands);
  const columnOf = (x) => Math.round((x - MARGIN) / COLUMN);
  let top = MARGIN;
  const tops = Array.from({ length: bands }, (_, band) => {
    const ys = [...spots.values()].filter(([x]) => Math.floor(columnOf(x) / per) === band).map(([, y]) => y);
    const [least, most] = ys.length ? [Math.min(...ys), Math.max(...ys)] : [MARGIN, MARGIN];
    const shift = top - least;
    top += most - least + 1.5 * APART[0];
    return shift;
  });
  const at = ([x, y]) => {
    const band = Math.floor(columnOf(x) / per);
    const column = columnOf(x) - band * per;
    return [MARGIN + (band % 2 ? per - 1 - column : column) * COLUMN, y + tops[band]];
  };
  return new Map([...spots].map(([spot, point]) => [spot, at(point)]));
}

/** The positions with those of the other nodes: each near its neighbours, at the nearest free spot. */
export function filledIn(names, positions, edges) {
  const at = { ...positions };
  for (const name of names.filter((n) => !(n in at))) {
    const near = edges.filter((edge) => edge.includes(name)).map(([a, b]) => at[a === name ? b : a]).filter(Boolean);
    const lowest = Math.max(0, ...Object.values(at).map(([, y]) => y));
    const centre = near.length ? [0, 1].map((i) => near.reduce((sum, p) => sum + p[i], 0) / near.length) : [MARGIN, lowest + APART[0]];
    at[name] = freeSpot(centre, Object.values(at));
  }
  return at;
}

function freeSpot([x, y], taken) {
  const far = ([a, b]) => taken.every(([c, d]) => Math.abs(a - c) >= COLUMN * 0.7 || Math.abs(b - d) >= APART[0] * 0.7);
  for (let ring = 0; ; ring++) {
    const steps = Array.from({ length: 2 * ring + 1 }, (_, i) => i - ring);
    const around = steps.flatMap((dx) => steps.filter((dy) => Math.max(Math.abs(dx), Math.abs(dy)) === ring).map((dy) => [x + (dx * COLUMN) / 2, y + (dy * APART[0]) / 2]));
    const away = ([a, b]) => (a - x) ** 2 + (b - y) ** 2;
    const free = around.filter(far);
    if (free.length) return free.reduce((best, spot) => (away(spot) < away(best) ? spot : best));
  }
}

class Layers {
  constructor(names, edges, sources) {
    const kept = new Set(withoutCircles(names, edges, sources).map(String));
    const seen = new Set();
    this.forward = [];
    for (const [a, b] of edges) {
      if (a === b || seen.has(String([a, b]))) continue;
      seen.add(String([a, b]));
      this.forward.push(kept.has(String([a, b])) ? [a, b] : [b, a]);
    }
    this.column = columnsOf(names, this.forward);
    this.columns = Array.from({ length: Math.max(0, ...this.column.values()) + 1 }, () => []);
    this.next = new Map();
    this.before = new Map();
    for (const name of names) this.add(name, this.column.get(name));
    const degree = new Map();
    for (const edge of this.forward) for (const n of edge) degree.set(n, (degree.get(n) ?? 0) + 1);
    const led = new Set();
    for (const [a, b] of this.forward) {
      if (led.has(String([a, b]))) continue;
      led.add(String([a, b]));
      const far = this.column.get(b) - this.column.get(a);
      if (Math.max(degree.get(a), degree.get(b)) <= HUB || far === 1) this.lead(a, b);
    }
    this.order();
  }

  add(spot, column) {
    this.columns[column].push(spot);
    this.next.set(spot, []);
    this.before.set(spot, []);
  }

  lead(a, b) {
    let last = a;
    for (let column = this.column.get(a) + 1; column < this.column.get(b); column++) {
      const spot = point(a, b, column);
      this.add(spot, column);
      this.join(last, spot);
      last = spot;
    }
    this.join(last, b);
  }

  join(a, b) {
    this.next.get(a).push(b);
    this.before.get(b).push(a);
  }

  order() {
    const copy = (columns) => columns.map((c) => [...c]);
    let best = copy(this.columns);
    let fewest = this.crossings();
    for (const start of [copy(this.columns), this.columns.map((c) => [...c].reverse())]) {
      for (const first of [0, 1]) {
        this.columns = copy(start);
        for (let sweep = 0; sweep < (fewest ? SWEEPS : 0); sweep++) {
          this.sweep((sweep + first) % 2 === 0);
          const crossings = this.crossings();
          if (crossings < fewest) [best, fewest] = [copy(this.columns), crossings];
        }
      }
    }
    this.columns = best;
  }

  sweep(forward) {
    const columns = forward ? this.columns.slice(1) : this.columns.slice(0, -1).reverse();
    for (const column of columns) this.sort(column, forward ? this.before : this.next);
    this.exchange();
  }

  sort(column, inward) {
    const row = this.rows();
    const mean = new Map(column.map((s) => [s, inward.get(s).length ? inward.get(s).reduce((sum, n) => sum + row.get(n), 0) / inward.get(s).length : row.get(s)]));
    column.sort((a, b) => mean.get(a) - mean.get(b));
  }

  exchange() {
    for (let turn = 0; turn < 4; turn++) {
      let better = false;
      const row = this.rows();
      for (const column of this.columns) {
        for (let i = 0; i < column.length - 1; i++) {
          const [a, b] = [column[i], column[i + 1]];
          if (this.gain(a, b, row) <= 0) continue;
          [column[i], column[i + 1]] = [b, a];
          const at = row.get(a);
          row.set(a, row.get(b));
          row.set(b, at);
          better = true;
        }
      }
      if (!better) return;
    }
  }

  gain(a, b, row) {
    let gain = 0;
    for (const side of [this.before, this.next]) for (const m of side.get(a)) for (const n of side.get(b)) gain += Math.sign(row.get(m) - row.get(n));
    return gain;
  }

  rows() {
    return new Map(this.columns.flatMap((column) => column.map((spot, i) => [spot, i])));
  }

  crossings() {
    const row = this.rows();
    let total = 0;
    for (const column of this.columns.slice(0, -1)) {
      const seen = [];
      for (const spot of column) {
        const ends = this.next.get(spot).map((n) => row.get(n));
        for (const end of ends) for (const other of seen) total += other > end;
        seen.push(...ends);
      }
    }
    return total;
  }
}

function withoutCircles(names, edges, sources) {
  const following = new Map(names.map((n) => [n, []]));
  for (const [a, b] of edges) following.get(a).push(b);
  const kept = [];
  const state = new Map();
  for (const root of [...sources, ...names]) {
    if (state.has(root)) continue;
    state.set(root, 1);
    const stack = [{ node: root, i: 0 }];
    while (stack.length) {
      const top = stack.at(-1);
      const child = following.get(top.node)[top.i++];
      if (child === undefined) {
        state.set(top.node, 2);
        stack.pop();
      } else if (state.get(child) !== 1) {
        kept.push([top.node, child]);
        if (!state.has(child)) {
          state.set(child, 1);
          stack.push({ node: child, i: 0 });
        }
      }
    }
  }
  return kept;
}

function columnsOf(names, edges) {
  const before = new Map(names.map((n) => [n, []]));
  const after = new Map(names.map((n) => [n, []]));
  for (const [a, b] of edges) {
    before.get(b).push(a);
    after.get(a).push(b);
  }
  const column = longestWays(names, before, after);
  for (let turn = 0; turn < TIGHTENINGS; turn++) {
    let moved = false;
    for (const name of names) {
      const low = before.get(name).length ? Math.max(...before.get(name).map((n) => column.get(n) + 1)) : 0;
      const high = after.get(name).length ? Math.min(...after.get(name).map((n) => column.get(n) - 1)) : column.get(name);
      const pull = after.get(name).length - before.get(name).length;
      const wanted = pull > 0 ? high : pull < 0 && before.get(name).length ? low : column.get(name);
      moved ||= wanted !== column.get(name);
      column.set(name, wanted);
    }
    if (!moved) break;
  }
  return column;
}

function longestWays(names, before, after) {
  const column = new Map(names.map((n) => [n, 0]));
  const waiting = new Map(names.map((n) => [n, before.get(n).length]));
  const ready = names.filter((n) => !waiting.get(n));
  while (ready.length) {
    const node = ready.pop();
    for (const child of after.get(node)) {
      column.set(child, Math.max(column.get(child), column.get(node) + 1));
      waiting.set(child, waiting.get(child) - 1);
      if (!waiting.get(child)) ready.push(child);
    }
  }
  return column;
}

/** Heights: every spot as level with its neighbours as its distance from those above and below it allows. */
function settled(layers) {
  const row = new Map();
  for (const column of layers.columns) {
    const heights = offsets(column);
    column.forEach((spot, i) => row.set(spot, heights[i] - heights.at(-1) / 2));
  }
  for (let i = 0; i < SETTLINGS; i++) {
    for (const column of i % 2 ? [...layers.columns].reverse() : layers.columns) {
      const placed = spaced(column, column.map((spot) => wish(spot, layers, row)));
      column.forEach((spot, k) => row.set(spot, placed[k]));
    }
  }
  level(layers, row);
  return row;
}

// Put each chain of nodes that follow one another without a branch on one height, where the
// distances in their columns allow it.
function level(layers, row) {
  const limits = new Map();
  for (const column of layers.columns) column.forEach((spot, i) => limits.set(spot, [column[i - 1], column[i + 1]]));
  const apart = (above, below) => APART[isPoint(above) + isPoint(below)] - 1e-6;
  const fits = (spot, height) => {
    const [above, below] = limits.get(spot);
    return (above === undefined || height - row.get(above) >= apart(above, spot))
      && (below === undefined || row.get(below) - height >= apart(spot, below));
  };
  for (const chain of chains(layers).sort((a, b) => b.length - a.length)) {
    const heights = chain.map((spot) => row.get(spot));
    const mean = heights.reduce((sum, y) => sum + y, 0) / heights.length;
    const height = [mean, ...heights.sort((a, b) => a - b)].find((y) => chain.every((spot) => fits(spot, y)));
    if (height !== undefined) for (const spot of chain) row.set(spot, height);
  }
}

function chains(layers) {
  const after = new Map();
  for (const [a, nexts] of layers.next) {
    if (nexts.length === 1 && layers.before.get(nexts[0]).length === 1 && !isPoint(a) && !isPoint(nexts[0])) after.set(a, nexts[0]);
  }
  const inner = new Set(after.values());
  return [...after.keys()].filter((first) => !inner.has(first)).map((first) => {
    const chain = [first];
    while (after.has(chain.at(-1))) chain.push(after.get(chain.at(-1)));
    return chain;
  });
}

function offsets(column) {
  const found = column.length ? [0] : [];
  for (let i = 1; i < column.length; i++) found.push(found[i - 1] + APART[isPoint(column[i - 1]) + isPoint(column[i])]);
  return found;
}

function wish(spot, layers, row) {
  const steps = [...layers.before.get(spot), ...layers.next.get(spot)].map((n) => [row.get(n), STRAIGHT[isPoint(spot) + isPoint(n)]]);
  const weight = steps.reduce((sum, [, w]) => sum + w, 0);
  return steps.length ? [steps.reduce((sum, [y, w]) => sum + y * w, 0) / weight, weight] : [row.get(spot), 1];
}

function spaced(column, wishes) {
  const offset = offsets(column);
  const pools = [];
  wishes.forEach(([y, w], i) => {
    let pool = [y - offset[i], w, 1];
    while (pools.length && pools.at(-1)[0] > pool[0]) {
      const [mean, weight, size] = pools.pop();
      const total = weight + pool[1];
      pool = [(mean * weight + pool[0] * pool[1]) / total, total, size + pool[2]];
    }
    pools.push(pool);
  });
  const means = pools.flatMap(([mean, , size]) => Array(size).fill(mean));
  return means.map((mean, i) => mean + offset[i]);
}
