"""State of many learners side by side (one per row), and the order of their actions by J.

The simulations of docs/learning.md run a thousand rows; the selector of a mission run has one. Both
use the same rules on the same arrays, so what is measured there is what runs here. Only sums are
stored. Each J is computed from the sums when it is needed, with one rho per row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

PRIOR = 3.0
"""Trials for which the additive prior of a combination counts: enough to rank those that were tried
once or twice, too few to hide what their actions do to each other."""
SUMS = ("tries", "runs", "successes", "cost", "squares", "costed", "missing")


class Response(Struct):
    """One trial of each row. All arrays have shape (rows,)."""

    action: Index
    success: Array
    """1 or 0."""
    cost: Array
    """Cost in the unit of the measure; nan if it was not measured."""
    executed: Mask
    """False if the run never began; such a trial only lowers the availability."""


class Batch(Struct):
    """`rows` learners over the same `n` actions. All sums have shape (rows, n)."""

    p: Array
    """Learned choice probabilities; each row sums to 1."""
    k: Array
    """Number of trials that each row has learned from, shape (rows,)."""
    tries: Array
    """How often each action was chosen."""
    runs: Array
    """Runs that count: executed and not censored."""
    successes: Array
    cost: Array
    """Sum of the measured costs."""
    squares: Array
    """Sum of the squared costs."""
    costed: Array
    """Number of runs that have a measured cost."""
    missing: Array
    """Number of runs that never began."""
    rho: float | None = None
    """Declared weight of the cost; None: 1 / max C of the row."""
    declared: Array | None = None
    """Declared costs, shape (n,), used where none was measured; nan or None: none is declared."""
    shape: tuple[int, ...] = ()
    """If the actions are combinations: how many there are of each primitive task."""
    own: dict[str, Array] = field(default_factory=dict)
    """Further arrays that a rule needs, by name; their first axis is the row."""

    @classmethod
    def fresh(cls, rows: int, n: int, rho: float | None) -> Batch:
        """Create learners without any experience: all actions are equally likely. Raises ValueError
        for fewer than one row or action."""
        if n < 1 or rows < 1:
            raise ValueError(f"expected at least one learner and one action, got {rows} and {n}")
        tries, runs, successes, cost, squares, costed, missing = (np.zeros((rows, n)) for _ in SUMS)
        p = np.full((rows, n), 1.0 / n)
        return cls(p, np.zeros(rows), tries, runs, successes, cost, squares, costed, missing, rho)

    @property
    def n(self) -> int:
        """Number of actions."""
        return int(self.p.shape[1])

    def choosing(self, action: Index) -> None:
        """Count one choice of each row."""
        self.tries[np.arange(len(self.k)), action] += 1

    def counting(self, trial: Response) -> None:
        """Add one trial of each row to the sums."""
        rows = np.arange(len(self.k))
        executed = trial.executed.astype(float)
        known = executed * ~np.isnan(trial.cost)
        self.runs[rows, trial.action] += executed
        self.successes[rows, trial.action] += executed * trial.success
        cost = np.where(known > 0, trial.cost, 0.0)
        self.cost[rows, trial.action] += cost
        self.squares[rows, trial.action] += cost * cost
        self.costed[rows, trial.action] += known
        self.missing[rows, trial.action] += 1 - executed
        self.k += 1

    # --- figures from the sums ----------------------------------------------------------------

    def reliability(self) -> Array:
        """R of each action; 0 where nothing is known. Combinations have an additive prior."""
        if self.shape:
            return (self.successes + PRIOR * self._additive()) / (self.runs + PRIOR)
        # 1e-300 stands for "no runs": 0 / 1e-300 is 0, without a warning of numpy
        return self.successes / np.maximum(self.runs, 1e-300)

    def _additive(self) -> Array:
        """Return R of each combination as the effects of its actions add up: each combination
        counts the same, however often it was chosen, with one pseudo-trial at the mean."""
        axes = tuple(range(1, len(self.shape) + 1))
        good, runs = (x.reshape(-1, *self.shape) for x in (self.successes, self.runs))
        mean = (good.sum(axes, keepdims=True) + 0.5) / (runs.sum(axes, keepdims=True) + 1.0)
        cell = (good + mean) / (runs + 1.0)
        out = (1 - len(axes)) * cell.mean(axes, keepdims=True)
        for axis in axes:
            others = tuple(other for other in axes if other != axis)
            out = out + cell.mean(others, keepdims=True)
        added: Array = np.clip(out, 0.0, 1.0).reshape(self.successes.shape)
        return added

    def neighbours(self) -> Array:
        """Return equal shares, shape (rows, n), of the combinations that differ from the likeliest
        one of the row in one action. What they show says most about where the row is now, and
        trying them costs little."""
        actions = np.indices(self.shape).reshape(len(self.shape), -1).T
        differ = (actions != actions[self.p.argmax(axis=1)][:, None, :]).sum(axis=2)
        near = (differ == 1).astype(float)
        shares: Array = near / near.sum(axis=1, keepdims=True)
        return shares

    def availability(self) -> Array:
        """A of each action; 1 where nothing is known."""
        started = self.runs + self.missing
        return np.where(started > 0, self.runs / np.maximum(started, 1e-300), 1.0)

    def mean_cost(self) -> Array:
        """C of each action: measured, else declared; 0 where nothing is known."""
        measured: Array = self.cost / np.maximum(self.costed, 1e-300)
        if self.declared is None:
            return measured
        return np.where(self.costed > 0, measured, np.nan_to_num(self.declared))

    def weight(self) -> Array:
        """Return rho of each row, shape (rows, 1); 0 where no cost above 0 is known."""
        if self.rho is not None:
            return np.full((len(self.k), 1), self.rho)
        largest = self.mean_cost().max(axis=1, keepdims=True)
        return np.where(largest > 0, 1.0 / np.where(largest > 0, largest, 1.0), 0.0)

    def objective(self) -> Array:
        """J = 1 - A R + rho C of each action; inf where it was never tried, unless a prior
        estimates it."""
        j = 1.0 - self.availability() * self.reliability() + self.weight() * self.mean_cost()
        if self.shape:
            return j
        return np.where(self.runs + self.missing > 0, j, np.inf)

    def spread(self) -> Array:
        """Standard error of J: the error of R and the error of rho C combined. R is estimated with
        one success and one failure added, so its error is never 0."""
        n = np.maximum(self.runs, 1.0)
        share = (self.successes + 1.0) / (self.runs + 2.0)
        costed = np.maximum(self.costed, 1.0)
        scatter = np.maximum(0.0, self.squares / costed - (self.cost / costed) ** 2)
        error: Array = np.sqrt(share * (1.0 - share) / n + self.weight() ** 2 * scatter / costed)
        return error

    def best(self, eligible: Mask | None = None) -> Index:
        """Return the action with the lowest J in each row (the first of equals), among the eligible
        actions if any of them was tried."""
        j = self.objective()
        if eligible is not None:
            some = np.any(eligible & (j < np.inf), axis=1, keepdims=True)
            j = np.where(eligible | ~some, j, np.inf)
        best: Index = np.argmin(j, axis=1)
        return best

    def payoff(self, trial: Response) -> Array:
        """Return the payoff of each trial in [0, 1], shape (rows,): the mean of success and saved
        cost where cost counts, otherwise the success alone."""
        rows = np.arange(len(self.k))
        weight = self.weight()[:, 0]
        mean = self.mean_cost()[rows, trial.action]
        cost = np.clip(weight * np.where(np.isnan(trial.cost), mean, trial.cost), 0.0, 1.0)
        matters = weight > 0
        gain = trial.success * trial.executed
        return np.where(matters, 0.5 * (gain + 1.0 - cost), gain)

    # --- plain data ---------------------------------------------------------------------------

    def to_plain(self) -> dict[str, Any]:
        """Return the first row as plain data."""
        data: dict[str, Any] = {"p": self.p[0].tolist(), "k": float(self.k[0])}
        data |= {name: getattr(self, name)[0].tolist() for name in SUMS}
        return data | {"own": {name: array[0].tolist() for name, array in self.own.items()}}

    def take_plain(self, data: Mapping[str, Any]) -> None:
        """Load what `to_plain` returned into the first row. Raises ValueError or KeyError if it
        does not fit."""
        for name in ("p", *SUMS):
            values = np.asarray(data[name], dtype=float)
            if values.shape != (self.n,) or not np.all(np.isfinite(values)) or np.any(values < 0):
                raise ValueError(f"{name}: expected {self.n} numbers that are not negative")
            getattr(self, name)[0] = values
        # In states of older versions a correction could leave more successes than runs.
        self.successes[0] = np.minimum(self.successes[0], self.runs[0])
        if abs(self.p[0].sum() - 1) > 1e-6:
            raise ValueError(
                f"p: expected probabilities that sum to 1, got a sum of {self.p[0].sum():g}"
            )
        self.k[0] = float(data["k"])
        if not 0 <= self.k[0] < np.inf:
            raise ValueError(f"k: expected a number of trials, got {data['k']!r}")
        for name, array in self.own.items():
            values = np.asarray(data["own"][name], dtype=float)
            if values.shape != array.shape[1:]:
                raise ValueError(f"{name}: expected shape {array.shape[1:]}, got {values.shape}")
            array[0] = values


def drawn(probabilities: Array, u: Array) -> Index:
    """Draw an action of each row by inverse transform sampling. `u`: uniform numbers in [0, 1),
    shape (rows,)."""
    bounds = np.cumsum(probabilities, axis=1)
    bounds /= bounds[:, -1:]
    chosen: Index = np.minimum((bounds <= u[:, None]).sum(axis=1), probabilities.shape[1] - 1)
    return chosen


def restricted(probabilities: Array, offered: Mask) -> Array:
    """Return the probabilities over the offered actions only, scaled to sum to 1; equal shares if
    all of them had probability 0."""
    left = np.where(offered, probabilities, 0.0)
    whole = left.sum(axis=1, keepdims=True)
    return np.where(
        whole > 0,
        left / np.where(whole > 0, whole, 1.0),
        offered / offered.sum(axis=1, keepdims=True),
    )
