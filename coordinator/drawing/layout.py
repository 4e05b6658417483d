"""Where the nodes stand: given positions are kept, missing ones come from layers along the flow of
tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from petrobot.coordinator.drawing.layers import Edge, Layers, Spot

Point = tuple[float, float]

COLUMN = 120.0
ROW = 105.0
MARGIN = 80.0
_BESIDE_NODE = 58.0
_BESIDE_ARC = 24.0
_SETTLINGS = 20
_STRAIGHT = (1.0, 3.0, 9.0)
"""How much a step wants to be level: between nodes, from a node to a way point, between way
points."""


@dataclass(frozen=True, slots=True)
class Layout:
    """A position for every node, and the points by which arcs over several columns are led."""

    at: Mapping[str, Point]
    through: Mapping[Edge, Sequence[Point]] = field(default_factory=dict)


def lay_out(
    wanted: Mapping[str, Point | None], edges: Sequence[Edge], sources: Sequence[str]
) -> Layout:
    """A position for every node. `sources` are the nodes from which the flow begins (the marked
    places)."""
    given = {name: at for name, at in wanted.items() if at is not None}
    if len(given) == len(wanted):
        return Layout(given)
    if 2 * len(given) >= len(wanted):
        return Layout(_fill_in(list(wanted), given, edges))
    return _layered(list(wanted), edges, sources)


def _fill_in(
    names: Sequence[str], given: Mapping[str, Point], edges: Sequence[Edge]
) -> dict[str, Point]:
    """The missing nodes near their neighbours, each at the next free spot."""
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
    """The nearest spot around the centre that keeps its distance from all others."""
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


def _layered(names: Sequence[str], edges: Sequence[Edge], sources: Sequence[str]) -> Layout:
    layers = Layers(names, edges, sources)
    row = _settled(layers)
    top = min(row.values(), default=0.0)

    def at(spot: Spot, column: int) -> Point:
        return MARGIN + column * COLUMN, MARGIN + row[spot] - top

    return Layout(
        {name: at(name, layers.column[name]) for name in names},
        {
            (a, b): [at(p, p[2]) for p in layers.way(a, b)]
            for a, b in edges
            if all(p in row for p in layers.way(a, b))
        },
    )


def _settled(layers: Layers) -> dict[Spot, float]:
    """Heights: every spot as level with its neighbours as its distance from those above and below
    it allows."""
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
    return row


def _apart(above: Spot, below: Spot) -> float:
    arcs = (isinstance(above, tuple)) + (isinstance(below, tuple))
    return (ROW, _BESIDE_NODE, _BESIDE_ARC)[arcs]


def _wish(spot: Spot, layers: Layers, row: Mapping[Spot, float]) -> tuple[float, float]:
    """Where a spot would stand by its neighbours, and how much it wants that."""
    steps = [
        (row[n], _STRAIGHT[isinstance(spot, tuple) + isinstance(n, tuple)])
        for n in (*layers.before[spot], *layers.next[spot])
    ]
    weight = sum(w for _, w in steps)
    return (sum(y * w for y, w in steps) / weight, weight) if steps else (row[spot], 1.0)


def _spaced(column: Sequence[Spot], wishes: Sequence[tuple[float, float]]) -> list[float]:
    """The heights nearest to the wishes (least squares) that keep distance: pooled adjacent
    violators on shifted wishes."""
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
