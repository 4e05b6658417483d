"""Where the gripper of an arm truly is: forward kinematics by joint axes, with the errors of one
installation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class TrueArm:
    """The axes of an arm as it is bolted down, all in the table's frame at joint angles of zero."""

    points: Vector
    """(n, 3) a point on each axis, m."""
    axes: Vector
    """(n, 3) unit vectors."""
    tip: Vector
    approach: Vector
    closing: Vector
    offsets: Vector
    """(n,) rad by which each joint stands beside what its encoder says."""

    def frames(self, joints: Sequence[float]) -> tuple[Vector, Vector]:
        """Return rotation and translation of the last link (product of exponentials)."""
        rotation, moved = np.eye(3), np.zeros(3)
        for angle, point, axis in zip(
            np.asarray(joints) + self.offsets, self.points, self.axes, strict=True
        ):
            turned = rotate(axis, float(angle))
            moved = moved + rotation @ (point - turned @ point)
            rotation = rotation @ turned
        return rotation, moved

    def tool(self, joints: Sequence[float]) -> ToolPose:
        """Return where the fingers are."""
        rotation, moved = self.frames(joints)
        x, y, z = (rotation @ self.tip + moved).tolist()
        closing, approach = rotation @ self.closing, rotation @ self.approach
        return ToolPose(
            x,
            y,
            z,
            math.atan2(closing[1], closing[0]),
            math.acos(max(-1.0, min(1.0, -float(approach[2])))),
        )

    def links(self, joints: Sequence[float]) -> list[tuple[float, float, float]]:
        """Return the points of the joints and of the finger tips, for the camera."""
        rotation, moved = np.eye(3), np.zeros(3)
        found = []
        for angle, point, axis in zip(
            np.asarray(joints) + self.offsets, self.points, self.axes, strict=True
        ):
            found.append(tuple((rotation @ point + moved).tolist()))
            turned = rotate(axis, float(angle))
            moved = moved + rotation @ (point - turned @ point)
            rotation = rotation @ turned
        found.append(tuple((rotation @ self.tip + moved).tolist()))
        return found


def rotate(axis: Vector, angle: float) -> Vector:
    """Return the rotation by `angle` rad about a unit vector (Rodrigues)."""
    x, y, z = axis
    k = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    turned: Vector = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
    return turned


def true_arm(
    numbers: Mapping[str, Any], errors: Mapping[str, Any], rng: np.random.Generator
) -> TrueArm:
    """Return an arm whose base and joint zeros are off as `errors` says (standard deviations).
    Raises KeyError for a number that is missing."""
    base = np.asarray(numbers["base"]["position"], float)
    yaw = float(numbers["base"]["yaw"]) + float(rng.normal(0.0, errors["base_yaw"]))
    base = base + np.append(rng.normal(0.0, errors["base"], 2), rng.normal(0.0, errors["base_z"]))
    turn = rotate(np.array((0.0, 0.0, 1.0)), yaw)
    joints = numbers["joints"]
    tool = numbers["tool"]
    return TrueArm(
        np.array([turn @ np.asarray(j["point"], float) + base for j in joints]),
        np.array([turn @ np.asarray(j["axis"], float) for j in joints]),
        turn @ np.asarray(tool["tip"], float) + base,
        turn @ np.asarray(tool["approach"], float),
        turn @ np.asarray(tool["closing"], float),
        rng.normal(0.0, errors["joint_zero"] * float(numbers.get("zero_error", 1.0)), len(joints)),
    )
