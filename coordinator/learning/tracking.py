"""The scheme of Nikolic and Fu for a world that changes: it follows, it no longer converges with
probability 1.

Sums fade by a forgetting factor, the gain and every choice probability have floors, and a two-sided
Page-Hinkley test on the successes and costs of each action starts the learner afresh when one of
them has moved (E. S. Page, Biometrika 41 (1954) 100; D. V. Hinkley, Biometrika 58 (1971) 509).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petrobot.coordinator.learning.batch import (
    SUMS,
    Array,
    Batch,
    Index,
    Mask,
    Trial,
    drawn,
    restricted,
)
from petrobot.coordinator.learning.rule import forced, one_hot

TESTS = ("success_up", "success_down", "cost_up", "cost_down")


@dataclass(frozen=True)
class Tracking:
    """Parameters: `memory` trials (the sums fade by 1 - 1 / memory each trial), floors of gain and
    probability, and the test.

    The test ignores moves below `slack` and alarms when what is beyond adds up to `threshold`; it
    begins after `settle` runs.
    """

    name: str = "tracking"
    memory: float = 300.0
    exponent: float = 0.7
    gain_floor: float = 0.04
    probability_floor: float = 0.02
    trials: int = 5
    slack: float = 0.15
    threshold: float = 8.0
    settle: int = 15

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing known."""
        batch = Batch.fresh(rows, n, rho)
        for name in (*TESTS, "seen", "seen_success", "seen_cost"):
            batch.own[name] = np.zeros((rows, n))
        batch.own["restarts"] = np.zeros((rows, 1))
        return batch

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """p above its floor, after the first trials of a restart."""
        floor = min(self.probability_floor, 1.0 / batch.n)
        mixed = restricted((1 - floor * batch.n) * batch.p + floor, offered)
        owed, least = forced(batch, offered, self.trials)
        return np.where(owed[:, None], one_hot(least, batch.n), mixed)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw."""
        return drawn(self.probabilities(batch, offered), u[:, 0])

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
        """Fade, estimate, test, order, move."""
        keep = 1.0 - 1.0 / self.memory
        for name in SUMS[1:]:
            getattr(batch, name)[:] *= keep
        batch.counting(trial)
        self._restart(batch, self._alarm(batch, trial))
        gain = np.maximum(self.gain_floor, np.minimum(1.0, 1.0 / batch.k**self.exponent))
        batch.p += gain[:, None] * (one_hot(batch.best(eligible), batch.n) - batch.p)

    def correcting(self, batch: Batch, action: int, change: float, age: int) -> float:
        """What is left in the sums of the trial `age` trials ago of the change of its success; one
        row.

        Nothing of a trial before the last restart. The test's own mean since the restart does not
        fade.
        """
        since = batch.k[0] - (batch.own["restarts"][0, 0] > 0)  # a restart leaves k at 1
        if age >= since:
            return 0.0
        seen, met = (batch.own[name][0] for name in ("seen", "seen_success"))
        met[action] = min(max(0.0, met[action] + change), seen[action])
        left: float = change * (1.0 - 1.0 / self.memory) ** age
        return left

    def _alarm(self, batch: Batch, trial: Trial) -> Mask:
        """Whether the chosen action's success or cost has left its mean since the restart."""
        at = (np.arange(len(batch.k)), trial.action)
        own, executed = batch.own, trial.executed
        scale = np.maximum(batch.mean_cost().max(axis=1), 1e-300)
        cost = np.where(np.isnan(trial.cost), 0.0, trial.cost)
        own["seen"][at] += executed
        own["seen_success"][at] += executed * trial.success
        own["seen_cost"][at] += executed * cost
        seen = np.maximum(own["seen"][at], 1.0)
        moves = (
            trial.success - own["seen_success"][at] / seen,
            (cost - own["seen_cost"][at] / seen) / scale,
        )
        ready = executed & (own["seen"][at] > self.settle)
        alarm = np.zeros(len(batch.k), dtype=bool)
        for name, move in zip(TESTS, (moves[0], -moves[0], moves[1], -moves[1]), strict=True):
            grown = np.maximum(0.0, own[name][at] + np.where(ready, move - self.slack, 0.0))
            own[name][at] = grown
            alarm |= grown > self.threshold
        return alarm

    def _restart(self, batch: Batch, alarm: Mask) -> None:
        """Forget what was, but for the probabilities: they are the best guess until something
        better is known."""
        if not alarm.any():
            return
        for name in SUMS:
            getattr(batch, name)[alarm] = 0.0
        for name in (*TESTS, "seen", "seen_success", "seen_cost"):
            batch.own[name][alarm] = 0.0
        batch.own["restarts"][alarm] += 1
        batch.k[alarm] = 1.0

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """A first trial since the restart, or the draw's probability."""
        restarts = batch.own["restarts"][0, 0]
        since = f", {restarts:g} changes of the world noticed" if restarts else ""
        if forced(batch, offered, self.trials)[0][0]:
            return f"trial {batch.tries[0, action] + 1:.0f} of its first {self.trials}{since}"
        return f"drawn with {self.probabilities(batch, offered)[0, action]:.3f}{since}"
