"""Rules that count but do not learn: a fixed choice, and each alternative in turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petrobot.coordinator.learning.batch import Array, Batch, Index, Mask, Trial
from petrobot.coordinator.learning.rule import forced, one_hot


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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
        """Count only."""
        batch.counting(trial)

    def says(self, batch: Batch, offered: Mask, action: int) -> str:
        """How often it was chosen."""
        return f"chosen least often so far, {batch.tries[0, action]:g} times"
