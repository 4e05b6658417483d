"""Whether a forecast can be true: trials played with the training's own choices against the trials
that they were learned from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2_contingency, ttest_ind

from petrobot.coordinator.studies.forecast.history import Training, Values
from petrobot.coordinator.studies.forecast.play import Choices, Played
from petrobot.coordinator.studies.forecast.shares import holm

LEVEL = 0.01
"""Level at which played and measured trials differ, over all tests of a regime (Holm)."""
NEGLIGIBLE = 0.02
"""Share of trials that may rest on a guess, or by which a share of played trials may miss the
measured one: what is less moves no forecast share by more than the margin of equivalence."""
TIME, MEAN = "time", "mean time"
OFF_TIME = 0.05
"""The same of mean times (relative) and of shares of trials in classes of the time."""


def measured(training: Training) -> Played:
    """Measured trials in the form of played ones."""
    trials = training.trials
    return Played(
        np.array([t.goals for t in trials], np.int64),
        np.array([t.completed for t in trials], np.bool_),
        np.array([t.all_success for t in trials], np.bool_),
        np.array([np.nan if t.time is None or not t.completed else t.time for t in trials]),
    )


def residuals(training: Training, played: Played) -> list[dict[str, Any]]:
    """Chi-square tests that measured and played trials come from one law, with p, Holm's p and how
    far off they are.

    Goals, completion, all-SUCCESS, classes of the time, its mean, and for each place by which
    transitions its runs left it. `off` is the largest difference of two shares; of the mean time
    the relative one.
    """
    real = measured(training)
    tables = {
        "goal": _shares(real.goals > 0, played.goals > 0),
        "complete": _shares(real.completed, played.completed),
        "every run SUCCESS": _shares(real.all_success, played.all_success),
        TIME: _shares(_classes(real.time, real.time), _classes(played.time, real.time)),
    }
    for place, ways in routing(training).items():
        tables[f"ways out of {place}"] = ways_table(ways, played.ways.get(place, {}))
    alone = {name: _p_value(table) for name, table in tables.items()} | {
        MEAN: _same_mean(real.time, played.time)
    }
    off = {name: _off(table) for name, table in tables.items()} | {
        MEAN: _mean_off(real.time, played.time)
    }
    return [
        {"of": name, "p": p, "p_holm": together, "off": round(off[name], 6)}
        for (name, p), together in zip(alone.items(), holm(list(alone.values())), strict=True)
    ]


def _shares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    kept_one, kept_other = one[~np.isnan(one)], other[~np.isnan(other)]
    levels = np.unique(np.concatenate([kept_one, kept_other]))
    return np.array([[np.sum(x == level) for level in levels] for x in (kept_one, kept_other)])


def _same_mean(one: Values, other: Values) -> float:
    """Welch's test: classes say little about a few trials that last very long."""
    kept_one, kept_other = one[~np.isnan(one)], other[~np.isnan(other)]
    if min(len(kept_one), len(kept_other)) < 2 or kept_one.std() + kept_other.std() == 0:
        return 1.0
    return float(ttest_ind(kept_one, kept_other, equal_var=False).pvalue)


def _off(table: np.ndarray) -> float:
    whole = table.sum(axis=1, keepdims=True)
    if table.shape[1] == 0:
        return 0.0
    return float(np.abs(np.diff(table / whole, axis=0)).max()) if whole.min() > 0 else 1.0


def _mean_off(one: Values, other: Values) -> float:
    if np.isnan(one).all() or np.isnan(other).all() or np.nanmean(one) == 0:
        return 0.0
    return float(abs(np.nanmean(other) / np.nanmean(one) - 1.0))


def _p_value(table: np.ndarray) -> float:
    """1 where there is nothing to compare; 0 where one of them has no such thing at all."""
    if table.shape[1] == 0 or (table.shape[1] == 1 and table.min() > 0):
        return 1.0
    return float(chi2_contingency(table).pvalue) if table.sum(axis=1).min() > 0 else 0.0


def _classes(times: Values, of: Values) -> Values:
    known = of[~np.isnan(of)]
    if not len(known):
        return np.full(len(times), np.nan)
    classes = np.searchsorted(
        np.quantile(known, (0.25, 0.5, 0.75, 0.9)), times, side="right"
    ).astype(np.float64)
    return np.where(np.isnan(times), np.nan, classes)


def routing(training: Training, choices: Choices | None = None) -> dict[str, dict[str, int]]:
    """By action place: how often each transition took a token out of it.

    With `choices` only in trials all of whose runs might have been chosen so: they alone say how
    such trials go on.
    """
    primitive = training.task.primitive_task_of
    out: dict[str, dict[str, int]] = {}
    for trial in training.trials:
        if choices is not None and any(
            choices.get(primitive(run.place).name, {run.action: 1.0}).get(run.action, 0.0) <= 0
            for run in trial.runs
        ):
            continue
        for run in trial.runs:
            if run.taken:
                ways = out.setdefault(run.place, {})
                ways[run.taken] = ways.get(run.taken, 0) + 1
    return {place: dict(sorted(ways.items())) for place, ways in sorted(out.items())}


def ways_table(before: Mapping[str, int], after: Mapping[str, int]) -> np.ndarray:
    """Contingency table (2, ways) of two countings of ways out of a place."""
    ways = sorted({*before, *after})
    return np.array([[counts.get(way, 0) for way in ways] for counts in (before, after)])


def doubts(residual: Sequence[Mapping[str, Any]], played: Played, trials: int) -> list[str]:
    """Why a forecast is doubtful, in words; nothing where it is not. `trials` were played for the
    forecast.

    Played trials have to be off by more than chance and by more than matters: with many trials the
    first alone says little.
    """
    out = [
        "trials played with the training's own choices differ from the training's: "
        f"{row['of']}, off by {row['off']:.1%} "
        f"(p = {row['p_holm']:.1e})"
        for row in residual
        if row["p_holm"] < LEVEL
        and row["off"] > (OFF_TIME if row["of"] in (TIME, MEAN) else NEGLIGIBLE)
    ]
    for place, n in sorted(played.beyond.items()):
        if n > NEGLIGIBLE * trials:
            out.append(
                f"in {n / trials:.1%} of the trials played a run in {place} goes on for "
                "longer than any that was measured: "
                "what it comes to then is a guess; train with runs that nothing cuts off so early"
            )
    for name, n in sorted(played.astray.items()):
        if n > NEGLIGIBLE * trials:
            out.append(
                f"in {n / trials:.1%} of the trials played {name} comes when the marking "
                "does not allow it: how long a run goes on "
                "until it is preempted depends on more than the run"
            )
    if played.endless > NEGLIGIBLE * trials:
        out.append(
            f"{played.endless / trials:.1%} of the trials played never end: branches that "
            "watch each other need more training "
            "trials, so that the contexts can tell them apart"
        )
    return out
