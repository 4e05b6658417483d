"""Bandit rules: they choose by what is known and how well, and keep no probabilities of their own.

- UCB1: P. Auer, N. Cesa-Bianchi and P. Fischer, "Finite-time analysis of the multiarmed bandit
  problem", Machine Learning 47
  (2002) 235-256.
- Thompson sampling: W. R. Thompson, Biometrika 25 (1933) 285-294; S. Agrawal and N. Goyal, COLT
  2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv

from petrobot.coordinator.learning.batch import Array, Batch, Index, Mask, Trial
from petrobot.coordinator.learning.rule import forced, one_hot

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


def _learn(batch: Batch, trial: Trial, eligible: Mask | None) -> None:
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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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
