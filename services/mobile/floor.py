"""The floor as the camera sees it: which pixel shows which spot, and samples of an image along
lines of the floor.

Body frame: origin on the floor below the middle of the axle, x forward, y to the left (m). The
camera looks along x and is only pitched. So an image row shows the floor at one distance x, and
along a row y is linear in the column: no image has to be warped to see the floor from above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from petrobot.services.mobile.model import CameraModel

Vector = NDArray[np.float64]
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


@dataclass(frozen=True)
class ScanGrid:
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
    def of(
        view: FloorView,
        far: float,
        spacing: float = 0.03,
        step: float = 0.00625,
        reach: float = 0.6,
    ) -> ScanGrid:
        """Choose image rows about `spacing` apart on the floor up to `far`, sampled every `step` to
        `reach` on both sides (m)."""
        distances = view.distances()
        rows, last = [], -math.inf
        for row in range(view.height - 1, -1, -1):
            if distances[row] > far:
                break
            if distances[row] - last >= spacing - 0.5 * _growth(distances, row):
                rows.append(row)
                last = distances[row]
        x = distances[rows]
        count = round(reach / step)
        y = np.arange(-count, count + 1, dtype=np.float64) * np.float64(step)
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
