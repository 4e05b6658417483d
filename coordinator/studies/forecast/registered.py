"""Forecast files: written before the runs, with the time, a hash of their basis and a hash of their
contents."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time.completion import completion_time
from petrobot.coordinator.analysis.time.stochastic import NoEstimate, stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import forecast as solve
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.propagation import ChoiceShares, measured_from
from petrobot.coordinator.studies.campaign.observed import context_of
from petrobot.coordinator.studies.forecast.history import ForecastError, Training
from petrobot.coordinator.studies.forecast.predict import Request, predict
from petrobot.coordinator.task import Task
from petrobot.services.host.json_text import finite, json_text
from petrobot.services.host.whole_file import make_folder, write_whole

SCHEMA = 2
"""1: times with a standard deviation only, everything from the simulated net; still read."""
METHOD = (
    "Where the training chose as the new trials will, or often enough so: figures straight from "
    "the training trials (exact binomial intervals, bootstrap-t for the mean, fractional order "
    "statistics for the quantile). Else generalised semi-Markov simulation of the net with "
    "measured competing risks of each run, in contexts that chi-square tests distinguish, and a "
    "cluster bootstrap over training trials. `interval` is predictive, for the new trials; "
    "`confidence` is of the true figure. Beside both the exact solution of the stochastic view "
    "(GSPN): phase-type durations, statuses of one trial independent of each other."
)
LARGEST = 50_000
"""Largest number of markings for which the stochastic view is solved."""
JUMPS = 20_000
"""Largest number of jumps of the uniformised chain for which its quantile is computed."""


def register(
    task: Task,
    trainings: Mapping[str, Training],
    requests: Mapping[str, Request],
    about: Mapping[str, Any],
    estimates: Estimates | None = None,
) -> dict[str, Any]:
    """Make a forecast of the regimes in `requests`; `about` describes its basis. With `estimates`,
    the solution of the stochastic view is added.

    Raises ForecastError.
    """
    regimes = {}
    for name, request in requests.items():
        if name not in trainings:
            raise ForecastError(
                f"no trial of regime {name} was measured; measured: {', '.join(trainings)}"
            )
        try:
            regimes[name] = predict(trainings[name], request) | {"choices": request.choices}
            if estimates is not None:
                regimes[name]["gspn"] = exact(task, estimates, name, request.choices)
        except ValueError as fault:
            raise ForecastError(f"regime {name or '-'}: {fault}") from fault
    told = {
        "schema": SCHEMA,
        "task": task.name,
        "registered_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "method": METHOD,
        **about,
        "regimes": regimes,
    }
    body = finite(told)  # as it will be read from the file, so that the hash is the same then
    return {**body, "sha256": _hash(body)}


def _hash(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def write(path: Path, forecast: Mapping[str, Any]) -> None:
    """Write a forecast file. Raises ForecastError, also if the file exists: a registered forecast
    is never overwritten."""
    text = json_text(forecast, indent=2) + "\n"
    try:
        make_folder(path.parent)
        write_whole(path, text, fresh=True)
    except FileExistsError as fault:
        raise ForecastError(
            f"{path} exists: a registered forecast is never overwritten; give another --out"
        ) from fault
    except OSError as fault:
        raise ForecastError(f"{path}: {fault.strerror or fault}") from fault


def read(path: Path) -> dict[str, Any]:
    """Read a forecast file. Raises ForecastError, also if the file was changed after it was
    written."""
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        body = {key: value for key, value in found.items() if key != "sha256"}
        if found["schema"] not in (1, SCHEMA):
            raise ForecastError(f"{path}: schema: expected 1 or {SCHEMA}, got {found['schema']!r}")
        said = found["sha256"]
    except OSError as fault:
        raise _no_forecast(path, fault.strerror or str(fault)) from fault
    except ValueError as fault:
        raise _no_forecast(path, f"not JSON ({fault})") from fault
    except (KeyError, TypeError, AttributeError) as fault:
        raise _no_forecast(path, "expected an object with schema and sha256") from fault
    if said != _hash(body):
        raise ForecastError(f"{path} was changed after it was registered; restore it from a copy")
    for regime in found["regimes"].values():
        if "training_throws" in regime:  # key in files of older versions
            regime["training_trials"] = regime.pop("training_throws")
    return found


def _no_forecast(path: Path, why: str) -> ForecastError:
    return ForecastError(
        f"{path} is not a forecast: {why}; give a file that `petrobot forecast --out FILE` wrote"
    )


def exact(task: Task, estimates: Estimates, regime: str, choice: ChoiceShares) -> dict[str, Any]:
    """Return the figures of the stochastic view for one trial; only `why` if it cannot be solved.

    Its times begin with the initial marking, so they include the wait for the event that begins the
    trial.
    """
    try:
        view = stochastic_view(task, measured_from(task, estimates, context_of(regime), choice))
        if task.runs_place:
            view = replace(view, gspn=view.gspn.marked({task.runs_place: 1}))
        found = solve(view, limits=SearchLimits(states=LARGEST))
    except (NoEstimate, ValueError, ArithmeticError) as fault:
        return {"why": str(fault)}
    try:
        q90 = (
            completion_time(found.chain, found.done.goal, steps=JUMPS).quantile(0.9)
            if found.completion_probability > 0
            else None
        )
    except ArithmeticError:
        q90 = None
    numbers = {
        "R_goal": found.goal_reliability,
        "P_complete": found.completion_probability,
        "R_conj": found.conjunctive_reliability,
        "mean": found.done.mean,
        "q90": q90,
    }
    return {
        **{k: None if v is None else round(float(v), 6) for k, v in numbers.items()},
        "markings": found.chain.n,
    }
