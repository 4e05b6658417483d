"""The rover's body: wheels that lag, slip and skid, a battery whose voltage drops, and the
resulting motion.

Differential drive. Between two moments at which anything changes, the wheels' speeds have a closed
form (first-order lag of a constant set point), and the body moves along a circular arc. So it is
moved only when its state is needed or something changes.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from petrobot.sim.track.course import FloorPose
from petrobot.sim.track.truth import RoverTruth

SLOT: Final = 0.02
"""Time between two draws of slip and two updates of the battery (s)."""
_DRAWN: Final = 256
"""Slips drawn at a time."""

_CAUGHT_UP: Final = 1e-6
"""Difference from its set point at which a wheel has caught up (rad/s)."""
_STUCK: Final = 0.01
"""Speed below which a wheel that is to stand sticks by dry friction (rad/s): 1 mm/s."""


class Wheel:
    """One wheel: its speed follows the set point with a lag, or its brake holds it."""

    def __init__(self) -> None:
        self.radius, self.lag = 0.0, 1.0  # until the rover is placed
        self.target = 0.0
        """Set point of its motor (rad/s)."""
        self.speed = 0.0
        self.angle = 0.0
        """Angle turned since the beginning (rad); the encoder counts this."""
        self.braked = True

    def turn(self, dt: float, brake_lag: float) -> float:
        """Turn for `dt` seconds; return the angle turned (rad)."""
        target, lag = (0.0, brake_lag) if self.braked else (self.target, self.lag)
        excess = self.speed - target
        if excess == 0.0:
            turned = target * dt
        else:
            # First-order lag with time constant T: w(t) = c + (w0 - c) exp(-t / T), integrated over
            # dt.
            rest = math.exp(-dt / lag)
            turned = target * dt + excess * lag * (1.0 - rest)
            self.speed = target + excess * rest
            near = _STUCK if target == 0.0 else _CAUGHT_UP
            if -near < self.speed - target < near:
                self.speed = target
        self.angle += turned
        return turned


class RoverBody:
    """Wheels 0 (left) and 1 (right) and the body on them. `move_to` advances it to a moment; times
    are on the caller's clock (s)."""

    def __init__(self, truth: RoverTruth, rng: np.random.Generator) -> None:
        """`rng` draws the slip."""
        self.wheels = (Wheel(), Wheel())
        self.now = 0.0
        self.place(truth, FloorPose(0.0, 0.0, 0.0), rng)

    def place(self, truth: RoverTruth, pose: FloorPose, rng: np.random.Generator) -> None:
        """Put this rover somewhere, standing; its encoders keep their counts."""
        self.truth = truth
        self.x, self.y, self.heading = pose
        self._rng = rng
        for wheel, true in zip(self.wheels, truth.wheels, strict=True):
            wheel.radius, wheel.lag, wheel.speed = true.radius, true.lag, 0.0
        self.speed = self.turn = 0.0
        """Speed along the heading (m/s) and turn (rad/s), averaged over the last motion."""
        self._slips = np.zeros((0, 2)).tolist()
        self._slip = [0.0, 0.0]
        self._slot = self._placed = self.now
        self._lasted: list[float] = [0.0, 0.0]
        self.torques = [0.0, 0.0]
        """Torques of the motors (N m)."""
        self.voltage = truth.battery[0]
        self._keep = math.exp(-SLOT / truth.slip_time)
        self._fresh = truth.slip * math.sqrt(1.0 - self._keep * self._keep)

    @property
    def pose(self) -> FloorPose:
        """Where it is."""
        return FloorPose(self.x, self.y, self.heading)

    @property
    def standing(self) -> bool:
        """Whether neither wheel turns."""
        left, right = self.wheels
        return left.speed == 0.0 and right.speed == 0.0

    @property
    def top_speed(self) -> float:
        """Speed that a wheel reaches with the present voltage (rad/s)."""
        return self.truth.top_speed * self.voltage / self.truth.nominal_voltage

    def move_to(self, now: float) -> None:
        """Advance the rover to `now`."""
        while self._slot + SLOT <= now + 1e-9:
            self._slot += SLOT
            self._move(self._slot)
            self._begin_slot()
        if now > self.now + 1e-12:
            self._move(now)

    def _move(self, now: float) -> None:
        dt = now - self.now
        if dt <= 0.0:
            return
        self.now = now
        left, right = self.wheels
        brake_lag = self.truth.settings["brake_lag"]
        turned_left, turned_right = left.turn(dt, brake_lag), right.turn(dt, brake_lag)
        if turned_left == 0.0 and turned_right == 0.0:
            self.speed = self.turn = 0.0
            return
        slip_left, slip_right = self._slip
        way_left = turned_left * left.radius * (1.0 - slip_left)
        way_right = turned_right * right.radius * (1.0 - slip_right)
        self._drive(
            dt, 0.5 * (way_left + way_right), (way_right - way_left) / self.truth.track_width
        )

    def _drive(self, dt: float, way: float, turned: float) -> None:
        """Move along an arc; lateral acceleration reduces the turn and pushes the body outwards."""
        truth = self.truth
        lateral = way * turned / (dt * dt)
        turned /= 1.0 + truth.slip_turn * abs(lateral)
        aside = -truth.slip_aside * lateral * dt
        middle = self.heading + 0.5 * turned
        # 2 R sin(turn / 2) to second order; the turn of one slot is small.
        chord = way * (1.0 - turned * turned / 24.0)
        c, s = math.cos(middle), math.sin(middle)
        self.x += chord * c - aside * s
        self.y += chord * s + aside * c
        self.heading += turned
        self.speed, self.turn = way / dt, turned / dt

    def _begin_slot(self) -> None:
        """Draw new slip; compute the averages of motors and battery over the finished slot."""
        if not self._slips:
            self._slips = self._rng.standard_normal((_DRAWN, 2)).tolist()
        fresh, keep, slip = self._slips.pop(), self._keep, self._slip
        # First-order Gauss-Markov process: x' = k x + sigma sqrt(1 - k^2) n keeps the variance
        # sigma^2.
        self._slip = [
            keep * slip[0] + self._fresh * fresh[0],
            keep * slip[1] + self._fresh * fresh[1],
        ]
        settings, power = self.truth.settings, self.truth.settings["electronics"]
        for side, wheel in enumerate(self.wheels):
            rising = (wheel.speed - self._lasted[side]) / SLOT
            self._lasted[side] = wheel.speed
            drag = math.copysign(settings["friction"], wheel.speed) if wheel.speed else 0.0
            self.torques[side] = 0.0 if wheel.braked else drag + settings["inertia"] * rising
            power += max(0.0, self.torques[side] * wheel.speed)
        start, fall, resistance = self.truth.battery
        idle = start - fall * (self.now - self._placed)
        self.voltage = max(0.0, idle - resistance * power / max(self.voltage, 1.0))
