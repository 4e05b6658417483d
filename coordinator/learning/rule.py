"""What a learning rule is: how it chooses and how it moves, for many learners at once."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from petrobot.coordinator.learning.batch import Array, Batch, Index, Mask, Trial


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

    def learn(self, batch: Batch, trial: Trial, eligible: Mask | None = None) -> None:
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
