"""Online joint trajectories, limited in velocity and acceleration, that accept a new target in any
cycle and any state of motion.

In each cycle each joint takes the greatest velocity from which it can still come to rest exactly on
its target by an even ramp of whole cycles. That is the discrete time-optimal rule (compare Kroeger,
"On-Line Trajectory Generation in Robotic Systems", Springer 2010, type I). It needs no planning, so
a new target costs nothing. Positions are the trapezoidal sums of the velocities: a drive that
interpolates linearly in velocity follows them exactly.

The kernels compute on plain floats, not arrays: six joints are too few for numpy to be faster.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from petrobot.services.host.numba_kernels import kernel
from petrobot.services.motion.model import Vector

Six = tuple[float, float, float, float, float, float]
"""One number per joint, base to flange."""


@kernel
def next_velocity(
    error: float, velocity: float, period: float, speed: float, acceleration: float
) -> float:
    """Return the velocity at the end of the next cycle (rad/s) of a joint that has `error` rad to
    go.

    The change never exceeds `acceleration * period`, nor the result `speed`, unless the joint is
    already faster (then it brakes). In units of u = v / (a T) and S = 2 (error - v T / 2) / (a
    T^2), an even ramp from u to rest in k = ceil(u) cycles covers u (k + 1); this solves u (ceil(u)
    + 1) <= |S| for the greatest u.
    """
    quantum = acceleration * period
    left = error - 0.5 * velocity * period
    size = 2.0 * abs(left) / (quantum * period)
    if size < RESIDUE and abs(velocity) <= quantum:
        return 0.0
    cycles = math.ceil(0.5 * (math.sqrt(1.0 + 4.0 * size) - 1.0) - ROUNDING)
    wish = quantum * (size / (cycles + 1.0) if size > cycles * cycles - 1.0 else cycles - 1.0)
    # Comparisons are faster than min and max here; six joints run this in every cycle.
    wish = wish if wish < speed else speed
    wish = wish if left >= 0.0 else -wish
    least, most = velocity - quantum, velocity + quantum
    return least if wish < least else most if wish > most else wish


RESIDUE = 1e-6
"""Share of one cycle's ramp that counts as arrived, so that rounding leaves no creeping; less than
1e-9 rad."""
ROUNDING = 1e-9
"""Cycles by which rounding may carry a ramp of whole cycles; without it a ramp would restart one
cycle longer each time."""


@kernel
def braking_velocity(velocity: float, period: float, acceleration: float) -> float:
    """Return the velocity at the end of the next cycle (rad/s) of a joint that comes to rest by an
    even ramp of whole cycles."""
    cycles = braking_cycles(velocity, period, acceleration)
    return velocity * (cycles - 1) / cycles if cycles else 0.0


@kernel
def braking_cycles(velocity: float, period: float, acceleration: float) -> int:
    """Return the number of whole cycles that the even ramp to rest takes."""
    return math.ceil(abs(velocity) / (acceleration * period) - ROUNDING)


@kernel
def braking_distance(velocity: float, period: float, acceleration: float) -> float:
    """Return the distance that the even ramp of `braking_velocity` covers, with the sign of the
    velocity (rad)."""
    return 0.5 * velocity * period * braking_cycles(velocity, period, acceleration)


@kernel
def _gone(period: float, q: Six, qd: Six, after: Six) -> Six:
    half = 0.5 * period
    return (
        q[0] + half * (qd[0] + after[0]),
        q[1] + half * (qd[1] + after[1]),
        q[2] + half * (qd[2] + after[2]),
        q[3] + half * (qd[3] + after[3]),
        q[4] + half * (qd[4] + after[4]),
        q[5] + half * (qd[5] + after[5]),
    )


@kernel
def toward(
    period: float, q: Six, qd: Six, target: Six, speed: Six, acceleration: Six
) -> tuple[Six, Six]:
    """Return positions and velocities at the end of the next cycle on the way to a target."""
    after = (
        next_velocity(target[0] - q[0], qd[0], period, speed[0], acceleration[0]),
        next_velocity(target[1] - q[1], qd[1], period, speed[1], acceleration[1]),
        next_velocity(target[2] - q[2], qd[2], period, speed[2], acceleration[2]),
        next_velocity(target[3] - q[3], qd[3], period, speed[3], acceleration[3]),
        next_velocity(target[4] - q[4], qd[4], period, speed[4], acceleration[4]),
        next_velocity(target[5] - q[5], qd[5], period, speed[5], acceleration[5]),
    )
    return _gone(period, q, qd, after), after


@kernel
def to_rest(period: float, q: Six, qd: Six, brakes: Six) -> tuple[Six, Six]:
    """Return positions and velocities at the end of the next cycle when all joints brake."""
    after = (
        braking_velocity(qd[0], period, brakes[0]),
        braking_velocity(qd[1], period, brakes[1]),
        braking_velocity(qd[2], period, brakes[2]),
        braking_velocity(qd[3], period, brakes[3]),
        braking_velocity(qd[4], period, brakes[4]),
        braking_velocity(qd[5], period, brakes[5]),
    )
    return _gone(period, q, qd, after), after


@kernel
def rest_of(period: float, q: Six, qd: Six, brakes: Six) -> Six:
    """Return where all joints come to rest if they brake from here."""
    return (
        q[0] + braking_distance(qd[0], period, brakes[0]),
        q[1] + braking_distance(qd[1], period, brakes[1]),
        q[2] + braking_distance(qd[2], period, brakes[2]),
        q[3] + braking_distance(qd[3], period, brakes[3]),
        q[4] + braking_distance(qd[4], period, brakes[4]),
        q[5] + braking_distance(qd[5], period, brakes[5]),
    )


@kernel
def braking_times(period: float, qd: Six, brakes: Six) -> Six:
    """Return the time that each joint needs to come to rest (s)."""
    return (
        period * braking_cycles(qd[0], period, brakes[0]),
        period * braking_cycles(qd[1], period, brakes[1]),
        period * braking_cycles(qd[2], period, brakes[2]),
        period * braking_cycles(qd[3], period, brakes[3]),
        period * braking_cycles(qd[4], period, brakes[4]),
        period * braking_cycles(qd[5], period, brakes[5]),
    )


@kernel
def _brakes_at(angle: float, velocity: float, now: float, time: float) -> float:
    return angle + velocity * (now - 0.5 * now * now / time if now < time else 0.5 * time)


@kernel
def braked_for(now: float, q: Six, qd: Six, times: Six) -> Six:
    """Return where the joints are `now` seconds after they began to brake from here; `times` are
    their braking times."""
    return (
        _brakes_at(q[0], qd[0], now, times[0]),
        _brakes_at(q[1], qd[1], now, times[1]),
        _brakes_at(q[2], qd[2], now, times[2]),
        _brakes_at(q[3], qd[3], now, times[3]),
        _brakes_at(q[4], qd[4], now, times[4]),
        _brakes_at(q[5], qd[5], now, times[5]),
    )


def reach_time(error: Vector, velocity: Vector, speed: Vector, acceleration: Vector) -> Vector:
    """Return the least time (s) to come to rest `error` rad away, from `velocity` rad/s, under the
    limits; any shapes that broadcast.

    Continuous time (triangular or trapezoidal velocity profile); `Trajectory` needs at most two
    cycles more.
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
    """Return limits (speed, acceleration), each (6,), under which all joints start and end a move
    from rest together.

    Stretching the time of a joint by 1 / s scales its speed by s and its acceleration by s^2.
    """
    times = reach_time(error, np.zeros_like(error), speed, acceleration)
    longest = float(times.max())
    scale = np.maximum(times / longest, SLOWEST) if longest > 0.0 else np.ones_like(times)
    return speed * scale, acceleration * scale * scale


_STILL: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SLOWEST = 0.05
"""Least scale of a synchronised joint; a joint with almost nothing to do may finish early."""


def six(values: Iterable[float]) -> Six:
    """Return six floats. Raises ValueError for fewer or more."""
    a, b, c, d, e, f = map(float, values)
    return a, b, c, d, e, f


class Trajectory:
    """The commanded motion of the arm's joints, advanced by one period per call. Angles in rad,
    speeds in rad/s.

    `target` None means: come to rest. Limits may change at any time; a joint beyond new limits
    brakes into them. Braking to rest always uses the accelerations given first.
    """

    def __init__(
        self,
        q: Sequence[float],
        period: float,
        speed: Sequence[float],
        acceleration: Sequence[float],
    ) -> None:
        self.period = period
        self.q: Six = six(q)
        self.qd: Six = _STILL
        self.target: Six | None = None
        self.brakes: Six = six(acceleration)
        self.limit(speed, acceleration)

    def limit(self, speed: Sequence[float], acceleration: Sequence[float]) -> None:
        """Use these limits from now on (rad/s, rad/s^2, one per joint)."""
        self.speed: Six = six(speed)
        self.acceleration: Six = six(acceleration)
        if not (min(self.speed) > 0.0 and min(self.acceleration) > 0.0):
            raise ValueError(
                f"trajectory limits: expected positive numbers, got {self.speed} rad/s and "
                f"{self.acceleration} rad/s^2"
            )

    def aim(self, target: Sequence[float] | None) -> None:
        """Go to a joint pose, or come to rest (None)."""
        self.target = None if target is None else six(target)

    def reset(self, q: Sequence[float]) -> None:
        """Stand still at `q`."""
        self.q, self.qd, self.target = six(q), _STILL, None

    def proposed(self) -> tuple[Six, Six]:
        """Return position and velocity at the end of the next cycle toward the target."""
        if self.target is None:
            return self.braking()
        return toward(self.period, self.q, self.qd, self.target, self.speed, self.acceleration)

    def braking(self) -> tuple[Six, Six]:
        """Return position and velocity at the end of the next cycle when all joints brake."""
        return to_rest(self.period, self.q, self.qd, self.brakes)

    def resting(self, q: Six, qd: Six) -> Six:
        """Return where all joints come to rest if they brake from here."""
        return rest_of(self.period, q, qd, self.brakes)

    def stopping(self, q: Six, qd: Six, *shares: float) -> Iterator[Six]:
        """Yield where the joints are after shares of the braking time from here; the slowest joint
        decides that time."""
        times = braking_times(self.period, qd, self.brakes)
        longest = max(times)
        for share in shares:
            yield braked_for(share * longest, q, qd, times)

    def accept(self, q: Six, qd: Six) -> None:
        """Make a proposed or braking state the present one."""
        self.q, self.qd = q, qd

    @property
    def still(self) -> bool:
        """Whether the commanded motion is at rest."""
        return not any(self.qd)

    def arrived(self, tolerance: float = 1e-6) -> bool:
        """Return whether the commanded motion rests on its target, within a tolerance (rad)."""
        if self.target is None:
            return self.still
        return self.still and all(
            abs(t - q) <= tolerance for t, q in zip(self.target, self.q, strict=True)
        )
