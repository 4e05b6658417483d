"""Check that a campaign chooses actions as a forecast assumes: for other choices, another forecast
is needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.stats import chi2_contingency

from petrobot.coordinator.studies.forecast.history import Training

Counts = Mapping[str, Mapping[str, float]]
"""By primitive task and action: number of runs."""
OTHER = 1e-6
"""Significance level at which two mixes of actions differ. It is far beyond any chance, because the
forecast is refused then."""
FEW = 30
"""Least number of training runs from which a mix can be seen. If fewer runs were all of one action,
the others may still have been possible."""


def choice_counts(training: Training) -> dict[str, dict[str, int]]:
    """Return how often each action was run."""
    counts: dict[str, dict[str, int]] = {}
    for trial in training.trials:
        for run in trial.runs:
            actions = counts.setdefault(training.task.primitive_task_of(run.place).name, {})
            actions[run.action] = actions.get(run.action, 0) + 1
    return counts


def choices_of(training: Training) -> dict[str, dict[str, float]]:
    """Return how often each action was chosen, as shares."""
    counts = choice_counts(training)
    return {
        t: {a: n / sum(actions.values()) for a, n in actions.items()}
        for t, actions in counts.items()
    }


def misfit(said: Mapping[str, Any], run: Counts) -> list[str]:
    """Return the primitive tasks whose actions a campaign chooses differently from the forecast of
    a regime."""
    return [
        name
        for name, counts in run.items()
        if name in said["choices"] and not _alike(said, name, counts)
    ]


def _alike(said: Mapping[str, Any], name: str, counts: Mapping[str, float]) -> bool:
    chosen: Mapping[str, float] = {a: p for a, p in said["choices"][name].items() if p > 0}
    trained = said.get("choice_runs", {}).get(name, said["training_trials"])
    others = sum(n for action, n in counts.items() if action not in chosen)
    if len(chosen) == 1 and (name in said.get("asked", [name]) or trained >= FEW):
        return others == 0
    known = [a for a in {**chosen, **counts} if chosen.get(a, 0.0) > 0 or counts.get(a, 0) > 0]
    if len(known) < 2 or not sum(counts.values()):
        return True
    table = np.array(
        [[chosen.get(a, 0.0) * trained for a in known], [counts.get(a, 0.0) for a in known]]
    )
    return float(chi2_contingency(table).pvalue) >= OTHER


def in_words(choices: Counts, names: Iterable[str]) -> str:
    """Describe the actions of some primitive tasks for people."""
    out = []
    for name in names:
        whole = sum(choices[name].values())
        shares = {a: n / whole for a, n in choices[name].items() if n > 0}
        sole = next(iter(shares)) if len(shares) == 1 else ""
        out.append(
            f"{name}={sole}"
            if sole
            else f"{name}: " + ", ".join(f"{a} {p:.0%}" for a, p in shares.items())
        )
    return "; ".join(out)


def remedy(choices: Counts, names: Iterable[str]) -> str:
    """Say how to make a campaign choose as a forecast assumes."""
    sole = [f"{name}={next(iter(choices[name]))}" for name in names if len(choices[name]) == 1]
    if len(sole) < len(list(names)):
        return "run it with the selector of the training campaign"
    return "run it with --choose " + ",".join(sole)
