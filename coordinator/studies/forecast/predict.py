"""The forecast of one regime: expected figures, predictive samples by a cluster bootstrap, and the
product rule for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from petrobot.coordinator.studies.forecast.choices import choice_counts, choices_of
from petrobot.coordinator.studies.forecast.distributions import (
    Drawer,
    RunDistributions,
    dependences,
)
from petrobot.coordinator.studies.forecast.history import Training, Values
from petrobot.coordinator.studies.forecast.net_arrays import SUCCESS, Structure
from petrobot.coordinator.studies.forecast.play import Choices, Play, Played
from petrobot.coordinator.studies.forecast.residual import doubts, residuals, routing
from petrobot.coordinator.studies.forecast.shares import predictive_interval, share_weight

POINT = 40_000
"""Trials simulated for the expected figures. The simulation error of a share is then below 0.25
points (standard error sqrt(0.25 / 40000))."""
REPLICATES = 200
TOGETHER = 25_000
"""Trials simulated side by side."""
LEVEL = 0.95
SHARES = ("R_goal", "P_complete", "R_conj")
TIMES = ("mean", "q90")
GRID = tuple(float(q) for q in np.linspace(0.005, 0.995, 100))
"""Probabilities at which the distribution of the time is stored."""


@dataclass(frozen=True)
class Request:
    """What a forecast is asked for."""

    runs: int
    """Number of trials that will be run."""
    choices: Choices
    seed: int = 1
    replicates: int = REPLICATES
    point: int = POINT


def figures(played: Played) -> dict[str, float]:
    """Return the forecast figures of simulated or measured trials; times are nan if no trial
    completed."""
    times = played.time[played.completed & ~np.isnan(played.time)]
    return {
        "R_goal": float(np.mean(played.goals > 0)),
        "P_complete": float(np.mean(played.completed)),
        "R_conj": float(np.mean(played.all_success)),
        "mean": float(np.mean(times)) if len(times) else float("nan"),
        "q90": float(np.quantile(times, 0.9)) if len(times) else float("nan"),
    }


def predict(training: Training, request: Request) -> dict[str, Any]:
    """Forecast further trials of a regime. Raises ValueError for a choice that was never
    measured."""
    structure, measured_runs = Structure.of(training.task), RunDistributions(training)
    _refuse_unmeasured(training, measured_runs, request.choices)
    random = np.random.default_rng(request.seed)
    even = np.ones((1, len(training.trials)))
    residual = (
        residuals(training, _replayed(training, structure, measured_runs, request))
        if training.whole
        else []
    )
    whole = _played(
        training, structure, measured_runs, request, even, np.zeros(request.point, np.int64), random
    )
    samples, distances = _bootstrap(training, structure, measured_runs, request, whole, random)
    point = figures(whole)
    times = whole.time[whole.completed]
    return {
        "training_trials": len(training.trials),
        "runs": request.runs,
        "figures": {
            name: _figure(name, point[name], samples[name], request, len(training.trials))
            for name in (*SHARES, *TIMES)
        },
        "product": product_rule(training, request.choices),
        "law": {"q": list(GRID), "s": _rounded(np.quantile(times, GRID)) if len(times) else []},
        "distance_99": round(float(np.quantile(distances, 0.99)), 6),
        "contexts": measured_runs.count,
        "splits": measured_runs.splits(),
        "dependence": dependences(training),
        "residual": residual,
        "doubts": doubts(residual, whole, request.point),
        "routing": routing(training, request.choices),
        "choice_runs": {
            name: sum(actions.values()) for name, actions in choice_counts(training).items()
        },
        "asked": sorted(
            name
            for name, chosen in request.choices.items()
            if dict(chosen) != choices_of(training).get(name)
        ),
        "not_back": sum(t.completed and t.time is None for t in training.trials),
        "endless": round(whole.endless / request.point, 6),
        "assumptions": list(structure.assumptions),
    }


def _refuse_unmeasured(
    training: Training, measured_runs: RunDistributions, choices: Choices
) -> None:
    names = training.vocabulary
    for q, place in enumerate(names.places):
        primitive = training.task.primitive_task_of(place).name
        for action, probability in choices.get(primitive, {}).items():
            measured_there = any(key[0] == q for key in measured_runs.contexts)
            if (
                probability > 0
                and measured_there
                and (q, names.actions.index(action) + 1) not in measured_runs.contexts
            ):
                raise ValueError(
                    f"{primitive}: {action} was never run in {place}, so nothing is known of "
                    "it; train "
                    "with --selector random"
                )


def _played(
    training: Training,
    structure: Structure,
    measured_runs: RunDistributions,
    request: Request,
    weights: Values,
    replicate: np.ndarray,
    random: np.random.Generator,
) -> Played:
    drawer = Drawer(measured_runs, training.waits, weights, random)
    try:
        return Play(structure, drawer, request.choices, replicate, longest_of(training)).run()
    except KeyError as fault:
        place, action = fault.args[0]
        names = training.vocabulary
        text = (
            f"{names.places[place]}: no run of {names.actions[action - 1]} was measured; train "
            "with more trials"
        )
        raise ValueError(text) from fault


def _replayed(
    training: Training, structure: Structure, measured_runs: RunDistributions, request: Request
) -> Played:
    """Simulate four times as many trials as were run, with the choices of the training."""
    n = len(training.trials)
    own = Request(request.runs, choices_of(training), request.seed)
    random = np.random.default_rng([request.seed, 1])
    return _played(
        training, structure, measured_runs, own, np.ones((1, n)), np.zeros(4 * n, np.int64), random
    )


def longest_of(training: Training) -> int:
    """Return the number of steps after which a simulated trial counts as endless: 100 plus twenty
    times the longest measured trial."""
    return 100 + 20 * max(len(trial.runs) + len(trial.waits) for trial in training.trials)


def _bootstrap(
    training: Training,
    structure: Structure,
    measured_runs: RunDistributions,
    request: Request,
    whole: Played,
    random: np.random.Generator,
) -> tuple[dict[str, Values], Values]:
    """Return the figures of `runs` new trials for resampled training trials, and the distance of
    each distribution of the time from the whole one.

    Trials are resampled as a whole (cluster bootstrap), because the runs of one trial depend on
    each other.
    """
    n = len(training.trials)
    at_once = max(1, TOGETHER // request.runs)
    found: dict[str, list[float]] = {name: [] for name in (*SHARES, *TIMES)}
    distances: list[float] = []
    reference = np.sort(whole.time[whole.completed])
    for begin in range(0, request.replicates, at_once):
        count = min(at_once, request.replicates - begin)
        weights = random.multinomial(n, np.full(n, 1.0 / n), size=count).astype(np.float64)
        replicate = np.repeat(np.arange(count), request.runs)
        played = _played(training, structure, measured_runs, request, weights, replicate, random)
        for b in range(count):
            own = replicate == b
            one = Played(
                played.goals[own], played.completed[own], played.all_success[own], played.time[own]
            )
            for name, value in figures(one).items():
                found[name].append(value)
            distances.append(distance(one.time[one.completed], reference))
    return {name: np.array(values) for name, values in found.items()}, np.array(distances)


def distance(sample: Values, reference: Values) -> float:
    """Return Kolmogorov's distance between a sample and a (large, sorted) reference."""
    if not len(sample) or not len(reference):
        return 1.0
    ordered = np.sort(sample)
    at = np.searchsorted(reference, ordered, side="right") / len(reference)
    below = np.searchsorted(reference, ordered, side="left") / len(reference)
    steps = np.arange(len(ordered) + 1) / len(ordered)
    return float(max(np.max(np.abs(at - steps[1:])), np.max(np.abs(below - steps[:-1]))))


def _figure(
    name: str, value: float, samples: Values, request: Request, training: int
) -> dict[str, Any]:
    known = samples[~np.isnan(samples)]
    if not len(known):
        return {"value": None, "interval": None, "sd": None}
    sd = float(known.std(ddof=1)) if len(known) > 1 else 0.0
    if name in SHARES:
        interval = predictive_interval(
            value, share_weight(value, sd, request.runs, training), request.runs, LEVEL
        )
    else:
        interval = _rounded(np.quantile(known, ((1 - LEVEL) / 2, (1 + LEVEL) / 2)))
    return {"value": round(value, 6), "interval": interval, "sd": round(sd, 8)}


def product_rule(training: Training, choices: Choices) -> dict[str, Any]:
    """Return the product of reliabilities over the places of the normal flow: R_conj of a series,
    if all were independent."""
    names, runs = training.vocabulary, training.runs
    status, _ = names.parts(runs.outcome)
    normal = [q for q, p in enumerate(names.places) if p not in training.task.flat.error_elements]
    value, factors = 1.0, {}
    for q in normal:
        chosen = choices.get(training.task.primitive_task_of(names.places[q]).name, {})
        r = whole = 0.0
        for action, probability in chosen.items():
            own = (
                (runs.place == q)
                & (runs.action == names.actions.index(action) + 1)
                & ~runs.censored
            )
            if own.any():
                r, whole = (
                    r + probability * float(np.mean(status[own] == SUCCESS)),
                    whole + probability,
                )
        if whole:
            factors[names.places[q]] = round(r / whole, 6)
            value *= r / whole
    return {"R_conj": round(value, 6), "factors": factors}


def _rounded(values: Values) -> list[float]:
    return [round(float(v), 6) for v in values]
