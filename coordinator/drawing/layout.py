"""Positions of nodes: given ones are kept, missing ones come from layers along the token flow.

Layered drawing after K. Sugiyama, S. Tagawa, M. Toda, Methods for visual understanding of
hierarchical system structures, IEEE Trans. SMC 11 (1981), in four steps:

1. Reverse arcs that close a cycle.
2. Put every node into a column, so that all arcs lead to the right.
3. Give an arc over several columns a way point in each column between, and order each column so
   that few arcs cross.
4. Choose heights that make arcs as level as the minimum distances allow.

A net of `FOLDED_FROM` columns or more is folded into bands, one below the other, that run to the
right and to the left in turn. Resources then take no part in the layers: they are put between the
nodes that use them.

A net that refines a smaller one is laid out in blocks: what stands for one node of the smaller net
has layers of its own, and the blocks lie as those nodes do.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from graphlib import TopologicalSorter
from itertools import pairwise
from math import inf

from msgspec import Struct, field

Point = tuple[float, float]
Edge = tuple[str, str]
WayPoint = tuple[str, str, int]
"""A way point of an arc: its two ends and its column."""
Spot = str | WayPoint
"""Occupant of a column: a node, by its name, or a way point."""
HUB = 14
"""A node with more arcs than this is a hub: its long arcs get no way points and run straight,
because so many way points would push the columns apart."""
_SWEEPS = 10
"""Sweeps over the columns for each starting order."""
_TIGHTENINGS = 12
"""Passes that move nodes closer to their neighbours' columns."""
COLUMN = 120.0
"""Distance between two columns (drawing units)."""
ROW = 105.0
"""Least distance between two nodes of a column; a way point needs less room."""
_BESIDE_NODE = 58.0
"""The same between a node and a way point."""
_BESIDE_ARC = 24.0
"""The same between two way points."""
MARGIN = 80.0
WIDEST = 14
"""Columns of one band: about what a screen shows."""
FOLDED_FROM = 28
"""Columns from which a layout is folded: a fold costs crossings, so what a reader can still follow
stays in one band."""
_WIDER = 1.4
"""How much farther apart than usual the columns of a block are: its labels are long."""
_BETWEEN = 1.5
"""Distance between two blocks, in columns and rows."""
_SETTLINGS = 20
"""Passes in which the heights of nodes approach those of their neighbours."""
_STRAIGHT = (1.0, 3.0, 9.0)
"""Weights of level arcs: between nodes, from a node to a way point, between way points. Bends
between way points look worst, so these weigh most."""


class Layers:
    """Columns of nodes and way points, in an order with few crossings.

    `next` and `before` hold the neighbours of each spot in the columns to its right and left.
    """

    def __init__(self, names: Sequence[str], edges: Sequence[Edge], sources: Sequence[str]) -> None:
        kept = set(without_circles(names, edges, sources))
        self.forward = [
            (a, b) if (a, b) in kept else (b, a) for a, b in dict.fromkeys(edges) if a != b
        ]
        self.column = _columns(names, self.forward)
        self.columns: list[list[Spot]] = [
            [] for _ in range(max(self.column.values(), default=0) + 1)
        ]
        self.next: dict[Spot, list[Spot]] = {}
        self.before: dict[Spot, list[Spot]] = {}
        for name in names:
            self._add(name, self.column[name])
        degree = Counter(n for edge in self.forward for n in edge)
        for a, b in dict.fromkeys(self.forward):
            if max(degree[a], degree[b]) <= HUB or self.column[b] - self.column[a] == 1:
                self._lead((a, b))
        self._order()

    def way_points(self, a: str, b: str) -> list[WayPoint]:
        """Return the way points of an arc from a to b, in its own direction."""
        columns = range(self.column[a] + 1, self.column[b])
        points = [(a, b, c) for c in columns]
        if self.column[a] > self.column[b]:
            points = [(b, a, c) for c in range(self.column[a] - 1, self.column[b], -1)]
        return points

    def _add(self, spot: Spot, column: int) -> None:
        self.columns[column].append(spot)
        self.next[spot], self.before[spot] = [], []

    def _lead(self, edge: Edge) -> None:
        a, b = edge
        last: Spot = a
        for point in self.way_points(a, b):
            self._add(point, point[2])
            self._join(last, point)
            last = point
        self._join(last, b)

    def _join(self, a: Spot, b: Spot) -> None:
        self.next[a].append(b)
        self.before[b].append(a)

    def _order(self) -> None:
        """Try four starts and keep the order with the fewest crossings.

        The barycentre heuristic ends in local optima, so it starts from the given and the reversed
        order, and from the left and from the right.
        """
        best, fewest = [list(c) for c in self.columns], self.crossings()
        for start in ([list(c) for c in self.columns], [c[::-1] for c in self.columns]):
            for first in (0, 1):
                self.columns = [list(c) for c in start]
                for sweep in range(_SWEEPS if fewest else 0):
                    self._sweep(forward=(sweep + first) % 2 == 0)
                    crossings = self.crossings()
                    if crossings < fewest:
                        best, fewest = [list(c) for c in self.columns], crossings
        self.columns = best

    def _sweep(self, forward: bool) -> None:
        """Sort each column by the mean row of its neighbours (barycentre), then swap neighbours."""
        inward, columns = (
            (self.before, self.columns[1:]) if forward else (self.next, self.columns[-2::-1])
        )
        row = self._rows()
        for column in columns:
            self._sort(column, inward, row)
            row.update((spot, i) for i, spot in enumerate(column))
        self._exchange()

    def _sort(
        self, column: list[Spot], inward: Mapping[Spot, Sequence[Spot]], row: Mapping[Spot, int]
    ) -> None:
        mean = {
            s: sum(row[n] for n in inward[s]) / len(inward[s]) if inward[s] else row[s]
            for s in column
        }
        column.sort(key=lambda s: mean[s])

    def _exchange(self) -> None:
        """Swap neighbours in a column while that removes crossings, in four passes at most: a sweep
        follows anyway."""
        for _ in range(4):
            better = False
            row = self._rows()
            for column in self.columns:
                for i in range(len(column) - 1):
                    a, b = column[i], column[i + 1]
                    if self._gain(a, b, row) > 0:
                        column[i], column[i + 1] = b, a
                        row[a], row[b] = row[b], row[a]
                        better = True
            if not better:
                return

    def _gain(self, a: Spot, b: Spot, row: Mapping[Spot, int]) -> int:
        """Return how many crossings disappear if b comes before a."""
        gain = 0
        for side in (self.before, self.next):
            for m in side[a]:
                for n in side[b]:
                    gain += (row[m] > row[n]) - (row[m] < row[n])
        return gain

    def _rows(self) -> dict[Spot, int]:
        return {spot: i for column in self.columns for i, spot in enumerate(column)}

    def crossings(self) -> int:
        """Count the crossings between neighbouring columns: the inversions among the arcs' ends."""
        row = self._rows()
        total = 0
        for column in self.columns[:-1]:
            seen: list[int] = []
            for spot in column:
                ends = sorted(row[n] for n in self.next[spot])
                total += sum(len(seen) - bisect_left(seen, end + 1) for end in ends)
                for end in ends:
                    insort(seen, end)
        return total


def without_circles(
    names: Sequence[str], edges: Sequence[Edge], sources: Sequence[str]
) -> list[Edge]:
    """Return the edges except those that close a cycle (depth-first search without recursion)."""
    following: dict[str, list[str]] = {n: [] for n in names}
    for a, b in edges:
        following[a].append(b)
    kept: list[Edge] = []
    state: dict[str, int] = {}
    for root in [*sources, *names]:
        if root in state:
            continue
        state[root] = 1
        stack = [(root, iter(following[root]))]
        while stack:
            node, rest = stack[-1]
            child = next(rest, None)
            if child is None:
                state[node] = 2
                stack.pop()
            elif state.get(child) != 1:
                kept.append((node, child))
                if child not in state:
                    state[child] = 1
                    stack.append((child, iter(following[child])))
    return kept


def _columns(names: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    """Return the column of each node.

    First its longest distance from a node without incoming edges. Then each node moves towards the
    side on which it has more neighbours, as far as its edges allow, which shortens arcs.
    """
    before: dict[str, list[str]] = {n: [] for n in names}
    after: dict[str, list[str]] = {n: [] for n in names}
    for a, b in edges:
        before[b].append(a)
        after[a].append(b)
    column = _longest_paths(before)
    for _ in range(_TIGHTENINGS):
        moved = False
        for name in names:
            low = max((column[n] + 1 for n in before[name]), default=0)
            high = min((column[n] - 1 for n in after[name]), default=column[name])
            pull = len(after[name]) - len(before[name])
            wanted = high if pull > 0 else low if pull < 0 and before[name] else column[name]
            moved |= wanted != column[name]
            column[name] = wanted
        if not moved:
            break
    return column


def _longest_paths(before: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Return the layer of each node: the length of the longest path that leads to it."""
    layers, layer = dict[str, int](), 0
    sorter = TopologicalSorter(before)
    sorter.prepare()
    while sorter.is_active():
        ready = sorter.get_ready()
        layers |= dict.fromkeys(ready, layer)
        sorter.done(*ready)
        layer += 1
    return layers


class NodePositions(Struct, frozen=True):
    """A position for every node, and the points through which long arcs run."""

    at: Mapping[str, Point]
    through: Mapping[Edge, Sequence[Point]] = field(default_factory=dict)

    def under(self, move: Callable[[Point], Point]) -> NodePositions:
        """Return the positions with every point moved."""
        return NodePositions(
            {name: move(point) for name, point in self.at.items()},
            {edge: [move(point) for point in way] for edge, way in self.through.items()},
        )


def lay_out(
    wanted: Mapping[str, Point | None],
    edges: Sequence[Edge],
    sources: Sequence[str],
    aside: Collection[str] = (),
) -> NodePositions:
    """Return a position for every node. `aside` are nodes that a wide layout leaves out of its
    layers.

    If at least half of the positions are given, they are kept and the others are filled in next to
    their neighbours; else all nodes are placed in layers, starting from `sources` (the marked
    places).
    """
    given = {name: at for name, at in wanted.items() if at is not None}
    if len(given) == len(wanted):
        return NodePositions(given)
    if 2 * len(given) >= len(wanted):
        return NodePositions(_fill_in(list(wanted), given, edges))
    layers = Layers(list(wanted), edges, sources)
    if len(layers.columns) < FOLDED_FROM:
        return _layered(layers, list(wanted), edges)
    names = [name for name in wanted if name not in aside]
    inner = [(a, b) for a, b in edges if a not in aside and b not in aside]
    layers = Layers(names, inner, [name for name in sources if name not in aside])
    placed = _folded(_layered(layers, names, inner), len(layers.columns))
    return NodePositions(_fill_in(list(wanted), placed.at, edges), placed.through)


def lay_out_blocks(
    block_of: Mapping[str, str], at: Mapping[str, Point], edges: Sequence[Edge]
) -> NodePositions:
    """Return a position for every node. Those of one block (`block_of`) stand together, and the
    blocks lie as `at` says; one without a position lies between its neighbours."""
    members = defaultdict[str, list[str]](list)
    for name, block in block_of.items():
        members[block].append(name)
    inner, entries = defaultdict[str, list[Edge]](list), set[str]()
    for a, b in edges:
        if block_of[a] == block_of[b]:
            inner[block_of[a]].append((a, b))
        else:
            entries.add(b)
    laid = {
        block: lay_out(
            dict.fromkeys(names), inner[block], [name for name in names if name in entries]
        )
        for block, names in members.items()
    }
    cells = defaultdict[tuple[int, int], list[str]](list)
    ends = dict.fromkeys((block_of[a], block_of[b]) for a, b in edges)
    wanted = dict[str, Point]()
    for block in members:
        near = [at[b] for pair in ends if block in pair for b in pair if b in at]
        wanted[block] = at[block] if block in at else _mean(near) if near else (MARGIN, MARGIN)
    columns = _ranks((x for x, _ in wanted.values()), COLUMN / 2)
    rows = _ranks((y for _, y in wanted.values()), ROW / 2)
    for block, (x, y) in wanted.items():
        cells[columns[x], rows[y]].append(block)
    widths, heights = defaultdict[int, float](float), defaultdict[int, float](float)
    for (column, row), blocks in cells.items():
        sizes = [_size(laid[block]) for block in blocks]
        widths[column] = max(widths[column], *(width for width, _ in sizes))
        heights[row] = max(heights[row], sum(height + ROW for _, height in sizes) - ROW)
    left, top = (
        _starts(sizes, _BETWEEN * gap) for sizes, gap in ((widths, COLUMN), (heights, ROW))
    )
    found, through = dict[str, Point](), dict[Edge, Sequence[Point]]()
    for (column, row), blocks in cells.items():
        total = sum(_size(laid[block])[1] + ROW for block in blocks) - ROW
        y = top[row] + (heights[row] - total) / 2
        for block in blocks:
            width, height = _size(laid[block])
            corner = left[column] + (widths[column] - width) / 2, y
            moved = _moved(laid[block], corner)
            found |= moved.at
            through |= moved.through
            y += height + ROW
    return NodePositions(found, through)


def _ranks(values: Iterable[float], apart: float) -> dict[float, int]:
    """Return the rank of each value; those less than `apart` above the first of a rank share it."""
    ranks, first, rank = dict[float, int](), -inf, -1
    for value in sorted(set(values)):
        if value - first >= apart:
            first, rank = value, rank + 1
        ranks[value] = rank
    return ranks


def _starts(sizes: Mapping[int, float], gap: float) -> dict[int, float]:
    """Return where each column or row begins."""
    starts, start = dict[int, float](), MARGIN
    for rank in sorted(sizes):
        starts[rank] = start
        start += sizes[rank] + gap
    return starts


def _size(block: NodePositions) -> Point:
    """Return width and height of a block."""
    xs, ys = zip(*block.at.values(), strict=True)
    return _WIDER * (max(xs) - min(xs)), max(ys) - min(ys)


def _moved(block: NodePositions, corner: Point) -> NodePositions:
    """Return a block widened, with its nodes to the right of and below a corner."""
    left, top = (min(values) for values in zip(*block.at.values(), strict=True))

    def to(point: Point) -> Point:
        return corner[0] + _WIDER * (point[0] - left), corner[1] + point[1] - top

    return block.under(to)


def _fill_in(
    names: Sequence[str], given: Mapping[str, Point], edges: Sequence[Edge]
) -> dict[str, Point]:
    """Place the missing nodes near their neighbours, each at the nearest free spot."""
    at = dict(given)
    for name in names:
        if name not in at:
            near = [
                at[b if a == name else a]
                for a, b in edges
                if name in (a, b) and (b if a == name else a) in at
            ]
            centre = (
                _mean(near)
                if near
                else (MARGIN, max((y for _, y in at.values()), default=0.0) + ROW)
            )
            at[name] = _free_spot(centre, list(at.values()))
    return at


def _free_spot(centre: Point, taken: Sequence[Point]) -> Point:
    """Return the nearest spot around the centre that is far enough from all others."""
    ring = 0
    while True:
        spots = [
            (centre[0] + dx * COLUMN / 2, centre[1] + dy * ROW / 2)
            for dx in range(-ring, ring + 1)
            for dy in range(-ring, ring + 1)
            if max(abs(dx), abs(dy)) == ring
        ]
        free = [
            s
            for s in spots
            if all(abs(s[0] - x) >= COLUMN * 0.7 or abs(s[1] - y) >= ROW * 0.7 for x, y in taken)
        ]
        if free:
            return min(free, key=lambda s: (s[0] - centre[0]) ** 2 + (s[1] - centre[1]) ** 2)
        ring += 1


def _folded(flat: NodePositions, columns: int) -> NodePositions:
    """Return a wide layout in bands of equally many columns; each second one runs to the left, so
    that arcs from band to band are short."""
    bands = -(-columns // WIDEST)
    per = -(-columns // bands)

    def band(point: Point) -> int:
        return round((point[0] - MARGIN) / COLUMN) // per

    points = [*flat.at.values(), *(p for way in flat.through.values() for p in way)]
    heights = [[y for x, y in points if band((x, y)) == b] or [MARGIN] for b in range(bands)]
    tops, top = list[float](), MARGIN
    for ys in heights:
        tops.append(top - min(ys))
        top += max(ys) - min(ys) + 1.5 * ROW

    def at(point: Point) -> Point:
        b = band(point)
        column = round((point[0] - MARGIN) / COLUMN) - b * per
        return MARGIN + (per - 1 - column if b % 2 else column) * COLUMN, point[1] + tops[b]

    return flat.under(at)


def _layered(layers: Layers, names: Sequence[str], edges: Sequence[Edge]) -> NodePositions:
    row = _settled(layers)
    top = min(row.values(), default=0.0)

    def at(spot: Spot, column: int) -> Point:
        return MARGIN + column * COLUMN, MARGIN + row[spot] - top

    return NodePositions(
        {name: at(name, layers.column[name]) for name in names},
        {
            (a, b): [at(p, p[2]) for p in layers.way_points(a, b)]
            for a, b in edges
            if all(p in row for p in layers.way_points(a, b))
        },
    )


def _settled(layers: Layers) -> dict[Spot, float]:
    """Return the height of every spot: level with its neighbours as far as distances allow."""
    row: dict[Spot, float] = {}
    for column in layers.columns:
        heights = [0.0]
        for above, below in pairwise(column):
            heights.append(heights[-1] + _apart(above, below))
        row |= {spot: h - heights[-1] / 2 for spot, h in zip(column, heights, strict=False)}
    for i in range(_SETTLINGS):
        for column in layers.columns if i % 2 == 0 else layers.columns[::-1]:
            wishes = [_wish(spot, layers, row) for spot in column]
            row |= dict(zip(column, _spaced(column, wishes), strict=True))
    _level(layers, row)
    return row


def _level(layers: Layers, row: dict[Spot, float]) -> None:
    """Put each chain of nodes that follow one another without a branch on one height, where the
    distances in their columns allow it: the averages come close to that only after many passes."""
    limits: dict[Spot, tuple[Spot | None, Spot | None]] = {}
    for column in layers.columns:
        around = [None, *column, None]
        limits |= {s: (around[i], around[i + 2]) for i, s in enumerate(column)}

    def fits(spot: Spot, height: float) -> bool:
        above, below = limits[spot]
        return (above is None or height - row[above] >= _apart(above, spot) - 1e-6) and (
            below is None or row[below] - height >= _apart(spot, below) - 1e-6
        )

    for chain in sorted(_chains(layers), key=len, reverse=True):
        heights = [row[s] for s in chain]
        for height in (sum(heights) / len(heights), *sorted(heights)):
            if all(fits(s, height) for s in chain):
                row |= dict.fromkeys(chain, height)
                break


def _chains(layers: Layers) -> list[list[str]]:
    """Return the longest rows of nodes that follow one another without a branch."""
    after = {
        a: nexts[0]
        for a, nexts in layers.next.items()
        if len(nexts) == 1
        and len(layers.before[nexts[0]]) == 1
        and isinstance(a, str)
        and isinstance(nexts[0], str)
    }
    inner, found = set(after.values()), list[list[str]]()
    for first in after:
        if first not in inner:
            chain = [first]
            while chain[-1] in after:
                chain.append(after[chain[-1]])
            found.append(chain)
    return found


def _apart(above: Spot, below: Spot) -> float:
    arcs = (isinstance(above, tuple)) + (isinstance(below, tuple))
    return (ROW, _BESIDE_NODE, _BESIDE_ARC)[arcs]


def _wish(spot: Spot, layers: Layers, row: Mapping[Spot, float]) -> tuple[float, float]:
    """Return the mean height of the neighbours of a spot, and the weight of that height."""
    steps = [
        (row[n], _STRAIGHT[isinstance(spot, tuple) + isinstance(n, tuple)])
        for n in (*layers.before[spot], *layers.next[spot])
    ]
    weight = sum(w for _, w in steps)
    return (sum(y * w for y, w in steps) / weight, weight) if steps else (row[spot], 1.0)


def _spaced(column: Sequence[Spot], wishes: Sequence[tuple[float, float]]) -> list[float]:
    """Return the heights closest to the wished ones (least squares) that keep the minimum
    distances.

    Subtracting the minimum distances turns the task into isotonic regression, which the
    pool-adjacent-violators algorithm solves exactly: neighbours in the wrong order are merged into
    a pool with their weighted mean.
    """
    offset = [0.0]
    for above, below in pairwise(column):
        offset.append(offset[-1] + _apart(above, below))
    pools: list[tuple[float, float, int]] = []  # mean, weight, size
    for (y, w), o in zip(wishes, offset, strict=False):
        pool = (y - o, w, 1)
        while pools and pools[-1][0] > pool[0]:
            mean, weight, size = pools.pop()
            total = weight + pool[1]
            pool = ((mean * weight + pool[0] * pool[1]) / total, total, size + pool[2])
        pools.append(pool)
    means = [mean for mean, _, size in pools for _ in range(size)]
    return [mean + o for mean, o in zip(means, offset, strict=False)]


def _mean(points: Sequence[Point]) -> Point:
    return sum(x for x, _ in points) / len(points), sum(y for _, y in points) / len(points)
