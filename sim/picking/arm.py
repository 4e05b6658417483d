"""The true pose of an arm's gripper: forward kinematics by joint axes, with the errors of one
installation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class ToolPose(NamedTuple):
    """The middle between the finger tips in the table's frame (m), the direction in which the
    fingers close (rad, seen from above), and how far they point from straight down (rad)."""

    x: float
    y: float
    z: float
    turn: float
    tilt: float


class TrueArm:
    """An arm as it is really mounted, all in the table's frame at joint angles of zero."""

    def __init__(
        self,
        points: Vector,
        axes: Vector,
        tool: tuple[Vector, Vector, Vector],
        offsets: Sequence[float],
    ) -> None:
        """`points`, `axes` (n, 3): a point on each axis, and its unit vector; `tool`: tip, approach
        and closing direction; `offsets`: error of each joint's encoder (rad)."""
        self._tip, self._approach, self._closing = tool
        self._offsets = list(offsets)
        self._points = list(points)
        self._turns = [(k, k @ k) for k in map(_skew, axes)]
        self._last: tuple[list[float], list[Vector], Vector] | None = None

    def _chain(self, joints: Sequence[float]) -> tuple[list[Vector], Vector]:
        """Return the positions of the joints and the tip, and the rotation of the last link
        (product of exponentials)."""
        angles = [a + b for a, b in zip(joints, self._offsets, strict=True)]
        if self._last is not None and self._last[0] == angles:
            return self._last[1:]
        rotation, moved = _UNIT, np.zeros(3)
        places = []
        for angle, point, (k, kk) in zip(angles, self._points, self._turns, strict=True):
            place = rotation @ point + moved
            places.append(place)
            rotation = rotation @ (_UNIT + math.sin(angle) * k + (1.0 - math.cos(angle)) * kk)
            moved = place - rotation @ point
        places.append(rotation @ self._tip + moved)
        self._last = angles, places, rotation
        return places, rotation

    def tool(self, joints: Sequence[float]) -> ToolPose:
        """Return the pose of the fingers."""
        places, rotation = self._chain(joints)
        x, y, z = places[-1].tolist()
        closing, approach = rotation @ self._closing, rotation @ self._approach
        return ToolPose(
            x,
            y,
            z,
            math.atan2(closing[1], closing[0]),
            math.acos(max(-1.0, min(1.0, -float(approach[2])))),
        )

    def links(self, joints: Sequence[float]) -> list[list[float]]:
        """Return the points of the joints and of the finger tips, for the camera."""
        return [place.tolist() for place in self._chain(joints)[0]]


_UNIT = np.eye(3)


def _skew(axis: Vector) -> Vector:
    x, y, z = axis
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def true_arm(
    numbers: Mapping[str, Any], errors: Mapping[str, Any], rng: np.random.Generator
) -> TrueArm:
    """Return an arm whose base and joint zeros are off as `errors` says (standard deviations).
    Raises KeyError for a number that is missing."""
    base = np.asarray(numbers["base"]["position"], float)
    yaw = float(numbers["base"]["yaw"]) + float(rng.normal(0.0, errors["base_yaw"]))
    base = base + np.append(rng.normal(0.0, errors["base"], 2), rng.normal(0.0, errors["base_z"]))
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    joints = numbers["joints"]
    zero = float(errors["joint_zero"]) * float(numbers.get("zero_error", 1.0))
    tool = numbers["tool"]
    return TrueArm(
        np.array([turn @ np.asarray(j["point"], float) + base for j in joints]),
        np.array([turn @ np.asarray(j["axis"], float) for j in joints]),
        (
            turn @ np.asarray(tool["tip"], float) + base,
            turn @ np.asarray(tool["approach"], float),
            turn @ np.asarray(tool["closing"], float),
        ),
        rng.normal(0.0, zero, len(joints)).tolist(),
    )
