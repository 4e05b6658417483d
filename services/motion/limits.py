"""The guard: joint limits, table, floor and pedestal that no set point can pass.

A commanded step is allowed only if the pose in which the arm would come to rest, braking from after that step, is clear,
and so is the way there if it is long. So at every moment the arm can stop without touching anything; where a
step is refused the servo brakes on the way that was found clear one cycle before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import sub
from typing import NamedTuple

from services.motion.kinematics import Puma
from services.motion.model import ArmModel, Cell
from services.motion.trajectory import Trajectory

Point = tuple[float, float, float]

CUP_MARGIN = 0.005
"""m between cup and table."""
ARM_MARGIN = 0.01
"""m between arm and table, and of everything to floor and pedestal."""
NEAR = 0.02
"""rad of braking below which the way to rest is too short (10 mm at the cup) to need a look at its middle."""
LOOKS = (0.0, 0.25, 0.5)
"""Shares of the braking time at which a long way to rest is looked at, besides its end."""
JOINT_SLACK = 1e-6
"""rad by which rounding may carry a command beyond a joint limit."""


class Placement(NamedTuple):
    """Where the parts of the arm are (m, base frame): the forearm's ends, the cup's mouth and its outward axis."""

    elbow: Point
    wrist: Point
    mouth: Point
    axis: Point


class Guard:
    """Knows what is solid in the cell. Plain floats: one pose at a time, twice a cycle."""

    def __init__(
        self, puma: Puma, model: ArmModel, cell: Cell, cup_margin: float = CUP_MARGIN, arm_margin: float = ARM_MARGIN
    ) -> None:
        """Margins (m) are between cup and table, and of everything else; they cover what happens between the poses looked at."""
        self._cup_margin, self._arm_margin = cup_margin, arm_margin
        self._puma = puma
        self._model = model
        self._body = model.body
        self._cell = cell
        lowest, highest = model.lower - JOINT_SLACK, model.upper + JOINT_SLACK
        self._limits = list(zip(lowest.tolist(), highest.tolist(), strict=True))
        self._length = cell.cup.depth + cell.cup.wall
        self._radius = cell.cup.radius + cell.cup.wall
        mouth, axis = cell.cup.mouth, cell.cup.axis
        ends = (
            math.hypot(*(m - length * a for m, a in zip(mouth, axis, strict=True))) for length in (0.0, self._length)
        )
        self._swing = max(ends) + self._radius
        """m from the wrist's centre within which the whole cup is."""
        self._thickest = max(self._body.forearm, self._body.wrist)
        self._before_table = cell.near_edge - arm_margin
        self._above_table = cell.table_top + arm_margin
        self._above_pedestal = max(puma.d1 + self._body.base, self._above_table, arm_margin)
        self._beside_pedestal = self._body.base + self._body.wrist + arm_margin
        self._vouched: list[float] | None = None
        """Where `advance` left a trajectory, if it let it go on: the very list, so another trajectory's is never meant."""

    def closer(self, share: float) -> Guard:
        """A guard that keeps only a share of the margins."""
        return Guard(self._puma, self._model, self._cell, share * self._cup_margin, share * self._arm_margin)

    def place(self, q: Sequence[float]) -> Placement:
        """Where forearm and cup are in a joint pose."""
        return self._placed(q, *self._forearm(q))

    def _placed(self, q: Sequence[float], elbow: Point, wrist: Point) -> Placement:
        turn = _turn(q)
        offset, axis = _turned(turn, self._cell.cup.mouth), _turned(turn, self._cell.cup.axis)
        return Placement(elbow, wrist, (wrist[0] + offset[0], wrist[1] + offset[1], wrist[2] + offset[2]), axis)

    def _forearm(self, q: Sequence[float]) -> tuple[Point, Point]:
        """Both ends of the forearm."""
        puma = self._puma
        c1, s1, c23, s23 = math.cos(q[0]), math.sin(q[0]), math.cos(q[1] + q[2]), math.sin(q[1] + q[2])
        reach = puma.a2 * math.cos(q[1]) + puma.a3 * c23
        height = puma.d1 + puma.a2 * math.sin(q[1]) + puma.a3 * s23
        elbow = (reach * c1 + puma.d3 * s1, reach * s1 - puma.d3 * c1, height)
        reach -= puma.d4 * s23
        return elbow, (reach * c1 + puma.d3 * s1, reach * s1 - puma.d3 * c1, height + puma.d4 * c23)

    def violation(self, q: Sequence[float]) -> str:
        """What a joint pose would touch, in words; empty if it is clear."""
        for angle, (low, high) in zip(q, self._limits, strict=True):
            if not low <= angle <= high:
                return f"joint {self._beyond(q)} beyond its limit"
        elbow, wrist = self._forearm(q)
        touched = "" if self._arm_far(elbow, wrist) else self._arm_touches(elbow, wrist)
        if touched or self._far(wrist):
            return touched
        return self._cup_touches(self._placed(q, elbow, wrist))

    def _beyond(self, q: Sequence[float]) -> int:
        """The first joint beyond its limit, from 1."""
        pairs = zip(q, self._limits, strict=True)
        return next(number for number, (angle, (low, high)) in enumerate(pairs, 1) if not low <= angle <= high)

    def _arm_far(self, elbow: Point, wrist: Point) -> bool:
        """Whether the forearm's ends are so far from everything that all of it is clear: cheap, and most often so."""
        thick = self._thickest
        low = min(elbow[2], wrist[2]) - thick
        return low >= self._above_pedestal or (
            low >= self._arm_margin
            and (max(elbow[0], wrist[0]) + thick <= self._before_table or low >= self._above_table)
            and math.hypot(wrist[0], wrist[1]) >= self._beside_pedestal
        )

    def _far(self, wrist: Point) -> bool:
        """Whether the wrist is so far from everything that the cup is clear however it is turned."""
        x, y, z = wrist
        inner = self._body.base + self._arm_margin + self._swing
        return (
            x + self._swing < self._cell.near_edge - self._cup_margin
            and z - self._swing > self._arm_margin
            and math.hypot(x, y) > inner
        )

    def _cup_touches(self, at: Placement) -> str:
        """The cup as a cylinder: extents of its two end discs."""
        cell, axis = self._cell, at.axis
        bottom = tuple(m - self._length * a for m, a in zip(at.mouth, axis, strict=True))
        ahead = max(at.mouth[0], bottom[0]) + self._radius * math.sqrt(max(0.0, 1.0 - axis[0] * axis[0]))
        low = min(at.mouth[2], bottom[2]) - self._radius * math.sqrt(max(0.0, 1.0 - axis[2] * axis[2]))
        if ahead > cell.near_edge - self._cup_margin and low < cell.table_top + self._cup_margin:
            return "cup at the table"
        if low < self._arm_margin:
            return "cup at the floor"
        for x, y, z in (at.mouth, bottom):
            if (
                z < self._puma.d1 + self._body.base
                and math.hypot(x, y) < self._body.base + self._radius + self._arm_margin
            ):
                return "cup at the pedestal"
        return ""

    def _arm_touches(self, elbow: Point, wrist: Point) -> str:
        """Forearm and wrist as spheres along the forearm."""
        cell, body = self._cell, self._body
        for share, radius in ((0.0, body.forearm), (0.5, body.forearm), (0.75, body.forearm), (1.0, body.wrist)):
            x = elbow[0] + share * (wrist[0] - elbow[0])
            z = elbow[2] + share * (wrist[2] - elbow[2])
            if x + radius > cell.near_edge - self._arm_margin and z - radius < cell.table_top + self._arm_margin:
                return "forearm at the table"
            if z - radius < self._arm_margin:
                return "forearm at the floor"
        x, y, z = wrist
        if z < self._puma.d1 + body.base and math.hypot(x, y) < body.base + body.wrist + self._arm_margin:
            return "wrist at the pedestal"
        return ""

    def path_clear(self, start: Sequence[float], end: Sequence[float], parts: int = 5) -> bool:
        """Whether the straight way between two joint poses is clear, looked at in so many places."""
        steps = [number / parts for number in range(1, parts + 1)]
        return not any(
            self.violation([a + share * (b - a) for a, b in zip(start, end, strict=True)]) for share in steps
        )

    def advance(self, trajectory: Trajectory) -> str:
        """Move a trajectory on by one cycle; gives what it refused to touch, in words, empty if it went on as it wished.

        It brakes where it refuses; that this way is clear holds if the guard has watched from a clear pose on.
        """
        q, qd = trajectory.proposed()
        rest = trajectory.resting(q, qd)
        refused = self.violation(rest)
        if not refused and max(map(abs, map(sub, rest, q))) > NEAR:
            refused = next(filter(None, map(self.violation, trajectory.stopping(q, qd, *LOOKS))), "")
        if refused:
            q, qd = trajectory.braking()
        else:
            self._vouched = q
        trajectory.accept(q, qd)
        return refused

    def stops_clear(self, trajectory: Trajectory) -> bool:
        """Whether the pose in which the trajectory comes to rest is clear; known at once if `advance` has just found it so."""
        return trajectory.q is self._vouched or not self.violation(trajectory.resting(trajectory.q, trajectory.qd))


def _turn(q: Sequence[float]) -> tuple[float, ...]:
    """Rotation of frame 6 in the base frame: cosine and sine of each angle on the way."""
    cos, sin, elbow = math.cos, math.sin, q[1] + q[2]
    return (
        cos(q[0]),
        sin(q[0]),
        cos(elbow),
        sin(elbow),
        cos(q[3]),
        sin(q[3]),
        cos(q[4]),
        sin(q[4]),
        cos(q[5]),
        sin(q[5]),
    )


def _turned(turn: tuple[float, ...], vector: Point) -> Point:
    """A vector of frame 6 in the base frame."""
    c1, s1, c23, s23, c4, s4, c5, s5, c6, s6 = turn
    x, y, z = vector
    x, y = c6 * x - s6 * y, s6 * x + c6 * y
    x, z = c5 * x - s5 * z, s5 * x + c5 * z  # the twists before and after joint 5 cancel
    x, y = c4 * x - s4 * y, s4 * x + c4 * y
    radial, up = c23 * x - s23 * z, s23 * x + c23 * z
    return c1 * radial - s1 * y, s1 * radial + c1 * y, up
