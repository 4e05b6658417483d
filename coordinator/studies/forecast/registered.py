"""Forecast files: written before the runs, with the time, a hash of their basis and a hash of their
contents."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from petrobot.coordinator.analysis.may_run import Cell, assumed, devices_of
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time.completion import completion_time, reliability_slopes
from petrobot.coordinator.analysis.time.measured import Measured, NoEstimate
from petrobot.coordinator.analysis.time.stochastic import STAGES, stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import MATTERS, Forecast, trial_forecast
from petrobot.coordinator.analysis.time.whatif import Change, change_task
from petrobot.coordinator.learning.estimate import Tally
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.propagation import ChoiceShares, limits_of, measured_from
from petrobot.coordinator.studies.campaign.observed import context_of, observation
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.history import ForecastError, Training
from petrobot.coordinator.studies.forecast.predict import NET, TRIALS, Request, predict
from petrobot.coordinator.studies.forecast.residual import overlapping
from petrobot.coordinator.task import Estimate, Kind, Status, Task
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
CONTRADICTS_SHARE, CONTRADICTS_TIME = 0.1, 0.25
"""By how much a share, and relatively a mean time, of simulated net and stochastic view may differ.
A heuristic: phase-type fits keep each mean and share, so only races of parallel runs, and statuses
that depend on each other, move these figures; the faults that it is to find were .3 and more."""
JUMPS = 20_000
"""Largest number of jumps of the uniformised chain for which its quantile is computed."""


def register(
    task: Task,
    trainings: Mapping[str, Training],
    requests: Mapping[str, Request],
    about: Mapping[str, Any],
    estimates: Estimates | None = None,
    cell: Cell | None = None,
) -> dict[str, Any]:
    """Make a forecast of the regimes in `requests`; `about` describes its basis. With `estimates`,
    the solution of the stochastic view in the cell is added.

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
            if request.changes:
                regimes[name]["what_if"] = [change.text for change in request.changes]
            if estimates is not None:
                regimes[name]["gspn"] = exact(
                    task,
                    estimates,
                    name,
                    request.choices,
                    cell,
                    apart=by_place(trainings[name]),
                    changes=request.changes,
                )
                if unlike := unlike_trials(regimes[name], regimes[name]["gspn"]):
                    regimes[name]["gspn"] = {"why": unlike}
                elif "why" not in regimes[name]["gspn"]:
                    regimes[name]["gspn"]["notes"] += _rough(
                        regimes[name], bool(overlapping(trainings[name]))
                    )
                doubts = contradictions(regimes[name], regimes[name]["gspn"])
                if doubts and not _views_miss(trainings[name], estimates, name, cell):
                    regimes[name]["doubts"] += doubts
        except ValueError as fault:
            raise ForecastError(f"regime {name or '-'}: {fault}") from fault
    told = {
        "schema": SCHEMA,
        "task": task.name,
        "registered_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "method": METHOD,
        "assumed": assumed(cell),
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


def exact(
    task: Task,
    estimates: Estimates,
    regime: str,
    choice: ChoiceShares,
    cell: Cell | None = None,
    *,
    apart: Mapping[str, Mapping[str, Tally]] | None = None,
    changes: Sequence[Change] = (),
) -> dict[str, Any]:
    """Return the figures of the stochastic view for one trial; only `why` if it cannot be solved.
    `apart` as for `measured_from`.

    `P_complete_interval` contains what the estimates leave open (see `_share_error`),
    `P_complete_error` what the solution does (relative). Its times begin when the run token is
    taken, as those of the trials do.
    """
    context = context_of(regime)
    try:
        devices = devices_of(cell)
        known = measured_from(task, estimates, context, choice, devices=devices, apart=apart)
        unentered = _unentered(task, known)
        known = replace(known, runs={**known.runs, **unentered})
        task, known = change_task(task, known, changes)
        view = stochastic_view(task, known, devices=devices)
        found = trial_forecast(view, SearchLimits(states=LARGEST))
        _refuse_guesses(task, found, unentered)
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
        "P_complete_error": found.completion_error,
    }
    # digits, not decimals: a probability of 1e-6 keeps its own
    return {
        **{k: None if v is None else float(f"{v:.7g}") for k, v in numbers.items()},
        "P_complete_interval": _share_error(task, estimates, context, found, apart or {}),
        "markings": found.chain.n,
        "notes": [*found.later],
    }


def contradictions(said: Mapping[str, Any], view: Mapping[str, Any]) -> list[str]:
    """Return in words where simulated net and stochastic view contradict each other, if no trial
    tells which of them is right: by more than fitted durations explain."""
    # the view does not know what a choice does to the runs of other places
    tested = said["whole"] and (said["asked"] or (said["same"] and not said.get("what_if")))
    if said["from"] != NET or tested:
        return []
    return [
        f"{name} is {value:.4g} by the simulated net, but {other:.4g} by the stochastic view, and "
        "no trial tells which is right; run a campaign of this form"
        for name, value, other in _apart(said, view)
    ]


def unlike_trials(said: Mapping[str, Any], view: Mapping[str, Any]) -> str:
    """Return in words which figures of the stochastic view the trials contradict, from which the
    figures of the forecast come; empty if none. Such a view is left out of the forecast."""
    apart = _apart(said, view) if said["from"] == TRIALS else []
    if not apart:
        return ""
    figures = "; ".join(
        f"{name} is {value:.4g} by the trials, but {other:.4g} by this view"
        for name, value, other in apart
    )
    return (
        f"left out: {figures}. One of its assumptions does not hold here, so do not rely on it in "
        "`analyse`, `simulate` or a what-if"
    )


def _apart(said: Mapping[str, Any], view: Mapping[str, Any]) -> list[tuple[str, float, float]]:
    """Return the figures (name, own value, that of the view) that differ by more than fitted
    durations explain."""
    out = list[tuple[str, float, float]]()
    if "why" in view:
        return out
    for name in ("R_goal", "P_complete", "mean"):
        figure, other = said["figures"].get(name), view[name]
        if figure is None or other is None or figure["value"] is None:
            continue
        value, (low, high) = figure["value"], figure["confidence"]
        limit = CONTRADICTS_TIME * value if name == "mean" else CONTRADICTS_SHARE
        if abs(other - value) > limit and not low <= other <= high:
            out.append((name, value, other))
    return out


def _rough(regime: Mapping[str, Any], overlap: bool) -> list[str]:
    """Return a note if the quantile of the view is not that of the forecast, whose durations are
    not fitted, and whose trials may `overlap`."""
    own, other = regime["figures"].get("q90"), regime["gspn"]["q90"]
    if own is None or own["value"] is None or other is None:
        return []
    low, high = own["confidence"]
    if low <= other <= high or abs(other - own["value"]) <= MATTERS * own["value"]:
        return []
    outside = "doubtful: its 90 % quantile is outside the interval above, because"
    if overlap:
        return [f"{outside} trials of the training overlapped, and the view has one at a time"]
    return [
        f"{outside} durations are fitted by their mean and deviation with at most {STAGES} phases, "
        "and statuses of one trial are taken as independent"
    ]


def _views_miss(training: Training, estimates: Estimates, regime: str, cell: Cell | None) -> bool:
    """Return whether the stochastic view contradicts the trials themselves, in the form that was
    run: then it does not judge another form."""
    known = training.earlier or training
    if not known.repeats:
        return False
    choices = choices_of(known)
    seen = predict(known, Request(len(known.trials), choices, net=False)) | {
        "from": NET,
        "same": False,
    }
    view = exact(known.task, estimates, regime, choices, cell, apart=by_place(known))
    return bool(contradictions(seen, view))


def by_place(training: Training) -> dict[str, dict[str, Tally]]:
    """Return the tally of each action in each place that ends its runs after another time than
    others of its primitive task; empty for an estimates file, which has no places."""
    flat, out = training.task.flat, dict[str, dict[str, Tally]]()
    own = {
        place.name
        for place in flat.places.values()
        if place.kind is Kind.ACTION and len(limits_of(flat, place.task)) > 1
    }
    for run in (r for t in training.trials for r in t.runs if training.whole and r.place in own):
        tallies = out.setdefault(run.place, {})
        tally = tallies.get(run.action, Tally())
        tallies[run.action] = tally.adding(observation(flat, run), str(tally.changes))
    return out


def _unentered(task: Task, known: Measured) -> dict[tuple[str, str], dict[Status, Estimate]]:
    """Return estimates that only let the view be built, for places of which nothing is known."""
    flat = task.flat
    return {
        (place.name, action): {Status.SUCCESS: Estimate(1.0, 1.0)}
        for place in flat.places.values()
        if place.kind is Kind.ACTION and not flat.primitive_tasks[place.task].estimates
        for action in flat.primitive_tasks[place.task].alternatives
        if not any(key[0] in (place.name, place.task) for key in known.runs)
    }


def _refuse_guesses(task: Task, found: Forecast, unentered: Mapping[tuple[str, str], Any]) -> None:
    """Raise ValueError if the view enters a place of which nothing is known."""
    for place in dict.fromkeys(name for name, _ in unentered):
        often = sum(
            found.firings[t.name]
            for t in task.flat.transitions.values()
            if any(out.place == place for out in t.outputs)
        )
        if often > 0.0:
            raise ValueError(
                f"no training run entered {place}, but by the net a trial enters it {often:.2g} "
                "times; train with more trials"
            )


def _share_error(
    task: Task,
    estimates: Estimates,
    context: str | None,
    found: Forecast,
    apart: Mapping[str, Mapping[str, Tally]],
) -> list[float] | None:
    """Return the 95 % interval of P_complete that the measured shares of statuses leave.

    Delta method on the logarithm, with the exact derivatives of the solution: the shares of one
    action are multinomial in its number of runs. A status that was never seen adds nothing.
    """
    p, variance = found.completion_probability, 0.0
    if p <= 0.0:
        return None
    slopes = reliability_slopes(found.done)
    shares: dict[tuple[str, str, Status], float] = {}
    for label, end in found.view.statuses.items():
        shares[end] = shares.get(end, 0.0) + slopes[label].value
    moves: dict[tuple[str, str], dict[Status, list[float]]] = {}
    for label, end in found.view.statuses.items():
        place, action, status = end
        where = place if action in apart.get(place, ()) else task.primitive_task_of(place).name
        # Places with the same primitive task share its runs, if all end them after the same time;
        # the branches of a duration share the runs of its status.
        own = moves.setdefault((where, action), {}).setdefault(status, [0.0, 0.0])
        own[0] += slopes[label].derivative * slopes[label].value / shares[end]
        own[1] = shares[end]
    for (where, action), by_status in moves.items():
        tallies = estimates.of(where, context).get(action, {}).values()
        runs = apart[where][action].runs if where in apart else sum(t.runs for t in tallies)
        if runs:
            first = sum(d * q for d, q in by_status.values())
            variance += (sum(q * d * d for d, q in by_status.values()) - first**2) / runs
    half = 1.96 * math.sqrt(max(0.0, variance)) / p
    low, high = (float(f"{min(1.0, p * math.exp(side)):.7g}") for side in (-half, half))
    # Nothing that decides was ever seen otherwise: no interval, not one of width 0. The digits that
    # are written decide, because the slopes then are rounding errors of the solution, not 0.
    return [low, high] if low < high else None
