"""The collision guard: no set point passes that leads beyond a joint limit or into table, floor or
pedestal.

A commanded step is allowed only if the pose after it and the pose in which the arm would come to
rest, braking from there, touch nothing, and, where the braking distance is long, if the path
between them touches nothing either. So the arm can stop at any moment without touching anything:
where a step is refused, the arm brakes along the path that was found clear one cycle before
(compare T. Fraichard, H. Asama, Inevitable collision states: a step towards safer robots?, IROS
2003).

The kernels compute on plain floats and use square roots and squares only, so that the compiled
kernels (numba) decide exactly as the uncompiled ones; sine and cosine come from the same C library
in both. Lengths in m, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from petrobot.services.device import Workspace
from petrobot.services.host.numba_kernels import kernel
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.model import JOINTS, ArmModel, CatchingCell
from petrobot.services.motion.trajectory import (
    Six,
    Trajectory,
    braked_for,
    braking_times,
    rest_of,
    six,
    toward,
)

# --- Kernels -------------------------------------------------------------------------------------

Point = tuple[float, float, float]
Links = tuple[float, float, float, float, float]
"""d1, a2, a3, d3, d4 of the arm (Denavit-Hartenberg parameters)."""
Cup = tuple[Point, Point, float, float]
"""Mouth and outward axis in the flange's frame, length and outer radius."""
Solids = tuple[float, float, float, float, float, float, float, float]
"""Where the solid parts of the cell begin, margins included.

Greatest x beside the table for the arm and for the cup, least z above it for each, margin to the
floor, height of the pedestal, and its radius for the wrist and for the cup.
"""
Radii = tuple[float, float]
"""Radii of forearm and wrist."""


@kernel
def within(q: Six, lower: Six, upper: Six) -> bool:
    """Return whether all joints are within their limits."""
    return (
        lower[0] <= q[0] <= upper[0]
        and lower[1] <= q[1] <= upper[1]
        and lower[2] <= q[2] <= upper[2]
        and lower[3] <= q[3] <= upper[3]
        and lower[4] <= q[4] <= upper[4]
        and lower[5] <= q[5] <= upper[5]
    )


@kernel
def ball_clear(x: float, z: float, radius: float, ahead: float, above: float, floor: float) -> bool:
    """Return whether a sphere on the forearm is clear of table and floor."""
    low = z - radius
    return (x + radius <= ahead or low >= above) and low >= floor


@kernel
def forearm_clear(elbow: Point, wrist: Point, radii: Radii, solids: Solids) -> bool:
    """Return whether forearm and wrist, as four spheres along the forearm, are clear of table,
    floor and pedestal."""
    thick, hand = radii
    (ex, _, ez), (x, y, z) = elbow, wrist
    ahead, _, above, _, floor, pedestal, beside, _ = solids
    along, up = x - ex, z - ez
    return (
        ball_clear(ex, ez, thick, ahead, above, floor)
        and ball_clear(ex + 0.5 * along, ez + 0.5 * up, thick, ahead, above, floor)
        and ball_clear(ex + 0.75 * along, ez + 0.75 * up, thick, ahead, above, floor)
        and ball_clear(x, z, hand, ahead, above, floor)
        and (z >= pedestal or x * x + y * y >= beside * beside)
    )


@kernel
def cup_clear(mouth: Point, axis: Point, length: float, radius: float, solids: Solids) -> bool:
    """Return whether the cup, as a cylinder, is clear of table, floor and pedestal."""
    _, ahead, _, above, floor, pedestal, _, beside = solids
    (x, y, z), (ax, ay, az) = mouth, axis
    bx, by, bz = x - length * ax, y - length * ay, z - length * az
    # A disc of radius r with the unit normal a reaches r * sqrt(1 - a_x^2) in direction x.
    front = max(x, bx) + radius * math.sqrt(max(0.0, 1.0 - ax * ax))
    low = min(z, bz) - radius * math.sqrt(max(0.0, 1.0 - az * az))
    return (
        (front <= ahead or low >= above)
        and low >= floor
        and (z >= pedestal or x * x + y * y >= beside * beside)
        and (bz >= pedestal or bx * bx + by * by >= beside * beside)
    )


@kernel
def pose_clear(q: Six, links: Links, radii: Radii, cup: Cup, solids: Solids) -> bool:
    """Return whether forearm and cup touch nothing in a joint pose."""
    d1, a2, a3, d3, d4 = links
    mouth, axis, length, radius = cup
    c1, s1, c23, s23 = math.cos(q[0]), math.sin(q[0]), math.cos(q[1] + q[2]), math.sin(q[1] + q[2])
    reach = a2 * math.cos(q[1]) + a3 * c23
    height = d1 + a2 * math.sin(q[1]) + a3 * s23
    elbow = (reach * c1 + d3 * s1, reach * s1 - d3 * c1, height)
    reach -= d4 * s23
    wx, wy, wz = reach * c1 + d3 * s1, reach * s1 - d3 * c1, height + d4 * c23
    if not forearm_clear(elbow, (wx, wy, wz), radii, solids):
        return False
    turn = (
        c1,
        s1,
        c23,
        s23,
        math.cos(q[3]),
        math.sin(q[3]),
        math.cos(q[4]),
        math.sin(q[4]),
        math.cos(q[5]),
        math.sin(q[5]),
    )
    x, y, z = turned(turn, mouth)
    return cup_clear((wx + x, wy + y, wz + z), turned(turn, axis), length, radius, solids)


Turn = tuple[float, float, float, float, float, float, float, float, float, float]
"""Cosine and sine of joint 1, of joints 2 and 3 together, of joints 4, 5 and 6."""


@kernel
def turned(turn: Turn, vector: Point) -> Point:
    """Rotate a vector of frame 6 into the base frame."""
    c1, s1, c23, s23, c4, s4, c5, s5, c6, s6 = turn
    x, y, z = vector
    x, y = c6 * x - s6 * y, s6 * x + c6 * y
    x, z = c5 * x - s5 * z, s5 * x + c5 * z  # The twists before and after joint 5 cancel.
    x, y = c4 * x - s4 * y, s4 * x + c4 * y
    radial, up = c23 * x - s23 * z, s23 * x + c23 * z
    return c1 * radial - s1 * y, s1 * radial + c1 * y, up


@kernel
def clear(
    q: Six, lower: Six, upper: Six, links: Links, radii: Radii, cup: Cup, solids: Solids
) -> bool:
    """Return whether a joint pose is within the limits and touches nothing."""
    return within(q, lower, upper) and pose_clear(q, links, radii, cup, solids)


@kernel
def farther(a: Six, b: Six, limit: float) -> bool:
    """Return whether any joint differs by more than `limit` between two poses."""
    return (
        abs(a[0] - b[0]) > limit
        or abs(a[1] - b[1]) > limit
        or abs(a[2] - b[2]) > limit
        or abs(a[3] - b[3]) > limit
        or abs(a[4] - b[4]) > limit
        or abs(a[5] - b[5]) > limit
    )


@kernel
def clear_step(
    period: float,
    near: float,
    q: Six,
    qd: Six,
    target: Six,
    speed: Six,
    acceleration: Six,
    brakes: Six,
    lower: Six,
    upper: Six,
    links: Links,
    radii: Radii,
    cup: Cup,
    solids: Solids,
) -> tuple[Six, Six, bool]:
    """Compute the next cycle toward `target`: positions, velocities, and whether the arm can come
    to rest from there.

    Where braking takes more than `near` rad, the path to rest is also checked after a quarter and
    after half of its time.
    """
    q, qd = toward(period, q, qd, target, speed, acceleration)
    rest = rest_of(period, q, qd, brakes)
    if not (
        clear(rest, lower, upper, links, radii, cup, solids)
        and clear(q, lower, upper, links, radii, cup, solids)
    ):
        return q, qd, False
    if not farther(rest, q, near):
        return q, qd, True
    times = braking_times(period, qd, brakes)
    longest = max(times)
    return (
        q,
        qd,
        clear(braked_for(0.25 * longest, q, qd, times), lower, upper, links, radii, cup, solids)
        and clear(braked_for(0.5 * longest, q, qd, times), lower, upper, links, radii, cup, solids),
    )


# --- The guard -----------------------------------------------------------------------------------

Geometry = tuple[Six, Six, Links, Radii, Cup, Solids]
"""Least and greatest angles, and the other arguments of the kernels."""

CUP_MARGIN = 0.005
"""Least distance between cup and table (m)."""
ARM_MARGIN = 0.01
"""Least distance between arm and table, and of every part to floor and pedestal (m)."""
BARELY = 0.1
"""Share of the margins that is left to an arm that has to creep out of them."""
NEAR = 0.02
"""rad of braking below which the path to rest is too short to need a check at its middle; 10 mm at
the cup."""
LOOKS = (0.25, 0.5)
"""Shares of the braking time at which a long path to rest is checked, beside its beginning and its
end; `clear_step` uses the same."""
JOINT_SLACK = 1e-6
"""How far rounding may carry a command beyond a joint limit (rad)."""


def point(values: Sequence[float]) -> Point:
    """Return three floats."""
    x, y, z = values
    return float(x), float(y), float(z)


class Placement(NamedTuple):
    """Where parts of the arm are (m, base frame): both ends of the forearm, the cup's mouth and its
    outward axis."""

    elbow: Point
    wrist: Point
    mouth: Point
    axis: Point


class CollisionGuard:
    """Knows what is solid in the cell. Works on plain floats, since it checks one pose at a time,
    twice a cycle."""

    def __init__(
        self,
        puma: Puma,
        model: ArmModel,
        cell: CatchingCell,
        cup_margin: float = CUP_MARGIN,
        arm_margin: float = ARM_MARGIN,
        workspace: Workspace | None = None,
    ) -> None:
        """Margins (m) are between cup and table, and of everything else. They cover what happens
        between the checked poses. `workspace` bounds the centre of the cup's mouth (base frame)."""
        self._workspace = workspace or Workspace()
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
        """Position to which `advance` last moved a trajectory after checking it. The tuple itself
        is compared, so the state of another trajectory is never mistaken for it."""

    def _warm_up(self) -> None:
        """Compile the kernels, or load them from the cache, now and not in the first cycles of the
        arm."""
        home = Trajectory([0.0] * JOINTS, 0.004, [1.0] * JOINTS, [1.0] * JOINTS)
        home.aim(home.q)
        home.resting(*home.proposed())
        home.braking()
        self.violation(home.q)
        self.advance(home)
        self._vouched = None

    def _numbers(self) -> Geometry:
        """Return the kernels' arguments: limits, links, radii, cup, and where the solids begin."""
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

    def closer(self, share: float) -> CollisionGuard:
        """Return a guard with only a share of the margins."""
        margins = share * self._cup_margin, share * self._arm_margin
        return CollisionGuard(self._puma, self._model, self._cell, *margins, self._workspace)

    def barely(self) -> CollisionGuard:
        """Return a guard that refuses contact only: without workspace, and with margins that cover
        no more than the way between two checked poses of a slow arm."""
        margins = BARELY * self._cup_margin, BARELY * self._arm_margin
        return CollisionGuard(self._puma, self._model, self._cell, *margins)

    def place(self, q: Sequence[float]) -> Placement:
        """Return where forearm and cup are in a joint pose."""
        return self._placed(q, *self._forearm(q))

    def _placed(self, q: Sequence[float], elbow: Point, wrist: Point) -> Placement:
        turn = _turn(q)
        offset, axis = turned(turn, self._cell.cup.mouth), turned(turn, self._cell.cup.axis)
        return Placement(
            elbow, wrist, (wrist[0] + offset[0], wrist[1] + offset[1], wrist[2] + offset[2]), axis
        )

    def _forearm(self, q: Sequence[float]) -> tuple[Point, Point]:
        """Return both ends of the forearm."""
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
        """Return in words what a joint pose would touch; empty if it is clear."""
        if clear(six(q), *self._geometry):
            return self._workspace.outside(self.place(q).mouth) if self._workspace.bounds else ""
        for angle, (low, high) in zip(q, self._limits, strict=True):
            if not low <= angle <= high:
                return f"joint {self._beyond(q)} beyond its limit"
        elbow, wrist = self._forearm(q)
        return self._arm_touches(elbow, wrist) or self._cup_touches(self._placed(q, elbow, wrist))

    def _beyond(self, q: Sequence[float]) -> int:
        """Return the number (from 1) of the first joint beyond its limit."""
        pairs = zip(q, self._limits, strict=True)
        return next(
            number
            for number, (angle, (low, high)) in enumerate(pairs, 1)
            if not low <= angle <= high
        )

    def _cup_touches(self, at: Placement) -> str:
        """Check the cup as a cylinder: the extents of its two end discs."""
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
        """Check forearm and wrist as spheres along the forearm."""
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

    def path_clear(self, start: Sequence[float], end: Sequence[float]) -> bool:
        """Return whether the straight path between two joint poses is clear, checked at five
        points."""
        steps = [number / 5 for number in range(1, 6)]
        return not any(
            self.violation([a + share * (b - a) for a, b in zip(start, end, strict=True)])
            for share in steps
        )

    def advance(self, trajectory: Trajectory) -> str:
        """Advance a trajectory by one cycle; return in words what it was refused to touch, empty if
        the step was allowed.

        A refused step becomes a braking step. That the braking path is clear is certain only if the
        guard has checked every step since a clear pose.
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
            sure = is_clear and not self._workspace.bounds
            refused = "" if sure else self._refusal(trajectory, q, qd)
        if refused:
            q, qd = trajectory.braking()
        else:
            self._vouched = q
        trajectory.accept(q, qd)
        return refused

    def _refusal(self, trajectory: Trajectory, q: Six, qd: Six) -> str:
        """Return what the arm would touch where it comes to rest from this state, or on the way
        there; empty if nothing."""
        rest = trajectory.resting(q, qd)
        path = trajectory.stopping(q, qd, *LOOKS) if farther(rest, q, NEAR) else ()
        return next(filter(None, map(self.violation, (rest, q, *path))), "")

    def stops_clear(self, trajectory: Trajectory) -> bool:
        """Return whether the pose in which the trajectory comes to rest is clear; needs no check if
        `advance` has just found it so."""
        return trajectory.q is self._vouched or not self.violation(
            trajectory.resting(trajectory.q, trajectory.qd)
        )


def _turn(q: Sequence[float]) -> Turn:
    """Return cosine and sine of each angle that rotates frame 6 into the base frame."""
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
