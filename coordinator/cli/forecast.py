"""Forecast further runs of a task from measured ones, and register the forecast before they run; or compare it with them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coordinator.cli import CommandError
from coordinator.cli.loading import load_task, write_json
from coordinator.cli.quantities import whole

if TYPE_CHECKING:
    from coordinator.campaign.plan import Plan
    from coordinator.forecast.history import Training
    from coordinator.learning.learning import Estimates
    from coordinator.task import Task

EXAMPLE = (
    "petrobot forecast catch_ball --estimates campaigns/train --runs 1000 --out forecast.json\n"
    "  petrobot forecast --compare forecast.json campaigns/new"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("task", nargs="?", help="a task file, or the name of a task that comes with petrobot")
    parser.add_argument(
        "--estimates",
        metavar="FILE|CAMPAIGN",
        type=Path,
        help="a campaign's folder, or an estimates file without its throws",
    )
    parser.add_argument(
        "--runs", type=whole(), default=1000, metavar="N", help="that will be run in each regime (%(default)s)"
    )
    parser.add_argument("--regime", default="", metavar="A,B", help="only these (default: all that were measured)")
    parser.add_argument(
        "--choose", default="", metavar="TASK=ACTION,...", help="choices of the new runs (default: as measured)"
    )
    parser.add_argument("--learned", metavar="CAMPAIGN", type=Path, help="new runs take what this campaign has learned")
    parser.add_argument("--replicates", type=whole(20), default=400, metavar="B", help="of the bootstrap (%(default)s)")
    parser.add_argument("--seed", type=whole(0), default=1, metavar="S", help="of the simulation (%(default)s)")
    parser.add_argument("--out", metavar="FILE", type=Path, help="register the forecast here; never written over")
    parser.add_argument(
        "--compare", nargs=2, metavar=("FORECAST", "CAMPAIGN"), type=Path, help="compare with what was measured"
    )
    parser.add_argument("--markdown", metavar="FILE", type=Path, help="write the table as Markdown")
    parser.add_argument("--json", metavar="FILE", help="write everything as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Forecast, or compare: exit code 1 when the forecast disagrees."""
    from coordinator.campaign.plan import CampaignError
    from coordinator.forecast.registered import ForecastError

    try:
        if options.compare is not None:
            registered, folder = options.compare
            return _compare(registered, folder, options)
        if options.task is None or options.estimates is None:
            raise CommandError(2, "give TASK and --estimates CAMPAIGN to forecast, or --compare FORECAST CAMPAIGN")
        return _forecast(options)
    except (ForecastError, CampaignError) as fault:
        raise CommandError(2, str(fault)) from fault


def _forecast(options: argparse.Namespace) -> int:
    from coordinator.forecast.registered import register, write
    from coordinator.forecast.tables import forecast_text

    task = load_task(options.task)
    trainings, estimates, about = _trainings(task, options.estimates)
    names = [name for name in options.regime.split(",") if name] or list(trainings)
    requests = {name: _request(task, trainings, name, options) for name in names}
    made = register(task, trainings, requests, about, estimates)
    if options.out is not None:
        write(options.out, made)
    if options.json:
        write_json(options.json, made)
    if options.json != "-":
        print(forecast_text(made))
        if options.out is not None:
            print(f"registered: {options.out}  sha256 {made['sha256'][:16]}")
    return 0


def _trainings(task: Task, path: Path) -> tuple[dict[str, Training], Estimates, dict[str, Any]]:
    """Training throws by regime, the estimates, and what the forecast says about where they come from."""
    from coordinator.campaign.observed import estimates_of
    from coordinator.campaign.plan import digest, read_manifest
    from coordinator.campaign.table import TABLE, read_table
    from coordinator.forecast.history import by_regime
    from coordinator.forecast.summed import read_estimates, trainings_of

    if not path.is_dir():
        known = read_estimates(path)
        return trainings_of(task, known), known, {"estimates": {"file": path.name, "sha256": digest(path)}}
    plan = read_manifest(path)
    found = by_regime(task, read_table(path / TABLE))
    if not found:
        raise CommandError(2, f"{path}: the table holds no throw yet")
    about = {
        "estimates": {"campaign": path.name, "seed": plan.seed, "block": plan.block, "sha256": digest(path / TABLE)},
        "task_sha256": plan.digests["task"],
    }
    return found, estimates_of(task, read_table(path / TABLE), path.name), about


def _request(task: Task, trainings: Mapping[str, Training], regime: str, options: argparse.Namespace) -> Any:
    from coordinator.campaign.policies import learned_choices
    from coordinator.forecast.predict import Request, choices_of

    if regime not in trainings:
        raise CommandError(2, f"--regime {regime}: not measured; there are {', '.join(trainings)}")
    choices: dict[str, Mapping[str, float]] = dict(choices_of(trainings[regime]))
    learned = learned_choices(options.learned).get(regime, {}) if options.learned is not None else {}
    by_hand = dict(_pair(text) for text in options.choose.split(",") if text)
    for name, action in {**learned, **by_hand}.items():
        primitive = task.primitive_tasks.get(name)
        if primitive is None or action not in primitive.alternatives:
            known = ", ".join(primitive.alternatives if primitive else task.primitive_tasks)
            raise CommandError(2, f"--choose {name}={action}: not known to {task.name}; choose among {known}")
        choices[name] = {action: 1.0}
    return Request(options.runs, choices, options.seed, options.replicates)


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise CommandError(2, f"--choose {text}: write TASK=ACTION")
    return name, value


def _compare(registered: Path, folder: Path, options: argparse.Namespace) -> int:
    from coordinator.forecast.tables import agreement_markdown, agreement_text

    found = compared(registered, folder)
    if options.markdown is not None:
        options.markdown.parent.mkdir(parents=True, exist_ok=True)
        options.markdown.write_text(agreement_markdown(found), encoding="utf-8")
    if options.json:
        write_json(options.json, found)
    if options.json != "-":
        print(agreement_text(found))
    return 0 if found["agrees"] else 1


def fitting(registered: Path, forecast: dict[str, Any], plan: Plan) -> Task:
    """The task of a campaign that may be compared with a registered forecast. Raises CommandError."""
    task = load_task(plan.task)
    if task.name != forecast["task"]:
        raise CommandError(2, f"{registered} forecasts {forecast['task']}, the campaign runs {task.name}")
    training = forecast["estimates"]
    if training.get("seed") == plan.seed and training.get("block") == plan.block:
        raise CommandError(
            2, f"{registered} was trained on these throws (seed {plan.seed}): run the campaign with another --seed"
        )
    return task


def compared(registered: Path, folder: Path) -> dict[str, Any]:
    """A registered forecast beside what a campaign measured. Raises CommandError when they do not belong together."""
    from coordinator.campaign.plan import read_manifest
    from coordinator.campaign.spent import began
    from coordinator.campaign.table import TABLE, read_table
    from coordinator.forecast.agreement import agreement
    from coordinator.forecast.history import by_regime
    from coordinator.forecast.registered import read

    forecast, plan = read(registered), read_manifest(folder)
    task = fitting(registered, forecast, plan)
    measured = by_regime(task, read_table(folder / TABLE))
    try:
        found = agreement(forecast, measured)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    first = began(folder)
    return {
        "task": task.name,
        "forecast": {"file": registered.name, "sha256": forecast["sha256"], "registered_at": forecast["registered_at"]},
        "campaign": {"folder": folder.name, "seed": plan.seed, "began_at": first},
        "registered_before": first is not None and forecast["registered_at"] <= first,
        "same_block": forecast["estimates"].get("block") in (None, plan.block),
        "same_task_file": forecast.get("task_sha256") in (None, plan.digests["task"]),
        **found,
    }
