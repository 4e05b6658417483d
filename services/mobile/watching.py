"""From image to image: continue where the line was last, and believe an end only when several
images show the same. Pure.

A line ends at the edge of a square without a track, or in the crossbar of the T. Both are searched
in a patch of floor around the line's last point, in columns beside the line: a crossbar is a stripe
across it with the square's colour on both sides; the edge of a square is a step along one straight
line, farther out than a bar reaches. The colours do not matter, nor does a small error in the
direction of the line: stripe and edge may be askew.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.services.mobile.detection import FloorView, Grey, ScanGrid, TrackDetector
from petrobot.services.mobile.model import FloorSizes, RoverModel
from petrobot.services.mobile.sight import (
    UNSEEN,
    LineEnd,
    Parabola,
    Sight,
    TrackEnd,
    Vector,
    polynomial,
)

# --- Line ends in one image ----------------------------------------------------------------------

BACK, ON, STEP = 0.16, 0.26, 0.01
"""What is searched before and after the last point of the line, and the step (m)."""
AT_LEAST, AT_MOST = -0.06, 0.20
"""Least and greatest distance (m) from the line's last point to its end: rows are centimetres
apart, and the last ones may have been missed."""
SURE = 0.012
"""Greatest rms distance of a stripe or an edge from a straight line (m)."""
ASKEW = 0.45
"""Greatest slope of stripe or edge against the perpendicular of the line."""
LEAST_CONTRAST = 14.0
"""Least grey levels of an edge or a stripe."""
CONTRAST_SHARE = 0.3
"""Share of the patch's range of grey that an edge or a stripe must have."""
COLUMNS_NEEDED = 3
"""Columns on each side of the line that must show the stripe; edges that must be seen near the line
and farther out."""


class EndFinder:
    """Judges line ends in images of one camera."""

    def __init__(self, view: FloorView, track: FloorSizes) -> None:
        self._view = view
        self._bar = track.bar_width
        half, line = 0.5 * track.bar_length, 0.5 * track.width
        inner = np.linspace(line + 0.045, half - 0.03, 6)
        outer = np.linspace(half + 0.035, half + 0.17, 6)
        self._aside = np.concatenate([-inner, inner, -outer, outer])
        self._inner = np.arange(self._aside.size) < 2 * inner.size
        self._s = np.arange(-BACK, ON + 1e-9, STEP)

    def judge(self, image: NDArray[np.uint8], sight: Sight) -> LineEnd | None:
        """Return how a line that broke off ends; None when it is neither kind, or too little is in
        view."""
        if not (sight.seen and sight.broke_off):
            return None
        x, y, direction = _last(sight)
        grey = self._patch(image, x, y, direction)
        valid: NDArray[np.bool_] = np.logical_not(np.isnan(grey).any(axis=1))
        if int(valid.sum()) < 2 * COLUMNS_NEEDED:
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
        return LineEnd(kind, x + at * math.cos(direction), y + at * math.sin(direction))

    def _patch(self, image: NDArray[np.uint8], x: float, y: float, direction: float) -> Grey:
        """Return grey levels (columns beside the line, samples along its direction)."""
        cos, sin = math.cos(direction), math.sin(direction)
        s, t = self._s[None, :], self._aside[:, None]
        return self._view.sample(image, x + s * cos - t * sin, y + s * sin + t * cos)

    def _stripe(
        self, grey: Grey, valid: NDArray[np.bool_], least: float
    ) -> tuple[float | None, bool]:
        """Return where a crossbar's middle meets the line (m from its last point), None without
        one; and whether much looks like a bar."""
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
        striped = int(shows.sum()) >= COLUMNS_NEEDED
        if int(left_side.sum()) < COLUMNS_NEEDED or int(right_side.sum()) < COLUMNS_NEEDED:
            return None, striped
        line, off = _straight(self._aside[shows], place[shows])
        fits = off < SURE and abs(line[1]) < ASKEW and AT_LEAST < line[0] < AT_MOST
        return (line[0] if fits else None), striped

    def _edge(self, grey: Grey, valid: NDArray[np.bool_], least: float) -> float | None:
        """Return where the edge of the square meets the line (m from its last point), None if there
        is none."""
        size = np.where(valid[:, None], np.abs(grey[:, 3:] - grey[:, :-3]), np.float32(0.0))
        best, place = _peaks(size, self._s[0] + 1.5 * STEP)
        shows = (best > least) & valid
        if (
            int((shows & self._inner).sum()) < COLUMNS_NEEDED
            or int((shows & ~self._inner).sum()) < COLUMNS_NEEDED
        ):
            return None
        line, off = _straight(self._aside[shows], place[shows])
        fits = off < SURE and abs(line[1]) < ASKEW and AT_LEAST < line[0] < AT_MOST
        return line[0] if fits else None


def _peaks(size: Grey, first: float) -> tuple[Grey, Vector]:
    """Return each row's greatest value and its position (m), to a fraction of a step; column 0 lies
    at `first` (m)."""
    row = np.arange(size.shape[0])
    best = np.clip(size.argmax(axis=1), 1, size.shape[1] - 2)
    before, at, after = size[row, best - 1], size[row, best], size[row, best + 1]
    shift = 0.5 * (before - after) / np.minimum(before - 2.0 * at + after, -1e-6)
    return at, first + (best + np.clip(shift, -1.0, 1.0)) * STEP


def _straight(aside: Vector, place: Vector) -> tuple[list[float], float]:
    """Return the line through all points except the worst one (value at 0, slope), and the distance
    of the rest from it (m, rms)."""
    line = polynomial(aside, place, 1)
    off = np.abs(place - line[0] - line[1] * aside)
    keep = np.arange(place.size) != int(off.argmax())
    line = polynomial(aside[keep], place[keep], 1)
    off = place[keep] - line[0] - line[1] * aside[keep]
    return line, math.sqrt(float(off @ off) / off.size)


def _last(sight: Sight) -> tuple[float, float, float]:
    """Return the line's last point and its direction there (m, rad)."""
    x, y = sight.x, sight.y
    near = x >= x[-1] - 0.25
    px, py = x[near] - x[-1], y[near]
    if px.size < 3:
        px, py = x - x[-1], y
    degree = 2 if px.size >= 6 else 1
    coefficients = polynomial(px, py, degree)
    return float(x[-1]), float(coefficients[0]), math.atan(float(coefficients[1]))


# --- From image to image -------------------------------------------------------------------------

FOLLOW_FAR, FIND_FAR = 1.2, 1.5
"""How far ahead scan rows lie while the line is followed, and while it is searched (m)."""
NEAR = 0.6
"""How far ahead a line may begin for the rows of following to suffice (m)."""
FORGET = 3
"""Images without a sight after which the line may begin anywhere again."""
VOTES, NEEDED = 6, 3
"""Ends of the latest images that are counted, and how many must agree and outnumber the rest."""


class FloorWatch(Struct, frozen=True):
    """What all watchers of one camera share: its geometry and scan rows."""

    view: FloorView
    ends: EndFinder
    near: ScanGrid
    """Rows for following."""
    wide: ScanGrid
    """Rows for finding."""
    width: float
    """Width of the track (m)."""

    @staticmethod
    def of(rover: RoverModel) -> FloorWatch:
        """Compute geometry and rows from the numbers of a rover."""
        view = FloorView(rover.camera)
        near, wide = ScanGrid.of(view, FOLLOW_FAR), ScanGrid.of(view, FIND_FAR)
        return FloorWatch(view, EndFinder(view, rover.track), near, wide, rover.track.width)


class LineWatcher:
    """One run's memory of the line."""

    def __init__(self, floor: FloorWatch, detector: TrackDetector, *, find: bool = False) -> None:
        self._floor = floor
        self._detect = detector
        self._find = find
        self._expected: Parabola | None = None
        self._votes: deque[TrackEnd] = deque(maxlen=VOTES)
        self.images = 0
        self.seen = 0
        """Images in which the line was seen."""
        self.unseen = 0
        """Images in a row without it."""

    @property
    def share(self) -> float:
        """Share of the images that showed the line."""
        return self.seen / self.images if self.images else 0.0

    @property
    def end(self) -> TrackEnd:
        """The end on which the latest images agree."""
        for kind in (TrackEnd.T, TrackEnd.INTERRUPTION):
            count = sum(vote is kind for vote in self._votes)
            if count >= NEEDED and 2 * count > len(self._votes):
                return kind
        return TrackEnd.NONE

    def look(self, image: NDArray[np.uint8]) -> Sight:
        """Return what the image shows; its `end` is set only once it is believed."""
        self.images += 1
        grid = self._floor.near if self._is_near and not self._find else self._floor.wide
        sight = self._detect(grid, grid.sample(image), self._floor.width, self._expected)
        if not sight.seen:
            self.unseen += 1
            if self.unseen >= FORGET:
                self._expected = None
            return UNSEEN
        self.seen, self.unseen = self.seen + 1, 0
        self._expected = sight.line()
        return replace(sight, end=self._believed(image, sight))

    @property
    def _is_near(self) -> bool:
        """Whether the line begins where the image does: then rows far ahead do not matter yet."""
        return self._expected is not None and self._expected.near < NEAR

    def _believed(self, image: NDArray[np.uint8], sight: Sight) -> LineEnd | None:
        end = self._floor.ends.judge(image, sight)
        if end is not None:
            self._votes.append(end.kind)
        elif not sight.broke_off and self._votes:
            self._votes.popleft()  # A line that continues contradicts an end.
        return end if end is not None and end.kind is self.end else None
