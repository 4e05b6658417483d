"""Paths of arcs around nodes, and positions of labels that cover as little as possible.

Both are greedy: one arc or label after the other takes the candidate of the lowest cost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise, starmap
from math import ceil, copysign, dist, hypot, inf

from msgspec import Struct

from petrobot.coordinator.drawing.layout import Point
from petrobot.coordinator.drawing.scene import RADIUS, Arc, DrawnNode, Scene

Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""

_BENDS = (0.0, *(b for w in (34.0, 68.0, 110.0, 160.0, 220.0, 340.0, 520.0) for b in (w, -w)))
"""Candidates for the bend of an arc, the straight line first (drawing units)."""
_CLEARANCE = 7.0
"""Distance that an arc keeps from the border of a node."""
_SAMPLES = 24
"""Least number of points on an arc that are tested for collisions."""
_STEP = 10.0
"""Distance of those points on a long arc: with its clearance a bar is wider, so none is missed."""
_LEVEL = 36.0
"""How far an arc may run level on both sides of a path point."""
_AROUND = 80.0
"""Largest distance of a label from its node, in addition to its own width."""
FONT = 12.5
LINE = 15.0
_CHARACTER = 0.565
"""Mean width of a character, relative to the font size."""


class ArcPath(Struct, frozen=True):
    """A smooth curve from border to border: a quadratic B-spline over its control points.

    `bend` is the distance of a single control point from the straight line.
    """

    arc: Arc
    start: Point
    controls: tuple[Point, ...]
    end: Point
    bend: float

    @property
    def is_straight(self) -> bool:
        """Whether it is a straight line."""
        return len(self.controls) == 1 and self.bend == 0

    def pieces(self, end: Point | None = None) -> list[tuple[Point, Point, Point]]:
        """Return its quadratic Bezier pieces: start, control point and end of each."""
        knots = [((a[0] + b[0]) / 2, (a[1] + b[1]) / 2) for a, b in pairwise(self.controls)]
        return list(
            zip([self.start, *knots], self.controls, [*knots, end or self.end], strict=True)
        )

    def point(self, s: float) -> Point:
        """Return the point at s, from 0 at the start to 1 at the end."""
        return _point(self.pieces(), s)

    @property
    def points(self) -> list[Point]:
        """Points along the curve, close enough to detect the nodes that it crosses."""
        pieces, found = self.pieces(), [self.start]
        for piece in pieces:  # a piece may be as long as all the others together
            n = ceil(max(_SAMPLES / len(pieces), 8.0, sum(starmap(dist, pairwise(piece))) / _STEP))
            found += [_point([piece], i / n) for i in range(1, n + 1)]
        return found


def _point(pieces: Sequence[tuple[Point, Point, Point]], s: float) -> Point:
    n = len(pieces)
    i = min(int(s * n), n - 1)
    u = s * n - i
    (x0, y0), (x1, y1), (x2, y2) = pieces[i]
    a, b, c = (1 - u) ** 2, 2 * u * (1 - u), u * u
    return a * x0 + b * x1 + c * x2, a * y0 + b * y1 + c * y2


class LabelBox(Struct, frozen=True):
    """The label of a node: start of its first baseline, text anchor, and the box that it covers."""

    node: DrawnNode
    x: float
    y: float
    anchor: str
    box: Box


def route(scene: Scene) -> list[ArcPath]:
    """Return a path for each arc.

    It runs through the points of the layout, or else has the smallest bend that avoids other nodes
    and other arcs between the same two nodes.
    """
    arcs = scene.arcs
    pairs: dict[frozenset[str], set[float]] = {}
    count = Counter(frozenset((a.source, a.target)) for a in arcs)
    paths: list[ArcPath] = []
    for arc in arcs:
        key = frozenset((arc.source, arc.target))
        used = pairs.setdefault(key, set())
        best = _best(scene, arc, used, count[key] > 1)
        sense = 1.0 if arc.source < arc.target else -1.0
        used.add(best.bend * sense)
        paths.append(best)
    return paths


def _best(scene: Scene, arc: Arc, used: set[float], twins: bool) -> ArcPath:
    """Return the path of lowest cost.

    Candidates come in order of a lower bound of their cost, so the search ends as soon as no later
    one can be better.
    """
    led = scene.through.get((arc.source, arc.target), ())
    best, least = None, inf
    candidates = (
        [
            (0.0, partial(_path_through, points=led)),
            (0.5, partial(_path_through, points=led, level=_LEVEL)),
        ]
        if led
        else []
    )
    for cost_at_least, make in [
        *candidates,
        *((abs(bend), partial(_bent_path, bend=bend)) for bend in _BENDS),
    ]:
        if best is not None and least <= cost_at_least:
            break
        path = make(scene.nodes, arc)
        cost = _cost(scene.nodes, path, used, twins) + (
            cost_at_least if len(path.controls) > 1 else 0.0
        )
        if best is None or cost < least:
            best, least = path, cost
    assert best is not None
    return best


def _bent_path(nodes: Mapping[str, DrawnNode], arc: Arc, bend: float) -> ArcPath:
    source, target = nodes[arc.source], nodes[arc.target]
    (x1, y1), (x2, y2) = source.at, target.at
    length = hypot(x2 - x1, y2 - y1) or 1.0
    control = ((x1 + x2) / 2 - (y2 - y1) / length * bend, (y1 + y2) / 2 + (x2 - x1) / length * bend)
    return ArcPath(arc, _border(source, control), (control,), _border(target, control), bend)


def _path_through(
    nodes: Mapping[str, DrawnNode], arc: Arc, points: Sequence[Point], level: float = 0.0
) -> ArcPath:
    """Return the path through the points of the layout.

    Points that lie on the line between their neighbours are left out, so straight parts stay
    straight. With `level` the path runs level for this distance on both sides of each point, so it
    does not cut a corner over a neighbour of the point.
    """
    if level:  # each second band of a wide layout runs to the left
        around = [nodes[arc.source].at, *points, nodes[arc.target].at]
        senses = [copysign(level, b[0] - a[0]) for a, b in zip(around, around[2:], strict=False)]
        ways = zip(points, senses, strict=True)
        points = [p for (x, y), step in ways for p in ((x - step, y), (x + step, y))]
    kept: list[Point] = []
    ahead = [*points[1:], nodes[arc.target].at]
    for point, after in zip(points, ahead, strict=True):
        x0, y0 = kept[-1] if kept else nodes[arc.source].at
        off = (after[0] - x0) * (point[1] - y0) - (after[1] - y0) * (point[0] - x0)
        if abs(off) > 2.0 * hypot(after[0] - x0, after[1] - y0):
            kept.append(point)
    if not kept:
        return _bent_path(nodes, arc, 0.0)
    source, target = nodes[arc.source], nodes[arc.target]
    return ArcPath(arc, _border(source, kept[0]), tuple(kept), _border(target, kept[-1]), 0.0)


def _border(node: DrawnNode, towards: Point) -> Point:
    """Return where the line from the centre of a node towards a point crosses its border."""
    (x, y), (w, h) = node.at, node.half
    dx, dy = towards[0] - x, towards[1] - y
    if node.is_place:
        length = hypot(dx, dy) or 1.0
        return x + dx / length * (RADIUS + 2), y + dy / length * (RADIUS + 2)
    scale = min((w + 2) / abs(dx) if dx else 1e9, (h + 2) / abs(dy) if dy else 1e9)
    return x + dx * scale, y + dy * scale


def _cost(nodes: Mapping[str, DrawnNode], path: ArcPath, used: set[float], twins: bool) -> float:
    """Return the cost: 1000 per node hit, 1500 for lying on another arc, plus the bend itself.

    A path through the layout's points is preferred to an equally cheap bent one (-0.5).
    """
    ends = (path.arc.source, path.arc.target)
    points = path.points
    box = _box_of(points)
    hits = 0
    for node in nodes.values():
        (x, y), (w, h) = node.at, node.half
        clear = x - w - _CLEARANCE, y - h - _CLEARANCE, x + w + _CLEARANCE, y + h + _CLEARANCE
        if _touch(box, clear) and node.name not in ends:
            hits += bool(_inside(clear, points))
    sense = 1.0 if path.arc.source < path.arc.target else -1.0
    alone = len(path.controls) == 1
    taken = alone and (path.bend * sense in used or (twins and path.bend == 0.0))
    return 1000.0 * hits + 1500.0 * taken + abs(path.bend) - 0.5 * (not alone)


def place_words(nodes: Mapping[str, DrawnNode], paths: Sequence[ArcPath]) -> list[LabelBox]:
    """Place the label of each node where it covers least.

    Covering nodes and other labels costs most, then arcs. Long labels are placed first, because
    they have the fewest free positions; those of places before those of transitions.
    """
    solid = [_around(n) for n in nodes.values()]
    curves = [(_box_of(points), points) for points in (w.points for w in paths)]
    placed: list[LabelBox] = []
    for node in sorted(
        nodes.values(), key=lambda n: (not n.is_place, -max(map(len, n.lines), default=0))
    ):
        region = _region(node)
        others = [b for b in solid if _touch(b, region) and b != _around(node)]
        others += [w.box for w in placed if _touch(w.box, region)]
        near = [
            near
            for box, points in curves
            if _touch(box, region) and (near := _inside(region, points))
        ]
        spots = list(_spots(node))
        costs = [_cover(w.box, others, near) + 0.4 * i for i, w in enumerate(spots)]
        placed.append(spots[costs.index(min(costs))])
    return placed


def _region(node: DrawnNode) -> Box:
    """Return the region in which the label of a node can be."""
    (x, y), reach = node.at, _AROUND + max(map(text_width, node.lines), default=0.0)
    tall = _AROUND + LINE * len(node.lines)
    return x - reach, y - tall, x + reach, y + tall


def _touch(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _inside(box: Box, points: Sequence[Point]) -> list[Point]:
    left, top, right, bottom = box
    return [p for p in points if left < p[0] < right and top < p[1] < bottom]


def _box_of(points: Sequence[Point]) -> Box:
    x, y = [p[0] for p in points], [p[1] for p in points]
    return min(x), min(y), max(x), max(y)


def badge_spot(node: DrawnNode, paths: Sequence[ArcPath]) -> Point:
    """Return the corner of a place that is farthest from the ends of its arcs, for its badge."""
    ends = [w.start for w in paths if w.arc.source == node.name] + [
        w.end for w in paths if w.arc.target == node.name
    ]
    reach = RADIUS * 0.8
    corners = [
        (node.at[0] + sx * reach, node.at[1] + sy * reach) for sy in (-1, 1) for sx in (1, -1)
    ]
    return max(
        corners, key=lambda c: min((hypot(c[0] - x, c[1] - y) for x, y in ends), default=0.0) // 4
    )


def text_width(text: str) -> float:
    """Return the estimated width of a text in the font of the drawing."""
    return len(text) * FONT * _CHARACTER


def _spots(node: DrawnNode) -> Iterator[LabelBox]:
    """Yield candidate positions of a label, the usual ones first."""
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


def _words(
    node: DrawnNode, x: float, top: float, anchor: str, width: float, height: float
) -> LabelBox:
    left = {"middle": x - width / 2, "start": x, "end": x - width}[anchor]
    return LabelBox(node, x, top + FONT * 0.85, anchor, (left, top, left + width, top + height))


def _around(node: DrawnNode) -> Box:
    (x, y), (w, h) = node.at, node.half
    return x - w - 2, y - h - 2, x + w + 2, y + h + 2


def _cover(box: Box, others: Sequence[Box], curves: Sequence[Sequence[Point]]) -> float:
    """Return the cost of what a label covers: boxes by area, arcs by the length inside the box."""
    cost = 0.0
    for other in others:
        across = min(box[2], other[2]) - max(box[0], other[0])
        down = min(box[3], other[3]) - max(box[1], other[1])
        if across > -3 and down > -1:
            cost += 200.0 + max(across, 0.0) * max(down, 0.0)
    around = box[0] - 2, box[1] - 1, box[2] + 2, box[3] + 1
    for curve in curves:
        inside = len(_inside(around, curve))
        cost += 25.0 * (inside > 0) + 4.0 * inside
    return cost
