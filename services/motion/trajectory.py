"""Online joint trajectories: velocity- and acceleration-limited, re-targeted at any cycle from any state of motion.

Each joint takes in each cycle the greatest velocity from which it can still come to rest exactly on its target by an even
ramp of whole cycles; that is the discrete time-optimal law (compare Kroeger, "On-line trajectory generation in robotic
systems", 2010, type II) and needs no planning, so a new target costs nothing. Positions are the trapezoidal sums of the
velocities: a drive that interpolates linearly in velocity follows them exactly.

Plain floats, not arrays: six joints a cycle are too few for numpy to pay.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from services.motion.model import Vector


def next_velocity(error: float, velocity: float, period: float, speed: float, acceleration: float) -> float:
    """Velocity at the end of the next cycle (rad/s) of a joint that has `error` rad to go.

    The change never exceeds `acceleration * period`, nor the result `speed`, unless the joint is faster already (then it
    brakes). In units of u = v / (a T) and S = 2 (error - v T / 2) / (a T^2), an even ramp from u to rest in k = ceil(u)
    cycles covers u (k + 1); this solves u (ceil(u) + 1) <= |S| for the greatest u.
    """
    quantum = acceleration * period
    left = error - 0.5 * velocity * period
    size = 2.0 * abs(left) / (quantum * period)
    if size < RESIDUE and abs(velocity) <= quantum:
        return 0.0
    cycles = math.ceil(0.5 * (math.sqrt(1.0 + 4.0 * size) - 1.0) - ROUNDING)
    wish = quantum * (size / (cycles + 1.0) if size > cycles * cycles - 1.0 else cycles - 1.0)
    # comparisons, not min and max: this is asked for six joints in every cycle
    wish = wish if wish < speed else speed
    wish = wish if left >= 0.0 else -wish
    least, most = velocity - quantum, velocity + quantum
    return least if wish < least else most if wish > most else wish


RESIDUE = 1e-6
"""Share of one cycle's ramp that counts as arrived, so that rounding leaves no creeping; less than 1e-9 rad."""
ROUNDING = 1e-9
"""Cycles by which rounding may carry a ramp of whole cycles; without it a ramp would restart one cycle longer each time."""


def braking_velocity(velocity: float, period: float, acceleration: float) -> float:
    """Velocity at the end of the next cycle of a joint that comes to rest by an even ramp of whole cycles (rad/s)."""
    cycles = braking_cycles(velocity, period, acceleration)
    return velocity * (cycles - 1) / cycles if cycles else 0.0


def braking_cycles(velocity: float, period: float, acceleration: float) -> int:
    """Whole cycles that the even ramp to rest takes."""
    return math.ceil(abs(velocity) / (acceleration * period) - ROUNDING)


def braking_distance(velocity: float, period: float, acceleration: float) -> float:
    """What the even ramp of `braking_velocity` covers, with the velocity's sign (rad)."""
    return 0.5 * velocity * period * braking_cycles(velocity, period, acceleration)


def reach_time(error: Vector, velocity: Vector, speed: Vector, acceleration: Vector) -> Vector:
    """Least time (s) to come to rest `error` rad away, from `velocity` rad/s, under the limits; any shapes that broadcast.

    Continuous time; `Trajectory` needs at most two cycles more.
    """
    away = error - velocity * np.abs(velocity) / (2.0 * acceleration)
    side = np.where(away >= 0.0, 1.0, -1.0)
    toward, distance = side * velocity, side * error
    peak = np.sqrt(np.maximum(acceleration * distance + 0.5 * toward * toward, 0.0))
    triangle = (2.0 * peak - toward) / acceleration
    ramps = np.abs(speed - toward) / acceleration + speed / acceleration
    ramped = (np.abs(speed - toward) * (speed + toward) + speed * speed) / (2.0 * acceleration)
    return np.where(peak <= speed, triangle, ramps + (distance - ramped) / speed)


def synchronised(error: Vector, speed: Vector, acceleration: Vector) -> tuple[Vector, Vector]:
    """Limits (speed, acceleration), each (6,), under which all joints start and end a move from rest at one time.

    Slowing a joint's time by 1 / s scales its speed by s and its acceleration by s^2.
    """
    times = reach_time(error, np.zeros_like(error), speed, acceleration)
    longest = float(times.max())
    scale = np.maximum(times / longest, SLOWEST) if longest > 0.0 else np.ones_like(times)
    return speed * scale, acceleration * scale * scale


SLOWEST = 0.05
"""Least scale of a synchronised joint; a joint with nearly nothing to do may end early."""


class Trajectory:
    """The commanded motion of the arm's joints, advanced by one period a call. Angles in rad, speeds in rad/s.

    `target` None means: come to rest. Limits may be changed at any time; a joint beyond new limits brakes into them. Braking to
    rest always uses the accelerations given first.
    """

    def __init__(
        self, q: Sequence[float], period: float, speed: Sequence[float], acceleration: Sequence[float]
    ) -> None:
        self.period = period
        self.q = [float(value) for value in q]
        self.qd = [0.0] * len(self.q)
        self.target: list[float] | None = None
        self._brakes = [float(value) for value in acceleration]
        self.limit(speed, acceleration)

    def limit(self, speed: Sequence[float], acceleration: Sequence[float]) -> None:
        """Go by these limits from now on (rad/s, rad/s^2, one a joint)."""
        self.speed = [float(value) for value in speed]
        self.acceleration = [float(value) for value in acceleration]
        if not (min(self.speed) > 0.0 and min(self.acceleration) > 0.0):
            raise ValueError(f"limits must be positive, are {self.speed} rad/s and {self.acceleration} rad/s^2")

    def aim(self, target: Sequence[float] | None) -> None:
        """Go to a joint pose, or come to rest."""
        self.target = None if target is None else [float(value) for value in target]

    def reset(self, q: Sequence[float]) -> None:
        """Stand still here."""
        self.q, self.qd, self.target = [float(value) for value in q], [0.0] * len(self.q), None

    def proposed(self) -> tuple[list[float], list[float]]:
        """Position and velocity at the end of the next cycle toward the target."""
        if self.target is None:
            return self.braking()
        period = self.period
        after = [
            next_velocity(target - q, v, period, speed, acceleration)
            for target, q, v, speed, acceleration in zip(
                self.target, self.q, self.qd, self.speed, self.acceleration, strict=True
            )
        ]
        return [q + 0.5 * period * (v + w) for q, v, w in zip(self.q, self.qd, after, strict=True)], after

    def braking(self) -> tuple[list[float], list[float]]:
        """Position and velocity at the end of the next cycle when all joints brake."""
        period = self.period
        after = [braking_velocity(v, period, a) for v, a in zip(self.qd, self._brakes, strict=True)]
        return [q + 0.5 * period * (v + w) for q, v, w in zip(self.q, self.qd, after, strict=True)], after

    def resting(self, q: Sequence[float], qd: Sequence[float]) -> list[float]:
        """Where all joints come to rest if they brake from here."""
        period = self.period
        return [
            angle + braking_distance(v, period, a) if v else angle
            for angle, v, a in zip(q, qd, self._brakes, strict=True)
        ]

    def stopping(self, q: Sequence[float], qd: Sequence[float], *shares: float) -> Iterator[list[float]]:
        """Where the joints are after shares of the time that braking from here takes, the slowest joint deciding."""
        period = self.period
        times = [period * braking_cycles(v, period, a) for v, a in zip(qd, self._brakes, strict=True)]
        longest = max(times)
        for share in shares:
            now = share * longest
            yield [
                angle + v * (now - 0.5 * now**2 / time if now < time else 0.5 * time) if time else angle
                for angle, v, time in zip(q, qd, times, strict=True)
            ]

    def accept(self, q: list[float], qd: list[float]) -> None:
        """Make a proposed or braking state the present one."""
        self.q, self.qd = q, qd

    @property
    def still(self) -> bool:
        """Whether the commanded motion is at rest."""
        return not any(self.qd)

    def arrived(self, tolerance: float = 1e-6) -> bool:
        """Whether the commanded motion rests on its target (rad)."""
        if self.target is None:
            return self.still
        return self.still and all(abs(t - q) <= tolerance for t, q in zip(self.target, self.q, strict=True))
