"""The gripper of an arm: its true pose, by forward kinematics with the errors of one installation,
and the effects of its two fingers on a part, which they push, turn, hold, or let slip.

The effects happen in the gripper's frame, seen from above: x is the closing direction, y along the
fingers' width, the origin in the middle between them. A part is held only if both fingers stop on
it; how firmly depends on friction, contact width and depth:

    capacity = 2 mu F min(1, contact width / full) min(1, depth / full depth)

A part whose weight and acceleration exceed the capacity slips, and falls when it has slipped out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.sim.picking.parts import Part, Point, clipped

# --- its true pose ---

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


# --- its fingers ---

PAD: Final = 2e-4
"""How far the rubber of the pads gives way (m): everything within this distance of the front-most
point is in contact."""
FULL_WIDTH: Final = 0.006
"""Contact width from which a grip is as firm as friction allows (m)."""
FULL_DEPTH: Final = 0.006
"""Height of a part between the fingers from which a grip is as firm as friction allows (m)."""
_TURNS: Final = 24
"""Most steps in which closing fingers turn or push a part in one tick."""
_LARGEST_TURN: Final = math.radians(2.0)


class Fingers(Struct, frozen=True):
    """Sizes of a gripper (m): greatest gap, and a finger's size along and across the closing
    direction."""

    opening: float
    thickness: float
    width: float


class Span(NamedTuple):
    """A part's extent between the fingers: its lowest and highest x (m), the middle of what touches
    there (y), and the lengths of the two contacts."""

    low: float
    high: float
    at_low: float
    at_high: float
    contact: float

    @property
    def size(self) -> float:
        """Return the least gap of the fingers (m)."""
        return self.high - self.low


def span(outline: list[Point], half: float) -> Span | None:
    """Return the extent of an outline (gripper's frame) within the fingers' width; None if it is
    outside."""
    inside = clipped(outline, half)
    if len(inside) < 3:
        return None
    low, high = min(p[0] for p in inside), max(p[0] for p in inside)
    left = _touching(inside, low, 1.0)
    right = _touching(inside, high, -1.0)
    return Span(
        low,
        high,
        (left[0] + left[1]) / 2,
        (right[0] + right[1]) / 2,
        min(left[1] - left[0], right[1] - right[0]),
    )


def _touching(outline: list[Point], front: float, inwards: float) -> tuple[float, float]:
    """Return the range of y in which an outline is within PAD of its front-most x."""
    limit = front + inwards * PAD
    ys: list[float] = []
    for k, (x1, y1) in enumerate(outline):
        x0, y0 = outline[k - 1]
        near0, near1 = (x0 - limit) * inwards <= 0.0, (x1 - limit) * inwards <= 0.0
        if near1:
            ys.append(y1)
        if near0 is not near1:
            ys.append(y0 + (limit - x0) / (x1 - x0) * (y1 - y0))
    return min(ys), max(ys)


class Grip(NamedTuple):
    """A part stopped between the fingers: its size there (m), and the share of 2 mu F that holds
    it."""

    size: float
    firmness: float


def close_on(part: Part, frame: tuple[float, float, float], gap: float, f: Fingers) -> Grip | None:
    """Let fingers that are `gap` m apart act on a part; `frame` is the pose of the gripper (x, y,
    turn). Moves the part; returns a Grip if it stops the fingers.

    A single finger pushes. Two fingers turn the part while the line between their contacts is
    outside the friction cone, squeeze it out sideways while they touch slanting sides, and are
    otherwise stopped by it.
    """
    for _ in range(_TURNS):
        shape = _local(part, frame)
        held = span(shape, f.width / 2)
        if held is None or abs(held.low + held.high) > gap:
            return None  # less than half of it is between the fingers
        left, right = -gap / 2 - held.low, held.high - gap / 2
        if left <= 1e-9 and right <= 1e-9:
            return None
        if held.size <= gap + 1e-9 and (left <= 0.0 or right <= 0.0):
            if left > 0.0:
                _push(part, frame, 1.0, left, (held.low, held.at_low))
            else:
                _push(part, frame, -1.0, right, (held.high, held.at_high))
            continue
        excess = held.size - gap
        wedge = _slope(shape, f.width / 2)
        if abs(wedge) > part.friction:
            _shift(part, frame, -math.copysign(min(excess / 2 / abs(wedge), 0.002) + 1e-5, wedge))
            continue
        lever = held.at_high - held.at_low
        if abs(math.atan2(lever, held.size)) > math.atan(part.friction):
            part.turn += math.copysign(min(excess / abs(lever) + 1e-4, _LARGEST_TURN), lever)
            continue
        _shift_along(part, frame, -(held.low + held.high) / 2)
        width = FULL_WIDTH if part.round else held.contact
        return Grip(held.size, min(1.0, max(width, 5e-4) / FULL_WIDTH))
    return None


def _slope(shape: list[Point], half: float) -> float:
    """Return half of the growth of the extent per m that the part moves along y: the tangent of the
    slant of the two sides that the fingers touch."""
    step = 2e-4
    ahead = span([(x, y + step) for x, y in shape], half)
    behind = span([(x, y - step) for x, y in shape], half)
    if ahead is None or behind is None:
        return math.copysign(math.inf, 1.0 if behind is None else -1.0)
    return (ahead.size - behind.size) / (4 * step)


def _local(part: Part, frame: tuple[float, float, float]) -> list[Point]:
    c, s = math.cos(frame[2]), math.sin(frame[2])
    return [
        (c * (x - frame[0]) + s * (y - frame[1]), -s * (x - frame[0]) + c * (y - frame[1]))
        for x, y in part.outline()
    ]


def _push(
    part: Part, frame: tuple[float, float, float], sign: float, distance: float, at: Point
) -> None:
    c, s = math.cos(frame[2]), math.sin(frame[2])
    point = frame[0] + c * at[0] - s * at[1], frame[1] + s * at[0] + c * at[1]
    part.push((sign * c, sign * s), distance, point)


def _shift(part: Part, frame: tuple[float, float, float], distance: float) -> None:
    """Move along the gripper's y."""
    part.x -= math.sin(frame[2]) * distance
    part.y += math.cos(frame[2]) * distance


def _shift_along(part: Part, frame: tuple[float, float, float], distance: float) -> None:
    """Move along the closing direction: both fingers close equally and centre the part."""
    part.x += math.cos(frame[2]) * distance
    part.y += math.sin(frame[2]) * distance
