"""Compare two campaigns trial by trial: equal seeds produce the same trials, so the differences are
paired.

Shares: McNemar's exact test (Q. McNemar, Psychometrika 12 (1947) 153-157; binomial test of the
discordant pairs), and the difference with the adjusted Wald interval of A. Agresti and Y. Min,
Statistics in Medicine 24 (2005) 729-740 (half a pair added to each cell). J and costs: percentile
bootstrap over pairs, all J from sums with one rho.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import nan
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.task import Status, Task

REPLICATES = 2000
Z = 1.959963984540054
Values = NDArray[np.float64]


class PairedTrials(Struct, frozen=True):
    """Trials of two campaigns with equal regime, seed and number that began in both."""

    one: tuple[TrialRow, ...]
    other: tuple[TrialRow, ...]
    left_out: int
    """Trials without a partner, or that did not begin."""


def paired(one: Iterable[TrialRow], other: Iterable[TrialRow]) -> PairedTrials:
    """Match the trials of two tables."""
    first = {(row.regime, row.seed, row.k): row for row in one}
    second = {(row.regime, row.seed, row.k): row for row in other}
    common = [
        k
        for k in first
        if k in second and first[k].trial is not None and second[k].trial is not None
    ]
    left = len(first) + len(second) - 2 * len(common)
    return PairedTrials(tuple(first[k] for k in common), tuple(second[k] for k in common), left)


def compare(
    task: Task,
    one: Iterable[TrialRow],
    other: Iterable[TrialRow],
    weighting: Weighting | None = None,
) -> dict[str, Any]:
    """Return the differences between the first and the second campaign: positive is better for
    shares, negative for J and time.

    `weighting` gives the rho of J, so that several comparisons can use the same; without it, rho is
    that of the actions in these two. Raises ValueError if they do not have two trials in common:
    every sample of a single pair is that pair, so its interval would be a point.
    """
    pairs = paired(one, other)
    if len(pairs.one) < 2:
        raise ValueError(
            f"the two campaigns have {'one' if pairs.one else 'no'} trial in common, a comparison "
            "needs two: run them with the same --seed, --block and --regime"
        )
    random = np.random.default_rng(1)
    shares = {
        "R_goal": lambda row: row.trial is not None and row.trial.goals > 0,
        "P_complete": lambda row: row.trial is not None and row.trial.completed,
        "R_conj": lambda row: row.trial is not None and row.trial.all_success,
    }
    found: dict[str, Any] = {name: share_difference(pairs, met) for name, met in shares.items()}
    own = own_flags(pairs)
    found |= {name: share_difference(pairs, _flag(name)) for name in own}
    weighting = weighting or Weighting.of(task, (*pairs.one, *pairs.other))
    return {
        "pairs": len(pairs.one),
        "left_out": pairs.left_out,
        "rho": {**weighting.rho, "task": weighting.task},
        "shares": found,
        "time": _time(pairs),
        "J": objective_difference(task, pairs, weighting, random),
    }


def own_flags(pairs: PairedTrials) -> list[str]:
    """Return the truth values of the task's own score that every pair has."""
    names = [n for n, v in pairs.one[0].score.items() if isinstance(v, bool)]
    return [
        n
        for n in names
        if all(isinstance(r.score.get(n), bool) for rows in (pairs.one, pairs.other) for r in rows)
    ]


def _flag(name: str) -> Callable[[TrialRow], bool]:
    return lambda row: bool(row.score[name])


def share_difference(pairs: PairedTrials, met: Callable[[TrialRow], bool]) -> dict[str, Any]:
    """Return both shares, the discordant pairs, McNemar's p-value, and the difference with its 95 %
    interval."""
    from scipy.stats import binomtest  # here: the page of one campaign compares nothing

    a = np.array([met(row) for row in pairs.one])
    b = np.array([met(row) for row in pairs.other])
    n, gained, lost = len(a), int(np.sum(a & ~b)), int(np.sum(~a & b))
    p = float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0
    # half a pair added to each of the four cells: n + 2 pairs
    middle = (gained - lost) / (n + 2)
    half = Z * np.sqrt(((gained + 0.5) + (lost + 0.5)) / (n + 2) - middle**2) / np.sqrt(n + 2)
    return {
        "one": round(float(a.mean()), 6),
        "other": round(float(b.mean()), 6),
        "only_one": gained,
        "only_other": lost,
        "difference": round((gained - lost) / n, 6),
        "interval": [
            round(float(max(-1.0, middle - half)), 6),
            round(float(min(1.0, middle + half)), 6),
        ],
        "p": p,
    }


def _time(pairs: PairedTrials) -> dict[str, Any]:
    times = [
        (a.trial.time, b.trial.time)
        for a, b in zip(pairs.one, pairs.other, strict=True)
        if a.trial and b.trial and a.trial.time is not None and b.trial.time is not None
    ]
    if len(times) < 2:
        return {"pairs": len(times)}
    one, other = np.array(times).T
    d = one - other
    half = Z * float(d.std(ddof=1)) / len(d) ** 0.5
    mean = float(d.mean())
    return {
        "pairs": len(d),
        "one": round(float(one.mean()), 6),
        "other": round(float(other.mean()), 6),
        "difference": round(mean, 6),
        "interval": [round(mean - half, 6), round(mean + half, 6)],
    }


class Weighting(Struct, frozen=True):
    """rho of each primitive task with alternatives, and of the task (whose cost is the duration of
    a trial)."""

    rho: Mapping[str, float]
    task: float

    @classmethod
    def of(cls, task: Task, rows: Sequence[TrialRow]) -> Weighting:
        """Return 1 / the largest mean cost of an action in these rows; for the task, 1 / the mean
        duration of their trials."""
        names = [p.name for p in task.primitive_tasks.values() if len(p.alternatives) > 1]
        times = [
            row.trial.time for row in rows if row.trial is not None and row.trial.time is not None
        ]
        mean = sum(times) / len(times) if times else 0.0
        return cls(
            {name: cost_weight(task, name, rows) for name in names}, 1.0 / mean if mean > 0 else 0.0
        )


def objectives(task: Task, rows: Sequence[TrialRow], weighting: Weighting) -> dict[str, float]:
    """Return J of each primitive task with alternatives, their mean ("mean") and J of the task
    ("task"), with the given rho; nan where nothing ran."""
    whole = np.ones((1, len(rows)))
    found = {
        name: float(_objective(_sums(task, name, rows), whole, rho)[0])
        for name, rho in weighting.rho.items()
    }
    known = [value for value in found.values() if not np.isnan(value)]
    return found | {
        "mean": float(np.mean(known)) if known else nan,
        "task": float(_objective(_task_sums(rows), whole, weighting.task)[0]),
    }


def objective_intervals(
    task: Task, rows: Sequence[TrialRow], weighting: Weighting
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the 95 % intervals of the mean J over the primitive tasks with alternatives, and of J
    of the task: percentiles of a bootstrap over whole trials, so the dependence of R and C counts.

    Four trials at the mean cost are added, two of them successes: without them the interval of a
    combination that never failed would be empty (A. Agresti and B. A. Coull, The American
    Statistician 52 (1998) 119-126). nan where nothing ran, and for one trial, which says nothing of
    the spread of the cost.
    """
    if len(rows) < 2:
        return (nan, nan), (nan, nan)
    random = np.random.default_rng(1)
    weights = random.multinomial(
        len(rows) + 4, np.full(len(rows) + 4, 1 / (len(rows) + 4)), REPLICATES
    )

    def spread(sums: Sums, rho: float) -> Values:
        runs, _, cost, costed = sums
        per_trial = runs.sum() / max(1, np.count_nonzero(runs))
        mean = cost.sum() / costed.sum() if costed.sum() else 0.0
        known = per_trial if costed.sum() else 0.0
        more = np.array(
            [[per_trial] * 4, [per_trial] * 2 + [0.0] * 2, [known * mean] * 4, [known] * 4]
        )
        grown = [np.append(one, other) for one, other in zip(sums, more, strict=True)]
        return _objective((grown[0], grown[1], grown[2], grown[3]), weights, rho)

    parts = [(_sums(task, name, rows), rho) for name, rho in weighting.rho.items()]
    spreads = [spread(sums, rho) for sums, rho in parts if sums[0].sum()]
    whole = spread(_task_sums(rows), weighting.task)
    mean = np.mean(spreads, axis=0) if spreads else np.empty(0)
    return _percentiles(mean), _percentiles(whole)


def _percentiles(spread: Values) -> tuple[float, float]:
    known = spread[~np.isnan(spread)]
    if not len(known):
        return nan, nan
    low, high = np.quantile(known, (0.025, 0.975))
    return float(low), float(high)


def objective_difference(
    task: Task, pairs: PairedTrials, weighting: Weighting, random: np.random.Generator
) -> dict[str, Any]:
    """Return the differences of J of each primitive task with alternatives, of their mean, and of J
    of the task (1 - R_goal + rho * time)."""
    n = len(pairs.one)
    weights = random.multinomial(n, np.full(n, 1 / n), size=REPLICATES)
    whole = np.ones((1, n))
    out: dict[str, Any] = {}
    means: list[tuple[float, float, Values, Values]] = []
    for name, rho in weighting.rho.items():
        one, other = _sums(task, name, pairs.one), _sums(task, name, pairs.other)
        if not one[0].sum() or not other[0].sum():
            continue
        point = float(_objective(one, whole, rho)[0]), float(_objective(other, whole, rho)[0])
        spread = _objective(one, weights, rho), _objective(other, weights, rho)
        means.append((*point, *spread))
        out[name] = _difference(*point, spread[0] - spread[1])
    if means:
        one_j, other_j = (float(np.mean([m[i] for m in means])) for i in (0, 1))
        out["mean"] = _difference(one_j, other_j, np.mean([m[2] - m[3] for m in means], axis=0))
    both = [_task_sums(rows) for rows in (pairs.one, pairs.other)]
    values = [float(_objective(sums, whole, weighting.task)[0]) for sums in both]
    spreads = [_objective(sums, weights, weighting.task) for sums in both]
    out["task"] = _difference(values[0], values[1], spreads[0] - spreads[1])
    return out


def _difference(one: float, other: float, spread: Values) -> dict[str, Any]:
    known = spread[~np.isnan(spread)]
    low, high, upper = np.quantile(known, (0.025, 0.975, 0.95))
    return {
        "one": round(one, 6),
        "other": round(other, 6),
        "difference": round(one - other, 6),
        "interval": [round(float(low), 6), round(float(high), 6)],
        "upper_95": round(float(upper), 6),
    }


Sums = tuple[Values, Values, Values, Values]
"""By trial: counted runs, successes, cost, runs with a cost."""


def _sums(task: Task, name: str, rows: Sequence[TrialRow]) -> Sums:
    """Return the sums of a primitive task."""
    out = np.zeros((4, len(rows)))
    for i, row in enumerate(rows):
        for run in row.runs:
            if run.status and task.primitive_task_of(run.place).name == name:
                known = run.cost is not None
                out[:, i] += (1.0, run.status == Status.SUCCESS.value, run.cost or 0.0, known)
    return out[0], out[1], out[2], out[3]


def _task_sums(rows: Sequence[TrialRow]) -> Sums:
    """Return the sums of the whole task: a trial counts as a run, a reached goal as its success,
    its duration as the cost."""
    out = np.zeros((4, len(rows)))
    for i, row in enumerate(rows):
        if row.trial is not None:
            time = row.trial.time
            out[:, i] = (1.0, row.trial.goals > 0, time or 0.0, time is not None)
    return out[0], out[1], out[2], out[3]


def cost_weight(task: Task, name: str, rows: Iterable[TrialRow]) -> float:
    """Return rho = 1 / the largest mean cost of an action of the primitive task in these rows; 0
    without costs."""
    costs: dict[str, list[float]] = {}
    for row in rows:
        for run in row.runs:
            if (
                run.status
                and run.cost is not None
                and task.primitive_task_of(run.place).name == name
            ):
                costs.setdefault(run.action, []).append(run.cost)
    largest = max((sum(c) / len(c) for c in costs.values()), default=0.0)
    return 1.0 / largest if largest > 0 else 0.0


def _objective(sums: Sums, weights: Any, rho: float) -> Values:
    """Return J = 1 - R + rho C for each row of weights."""
    runs, successes, cost, costed = (weights @ s for s in sums)
    with np.errstate(divide="ignore", invalid="ignore"):
        value: Values = (
            1.0
            - successes / runs
            + rho * np.where(costed > 0, cost / np.maximum(costed, 1e-300), 0.0)
        )
    return value
