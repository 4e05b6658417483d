"""The camera as its calibration describes it: base-frame points to pixels, and pixels back to a
plane above the table, exactly.

Pinhole with Brown's distortion in OpenCV's order k1 k2 p1 p2 (D. C. Brown, "Decentering distortion
of lenses", 1966). Lengths in m, base frame; pixels are (u, v), u to the right, whole numbers at
pixel centres.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Number = TypeVar("Number", float, Array)

NEWTON_STEPS = 4
"""Steps of Newton's method on the distortion: 4 leave less than 1e-9 px inside the image
(tests/vision/test_optics.py)."""


class Optics(Struct, frozen=True):
    """A calibrated camera.

    `focal` and `centre` (px), `distortion` k1 k2 p1 p2, and its pose: a base-frame point p has
    camera coordinates `rotation @ (p - position)`.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float]
    rotation: Array
    position: Array

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (..., 2) of points (..., 3) in front of the camera."""
        at = np.asarray(points, float)
        if at.ndim == 1:
            return np.array(self._pixel(*at.tolist()))
        seen = (at - self.position) @ self.rotation.T
        x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
        bent_x, bent_y, *_ = self._bend(x, y)
        return np.stack(
            [self.focal[0] * bent_x + self.centre[0], self.focal[1] * bent_y + self.centre[1]],
            axis=-1,
        )

    def _pixel(self, px: float, py: float, pz: float) -> tuple[float, float]:
        """Project one point, as in tracking: plain floats are much faster than arrays without
        dimension."""
        ox, oy, oz = self.position.tolist()
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self.rotation.tolist()
        dx, dy, dz = px - ox, py - oy, pz - oz
        depth = dx * zx + dy * zy + dz * zz
        bent_x, bent_y, *_ = self._bend(
            (dx * xx + dy * xy + dz * xz) / depth, (dx * yx + dy * yy + dz * yz) / depth
        )
        return self.focal[0] * bent_x + self.centre[0], self.focal[1] * bent_y + self.centre[1]

    def _place(self, u: float, v: float, z: float) -> tuple[float, float]:
        """Return where one pixel meets the plane."""
        x, y = self._straighten(
            (u - self.centre[0]) / self.focal[0], (v - self.centre[1]) / self.focal[1]
        )
        ox, oy, oz = self.position.tolist()
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self.rotation.tolist()
        distance = (z - oz) / (x * xz + y * yz + zz)
        return ox + distance * (x * xx + y * yx + zx), oy + distance * (x * xy + y * yy + zy)

    def to_plane(self, pixels: ArrayLike, z: float) -> Array:
        """Return the points (..., 2), x and y, where pixels (..., 2) look through the horizontal
        plane at height `z` (m)."""
        at = np.asarray(pixels, float)
        if at.ndim == 1:
            u, v = at.tolist()
            return np.array(self._place(u, v, z))
        x, y = self._straighten(
            (at[..., 0] - self.centre[0]) / self.focal[0],
            (at[..., 1] - self.centre[1]) / self.focal[1],
        )
        direction = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation
        distance = (z - self.position[2]) / direction[..., 2]
        return np.asarray(self.position[:2] + distance[..., None] * direction[..., :2])

    def scale(self, point: ArrayLike) -> float:
        """Return pixels per metre near a point (3,): the size in the image of something one metre
        across."""
        depth = float(self.rotation[2] @ (np.asarray(point, float) - self.position))
        return (self.focal[0] + self.focal[1]) / 2.0 / depth

    def _bend(self, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
        """Return distorted image-plane coordinates and their derivatives by x and y (xx, xy = yx,
        yy)."""
        k1, k2, p1, p2 = self.distortion
        square = x * x + y * y
        radial = 1.0 + square * (k1 + k2 * square)
        slope = 2.0 * (k1 + 2.0 * k2 * square)
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        bent_y = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return bent_x, bent_y, xx, xy, yy

    def _straighten(self, bent_x: Number, bent_y: Number) -> tuple[Number, Number]:
        """Invert the distortion by Newton's method."""
        x, y = bent_x, bent_y
        for _ in range(NEWTON_STEPS):
            at_x, at_y, xx, xy, yy = self._bend(x, y)
            off_x, off_y, determinant = at_x - bent_x, at_y - bent_y, xx * yy - xy * xy
            x, y = (
                x - (yy * off_x - xy * off_y) / determinant,
                y - (xx * off_y - xy * off_x) / determinant,
            )
        return x, y


# --- the table ---


class TableView(Struct, frozen=True, dict=True):
    """Table and ball (m, base frame) in front of a calibrated camera. `height` is that of a rolling
    ball's centre."""

    optics: Optics
    width_px: int
    height_px: int
    near_edge: float
    length: float
    half_width: float
    height: float
    radius: float
    exposure: float
    """Exposure time of an image (s)."""

    @classmethod
    def of(cls, cell: Mapping[str, Any], optics: Optics) -> TableView:
        """Read the cell's data. Raises KeyError for a missing key."""
        table, camera, radius = cell["table"], cell["camera"], float(cell["ball"]["radius"])
        return cls(
            optics,
            int(camera["width"]),
            int(camera["height"]),
            float(table["near_edge"]),
            float(table["length"]),
            float(table["width"]) / 2.0,
            float(table["top"]) + radius,
            radius,
            float(camera["exposure"]),
        )

    def to_table(self, pixels: ArrayLike) -> Array:
        """Return x and y (..., 2), m, of a rolling ball whose centre is seen at pixels (..., 2)."""
        return self.optics.to_plane(pixels, self.height)

    def to_pixels(self, places: ArrayLike) -> Array:
        """Return pixels (..., 2) of a rolling ball's centre at x and y (..., 2), m."""
        at = np.asarray(places, float)
        if at.ndim == 1:
            return self.optics.project((*at.tolist(), self.height))
        return self.optics.project(
            np.concatenate([at, np.full((*at.shape[:-1], 1), self.height)], axis=-1)
        )

    def on_table(self, places: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return which places (..., 2) lie on the table, or at most `margin` m beside it."""
        at = np.asarray(places, float)
        inside: NDArray[np.bool_] = (
            (at[..., 0] >= self.near_edge - margin)
            & (at[..., 0] <= self.near_edge + self.length + margin)
            & (np.abs(at[..., 1]) <= self.half_width + margin)
        )
        return inside

    @cached_property
    def radius_px(self) -> float:
        """The ball's radius (px) in the middle of the table; it varies by a few per cent over the
        table."""
        middle = (self.near_edge + self.length / 2.0, 0.0, self.height)
        return self.radius * self.optics.scale(middle)

    def streak_px(self, speed: float) -> float:
        """Return the px that a ball of this speed (m/s) moves during an exposure."""
        return abs(speed) * self.exposure * self.radius_px / self.radius

    @cached_property
    def region(self) -> tuple[slice, slice]:
        """Rows and columns of the image that contain the table, at even bounds so that half the
        size is exact."""
        near, far, side = self.near_edge, self.near_edge + self.length, self.half_width
        middle = (near + far) / 2.0
        rim = [(x, y) for x in (near, middle, far) for y in (-side, 0.0, side)]
        pixels = self.to_pixels(rim)
        low = np.maximum(pixels.min(axis=0) - self.radius_px, 0).astype(int) // 2 * 2
        high = (
            np.minimum(pixels.max(axis=0) + self.radius_px, (self.width_px, self.height_px)).astype(
                int
            )
            // 2
            * 2
        )
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
