"""The rover's forward camera: perspective view of the floor, blurred by motion, in changing light, with flashes and noise.

Body frame: origin on the floor below the middle of the axle, x forward, y left, z up. Camera frame: x right, y down, z forward.
All pixels look at the floor, so each image is a homography of the floor's pictures: a matrix for the whole image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.track_floor import COARSE, FINE, ORIGIN, Floor, Picture

Array = NDArray[np.float64]

STILL: Final = 0.0005
"""m by which the farthest floor in view moves during an exposure, below which one view of it is enough."""
_BLUR: Final = 0.5 / math.sqrt(3.0)
"""Two views so much of the exposure before and after its middle spread a point as evenly as the whole exposure (equal variance)."""
_NOISE_SIZE: Final = 512
_SAMPLING: Final = 3.0
"""Cells of the fine picture that a pixel may cover along the view before the coarse one is looked at."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Where the camera is on the rover (m, rad) and how it sees (px): pitch down, yaw to the left, roll to the right."""

    forward: float
    height: float
    pitch: float
    yaw: float
    roll: float
    focal: float
    principal: tuple[float, float]
    width: int
    rows: int

    @property
    def rotation(self) -> Array:
        """(3, 3): rows are the camera's axes in the body frame."""
        cp, sp = math.cos(self.pitch), math.sin(self.pitch)
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        level = np.array([[0.0, -1.0, 0.0], [-sp, 0.0, -cp], [cp, 0.0, -sp]])
        turned = level @ np.array([[cy, sy, 0.0], [-sy, cy, 0.0], [0.0, 0.0, 1.0]])
        rolled: Array = np.array([[cr, sr, 0.0], [-sr, cr, 0.0], [0.0, 0.0, 1.0]]) @ turned
        return rolled

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of body-frame points on the floor (..., 2)."""
        floor = np.asarray(points, float)
        at = np.stack([floor[..., 0] - self.forward, floor[..., 1], np.full(floor.shape[:-1], -self.height)], axis=-1)
        seen = at @ self.rotation.T
        return np.asarray(self.focal * seen[..., :2] / seen[..., 2:] + self.principal)

    def to_floor(self) -> Array:
        """(3, 3) homography from pixels (u, v, 1) to the body frame's floor. Raises ValueError for a pixel above the horizon."""
        u0, v0 = self.principal
        rays = self.rotation.T @ np.array(
            [[1.0, 0.0, -u0], [0.0, 1.0, -v0], [0.0, 0.0, self.focal]]
        )  # of pixels, body frame
        corners = np.array([[u, v, 1.0] for u in (0, self.width - 1) for v in (0, self.rows - 1)])
        if (corners @ rays[2] >= 0.0).any():
            raise ValueError("the camera looks over the horizon: give it more pitch or a longer focal length")
        return np.array([self.height * rays[0] - self.forward * rays[2], self.height * rays[1], -rays[2]])


class Motion(NamedTuple):
    """The rover's pose (m, rad) and how it moves (m/s along its heading, rad/s)."""

    x: float
    y: float
    heading: float
    speed: float
    turn: float


class FloorCamera:
    """Takes images of a `Floor`; noise from `rng`."""

    def __init__(
        self, mount: Mount, exposure: float, greys: tuple[float, float], noise: float, vignetting: float
    ) -> None:
        """`exposure` in s; `greys` of black and white paint; `noise` in grey levels (sigma); `vignetting`: share of the light
        that the corners lose."""
        self.mount = mount
        self.exposure = exposure
        self._to_floor = mount.to_floor()
        self._black, self._white = greys
        self._reach = float(np.hypot(*self._ground(mount.width / 2, 0.0)))
        self._split = self._split_row()
        u, v = np.meshgrid(np.linspace(-1.0, 1.0, mount.width), np.linspace(-1.0, 1.0, mount.rows))
        lit = 1.0 - 0.5 * vignetting * (u * u + v * v)
        self._gain = (lit * ((self._white - self._black) / 255.0)).astype(np.float32)
        self._floor_grey = (lit * self._black).astype(np.float32)
        field = np.random.default_rng(_NOISE_SIZE).standard_normal((_NOISE_SIZE, _NOISE_SIZE))
        self._noise = (noise * field).astype(np.float32)
        self._maps = [
            _scaled(self._to_floor, 0.0, self._split, COARSE),
            _scaled(self._to_floor, float(self._split), mount.rows - self._split, FINE),
        ]

    def _ground(self, u: float, v: float) -> Array:
        x, y, w = self._to_floor @ (u, v, 1.0)
        return np.array([x / w, y / w])

    def _split_row(self) -> int:
        """First row whose pixels cover less than `_SAMPLING` cells of the fine picture along the view."""
        u = self.mount.width / 2
        for row in range(self.mount.rows):
            if np.linalg.norm(self._ground(u, row) - self._ground(u, row + 1)) < _SAMPLING * FINE:
                return row
        return self.mount.rows

    def take(
        self,
        floor: Floor,
        motion: Motion,
        rng: np.random.Generator,
        light: float = 1.0,
        veil: float = 0.0,
        grain: float = 1.0,
    ) -> Picture:
        """One image (rows, width). `light`: factor, `veil`: grey levels of stray light, `grain`: factor on the noise."""
        during = self.exposure * _BLUR
        if self.exposure * (abs(motion.speed) + abs(motion.turn) * self._reach) < STILL:
            grey = self._view(floor, motion, 0.0).astype(np.float32)
        else:
            before, after = self._view(floor, motion, -during), self._view(floor, motion, during)
            grey = np.add(before, after, dtype=np.float32)
            grey *= 0.5
        return self._develop(grey, rng, light, veil, grain)

    def _view(self, floor: Floor, motion: Motion, later: float) -> Picture:
        """The paint that each pixel sees, `later` seconds than `motion`."""
        heading = motion.heading + later * motion.turn
        way = later * motion.speed
        c, s = math.cos(heading), math.sin(heading)
        x, y = motion.x + way * c - ORIGIN, motion.y + way * s - ORIGIN
        body = np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])
        image = np.empty((self.mount.rows, self.mount.width), np.uint8)
        parts = ((0, self._split, floor.coarse), (self._split, self.mount.rows, floor.fine))
        for (top, bottom, picture), scaled in zip(parts, self._maps, strict=True):
            if bottom > top:
                cv2.warpPerspective(
                    picture,
                    scaled.matrix(body),
                    (self.mount.width, bottom - top),
                    dst=image[top:bottom],
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                    borderMode=cv2.BORDER_REPLICATE,
                )
        return image

    def _develop(
        self, grey: NDArray[np.float32], rng: np.random.Generator, light: float, veil: float, grain: float
    ) -> Picture:
        grey *= self._gain
        grey += self._floor_grey
        if light != 1.0:
            grey *= np.float32(light)
        row, column = rng.integers(_NOISE_SIZE - self.mount.rows), rng.integers(_NOISE_SIZE - self.mount.width)
        noise = self._noise[row : row + self.mount.rows, column : column + self.mount.width]
        grey += noise if grain == 1.0 else noise * np.float32(grain)
        if veil:
            grey += np.float32(veil)
        np.rint(grey, out=grey)
        return np.clip(grey, 0.0, 255.0, out=grey).astype(np.uint8)


class _Scaled(NamedTuple):
    """Homography of some rows of the image to the body frame's floor, and the scale of the picture that is looked at."""

    to_floor: Array
    cells: Array

    def matrix(self, body: Array) -> Array:
        """From pixels to cells of the picture, for the rover's pose in it (3, 3), m."""
        matrix: Array = self.cells @ body @ self.to_floor
        return matrix


def _scaled(to_floor: Array, top: float, rows: int, cell: float) -> _Scaled:
    shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
    return _Scaled(to_floor @ shift, np.array([[1.0 / cell, 0.0, -0.5], [0.0, 1.0 / cell, -0.5], [0.0, 0.0, 1.0]]))
