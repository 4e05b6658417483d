"""The position loop inside a drive: interpolation between cyclic set points, cascade control,
quick-stop ramp.

The numbers of each servo are a row that the kernels read and write: compiled, one call computes the
torques of all six.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from petrobot.services.host.numba_kernels import kernel, rows_for
from petrobot.sim.catching.arm_motion import Six


@dataclass(frozen=True, slots=True)
class DriveRating:
    """What a drive was sized and commissioned for, at the joint: torque (N m), speed (rad/s),
    expected inertia (kg m^2)."""

    torque: float
    speed: float
    inertia: float


POSITION_GAIN = 45.0
"""1/s, of the position loop."""
VELOCITY_GAIN = 180.0
"""1/s, of the velocity loop; multiplied by the inertia it gives a torque."""
INTEGRAL_GAIN = 40.0
"""1/s, of the velocity loop's integrator: it carries gravity and friction, as in drives without a
model of the arm."""
CYCLE = 0.001
"""s, cycle of the loop inside the drive.

The loop compares the angle with where the joint is to be at the end of its cycle, whatever the step
size of the plant. So steps of 2 ms lead to the same path as steps of 1 ms, to 0.2 mm at the cup
(tests/sim/test_puma.py).
"""
DEAD_BAND = 1e-4
"""rad; while the set point is constant and the error is smaller, the integrator keeps its value, as
in commercial drives, so that integrator and dry friction do not oscillate.

This project's choice, small compared with the 0.5 degrees within which the arm counts as being at
home; no data sheet states it.
"""


# The row of a servo. The last three set points (rad); where the interpolation between them began
# (rad), its speed there (rad/s), its acceleration (rad/s^2), and the seconds since.
FIRST, BEFORE, LAST, FROM, RISE, ACCELERATION, SINCE = range(7)
# The reference now (rad, rad/s), and whether it stands (1 or 0).
REFERENCE, VELOCITY, STANDING = range(7, 10)
# Torque of the integrator (N m), following error (rad), and the window of the latter (rad).
INTEGRAL, ERROR, WINDOW = range(10, 13)
# Deceleration of a ramp to rest (rad/s^2; less than 0: there is none).
RAMP: Final = 13
# What follows from the rating: torque (N m), inertia (kg m^2), gains; and the period (s).
MOST, INERTIA, STIFFNESS, INTEGRATION, PERIOD = range(14, 19)
WIDTH: Final = 19

Row = Any
"""Numbers of a servo: a row of a numpy array if kernels are compiled, else a list."""


@kernel
def torque(row: Row, q: float, qd: float, dt: float) -> float:
    """Return the torque (N m) for the next `dt` seconds from the measured angle and speed."""
    if row[RAMP] >= 0.0:
        _decelerate(row, dt)
    elif row[STANDING] == 0.0:
        _interpolate(row, dt)
    row[ERROR] = error = row[REFERENCE] - q
    most, integral = row[MOST], row[INTEGRAL]
    wanted = row[VELOCITY] + POSITION_GAIN * error - qd
    tau: float = row[INERTIA] * row[ACCELERATION] + row[STIFFNESS] * wanted + integral
    if not -most < tau < most:
        return math.copysign(most, tau)
    if row[STANDING] == 0.0 or not -DEAD_BAND < error < DEAD_BAND:
        row[INTEGRAL] = integral + row[INTEGRATION] * wanted * dt
    return tau


@kernel
def torques(rows: Any, q: Six, qd: Six, dt: float) -> tuple[Six, bool]:
    """Return the torques of six servos, and whether all following errors are within their
    windows."""
    tau = (
        torque(rows[0], q[0], qd[0], dt),
        torque(rows[1], q[1], qd[1], dt),
        torque(rows[2], q[2], qd[2], dt),
        torque(rows[3], q[3], qd[3], dt),
        torque(rows[4], q[4], qd[4], dt),
        torque(rows[5], q[5], qd[5], dt),
    )
    for joint in range(6):
        row = rows[joint]
        if not -row[WINDOW] <= row[ERROR] <= row[WINDOW]:
            return tau, False
    return tau, True


@kernel
def aimed(row: Row, target: float, most: float) -> bool:
    """Take the next set point (rad), at most `most` rad from the last one; return whether it was
    cut."""
    before, last = row[BEFORE], row[LAST]
    if target == last and row[STANDING] != 0.0:
        return False
    step = target - last
    cut: bool = abs(step) > most * (1.0 + 1e-3)
    if cut:
        target = last + math.copysign(most, step)
    passed(row, before, last, target)
    row[SINCE] = 0.0
    return cut


@kernel
def passed(row: Row, a: float, b: float, c: float) -> None:
    """Interpolate between these set points from now on."""
    period = row[PERIOD]
    row[FIRST], row[BEFORE], row[LAST] = a, b, c
    row[STANDING] = 1.0 if a == b == c else 0.0
    row[REFERENCE] = row[FROM] = 0.5 * (a + b)
    row[VELOCITY] = row[RISE] = (b - a) / period
    row[ACCELERATION] = (a - 2.0 * b + c) / (period * period)


@kernel
def _interpolate(row: Row, dt: float) -> None:
    since, period = row[SINCE] + dt, row[PERIOD]
    # A SYNC is missing: as if the last set point had come again.
    if since > period + 1e-9:
        passed(row, row[BEFORE], row[LAST], row[LAST])
        since -= period
    row[SINCE] = since
    since += CYCLE - dt
    rise = row[RISE]
    row[VELOCITY] = speed = rise + row[ACCELERATION] * since
    row[REFERENCE] = row[FROM] + 0.5 * (rise + speed) * since


@kernel
def _decelerate(row: Row, dt: float) -> None:
    before = row[VELOCITY]
    change = row[RAMP] * dt
    row[VELOCITY] = after = 0.0 if abs(before) <= change else before - math.copysign(change, before)
    row[ACCELERATION] = (after - before) / dt
    row[STANDING] = 1.0 if before == 0.0 else 0.0
    row[REFERENCE] += 0.5 * (before + after) * dt


class JointServo:
    """Torque for one joint from set points that arrive once per period.

    Between set points the reference is a uniform quadratic B-spline of the last three: continuous
    in velocity, exact at rest, one and a half periods behind. Torque = J (a + Kv (v + Kp e - qd)) +
    integral, at most the rated torque.
    """

    def __init__(self, rating: DriveRating, q: float, row: Row = None) -> None:
        """`row`: where its numbers are kept (`WIDTH`), if beside those of others."""
        self.rating = rating
        self._row = row = rows_for(torque, 1, WIDTH)[0] if row is None else row
        row[MOST], row[INERTIA] = rating.torque, rating.inertia
        row[STIFFNESS] = rating.inertia * VELOCITY_GAIN
        row[INTEGRATION] = row[STIFFNESS] * INTEGRAL_GAIN
        row[WINDOW] = math.inf
        self.limit = rating.speed
        self.period = 0.004
        self.limited = False
        self.start(q)

    @property
    def period(self) -> float:
        """Time between two set points (s)."""
        return self._period

    @period.setter
    def period(self, period: float) -> None:
        self._period = self._row[PERIOD] = period

    def start(self, q: float) -> None:
        """Begin to hold here, with an empty integrator."""
        row = self._row
        passed(row, q, q, q)
        row[SINCE] = row[INTEGRAL] = row[ERROR] = 0.0
        self._ramps, row[RAMP] = False, -1.0

    def aim(self, target: float) -> None:
        """Take the next set point (rad); one that requires more than the greatest speed is cut and
        sets `limited`."""
        if not self._ramps:
            self.limited = aimed(self._row, target, self.limit * self._period)

    def ramp_down(self, deceleration: float) -> None:
        """Bring the reference to rest at so many rad/s^2 and stay there."""
        self._ramps, self._row[RAMP] = True, deceleration

    @property
    def ramped_down(self) -> bool:
        """Whether a ramp has ended."""
        return self._ramps and self.velocity == 0.0

    def follow(self, target: float) -> None:
        """Leave the ramp and take set points again from where the reference is."""
        self._ramps, self._row[RAMP] = False, -1.0
        here = self.reference
        passed(self._row, here, here, here)
        self.aim(target)

    def torque(self, q: float, qd: float, dt: float) -> float:
        """Return the torque (N m) for the next `dt` seconds from the measured angle and speed."""
        return torque(self._row, q, qd, dt)

    @property
    def settled(self) -> bool:
        """Whether a joint that stands still gets the same torque from now on."""
        return self.standing and -DEAD_BAND < self.error < DEAD_BAND

    @property
    def standing(self) -> bool:
        """Whether the reference stands still."""
        return bool(self._row[STANDING] != 0.0)

    @property
    def reference(self) -> float:
        """Where the joint is to be now (rad)."""
        return float(self._row[REFERENCE])

    @property
    def velocity(self) -> float:
        """Speed of the reference (rad/s)."""
        return float(self._row[VELOCITY])

    @property
    def error(self) -> float:
        """Following error (rad): how far the joint is from the reference."""
        return float(self._row[ERROR])

    @property
    def window(self) -> float:
        """Greatest following error that is normal (rad)."""
        return float(self._row[WINDOW])

    @window.setter
    def window(self, window: float) -> None:
        self._row[WINDOW] = window

    @property
    def off(self) -> bool:
        """Whether the following error is beyond the window."""
        row = self._row
        return not -row[WINDOW] <= row[ERROR] <= row[WINDOW]
