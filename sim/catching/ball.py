"""Motion of the ball where it is known exactly: sliding and rolling on the flat table, and free
flight.

A ball on a table slides while its lowest point moves, then rolls. With sliding friction mu the slip
velocity keeps its direction and decreases at mu g (1 + 1/k), where k = I / (m r^2); a rolling ball
then loses c g of speed per second (c: coefficient of rolling resistance). Both phases have closed
forms, so there is no step size. Source: rigid-body mechanics of a sphere on a plane (e.g. W. C.
Marlow, "The Physics of Pocket Billiards", 1995).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from msgspec import Struct


class BallState(NamedTuple):
    """Centre (m), velocity (m/s) and spin (rad/s) of the ball in the base frame, each (x, y, z)."""

    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    spin: tuple[float, float, float]


class BallModel(Struct, frozen=True):
    """Constants of the ball for all throws; `inertia_factor` is k = I / (m r^2), `friction` the
    sliding coefficient."""

    radius: float
    mass: float
    inertia_factor: float
    gravity: float
    friction: float

    @classmethod
    def of(cls, ball: Mapping[str, Any], friction: float) -> BallModel:
        """Read the `[ball]` table of cell.toml; `friction` is the true one."""
        return cls(ball["radius"], ball["mass"], ball["inertia_factor"], ball["gravity"], friction)

    def spin_of_rolling(
        self, vx: float, vy: float, share: float = 1.0
    ) -> tuple[float, float, float]:
        """Return the spin (rad/s) of a ball that rolls with horizontal velocity (vx, vy), times
        `share`."""
        return (-share * vy / self.radius, share * vx / self.radius, 0.0)


class TableMotion:
    """Motion on a flat table from a start state, as a function of the time since then; height is
    not part of it."""

    def __init__(self, model: BallModel, start: BallState, rolling_resistance: float) -> None:
        self._model = model
        self._p = start.position
        self._v = start.velocity[0], start.velocity[1]
        self._w = start.spin
        slip_x = self._v[0] - model.radius * start.spin[1]
        slip_y = self._v[1] + model.radius * start.spin[0]
        slip = math.hypot(slip_x, slip_y)
        self._slip = (slip_x / slip, slip_y / slip) if slip > 0.0 else (0.0, 0.0)
        self._sliding = model.friction * model.gravity
        self.rolls_after = slip / (self._sliding * (1.0 + 1.0 / model.inertia_factor))
        """Time until sliding ends (s)."""
        t = self.rolls_after
        self._q = self._slide_position(t)
        self._u = self._slide_velocity(t)
        self._deceleration = rolling_resistance * model.gravity
        speed = math.hypot(*self._u)
        self._heading = (self._u[0] / speed, self._u[1] / speed) if speed > 0.0 else (0.0, 0.0)
        self._speed = speed
        self.rests_after = t + (
            speed / self._deceleration if self._deceleration > 0.0 else math.inf
        )
        """Time until the ball lies still (s)."""

    def _slide_position(self, t: float) -> tuple[float, float]:
        half = 0.5 * self._sliding * t * t
        return (
            self._p[0] + self._v[0] * t - half * self._slip[0],
            self._p[1] + self._v[1] * t - half * self._slip[1],
        )

    def _slide_velocity(self, t: float) -> tuple[float, float]:
        lost = self._sliding * t
        return self._v[0] - lost * self._slip[0], self._v[1] - lost * self._slip[1]

    def state(self, t: float) -> BallState:
        """Return the state `t` >= 0 seconds after the start."""
        z = self._p[2]
        if t < self.rolls_after:
            x, y = self._slide_position(t)
            vx, vy = self._slide_velocity(t)
            gained = self._sliding * t / (self._model.inertia_factor * self._model.radius)
            spin = (
                self._w[0] - gained * self._slip[1],
                self._w[1] + gained * self._slip[0],
                self._w[2],
            )
            return BallState((x, y, z), (vx, vy, 0.0), spin)
        rolled = min(t, self.rests_after) - self.rolls_after
        way = self._speed * rolled - 0.5 * self._deceleration * rolled * rolled
        speed = max(0.0, self._speed - self._deceleration * rolled) if t < self.rests_after else 0.0
        vx, vy = speed * self._heading[0], speed * self._heading[1]
        wx, wy, _ = self._model.spin_of_rolling(vx, vy)
        x, y = self._q[0] + way * self._heading[0], self._q[1] + way * self._heading[1]
        return BallState((x, y, z), (vx, vy, 0.0), (wx, wy, self._w[2]))

    def first_crossing(self, axis: int, value: float) -> float:
        """Return the seconds until the centre's x (axis 0) or y (axis 1) first equals `value`; inf
        if never."""
        sliding = _first_root(
            self._p[axis] - value,
            self._v[axis],
            -0.5 * self._sliding * self._slip[axis],
            self.rolls_after,
        )
        if sliding < math.inf:
            return sliding
        rolling = _first_root(
            self._q[axis] - value,
            self._u[axis],
            -0.5 * self._deceleration * self._heading[axis],
            self.rests_after - self.rolls_after,
        )
        return self.rolls_after + rolling


class UnevenMotion:
    """Motion on a table with slopes, from a start state, as a function of the time since then: as
    `TableMotion`, but integrated in steps of `_STEP`.

    On a slope s the ball gains -g s of speed a second while it slides, and 1 / (1 + k) of that
    while it rolls, since its spin must grow as well (k = I / (m r^2)). Height is not part of it.
    """

    def __init__(
        self,
        model: BallModel,
        start: BallState,
        rolling_resistance: float,
        slope: Callable[[float, float], tuple[float, float]],
    ) -> None:
        """`slope` returns the rise of the table per m along x and y at a point (m)."""
        self._z, self._spin_z = start.position[2], start.spin[2]
        self._path = [start]
        g, r, k = model.gravity, model.radius, model.inertia_factor
        (x, y, _), (vx, vy, _), (wx, wy, _) = start
        for _ in range(round(_LONGEST / _STEP)):
            rise_x, rise_y = slope(x, y)
            before_x, before_y = vx, vy
            slip_x, slip_y = vx - r * wy, vy + r * wx
            slip = math.sqrt(slip_x * slip_x + slip_y * slip_y)
            rub = model.friction * g * _STEP
            if slip > rub * (1.0 + 1.0 / k):
                vx -= rub * slip_x / slip + g * rise_x * _STEP
                vy -= rub * slip_y / slip + g * rise_y * _STEP
                wx -= rub * slip_y / slip / (k * r)
                wy += rub * slip_x / slip / (k * r)
            else:
                # What is left of the slip goes within this step: the momentum about the point of
                # contact is kept.
                vx, vy = (vx + k * r * wy) / (1.0 + k), (vy - k * r * wx) / (1.0 + k)
                vx -= g * rise_x * _STEP / (1.0 + k)
                vy -= g * rise_y * _STEP / (1.0 + k)
                speed = math.sqrt(vx * vx + vy * vy)
                left = max(0.0, 1.0 - rolling_resistance * g * _STEP / speed) if speed else 0.0
                vx, vy = left * vx, left * vy
                wx, wy, _ = model.spin_of_rolling(vx, vy)
            x, y = x + 0.5 * (before_x + vx) * _STEP, y + 0.5 * (before_y + vy) * _STEP
            self._path.append(BallState((x, y, self._z), (vx, vy, 0.0), (wx, wy, self._spin_z)))
            steep = math.hypot(*slope(x, y)) > rolling_resistance * (1.0 + k)
            if vx == vy == 0.0 and not steep:
                break
        self.rests_after = _STEP * (len(self._path) - 1)
        """Time until the ball lies still, or until the path is not known any further (s)."""

    def state(self, t: float) -> BallState:
        """Return the state `t` >= 0 seconds after the start."""
        at = t / _STEP
        n = int(at)
        if n >= len(self._path) - 1:
            (x, y, z), _, _ = self._path[-1]
            return BallState((x, y, z), (0.0, 0.0, 0.0), (0.0, 0.0, self._spin_z))
        share, one, two = at - n, self._path[n], self._path[n + 1]
        (ax, ay, az), (avx, avy, _), (awx, awy, awz) = one
        (bx, by, _), (bvx, bvy, _), (bwx, bwy, _) = two
        return BallState(
            (ax + share * (bx - ax), ay + share * (by - ay), az),
            (avx + share * (bvx - avx), avy + share * (bvy - avy), 0.0),
            (awx + share * (bwx - awx), awy + share * (bwy - awy), awz),
        )

    def first_crossing(self, axis: int, value: float) -> float:
        """Return the seconds until the centre's x (axis 0) or y (axis 1) first equals `value`; inf
        if never."""
        before = self._path[0].position[axis] - value
        if before == 0.0:
            return 0.0
        for n, state in enumerate(self._path[1:]):
            after = state.position[axis] - value
            if before * after <= 0.0:
                return _STEP * (n + before / (before - after))
            before = after
        return math.inf


_STEP = 0.001
"""s."""
_LONGEST = 12.0
"""A time longer than a ball is left on the table (s)."""


def _first_root(c: float, b: float, a: float, until: float) -> float:
    """Return the smallest t in [0, until] with a t^2 + b t + c = 0; inf if there is none."""
    if a == 0.0:
        roots = [-c / b] if b != 0.0 else []
    else:
        discriminant = b * b - 4.0 * a * c
        if discriminant < 0.0:
            return math.inf
        # The stable form: no difference of nearly equal numbers (Press et al., Numerical Recipes,
        # section 5.6).
        q = -0.5 * (b + math.copysign(math.sqrt(discriminant), b))
        roots = [q / a] + ([c / q] if q != 0.0 else [])
    return min((t for t in roots if 0.0 <= t <= until), default=math.inf)


def fly(start: BallState, t: float, gravity: float) -> BallState:
    """Return the state after `t` seconds of free flight without air drag; the spin is kept."""
    (x, y, z), (vx, vy, vz), spin = start
    return BallState(
        (x + vx * t, y + vy * t, z + vz * t - 0.5 * gravity * t * t),
        (vx, vy, vz - gravity * t),
        spin,
    )
