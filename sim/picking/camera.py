"""Images of the camera above the table: parts as prisms with their sides and shadows, trays, arm,
light and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.sim.picking.parts import Part, Point, rectangle

Picture = NDArray[np.uint8]
Vector = NDArray[np.float64]
_SHIFT: Final = 4
"""Fractional bits of pixel coordinates in OpenCV's drawing functions."""
_SIDE: Final = 0.72
"""Brightness of a part's sides relative to its top."""


class Lighting(Struct, frozen=True):
    """Lighting on the table: its level, the direction (rad) and length of shadows per height, their
    darkness, and a broad shadow across the table (position along y and width; m)."""

    level: float
    direction: float
    length: float
    darkness: float
    band: tuple[float, float] | None
    noise: float
    """Standard deviation of the noise (grey levels)."""


class Mounted(Struct, frozen=True):
    """The camera as it is really mounted: a point p has camera coordinates `rotation @ (p -
    position)`."""

    width: int
    height: int
    focal: float
    position: Vector
    rotation: Vector

    def pixels(self, points: Sequence[Sequence[float]]) -> Vector:
        """Return the pixels (n, 2) of points of the table's frame (n, 3)."""
        seen = (np.asarray(points, float) - self.position) @ self.rotation.T
        depth = np.maximum(seen[:, 2:], 0.02)
        return self.focal * seen[:, :2] / depth + (self.width / 2 - 0.5, self.height / 2 - 0.5)


def mounted(
    numbers: Mapping[str, Any], errors: Mapping[str, Any], rng: np.random.Generator
) -> Mounted:
    """Return the camera of an installation; `errors` are standard deviations. Raises KeyError."""
    pitch, roll = rng.normal(0.0, errors["camera_tilt"], 2)
    yaw = float(rng.normal(0.0, errors["camera_turn"]))
    down = np.array(((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    small = np.array(((1.0, -yaw, roll), (yaw, 1.0, -pitch), (-roll, pitch, 1.0)))
    u, _, v = np.linalg.svd(small)
    return Mounted(
        int(numbers["width"]),
        int(numbers["height"]),
        float(numbers["focal_px"]) * (1.0 + float(rng.normal(0.0, errors["camera_focal"]))),
        np.asarray(numbers["position"], float) + rng.normal(0.0, errors["camera"], 3),
        (u @ v) @ down,
    )


class SceneCamera:
    """Renders images of one installation."""

    def __init__(self, mount: Mounted, table: float, trays: Mapping[str, Any]) -> None:
        """`table`: its grey level."""
        self.mount = mount
        size = mount.height, mount.width
        self._ground = np.full(size, table, np.uint8)
        for tray in trays.values():
            corners = _tray(tray, 0.0)
            self._fill(self._ground, [(x, y, 0.0) for x, y in corners], 0.82 * table)
            inner = _tray(tray, 0.006)
            self._fill(self._ground, [(x, y, 0.0) for x, y in inner], 1.08 * table)
        v, u = np.mgrid[0 : size[0], 0 : size[1]]
        r2 = ((u / size[1] - 0.5) ** 2 + (v / size[0] - 0.5) ** 2) / 0.5
        # The lamp hangs to one side, and the lens loses light towards the corners.
        self._gain = ((1.0 - 0.12 * r2) * (1.06 - 0.12 * u / size[1])).astype(np.float32)
        draws = np.random.default_rng(0x6E6F)
        self._noise = draws.standard_normal((2 * size[0], 2 * size[1])).astype(np.float32)

    def take(
        self,
        parts: Sequence[Part],
        arm: Sequence[Sequence[float]],
        radius: float,
        light: Lighting,
        rng: np.random.Generator,
    ) -> Picture:
        """Return an image (height, width) of grey levels. `arm`: points of its links, `radius`:
        half their thickness (m)."""
        image = self._ground.copy()
        there = [part for part in parts if not part.lost]
        self._shade(image, there, light)
        eye = self.mount.position
        for part in sorted(
            there, key=lambda p: (p.z, -math.hypot(p.x - eye[0], p.y - eye[1]), p.number)
        ):
            bottom = [(x, y, part.z) for x, y in part.outline()]
            top = [(x, y, part.top) for x, y in part.outline()]
            self._hull(image, bottom + top, _SIDE * part.grey)
            self._fill(image, top, part.grey)
        self._draw_arm(image, arm, radius)
        seen = image.astype(np.float32)
        seen *= self._gain
        if light.band is not None:
            seen *= self._band(light)
        seen *= light.level
        dv, du = rng.integers(0, self.mount.height), rng.integers(0, self.mount.width)
        seen += light.noise * self._noise[dv : dv + self.mount.height, du : du + self.mount.width]
        return np.clip(seen, 0.0, 255.0).astype(np.uint8)

    def _shade(self, image: Picture, parts: Sequence[Part], light: Lighting) -> None:
        if light.darkness <= 0.0:
            return
        mask = np.zeros_like(image)
        dx = light.length * math.cos(light.direction)
        dy = light.length * math.sin(light.direction)
        for part in parts:
            foot = [(x + dx * part.z, y + dy * part.z, 0.0) for x, y in part.outline()]
            far = [(x + dx * part.top, y + dy * part.top, 0.0) for x, y in part.outline()]
            self._hull(mask, foot + far, 255.0)
        mask = cv2.GaussianBlur(mask, (5, 5), 1.2)  # type: ignore[assignment]
        factor = 1.0 - light.darkness / 255.0 * mask.astype(np.float32)
        np.copyto(image, (image * factor).astype(np.uint8))

    def _band(self, light: Lighting) -> NDArray[np.float32]:
        """Return a soft shadow across the table, such as a person's, as a factor per image
        column."""
        middle, width = light.band or (0.0, 0.0)
        at = self.mount.pixels([(0.15, middle, 0.0), (0.15, middle + width / 2, 0.0)])
        u = np.arange(self.mount.width, dtype=np.float32)
        half = abs(float(at[1, 0] - at[0, 0]))
        edge = 1.0 / (1.0 + np.exp((np.abs(u - float(at[0, 0])) - half) / 6.0))
        return (1.0 - light.darkness * edge)[None, :].astype(np.float32)  # type: ignore[no-any-return]

    def _draw_arm(self, image: Picture, arm: Sequence[Sequence[float]], radius: float) -> None:
        eye = self.mount.position[2]
        for k, (a, b) in enumerate(pairwise(arm)):
            if max(a[2], b[2]) > eye - 0.08 or math.dist(a, b) < 1e-6:
                continue
            thick = radius * (0.5 if k == len(arm) - 2 else 1.0)
            ends = self.mount.pixels([a, b])
            width = 2.0 * thick * self.mount.focal / (eye - (a[2] + b[2]) / 2)
            (u0, v0), (u1, v1) = np.rint(ends).astype(int).tolist()
            cv2.line(image, (u0, v0), (u1, v1), 45, max(1, round(width)))

    def _fill(self, image: Picture, points: Sequence[Sequence[float]], grey: float) -> None:
        corners = np.rint(self.mount.pixels(points) * (1 << _SHIFT)).astype(np.int32)
        cv2.fillConvexPoly(image, corners, float(grey), cv2.LINE_AA, _SHIFT)

    def _hull(self, image: Picture, points: Sequence[Sequence[float]], grey: float) -> None:
        corners = (self.mount.pixels(points) * (1 << _SHIFT)).astype(np.float32)
        hull = np.rint(cv2.convexHull(corners)).astype(np.int32)
        cv2.fillConvexPoly(image, hull, float(grey), cv2.LINE_AA, _SHIFT)


def _tray(tray: Mapping[str, Any], rim: float) -> list[Point]:
    (x, y), (along, across) = tray["position"], tray["size"]
    return rectangle(x, y, 0.0, along - rim, across - rim)
