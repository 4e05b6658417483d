"""An arm as a table of its joints: where its tool is, and joint positions that bring it there."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from petrobot.services.device import numbers

Array = NDArray[np.float64]
CLOSE: Final = 1e-7
"""Tolerance of a found pose (m and rad)."""
STEPS: Final = 80
"""Most steps of one search."""
STUCK: Final = 1e-6
"""Change of every joint below which a search goes no further (rad or m)."""
STEP: Final = 0.5
"""Longest step of a joint in one step of a search (rad or m)."""
PART: Final = 0.02, 0.004
"""Greatest distance between two poses of a straight way (rad and m)."""
JUMP: Final = 0.2
"""Change of a joint between two such places that shows a singularity (rad or m)."""


class JointChain:
    """An arm's joints, one after the other, as published tables have them.

    A pose is x, y, z (m) and a rotation vector (rad), in the frame of the base. Joint positions are
    in rad, of joints that slide in m.
    """

    def __init__(
        self,
        joints: Iterable[Mapping[str, Any]],
        tool: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """`joints`: a row for each joint, from the base on, with `name`, `limits` (lowest and
        highest position) and `slide = true` if it does not turn; and where it is, either

        - by `axis` (its direction) and `point` (any point on it, m) while all positions are 0, or
        - by Denavit-Hartenberg parameters `d`, `a` (m), `alpha`, `theta` (rad; those that are 0
          may be left out; the joint adds to `theta`, or to `d` if it slides).

        `tool`: pose of the tool in the last frame; without Denavit-Hartenberg parameters that is
        its pose while all positions are 0. Raises ValueError naming the joint and its key.
        """
        self.limits: dict[str, tuple[float, float]] = {}
        """Lowest and highest position by joint, as `JointMotion` takes them."""
        axes, points, slides = list[Array](), list[Array](), list[bool]()
        frame = np.eye(4)
        for row in joints:
            name = str(row.get("name", f"joint {len(axes) + 1}"))
            given = {"axis", "point"} if "axis" in row else {"d", "a", "alpha", "theta"}
            if unknown := set(row) - given - {"name", "limits", "slide"}:
                expected = "axis and point, or d, a, alpha and theta"
                raise ValueError(f"{name}: unknown keys {sorted(unknown)}; expected {expected}")
            low, high = numbers(row.get("limits"), 2, f"{name}.limits")
            if not low < high or name in self.limits:
                raise ValueError(f"{name}: expected limits [low, high], and each name once")
            self.limits[name] = low, high
            slides.append(bool(row.get("slide", False)))
            axis, point = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
            if "axis" in row:
                axis = numbers(row["axis"], 3, f"{name}.axis")
                point = numbers(row.get("point"), 3, f"{name}.point")
                if math.hypot(*axis) == 0.0:
                    raise ValueError(f"{name}.axis: expected a direction, found {axis}")
            axes.append(frame[:3, :3] @ np.array(axis) / math.hypot(*axis))
            points.append(frame[:3, :3] @ np.array(point) + frame[:3, 3])
            if "axis" not in row:
                keys = ("theta", "d", "a", "alpha")
                frame = frame @ _step(
                    *(numbers([row.get(k, 0.0)], 1, f"{name}.{k}")[0] for k in keys)
                )
        if not axes:
            raise ValueError("expected a row for each joint, found none")
        last = numbers(tool, 6, "tool")
        turns = [(k, k @ k) for k in map(_skew, axes)]
        self._rows = list(zip(points, axes, turns, slides, strict=True))
        self._slides = np.array(slides)[:, None]
        self._tip = frame[:3, :3] @ np.array(last[:3]) + frame[:3, 3]
        self._turn = frame[:3, :3] @ rotation_matrix(last[3:])
        self._low, self._high = np.array(list(self.limits.values())).T

    def tool(self, q: Sequence[float]) -> list[float]:
        """Return the tool's pose at these joint positions."""
        tip, turn, _, _ = self._at(q)
        return [*tip.tolist(), *rotation_vector(turn).tolist()]

    def point(self, q: Sequence[float]) -> list[float]:
        """Return where the tool is (x, y, z in m), as `JointMotion` takes it."""
        tip: list[float] = self._at(q)[0].tolist()
        return tip

    def _at(self, q: Sequence[float]) -> tuple[Array, Array, list[Array], list[Array]]:
        """Return the tool's point and rotation, and points and directions of the joints' axes
        (product of exponentials; Lynch and Park, Modern Robotics, chapter 4)."""
        turn, moved = np.eye(3), np.zeros(3)
        points, axes = [], []
        for value, (point, axis, (k, kk), slides) in zip(q, self._rows, strict=True):
            axes.append(turn @ axis)
            points.append(turn @ point + moved)
            if slides:
                moved = moved + value * axes[-1]
            else:
                c, s = math.cos(value), math.sin(value)
                turn = turn @ (np.eye(3) + s * k + (1.0 - c) * kk)
                moved = points[-1] - turn @ point
        return turn @ self._tip + moved, turn @ self._turn, points, axes

    def joints(
        self,
        pose: Sequence[float],
        near: Sequence[float],
        *,
        any_heading: bool = False,
        keep: Sequence[str] = (),
        starts: int = 1,
    ) -> list[float]:
        """Return joint positions within the limits whose tool has this pose.

        The search begins at the positions `near`, and then at `starts` - 1 others, always the same
        ones. `any_heading`: the pose may be turned about the vertical, for arms of less than six
        joints. Joints in `keep` stay as they are in `near`. Raises ValueError if nothing is found,
        with how near the tool comes.
        """
        moving = np.array([name not in keep for name in self.limits])
        first = np.clip(np.array(near, float), self._low, self._high)
        spread = np.random.default_rng(0).uniform(self._low, self._high, (starts - 1, len(first)))
        best = math.inf, 0.0
        for start in (first, *np.where(moving, spread, first)):
            q, off = self._search(pose, start, moving, any_heading)
            if max(off) < CLOSE:
                found: list[float] = q.tolist()
                return found
            best = min(best, off)
        x, y, z = pose[:3]
        raise ValueError(
            f"({x:.3f}, {y:.3f}, {z:.3f}) m: no joint positions within the limits were found that "
            f"bring the tool there with this rotation; nearest: {1e3 * best[0]:.1f} mm and "
            f"{best[1]:.3f} rad away"
        )

    def _search(
        self, pose: Sequence[float], q: Array, moving: NDArray[np.bool_], any_heading: bool
    ) -> tuple[Array, tuple[float, float]]:
        """Return where the search from `q` ends, and its distance to the pose (m and rad)."""
        goal, wanted = np.array(pose[:3], float), rotation_matrix(pose[3:])
        rows = 5 if any_heading else 6
        for count in range(STEPS + 1):
            tip, turn, points, axes = self._at(q.tolist())
            aside = wanted @ turn.T
            if any_heading:  # turn the goal about the vertical to the nearest rotation
                s, c = aside[0, 1] - aside[1, 0], aside[0, 0] + aside[1, 1]
                aside = rotation_matrix((0.0, 0.0, math.atan2(s, c))) @ aside
            miss = np.concatenate((goal - tip, rotation_vector(aside)))[:rows]
            off = float(np.abs(miss[:3]).max()), float(np.abs(miss[3:]).max())
            if max(off) < CLOSE or count == STEPS:
                break
            along, slides = np.array(axes), self._slides
            moves = np.where(slides, along, np.cross(along, tip - np.array(points)))
            jacobian = np.hstack((moves, np.where(slides, 0.0, along))).T[:rows]
            before, q = q, self._stepped(q, jacobian, miss, moving)
            if float(np.abs(q - before).max()) < STUCK:
                break
        return q, off

    def _stepped(self, q: Array, jacobian: Array, miss: Array, moving: NDArray[np.bool_]) -> Array:
        """Return the next positions: a Levenberg-Marquardt step whose damping falls with the square
        of the error (Sugihara, IEEE Trans. Robotics 27(5), 2011), without the joints that it would
        push against their limits."""
        damping = 0.5 * float(miss @ miss) + 1e-12
        free = moving.copy()
        while free.any():
            part = jacobian[:, free]
            step = np.zeros(len(q))
            step[free] = np.linalg.solve(
                part.T @ part + damping * np.eye(int(free.sum())), part.T @ miss
            )
            pushed = ((q <= self._low) & (step < 0.0)) | ((q >= self._high) & (step > 0.0))
            if not (pushed & free).any():
                break
            free &= ~pushed
        step *= min(1.0, STEP / max(1e-9, float(np.abs(step).max())))
        next_q: Array = np.clip(q + step, self._low, self._high)
        return next_q

    def line(self, pose: Sequence[float], q: Sequence[float]) -> list[list[float]]:
        """Return joint positions, from `q` on, along which the tool moves straight to a pose.
        Raises ValueError where it cannot pass: out of reach, or a singularity."""
        begin, way = self.tool(q), [list(map(float, q))]
        first = rotation_matrix(begin[3:])
        turn = rotation_vector(rotation_matrix(pose[3:]) @ first.T)
        length = math.dist(begin[:3], pose[:3])
        parts = max(2, math.ceil(math.hypot(*turn) / PART[0]), math.ceil(length / PART[1]))
        for share in np.arange(1, parts + 1) / parts:
            at = [a + share * (b - a) for a, b in zip(begin[:3], pose[:3], strict=True)]
            rotation = rotation_vector(rotation_matrix(share * turn) @ first)
            try:
                found = self.joints([*at, *rotation], way[-1])
            except ValueError:
                found = [math.inf]
            if max(abs(a - b) for a, b in zip(found, way[-1], strict=False)) > JUMP:
                x, y, z = at
                raise ValueError(f"the tool cannot pass x = {x:.3f}, y = {y:.3f}, z = {z:.3f} m")
            way.append(found)
        return way


def _step(theta: float, d: float, a: float, alpha: float) -> Array:
    """Return the next frame, seen from the one before (standard Denavit-Hartenberg)."""
    c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
    rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d]]
    return np.array([*rows, [0.0, 0.0, 0.0, 1.0]])


def _skew(axis: Sequence[float] | Array) -> Array:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_matrix(vector: Sequence[float] | Array) -> Array:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return np.eye(3)
    k = _skew((x / angle, y / angle, z / angle))
    turned: Array = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
    return turned


def rotation_vector(rotation: Array) -> Array:
    """Return the rotation vector of a rotation matrix, of at most pi rad."""
    r = rotation
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
