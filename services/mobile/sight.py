"""What one image shows of the track: points of its centre line, and the offset, heading and
curvature computed from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FIT_REACH = 0.5
"""Length ahead of the nearest point over which one parabola describes the line (m)."""
POINT_SPACING = 0.05
"""Distance between streamed points (m)."""
STREAMED = 12
"""Most points in a set point."""
HEAD = 5
"""Numbers of a set point before its points."""


class TrackEnd(IntEnum):
    """How the line ends within view."""

    NONE = 0
    """It continues out of view, or it is not known yet how it ends."""
    INTERRUPTION = 1
    """The next square has no track."""
    T = 2
    """The crossbar of the T."""


class LineEnd(Struct, frozen=True):
    """Where (m, body frame at exposure) and how the line ends."""

    kind: TrackEnd
    x: float
    y: float


class Sight(Struct, frozen=True):
    """The line in one image, body frame at exposure: `x` ascending, `y` to the left (m); empty when
    none was seen.

    `confidence` is 0 to 1: the share of rows within reach in which the line was found.
    """

    x: Vector
    y: Vector
    confidence: float = 0.0
    end: LineEnd | None = None
    broke_off: bool = False
    """Whether rows that should show more of the line do not."""

    @property
    def seen(self) -> bool:
        """Whether there is a line."""
        return self.x.size > 2

    def line(self) -> Parabola:
        """Return a parabola over the first half metre, to know where to look next. Raises
        ValueError when no line was seen."""
        x, y = self._near()
        return fit_line(x, y)

    def describe(self) -> Shape:
        """Return offset, heading and curvature at the nearest point. Raises ValueError when no line
        was seen.

        The parabola is fitted along the chord: relative to the body's axis, an arc seen at 60
        degrees is not a parabola.
        """
        x, y = self._near()
        chord = math.atan2(float(y[-1] - y[0]), float(x[-1] - x[0]))
        cos, sin = math.cos(chord), math.sin(chord)
        along = fit_line((x - x[0]) * cos + (y - y[0]) * sin, (y - y[0]) * cos - (x - x[0]) * sin)
        steep = 1.0 + along.slope * along.slope
        offset = float(y[0]) + along.offset / max(0.2, math.cos(chord))
        return Shape(
            offset,
            chord + math.atan(along.slope),
            along.bend / (steep * math.sqrt(steep)),
        )

    def _near(self) -> tuple[Vector, Vector]:
        if not self.seen:
            raise ValueError("no line was seen")
        near = self.x <= self.x[0] + FIT_REACH
        return self.x[near], self.y[near]


UNSEEN = Sight(np.empty(0), np.empty(0))


class Shape(Struct, frozen=True):
    """The line at its nearest point: offset (m) and heading (rad) to the left, curvature (1/m,
    positive to the left)."""

    offset: float
    heading: float
    curvature: float


class Parabola(Struct, frozen=True):
    """A parabola y = offset + slope (x - near) + bend (x - near)^2 / 2 over [near, far] (m, body
    frame)."""

    near: float
    far: float
    offset: float
    slope: float
    bend: float

    def at(self, x: float) -> float:
        """Return y at a distance x (m)."""
        d = x - self.near
        return self.offset + self.slope * d + 0.5 * self.bend * d * d


def fit_line(x: Vector, y: Vector) -> Parabola:
    """Return the least-squares parabola through points, a straight line through fewer than five."""
    near, far = float(x[0]), float(x[-1])
    degree = 2 if x.size >= 5 and far - near > 0.15 else 1
    coefficients = polynomial(x - near, y, degree)
    bend = 2.0 * coefficients[2] if degree == 2 else 0.0
    return Parabola(near, far, coefficients[0], coefficients[1], bend)


def polynomial(x: Vector, y: Vector, degree: int, weights: Vector | None = None) -> list[float]:
    """Return the coefficients, constant first, of the weighted least-squares polynomial. Raises
    LinAlgError for too few points."""
    powers = [np.ones_like(x)]
    for _ in range(2 * degree):
        powers.append(powers[-1] * x)
    w = np.ones_like(x) if weights is None else weights
    moments = [float(w @ p) for p in powers]
    wy = w * y
    right = [float(wy @ p) for p in powers[: degree + 1]]
    matrix = [[moments[i + j] for j in range(degree + 1)] for i in range(degree + 1)]
    solved: list[float] = np.linalg.solve(np.array(matrix), np.array(right)).tolist()
    return solved


class TrackAhead(Struct, frozen=True):
    """A set point of the stream `track_ahead`: [age, confidence, end, end_x, end_y, x1, y1, x2, y2,
    ...].

    `age` s since mid-exposure when it was published; `confidence` 0: no line; `end` a `TrackEnd` at
    (end_x, end_y); then up to `STREAMED` points of the centre line, near to far (m, body frame at
    exposure).
    """

    age: float
    confidence: float
    end: LineEnd | None = None
    points: tuple[tuple[float, float], ...] = ()

    def values(self) -> list[float]:
        """Return the set point as numbers."""
        end = self.end or LineEnd(TrackEnd.NONE, 0.0, 0.0)
        flat = [c for point in self.points for c in point]
        return [self.age, self.confidence, float(end.kind), end.x, end.y, *flat]

    @staticmethod
    def parse(values: Sequence[float], held: float = 0.0) -> TrackAhead:
        """Read numbers that were held for `held` s since their sender published them. Raises
        ValueError when they are not a set point."""
        rest = len(values) - HEAD
        if rest < 0 or rest % 2 or rest // 2 > STREAMED or not all(map(math.isfinite, values)):
            raise ValueError(
                f"track_ahead: expected {HEAD} finite numbers and up to {STREAMED} pairs, got "
                f"{len(values)} numbers"
            )
        age, confidence, kind, x, y = values[:HEAD]
        if kind not in tuple(TrackEnd) or age < 0.0:
            raise ValueError(
                f"track_ahead: expected an age of 0 or more and an end of 0 to 2, got {age} "
                f"and {kind}"
            )
        end = None if kind == TrackEnd.NONE else LineEnd(TrackEnd(int(kind)), x, y)
        points = tuple(zip(values[HEAD::2], values[HEAD + 1 :: 2], strict=True))
        return TrackAhead(age + held, confidence, end, points)


def thinned(sight: Sight) -> tuple[tuple[float, float], ...]:
    """Return points of a sight for the stream: the nearest first, at least `POINT_SPACING`
    apart."""
    points: list[tuple[float, float]] = []
    for x, y in zip(sight.x.tolist(), sight.y.tolist(), strict=True):
        if len(points) == STREAMED:
            break
        if not points or math.hypot(x - points[-1][0], y - points[-1][1]) >= POINT_SPACING:
            points.append((x, y))
    return tuple(points)
