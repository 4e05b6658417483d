"""How the line ends: at the edge of a square without a track, or in the crossbar of the T.

The crossbar has the colour of the square behind it, so it is no stripe of its own: it pushes the edge of the square 5 cm
towards the rover as far as the bar reaches. What is measured is the place of that edge beside the line, close to it (where a
bar would be) and farther out (where there is none): one straight edge, an interruption; an edge that steps by a bar's width, the T.
The colours do not matter, nor does a small error in the direction of the line: the edge may be askew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.mobile.floor import FloorView
from services.mobile.model import Track
from services.mobile.sight import End, Sight, TrackEnd, Vector, polynomial

BACK, ON, STEP = 0.16, 0.26, 0.01
"""m before and after the last point of the line that are searched for the square's edge, and the step."""
SURE = 0.012
"""m, root mean square, that the edge may be off the better of the two shapes, and less than `BETTER` of the other's."""
BETTER = 0.6
ASKEW = 0.45
"""Slope of the edge against the square to the line's direction."""
LEAST_CONTRAST = 14.0
NEEDED = 3
"""Edges that must be seen both near the line and farther out."""


@dataclass(frozen=True, slots=True)
class _Columns:
    """Places beside the line (m, to the left positive) at which the edge is looked for."""

    inner: Vector
    outer: Vector


class EndFinder:
    """Judges line ends in images of one camera."""

    def __init__(self, view: FloorView, track: Track) -> None:
        self._view = view
        self._bar = track.bar_width
        half, line = 0.5 * track.bar_length, 0.5 * track.width
        inner = np.linspace(line + 0.045, half - 0.03, 6)
        outer = np.linspace(half + 0.035, half + 0.17, 6)
        self._columns = _Columns(np.concatenate([-inner, inner]), np.concatenate([-outer, outer]))
        self._s = np.arange(-BACK, ON + 1e-9, STEP)

    def judge(self, image: NDArray[np.uint8], sight: Sight) -> End | None:
        """How a line that broke off ends; None when too little of the square's edge is in view or it is neither."""
        if not (sight.seen and sight.broke_off):
            return None
        x, y, direction = _last(sight)
        columns = self._columns
        aside = np.concatenate([columns.inner, columns.outer])
        edge = self._edges(image, x, y, direction, aside)
        found = ~np.isnan(edge)
        inner = np.arange(aside.size) < columns.inner.size
        if int((found & inner).sum()) < NEEDED or int((found & ~inner).sum()) < NEEDED:
            return None
        kind, at = self._shape(aside[found], edge[found], inner[found])
        if kind is TrackEnd.NONE or not -0.06 < at < 0.24:
            return None  # not where the line ends: rows are centimetres apart, and the last ones may have been missed
        return End(kind, x + at * math.cos(direction), y + at * math.sin(direction))

    def _shape(self, aside: Vector, edge: Vector, inner: NDArray[np.bool_]) -> tuple[TrackEnd, float]:
        """Which shape the edge has, and where (m from the line's last point) the square ends on the line."""
        plain, plain_off = _straight(aside, edge)
        barred, barred_off = _straight(aside, edge + self._bar * inner)
        if plain_off < SURE and plain_off < BETTER * barred_off and abs(plain[1]) < ASKEW:
            return TrackEnd.INTERRUPTION, plain[0]
        if barred_off < SURE and barred_off < BETTER * plain_off and abs(barred[1]) < ASKEW:
            return TrackEnd.T, barred[0]
        return TrackEnd.NONE, 0.0

    def _edges(
        self, image: NDArray[np.uint8], x: float, y: float, direction: float, aside: Vector
    ) -> Vector:
        """Where along the line's direction (m from its last point) each column crosses from one colour to the other, else NaN."""
        cos, sin = math.cos(direction), math.sin(direction)
        s, t = self._s[None, :], aside[:, None]
        grey = self._view.sample(image, x + s * cos - t * sin, y + s * sin + t * cos)
        rise = grey[:, 3:] - grey[:, :-3]
        size = np.abs(rise)
        valid = ~np.isnan(size).any(axis=1)
        size = np.where(np.isnan(size), 0.0, size)
        best = np.clip(size.argmax(axis=1), 1, size.shape[1] - 2)
        row = np.arange(size.shape[0])
        before, at, after = size[row, best - 1], size[row, best], size[row, best + 1]
        valid &= at > max(LEAST_CONTRAST, 0.3 * float(np.nanmax(grey) - np.nanmin(grey)) if valid.any() else 255.0)
        shift = 0.5 * (before - after) / np.minimum(before - 2.0 * at + after, -1e-6)
        places = self._s[0] + (best + 1.5 + shift) * STEP
        return np.where(valid, places, np.nan)


def _straight(aside: Vector, edge: Vector) -> tuple[list[float], float]:
    """The straight line through an edge but for its worst point (at 0 and slope), and how far the rest is off it (m, rms)."""
    line = polynomial(aside, edge, 1)
    off = np.abs(edge - line[0] - line[1] * aside)
    keep = np.arange(edge.size) != int(off.argmax())
    line = polynomial(aside[keep], edge[keep], 1)
    off = edge[keep] - line[0] - line[1] * aside[keep]
    return line, math.sqrt(float(off @ off) / off.size)


def _last(sight: Sight) -> tuple[float, float, float]:
    """The line's last point and its direction there (m, rad)."""
    x, y = sight.x, sight.y
    near = x >= x[-1] - 0.25
    px, py = x[near] - x[-1], y[near]
    if px.size < 3:
        px, py = x - x[-1], y
    degree = 2 if px.size >= 6 else 1
    coefficients = np.polynomial.polynomial.polyfit(px, py, degree)
    return float(x[-1]), float(coefficients[0]), math.atan(float(coefficients[1]))
