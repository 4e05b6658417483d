"""The scene in front of the simulated camera: floor, table with its lines and marks, calibration
board; arm and cup, which hide it.

Surfaces are planes with a grey level under even light; sim/catching/camera.py adds light, lens and
noise. Lengths in m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

# --- static ---

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


class TableArea(Struct, frozen=True):
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
            near = np.nonzero((abs(along - mark_x) < MARK_RADIUS) & (abs(y - mark_y) < MARK_RADIUS))
            distance = np.hypot(along[near] - mark_x, y[near] - mark_y)
            grey[near] = np.where(distance < MARK_RADIUS, MARK_GREY, grey[near])
        grey = np.where(np.abs(y) < CENTRE_LINE / 2, LINE_GREY, grey)
        border = np.minimum.reduce([along, self.length - along, self.width / 2 - np.abs(y)])
        return np.where(border < SIDE_LINE, EDGE_GREY, grey)


def floor_grey(x: Array, y: Array) -> Array:
    """Return the grey level of the tiled floor at points (m, base frame)."""
    joint = (np.mod(x, TILE) < JOINT) | (np.mod(y, TILE) < JOINT)
    tiles = FLOOR_GREY + 5.0 * np.mod(np.floor(x / TILE) + 2.0 * np.floor(y / TILE), 3.0)
    return np.where(joint, FLOOR_JOINT_GREY, tiles)


class Chessboard(Struct, frozen=True):
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


# --- arm and cup ---
# Arm and cup as the simulated camera sees them: patches of one grey level, each the convex hull of
# two rims.
#
# They are computed again only when arm or cup has moved. Plain floats decide what is in view,
# since most parts never are.

Picture = NDArray[np.uint8]
Box = tuple[slice, slice]
Disc = tuple[float, float, float]
"""Pixel (u, v) of its middle, and its radius (px)."""

ARM_GREY = 120.0
CUP_GREY = 92.0
CUP_INSIDE_GREY = 40.0
CUP_WALL = 0.004
SUBPIXEL_BITS = 4
"""OpenCV draws polygons with corners in fractions of a pixel: sixteenths."""
_SUBPIXELS = float(1 << SUBPIXEL_BITS)
_SOFT = 2
"""How far a smooth edge may reach beyond its corners (px)."""
_STRETCH = 1.5
"""Factor larger than the stretch of the lens around any point in view."""
CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 13)[:-1]) for f in (np.cos, np.sin)], axis=-1)
_RING = np.pad(CIRCLE, ((0, 0), (0, 1)))


class Lens(Protocol):
    """What is needed of the camera; lengths in m, base frame."""

    width: int
    height: int
    focal: float
    position: Array

    @property
    def illumination(self) -> NDArray[np.float32]:
        """Relative light (height, width)."""

    def pixel(self, point: Sequence[float]) -> tuple[float, float, float]:
        """Return pixel (u, v) of a point (3,), and its depth in front of the lens (m)."""

    def project(self, points: Array) -> Array:
        """Return pixels (..., 2) of points (..., 3)."""


class Cover(Struct, frozen=True, eq=False):
    """A patch that hides the scene: convex hull (n, 1, 2) in sixteenths of a pixel, the box of the
    image that contains it, its grey level, its height (m)."""

    hull: NDArray[np.int32]
    box: Box
    grey: float
    height: float
    cup: bool


class Occluders:
    """Caches the covers of the newest pose of arm and cup."""

    def __init__(self, lens: Lens, cup_radius: float, cup_depth: float) -> None:
        """Radius and depth of the cup (m)."""
        self._lens = lens
        outer = _RING * (cup_radius + CUP_WALL)
        self._rings: Array = np.concatenate(
            [outer, outer - (0.0, 0.0, cup_depth), _RING * cup_radius]
        )
        self._size = math.hypot(cup_radius + CUP_WALL, cup_depth)
        self._seen: tuple[bytes, list[Cover]] = (b"", [])

    def covers(self, points: Array, radii: Array, pose: Array | None) -> list[Cover]:
        """Return what hides something now: capsules of the arm (points (n, 2, 3), radii (n,)), and
        the cup at `pose` (4, 4) if not None."""
        key = points.tobytes() + radii.tobytes() + (b"" if pose is None else pose.tobytes())
        if key != self._seen[0]:
            if len(points) != len(radii):
                raise ValueError(f"{len(points)} capsules of the arm, but {len(radii)} radii")
            self._seen = key, self._arm(points.tolist(), radii.tolist()) + self._cup(pose)
        return self._seen[1]

    def _arm(
        self, capsules: Sequence[Sequence[Sequence[float]]], radii: Sequence[float]
    ) -> list[Cover]:
        """Return the hull of both end discs of each capsule in view."""
        seen = [
            (disc, 0.5 * (a[2] + b[2]))
            for (a, b), r in zip(capsules, radii, strict=True)
            if (disc := self._discs(a, b, r))
        ]
        if not seen:
            return []
        discs = np.array([disc for disc, _ in seen])
        rims = (discs[:, :, None, 2:] * CIRCLE + discs[:, :, None, :2]).reshape(len(seen), -1, 2)
        corners = np.rint(rims * _SUBPIXELS).astype(np.int32)
        return [
            self._cover(hull, 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), ARM_GREY, height)
            for hull, ((a, b), height) in zip(corners, seen, strict=True)
        ]

    def _discs(
        self, a: Sequence[float], b: Sequence[float], radius: float
    ) -> tuple[Disc, Disc] | None:
        """Return both ends of a capsule, None if it is not in view."""
        lens = self._lens
        (ua, va, near), (ub, vb, far) = lens.pixel(a), lens.pixel(b)
        if near <= 4.0 * radius or far <= 4.0 * radius:
            return None  # At or behind the lens: out of focus anyway.
        ra, rb = radius * lens.focal / near, radius * lens.focal / far
        if not self._in_view(
            min(ua - ra, ub - rb),
            min(va - ra, vb - rb),
            max(ua + ra, ub + rb),
            max(va + ra, vb + rb),
        ):
            return None
        return (ua, va, ra), (ub, vb, rb)

    def _cup(self, pose: Array | None) -> list[Cover]:
        """Return the wall as the hull of both rims, then the dark mouth if it faces the camera."""
        if pose is None:
            return []
        lens, mouth = self._lens, pose[:3, 3].tolist()
        u, v, depth = lens.pixel(mouth)
        if depth - self._size < 0.1:
            return []
        reach = _STRETCH * self._size * lens.focal / (depth - self._size)
        if not self._in_view(u - reach, v - reach, u + reach, v + reach):
            return []
        pixels, count = lens.project(self._rings @ pose[:3, :3].T + pose[:3, 3]), 2 * len(_RING)
        wall = pixels[:count]
        if not self._in_view(*wall.min(axis=0).tolist(), *wall.max(axis=0).tolist()):
            return []
        corners = np.rint(pixels * _SUBPIXELS).astype(np.int32)
        at_u, at_v = wall.mean(axis=0).tolist()
        covers = [self._cover(corners[:count], at_u, at_v, CUP_GREY, mouth[2], cup=True)]
        if (lens.position - pose[:3, 3]) @ pose[:3, 2] > 0.0:
            covers.append(self._cover(corners[count:], u, v, CUP_INSIDE_GREY, mouth[2], cup=True))
        return covers

    def _in_view(self, left: float, top: float, right: float, bottom: float) -> bool:
        """Return whether a part of a box (px) is in the image."""
        return (
            right >= 0.0 and bottom >= 0.0 and left < self._lens.width and top < self._lens.height
        )

    def _cover(
        self,
        corners: NDArray[np.int32],
        u: float,
        v: float,
        grey: float,
        height: float,
        cup: bool = False,
    ) -> Cover:
        """Return the convex hull of corners (n, 2), in sixteenths of a pixel, in the light of the
        pixel (u, v)."""
        lens = self._lens
        light = lens.illumination[
            min(max(int(v), 0), lens.height - 1), min(max(int(u), 0), lens.width - 1)
        ]
        hull = np.asarray(cv2.convexHull(corners), np.int32)
        left, top, wide, high = cv2.boundingRect(hull)
        box = _within(lens.height, top, top + high), _within(lens.width, left, left + wide)
        return Cover(hull, box, grey * float(light), height, cup)


def _within(size: int, low: int, high: int) -> slice:
    """Return whole pixels of an image side of `size` px around an interval in sixteenths of a
    pixel."""
    return slice(
        max((low >> SUBPIXEL_BITS) - _SOFT, 0), min((high >> SUBPIXEL_BITS) + _SOFT + 1, size)
    )


def fill(picture: Picture, covers: Sequence[Cover]) -> None:
    """Draw covers with smooth edges."""
    for cover in covers:
        cv2.fillConvexPoly(picture, cover.hull, cover.grey, cv2.LINE_AA, SUBPIXEL_BITS)
