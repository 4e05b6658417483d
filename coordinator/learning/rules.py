"""Learning rules for many learners at once: fixed choices, bandit rules and learning automata.

Sources:

- Nikolic and Fu: Z. J. Nikolic and K. S. Fu, "An algorithm for learning without external
  supervision and its application to learning control systems", IEEE Trans. Automatic Control AC-11
  (1966) 414-422; used for robotic tasks by P. U. Lima and G. N. Saridis, Design of Intelligent
  Control Systems Based on Hierarchical Stochastic Automata, World Scientific 1996.
- Linear reward-inaction: K. S. Narendra and M. A. L. Thathachar, Learning Automata, Prentice Hall
  1989 (S-model: payoffs in [0, 1]).
- Discretised pursuit: B. J. Oommen and J. K. Lanctot, "Discretized pursuit learning automata", IEEE
  Trans. Systems, Man and Cybernetics 20 (1990) 931-938 (reward-inaction).
- UCB1: P. Auer, N. Cesa-Bianchi and P. Fischer, "Finite-time analysis of the multiarmed bandit
  problem", Machine Learning 47 (2002) 235-256.
- Thompson sampling: W. R. Thompson, Biometrika 25 (1933) 285-294.
- Change detection in `Tracking`: E. S. Page, "Continuous inspection schemes", Biometrika 41 (1954)
  100-115 (CUSUM).
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

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


class Rule(Struct, frozen=True):
    """A learning rule has parameters but no state: all state is in the batch, and all randomness is
    in the uniform numbers that the caller passes in. By default it draws and only counts."""

    name: str
    """Name of the rule on the command line."""

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Create learners without any experience, with all actions equally likely."""
        return Batch.fresh(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return the probability of each action for the next choice, shape (rows, n)."""
        raise NotImplementedError

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Choose the next action of each row. `u`: uniform numbers in [0, 1), shape (rows, n).
        Changes nothing."""
        return drawn(self.probabilities(batch, offered), u[:, 0])

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Learn from one trial of each row. Only eligible actions (None: all) may count as best."""
        batch.counting(trial)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Explain in a few words why the first row would choose this action."""
        return f"drawn with {self.probabilities(batch, offered)[0, action]:.3f}"


def forced(batch: Batch, offered: Mask, least: float) -> tuple[Mask, Index]:
    """Find the rows in which some offered action was chosen fewer than `least` times. Also returns
    the least chosen offered action of each row."""
    tries = np.where(offered, batch.tries, np.inf)
    return tries.min(axis=1) < least, np.argmin(tries, axis=1)


def one_hot(action: Index, n: int) -> Array:
    """Return an array (rows, n) with 1 at the action of each row and 0 elsewhere."""
    out = np.zeros((len(action), n))
    out[np.arange(len(action)), action] = 1.0
    return out


# --- rules that count but do not learn ---


class Fixed(Rule, frozen=True):
    """Always choose the first offered alternative."""

    name: str = "fixed"

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return 1 for the first offered action."""
        return one_hot(np.argmax(offered, axis=1), batch.n)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Choose the first offered action."""
        first: Index = np.argmax(offered, axis=1)
        return first

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Give no numbers: the choice does not depend on any."""
        return "the first alternative"


class RoundRobin(Rule, frozen=True):
    """Choose the offered alternative that was chosen least often; the first of equals."""

    name: str = "round_robin"

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return the long-run shares, which are equal."""
        shares: Array = offered / offered.sum(axis=1, keepdims=True)
        return shares

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Choose the next action in turn."""
        return forced(batch, offered, np.inf)[1]

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Say how often the action was chosen."""
        return f"chosen least often so far, {batch.tries[0, action]:g} times"


# --- bandit rules: they choose by estimates and their uncertainty, not by learned probabilities ---

POINTS = 512
"""Number of fixed points at which Thompson's choice probabilities are evaluated for displays and
forecasts."""


def _allowed(batch: Batch, offered: Mask) -> Mask:
    """Return the offered actions that a target reliability does not rule out; all offered ones if
    it rules out every one of them."""
    ruled_out = batch.own["ruled_out"] > 0
    left: Mask = offered & ~ruled_out
    return np.where(left.any(axis=1, keepdims=True), left, offered)


class _Bandit(Rule, frozen=True):
    """Its p only recommends; displays and frozen selectors read it."""

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Create learners without any experience."""
        batch = Batch.fresh(rows, n, rho)
        batch.own["ruled_out"] = np.zeros((rows, n))
        return batch

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Count the trial and update the recommendation."""
        batch.counting(trial)
        if eligible is not None:
            batch.own["ruled_out"][:] = ~eligible
        batch.p[:] = one_hot(batch.best(eligible), batch.n)


class UCB1(_Bandit, frozen=True):
    """Choose the action with the largest mean payoff + sqrt(width * 2 ln k / n_a). The payoff is an
    affine function of J in [0, 1]."""

    name: str = "ucb1"
    width: float = 1.0
    """Scale of the bonus; 1 is Auer's bound for arbitrary payoffs in [0, 1]."""

    def index(self, batch: Batch) -> Array:
        """Return the upper confidence bound of the mean payoff of each action; inf where it was
        never tried."""
        weight = batch.weight()
        gain = batch.availability() * batch.reliability()
        # 1 - J / 2: with rho = 1 / max C the cost term is at most 1, so J lies between 0 and 2
        mean = np.where(
            weight > 0, 0.5 * (gain + 1 - np.clip(weight * batch.mean_cost(), 0, 1)), gain
        )
        n = batch.runs + batch.missing
        bonus = np.sqrt(
            2 * self.width * np.log(np.maximum(batch.k, 1.0))[:, None] / np.maximum(n, 1e-300)
        )
        return np.where(n > 0, mean + bonus, np.inf)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return 1 for the action that will be chosen: the rule is deterministic."""
        return one_hot(self._next(batch, offered), batch.n)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Choose an untried action first, then the one with the largest upper bound."""
        return self._next(batch, offered)

    def _next(self, batch: Batch, offered: Mask) -> Index:
        owed, least = forced(batch, offered, 1)
        bound = np.where(_allowed(batch, offered), self.index(batch), -np.inf)
        return np.where(owed, least, np.argmax(bound, axis=1))

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Give the upper bound."""
        bound = float(self.index(batch)[0, action])
        return (
            "never tried" if bound == np.inf else f"largest upper bound {bound:.3f} of the payoff"
        )


class Thompson(_Bandit, frozen=True):
    """Draw R of each action from its posterior Beta(1 + successes, 1 + other runs) and choose the
    lowest J. Costs enter as their means."""

    name: str = "thompson"

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Estimate the choice probabilities at fixed points of a low-discrepancy sequence, so that
        the same state always shows the same numbers."""
        ratio = 1.0 / _plastic(batch.n) ** np.arange(1, batch.n + 1)
        share = np.zeros_like(batch.p)
        for i in range(POINTS):
            u = np.broadcast_to((0.5 + (i + 1) * ratio) % 1.0, batch.p.shape)
            share += one_hot(self.choose(batch, offered, u), batch.n)
        return share / POINTS

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw each R by the inverse of its posterior distribution and compare J. An untried action
        is assumed to cost as much as the cheapest known one."""
        from scipy.special import betaincinv  # here, because it takes 0.15 s: not every run draws

        # betaincinv(a, b, u) is the u-quantile of Beta(a, b)
        r = betaincinv(1 + batch.successes, 1 + batch.runs - batch.successes, u)
        known = np.where(batch.costed > 0, batch.mean_cost(), np.inf)
        cheapest = known.min(axis=1, keepdims=True)
        cost = np.where(batch.costed > 0, known, np.where(cheapest < np.inf, cheapest, 0.0))
        j = 1.0 - batch.availability() * r + batch.weight() * cost
        lowest: Index = np.argmin(np.where(_allowed(batch, offered), j, np.inf), axis=1)
        return lowest

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Give the posterior distribution."""
        good, runs = batch.successes[0, action], batch.runs[0, action]
        return f"lowest J with R drawn from Beta({1 + good:g}, {1 + runs - good:g})"


def _plastic(n: int) -> float:
    """Return the root above 1 of x^(n+1) = x + 1, which generates an evenly spread additive
    sequence in n dimensions (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
    2018)."""
    x = 2.0  # fixed-point iteration; it converges for every n >= 1, 64 steps are plenty
    for _ in range(64):
        x = (1.0 + x) ** (1.0 / (n + 1))
    return x


# --- learning automata ---


class _TriesFirst(Rule, frozen=True):
    """Each action is first chosen `trials` times, so that the estimates mean something."""

    trials: int

    def tried(self, batch: Batch, offered: Mask, then: Array) -> Array:
        """Return 1 for the action that still needs one of its first trials; later `then`."""
        owed, least = forced(batch, offered, self.trials)
        return np.where(owed[:, None], one_hot(least, batch.n), then)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Say which of its first trials this is, or with which probability it was drawn."""
        owed, _ = forced(batch, offered, self.trials)
        if owed[0]:
            return f"trial {batch.tries[0, action] + 1:.0f} of its first {self.trials}"
        return super().says(batch, offered, action)


class NikolicFu(_TriesFirst, frozen=True):
    """The scheme of the paper: estimate R and C of the chosen action, order all actions by J, and
    move p towards the best one: p_i += gamma_k (lambda_i - p_i), where lambda is 1 at the lowest J
    and 0 elsewhere, and gamma_k = min(1, c / (k + k0)^exponent), k = 1, 2, ...

    Each action is first chosen `trials` times. With `mixing` m > 0, actions are drawn from (1 -
    eps_k) p + eps_k e with eps_k = min(1, m n / k). The distribution e explores: a share `even` is
    spread evenly over all actions, the rest over the contenders, that is, actions whose J minus
    `focus` standard errors is not above the smallest J plus `focus` standard errors. The textbook
    gain has exponent 1, 0 < c <= 1 and no mixing; docs/learning.md says which parameters converge
    with probability 1.
    """

    name: str = "nikolic_fu"
    c: float = 1.0
    k0: float = 1.0
    exponent: float = 1.0
    mixing: float = 0.0
    trials: int = 5
    even: float = 1.0
    focus: float = 2.0

    def gain(self, k: Array) -> Array:
        """Return gamma at trial k."""
        gamma: Array = np.minimum(1.0, self.c / (k + self.k0) ** self.exponent)
        return gamma

    def exploration(self, batch: Batch) -> Array:
        """Return eps of the next trial, shape (rows, 1)."""
        if not self.mixing:
            return np.zeros((len(batch.k), 1))
        eps: Array = np.minimum(1.0, self.mixing * batch.n / (batch.k + 1.0))[:, None]
        return eps

    def explored(self, batch: Batch) -> Array:
        """Return the shares e of the actions in exploration, shape (rows, n)."""
        if self.even >= 1.0:
            return np.full_like(batch.p, 1.0 / batch.n)
        # Samples are spent where the order is in doubt: an action contends while its confidence
        # interval of J reaches below the smallest upper bound. An untried action contends, too.
        j, error = batch.objective(), self.focus * batch.spread()
        contends = j - error <= np.min(j + error, axis=1, keepdims=True)
        contends |= np.isinf(j)
        shares: Array = contends / contends.sum(axis=1, keepdims=True)
        return self.even / batch.n + (1.0 - self.even) * shares

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return p mixed with exploration; 1 for the action that still needs one of its first
        trials."""
        mixed = batch.p
        if self.mixing:
            eps = self.exploration(batch)
            mixed = (1 - eps) * batch.p + eps * self.explored(batch)
        return self.tried(batch, offered, restricted(mixed, offered))

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Update the estimates, order the actions by J, move p towards the best one."""
        batch.counting(trial)
        target = one_hot(batch.best(eligible), batch.n)
        batch.p += self.gain(batch.k)[:, None] * (target - batch.p)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Also say how much is explored, after the first trials."""
        eps = float(self.exploration(batch)[0, 0])
        tried = not forced(batch, offered, self.trials)[0][0]
        exploring = f", exploring {eps:.2f}" if eps and tried else ""
        return super().says(batch, offered, action) + exploring


class RewardInaction(Rule, frozen=True):
    """L_R-I: p of the chosen action grows by step * payoff * (1 - p) and the others shrink; without
    payoff nothing changes.

    It chooses without estimates. It ends at some action with probability 1, and at the best one
    with a probability that approaches 1 as the step approaches 0 (epsilon-optimal).
    """

    name: str = "reward_inaction"
    step: float = 0.02

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return p over the offered actions."""
        return restricted(batch.p, offered)

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Move p towards the chosen action in proportion to its payoff, unless that action is not
        eligible."""
        batch.counting(trial)
        pay = batch.payoff(trial)
        if eligible is not None:
            allowed = eligible[np.arange(len(pay)), trial.action] | ~eligible.any(axis=1)
            pay = pay * allowed
        batch.p += (self.step * pay)[:, None] * (one_hot(trial.action, batch.n) - batch.p)


class DiscretisedPursuit(_TriesFirst, frozen=True):
    """DP_R-I: after each success, move p in steps of 1 / (n * resolution) towards the action with
    the lowest J.

    Each action is first tried `trials` times, so that the estimates mean something.
    """

    name: str = "discretised_pursuit"
    resolution: int = 20
    trials: int = 10

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return p over the offered actions; 1 for the action that still needs one of its first
        trials."""
        return self.tried(batch, offered, restricted(batch.p, offered))

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Move p towards the best estimate if the trial succeeded and all first trials are done."""
        batch.counting(trial)
        # All other actions give up one step; the best one gets what they gave up.
        best = batch.best(eligible)
        step = 1.0 / (batch.n * self.resolution)
        moved = np.maximum(batch.p - step, 0.0)
        rows = np.arange(len(best))
        moved[rows, best] = 0.0
        moved[rows, best] = 1.0 - moved.sum(axis=1)
        over = batch.tries.min(axis=1) >= self.trials
        rewarded = (trial.success > 0) & trial.executed & over
        batch.p = np.where(rewarded[:, None], moved, batch.p)


# CUSUM sums of the change test: one for each direction of each observed quantity.
TESTS = ("success_up", "success_down", "cost_up", "cost_down")


class Tracking(_TriesFirst, frozen=True):
    """The scheme of Nikolic and Fu for a changing world. It follows changes, and therefore does not
    converge with probability 1.

    The sums fade by 1 - 1 / `memory` at each trial; gain and probabilities have floors. A CUSUM
    test on success and cost of each action ignores changes below `slack`, adds up what exceeds it
    and raises an alarm at `threshold`; it starts after `settle` runs. An alarm restarts the
    estimates. With these numbers an R that does not change raises a false alarm once in 100,000
    runs at 0.5, where success varies most, and a fall by 0.5 is noticed after about 25 runs
    (simulated, 40 million runs).

    Of many combinations, floors for each would leave nearly all trials to chance. There the share
    `explore` of the trials goes to other combinations: a fifth of it to any, the rest to those that
    differ from the likeliest one in one action.
    """

    name: str = "tracking"
    memory: float = 300.0
    exponent: float = 0.7
    gain_floor: float = 0.04
    probability_floor: float = 0.02
    explore: float = 0.1
    trials: int = 5
    slack: float = 0.15
    threshold: float = 8.0
    settle: int = 15

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Create learners without any experience, and the state of the change test."""
        batch = Batch.fresh(rows, n, rho)
        for name in (*TESTS, "seen", "seen_success", "seen_cost"):
            batch.own[name] = np.zeros((rows, n))
        batch.own["restarts"] = np.zeros((rows, 1))
        return batch

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Return p raised to its floor; 1 for the action that still needs one of its first trials
        since the last restart."""
        if batch.shape:
            other = 0.8 * batch.neighbours() + 0.2 / batch.n
            raised = (1 - self.explore) * batch.p + self.explore * other
        else:
            floor = min(self.probability_floor, 1.0 / batch.n)
            raised = (1 - floor * batch.n) * batch.p + floor
        return self.tried(batch, offered, restricted(raised, offered))

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Fade the sums, update the estimates, test for a change, order the actions by J, move
        p."""
        keep = 1.0 - 1.0 / self.memory
        for name in SUMS[1:]:
            getattr(batch, name)[:] *= keep
        batch.counting(trial)
        self._restart(batch, self._alarm(batch, trial))
        gain = np.maximum(self.gain_floor, np.minimum(1.0, 1.0 / batch.k**self.exponent))
        batch.p += gain[:, None] * (one_hot(batch.best(eligible), batch.n) - batch.p)

    def _alarm(self, batch: Batch, trial: Response) -> Mask:
        """Return the rows in which success or cost of the chosen action has left its mean since the
        restart."""
        at = (np.arange(len(batch.k)), trial.action)
        own, executed = batch.own, trial.executed
        scale = np.maximum(batch.mean_cost().max(axis=1), 1e-300)
        cost = np.where(np.isnan(trial.cost), 0.0, trial.cost)
        own["seen"][at] += executed
        own["seen_success"][at] += executed * trial.success
        own["seen_cost"][at] += executed * cost
        seen = np.maximum(own["seen"][at], 1.0)
        # Costs have any unit, so their test is on costs divided by the largest mean cost.
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
        """Forget the sums of the rows with an alarm. The probabilities stay: they are the best
        guess until something better is known."""
        if not alarm.any():
            return
        for name in SUMS:
            getattr(batch, name)[alarm] = 0.0
        for name in (*TESTS, "seen", "seen_success", "seen_cost"):
            batch.own[name][alarm] = 0.0
        batch.own["restarts"][alarm] += 1
        batch.k[alarm] = 1.0

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Also say how many changes of the world it noticed: each begins its first trials again."""
        restarts = batch.own["restarts"][0, 0]
        since = f", {restarts:g} changes of the world noticed" if restarts else ""
        return super().says(batch, offered, action) + since
