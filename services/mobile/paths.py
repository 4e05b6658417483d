"""Paths to plan where the track cannot be seen: arcs, straights and joins as points (m), and where
a track may resume. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from petrobot.services.mobile.odometry import Pose, turned

SPACING = 0.05
"""Distance between points (m)."""
Points = list[tuple[float, float]]


def resume_poses(end: Pose, square: float, radius: float) -> tuple[Pose, Pose, Pose]:
    """Return where the track can resume beyond an empty square that is entered at `end`: straight
    on, to the left, to the right.

    By the rules every element leads from the middle of one edge of its square to the middle of
    another.
    """
    ways = ((square, 0.0, 0.0), (radius, radius, 0.5 * math.pi), (radius, -radius, -0.5 * math.pi))
    straight_on, to_left, to_right = (
        Pose(*end.floor(ahead, left), end.heading + turn) for ahead, left, turn in ways
    )
    return straight_on, to_left, to_right


def arc(begin: Pose, curvature: float, length: float) -> Points:
    """Return points of a circle (1/m, positive to the left; 0: straight) from a pose on, `length` m
    long."""
    count = max(2, round(length / SPACING))
    return [_along(begin, curvature, length * i / count) for i in range(1, count + 1)]


def _along(begin: Pose, curvature: float, way: float) -> tuple[float, float]:
    angle = curvature * way
    if abs(angle) < 1e-6:
        return begin.floor(way, 0.5 * curvature * way * way)
    return begin.floor(math.sin(angle) / curvature, (1.0 - math.cos(angle)) / curvature)


def arc_through(begin: Pose, x: float, y: float, beyond: float) -> Points:
    """Return the circle tangent to a pose that leads through a point ahead of it, and `beyond` m
    straight on from there.

    On a chessboard track this is exactly the missing element: straight or arc, it is tangent to the
    line's end.
    """
    ahead, left = begin.body(x, y)
    squared = ahead * ahead + left * left
    curvature = 2.0 * left / squared
    bearing = math.atan2(left, ahead)
    length = (
        math.sqrt(squared)
        if abs(bearing) < 1e-6
        else math.sqrt(squared) * bearing / math.sin(bearing)
    )
    there = Pose(x, y, begin.heading + 2.0 * bearing)
    return arc(begin, curvature, length) + arc(there, 0.0, beyond)


def straight(begin: tuple[float, float], end: tuple[float, float]) -> Points:
    """Return points from one place to another."""
    length = math.hypot(end[0] - begin[0], end[1] - begin[1])
    return arc(Pose(*begin, math.atan2(end[1] - begin[1], end[0] - begin[0])), 0.0, length)


def join(begin: Pose, end: Pose, beyond: float) -> Points:
    """Return a cubic Hermite curve from one pose to another, and `beyond` m straight on."""
    size = math.hypot(end.x - begin.x, end.y - begin.y)
    count = max(4, round(size / SPACING))
    a, b = (
        (math.cos(begin.heading), math.sin(begin.heading)),
        (math.cos(end.heading), math.sin(end.heading)),
    )
    points: Points = []
    for i in range(count + 1):
        t = i / count
        h0, h1 = (1.0 + 2.0 * t) * (1.0 - t) ** 2, t * t * (3.0 - 2.0 * t)
        m0, m1 = size * t * (1.0 - t) ** 2, size * t * t * (t - 1.0)
        x = h0 * begin.x + m0 * a[0] + m1 * b[0] + h1 * end.x
        y = h0 * begin.y + m0 * a[1] + m1 * b[1] + h1 * end.y
        points.append((x, y))
    return points + arc(end, 0.0, beyond)


def passes(points: Sequence[tuple[float, float]], gate: Pose, aside: float, turn: float) -> bool:
    """Return whether a line seen as points (near to far) leads through a gate: within `aside` m of
    it and `turn` rad of its heading.

    The line counts as continuing straight for half a metre before its first point and after its
    last. A line seen in the opposite direction, by a rover that has gone too far and looks back,
    does not count: it would be followed backwards.
    """
    near, far = points[0], points[-1]
    direction = math.atan2(far[1] - near[1], far[0] - near[0])
    first = points[min(3, len(points) - 1)]
    begin = math.atan2(first[1] - near[1], first[0] - near[0])
    places = [Pose(*near, begin).floor(-0.5 + 0.1 * i, 0.0) for i in range(5)]
    places += [*points, *(Pose(*far, direction).floor(0.1 * i, 0.0) for i in range(1, 6))]
    closest = min(
        range(len(places)), key=lambda i: math.hypot(places[i][0] - gate.x, places[i][1] - gate.y)
    )
    if math.hypot(places[closest][0] - gate.x, places[closest][1] - gate.y) > aside:
        return False
    i = min(closest, len(places) - 2)
    local = math.atan2(places[i + 1][1] - places[i][1], places[i + 1][0] - places[i][0])
    return abs(turned(local - gate.heading)) < turn
