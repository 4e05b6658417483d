"""Bernoulli worlds with known J, and rules simulated in many of them in parallel: the convergence
study of docs/figures-selectors.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.learning.batch import Array, Batch, Index, Response
from petrobot.coordinator.learning.rules import Rule


class BanditWorld(Struct, frozen=True):
    """Reliability and mean cost of each action; from trial `change` on those of `later`."""

    name: str
    reliability: tuple[float, ...]
    cost: tuple[float, ...]
    change: int | None = None
    later: tuple[float, ...] = ()

    @property
    def n(self) -> int:
        """Number of actions."""
        return len(self.reliability)

    def at(self, trial: int) -> BanditWorld:
        """Return the world at a trial (from 0), without its later change."""
        if self.change is None or trial < self.change:
            return replace(self, change=None)
        return replace(self, reliability=self.later, change=None)

    def objective(self) -> Array:
        """Return J of each action with rho = 1 / max C."""
        cost = np.array(self.cost)
        rho = 1.0 / cost.max() if cost.max() > 0 else 0.0
        return 1.0 - np.array(self.reliability) + rho * cost

    @property
    def gap(self) -> float:
        """Return the difference of the two lowest J."""
        low = np.sort(self.objective())
        return float(low[1] - low[0])


def gapped(gap: float, best: float = 0.9, n: int = 4) -> BanditWorld:
    """Return a world with one action of reliability `best` and all others `gap` worse, at equal
    costs."""
    return BanditWorld(f"gap {gap:g}", (best - gap, *([best - gap] * (n - 2)), best), (1.0,) * n)


class PlayedTrials(Struct):
    """Result of a simulation: arrays over seeds (rows)."""

    batch: Batch
    regret: Array
    """Cumulative regret in J at each checkpoint, shape (checkpoints, rows)."""
    optimal: Array
    """Share of optimal choices among the last hundred, by row."""
    p_best: Array
    """p of the optimum at each checkpoint, shape (checkpoints, rows)."""
    recent: Array
    """Share of optimal choices among the hundred before each checkpoint, shape (checkpoints,
    rows)."""
    checkpoints: Sequence[int]


def play(
    rule: Rule,
    world: BanditWorld,
    trials: int,
    seeds: int,
    rng: np.random.Generator,
    checkpoints: Sequence[int] = (),
    watch: Callable[[int, Batch, Index], None] | None = None,
) -> PlayedTrials:
    """Simulate a rule in `seeds` copies of a world; each row has its own random numbers."""
    batch, n = rule.begin(seeds, world.n), world.n
    offered = np.ones((seeds, n), dtype=bool)
    marks = list(checkpoints) or [trials]
    total, regret, p_best, shares = np.zeros(seeds), [], [], []
    recent = np.zeros((100, seeds))
    executed = np.ones(seeds, dtype=bool)
    for t in range(trials):
        now = world.at(t)
        j = now.objective()
        action = rule.choose(batch, offered, rng.random((seeds, n)))
        batch.choosing(action)
        success = (rng.random(seeds) < np.array(now.reliability)[action]).astype(float)
        cost = np.array(now.cost)[action] * rng.gamma(10.0, 0.1, seeds)
        rule.learn(batch, Response(action, success, cost, executed))
        total += j[action] - j.min()
        recent[t % 100] = j[action] <= j.min() + 1e-12
        if watch is not None:
            watch(t, batch, action)
        if t + 1 in marks:
            regret.append(total.copy())
            p_best.append(batch.p[:, j <= j.min() + 1e-12].sum(axis=1))
            shares.append(recent[: t + 1].mean(axis=0))
    optimal = recent[: min(trials, 100)].mean(axis=0)
    return PlayedTrials(batch, np.array(regret), optimal, np.array(p_best), np.array(shares), marks)
