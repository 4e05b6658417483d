"""The table as the calibrated camera sees it: where a rolling ball can be, in metres and in
pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petrobot.services.vision.optics import Array, Optics


@dataclass(frozen=True)
class TableView:
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
