"""What a learning rule is: how it chooses and how it moves, for many learners at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import betaincinv

from petrobot.coordinator.learning.batch import Array, Batch, Index, Mask, Response


class Rule(Protocol):
    """A rule has parameters and no state: all state is in the batch, and all chance in the uniform
    numbers passed in."""

    @property
    def name(self) -> str:
        """How users call it."""

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Learners that know nothing."""

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """With which each action is chosen next, shape (rows, n)."""

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """The next action of each row. `u` are uniform numbers in [0, 1) of shape (rows, n);
        nothing changes."""

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Learn from a trial of each row. Only eligible actions (None: all) may be taken for the
        best."""

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Why the first row would choose this action: a few words and numbers."""


def forced(batch: Batch, offered: Mask, least: float) -> tuple[Mask, Index]:
    """Rows in which some offered action has been chosen fewer than `least` times, and the least
    chosen one of each row."""
    tries = np.where(offered, batch.tries, np.inf)
    return tries.min(axis=1) < least, np.argmin(tries, axis=1)


def one_hot(action: Index, n: int) -> Array:
    """1 at the action of each row, else 0."""
    out = np.zeros((len(action), n))
    out[np.arange(len(action)), action] = 1.0
    return out


# Rules that count but do not learn: a fixed choice, and each alternative in turn.


@dataclass(frozen=True)
class Fixed:
    """Always the first alternative that is offered."""

    name: str = "fixed"

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing known, and no need to."""
        return Batch.fresh(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Certain."""
        return one_hot(np.argmax(offered, axis=1), batch.n)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """The first."""
        first: Index = np.argmax(offered, axis=1)
        return first

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Count only."""
        batch.counting(trial)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """No reason."""
        return "the first alternative"


@dataclass(frozen=True)
class RoundRobin:
    """The offered alternative that was chosen least often; the first of equals."""

    name: str = "round_robin"

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing chosen yet."""
        return Batch.fresh(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """In the long run: equal shares."""
        shares: Array = offered / offered.sum(axis=1, keepdims=True)
        return shares

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """The next one in turn."""
        return forced(batch, offered, np.inf)[1]

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Count only."""
        batch.counting(trial)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """How often it was chosen."""
        return f"chosen least often so far, {batch.tries[0, action]:g} times"


# Bandit rules: they choose by what is known and how well, and keep no probabilities of their own.

POINTS = 512
"""Fixed points at which Thompson's choice probabilities are worked out for people and forecasts."""


def _follow(batch: Batch, eligible: Mask | None) -> None:
    """p of a bandit rule: all on what it would recommend now, for people and for a frozen
    selector."""
    batch.p[:] = one_hot(batch.best(eligible), batch.n)


def _allowed(batch: Batch, offered: Mask) -> Mask:
    """Offered actions, without those that a target reliability rules out unless that leaves
    none."""
    ruled_out = batch.own["ruled_out"] > 0
    left: Mask = offered & ~ruled_out
    return np.where(left.any(axis=1, keepdims=True), left, offered)


def _begin(rows: int, n: int, rho: float | None) -> Batch:
    batch = Batch.fresh(rows, n, rho)
    batch.own["ruled_out"] = np.zeros((rows, n))
    return batch


def _learn(batch: Batch, trial: Response, eligible: Mask | None) -> None:
    batch.counting(trial)
    if eligible is not None:
        batch.own["ruled_out"][:] = ~eligible
    _follow(batch, eligible)


@dataclass(frozen=True)
class UCB1:
    """The action with the largest mean payoff + sqrt(width * 2 ln k / n_a); the payoff is affine in
    J, within [0, 1]."""

    name: str = "ucb1"
    width: float = 1.0
    """1 is Auer's bound for payoffs anywhere in [0, 1]."""

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing known."""
        return _begin(rows, n, rho)

    def index(self, batch: Batch) -> Array:
        """Upper confidence bound of each action's mean payoff; inf where it was never tried."""
        weight = batch.weight()
        gain = batch.availability() * batch.reliability()
        mean = np.where(
            weight > 0, 0.5 * (gain + 1 - np.clip(weight * batch.mean_cost(), 0, 1)), gain
        )
        n = batch.runs + batch.missing
        bonus = np.sqrt(
            2 * self.width * np.log(np.maximum(batch.k, 1.0))[:, None] / np.maximum(n, 1e-300)
        )
        return np.where(n > 0, mean + bonus, np.inf)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Certain."""
        return one_hot(self._next(batch, offered), batch.n)

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """The largest index; an untried action first."""
        return self._next(batch, offered)

    def _next(self, batch: Batch, offered: Mask) -> Index:
        owed, least = forced(batch, offered, 1)
        bound = np.where(_allowed(batch, offered), self.index(batch), -np.inf)
        return np.where(owed, least, np.argmax(bound, axis=1))

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Count."""
        _learn(batch, trial, eligible)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Its bound."""
        bound = float(self.index(batch)[0, action])
        return (
            "never tried" if bound == np.inf else f"largest upper bound {bound:.3f} of the payoff"
        )


@dataclass(frozen=True)
class Thompson:
    """The lowest J after drawing each R from its posterior Beta(1 + successes, 1 + others); costs
    are taken as their means."""

    name: str = "thompson"

    def begin(self, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing known: a uniform prior of each R."""
        return _begin(rows, n, rho)

    def probabilities(self, batch: Batch, offered: Mask) -> Array:
        """Shares of the choices over fixed points of a low-discrepancy sequence."""
        ratio = 1.0 / _plastic(batch.n) ** np.arange(1, batch.n + 1)
        share = np.zeros_like(batch.p)
        for i in range(POINTS):
            u = np.broadcast_to((0.5 + (i + 1) * ratio) % 1.0, batch.p.shape)
            share += one_hot(self.choose(batch, offered, u), batch.n)
        return share / POINTS

    def choose(self, batch: Batch, offered: Mask, u: Array) -> Index:
        """Draw each R by the inverse of its posterior, and compare J. Untried actions are taken to
        cost what the cheapest does."""
        r = betaincinv(1 + batch.successes, 1 + batch.runs - batch.successes, u)
        known = np.where(batch.costed > 0, batch.mean_cost(), np.inf)
        cheapest = known.min(axis=1, keepdims=True)
        cost = np.where(batch.costed > 0, known, np.where(cheapest < np.inf, cheapest, 0.0))
        j = 1.0 - batch.availability() * r + batch.weight() * cost
        lowest: Index = np.argmin(np.where(_allowed(batch, offered), j, np.inf), axis=1)
        return lowest

    def learn(self, batch: Batch, trial: Response, eligible: Mask | None = None) -> None:
        """Count."""
        _learn(batch, trial, eligible)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """Its posterior."""
        good, runs = batch.successes[0, action], batch.runs[0, action]
        return f"lowest J with R drawn from Beta({1 + good:g}, {1 + runs - good:g})"


def _plastic(n: int) -> float:
    """The root above 1 of x^(n+1) = x + 1: generator of an even additive sequence in n dimensions
    (M. Roberts, 2018)."""
    x = 2.0
    for _ in range(64):
        x = (1.0 + x) ** (1.0 / (n + 1))
    return x
