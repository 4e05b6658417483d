"""The position loop inside one drive: interpolation between cyclic set points, cascade control,
quick-stop ramp."""

from __future__ import annotations

import math
from dataclasses import dataclass


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


class JointServo:
    """Torque for one joint from set points that arrive once per period.

    Between set points the reference is a uniform quadratic B-spline of the last three: continuous
    in velocity, exact at rest, one and a half periods behind. Torque = J (a + Kv (v + Kp e - qd)) +
    integral, at most the rated torque.
    """

    def __init__(self, rating: DriveRating, q: float) -> None:
        self.rating = rating
        self._most, self._inertia = rating.torque, rating.inertia
        self._stiffness = rating.inertia * VELOCITY_GAIN
        self._integration = self._stiffness * INTEGRAL_GAIN
        self.limit = rating.speed
        self.period = 0.004
        self.limited = False
        self.start(q)

    def start(self, q: float) -> None:
        """Begin to hold here, with an empty integrator."""
        self._pass(q, q, q)
        self._since = 0.0
        self._integral = 0.0
        self._ramp: float | None = None
        self.error = 0.0

    def aim(self, target: float) -> None:
        """Take the next set point (rad); one that requires more than the greatest speed is cut and
        sets `limited`."""
        if self._ramp is not None:
            return
        _, before, last = self._points
        if target == last and self.standing:
            self.limited = False
            return
        most = self.limit * self.period
        step = target - last
        self.limited = abs(step) > most * (1.0 + 1e-3)
        if self.limited:
            target = last + math.copysign(most, step)
        self._pass(before, last, target)
        self._since = 0.0

    def ramp_down(self, deceleration: float) -> None:
        """Bring the reference to rest at so many rad/s^2 and stay there."""
        self._ramp = deceleration

    @property
    def ramped_down(self) -> bool:
        """Whether a ramp has ended."""
        return self._ramp is not None and self.velocity == 0.0

    def follow(self, target: float) -> None:
        """Leave the ramp and take set points again from where the reference is."""
        self._ramp = None
        self._pass(self.reference, self.reference, self.reference)
        self.aim(target)

    def torque(self, q: float, qd: float, dt: float) -> float:
        """Return the torque (N m) for the next `dt` seconds from the measured angle and speed."""
        if self._ramp is not None:
            self._decelerate(dt)
        elif not self.standing:
            self._interpolate(dt)
        self.error = error = self.reference - q
        most, integral = self._most, self._integral
        wanted = self.velocity + POSITION_GAIN * error - qd
        tau = self._inertia * self._acceleration + self._stiffness * wanted + integral
        if not -most < tau < most:
            return math.copysign(most, tau)
        if not self.standing or not -DEAD_BAND < error < DEAD_BAND:
            self._integral = integral + self._integration * wanted * dt
        return tau

    @property
    def settled(self) -> bool:
        """Whether a joint that stands still gets the same torque from now on."""
        return self.standing and -DEAD_BAND < self.error < DEAD_BAND

    def _pass(self, a: float, b: float, c: float) -> None:
        """Interpolate between these set points from now on."""
        self._points = a, b, c
        self.standing = a == b == c
        self.reference = self._from = 0.5 * (a + b)
        self.velocity = self._rise = (b - a) / self.period
        self._acceleration = (a - 2.0 * b + c) / (self.period * self.period)

    def _interpolate(self, dt: float) -> None:
        since = self._since + dt
        # A SYNC is missing: as if the last set point had come again.
        if since > self.period + 1e-9:
            _, b, c = self._points
            self._pass(b, c, c)
            since -= self.period
        self._since = since
        since += CYCLE - dt
        self.velocity = speed = self._rise + self._acceleration * since
        self.reference = self._from + 0.5 * (self._rise + speed) * since

    def _decelerate(self, dt: float) -> None:
        assert self._ramp is not None
        before = self.velocity
        change = self._ramp * dt
        self.velocity = 0.0 if abs(before) <= change else before - math.copysign(change, before)
        self._acceleration = (self.velocity - before) / dt
        self.standing = before == 0.0
        self.reference += 0.5 * (before + self.velocity) * dt
