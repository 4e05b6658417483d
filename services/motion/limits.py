"""The guard: joint limits, table, floor and pedestal that no set point can pass.

A commanded step is allowed only if the pose in which the arm would come to rest, braking from after
that step, is clear, and so is the way there if it is long. So at every moment the arm can stop
without touching anything; where a step is refused the servo brakes on the way that was found clear
one cycle before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from petrobot.services.motion.clearance import (
    Cup,
    Links,
    Point,
    Radii,
    Solids,
    Turn,
    clear,
    clear_step,
    farther,
    turned,
)
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.model import JOINTS, ArmModel, Cell
from petrobot.services.motion.trajectory import Six, Trajectory, six

Geometry = tuple[Six, Six, Links, Radii, Cup, Solids]
"""Least and greatest angles, and the rest of what services/motion/clearance.py asks for."""

CUP_MARGIN = 0.005
"""m between cup and table."""
ARM_MARGIN = 0.01
"""m between arm and table, and of everything to floor and pedestal."""
NEAR = 0.02
"""rad of braking below which the way to rest is too short (10 mm at the cup) to need a look at its
middle."""
LOOKS = (0.0, 0.25, 0.5)
"""Shares of the braking time at which a long way to rest is looked at, besides its end; the kernel
has the same."""
JOINT_SLACK = 1e-6
"""rad by which rounding may carry a command beyond a joint limit."""


def point(values: Sequence[float]) -> Point:
    """Three floats."""
    x, y, z = values
    return float(x), float(y), float(z)


class Placement(NamedTuple):
    """Where the parts of the arm are (m, base frame): the forearm's ends, the cup's mouth and its
    outward axis."""

    elbow: Point
    wrist: Point
    mouth: Point
    axis: Point


class Guard:
    """Knows what is solid in the cell. Plain floats: one pose at a time, twice a cycle."""

    def __init__(
        self,
        puma: Puma,
        model: ArmModel,
        cell: Cell,
        cup_margin: float = CUP_MARGIN,
        arm_margin: float = ARM_MARGIN,
    ) -> None:
        """Margins (m) are between cup and table, and of everything else; they cover what happens
        between the poses looked at."""
        self._cup_margin, self._arm_margin = cup_margin, arm_margin
        self._puma = puma
        self._model = model
        self._body = model.body
        self._cell = cell
        lowest, highest = model.lower - JOINT_SLACK, model.upper + JOINT_SLACK
        self._limits = list(zip(lowest.tolist(), highest.tolist(), strict=True))
        self._length = cell.cup.depth + cell.cup.wall
        self._radius = cell.cup.radius + cell.cup.wall
        self._geometry = self._numbers()
        self._warm_up()
        self._vouched: Six | None = None
        """Where `advance` left a trajectory, if it let it go on: the very tuple, so another
        trajectory's is never meant."""

    def _warm_up(self) -> None:
        """Kernels are compiled, or read from where they are kept, now and not in the servo's first
        cycles."""
        home = Trajectory([0.0] * JOINTS, 0.004, [1.0] * JOINTS, [1.0] * JOINTS)
        home.aim(home.q)
        home.resting(*home.proposed())
        home.braking()
        self.violation(home.q)
        self.advance(home)
        self._vouched = None

    def _numbers(self) -> Geometry:
        """What the kernels must know: limits, links, radii, cup, and where the solids begin."""
        puma, body, cell, cup = self._puma, self._body, self._cell, self._cell.cup
        solids = (
            cell.near_edge - self._arm_margin,
            cell.near_edge - self._cup_margin,
            cell.table_top + self._arm_margin,
            cell.table_top + self._cup_margin,
            self._arm_margin,
            puma.d1 + body.base,
            body.base + body.wrist + self._arm_margin,
            body.base + self._radius + self._arm_margin,
        )
        return (
            six(self._model.lower - JOINT_SLACK),
            six(self._model.upper + JOINT_SLACK),
            (puma.d1, puma.a2, puma.a3, puma.d3, puma.d4),
            (body.forearm, body.wrist),
            (point(cup.mouth), point(cup.axis), self._length, self._radius),
            solids,
        )

    def closer(self, share: float) -> Guard:
        """A guard that keeps only a share of the margins."""
        return Guard(
            self._puma, self._model, self._cell, share * self._cup_margin, share * self._arm_margin
        )

    def place(self, q: Sequence[float]) -> Placement:
        """Where forearm and cup are in a joint pose."""
        return self._placed(q, *self._forearm(q))

    def _placed(self, q: Sequence[float], elbow: Point, wrist: Point) -> Placement:
        turn = _turn(q)
        offset, axis = turned(turn, self._cell.cup.mouth), turned(turn, self._cell.cup.axis)
        return Placement(
            elbow, wrist, (wrist[0] + offset[0], wrist[1] + offset[1], wrist[2] + offset[2]), axis
        )

    def _forearm(self, q: Sequence[float]) -> tuple[Point, Point]:
        """Both ends of the forearm."""
        puma = self._puma
        c1, s1, c23, s23 = (
            math.cos(q[0]),
            math.sin(q[0]),
            math.cos(q[1] + q[2]),
            math.sin(q[1] + q[2]),
        )
        reach = puma.a2 * math.cos(q[1]) + puma.a3 * c23
        height = puma.d1 + puma.a2 * math.sin(q[1]) + puma.a3 * s23
        elbow = (reach * c1 + puma.d3 * s1, reach * s1 - puma.d3 * c1, height)
        reach -= puma.d4 * s23
        return elbow, (reach * c1 + puma.d3 * s1, reach * s1 - puma.d3 * c1, height + puma.d4 * c23)

    def violation(self, q: Sequence[float]) -> str:
        """What a joint pose would touch, in words; empty if it is clear."""
        if clear(six(q), *self._geometry):
            return ""
        for angle, (low, high) in zip(q, self._limits, strict=True):
            if not low <= angle <= high:
                return f"joint {self._beyond(q)} beyond its limit"
        elbow, wrist = self._forearm(q)
        return self._arm_touches(elbow, wrist) or self._cup_touches(self._placed(q, elbow, wrist))

    def _beyond(self, q: Sequence[float]) -> int:
        """The first joint beyond its limit, from 1."""
        pairs = zip(q, self._limits, strict=True)
        return next(
            number
            for number, (angle, (low, high)) in enumerate(pairs, 1)
            if not low <= angle <= high
        )

    def _cup_touches(self, at: Placement) -> str:
        """The cup as a cylinder: extents of its two end discs."""
        cell, axis = self._cell, at.axis
        bottom = tuple(m - self._length * a for m, a in zip(at.mouth, axis, strict=True))
        ahead = max(at.mouth[0], bottom[0]) + self._radius * math.sqrt(
            max(0.0, 1.0 - axis[0] * axis[0])
        )
        low = min(at.mouth[2], bottom[2]) - self._radius * math.sqrt(
            max(0.0, 1.0 - axis[2] * axis[2])
        )
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
        for share, radius in (
            (0.0, body.forearm),
            (0.5, body.forearm),
            (0.75, body.forearm),
            (1.0, body.wrist),
        ):
            x = elbow[0] + share * (wrist[0] - elbow[0])
            z = elbow[2] + share * (wrist[2] - elbow[2])
            if (
                x + radius > cell.near_edge - self._arm_margin
                and z - radius < cell.table_top + self._arm_margin
            ):
                return "forearm at the table"
            if z - radius < self._arm_margin:
                return "forearm at the floor"
        x, y, z = wrist
        if (
            z < self._puma.d1 + body.base
            and math.hypot(x, y) < body.base + body.wrist + self._arm_margin
        ):
            return "wrist at the pedestal"
        return ""

    def path_clear(self, start: Sequence[float], end: Sequence[float], parts: int = 5) -> bool:
        """Whether the straight way between two joint poses is clear, looked at in so many
        places."""
        steps = [number / parts for number in range(1, parts + 1)]
        return not any(
            self.violation([a + share * (b - a) for a, b in zip(start, end, strict=True)])
            for share in steps
        )

    def advance(self, trajectory: Trajectory) -> str:
        """Move a trajectory on by one cycle; gives what it refused to touch, in words, empty if it
        went on as it wished.

        It brakes where it refuses; that this way is clear holds if the guard has watched from a
        clear pose on.
        """
        target = trajectory.target
        if target is None:
            q, qd = trajectory.braking()
            refused = self._refusal(trajectory, q, qd)
        else:
            q, qd, is_clear = clear_step(
                trajectory.period,
                NEAR,
                trajectory.q,
                trajectory.qd,
                target,
                trajectory.speed,
                trajectory.acceleration,
                trajectory.brakes,
                *self._geometry,
            )
            refused = "" if is_clear else self._refusal(trajectory, q, qd)
        if refused:
            q, qd = trajectory.braking()
        else:
            self._vouched = q
        trajectory.accept(q, qd)
        return refused

    def _refusal(self, trajectory: Trajectory, q: Six, qd: Six) -> str:
        """What the arm would touch where it comes to rest from this state, or on the way there;
        empty if nothing."""
        rest = trajectory.resting(q, qd)
        refused = self.violation(rest)
        if not refused and farther(rest, q, NEAR):
            refused = next(
                filter(None, map(self.violation, trajectory.stopping(q, qd, *LOOKS))), ""
            )
        return refused

    def stops_clear(self, trajectory: Trajectory) -> bool:
        """Whether the pose in which the trajectory comes to rest is clear; known at once if
        `advance` has just found it so."""
        return trajectory.q is self._vouched or not self.violation(
            trajectory.resting(trajectory.q, trajectory.qd)
        )


def _turn(q: Sequence[float]) -> Turn:
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
