"""A chessboard floor with a track, painted and photographed here, independent of the laboratory."""

from __future__ import annotations

import math

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.mobile.detection import FloorView
from petrobot.services.mobile.model import nominal_rover

Vector = NDArray[np.float64]
TURN = {"S": 0, "L": 1, "R": -1}


class DrawnPose(Struct, frozen=True):
    """A place on the floor (m) and a heading (rad)."""

    x: float
    y: float
    heading: float

    def moved(self, forward: float, left: float = 0.0, turn: float = 0.0) -> DrawnPose:
        """The pose that lies there as seen from this one."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return DrawnPose(
            self.x + forward * cos - left * sin,
            self.y + forward * sin + left * cos,
            self.heading + turn,
        )


class DrawnFloor:
    """Elements ("S", "L", "R"; lower case: unpainted) from (0, 0) along x; squares of 2 m with
    their first edge there.

    `inverted` swaps black and white; `bar` ends the last element, a straight one, in a T 0.25 m
    before its square's edge.
    """

    def __init__(
        self, elements: str, *, inverted: bool = False, bar: bool = False, width: float = 0.05
    ) -> None:
        self.inverted, self.bar, self.width = inverted, bar, width
        self.elements = []
        pose = DrawnPose(0.0, 0.0, 0.0)
        for letter in elements:
            turn = TURN[letter.upper()]
            self.elements.append((letter, pose))
            pose = (
                pose.moved(2.0) if turn == 0 else pose.moved(1.0, float(turn), turn * math.pi / 2)
            )
        self.end = pose
        self.t = pose.moved(-0.25)

    def at(self, s: float, aside: float = 0.0, turn: float = 0.0) -> DrawnPose:
        """The pose `s` metres along the centre line, `aside` m to its left, turned by `turn`
        rad."""
        for letter, pose in self.elements:
            bend = TURN[letter.upper()]
            length = 2.0 if bend == 0 else math.pi / 2
            if s <= length + 1e-9:
                if bend == 0:
                    return pose.moved(s).moved(0.0, aside, turn)
                return pose.moved(math.sin(s), bend * (1.0 - math.cos(s)), bend * s).moved(
                    0.0, aside, turn
                )
            s -= length
        return self.end.moved(s, aside, turn)

    def white(self, x: Vector, y: Vector) -> NDArray[np.bool_]:
        """Colour at points of the floor."""
        i, j = np.floor(x / 2.0), np.floor((y + 1.0) / 2.0)
        colour = ((i + j) % 2 == 0) ^ self.inverted
        marked = np.zeros_like(colour)
        for letter, pose in self.elements:
            if letter.islower():
                continue
            u, w = _body(pose, x, y)
            inside = (u >= 0.0) & (u < 2.0) & (np.abs(w) <= 1.0)
            bend = TURN[letter]
            off = np.abs(w) if bend == 0 else np.abs(np.hypot(u, 1.0 - bend * w) - 1.0)
            marked |= inside & (off <= 0.5 * self.width)
        if self.bar:
            u, w = _body(self.t, x, y)
            marked &= ~((u > 0.0) & (u < 0.25) & (np.abs(w) < 0.1))
            marked |= (u <= 0.0) & (u >= -0.05) & (np.abs(w) <= 0.25)
        result: NDArray[np.bool_] = colour ^ marked
        return result


def _body(pose: DrawnPose, x: Vector, y: Vector) -> tuple[Vector, Vector]:
    dx, dy = x - pose.x, y - pose.y
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    return dx * cos + dy * sin, dy * cos - dx * sin


class Photographer:
    """Takes images of a floor with the nominal camera: each pixel is the mean of 2 x 2 spots, then
    noise."""

    def __init__(self, noise: float = 3.0, black: float = 40.0, white: float = 200.0) -> None:
        self.view = FloorView(nominal_rover().camera)
        self.noise, self.black, self.white = noise, black, white
        fine = np.array([-0.25, 0.25])
        u = (np.arange(self.view.width)[:, None] + fine).ravel()
        v = (np.arange(self.view.height)[:, None] + fine).ravel()
        self._x, self._y = self.view.points(u[None, :], v[:, None])

    def __call__(
        self, floor: DrawnFloor, pose: DrawnPose, random: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Grey levels (height, width) from a pose of the rover."""
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        x = pose.x + self._x * cos - self._y * sin
        y = pose.y + self._x * sin + self._y * cos
        light = floor.white(x, y).astype(float)
        high, wide = self.view.height, self.view.width
        light = light.reshape(high, 2, wide, 2).mean(axis=(1, 3))
        grey = self.black + (self.white - self.black) * light
        noisy = np.rint(grey + random.normal(0.0, self.noise, grey.shape))
        image: NDArray[np.uint8] = np.clip(noisy, 0, 255).astype(np.uint8)
        return image
