"""Learning automata: schemes that move a vector of choice probabilities.

- Nikolic and Fu: Z. J. Nikolic and K. S. Fu, "An algorithm for learning without external
  supervision and its application to
  learning control systems", IEEE Trans. Automatic Control AC-11 (1966) 414-422; used for robotic
  tasks by P. U. Lima and G. N. Saridis, Design of Intelligent Control Systems Based on Hierarchical
  Stochastic Automata, World Scientific 1996. Estimate R and C of the chosen action, order by J,
  move: p_i += gamma_k (lambda_i - p_i), lambda = 1 at the lowest J.
- Linear reward-inaction: K. S. Narendra and M. A. L. Thathachar, Learning Automata, Prentice Hall
  1989 (S-model).
- Discretised pursuit: B. J. Oommen and J. K. Lanctot, "Discretized pursuit learning automata", IEEE
  Trans. Systems, Man and
  Cybernetics 20 (1990) 931-938 (reward-inaction).
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
    Response,
    drawn,
    restricted,
)
from petrobot.coordinator.learning.rules import forced, one_hot


@dataclass(frozen=True)
class NikolicFu:
    """The paper's scheme. gamma_k = min(1, c / (k + k0)^exponent), k = 1, 2, ...

    Each action is chosen `trials` times first. With `mixing` m > 0 the draw is from (1 - eps_k) p +
    eps_k e, eps_k = min(1, m n / k). e explores: a share `even` over all actions alike, the rest
    over the contenders, those whose J less `focus` standard errors is not above what some action's
    J plus as many is. The textbook gain has exponent 1, 0 < c <= 1 and no mixing; docs/learning.md
    says which parameters converge with probability 1.
    """

    name: str = "nikolic_fu"
    c: float = 1.0
    k0: float = 1.0
    exponent: float = 1.0
    mixing: float = 0.0
    trials: int = 5
    even: float = 1.0
    focus: float = 2.0

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """All actions equally likely."""
        return Batch.fresh(rows, n, rho)

    def gain(self, k: Array) -> Array:
        """gamma at the k-th trial."""
        gamma: Array = np.minimum(1.0, self.c / (k + self.k0) ** self.exponent)
        return gamma

    def exploration(self, batch: Batch) -> Array:
        """eps of the next trial, shape (rows, 1)."""
        if not self.mixing:
            return np.zeros((len(batch.k), 1))
        eps: Array = np.minimum(1.0, self.mixing * batch.n / (batch.k + 1.0))[:, None]
        return eps

    def explored(self, batch: Batch) -> Array:
        """Shares of the actions in exploration, shape (rows, n)."""
        if self.even >= 1.0:
            return np.full_like(batch.p, 1.0 / batch.n)
        j, error = batch.objective(), self.focus * batch.spread()
        contends = j - error <= np.min(j + error, axis=1, keepdims=True)
        contends |= np.isinf(j)
        shares: Array = contends / contends.sum(axis=1, keepdims=True)
        return self.even / batch.n + (1.0 - self.even) * shares

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """p with its share of exploration; certain while an action is still owed its first
        trials."""
        mixed = batch.p
        if self.mixing:
            eps = self.exploration(batch)
            mixed = (1 - eps) * batch.p + eps * self.explored(batch)
        mixed = restricted(mixed, offered)
        if not self.trials:
            return mixed
        owed, least = forced(batch, offered, self.trials)
        return np.where(owed[:, None], one_hot(least, batch.n), mixed)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw."""
        return drawn(self.probabilities(batch, offered), u[:, 0])

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Estimate, order, move."""
        batch.counting(trial)
        target = one_hot(batch.best(eligible), batch.n)
        batch.p += self.gain(batch.k)[:, None] * (target - batch.p)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """A first trial, or the draw's probability."""
        owed, _ = forced(batch, offered, self.trials)
        if owed[0]:
            return f"trial {batch.tries[0, action] + 1:.0f} of its first {self.trials}"
        share = self.probabilities(batch, offered)[0, action]
        eps = float(self.exploration(batch)[0, 0])
        return f"drawn with {share:.3f}" + (f", exploring {eps:.2f}" if eps else "")


@dataclass(frozen=True)
class RewardInaction:
    """L_R-I: the chosen action's probability grows by step * payoff * (1 - p), the others shrink; a
    bad payoff does nothing.

    It keeps no estimates to choose by. It ends at some action with probability 1, at the best one
    with a probability that nears 1 as the step nears 0 (epsilon-optimal).
    """

    name: str = "reward_inaction"
    step: float = 0.02

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """All actions equally likely."""
        return Batch.fresh(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """p."""
        return restricted(batch.p, offered)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw."""
        return drawn(self.probabilities(batch, offered), u[:, 0])

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Move towards the chosen action as far as it paid; not at all towards one that is not
        eligible."""
        batch.counting(trial)
        pay = batch.payoff(trial)
        if eligible is not None:
            allowed = eligible[np.arange(len(pay)), trial.action] | ~eligible.any(axis=1)
            pay = pay * allowed
        batch.p += (self.step * pay)[:, None] * (one_hot(trial.action, batch.n) - batch.p)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """The draw's probability."""
        return f"drawn with {self.probabilities(batch, offered)[0, action]:.3f}"


@dataclass(frozen=True)
class DiscretisedPursuit:
    """DP_R-I: after each success, probability moves in steps of 1 / (n * resolution) to the action
    with the lowest J.

    Each action is tried `trials` times first, so that the estimates mean something.
    """

    name: str = "discretised_pursuit"
    resolution: int = 20
    trials: int = 10

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """All actions equally likely."""
        return Batch.fresh(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """p, after the first trials."""
        owed, least = forced(batch, offered, self.trials)
        return np.where(owed[:, None], one_hot(least, batch.n), restricted(batch.p, offered))

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw."""
        return drawn(self.probabilities(batch, offered), u[:, 0])

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Pursue the best estimate when the trial was a success and the first trials are over."""
        batch.counting(trial)
        best = batch.best(eligible)
        step = 1.0 / (batch.n * self.resolution)
        moved = np.maximum(batch.p - step, 0.0)
        rows = np.arange(len(best))
        moved[rows, best] = 0.0
        moved[rows, best] = 1.0 - moved.sum(axis=1)
        over = batch.tries.min(axis=1) >= self.trials
        rewarded = (trial.success > 0) & trial.executed & over
        batch.p = np.where(rewarded[:, None], moved, batch.p)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """A first trial, or the draw's probability."""
        owed, _ = forced(batch, offered, self.trials)
        if owed[0]:
            return f"trial {batch.tries[0, action] + 1:.0f} of its first {self.trials}"
        return f"drawn with {self.probabilities(batch, offered)[0, action]:.3f}"


# The scheme of Nikolic and Fu for a world that changes: it follows, it no longer converges with probability 1.

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

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
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

    def _alarm(self, batch: Batch, trial: Response) -> Mask:
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
