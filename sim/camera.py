"""The simulated camera: a pinhole with lens distortion looks at the cell and gives grey images as a real one would.

The static scene is drawn once; each image copies it, paints ball, shadow, arm and cup into their regions of interest and
adds light and noise in one pass. Geometry: pinhole with the distortion of Brown (1966) in OpenCV's order k1 k2 p1 p2;
the ball is an exact sphere (its distance from each pixel's ray), blurred over the exposure.
Lengths in m, base frame; pixels are (u, v), u to the right, whole numbers at pixel centres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.scenery import Chessboard, Table, floor_grey, supersampled

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

BALL_GREY = 215.0
ARM_GREY = 120.0
CUP_GREY = 92.0
CUP_INSIDE_GREY = 40.0
CUP_WALL = 0.004
SHADOW_DEPTH = 0.35
"""Part of the light that the ball takes from the table right below it."""
NOISE_ZERO = 128
NOISE_SIZE = 1280
LIGHT_DIRECTION = np.array([-0.25, 0.35, 0.90]) / np.linalg.norm([-0.25, 0.35, 0.90])
"""Towards the lamp, base frame."""
LENS_STEPS = 6
CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 13)[:-1]) for f in (np.cos, np.sin)], axis=-1)
RING = np.pad(CIRCLE, ((0, 0), (0, 1)))


@dataclass(frozen=True, slots=True)
class View:
    """The true camera and light, where they differ from the cell's nominal ones. None: nominal."""

    position: Sequence[float] | None = None
    """(3,) optical centre, m, base frame."""
    rotation: ArrayLike | None = None
    """(3, 3), rows are the camera's x (right), y (down) and z (forward) axes in the base frame."""
    focal_px: float | None = None
    principal_px: Sequence[float] | None = None
    """(2,) px; nominal is the middle of the image."""
    distortion: Sequence[float] | None = None
    """k1 k2 p1 p2."""
    table_top: float | None = None
    """m."""
    near_edge: float | None = None
    """m."""
    light_gradient: Sequence[float] = (-0.50, 0.10)
    """Relative change of the light from one side of the image to the other, along u and v: the far end is dimmer."""
    vignetting: float = 0.20
    """Relative loss of light in the image's corners."""
    noise: float | None = None
    """Grey levels, sigma."""

    @classmethod
    def of(cls, truth: Mapping[str, Any]) -> View:
        """Read from a mapping with these names as keys. An unknown key raises ValueError."""
        unknown = sorted(set(truth) - set(cls.__slots__))
        if unknown:
            raise ValueError(f"camera truth: unknown key {unknown[0]!r}; known are {', '.join(cls.__slots__)}")
        return cls(**truth)


@dataclass(frozen=True, eq=False, slots=True)
class _Cover:
    """What arm or cup hide: a convex hull (n, 1, 2) in sixteenths of a pixel, its grey level, its height (m)."""

    hull: NDArray[np.int32]
    grey: float
    height: float
    cup: bool


class PinholeCamera:
    """The camera of the simulated laboratory. The same generator state and the same calls give the same images."""

    def __init__(self, cell: Mapping[str, Any], truth: Mapping[str, Any], rng: np.random.Generator) -> None:
        camera, view = cell["camera"], View.of(truth)
        self.view = view
        self.width, self.height = int(camera["width"]), int(camera["height"])
        self.table = Table.of(cell, view.table_top, view.near_edge)
        self.ball_radius = float(cell["ball"]["radius"])
        self.cup_radius, self.cup_depth = float(cell["cup"]["radius"]), float(cell["cup"]["depth"])
        self.exposure = float(camera["exposure"])
        self.focal = float(camera["focal_px"] if view.focal_px is None else view.focal_px)
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        self.cx, self.cy = (float(c) for c in (middle if view.principal_px is None else view.principal_px))
        self.distortion: Array = np.asarray(camera["distortion"] if view.distortion is None else view.distortion, float)
        self.position: Array = np.asarray(camera["position"] if view.position is None else view.position, float)
        self.rotation: Array = _looking_down(camera) if view.rotation is None else np.asarray(view.rotation, float)
        self._rng = rng
        self._lamp = (self.rotation @ LIGHT_DIRECTION).astype(np.float32)
        outer = RING * (self.cup_radius + CUP_WALL)
        self._cup_rings: Array = np.concatenate([outer, outer - (0.0, 0.0, self.cup_depth), RING * self.cup_radius])
        self._covered: tuple[bytes, list[_Cover]] = (b"", [])
        sigma = float(camera["noise"] if view.noise is None else view.noise)
        field = NOISE_ZERO + sigma * rng.standard_normal((NOISE_SIZE, NOISE_SIZE), np.float32)
        self._noise: Picture = np.clip(np.rint(field), 0, 255).astype(np.uint8)
        self._brighter: Picture = np.maximum(self._noise, NOISE_ZERO) - np.uint8(NOISE_ZERO)
        self._darker: Picture = np.uint8(NOISE_ZERO) - np.minimum(self._noise, NOISE_ZERO)

    def reseed(self, rng: np.random.Generator) -> None:
        """Choose noise by another generator from now on."""
        self._rng = rng

    # Geometry

    def to_camera(self, points: ArrayLike) -> Array:
        """Base-frame points (..., 3) in the camera's frame."""
        return np.asarray((np.asarray(points, float) - self.position) @ self.rotation.T)

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of base-frame points (..., 3)."""
        return self._pixels(self.to_camera(points))

    def _pixels(self, seen: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera's frame."""
        x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
        k1, k2, p1, p2 = self.distortion
        square = x * x + y * y
        radial = 1.0 + square * (k1 + k2 * square)
        u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        pixels = np.empty((*u.shape, 2))
        pixels[..., 0], pixels[..., 1] = self.focal * u + self.cx, self.focal * v + self.cy
        return pixels

    def rays(self, pixels: Array) -> Array:
        """Unit directions (..., 3), camera frame, in which pixels (..., 2) look; fixed-point inverse of the distortion."""
        du = (pixels[..., 0] - self.cx) / self.focal
        dv = (pixels[..., 1] - self.cy) / self.focal
        x, y = du, dv
        k1, k2, p1, p2 = self.distortion
        for _ in range(LENS_STEPS):
            square = x * x + y * y
            radial = 1.0 + square * (k1 + k2 * square)
            x, y = (
                (du - 2.0 * p1 * x * y - p2 * (square + 2.0 * x * x)) / radial,
                (dv - p1 * (square + 2.0 * y * y) - 2.0 * p2 * x * y) / radial,
            )
        direction = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))

    def _on_plane(self, pixels: Array, origin: Array, normal: Array) -> Array:
        """Base-frame points (..., 3) where pixels look through a plane."""
        return self._through(self.rays(pixels) @ self.rotation, origin, normal)

    def _through(self, direction: Array, origin: Array, normal: Array) -> Array:
        """Points (..., 3) where base-frame directions (..., 3) from the optical centre pass a plane."""
        distance = ((origin - self.position) @ normal) / (direction @ normal)
        return np.asarray(self.position + distance[..., None] * direction)

    # Static scene

    @cached_property
    def _grid(self) -> Array:
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return np.stack([u, v], axis=-1)

    @cached_property
    def _rays(self) -> NDArray[np.float32]:
        return self.rays(self._grid).astype(np.float32)

    @cached_property
    def illumination(self) -> NDArray[np.float32]:
        """Relative light (height, width): gradient and vignetting."""
        u = (self._grid[..., 0] - (self.width - 1) / 2) / self.width
        v = (self._grid[..., 1] - (self.height - 1) / 2) / self.height
        gradient = 1.0 + self.view.light_gradient[0] * u + self.view.light_gradient[1] * v
        return (gradient * (1.0 - self.view.vignetting * 2.0 * (u * u + v * v))).astype(np.float32)

    def _scene_grey(self, pixels: Array) -> Array:
        up = np.array([0.0, 0.0, 1.0])
        direction = self.rays(pixels) @ self.rotation
        table = self._through(direction, np.array([0.0, 0.0, self.table.top]), up)
        floor = self._through(direction, np.zeros(3), up)
        on_table = self.table.contains(table[..., 0], table[..., 1])
        return np.where(
            on_table, self.table.grey(table[..., 0], table[..., 1]), floor_grey(floor[..., 0], floor[..., 1])
        )

    @cached_property
    def background(self) -> Picture:
        """The scene without ball, arm and cup, lit, without noise (height, width)."""
        grey = supersampled(self._grid, self._scene_grey, 2) * self.illumination
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    # Images

    def warm_up(self) -> None:
        """Make all that is made once: in real time the first image must not take longer than the others."""
        _ = self.background, self._rays

    def render(
        self,
        ball: ArrayLike | None,
        ball_velocity: ArrayLike = (0.0, 0.0, 0.0),
        arm_points: ArrayLike | None = None,
        arm_radii: ArrayLike = (),
        cup_pose: ArrayLike | None = None,
        light: float = 1.0,
    ) -> Picture:
        """One image (height, width) uint8.

        ball: centre at mid-exposure (3,) m, None: no ball; ball_velocity (3,) m/s; arm_points (n, 2, 3): both ends of each
        capsule of the arm, arm_radii (n,) m; cup_pose (4, 4): the cup's mouth centre with z out of the mouth; light: factor.
        """
        picture = self.background.copy()
        pose = None if cup_pose is None else np.asarray(cup_pose, float)
        covers = self._covers(arm_points, arm_radii, pose)
        if ball is None:
            self._fill(picture, covers)
        else:
            centre = np.asarray(ball, float)
            in_cup = pose is not None and self._inside_cup(centre, pose)
            above = [cover for cover in covers if cover.height > centre[2] and not (cover.cup and in_cup)]
            self._fill(picture, [cover for cover in covers if cover not in above])
            self._paint_ball(picture, centre, np.asarray(ball_velocity, float))
            self._fill(picture, above)
        return self._expose(picture, light)

    def render_board(self, pose: ArrayLike, board: Chessboard | None = None, light: float = 1.0) -> Picture:
        """One image of a calibration board held at `pose` (4, 4), board frame to base frame; nothing else in view."""
        board = board or Chessboard()
        frame = np.asarray(pose, float)

        def point_at(pixels: Array) -> Array:
            return np.asarray((self._on_plane(pixels, frame[:3, 3], frame[:3, 2]) - frame[:3, 3]) @ frame[:3, :3])

        outline = self.project(board.outline() @ frame[:3, :3].T + frame[:3, 3])
        (left, top), (right, bottom) = outline.min(axis=0), outline.max(axis=0)
        box = self._box((left + right) / 2, (top + bottom) / 2, (right - left) / 2 + 2, (bottom - top) / 2 + 2)
        picture = self.background.copy()
        if box is not None:
            pixels = self._grid[box]
            grey = supersampled(pixels, lambda at: board.grey(point_at(at)), 3) * self.illumination[box]
            seen = board.covers(point_at(pixels))
            picture[box] = np.where(seen, np.clip(np.rint(grey), 0, 255).astype(np.uint8), picture[box])
        return self._expose(picture, light)

    def _expose(self, picture: Picture, light: float) -> Picture:
        """Light and noise over the whole image: a window of the noise field that the generator chooses."""
        row = int(self._rng.integers(NOISE_SIZE - self.height + 1))
        column = int(self._rng.integers(NOISE_SIZE - self.width + 1))
        window = slice(row, row + self.height), slice(column, column + self.width)
        if light == 1.0:  # the same sum in a third of the time
            cv2.add(picture, self._brighter[window], picture)
            return np.asarray(cv2.subtract(picture, self._darker[window], picture), np.uint8)
        noise = self._noise[window]
        return np.asarray(cv2.addWeighted(picture, light, noise, 1.0, -NOISE_ZERO), np.uint8)

    # Moving things

    def _paint_ball(self, picture: Picture, ball: Array, velocity: Array) -> None:
        foot = ball - LIGHT_DIRECTION * ((ball[2] - self.table.top) / LIGHT_DIRECTION[2])
        seen = self.to_camera(np.array((ball, ball + 0.5 * self.exposure * velocity, foot)))
        (u, v), (later_u, later_v), (foot_u, foot_v) = self._pixels(seen).tolist()
        travel_u, travel_v = later_u - u, later_v - v
        reach = 2.2 * self.ball_radius * self.focal / float(seen[0, 2])
        box = self._box(u, v, reach + abs(travel_u), reach + abs(travel_v))
        if box is None:
            return
        region = picture[box].astype(np.float32)
        if self.table.contains(foot[0], foot[1]) and 0.0 < ball[2] - self.table.top < 0.2:
            region *= _shadow(foot_u, foot_v, self.ball_radius * self.focal / float(seen[2, 2]), box)
        near = self._box(u, v, 0.6 * reach + 2.0 + abs(travel_u), 0.6 * reach + 2.0 + abs(travel_v))
        if near is not None:
            (top, left), (rows, columns) = (box[0].start, box[1].start), near
            part = region[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
            cover, shade = self._sphere(seen[0], self.rotation @ velocity, math.hypot(travel_u, travel_v), near)
            part *= 1.0 - cover
            part += shade * (BALL_GREY * self.illumination[near])
        picture[box] = np.rint(np.minimum(region, 255.0, out=region)).astype(np.uint8)

    def _sphere(
        self, centre: Array, velocity: Array, travel: float, box: tuple[slice, slice]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Part of each pixel that the ball covers, averaged over the exposure, and that part times its shading.

        Centre and velocity in the camera's frame; `travel`: half the ball's way in the image (px).
        """
        steps = 1 + 2 * math.ceil(travel)
        moments = ((np.arange(steps) + 0.5) / steps - 0.5) * self.exposure
        centres = (centre + moments[:, None] * velocity).astype(np.float32)
        rays, radius = self._rays[box], np.float32(self.ball_radius)
        shape, rays = rays.shape[:2], rays.reshape(-1, 3).T
        along = centres @ rays
        square = (centres * centres).sum(axis=1)[:, None] - along * along
        np.maximum(square, 0.0, out=square)
        cover = (radius - np.sqrt(square)) * (np.float32(self.focal) / centres[:, 2:]) + np.float32(0.5)
        np.minimum(np.maximum(cover, 0.0, out=cover), 1.0, out=cover)
        along -= np.sqrt(np.maximum(radius * radius - square, 0.0))  # now the distance of the ball's surface
        # the surface normal's part towards the lamp: (ray * distance - centre) . lamp / radius
        facing = (along * (self._lamp @ rays) - (centres @ self._lamp)[:, None]) / radius
        np.minimum(np.maximum(facing, 0.0, out=facing), 1.0, out=facing)
        shade = cover * (np.float32(0.70) + np.float32(0.30) * facing)
        share = np.full(steps, 1.0 / steps, np.float32)
        return (share @ cover).reshape(shape), (share @ shade).reshape(shape)

    def _box(self, u: float, v: float, reach_u: float, reach_v: float) -> tuple[slice, slice] | None:
        if not (np.isfinite(u) and np.isfinite(v)):
            return None
        left, right = max(0, int(u - reach_u)), min(self.width, int(u + reach_u) + 2)
        top, bottom = max(0, int(v - reach_v)), min(self.height, int(v + reach_v) + 2)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None

    # Arm and cup: patches of one grey level, the same as long as neither moves

    def _covers(self, arm_points: ArrayLike | None, arm_radii: ArrayLike, pose: Array | None) -> list[_Cover]:
        points = np.empty((0, 2, 3)) if arm_points is None else np.asarray(arm_points, float).reshape(-1, 2, 3)
        radii = np.asarray(arm_radii, float).ravel()
        key = points.tobytes() + radii.tobytes() + (b"" if pose is None else pose.tobytes())
        if key != self._covered[0]:
            arm = self._arm_covers(points, radii) if len(points) else []
            self._covered = key, arm + ([] if pose is None else self._cup_covers(pose))
        return self._covered[1]

    def _arm_covers(self, points: Array, radii: Array) -> list[_Cover]:
        """The hull of both ends' discs for each capsule that is in view."""
        if len(points) != len(radii):
            raise ValueError(f"{len(points)} capsules of the arm, but {len(radii)} radii")
        seen = self.to_camera(points)
        depth = seen[..., 2]
        discs = (radii[:, None] * self.focal / depth)[..., None, None] * CIRCLE
        rims = (self._pixels(seen)[:, :, None] + discs).reshape(len(points), -1, 2)
        # at or behind the lens: out of focus anyway
        sharp = (depth > 4.0 * radii[:, None]).all(axis=1)
        heights = points[..., 2].mean(axis=1)
        return [
            self._cover(rims[part], ARM_GREY, float(heights[part]))
            for part in np.flatnonzero(sharp & self._in_view(rims)).tolist()
        ]

    def _cup_covers(self, pose: Array) -> list[_Cover]:
        """The wall as the hull of both rims, then the dark mouth as far as it faces the camera."""
        seen = self.to_camera(self._cup_rings @ pose[:3, :3].T + pose[:3, 3])
        if seen[:, 2].min() < 0.1:
            return []
        pixels, height = self._pixels(seen), float(pose[2, 3])
        wall, mouth = pixels[: 2 * len(RING)], pixels[2 * len(RING) :]
        if not self._in_view(wall):
            return []
        covers = [self._cover(wall, CUP_GREY, height, cup=True)]
        if (self.position - pose[:3, 3]) @ pose[:3, 2] > 0.0:
            covers.append(self._cover(mouth, CUP_INSIDE_GREY, height, cup=True))
        return covers

    def _in_view(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether some of the box around pixels (..., n, 2) is in the image."""
        low, high = pixels.min(axis=-2), pixels.max(axis=-2)
        inside: NDArray[np.bool_] = ((high >= 0.0) & (low < (self.width, self.height))).all(axis=-1)
        return inside

    def _cover(self, pixels: Array, grey: float, height: float, cup: bool = False) -> _Cover:
        """The convex hull of pixels in its middle's light."""
        u, v = (pixels.sum(axis=0) / len(pixels)).tolist()
        light = self.illumination[min(max(int(v), 0), self.height - 1), min(max(int(u), 0), self.width - 1)]
        hull = np.asarray(cv2.convexHull(np.rint(pixels * 16).astype(np.int32)), np.int32)
        return _Cover(hull, grey * float(light), height, cup)

    def _fill(self, picture: Picture, covers: Sequence[_Cover]) -> None:
        for cover in covers:
            cv2.fillConvexPoly(picture, cover.hull, cover.grey, cv2.LINE_AA, 4)

    def _inside_cup(self, ball: Array, pose: Array) -> bool:
        local = (ball - pose[:3, 3]) @ pose[:3, :3]
        return bool(np.hypot(local[0], local[1]) < self.cup_radius and -self.cup_depth < local[2] < self.ball_radius)


def _shadow(u: float, v: float, size: float, box: tuple[slice, slice]) -> NDArray[np.float32]:
    """Factor on the light of the table around the ball: soft, the ball's `size` (px) wide, about the pixel (u, v)."""
    rows, columns = box
    du = (np.arange(columns.start, columns.stop, dtype=np.float32) - u) / size
    dv = (np.arange(rows.start, rows.stop, dtype=np.float32) - v) / size
    gap = (du * du)[None, :] + (dv * dv)[:, None]
    return np.asarray(1.0 - SHADOW_DEPTH * np.exp(gap * gap / -1.5), np.float32)


def _looking_down(camera: Mapping[str, Any]) -> Array:
    """Nominal camera-from-base rotation: straight down, image x along `image_x`."""
    right, down = np.asarray(camera["image_x"], float), np.array([0.0, 0.0, -1.0])
    return np.array([right, np.cross(down, right), down])
