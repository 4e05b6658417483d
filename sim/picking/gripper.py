"""Two fingers and their effects on a part: they push it, turn it, hold it, or let it slip.

All of it happens in the gripper's frame, seen from above: x is the closing direction, y along the
fingers' width, the origin in the middle between them. A part is held only if both fingers stop on
it; how firmly depends on friction, contact width and depth:

    capacity = 2 mu F min(1, contact width / full) min(1, depth / full depth)

A part whose weight and acceleration exceed the capacity slips, and falls when it has slipped out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from petrobot.sim.picking.parts import Part, Point, clipped

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


@dataclass(frozen=True, slots=True)
class Fingers:
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
