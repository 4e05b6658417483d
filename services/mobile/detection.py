"""Finding the track in an image, in four ways of different cost and reliability.

All look at scan rows of the floor (see `ScanGrid`) and return the centre line as points of the body
frame. `expected` is the line of the image before, if there was one: then only what continues it
counts.

First come candidates: spots in scan rows that look like the track. They ignore polarity, since the
track's colour changes from square to square. A candidate is a pair of opposite edges a track's
width apart, or a ridge, bright or dark, of that width. A single edge, of a square or a shadow, is
neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.mobile.model import CameraModel
from petrobot.services.mobile.sight import UNSEEN, Parabola, Sight, Vector, polynomial

# --- the floor in the image ---
# The floor as the camera sees it: which pixel shows which spot, and samples of an image along
# lines of the floor.
#
# Body frame: origin on the floor below the middle of the axle, x forward, y to the left (m). The
# camera looks along x and is only pitched. So an image row shows the floor at one distance x, and
# along a row y is linear in the column: no image has to be warped to see the floor from above.

Grey = NDArray[np.float32]


class FloorView:
    """Projection between floor and image of a pinhole camera without roll and yaw."""

    def __init__(self, camera: CameraModel) -> None:
        self.width = round(camera.width)
        self.height = round(camera.height_px)
        self._forward, self._above = camera.forward, camera.height
        self._cos, self._sin = math.cos(camera.pitch), math.sin(camera.pitch)
        self._focal = camera.focal_px
        self._cx, self._cy = camera.principal_px

    def pixels(self, x: Vector, y: Vector) -> tuple[Vector, Vector]:
        """Return columns and rows (px) of floor points (m) ahead of the camera."""
        ahead = np.asarray(x) - self._forward
        depth = ahead * self._cos + self._above * self._sin
        u = self._cx - self._focal * np.asarray(y) / depth
        v = self._cy + self._focal * (self._above * self._cos - ahead * self._sin) / depth
        return u, v

    def points(self, u: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return the floor points (m) of pixels below the horizon."""
        t = (np.asarray(v) - self._cy) / self._focal
        ahead = self._above * (self._cos - t * self._sin) / (t * self._cos + self._sin)
        depth = ahead * self._cos + self._above * self._sin
        return ahead + self._forward, -(np.asarray(u) - self._cx) * depth / self._focal

    def distances(self) -> Vector:
        """Return how far ahead (m) each image row shows the floor; inf at and above the horizon."""
        rows = np.arange(self.height, dtype=float)
        t = (rows - self._cy) / self._focal
        under = t * self._cos + self._sin > 1e-3
        x, _ = self.points(np.zeros(self.height), np.where(under, rows, self._cy))
        return np.where(under, x, np.inf)

    def sample(self, image: NDArray[np.uint8], x: Vector, y: Vector) -> Grey:
        """Return grey levels at floor points, bilinear, in the shape of x and y; NaN outside the
        image."""
        u, v = self.pixels(x, y)
        inside = (u >= 0.0) & (u <= self.width - 1.001) & (v >= 0.0) & (v <= self.height - 1.001)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        column, row = u.astype(np.intp), v.astype(np.intp)
        at, flat = row * self.width + column, image.ravel()
        du, dv = u - column, v - row
        upper = flat.take(at) * (1.0 - du) + flat.take(at + 1) * du
        lower = flat.take(at + self.width) * (1.0 - du) + flat.take(at + self.width + 1) * du
        return np.where(inside, upper * (1.0 - dv) + lower * dv, np.nan).astype(np.float32)


class ScanGrid(Struct, frozen=True):
    """Where scan rows are sampled: distances `x` (rows,) and lateral positions `y` (columns,) in m,
    ascending."""

    x: Vector
    y: Vector
    seen: NDArray[np.bool_]
    """(rows, columns): whether the image shows the spot."""
    _at: NDArray[np.intp]
    _part: Grey
    rows: tuple[float, ...]
    """`x` as plain numbers."""

    @staticmethod
    def of(view: FloorView, far: float) -> ScanGrid:
        """Choose image rows 3 cm apart on the floor up to `far`, sampled every 6.25 mm to
        60 cm on both sides (m)."""
        distances = view.distances()
        rows, last = [], -math.inf
        for row in range(view.height - 1, -1, -1):
            if distances[row] > far:
                break
            if distances[row] - last >= 0.03 - 0.5 * _growth(distances, row):
                rows.append(row)
                last = distances[row]
        x = distances[rows]
        y = np.arange(-96, 97, dtype=np.float64) * np.float64(0.00625)
        u, _ = view.pixels(x[:, None], y[None, :])
        seen = (u >= 0.0) & (u <= view.width - 1.001)
        u = np.clip(u, 0.0, view.width - 1.001)
        column = u.astype(np.intp)
        at = np.asarray(rows, dtype=np.intp)[:, None] * view.width + column
        return ScanGrid(x, y, seen, at, (u - column).astype(np.float32), tuple(x.tolist()))

    @property
    def step(self) -> float:
        """Distance between samples of a row (m)."""
        return float(self.y[1] - self.y[0])

    def sample(self, image: NDArray[np.uint8]) -> Grey:
        """Return grey levels (rows, columns); the image's edge is repeated where the image does not
        show the spot."""
        flat = image.ravel()
        left = flat.take(self._at).astype(np.float32)
        right = flat.take(self._at + 1).astype(np.float32)
        return left + (right - left) * self._part


def _growth(distances: Vector, row: int) -> float:
    """Return how much farther the next row up looks (m)."""
    return float(distances[row - 1] - distances[row]) if row else 0.0


# --- the track on it ---

# --- Candidates in one scan row ------------------------------------------------------------------

LEAST_CONTRAST = 14.0
"""Grey levels that noise alone does not reach."""
CONTRAST_SHARE = 0.22
"""Share of an image's range of grey that an edge must have."""
NARROWEST, WIDEST = 0.6, 2.1
"""Least and greatest distance between the edges of a pair, in track widths: a track crossed at an
angle is wider."""


class Candidates(Struct, frozen=True):
    """Spots by row: `row` ascending, `y` (m), `strength` (grey levels), all (n,)."""

    row: NDArray[np.intp]
    y: Vector
    strength: Vector


def contrast_threshold(samples: Grey) -> float:
    """Return the grey levels from which a difference counts in this image."""
    some = samples[::3, ::5]
    return max(LEAST_CONTRAST, CONTRAST_SHARE * float(some.max() - some.min()))


def edge_pairs(grid: ScanGrid, samples: Grey, width: float) -> Candidates:
    """Return the middles of pairs of opposite edges about `width` (m) apart."""
    gradient = (
        samples[:, 4:] - samples[:, :-4]
    )  # The rise over 25 mm (4 samples): edges are blurred by optics and motion.
    size = np.abs(gradient)
    size[~(grid.seen[:, 4:] & grid.seen[:, :-4])] = 0.0
    middle = size[:, 1:-1]
    peak = (
        (middle > contrast_threshold(samples)) & (middle >= size[:, :-2]) & (middle > size[:, 2:])
    )
    row, column = np.nonzero(peak)
    if row.size < 2:
        return Candidates(row[:0], np.empty(0), np.empty(0))
    before, at, after = size[row, column], size[row, column + 1], size[row, column + 2]
    # The vertex of the parabola through three samples gives the edge to a fraction of a step.
    shift = 0.5 * (before - after) / np.minimum(before - 2.0 * at + after, -1e-6)
    place = grid.y[column + 3] + shift * grid.step
    sign = gradient[row, column + 1] > 0.0
    pairs = [_paired(row, place, sign, at, gap, width) for gap in (1, 2)]
    rows = np.concatenate([p[0] for p in pairs])
    order = np.argsort(rows, kind="stable")
    y, strength = (np.concatenate([p[i] for p in pairs])[order] for i in (1, 2))
    return Candidates(rows[order], y, strength)


def _paired(
    row: NDArray[np.intp],
    place: Vector,
    sign: NDArray[np.bool_],
    size: Grey,
    gap: int,
    width: float,
) -> tuple[NDArray[np.intp], Vector, Vector]:
    """Return the edges that are `gap` apart in the list and may be the two sides of a track."""
    apart = place[gap:] - place[:-gap]
    fits = (row[gap:] == row[:-gap]) & (sign[gap:] != sign[:-gap])
    fits &= (apart > NARROWEST * width) & (apart < WIDEST * width)
    index = np.nonzero(fits)[0]
    strength = np.minimum(size[index], size[index + gap]).astype(float)
    return row[index], 0.5 * (place[index] + place[index + gap]), strength


def ridge_strength(grid: ScanGrid, samples: Grey, width: float) -> Grey:
    """Return by how much (grey levels) each spot differs from both its sides: the lesser of the two
    differences, 0 where their signs are opposite.

    This is the absolute second difference of a row, made blind to steps: at a step one of the two
    differences vanishes.
    """
    side = round(width / grid.step)
    core = max(1, round(0.3 * width / grid.step))
    sums = np.cumsum(np.pad(samples, ((0, 0), (core + 1, core)), mode="edge"), axis=1)
    mean = (sums[:, 2 * core + 1 :] - sums[:, : -2 * core - 1]) * np.float32(1.0 / (2 * core + 1))
    left = mean[:, side:-side] - mean[:, : -2 * side]
    right = mean[:, side:-side] - mean[:, 2 * side :]
    strength = np.zeros_like(samples)
    lesser = np.minimum(np.abs(left), np.abs(right))
    strength[:, side:-side] = np.where(left * right > 0.0, lesser, np.float32(0.0))
    strength[~grid.seen] = 0.0
    return strength


def ridges(grid: ScanGrid, samples: Grey, width: float) -> Candidates:
    """Return the middles of ridges of about `width` (m): peaks of `ridge_strength`, each at its
    centre of gravity."""
    strength = ridge_strength(grid, samples, width)
    reach = max(1, round(0.5 * width / grid.step))
    middle = strength[:, reach:-reach]
    peak = middle > contrast_threshold(samples)
    for shift in range(1, reach + 1):
        end = strength.shape[1] - reach
        peak &= (middle >= strength[:, reach - shift : end - shift]) & (
            middle > strength[:, reach + shift :][:, : middle.shape[1]]
        )
    row, column = np.nonzero(peak)
    around = strength[row[:, None], column[:, None] + np.arange(2 * reach + 1)[None, :]]
    offsets = (np.arange(2 * reach + 1) - reach) * grid.step
    y = grid.y[column + reach] + (around @ offsets) / np.maximum(around.sum(axis=1), 1e-6)
    return Candidates(row, y.astype(float), strength[row, column + reach].astype(float))


# --- From candidates to the line -----------------------------------------------------------------

GATE = 0.07
"""Greatest distance of the line from the expected one (m)."""
STEP_GATE = 0.016
"""m that a point may be off the line through the points before it, plus `STEP_SLOPE` m per metre of
distance."""
STEP_SLOPE = 0.55
GAP = 0.13
"""m without a sight after which a line counts as broken off; square edges and glare hide less."""
STEEPEST = 1.6
"""Slope against straight ahead beyond which rows cut the line too obliquely."""
FIRST_SLOPE = 0.9
"""Steepest slope with which a line that was not expected may begin."""
SURELY = 0.45
"""Length of line from an expected beginning after which no other is tried (m)."""
SHORTEST = 0.16
"""Least length of a line (m)."""


class TrackDetector(Protocol):
    """Finds the line in samples of an image (rows, columns) of a grid."""

    def __call__(
        self, grid: ScanGrid, samples: Grey, width: float, expected: Parabola | None
    ) -> Sight:
        """Return the line; `UNSEEN` if there is none."""


def detect_edges(grid: ScanGrid, samples: Grey, width: float, expected: Parabola | None) -> Sight:
    """Chain pairs of opposite edges from near to far: the cheapest way, and the most accurate on
    clean paint."""
    return chain(grid, edge_pairs(grid, samples, width), expected)


def detect_ridge(grid: ScanGrid, samples: Grey, width: float, expected: Parabola | None) -> Sight:
    """Chain ridges of the absolute second difference from near to far: averages noise over the
    track's width."""
    return chain(grid, ridges(grid, samples, width), expected)


class _Chain:
    """A line that grows from near to far, point by point."""

    __slots__ = ("slope", "strength", "x", "y")

    def __init__(self, x: float, y: float, slope: float) -> None:
        self.x, self.y, self.slope, self.strength = [x], [y], slope, 0.0

    def ahead(self, x: float) -> float:
        """Return where the line should be at a distance x (m)."""
        return self.y[-1] + self.slope * (x - self.x[-1])

    def add(self, x: float, y: float) -> None:
        """Append a point; the slope follows the points of the last tenth of a metre."""
        self.x.append(x)
        self.y.append(y)
        back = len(self.x) - 1
        while back > 0 and x - self.x[back] < 0.10:
            back -= 1
        fresh = (y - self.y[back]) / (x - self.x[back])
        self.slope = fresh if back or len(self.x) > 4 else 0.5 * (self.slope + fresh)

    @property
    def length(self) -> float:
        """Length along x (m)."""
        return self.x[-1] - self.x[0]


def chain(grid: ScanGrid, candidates: Candidates, expected: Parabola | None) -> Sight:
    """Return the best line through candidates: in each row the candidate nearest to where the line
    should be, starting from the nearest rows."""
    rows = _by_row(grid, candidates)
    begun = _seeds(grid, rows, expected)
    best: _Chain | None = None
    for seed, first in begun:
        _grow(seed, first, grid.rows, rows)
        if expected is not None and seed.length > SURELY:
            return _sight(grid, seed)
        if seed.length >= SHORTEST and (best is None or _worth(seed) > _worth(best)):
            best = seed
    return _sight(grid, best) if best is not None else UNSEEN


def _by_row(grid: ScanGrid, candidates: Candidates) -> list[list[float]]:
    rows: list[list[float]] = [[] for _ in range(grid.x.size)]
    for row, y in zip(candidates.row.tolist(), candidates.y.tolist(), strict=True):
        rows[row].append(y)
    return rows


def _seeds(
    grid: ScanGrid, rows: list[list[float]], expected: Parabola | None
) -> list[tuple[_Chain, int]]:
    """Return beginnings of lines, each with the row after which it continues."""
    seeds: list[tuple[_Chain, int]] = []
    x = grid.rows
    if expected is not None:
        for i, places in enumerate(rows):
            if x[i] > expected.near + 0.45 or len(seeds) == 3:
                break
            wanted = expected.at(x[i])
            near = [y for y in places if abs(y - wanted) < GATE]
            if near:
                y = min(near, key=lambda y: abs(y - wanted))
                slope = expected.slope + expected.bend * (x[i] - expected.near)
                seeds.append((_Chain(x[i], y, slope), i + 1))
        return seeds
    for i, places in enumerate(rows):
        if len(seeds) >= 14:
            break
        for y in places:
            if not any(abs(y - s.ahead(x[i])) < 0.06 for s, _ in seeds):
                seeds += _pairs_on(x, rows, i, y)
    return seeds


def _pairs_on(
    x: tuple[float, ...], rows: list[list[float]], i: int, y: float
) -> list[tuple[_Chain, int]]:
    """Return lines from a spot to each spot of the next rows that is not too far to the side."""
    for j in range(i + 1, min(i + 4, len(x))):
        slopes = [(other - y) / (x[j] - x[i]) for other in rows[j]]
        fit = sorted((s for s in slopes if abs(s) < FIRST_SLOPE), key=abs)[:2]
        if fit:
            return [(_Chain(x[i], y, slope), i + 1) for slope in fit]
    return []


def _grow(line: _Chain, first: int, x: tuple[float, ...], rows: list[list[float]]) -> None:
    for i in range(first, len(x)):
        onwards = x[i] - line.x[-1]
        if onwards > GAP or abs(line.slope) > STEEPEST:
            return
        wanted = line.ahead(x[i])
        places = rows[i]
        if places:
            y = min(places, key=lambda place: abs(place - wanted))
            if abs(y - wanted) <= STEP_GATE + STEP_SLOPE * onwards:
                line.add(x[i], y)


def _worth(line: _Chain) -> float:
    """Prefer long lines, then near ones, then those straight ahead."""
    return len(line.x) - 12.0 * line.x[0] - 8.0 * abs(line.y[0])


def _sight(grid: ScanGrid, line: _Chain) -> Sight:
    x, y = np.asarray(line.x), np.asarray(line.y)
    span = (grid.x >= x[0]) & (grid.x <= x[-1])
    confidence = x.size / max(1, int(span.sum()))
    return Sight(x, y, confidence, broke_off=_broke_off(grid, line))


def _broke_off(grid: ScanGrid, line: _Chain) -> bool:
    """Return whether the rows beyond the last point should show the line and do not."""
    if abs(line.slope) > STEEPEST * 0.75:
        return False
    end = line.x[-1] + GAP
    if end > grid.x[-1]:
        return False
    aside = line.ahead(end)
    row = int(np.searchsorted(grid.x, end))
    column = int(np.searchsorted(grid.y, aside + np.sign(aside) * 0.05))
    return 0 < column < grid.y.size and bool(grid.seen[min(row, grid.x.size - 1), column])


# --- Whole-line fits ------------------------------------------------------------------------------

WINDOW = 0.55
"""Length of line to which a parabola is fitted as a whole (m)."""
INLIER = 0.018
"""Distance from the parabola within which a candidate belongs to it (m)."""
DRAWS = 60
"""Triples of points that are tried."""


def consensus(random: Callable[[], np.random.Generator]) -> TrackDetector:
    """Return a detector that fits a parabola to edge pairs by random sample consensus (RANSAC,
    Fischler and Bolles 1981).

    It finds the line among many false pairs, where a chain may follow a wrong one; `random` returns
    the generator to draw from.
    """

    def detect(grid: ScanGrid, samples: Grey, width: float, expected: Parabola | None) -> Sight:
        found = edge_pairs(grid, samples, width)
        keep = _plausible(grid, found, expected)
        x, y = grid.x[found.row[keep]], found.y[keep]
        if np.unique(x).size < 5:
            return UNSEEN
        picks = random().integers(0, x.size, (DRAWS, 3))
        curves = _through(x, y, picks)
        if curves.size == 0:
            return UNSEEN
        off = np.abs(curves[:, :1] + curves[:, 1:2] * x + curves[:, 2:] * x * x - y)
        best = curves[int((off < INLIER).sum(axis=1).argmax())]
        return chain_about(grid, found, best)

    return detect


def _plausible(grid: ScanGrid, found: Candidates, expected: Parabola | None) -> NDArray[np.bool_]:
    """Return which candidates lie within the window, and near the expected line if there is one."""
    x = grid.x[found.row]
    keep: NDArray[np.bool_] = x <= (x.min() + WINDOW if x.size else 0.0)
    if expected is not None:
        d = x - expected.near
        keep &= (
            np.abs(expected.offset + expected.slope * d + 0.5 * expected.bend * d * d - found.y)
            < 1.5 * GATE + 0.3 * d
        )
    return keep


def _through(x: Vector, y: Vector, picks: NDArray[np.int64]) -> Vector:
    """Return parabolas [c0, c1, c2] through triples of points that are apart, not too steep and not
    too bent (k, 3)."""
    px, py = x[picks], y[picks]
    apart = np.minimum(
        np.minimum(np.abs(px[:, 0] - px[:, 1]), np.abs(px[:, 1] - px[:, 2])),
        np.abs(px[:, 0] - px[:, 2]),
    )
    ok = apart > 0.05
    px, py = px[ok], py[ok]
    if px.size == 0:
        return np.empty((0, 3))
    curves = np.linalg.solve(np.stack([np.ones_like(px), px, px * px], axis=2), py[:, :, None])[
        :, :, 0
    ]
    slope = curves[:, 1] + 2.0 * curves[:, 2] * px.min(axis=1)
    kept: Vector = curves[(np.abs(slope) < STEEPEST) & (np.abs(curves[:, 2]) < 2.5)]
    return kept


def chain_about(grid: ScanGrid, found: Candidates, curve: Vector) -> Sight:
    """Return the line that continues from a parabola's inliers: they seed a chain, so that the line
    is followed beyond the window."""
    x = grid.x[found.row]
    inlier = np.abs(curve[0] + curve[1] * x + curve[2] * x * x - found.y) < INLIER
    if int(inlier.sum()) < 5:
        return UNSEEN
    near = float(x[inlier].min())
    slope, bend = float(curve[1] + 2.0 * curve[2] * near), float(2.0 * curve[2])
    line = Parabola(
        near, near + WINDOW, float(curve[0] + curve[1] * near + curve[2] * near * near), slope, bend
    )
    return chain(grid, found, line)


OFFSETS = np.arange(-0.36, 0.361, 0.02)
SLOPES = np.arange(-0.75, 0.751, 0.15)
BENDS = np.array([-1.6, -0.8, 0.0, 0.8, 1.6])


class TemplateBank:
    """A detector that tries whole lines: parabolas on a lattice of offset, slope and bend, scored
    by ridge strength.

    Every row votes, so noise and dim light matter least; it costs most. Bends between those of the
    lattice are refined by a weighted fit around the best parabola.
    """

    def __init__(self) -> None:
        self._grid: ScanGrid | None = None

    def __call__(
        self, grid: ScanGrid, samples: Grey, width: float, expected: Parabola | None
    ) -> Sight:
        """Return the line; `UNSEEN` if there is none."""
        if self._grid is not grid:
            self._lay_out(grid)
        strength = ridge_strength(grid, samples, width)
        votes = np.minimum(strength[: self._rows], np.float32(contrast_threshold(samples)))
        score = votes.ravel().take(self._at).sum(axis=1)
        if expected is not None:
            score = np.where(
                np.abs(self._start - expected.at(float(grid.x[0]))) < GATE + 0.02, score, 0.0
            )
        best = int(score.argmax())
        if score[best] < 0.5 * self._rows * contrast_threshold(samples):
            return UNSEEN
        return self._refined(grid, strength, best)

    def _lay_out(self, grid: ScanGrid) -> None:
        """Compute the column of each parabola in each row, for this grid."""
        self._grid, self._rows = grid, int(np.searchsorted(grid.x, grid.x[0] + WINDOW))
        d = grid.x[: self._rows] - grid.x[0]
        offset, slope, bend = (
            a.ravel() for a in np.meshgrid(OFFSETS, SLOPES, BENDS, indexing="ij")
        )
        y = offset[:, None] + slope[:, None] * d + 0.5 * bend[:, None] * d * d
        inside = np.abs(y).max(axis=1) < grid.y[-1]
        y, self._start = y[inside], offset[inside]
        column = np.rint((y - grid.y[0]) / grid.step).astype(np.intp)
        self._lines = y
        self._at = np.arange(self._rows, dtype=np.intp)[None, :] * grid.y.size + column

    def _refined(self, grid: ScanGrid, strength: Grey, best: int) -> Sight:
        """Return centres of gravity around the best parabola, smoothed by a weighted fit, and the
        line beyond it."""
        rows = np.arange(self._rows)
        half = round(0.04 / grid.step)
        columns = np.rint((self._lines[best] - grid.y[0]) / grid.step).astype(np.intp)
        columns = np.clip(
            columns[:, None] + np.arange(-half, half + 1)[None, :], 0, grid.y.size - 1
        )
        weight = strength[rows[:, None], columns].astype(float)
        mass = weight.sum(axis=1)
        heavy = mass > 0.25 * mass.max()
        if int(heavy.sum()) < 5:
            return UNSEEN
        y = (weight * grid.y[columns]).sum(axis=1)[heavy] / mass[heavy]
        x = grid.x[: self._rows][heavy]
        c = polynomial(x - x[0], y, 2, mass[heavy])
        found = Candidates(rows[heavy], y, mass[heavy])
        line = Parabola(float(x[0]), float(x[-1]), c[0], c[1], 2.0 * c[2])
        beyond = _beyond(grid, strength, self._rows)
        return chain(grid, _joined(found, beyond), line)


def _beyond(grid: ScanGrid, strength: Grey, first: int) -> Candidates:
    """Return the strongest spot of each row from `first` on."""
    rest = strength[first:]
    column = rest.argmax(axis=1)
    value = rest[np.arange(rest.shape[0]), column].astype(float)
    ok = value > LEAST_RIDGE
    return Candidates(np.nonzero(ok)[0] + first, grid.y[column[ok]], value[ok])


LEAST_RIDGE = 20.0
"""Grey levels that a ridge must have beyond the window of the template."""


def _joined(a: Candidates, b: Candidates) -> Candidates:
    return Candidates(
        np.concatenate([a.row, b.row]),
        np.concatenate([a.y, b.y]),
        np.concatenate([a.strength, b.strength]),
    )
