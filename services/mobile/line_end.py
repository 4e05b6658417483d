"""How the line ends: at the edge of a square that carries no track, or in the crossbar of the T.

Both are looked for in a patch of floor around the line's last point, in columns beside the line: a
crossbar is a stripe across it with the square's colour on both sides, the edge of a square a step
in one straight line, farther out than a bar reaches. The colours do not matter, nor does a small
error in the direction of the line: stripe and edge may be askew.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from petrobot.services.mobile.floor import FloorView, Grey
from petrobot.services.mobile.model import Track
from petrobot.services.mobile.sight import End, Sight, TrackEnd, Vector, polynomial

BACK, ON, STEP = 0.16, 0.26, 0.01
"""m before and after the last point of the line that are searched, and the step."""
AT_LEAST, AT_MOST = -0.06, 0.20
"""m from the line's last point to its end: rows are centimetres apart, and the last ones may have
been missed."""
SURE = 0.012
"""m, root mean square, that a stripe or an edge may be off a straight line."""
ASKEW = 0.45
"""Slope of stripe or edge against the square to the line's direction."""
LEAST_CONTRAST = 14.0
CONTRAST_SHARE = 0.3
"""Share of the patch's range of grey that an edge or a stripe must have."""
NEEDED = 3
"""Columns on each side of the line that must show the stripe; edges that must be seen near the line
and farther out."""


class EndFinder:
    """Judges line ends in images of one camera."""

    def __init__(self, view: FloorView, track: Track) -> None:
        self._view = view
        self._bar = track.bar_width
        half, line = 0.5 * track.bar_length, 0.5 * track.width
        inner = np.linspace(line + 0.045, half - 0.03, 6)
        outer = np.linspace(half + 0.035, half + 0.17, 6)
        self._aside = np.concatenate([-inner, inner, -outer, outer])
        self._inner = np.arange(self._aside.size) < 2 * inner.size
        self._s = np.arange(-BACK, ON + 1e-9, STEP)

    def judge(self, image: NDArray[np.uint8], sight: Sight) -> End | None:
        """How a line that broke off ends; None when it is neither, or too little is in view to
        tell."""
        if not (sight.seen and sight.broke_off):
            return None
        x, y, direction = _last(sight)
        grey = self._patch(image, x, y, direction)
        valid: NDArray[np.bool_] = np.logical_not(np.isnan(grey).any(axis=1))
        if int(valid.sum()) < 2 * NEEDED:
            return None
        least = max(LEAST_CONTRAST, CONTRAST_SHARE * float(grey[valid].max() - grey[valid].min()))
        bar, striped = self._stripe(grey, valid, least)
        if bar is not None:
            kind, at = TrackEnd.T, bar + 0.5 * self._bar
        elif striped:
            return None
        else:
            edge = self._edge(grey, valid, least)
            if edge is None:
                return None
            kind, at = TrackEnd.INTERRUPTION, edge
        return End(kind, x + at * math.cos(direction), y + at * math.sin(direction))

    def _patch(self, image: NDArray[np.uint8], x: float, y: float, direction: float) -> Grey:
        """Grey levels (columns beside the line, places along its direction)."""
        cos, sin = math.cos(direction), math.sin(direction)
        s, t = self._s[None, :], self._aside[:, None]
        return self._view.sample(image, x + s * cos - t * sin, y + s * sin + t * cos)

    def _stripe(
        self, grey: Grey, valid: NDArray[np.bool_], least: float
    ) -> tuple[float | None, bool]:
        """Where a crossbar's middle meets the line (m from its last point), None without one; and
        whether much looks like one."""
        side = round(self._bar / STEP)
        core = (grey[:, :-2] + grey[:, 1:-1] + grey[:, 2:]) / np.float32(3.0)
        left, right = (
            core[:, side:-side] - core[:, : -2 * side],
            core[:, side:-side] - core[:, 2 * side :],
        )
        lesser = np.minimum(np.abs(left), np.abs(right))
        size = np.where((left * right > 0.0) & valid[:, None], lesser, np.float32(0.0))
        best, place = _peaks(size, self._s[0] + (1 + side) * STEP)
        shows = (best > least) & valid & self._inner
        left_side, right_side = shows & (self._aside < 0.0), shows & (self._aside > 0.0)
        striped = int(shows.sum()) >= NEEDED
        if int(left_side.sum()) < NEEDED or int(right_side.sum()) < NEEDED:
            return None, striped
        line, off = _straight(self._aside[shows], place[shows])
        fits = off < SURE and abs(line[1]) < ASKEW and AT_LEAST < line[0] < AT_MOST
        return (line[0] if fits else None), striped

    def _edge(self, grey: Grey, valid: NDArray[np.bool_], least: float) -> float | None:
        """Where the edge of the square meets the line (m from its last point), None if there is
        none."""
        size = np.where(valid[:, None], np.abs(grey[:, 3:] - grey[:, :-3]), np.float32(0.0))
        best, place = _peaks(size, self._s[0] + 1.5 * STEP)
        shows = (best > least) & valid
        if int((shows & self._inner).sum()) < NEEDED or int((shows & ~self._inner).sum()) < NEEDED:
            return None
        line, off = _straight(self._aside[shows], place[shows])
        fits = off < SURE and abs(line[1]) < ASKEW and AT_LEAST < line[0] < AT_MOST
        return line[0] if fits else None


def _peaks(size: Grey, first: float) -> tuple[Grey, Vector]:
    """Each row's greatest value and its place (m), to a fraction of a step; column 0 lies at
    `first` (m)."""
    row = np.arange(size.shape[0])
    best = np.clip(size.argmax(axis=1), 1, size.shape[1] - 2)
    before, at, after = size[row, best - 1], size[row, best], size[row, best + 1]
    shift = 0.5 * (before - after) / np.minimum(before - 2.0 * at + after, -1e-6)
    return at, first + (best + np.clip(shift, -1.0, 1.0)) * STEP


def _straight(aside: Vector, place: Vector) -> tuple[list[float], float]:
    """The straight line through points but for the worst one (at 0 and slope), and how far the rest
    is off it (m, rms)."""
    line = polynomial(aside, place, 1)
    off = np.abs(place - line[0] - line[1] * aside)
    keep = np.arange(place.size) != int(off.argmax())
    line = polynomial(aside[keep], place[keep], 1)
    off = place[keep] - line[0] - line[1] * aside[keep]
    return line, math.sqrt(float(off @ off) / off.size)


def _last(sight: Sight) -> tuple[float, float, float]:
    """The line's last point and its direction there (m, rad)."""
    x, y = sight.x, sight.y
    near = x >= x[-1] - 0.25
    px, py = x[near] - x[-1], y[near]
    if px.size < 3:
        px, py = x - x[-1], y
    degree = 2 if px.size >= 6 else 1
    coefficients = polynomial(px, py, degree)
    return float(x[-1]), float(coefficients[0]), math.atan(float(coefficients[1]))
