"""Forward and inverse kinematics of UR arms.

Denavit-Hartenberg parameters: Universal Robots, "DH Parameters for calculations of kinematics and
dynamics" (support article 16538). A robot's own calibration differs by a few tenths of a
millimetre. Poses are x, y, z (m) and a rotation vector (rad) in the base frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# d1, a2, a3, d4, d5, d6 (m)
MODELS = {
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
}
TWISTS = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
CLOSE = 1e-7
"""Tolerance of a solution (m and rad)."""


class Geometry:
    """A model with a tool point `tool` (m, in the flange's frame)."""

    def __init__(self, model: str, tool: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        d1, a2, a3, d4, d5, d6 = MODELS[model]
        self._d, self._a = (d1, 0.0, 0.0, d4, d5, d6), (0.0, a2, a3, 0.0, 0.0, 0.0)
        self._tool = np.array([*tool, 1.0])

    def _frames(self, q: Sequence[float]) -> list[Array]:
        frames = [np.eye(4)]
        for angle, d, a, twist in zip(q, self._d, self._a, TWISTS, strict=True):
            c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(twist), math.sin(twist)
            step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d]]
            frames.append(frames[-1] @ np.array([*step, [0, 0, 0, 1]]))
        return frames

    def tool(self, q: Sequence[float]) -> list[float]:
        """Return the pose of the tool point in a joint pose (rad)."""
        last = self._frames(q)[-1]
        return [*(last @ self._tool)[:3].tolist(), *_vector(last[:3, :3]).tolist()]

    def joints(self, pose: Sequence[float], near: Sequence[float]) -> list[float] | None:
        """Return the joints (rad) whose tool has this pose, reached from `near` without passing a
        singularity; None if there are none (damped Newton steps on the geometric Jacobian)."""
        goal, turn, q = np.asarray(pose[:3], float), _matrix(pose[3:]), np.array(near, float)
        for _ in range(60):
            frames = self._frames(q.tolist())
            at = (frames[-1] @ self._tool)[:3]
            miss = np.concatenate([goal - at, _vector(turn @ frames[-1][:3, :3].T)])
            if float(np.abs(miss).max()) < CLOSE:
                found: list[float] = q.tolist()
                return found
            axes = [frame[:3, 2] for frame in frames[:-1]]
            columns = [
                np.concatenate([np.cross(axis, at - frame[:3, 3]), axis])
                for axis, frame in zip(axes, frames, strict=False)
            ]
            jacobian = np.array(columns).T
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-9 * np.eye(6), miss)
            q += step * min(1.0, 0.5 / max(1e-9, float(np.abs(step).max())))
        return None


def between(start: Sequence[float], end: Sequence[float], share: float) -> list[float]:
    """Return the pose at a share (0 to 1) of the straight line from one pose to another."""
    place = [a + share * (b - a) for a, b in zip(start[:3], end[:3], strict=True)]
    first = _matrix(start[3:])
    turn = _vector(_matrix(end[3:]) @ first.T)
    return [*place, *_vector(_matrix((share * turn).tolist()) @ first).tolist()]


def _matrix(vector: Sequence[float]) -> Array:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return np.eye(3)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / angle
    turned: Array = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
    return turned


def _vector(rotation: Any) -> Array:
    """Return the rotation vector of a rotation matrix, of at most pi rad."""
    r = np.asarray(rotation)
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine, cosine = 0.5 * float(np.linalg.norm(axis)), 0.5 * (float(np.trace(r)) - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > 1e-7:
        return axis * (angle / (2.0 * sine))
    if cosine > 0.0:
        return 0.5 * axis
    # Half a turn: the axis is a column of (r + 1) / 2, the longest one.
    half = 0.5 * (r + np.eye(3))
    column = half[:, int(np.argmax(np.diag(half)))]
    found: Array = column / np.linalg.norm(column) * angle
    return found
