"""State of many learners side by side, one a row, and the order of their actions by J.

The simulations of docs/learning.md play a thousand rows, the selector of a mission run has one:
both run the same rules on the same arrays, so what is measured is what is shipped. All sums are
kept as sums, and every J is computed from them afresh with the one rho of its row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

SUMS = ("tries", "runs", "successes", "cost", "squares", "costed", "missing")


@dataclass
class Response:
    """One trial of each row: arrays of shape (rows,)."""

    action: Index
    success: Array
    """1 or 0."""
    cost: Array
    """In the measure's unit; nan where it was not measured."""
    executed: Mask
    """False: it never began; it lowers the availability alone."""


@dataclass
class Batch:
    """`rows` learners over the same `n` actions. All sums have shape (rows, n)."""

    p: Array
    """Learned choice probabilities; each row sums to 1."""
    k: Array
    """Trials learned from, by row (shape (rows,))."""
    tries: Array
    """Times that each action was chosen."""
    runs: Array
    """Counted runs: executed, not censored."""
    successes: Array
    cost: Array
    """Sum of the costs of the runs that have one."""
    squares: Array
    """Sum of their squares."""
    costed: Array
    """Runs that have a cost."""
    missing: Array
    """Runs that never began."""
    rho: float | None = None
    """Declared weight; None: 1 / max C of the row."""
    own: dict[str, Array] = field(default_factory=dict)
    """What a rule keeps beside, by name; the first axis is the row."""

    @classmethod
    def fresh(cls, rows: int, n: int, rho: float | None = None) -> Batch:
        """Nothing known, all actions equally likely."""
        if n < 1 or rows < 1:
            raise ValueError(f"{rows} learners over {n} actions: at least one of each is needed")
        tries, runs, successes, cost, squares, costed, missing = (np.zeros((rows, n)) for _ in SUMS)
        p = np.full((rows, n), 1.0 / n)
        return cls(p, np.zeros(rows), tries, runs, successes, cost, squares, costed, missing, rho)

    @property
    def n(self) -> int:
        """Actions."""
        return int(self.p.shape[1])

    def choosing(self, action: Index) -> None:
        """Count a choice of each row."""
        self.tries[np.arange(len(self.k)), action] += 1

    def counting(self, trial: Response) -> None:
        """Add a trial of each row to the sums."""
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
        """R; 0 where nothing is known."""
        return self.successes / np.maximum(self.runs, 1e-300)

    def availability(self) -> Array:
        """A; 1 where nothing is known."""
        started = self.runs + self.missing
        return np.where(started > 0, self.runs / np.maximum(started, 1e-300), 1.0)

    def mean_cost(self) -> Array:
        """C; 0 where nothing is known."""
        return self.cost / np.maximum(self.costed, 1e-300)

    def weight(self) -> Array:
        """rho of each row, shape (rows, 1); 0 where no cost above 0 is known."""
        if self.rho is not None:
            return np.full((len(self.k), 1), self.rho)
        largest = self.mean_cost().max(axis=1, keepdims=True)
        return np.where(largest > 0, 1.0 / np.where(largest > 0, largest, 1.0), 0.0)

    def objective(self) -> Array:
        """J = 1 - A R + rho C of each action; inf where it was never tried."""
        j = 1.0 - self.availability() * self.reliability() + self.weight() * self.mean_cost()
        return np.where(self.runs + self.missing > 0, j, np.inf)

    def spread(self) -> Array:
        """Standard error of J: of R with one success and one failure added, so that it is never 0,
        and of rho C."""
        n = np.maximum(self.runs, 1.0)
        share = (self.successes + 1.0) / (self.runs + 2.0)
        costed = np.maximum(self.costed, 1.0)
        scatter = np.maximum(0.0, self.squares / costed - (self.cost / costed) ** 2)
        error: Array = np.sqrt(share * (1.0 - share) / n + self.weight() ** 2 * scatter / costed)
        return error

    def best(self, eligible: Mask | None = None) -> Index:
        """The action with the lowest J in each row, of the eligible ones if any is; the first of
        equals."""
        j = self.objective()
        if eligible is not None:
            some = np.any(eligible & (j < np.inf), axis=1, keepdims=True)
            j = np.where(eligible | ~some, j, np.inf)
        best: Index = np.argmin(j, axis=1)
        return best

    def payoff(self, trial: Response) -> Array:
        """A trial's gain in [0, 1], affine in its share of J: success, and cost where costs count;
        shape (rows,)."""
        rows = np.arange(len(self.k))
        weight = self.weight()[:, 0]
        mean = self.mean_cost()[rows, trial.action]
        cost = np.clip(weight * np.where(np.isnan(trial.cost), mean, trial.cost), 0.0, 1.0)
        matters = weight > 0
        gain = trial.success * trial.executed
        return np.where(matters, 0.5 * (gain + 1.0 - cost), gain)

    # --- plain data ---------------------------------------------------------------------------

    def to_plain(self) -> dict[str, Any]:
        """Plain data of a batch of one row."""
        data: dict[str, Any] = {"p": self.p[0].tolist(), "k": float(self.k[0])}
        data |= {name: getattr(self, name)[0].tolist() for name in SUMS}
        return data | {"own": {name: array[0].tolist() for name, array in self.own.items()}}

    def take_plain(self, data: Mapping[str, Any]) -> None:
        """Take over what `to_plain` gave. Raises ValueError or KeyError if it does not fit."""
        for name in ("p", *SUMS):
            values = np.asarray(data[name], dtype=float)
            if values.shape != (self.n,) or not np.all(np.isfinite(values)) or np.any(values < 0):
                raise ValueError(f"{name} needs {self.n} numbers that are not negative")
            getattr(self, name)[0] = values
        self.successes[0] = np.minimum(
            self.successes[0], self.runs[0]
        )  # states written before corrections were bounded
        if abs(self.p[0].sum() - 1) > 1e-6:
            raise ValueError("probabilities that do not sum to 1")
        self.k[0] = float(data["k"])
        if not 0 <= self.k[0] < np.inf:
            raise ValueError(f"{data['k']!r} trials")
        for name, array in self.own.items():
            values = np.asarray(data["own"][name], dtype=float)
            if values.shape != array.shape[1:]:
                raise ValueError(f"{name} has another shape")
            array[0] = values


def drawn(probabilities: Array, u: Array) -> Index:
    """The action of each row at a uniform number u in [0, 1), shape (rows,), by the inverse of the
    distribution."""
    bounds = np.cumsum(probabilities, axis=1)
    bounds /= bounds[:, -1:]
    chosen: Index = np.minimum((bounds <= u[:, None]).sum(axis=1), probabilities.shape[1] - 1)
    return chosen


def restricted(probabilities: Array, offered: Mask) -> Array:
    """Probabilities of the offered actions alone; equal ones where they had none."""
    left = np.where(offered, probabilities, 0.0)
    whole = left.sum(axis=1, keepdims=True)
    return np.where(
        whole > 0,
        left / np.where(whole > 0, whole, 1.0),
        offered / offered.sum(axis=1, keepdims=True),
    )
