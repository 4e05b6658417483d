"""The rover's forward camera: perspective view of the floor, blurred by motion, in changing light,
with flashes and noise.

Body frame: origin on the floor below the middle of the axle, x forward, y left, z up. Camera frame:
x right, y down, z forward. All pixels look at the floor, so each image is a homography of the
floor's pictures: one matrix for the whole image.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from petrobot.sim.track.floor import COARSE, FINE, Floor, FloorWindow, Picture

Array = NDArray[np.float64]

STILL: Final = 0.0005
"""m by which the farthest floor in view must move during an exposure for two views of it to be
needed."""
_BLUR: Final = 0.5 / math.sqrt(3.0)
"""Two views this share of the exposure before and after its middle spread a point like the whole
exposure: a uniform distribution over the exposure T has the variance T^2 / 12, two points at +-d
have d^2."""
_NOISE_SIZE: Final = 320
_NOISE_ZERO: Final = 128.0
"""Grey level of the noise field that stands for no noise."""
_SAMPLING: Final = 3.0
"""Cells of the fine picture that a pixel may cover along the view before the coarse picture is
used."""


class Mount(Struct, frozen=True):
    """Where the camera is on the rover (m, rad) and its lens (px): pitch down, yaw to the left,
    roll to the right."""

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
        """Return pixels (..., 2) of body-frame points on the floor (..., 2)."""
        floor = np.asarray(points, float)
        at = np.stack(
            [floor[..., 0] - self.forward, floor[..., 1], np.full(floor.shape[:-1], -self.height)],
            axis=-1,
        )
        seen = at @ self.rotation.T
        return np.asarray(self.focal * seen[..., :2] / seen[..., 2:] + self.principal)

    def to_floor(self) -> Array:
        """Return the homography (3, 3) from pixels (u, v, 1) to the floor in the body frame. Raises
        ValueError for a pixel above the horizon."""
        u0, v0 = self.principal
        rays = self.rotation.T @ np.array(
            [[1.0, 0.0, -u0], [0.0, 1.0, -v0], [0.0, 0.0, self.focal]]
        )  # of pixels, body frame
        corners = np.array([[u, v, 1.0] for u in (0, self.width - 1) for v in (0, self.rows - 1)])
        if (corners @ rays[2] >= 0.0).any():
            raise ValueError(
                "the camera looks over the horizon: give it more pitch or a longer focal length"
            )
        return np.array(
            [self.height * rays[0] - self.forward * rays[2], self.height * rays[1], -rays[2]]
        )


class Motion(NamedTuple):
    """The rover's pose (m, rad) and motion (m/s along its heading, rad/s)."""

    x: float
    y: float
    heading: float
    speed: float
    turn: float


class RoverCamera:
    """Takes images of a `Floor`; noise from `rng`."""

    def __init__(
        self,
        mount: Mount,
        exposure: float,
        greys: tuple[float, float],
        noise: float,
        vignetting: float,
    ) -> None:
        """`exposure` in s; `greys` of black and white paint; `noise` in grey levels (sigma);
        `vignetting`: share of the light that the corners lose."""
        self.mount = mount
        self.exposure = exposure
        self._to_floor = mount.to_floor()
        self._black, self._white = greys
        self._reach = float(np.hypot(*self._ground(mount.width / 2, 0.0)))
        self._split = self._split_row()
        u, v = np.meshgrid(np.linspace(-1.0, 1.0, mount.width), np.linspace(-1.0, 1.0, mount.rows))
        lit = 1.0 - 0.5 * vignetting * (u * u + v * v)
        self._lit = np.asarray(np.rint(255.0 * lit), np.uint8)
        field = np.random.default_rng(_NOISE_SIZE).standard_normal((_NOISE_SIZE, _NOISE_SIZE))
        self._noise = np.asarray(np.clip(np.rint(_NOISE_ZERO + noise * field), 0, 255), np.uint8)
        self._parts = [
            _Part(self._to_floor, 0, self._split, FloorWindow(COARSE, self._farthest(0.0))),
            _Part(
                self._to_floor,
                self._split,
                mount.rows,
                FloorWindow(FINE, self._farthest(float(self._split))),
            ),
        ]

    def _farthest(self, row: float) -> float:
        """Return how far from the body's origin the ends of a row look (m)."""
        return max(float(np.hypot(*self._ground(u, row))) for u in (0.0, float(self.mount.width)))

    def _ground(self, u: float, v: float) -> Array:
        x, y, w = self._to_floor @ (u, v, 1.0)
        return np.array([x / w, y / w])

    def _split_row(self) -> int:
        """Return the first row whose pixels cover less than `_SAMPLING` cells of the fine picture
        along the view."""
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
        """Return one image (rows, width). `light`: factor, `veil`: grey levels of stray light,
        `grain`: factor on the noise."""
        black, share = self._black, (self._white - self._black) / 255.0
        if self.exposure * (abs(motion.speed) + abs(motion.turn) * self._reach) < STILL:
            still = self._view(floor, motion, 0.0)
            grey = cv2.addWeighted(still, share, still, 0.0, black)
        else:
            during = self.exposure * _BLUR
            before, after = self._view(floor, motion, -during), self._view(floor, motion, during)
            grey = cv2.addWeighted(before, 0.5 * share, after, 0.5 * share, black)
        grey = cv2.multiply(grey, self._lit, scale=1.0 / 255.0)
        row, column = (
            int(rng.integers(_NOISE_SIZE - size)) for size in (self.mount.rows, self.mount.width)
        )
        noise = self._noise[row : row + self.mount.rows, column : column + self.mount.width]
        return np.asarray(
            cv2.addWeighted(grey, light, noise, grain, veil - grain * _NOISE_ZERO), np.uint8
        )

    def _view(self, floor: Floor, motion: Motion, later: float) -> Picture:
        """Return the paint that each pixel sees, `later` seconds after `motion`."""
        heading = motion.heading + later * motion.turn
        way = later * motion.speed
        c, s = math.cos(heading), math.sin(heading)
        x, y = motion.x + way * c, motion.y + way * s
        image = np.empty((self.mount.rows, self.mount.width), np.uint8)
        for part, picture in zip(self._parts, (floor.coarse, floor.fine), strict=True):
            if part.bottom > part.top:
                part.window.look(picture, floor.version, x, y)
                body = np.array(
                    [[c, -s, x - part.window.x], [s, c, y - part.window.y], [0.0, 0.0, 1.0]]
                )
                cv2.warpPerspective(
                    part.window.part,
                    part.cells @ body @ part.to_floor,
                    (self.mount.width, part.bottom - part.top),
                    dst=image[part.top : part.bottom],
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                    borderMode=cv2.BORDER_REPLICATE,
                )
        return image


class _Part:
    """Some rows of the image: their homography to the floor in the body frame, and the window of
    the picture that they look at."""

    def __init__(self, to_floor: Array, top: int, bottom: int, window: FloorWindow) -> None:
        self.top, self.bottom, self.window = top, bottom, window
        self.to_floor: Array = to_floor @ np.array(
            [[1.0, 0.0, 0.0], [0.0, 1.0, float(top)], [0.0, 0.0, 1.0]]
        )
        cell = window.cell
        self.cells: Array = np.array(
            [[1.0 / cell, 0.0, -0.5], [0.0, 1.0 / cell, -0.5], [0.0, 0.0, 1.0]]
        )
