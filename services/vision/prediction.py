"""Where and when a rolling ball leaves the table, from where it was seen: three predictors of
different cost.

A ball on a table first slides, while its spin is less than that of pure rolling: a hollow ball with
spin share s settles at (3 + 2 s) / 5 of its speed (conservation of angular momentum about the
contact point, with I = 2/3 m r^2). Then it rolls and loses a constant c g of speed per second. It
stays on a straight line all the time. The coefficient c is known to +-30 % only; sliding ends some
tenths of a second after the release. Pure; s, m, base frame.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLIDING, SLIDING_SIGMA = 2.5, 1.5
"""m/s^2, deceleration of a sliding ball before anything is known: friction coefficient 0.25 +- 0.15
times g."""
LARGEST_LOSS, LOSS_SIGMA = 0.12, 0.02
"""Largest share of its speed that a ball loses by sliding, and how sharp that bound is. As measured
in one installation: 0.12 was the most of 30 throws. Where balls are thrown with less spin this
prior is wrong (without any, a ball loses 0.4)."""


class ExitWay(StrEnum):
    """How a ball leaves the table, if it does."""

    NEAR_EDGE = "near_edge"
    SIDE = "side"
    STAYS = "stays"
    """It stops before an edge, or rolls away from the near one."""


class PredictedExit(Struct, frozen=True):
    """Prediction of where the ball's centre passes the edge.

    `time` on the clock of the observations, `point` and `velocity` (2,), standard deviations of the
    time and of the place along the edge. For `ExitWay.STAYS` the time is inf.
    """

    way: ExitWay
    time: float
    point: Array
    velocity: Array
    sigma_time: float
    sigma_place: float


class Surface(Struct, frozen=True):
    """The table as the ball's centre meets it, and how it slows the ball.

    `rolling` and `rolling_sigma`: deceleration of a rolling ball and its uncertainty (m/s^2);
    `noise`: standard deviation of a measured place (m).
    """

    near_edge: float
    half_width: float
    rolling: float
    rolling_sigma: float
    noise: float = 0.0005

    @classmethod
    def of(cls, cell: Mapping[str, Any]) -> Surface:
        """Read the cell's data; the rolling resistance is uniform within +- 30 % of the nominal."""
        table, ball = cell["table"], cell["ball"]
        rolling = float(ball["rolling_resistance"]) * float(ball["gravity"])
        return cls(
            float(table["near_edge"]),
            float(table["width"]) / 2.0,
            rolling,
            0.30 / np.sqrt(3.0) * rolling,
        )

    def gap(self, place: Array, heading: Sequence[float] | Array) -> tuple[float, ExitWay]:
        """Return the distance along `heading` (2,) from `place` (2,) to the edge that comes first,
        and which one; inf when none does."""
        side = np.inf
        if abs(heading[1]) > 1e-9:
            side = (np.copysign(self.half_width, heading[1]) - place[1]) / heading[1]
        if heading[0] > -1e-9:
            return (
                (float(side), ExitWay.SIDE) if np.isfinite(side) else (float("inf"), ExitWay.STAYS)
            )
        near = (self.near_edge - place[0]) / heading[0]
        return (float(near), ExitWay.NEAR_EDGE) if near <= side else (float(side), ExitWay.SIDE)


class Predictor(Protocol):
    """Takes places one by one and predicts at any time. Every observation costs the same."""

    count: int
    """Number of observations."""

    def add(self, time: float, x: float, y: float, sigma: float | None = None) -> None:
        """Take the place (m) where the ball was seen at a time (s, rising), with its standard
        deviation (m; None: the surface's)."""

    def place(self, time: float) -> Array:
        """Return where the ball is expected (2,). Needs two observations."""

    def exit(self) -> PredictedExit | None:
        """Return how it leaves the table; None before three observations."""


class ConstantVelocity:
    """A straight line of constant speed through the last places. The cheapest; models neither
    sliding nor rolling resistance."""

    def __init__(self, surface: Surface, last: int = 10) -> None:
        self._surface = surface
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=last)
        self.count = 0

    def add(self, time: float, x: float, y: float, sigma: float | None = None) -> None:
        """Take a place (m) seen at a time (s); all count the same."""
        self._rows.append((time, x, y))
        self.count += 1

    def _fit(self) -> tuple[Array, Array, float]:
        rows = np.array(self._rows)
        middle = rows.mean(axis=0)
        off = rows - middle
        square = float(off[:, 0] @ off[:, 0])
        return middle, off[:, 0] @ off[:, 1:] / max(square, 1e-12), square

    def place(self, time: float) -> Array:
        """Return where the ball is expected (2,) m."""
        middle, velocity, _ = self._fit()
        return np.asarray(middle[1:] + velocity * (time - middle[0]))

    def exit(self) -> PredictedExit | None:
        """Return how it leaves the table."""
        if len(self._rows) < 3:
            return None
        middle, velocity, square = self._fit()
        speed = float(np.hypot(*velocity))
        heading = velocity / max(speed, 1e-9)
        gap, way = self._surface.gap(middle[1:], heading)
        if way is ExitWay.STAYS or speed < 1e-3:
            return _stays(middle[1:], velocity)
        ahead = gap / speed
        sigma = self._surface.noise * float(np.sqrt(1.0 / len(self._rows) + ahead * ahead / square))
        facing = abs(heading[0] if way is ExitWay.NEAR_EDGE else heading[1])
        return PredictedExit(
            way,
            float(middle[0]) + ahead,
            middle[1:] + gap * heading,
            velocity,
            sigma / speed,
            sigma / facing,
        )


def _stays(place: Array, velocity: Array) -> PredictedExit:
    return PredictedExit(ExitWay.STAYS, float("inf"), place, velocity, float("inf"), float("inf"))


_PLACES = np.ix_((0, 4, 5), (0, 4, 5))
"""Indices of weight, x and y in the sums of a model."""


class _Solution(NamedTuple):
    """Heading (2,), each model's solution (m, 4), covariance (m, 4, 4) and weight (m,)."""

    heading: tuple[float, float]
    solution: Array
    covariance: Array
    weight: Array


class LeastSquares:
    """Least squares over all places since the ball was first seen.

    The model is a straight line in space; along it a start, a speed, the rolling deceleration (with
    a prior), and sliding that ends at one of several moments. For each moment this is a linear
    model with its own normal equations, which grow by addition. The models are weighted by their
    evidence (J. A. Hoeting et al., Bayesian model averaging: a tutorial, Statistical Science 14,
    1999), so no moment has to be guessed, and the cost per place never grows."""

    MOMENTS = np.array([0.0, 0.02, 0.04, 0.06, 0.08, 0.10, 0.13, 0.16, 0.20, 0.26])
    """When sliding may end, after the first place (s)."""

    def __init__(self, surface: Surface, rolling_sigma: float | None = None) -> None:
        """`rolling_sigma`: 0 treats the surface's rolling deceleration as known; None uses its
        uncertainty."""
        self._surface = surface
        sigma = max(surface.rolling_sigma if rolling_sigma is None else rolling_sigma, 1e-6)
        self._prior = np.array([0.0, 0.0, sigma**-2.0, SLIDING_SIGMA**-2.0])
        self._mean = np.array([0.0, 0.0, surface.rolling, SLIDING])
        self._regular, self._drawn = np.diag(self._prior), self._prior * self._mean
        self._sums = np.zeros((len(self.MOMENTS), 6, 6))
        """Weighted sums of products of each model's row: start, speed, rolling, sliding, x, y."""
        self._origin = (0.0, 0.0, 0.0)
        self._solved: _Solution | None = None
        self.count = 0

    def _basis(self, t: float | Array) -> Array:
        """Return (models, 4) at one time or at each model's own: start, speed, rolling and sliding
        deceleration."""
        basis = np.empty((len(self.MOMENTS), 4))
        self._fill(basis, t)
        return basis

    def _fill(self, rows: Array, t: float | Array) -> None:
        rest = np.maximum(self.MOMENTS - t, 0.0)
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = 1.0, t, -0.5 * t * t, -0.5 * rest * rest

    def add(self, time: float, x: float, y: float, sigma: float | None = None) -> None:
        """Take a place (m) seen at a time (s) with a standard deviation (m)."""
        if self.count == 0:
            self._origin = (time, x, y)
        rows = np.empty((len(self.MOMENTS), 6))
        self._fill(rows, time - self._origin[0])
        rows[:, 4], rows[:, 5] = x - self._origin[1], y - self._origin[2]
        products = rows[:, :, None] * rows[:, None, :]
        self._sums += products if sigma is None else (self._surface.noise / sigma) ** 2 * products
        self.count += 1
        self._solved = None

    def _middle(self) -> tuple[float, float]:
        """Return the mean of the places, relative to the first one."""
        weight, x, y = self._sums[0, 0, (0, 4, 5)].tolist()
        return x / weight, y / weight

    def _scatter(self) -> tuple[float, float, float]:
        """Return the sums of squares of the places about their mean: xx, xy, yy."""
        (weight, x, y), (_, xx, xy), (_, _, yy) = self._sums[0][_PLACES].tolist()
        return xx - x * x / weight, xy - x * y / weight, yy - y * y / weight

    def _heading(self) -> tuple[float, float]:
        """Return the direction of the ball's straight path: principal axis of the places, pointing
        the way the ball moves."""
        xx, xy, yy = self._scatter()
        turn = 0.5 * math.atan2(2.0 * xy, xx - yy)
        hx, hy = math.cos(turn), math.sin(turn)
        # The normal equation of the speed, in the model without sliding, tells the direction.
        (weight, t, x, y), (_, _, tx, ty) = self._sums[0, :2][:, (0, 1, 4, 5)].tolist()
        forward = (tx - t / weight * x) * hx + (ty - t / weight * y) * hy
        return (hx, hy) if forward >= 0.0 else (-hx, -hy)

    def _solve(self) -> _Solution:
        if self._solved is None:
            heading, precision = self._heading(), self._surface.noise**-2.0
            P = self._sums[:, :4, :4] * precision + self._regular
            b = (self._sums[:, :4, 4:] @ heading) * precision + self._drawn
            covariance = np.linalg.inv(P)
            solution = (covariance @ b[:, :, None])[:, :, 0]
            # Log evidence of a linear model with a Gaussian prior; terms that all models share are
            # left out.
            evidence = 0.5 * ((solution * b).sum(axis=1) - np.linalg.slogdet(P)[1])
            # A soft upper bound on the speed lost by sliding rules out implausible models.
            lost = solution[:, 3] * self.MOMENTS / np.maximum(solution[:, 1], 0.05)
            evidence -= 0.5 * np.square(np.maximum(lost - LARGEST_LOSS, 0.0) / LOSS_SIGMA)
            weight = np.exp(evidence - evidence.max())
            self._solved = _Solution(heading, solution, covariance, weight / weight.sum())
        return self._solved

    def place(self, time: float) -> Array:
        """Return where the ball is expected (2,) m."""
        (hx, hy), solution, _, weight = self._solve()
        along = float(weight @ (self._basis(time - self._origin[0]) * solution).sum(axis=1))
        x, y = self._middle()
        ahead = along - (x * hx + y * hy)
        return np.array([self._origin[1] + x + hx * ahead, self._origin[2] + y + hy * ahead])

    def exit(self) -> PredictedExit | None:
        """Return how it leaves the table."""
        if self.count < 3:
            return None
        heading, solution, covariance, weight = self._solve()
        x, y = self._middle()
        middle = np.array([self._origin[1] + x, self._origin[2] + y])
        gap, way = self._surface.gap(middle, heading)
        if way is ExitWay.STAYS:
            return _stays(middle, np.zeros(2))
        along = gap + x * heading[0] + y * heading[1]
        ahead, speed, variance = self._arrivals(along, solution, covariance)
        usual = np.isfinite(ahead)
        if weight @ usual < 0.5:
            return _stays(middle, np.zeros(2))
        weight, ahead, speed = weight[usual] / weight[usual].sum(), ahead[usual], speed[usual]
        mean = float(weight @ ahead)
        sigma = float(np.sqrt(weight @ (variance[usual] + (ahead - mean) ** 2)))
        facing = abs(heading[0] if way is ExitWay.NEAR_EDGE else heading[1])
        return PredictedExit(
            way,
            self._origin[0] + mean,
            middle + gap * np.array(heading),
            np.array(heading) * float(weight @ speed),
            sigma,
            self._place_sigma(heading, gap) / facing,
        )

    def _arrivals(
        self, along: float, solution: Array, covariance: Array
    ) -> tuple[Array, Array, Array]:
        """Return time, speed and variance of the time at which each model's ball has rolled `along`
        m; inf where it stops before."""
        start, speed, rolling, _ = solution.T
        under = speed * speed - 2.0 * rolling * (along - start)
        last = np.sqrt(np.maximum(under, 1e-6))
        ahead = np.where(
            (under > 0.0) & (speed > 0.0),
            2.0 * (along - start) / np.maximum(speed + last, 1e-6),
            np.inf,
        )
        t = np.where(np.isfinite(ahead), ahead, 0.0)
        slope = self._basis(t)
        variance = ((covariance @ slope[:, :, None])[:, :, 0] * slope).sum(axis=1)
        return ahead, last, variance / last**2

    def _place_sigma(self, heading: tuple[float, float], gap: float) -> float:
        """Return the standard deviation, across the path, of the point `gap` m beyond the middle of
        the places."""
        (hx, hy), (xx, xy, yy) = heading, self._scatter()
        scatter = xx * hx * hx + 2.0 * xy * hx * hy + yy * hy * hy
        return self._surface.noise * math.sqrt(
            1.0 / float(self._sums[0, 0, 0]) + gap * gap / max(scatter, 1e-9)
        )


class Kalman:
    """Extended Kalman filter over place, velocity, rolling deceleration, and a sliding deceleration
    that decays.

    State: x, y, vx, vy, rolling, sliding. Sliding ends at a moment that the filter does not know.
    It is assumed to decay within `FADE` seconds, and its noise lets the filter follow the true,
    sudden end.
    """

    FADE = 0.10
    """Time constant of the sliding deceleration (s)."""
    SLIDING_NOISE = 1.2
    """m/s^2 per root s, noise that drives the sliding deceleration; it decreases with time."""
    VELOCITY_NOISE = 0.002
    """Random change of the speed by an uneven table (m/s per root s)."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._x = np.zeros(6)
        self._P = np.zeros((6, 6))
        self._time = 0.0
        self._first = 0.0
        self.count = 0

    def add(self, time: float, x: float, y: float, sigma: float | None = None) -> None:
        """Take a place (m) seen at a time (s) with a standard deviation (m)."""
        variance = (self._surface.noise if sigma is None else sigma) ** 2
        if self.count == 0:
            self._x = np.array([x, y, 0.0, 0.0, self._surface.rolling, 0.5 * SLIDING])
            place = np.sqrt(variance)
            self._P = np.diag(
                np.square([place, place, 4.0, 4.0, self._surface.rolling_sigma, SLIDING])
            )
            self._first = time
        else:
            self._x, self._P = self._ahead(time - self._time)
            H = np.eye(2, 6)
            S = self._P[:2, :2] + variance * np.eye(2)
            K = self._P[:, :2] @ np.linalg.inv(S)
            self._x = self._x + K @ (np.array([x, y]) - self._x[:2])
            rest = np.eye(6) - K @ H
            self._P = rest @ self._P @ rest.T + variance * (
                K @ K.T
            )  # Joseph's form keeps it symmetric and positive.
        self._time = time
        self.count += 1

    def _ahead(self, step: float) -> tuple[Array, Array]:
        """Return state and covariance `step` s later."""
        velocity = self._x[2:4]
        heading = velocity / max(float(np.hypot(*velocity)), 1e-9)
        fade = float(np.exp(-step / self.FADE))
        lost = self.FADE * (1.0 - fade)
        F = np.eye(6)
        F[0, 2] = F[1, 3] = step
        F[0:2, 4] = -0.5 * step * step * heading
        F[2:4, 4] = -step * heading
        F[0:2, 5] = -self.FADE * (step - lost) * heading
        F[2:4, 5] = -lost * heading
        F[5, 5] = fade
        Q = np.zeros((6, 6))
        Q[2, 2] = Q[3, 3] = self.VELOCITY_NOISE**2 * step
        age = self._time - self._first
        Q[5, 5] = self.SLIDING_NOISE**2 * step * float(np.exp(-age / 0.15))
        return F @ self._x, F @ self._P @ F.T + Q

    def place(self, time: float) -> Array:
        """Return where the ball is expected (2,) m."""
        return np.asarray(self._ahead(time - self._time)[0][:2])

    def exit(self) -> PredictedExit | None:
        """Return how it leaves the table."""
        if self.count < 3:
            return None
        velocity = self._x[2:4]
        speed = float(np.hypot(*velocity))
        heading = velocity / max(speed, 1e-9)
        gap, way = self._surface.gap(self._x[:2], heading)
        ahead = self._arrival(gap, speed) if way is not ExitWay.STAYS else float("inf")
        if not np.isfinite(ahead):
            return _stays(self._x[:2].copy(), velocity.copy())
        state, covariance = self._ahead(ahead)
        last = max(float(np.hypot(*state[2:4])), 1e-6)
        along = float(heading @ covariance[:2, :2] @ heading)
        normal = np.array([-heading[1], heading[0]])
        across = float(normal @ covariance[:2, :2] @ normal)
        facing = abs(heading[0] if way is ExitWay.NEAR_EDGE else heading[1])
        return PredictedExit(
            way,
            self._time + ahead,
            self._x[:2] + gap * heading,
            state[2:4],
            float(np.sqrt(along)) / last,
            float(np.sqrt(across)) / facing,
        )

    def _arrival(self, gap: float, speed: float) -> float:
        """Return the seconds until the ball has rolled `gap` m, by Newton's method; inf when it
        stops before."""
        rolling, sliding = float(self._x[4]), float(self._x[5])
        t = gap / max(speed, 1e-6)
        for _ in range(6):
            fade = float(np.exp(-max(t, 0.0) / self.FADE))
            lost = self.FADE * (1.0 - fade)
            now = speed - rolling * t - sliding * lost
            if now < 0.02:
                return float("inf")
            t -= (speed * t - 0.5 * rolling * t * t - sliding * self.FADE * (t - lost) - gap) / now
        return t
