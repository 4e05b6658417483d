"""Places in scan rows that look like the track: polarity-free, since its colour changes from square
to square.

Two ways: pairs of opposite edges a track's width apart, and ridges, bright or dark, of that width.
A single edge (of a square, of a shadow) is neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from petrobot.services.mobile.floor import ScanGrid

Vector = NDArray[np.float64]
Grey = NDArray[np.float32]

LEAST_CONTRAST = 14.0
"""Grey levels: what noise alone does not reach."""
CONTRAST_SHARE = 0.22
"""Share of an image's range of grey that an edge must have."""
NARROWEST, WIDEST = 0.6, 2.1
"""Track widths between the edges of a pair: a track crossed at an angle is wider."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """Places by row: `row` ascending, `y` (m), `strength` (grey levels), all (n,)."""

    row: NDArray[np.intp]
    y: Vector
    strength: Vector


def contrast_threshold(samples: Grey) -> float:
    """Grey levels from which a difference counts, for this image."""
    some = samples[::3, ::5]
    return max(LEAST_CONTRAST, CONTRAST_SHARE * float(some.max() - some.min()))


def edge_pairs(grid: ScanGrid, samples: Grey, width: float) -> Candidates:
    """Middles of pairs of opposite edges about `width` (m) apart."""
    gradient = (
        samples[:, 4:] - samples[:, :-4]
    )  # the rise over 25 mm: edges are blurred by optics and motion
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
    """Edges that are `gap` apart in the list and may be the two sides of a track."""
    apart = place[gap:] - place[:-gap]
    fits = (row[gap:] == row[:-gap]) & (sign[gap:] != sign[:-gap])
    fits &= (apart > NARROWEST * width) & (apart < WIDEST * width)
    index = np.nonzero(fits)[0]
    strength = np.minimum(size[index], size[index + gap]).astype(float)
    return row[index], 0.5 * (place[index] + place[index + gap]), strength


def ridge_strength(grid: ScanGrid, samples: Grey, width: float) -> Grey:
    """How far (grey levels) each spot differs from both its sides, the lesser of the two; 0 where
    they differ oppositely.

    The absolute second difference of a row, made blind to steps: at a step one of the two
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
    """Middles of ridges of about `width` (m): peaks of `ridge_strength`, each at its centre of
    gravity."""
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
