"""Following a stream of catch points: which set points may be executed, and the plan for the newest
one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from petrobot.services.device import Setpoint
from petrobot.services.motion.interception import (
    STRATEGIES,
    CatchPlan,
    Interceptor,
    Prediction,
    Strategy,
)
from petrobot.services.motion.trajectory import Trajectory

STALE_PERIODS: Final = 3
"""Periods of the stream after which a set point must not be executed any more."""
FROZEN: Final = 0.03
"""Seconds before the ball arrives from which the cup keeps still: a late correction gains less than
a moving rim can spoil."""
SAME_PLACE: Final = 0.0003
"""m, `SAME_SPEED` m/s, `SAME_TIME` s: by how much two predictions may differ and still share one
plan; 0.5 mm at the cup."""
SAME_SPEED: Final = 0.002
SAME_TIME: Final = 0.002
SAME_SIGMA: Final = 0.002
ROUNDING: Final = 1e-9
"""Seconds by which rounding may change an age."""


class Follower:
    """The newest prediction of the stream, and the plan for it."""

    def __init__(self, period: float) -> None:
        self._period = period
        self.strategy: Strategy = STRATEGIES["tilted"]
        self.plan: CatchPlan | None = None
        self._made = 0.0
        self._prediction: Prediction | None = None
        self._planned: Prediction | None = None
        self._planned_for = self.strategy
        self._values: tuple[float, ...] | None = None
        self.count = 0
        self.age = math.inf
        self._came = -math.inf
        self.refused = 0
        self.oldest = 0.0
        self.stale = 0

    def begin(self, count: int) -> None:
        """Forget the past: only set points that arrive from now on count."""
        self.plan, self._prediction, self._values = None, None, None
        self.count, self.age, self._came = count, math.inf, -math.inf

    def fresh(self, now: float) -> bool:
        """Return whether the last valid set point may still be executed; store its age."""
        self.age = now - self._came
        return self.age <= STALE_PERIODS * self._period + ROUNDING

    def executed(self, now: float) -> None:
        """Record that a cycle moved towards the last valid set point; its age is recorded
        separately from the rule that decides about it."""
        age = now - self._came
        self.oldest = max(self.oldest, age)
        self.stale += age > STALE_PERIODS * self._period + ROUNDING

    def take(self, setpoint: Setpoint, now: float) -> bool:
        """Accept a set point with new values if it may be executed; a repetition only renews the
        last one."""
        values = setpoint.values
        if setpoint.count == self.count or values is None:
            return False
        self.count = setpoint.count
        if values != self._values:
            try:
                self._prediction = Prediction.parse(values, setpoint.held)
            except ValueError:
                self.refused += 1
                return False
        self._came = now - setpoint.age
        new, self._values = values != self._values, values
        return self.fresh(now) and new

    def drop(self) -> None:
        """Treat the values of the stale set point as new if they arrive again."""
        self._values = None

    def plan_with(
        self,
        interceptor: Interceptor,
        trajectory: Trajectory,
        speed: Sequence[float],
        acceleration: Sequence[float],
        now: float,
    ) -> CatchPlan | None:
        """Plan for the prediction just accepted; return None if it cannot be reached (then the
        earlier plan is forgotten)."""
        assert self._prediction is not None
        if self.plan is not None and (
            self.plan.arrival - (now - self._made) < FROZEN or self._says_the_same(now)
        ):
            return self.plan
        self.plan = interceptor.plan(
            self.strategy,
            self._prediction,
            trajectory.q,
            trajectory.qd,
            speed,
            acceleration,
            self.plan,
        )
        self._made, self._planned, self._planned_for = now, self._prediction, self.strategy
        return self.plan

    def _says_the_same(self, now: float) -> bool:
        """Return whether the newest prediction differs too little from the planned one to be worth
        a new plan."""
        new, old = self._prediction, self._planned
        if new is None or old is None or self.strategy != self._planned_for:
            return False
        apart = max(abs(a - b) for a, b in zip(new.point, old.point, strict=True))
        faster = max(abs(a - b) for a, b in zip(new.velocity, old.velocity, strict=True))
        later = abs(new.time_to_go + now - old.time_to_go - self._made)
        surer = old.sigma_y - new.sigma_y
        return (
            apart < SAME_PLACE and faster < SAME_SPEED and later < SAME_TIME and surer < SAME_SIGMA
        )

    def published(self, now: float) -> dict[str, Any] | None:
        """Return the plan as plain data; times are seconds from `now`."""
        plan, prediction = self.plan, self._prediction
        if plan is None or prediction is None:
            return None
        return {
            "point": plan.point,
            "axis": plan.axis,
            "arrival": plan.arrival - (now - self._made),
            "slack": plan.slack,
            "reach": plan.reach,
            "sigma_y": prediction.sigma_y,
            "sigma_t": prediction.sigma_t,
        }
