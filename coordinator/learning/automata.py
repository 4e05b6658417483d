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

from petrobot.coordinator.learning.batch import Array, Batch, Index, Mask, Trial, drawn, restricted
from petrobot.coordinator.learning.rule import forced, one_hot


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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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
