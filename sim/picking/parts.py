"""Parts on a table: outlines in the plane, contact between them, and how a push moves a part.

A part is an upright prism: a box or a cylinder. Pushing is slow, so a part moves only as far as it
is pushed (quasi-static): the direction of its motion follows from the limit surface of its friction
on the table, taken as an ellipsoid (Goyal, Ruina, Papadopoulos 1991; Lynch and Mason 1996).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from msgspec import Struct, field

Point = tuple[float, float]
CORNERS: Final = 24
"""Corners of the polygon that approximates a circle: its radius is at most 0.9 % too small."""


class Contact(NamedTuple):
    """Overlap of two outlines: depth (m), unit normal from the first to the second, and point of
    contact."""

    depth: float
    normal: Point
    point: Point


class Part(Struct):
    """A part: its true size (m), mass (kg), friction coefficient at the fingers, and pose."""

    number: int
    kind: str
    round: bool
    length: float
    """Length along its own x axis (m); the diameter of a round part."""
    width: float
    height: float
    mass: float
    friction: float
    grey: float
    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    """Direction of its own x axis in the table's frame (rad)."""
    z: float = 0.0
    """Height of its bottom above the table (m)."""
    lost: bool = False
    """Whether it fell off the table."""
    _outline: list[Point] = field(default_factory=list)
    _pose: tuple[float, float, float] = (math.inf, 0.0, 0.0)

    @property
    def top(self) -> float:
        """Height of its top above the table (m)."""
        return self.z + self.height

    @property
    def reach(self) -> float:
        """Radius of the circle around it (m)."""
        return self.length / 2 if self.round else math.hypot(self.length, self.width) / 2

    def outline(self) -> list[Point]:
        """Its corners in the table's frame, counter-clockwise."""
        pose = self.x, self.y, self.turn
        if pose != self._pose:
            c, s = math.cos(self.turn), math.sin(self.turn)
            self._outline = [
                (self.x + c * px - s * py, self.y + s * px + c * py) for px, py in self._corners()
            ]
            self._pose = pose
        return self._outline

    def _corners(self) -> list[Point]:
        if self.round:
            step = 2.0 * math.pi / CORNERS
            r = self.length / 2
            return [(r * math.cos(k * step), r * math.sin(k * step)) for k in range(CORNERS)]
        a, b = self.length / 2, self.width / 2
        return [(-a, -b), (a, -b), (a, b), (-a, b)]

    def push(self, direction: Point, distance: float, at: Point) -> None:
        """Move the part so that its point `at` moves `distance` m along the unit vector
        `direction`.

        For a force f at r from the centre, the ellipsoid gives a velocity along f and a turn
        (r x f) / c^2, c the ratio of the greatest friction torque to the greatest friction force.
        """
        c = 0.6 * self.reach  # two thirds of the radius for a disc, a little less for a square
        rx, ry = at[0] - self.x, at[1] - self.y
        arm = rx * direction[1] - ry * direction[0]
        share = distance / (1.0 + (arm / c) ** 2)
        self.x += share * direction[0]
        self.y += share * direction[1]
        self.turn += share * arm / c**2


def rectangle(x: float, y: float, turn: float, along: float, across: float) -> list[Point]:
    """Return the corners of a rectangle around (x, y) whose side `along` points to `turn`."""
    c, s = math.cos(turn), math.sin(turn)
    a, b = along / 2, across / 2
    corners = (-a, -b), (a, -b), (a, b), (-a, b)
    return [(x + c * px - s * py, y + s * px + c * py) for px, py in corners]


def contact(first: Sequence[Point], second: Sequence[Point]) -> Contact | None:
    """Return how two convex outlines overlap, None if they do not (separating axes)."""
    best: tuple[float, Point] | None = None
    for polygon in (first, second):
        x0, y0 = polygon[-1]
        for x1, y1 in polygon:
            nx, ny = y1 - y0, x0 - x1
            x0, y0 = x1, y1
            size = math.hypot(nx, ny)
            if size == 0.0:
                continue
            nx, ny = nx / size, ny / size
            one = [nx * x + ny * y for x, y in first]
            two = [nx * x + ny * y for x, y in second]
            ahead, behind = max(one) - min(two), max(two) - min(one)
            if ahead <= 0.0 or behind <= 0.0:
                return None
            depth, sign = (ahead, 1.0) if ahead <= behind else (behind, -1.0)
            if best is None or depth < best[0] - 1e-12:
                best = depth, (sign * nx, sign * ny)
    if best is None:
        return None
    inside = [p for p in second if within(p, first)] + [p for p in first if within(p, second)]
    touching = inside or [*first, *second]
    count = len(touching)
    at = sum(p[0] for p in touching) / count, sum(p[1] for p in touching) / count
    return Contact(best[0], best[1], at)


def within(point: Point, polygon: Sequence[Point]) -> bool:
    """Return whether a point lies in a convex outline with counter-clockwise corners."""
    x0, y0 = polygon[-1]
    for x1, y1 in polygon:
        if (x1 - x0) * (point[1] - y0) - (y1 - y0) * (point[0] - x0) < 0.0:
            return False
        x0, y0 = x1, y1
    return True


def clipped(polygon: Sequence[Point], half: float) -> list[Point]:
    """Return the part of a convex outline within |y| <= half."""
    for sign in (1.0, -1.0):
        kept: list[Point] = []
        for k, (x1, y1) in enumerate(polygon):
            x0, y0 = polygon[k - 1]
            inside0, inside1 = sign * y0 <= half, sign * y1 <= half
            if inside0 is not inside1:
                share = (sign * half - y0) / (y1 - y0)
                kept.append((x0 + share * (x1 - x0), sign * half))
            if inside1:
                kept.append((x1, y1))
        polygon = kept
    return list(polygon)
