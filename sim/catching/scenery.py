"""The static scene in front of the simulated camera: floor, table with its lines and marks, and the
calibration board.

Surfaces are planes with a grey level under even light; sim/catching/camera.py adds light, lens and
noise. Lengths in m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLOOR_GREY = 48.0
FLOOR_JOINT_GREY = 34.0
TABLE_GREY = 74.0
EDGE_GREY = 168.0
LINE_GREY = 150.0
MARK_GREY = 118.0
SIDE_LINE = 0.020
"""Width of the white lines along a table's edges (ITTF law 2.1.5: 20 mm)."""
CENTRE_LINE = 0.003
"""Width of the centre line (ITTF law 2.1.6: 3 mm)."""
TILE = 0.40
JOINT = 0.008
MARK_RADIUS = 0.018
STRIPE = 8
"""Rows of an image that are computed at a time."""
MARKS = ((0.25, 0.22), (0.25, -0.30), (0.80, 0.36), (0.80, -0.20), (1.30, 0.28), (1.30, -0.36))
"""Round stickers on the table, as large as a ball: (m from the near edge, y); they deceive a
detector that looks for circles."""


@dataclass(frozen=True, slots=True)
class TableArea:
    """The table of the cell: height of its top, x of the near edge, length along x, width along y
    (m)."""

    top: float
    near_edge: float
    length: float
    width: float

    @classmethod
    def of(
        cls, cell: Mapping[str, Any], top: float | None = None, near_edge: float | None = None
    ) -> TableArea:
        """Read the cell's `[table]`; `top` and `near_edge` (m) replace the nominal ones."""
        table = cell["table"]
        return cls(
            float(table["top"] if top is None else top),
            float(table["near_edge"] if near_edge is None else near_edge),
            float(table["length"]),
            float(table["width"]),
        )

    def contains(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Return which points of the table's plane lie on the table."""
        inside: NDArray[np.bool_] = (
            (x >= self.near_edge)
            & (x <= self.near_edge + self.length)
            & (np.abs(y) <= self.width / 2)
        )
        return inside

    def grey(self, x: Array, y: Array) -> Array:
        """Return the grey level of the table top under even light at points (m, base frame)."""
        along = x - self.near_edge
        grain = 3.0 * np.sin(23.0 * along + 2.0 * np.sin(3.0 * y)) * np.sin(140.0 * y)
        grey = TABLE_GREY + grain
        for mark_x, mark_y in MARKS:
            grey = np.where(np.hypot(along - mark_x, y - mark_y) < MARK_RADIUS, MARK_GREY, grey)
        grey = np.where(np.abs(y) < CENTRE_LINE / 2, LINE_GREY, grey)
        border = np.minimum.reduce([along, self.length - along, self.width / 2 - np.abs(y)])
        return np.where(border < SIDE_LINE, EDGE_GREY, grey)


def floor_grey(x: Array, y: Array) -> Array:
    """Return the grey level of the tiled floor at points (m, base frame)."""
    joint = (np.mod(x, TILE) < JOINT) | (np.mod(y, TILE) < JOINT)
    tiles = FLOOR_GREY + 5.0 * np.mod(np.floor(x / TILE) + 2.0 * np.floor(y / TILE), 3.0)
    return np.where(joint, FLOOR_JOINT_GREY, tiles)


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A calibration board: `columns` x `rows` inner corners, `square` m wide, with a white margin
    of one square.

    The board frame has its origin at the first inner corner, x along the columns, y along the rows,
    z out of the board. The square between the first corner and the board's nearest outer corner is
    black.
    """

    columns: int = 9
    rows: int = 6
    square: float = 0.060

    def grey(self, points: Array) -> Array:
        """Return the grey level at points (..., 3) of the board's plane, board frame."""
        i, j = np.floor(points[..., 0] / self.square), np.floor(points[..., 1] / self.square)
        printed = (i >= -1) & (i < self.columns) & (j >= -1) & (j < self.rows)
        return np.where(printed & (np.mod(i + j, 2.0) == 0), 25.0, 205.0)

    def covers(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (..., 3) of the board's plane lie on the board."""
        i, j = np.floor(points[..., 0] / self.square), np.floor(points[..., 1] / self.square)
        covered: NDArray[np.bool_] = (i >= -2) & (i <= self.columns) & (j >= -2) & (j <= self.rows)
        return covered

    def outline(self) -> Array:
        """Return the board's four outer corners (4, 3), board frame."""
        near, right, far = (
            -2 * self.square,
            (self.columns + 1) * self.square,
            (self.rows + 1) * self.square,
        )
        return np.array(
            [[near, near, 0.0], [right, near, 0.0], [right, far, 0.0], [near, far, 0.0]]
        )


def stripes(rows: int) -> Iterator[slice]:
    """Return an image's rows, a few at a time: the data of so many pixels fits into a core's
    cache."""
    return (slice(first, first + STRIPE) for first in range(0, rows, STRIPE))


def supersampled(
    pixels: NDArray[np.float64], grey_at: Callable[[NDArray[np.float64]], Array], samples: int
) -> Array:
    """Return the mean grey level of each pixel from `samples` x `samples` points inside it;
    `pixels` (..., 2), result (...)."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    offsets = [np.array([du, dv]) for dv in steps for du in steps]
    mean: Array = np.empty(pixels.shape[:-1])
    for rows in stripes(len(pixels)):
        mean[rows] = np.mean([grey_at(pixels[rows] + offset) for offset in offsets], axis=0)
    return mean
