"""One element of the chessboard track: how it crosses its square, its centre line, and how far
points lie within its paint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Square = tuple[int, int]
"""Column and row: the square reaches from 2 i to 2 i + 2 m in x and from 2 j to 2 j + 2 m in y."""

SQUARE: Final = 2.0
"""Side of a square (m)."""
RADIUS: Final = 1.0
"""Radius of an arc's centre line (m)."""
HALF_WIDTH: Final = 0.025
"""Half the track's width (m)."""
BAR_LENGTH, BAR_WIDTH = 0.50, 0.05
"""Length and width of the T's crossbar (m)."""
BAR_MARGIN: Final = 0.25
"""m between the crossbar and the end of its square: without paint of one colour all around, it
would not be a T."""
_DIRECTIONS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Unit vectors of the headings 0, 90, 180, 270 degrees."""


class ElementKind(StrEnum):
    """Kind of an element, in the direction of travel."""

    STRAIGHT = "S"
    LEFT = "L"
    RIGHT = "R"

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return SQUARE if self is ElementKind.STRAIGHT else 0.5 * math.pi * RADIUS

    @property
    def turn(self) -> int:
        """Quarter turns to the left from its entrance to its exit."""
        return {ElementKind.STRAIGHT: 0, ElementKind.LEFT: 1, ElementKind.RIGHT: -1}[self]


class FloorPose(NamedTuple):
    """A point of the floor (m) and a heading (rad, counter-clockwise from x)."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Element:
    """One element. `heading` counts quarter turns from x; `start` is the arc length at its entrance
    (m)."""

    kind: ElementKind
    square: Square
    heading: int
    start: float
    painted: bool = True

    @property
    def end(self) -> float:
        """Arc length at its exit (m)."""
        return self.start + self.kind.length

    @property
    def entrance(self) -> tuple[float, float]:
        """Where it is entered (m)."""
        dx, dy = _DIRECTIONS[self.heading]
        return (self.square[0] + 0.5 * (1 - dx)) * SQUARE, (
            self.square[1] + 0.5 * (1 - dy)
        ) * SQUARE

    def at(self, way: float) -> FloorPose:
        """Return the pose `way` metres after the entrance; the line continues straight before the
        entrance and after the exit."""
        turn, inside = self.kind.turn, min(max(way, 0.0), self.kind.length)
        if turn:
            angle = inside / RADIUS
            u, w = RADIUS * math.sin(angle), turn * RADIUS * (1.0 - math.cos(angle))
        else:
            angle, u, w = 0.0, inside, 0.0
        beyond = way - inside
        u, w = u + beyond * math.cos(angle), w + beyond * turn * math.sin(angle)
        (x, y), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        return FloorPose(
            x + u * dx - w * dy, y + u * dy + w * dx, self.heading * 0.5 * math.pi + turn * angle
        )

    def nearest(self, x: float, y: float) -> tuple[float, float, float]:
        """Return for a point: distance after the entrance (m, within the element), offset to the
        left (m) and distance (m)."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, (y - y0) * dx - (x - x0) * dy
        if self.kind is ElementKind.STRAIGHT:
            way = min(max(u, 0.0), SQUARE)
            return way, w, math.hypot(u - way, w)
        turn = self.kind.turn
        angle = min(max(math.atan2(u, RADIUS - turn * w), 0.0), 0.5 * math.pi)
        aside = math.hypot(
            u - RADIUS * math.sin(angle), turn * w - RADIUS * (1.0 - math.cos(angle))
        )
        return angle * RADIUS, turn * (RADIUS - math.hypot(u, RADIUS - turn * w)), aside

    def depth(self, x: Array, y: Array) -> Array:
        """Return how far (m) points (...,) of its square lie within the track if it is painted;
        negative outside."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, (y - y0) * dx - (x - x0) * dy
        aside = (
            w
            if self.kind is ElementKind.STRAIGHT
            else np.hypot(u, RADIUS - self.kind.turn * w) - RADIUS
        )
        inside: Array = HALF_WIDTH - np.abs(aside)
        return inside

    def tee_depth(self, x: Array, y: Array) -> Array:
        """Return the same where a straight element ends in a T: a crossbar before its exit, and
        nothing beyond that."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, np.abs((y - y0) * dx - (x - x0) * dy)
        before_end = SQUARE - BAR_MARGIN - u
        stem = np.minimum(HALF_WIDTH - w, before_end)
        bar = np.minimum(0.5 * BAR_LENGTH - w, np.minimum(before_end, BAR_WIDTH - before_end))
        inside: Array = np.maximum(stem, bar)
        return inside

    @property
    def next_square(self) -> Square:
        """The square beyond its exit."""
        return beyond_edge(self.square, self.next_heading)

    @property
    def next_heading(self) -> int:
        """Heading at its exit, in quarter turns."""
        return (self.heading + self.kind.turn) % 4


def beyond_edge(square: Square, heading: int) -> Square:
    """Return the square next to `square` in direction `heading` (quarter turns)."""
    dx, dy = _DIRECTIONS[heading]
    return square[0] + dx, square[1] + dy
