"""The simulated camera: a pinhole with lens distortion looks at the cell and returns grey images
like a real one.

The static scene is drawn once. Each image copies it, paints ball, shadow, arm and cup into their
regions, and adds light and noise in one pass. Geometry: pinhole with Brown's distortion (1966) in
OpenCV's order k1 k2 p1 p2; the ball is an exact sphere (its distance from each pixel's ray),
blurred over the exposure. Lengths in m, base frame; pixels are (u, v), u to the right, whole
numbers at pixel centres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from petrobot.sim.catching.scenery import (
    Box,
    Chessboard,
    Occluders,
    TableArea,
    fill,
    floor_grey,
    stripes,
    supersampled,
)

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

BALL_GREY = 215.0
SHADOW_DEPTH = 0.35
"""Share of the light that the ball takes from the table right below it."""
NOISE_ZERO = 128
NOISE_SIZE = 1280
LIGHT_DIRECTION = np.array([-0.25, 0.35, 0.90]) / np.linalg.norm([-0.25, 0.35, 0.90])
"""Direction to the lamp, base frame."""
_TO_LAMP: Sequence[float] = LIGHT_DIRECTION.tolist()
BRIDGE_HEIGHT = 0.15
"""Height above the table (m)."""
BRIDGE_GREY = 40.0
LENS_STEPS = 6
"""Steps of the fixed-point inverse of the distortion."""


class CameraView(Struct, frozen=True):
    """True pose, lens and light of the camera, where they differ from the cell's nominal ones.
    None: nominal."""

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
    """Height of the table top (m)."""
    near_edge: float | None = None
    """x of the near edge (m)."""
    light_gradient: Sequence[float] = (-0.50, 0.10)
    """Relative change of the light from one side of the image to the other, along u and v: the far
    end is dimmer."""
    vignetting: float = 0.20
    """Relative loss of light in the corners of the image."""
    noise: float | None = None
    """Grey levels, sigma."""
    hidden: tuple[float, float] | None = None
    """m, x from and to: a bridge over the table, `BRIDGE_HEIGHT` above it, hides what is below."""

    @classmethod
    def of(cls, truth: Mapping[str, Any]) -> CameraView:
        """Read a mapping with these names as keys. Raises ValueError for an unknown key."""
        known = cls.__struct_fields__
        unknown = sorted(set(truth) - set(known))
        if unknown:
            raise ValueError(
                f"camera truth: unknown key {unknown[0]!r}; known are {', '.join(known)}"
            )
        return cls(**truth)


class PinholeCamera:
    """The camera of the simulated laboratory. The same generator state and the same calls return
    the same images."""

    def __init__(
        self, cell: Mapping[str, Any], truth: Mapping[str, Any], rng: np.random.Generator
    ) -> None:
        camera, view = cell["camera"], CameraView.of(truth)
        self.view = view
        self.width, self.height = int(camera["width"]), int(camera["height"])
        self.table = TableArea.of(cell, view.table_top, view.near_edge)
        self.ball_radius = float(cell["ball"]["radius"])
        self.cup_radius, self.cup_depth = float(cell["cup"]["radius"]), float(cell["cup"]["depth"])
        self.exposure = float(camera["exposure"])
        self.focal = float(camera["focal_px"] if view.focal_px is None else view.focal_px)
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        self.cx, self.cy = (
            float(c) for c in (middle if view.principal_px is None else view.principal_px)
        )
        self.distortion: Array = np.asarray(
            camera["distortion"] if view.distortion is None else view.distortion, float
        )
        self.position: Array = np.asarray(
            camera["position"] if view.position is None else view.position, float
        )
        self.rotation: Array = (
            _looking_down(camera) if view.rotation is None else np.asarray(view.rotation, float)
        )
        self._rng = rng
        self._lamp = (self.rotation @ LIGHT_DIRECTION).astype(np.float32)
        self._turn: list[list[float]] = self.rotation.tolist()
        self._at: list[float] = self.position.tolist()
        self._bend: list[float] = self.distortion.tolist()
        self._occluders = Occluders(self, self.cup_radius, self.cup_depth)
        sigma = float(camera["noise"] if view.noise is None else view.noise)
        field = NOISE_ZERO + sigma * rng.standard_normal((NOISE_SIZE, NOISE_SIZE), np.float32)
        self._noise: Picture = np.clip(np.rint(field), 0, 255).astype(np.uint8)
        self._grain: Picture = self._noise - np.uint8(NOISE_ZERO)
        """The noise to add, modulo 256."""

    def reseed(self, rng: np.random.Generator) -> None:
        """Choose noise with another generator from now on."""
        self._rng = rng

    # Geometry

    def to_camera(self, points: ArrayLike) -> Array:
        """Return base-frame points (..., 3) in the camera's frame."""
        return np.asarray((np.asarray(points, float) - self.position) @ self.rotation.T)

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (..., 2) of base-frame points (..., 3)."""
        return self._pixels(self.to_camera(points))

    def pixel(self, point: Sequence[float]) -> tuple[float, float, float]:
        """Return pixel (u, v) of one base-frame point (3,) and its depth (m): as `project`, in
        plain floats."""
        ax, ay, az = point[0] - self._at[0], point[1] - self._at[1], point[2] - self._at[2]
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._turn
        depth = ax * zx + ay * zy + az * zz
        x, y = (ax * xx + ay * xy + az * xz) / depth, (ax * yx + ay * yy + az * yz) / depth
        k1, k2, p1, p2 = self._bend
        square = x * x + y * y
        radial = 1.0 + square * (k1 + k2 * square)
        u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return self.focal * u + self.cx, self.focal * v + self.cy, depth

    def _pixels(self, seen: Array) -> Array:
        """Return pixels (..., 2) of points (..., 3) in the camera's frame."""
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
        """Return the unit directions (..., 3), camera frame, in which pixels (..., 2) look;
        fixed-point inverse of the distortion."""
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
        direction = np.empty((*x.shape, 3))
        length = np.sqrt(x * x + (y * y + 1.0))
        direction[..., 0], direction[..., 1], direction[..., 2] = (
            x / length,
            y / length,
            1.0 / length,
        )
        return direction

    def _on_plane(self, pixels: Array, origin: Array, normal: Array) -> Array:
        """Return base-frame points (..., 3) where pixels look through a plane."""
        return self._through(self.rays(pixels) @ self.rotation, origin, normal)

    def _through(self, direction: Array, origin: Array, normal: Array) -> Array:
        """Return points (..., 3) where base-frame directions (..., 3) from the optical centre meet
        a plane."""
        distance = ((origin - self.position) @ normal) / (direction @ normal)
        return np.asarray(self.position + distance[..., None] * direction)

    # Static scene

    @cached_property
    def _grid(self) -> Array:
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return np.stack([u, v], axis=-1)

    @cached_property
    def _rays(self) -> NDArray[np.float32]:
        """Unit directions (3, height, width), camera frame, in which the pixels look."""
        rays = np.empty((3, self.height, self.width), np.float32)
        for rows in stripes(self.height):
            rays[:, rows] = np.moveaxis(self.rays(self._grid[rows]), -1, 0)
        return rays

    @cached_property
    def _to_lamp(self) -> NDArray[np.float32]:
        """Component of those directions towards the lamp (height, width)."""
        return np.asarray(np.tensordot(self._lamp, self._rays, 1), np.float32)

    @cached_property
    def illumination(self) -> NDArray[np.float32]:
        """Relative light (height, width): gradient and vignetting."""
        u = (self._grid[..., 0] - (self.width - 1) / 2) / self.width
        v = (self._grid[..., 1] - (self.height - 1) / 2) / self.height
        gradient = 1.0 + self.view.light_gradient[0] * u + self.view.light_gradient[1] * v
        return (gradient * (1.0 - self.view.vignetting * 2.0 * (u * u + v * v))).astype(np.float32)

    @cached_property
    def _ball_grey(self) -> NDArray[np.float32]:
        """Grey level of a ball that faces the lamp (height, width)."""
        return BALL_GREY * self.illumination

    def _scene_grey(self, pixels: Array) -> Array:
        up = np.array([0.0, 0.0, 1.0])
        direction = self.rays(pixels) @ self.rotation
        table = self._through(direction, np.array([0.0, 0.0, self.table.top]), up)
        on_table = self.table.contains(table[..., 0], table[..., 1])
        floor = self._through(direction[~on_table], np.zeros(3), up)
        grey = np.empty(on_table.shape)
        grey[on_table] = self.table.grey(table[on_table, 0], table[on_table, 1])
        grey[~on_table] = floor_grey(floor[..., 0], floor[..., 1])
        if self.view.hidden is None:
            return grey
        return np.where(self._below_bridge(direction), BRIDGE_GREY, grey)

    def _below_bridge(self, direction: Array) -> NDArray[np.bool_]:
        """Return which base-frame directions (..., 3) from the optical centre meet the bridge."""
        low, high = self.view.hidden or (0.0, 0.0)
        above = np.array([0.0, 0.0, self.table.top + BRIDGE_HEIGHT])
        point = self._through(direction, above, np.array([0.0, 0.0, 1.0]))
        across = 0.5 * self.table.width + 0.1
        met: NDArray[np.bool_] = (
            (point[..., 0] >= low) & (point[..., 0] <= high) & (np.abs(point[..., 1]) <= across)
        )
        return met

    @cached_property
    def _bridge(self) -> NDArray[np.bool_] | None:
        """Pixels (height, width) that see the bridge; None without one."""
        if self.view.hidden is None:
            return None
        return self._below_bridge(self.rays(self._grid) @ self.rotation)

    @cached_property
    def background(self) -> Picture:
        """The scene without ball, arm and cup, lit, without noise (height, width)."""
        grey = supersampled(self._grid, self._scene_grey, 2) * self.illumination
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    # Images

    def warm_up(self) -> None:
        """Make everything that is made once: in real time the first image must not take longer than
        the others."""
        _ = self.background, self._canvas, self._to_lamp, self._bridge

    def render(
        self,
        ball: ArrayLike | None,
        ball_velocity: ArrayLike = (0.0, 0.0, 0.0),
        arm_points: ArrayLike | None = None,
        arm_radii: ArrayLike = (),
        cup_pose: ArrayLike | None = None,
        light: float = 1.0,
        others: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    ) -> Picture:
        """Return one image (height, width) uint8. `others`: centres and velocities of further
        balls, away from arm and cup.

        ball: centre at mid-exposure (3,) m, None: no ball; ball_velocity (3,) m/s; arm_points (n,
        2, 3): both ends of each capsule of the arm, arm_radii (n,) m; cup_pose (4, 4): the cup's
        mouth centre with z out of the mouth; light: factor.
        """
        pose = None if cup_pose is None else np.asarray(cup_pose, float)
        points = (
            np.empty((0, 2, 3))
            if arm_points is None
            else np.asarray(arm_points, float).reshape(-1, 2, 3)
        )
        covers = self._occluders.covers(points, np.asarray(arm_radii, float).ravel(), pose)
        changed = [cover.box for cover in covers]
        glaring = [cover.box for cover in covers if not self._bears_noise(cover.grey)]
        picture = self._canvas
        for other, speed in others:
            box = self._paint_ball(picture, np.asarray(other, float), np.asarray(speed, float))
            if box is not None:
                changed.append(box)
                glaring.append(box)
        if ball is None:
            fill(picture, covers)
        else:
            centre = np.asarray(ball, float)
            in_cup = pose is not None and self._inside_cup(centre, pose)
            above = [
                cover for cover in covers if cover.height > centre[2] and not (cover.cup and in_cup)
            ]
            fill(picture, [cover for cover in covers if cover not in above])
            box = self._paint_ball(picture, centre, np.asarray(ball_velocity, float))
            if box is not None:
                changed.append(box)
                glaring.append(box)
            fill(picture, above)
        if self._bridge is not None:
            for box in changed:
                picture[box] = np.where(self._bridge[box], self.background[box], picture[box])
        image = self._expose(picture, light, glaring)
        for box in changed:
            picture[box] = self.background[box]
        return image

    @cached_property
    def _canvas(self) -> Picture:
        """Copy of the background on which an image is painted; `render` restores what it
        changes."""
        return self.background.copy()

    @cached_property
    def _sound(self) -> bool:
        """Whether noise never takes the background beyond black or white, so that it may be added
        without a check."""
        return self._bears_noise(float(self.background.min())) and self._bears_noise(
            float(self.background.max())
        )

    @cached_property
    def _noise_range(self) -> tuple[int, int]:
        """Least and greatest grey level that noise adds."""
        return int(self._noise.min()) - NOISE_ZERO, int(self._noise.max()) - NOISE_ZERO

    def _bears_noise(self, grey: float) -> bool:
        """Return whether noise never takes this grey level, rounded either way, beyond black or
        white. Smooth edges lie between two such levels."""
        least, most = self._noise_range
        return math.floor(grey) + least >= 0 and math.ceil(grey) + most <= 255

    def render_board(self, pose: ArrayLike, board: Chessboard | None = None) -> Picture:
        """Return one image of a calibration board held at `pose` (4, 4), board frame to base frame;
        nothing else in view."""
        board = board or Chessboard()
        frame = np.asarray(pose, float)

        def point_at(pixels: Array) -> Array:
            return np.asarray(
                (self._on_plane(pixels, frame[:3, 3], frame[:3, 2]) - frame[:3, 3]) @ frame[:3, :3]
            )

        outline = self.project(board.outline() @ frame[:3, :3].T + frame[:3, 3])
        (left, top), (right, bottom) = outline.min(axis=0), outline.max(axis=0)
        box = self._box(
            (left + right) / 2, (top + bottom) / 2, (right - left) / 2 + 2, (bottom - top) / 2 + 2
        )
        picture = self.background.copy()
        if box is not None:
            pixels = self._grid[box]
            grey = (
                supersampled(pixels, lambda at: board.grey(point_at(at)), 3)
                * self.illumination[box]
            )
            seen = board.covers(point_at(pixels))
            picture[box] = np.where(
                seen, np.clip(np.rint(grey), 0, 255).astype(np.uint8), picture[box]
            )
        return self._expose(picture, 1.0, None)

    def _expose(self, picture: Picture, light: float, glaring: Sequence[Box] | None) -> Picture:
        """Add light and noise to the whole image; the generator chooses a window of the noise
        field.

        Outside the boxes `glaring` the picture tolerates noise as the background does (None: it may
        be arbitrarily bright or dark anywhere).
        """
        row = int(self._rng.integers(NOISE_SIZE - self.height + 1))
        column = int(self._rng.integers(NOISE_SIZE - self.width + 1))
        window = slice(row, row + self.height), slice(column, column + self.width)
        noise = self._noise[window]
        if light != 1.0 or glaring is None or not self._sound:
            return np.asarray(cv2.addWeighted(picture, light, noise, 1.0, -NOISE_ZERO), np.uint8)
        image = picture + self._grain[window]  # The same sum in a tenth of the time.
        for box in glaring:
            image[box] = cv2.addWeighted(picture[box], 1.0, noise[box], 1.0, -NOISE_ZERO)
        return image

    # Moving things

    def _paint_ball(self, picture: Picture, ball: Array, velocity: Array) -> Box | None:
        """Paint ball and shadow; return the box that they may have changed."""
        at, (lx, ly, lz), half = ball.tolist(), _TO_LAMP, 0.5 * self.exposure
        height = at[2] - self.table.top
        fall = height / lz
        foot = at[0] - lx * fall, at[1] - ly * fall, at[2] - lz * fall
        (u, v, depth), (foot_u, foot_v, foot_depth) = self.pixel(at), self.pixel(foot)
        later_u, later_v, _ = self.pixel(
            [p + half * w for p, w in zip(at, velocity.tolist(), strict=True)]
        )
        travel_u, travel_v = later_u - u, later_v - v
        reach = 2.2 * self.ball_radius * self.focal / depth
        box = self._box(u, v, reach + abs(travel_u), reach + abs(travel_v))
        if box is None:
            return None
        region = picture[box].astype(np.float32)
        if self.table.contains(foot[0], foot[1]) and 0.0 < height < 0.2:
            region *= _shadow(foot_u, foot_v, self.ball_radius * self.focal / foot_depth, box)
        near = self._box(u, v, 0.6 * reach + 2.0 + abs(travel_u), 0.6 * reach + 2.0 + abs(travel_v))
        if near is not None:
            (top, left), (rows, columns) = (box[0].start, box[1].start), near
            part = region[
                rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
            ]
            centre = self.rotation @ (ball - self.position)
            cover, shade = self._sphere(
                centre, self.rotation @ velocity, math.hypot(travel_u, travel_v), near
            )
            part *= 1.0 - cover
            part += shade * self._ball_grey[near]
        picture[box] = np.rint(np.minimum(region, 255.0, out=region), out=region)
        return box

    def _sphere(
        self, centre: Array, velocity: Array, travel: float, box: tuple[slice, slice]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the share of each pixel that the ball covers, averaged over the exposure, and that
        share times its shading.

        Centre and velocity in the camera's frame; `travel`: half the ball's path in the image (px).
        """
        steps = 1 + 2 * math.ceil(travel)
        moments = ((np.arange(steps) + 0.5) / steps - 0.5) * self.exposure
        centres = (centre + moments[:, None] * velocity).astype(np.float32)
        rays, to_lamp, radius = (
            self._rays[:, box[0], box[1]],
            self._to_lamp[box],
            np.float32(self.ball_radius),
        )
        shape, rays = to_lamp.shape, rays.reshape(3, -1)
        along = centres @ rays
        square = (centres * centres).sum(axis=1)[:, None] - along * along
        np.maximum(square, 0.0, out=square)
        cover = (radius - np.sqrt(square)) * (np.float32(self.focal) / centres[:, 2:]) + np.float32(
            0.5
        )
        np.minimum(np.maximum(cover, 0.0, out=cover), 1.0, out=cover)
        along -= np.sqrt(
            np.maximum(radius * radius - square, 0.0)
        )  # now the distance of the ball's surface
        # Lambert's law: the component of the surface normal towards the lamp, (ray * distance -
        # centre) . lamp / radius.
        facing = (along * to_lamp.ravel() - (centres @ self._lamp)[:, None]) / radius
        np.minimum(np.maximum(facing, 0.0, out=facing), 1.0, out=facing)
        shade = cover * (np.float32(0.70) + np.float32(0.30) * facing)
        share = np.full(steps, 1.0 / steps, np.float32)
        return (share @ cover).reshape(shape), (share @ shade).reshape(shape)

    def _box(self, u: float, v: float, reach_u: float, reach_v: float) -> Box | None:
        if not (math.isfinite(u) and math.isfinite(v)):
            return None
        left, right = max(0, int(u - reach_u)), min(self.width, int(u + reach_u) + 2)
        top, bottom = max(0, int(v - reach_v)), min(self.height, int(v + reach_v) + 2)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None

    def _inside_cup(self, ball: Array, pose: Array) -> bool:
        local = (ball - pose[:3, 3]) @ pose[:3, :3]
        return bool(
            np.hypot(local[0], local[1]) < self.cup_radius
            and -self.cup_depth < local[2] < self.ball_radius
        )


def _shadow(u: float, v: float, size: float, box: tuple[slice, slice]) -> NDArray[np.float32]:
    """Return the factor on the light of the table around the ball: soft, the ball's `size` (px)
    wide, about the pixel (u, v)."""
    rows, columns = box
    du = (np.arange(columns.start, columns.stop, dtype=np.float32) - u) / size
    dv = (np.arange(rows.start, rows.stop, dtype=np.float32) - v) / size
    gap = (du * du)[None, :] + (dv * dv)[:, None]
    return np.asarray(1.0 - SHADOW_DEPTH * np.exp(gap * gap / -1.5), np.float32)


def _looking_down(camera: Mapping[str, Any]) -> Array:
    """Return the nominal camera-from-base rotation: straight down, image x along `image_x`."""
    right, down = np.asarray(camera["image_x"], float), np.array([0.0, 0.0, -1.0])
    return np.array([right, np.cross(down, right), down])
