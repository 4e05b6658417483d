"""Ways of arcs around nodes, and places for words that cover neither nodes nor arcs nor each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import hypot

from coordinator.drawing.layout import Point
from coordinator.drawing.scene import RADIUS, Arc, Node

Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""

_BENDS = (0.0, 34.0, -34.0, 68.0, -68.0, 110.0, -110.0, 160.0, -160.0, 220.0, -220.0)
_CLEARANCE = 7.0
_SAMPLES = 24
FONT = 12.5
LINE = 15.0
_CHARACTER = 0.565


@dataclass(frozen=True, slots=True)
class Way:
    """A quadratic curve from border to border; `bend` is how far its control point is off the straight line."""

    arc: Arc
    start: Point
    control: Point
    end: Point
    bend: float

    def point(self, s: float) -> Point:
        """The point at s, 0 at the start and 1 at the end."""
        a, b, c = (1 - s) ** 2, 2 * s * (1 - s), s * s
        return (
            a * self.start[0] + b * self.control[0] + c * self.end[0],
            a * self.start[1] + b * self.control[1] + c * self.end[1],
        )


@dataclass(frozen=True, slots=True)
class Words:
    """Lines of text at a place: where the first baseline begins and how the text is anchored."""

    node: Node
    x: float
    y: float
    anchor: str
    box: Box


def route(nodes: Mapping[str, Node], arcs: Sequence[Arc]) -> list[Way]:
    """A way for each arc: the least bent one that passes the other nodes and the ways with the same two ends."""
    pairs: dict[frozenset[str], set[float]] = {}
    ways: list[Way] = []
    for arc in arcs:
        key = frozenset((arc.source, arc.target))
        twins = sum(frozenset((a.source, a.target)) == key for a in arcs) > 1
        used = pairs.setdefault(key, set())
        best = min((_way(nodes, arc, bend) for bend in _BENDS), key=lambda w: _cost(nodes, w, used, twins))
        sense = 1.0 if arc.source < arc.target else -1.0
        used.add(best.bend * sense)
        ways.append(best)
    return ways


def _way(nodes: Mapping[str, Node], arc: Arc, bend: float) -> Way:
    source, target = nodes[arc.source], nodes[arc.target]
    (x1, y1), (x2, y2) = source.at, target.at
    length = hypot(x2 - x1, y2 - y1) or 1.0
    control = ((x1 + x2) / 2 - (y2 - y1) / length * bend, (y1 + y2) / 2 + (x2 - x1) / length * bend)
    return Way(arc, _border(source, control), control, _border(target, control), bend)


def _border(node: Node, towards: Point) -> Point:
    """Where the line from the node's centre leaves it."""
    (x, y), (w, h) = node.at, node.half
    dx, dy = towards[0] - x, towards[1] - y
    if node.is_place:
        length = hypot(dx, dy) or 1.0
        return x + dx / length * (RADIUS + 2), y + dy / length * (RADIUS + 2)
    scale = min((w + 2) / abs(dx) if dx else 1e9, (h + 2) / abs(dy) if dy else 1e9)
    return x + dx * scale, y + dy * scale


def _cost(nodes: Mapping[str, Node], way: Way, used: set[float], twins: bool) -> float:
    ends = (way.arc.source, way.arc.target)
    points = [way.point(i / _SAMPLES) for i in range(_SAMPLES + 1)]
    hits = sum(any(_near(node, p) for p in points) for name, node in nodes.items() if name not in ends)
    sense = 1.0 if way.arc.source < way.arc.target else -1.0
    taken = way.bend * sense in used or (twins and way.bend == 0.0)
    return 1000.0 * hits + 1500.0 * taken + abs(way.bend)


def _near(node: Node, p: Point) -> bool:
    w, h = node.half
    return abs(p[0] - node.at[0]) < w + _CLEARANCE and abs(p[1] - node.at[1]) < h + _CLEARANCE


def place_words(nodes: Mapping[str, Node], ways: Sequence[Way]) -> list[Words]:
    """Words beside each node where they cover least: nodes and other words count most, then arcs."""
    solid = [_around(n) for n in nodes.values()]
    curves = [[w.point(i / _SAMPLES) for i in range(_SAMPLES + 1)] for w in ways]
    placed: list[Words] = []
    for node in sorted(nodes.values(), key=lambda n: (not n.is_place, -max(map(len, n.lines), default=0))):
        others = [b for b in solid if b != _around(node)] + [w.box for w in placed]
        spots = list(_spots(node))
        costs = [_cover(w.box, others, curves) + 0.4 * i for i, w in enumerate(spots)]
        placed.append(spots[costs.index(min(costs))])
    return placed


def badge_spot(node: Node, ways: Sequence[Way]) -> Point:
    """The corner of a place that is farthest from the ends of its arcs."""
    ends = [w.start for w in ways if w.arc.source == node.name] + [w.end for w in ways if w.arc.target == node.name]
    reach = RADIUS * 0.8
    corners = [(node.at[0] + sx * reach, node.at[1] + sy * reach) for sy in (-1, 1) for sx in (1, -1)]
    return max(corners, key=lambda c: min((hypot(c[0] - x, c[1] - y) for x, y in ends), default=0.0) // 4)


def text_width(text: str) -> float:
    """Estimated width of a text in the drawing's font."""
    return len(text) * FONT * _CHARACTER


def _spots(node: Node) -> Iterator[Words]:
    """Candidate positions, the usual ones first."""
    width = max(map(text_width, node.lines), default=0.0)
    height = LINE * len(node.lines)
    (x, y), (w, h) = node.at, node.half
    for far in (0.0, 10.0, 22.0):
        below, above = y + h + 4 + far, y - h - 5 - height - far
        right, left = x + w + 6 + far, x - w - 6 - far
        for top in (below, above) if node.is_place else (above, below):
            yield _words(node, x, top, "middle", width, height)
        for aside in (y - height / 2, y - height - 4, y + 4):
            yield _words(node, right, aside, "start", width, height)
            yield _words(node, left, aside, "end", width, height)
        for top in (below, above):
            yield _words(node, x + 4, top, "start", width, height)
            yield _words(node, x - 4, top, "end", width, height)
            yield _words(node, x + 0.8 * w, top, "start", width, height)
            yield _words(node, x - 0.8 * w, top, "end", width, height)


def _words(node: Node, x: float, top: float, anchor: str, width: float, height: float) -> Words:
    left = {"middle": x - width / 2, "start": x, "end": x - width}[anchor]
    return Words(node, x, top + FONT * 0.85, anchor, (left, top, left + width, top + height))


def _around(node: Node) -> Box:
    (x, y), (w, h) = node.at, node.half
    return x - w - 2, y - h - 2, x + w + 2, y + h + 2


def _cover(box: Box, others: Sequence[Box], curves: Sequence[Sequence[Point]]) -> float:
    cost = 0.0
    for other in others:
        across = min(box[2], other[2]) - max(box[0], other[0])
        down = min(box[3], other[3]) - max(box[1], other[1])
        if across > -3 and down > -1:
            cost += 200.0 + max(across, 0.0) * max(down, 0.0)
    for curve in curves:
        inside = sum(box[0] - 2 < x < box[2] + 2 and box[1] - 1 < y < box[3] + 1 for x, y in curve)
        cost += 25.0 * (inside > 0) + 4.0 * inside
    return cost
