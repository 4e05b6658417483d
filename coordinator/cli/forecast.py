"""Forecast further runs of a task from measured ones, and register the forecast before they run; or
compare it with them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    add_json_argument,
    add_seed_argument,
    add_services_argument,
    add_task_argument,
    cell_finder,
    load_directory,
    load_task,
    task_path,
    told_if_slow,
    write_json,
)
from petrobot.coordinator.cli.options import pairs, refuse_idle
from petrobot.services.comm.location_file import FIRST_PHYSICS, MOCK, physics_of, same_physics
from petrobot.services.host.command_line import MOST_RUNS, whole
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.may_run import Cell
    from petrobot.coordinator.learning.learning import Estimates
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan
    from petrobot.coordinator.studies.forecast.history import Training
    from petrobot.coordinator.studies.forecast.predict import Request
    from petrobot.coordinator.task import Task

EXAMPLE = (
    "petrobot forecast catch_ball --estimates campaigns/train --runs 1000 --out forecast.json\n"
    "  petrobot forecast --compare forecast.json campaigns/new"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    _add_training(parser)
    _add_further_runs(parser)
    _add_output(parser)


def _add_training(parser: argparse.ArgumentParser) -> None:
    add_task_argument(parser, optional=True)
    parser.add_argument(
        "--estimates",
        metavar="FILE|CAMPAIGN",
        type=Path,
        help="a campaign's folder, or an estimates file without its trials",
    )
    parser.add_argument(
        "--plant",
        metavar="NAME",
        help="which runs of an estimates file with several plants: real, simulated or mock",
    )
    add_services_argument(parser)


def _add_further_runs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--runs",
        type=whole(most=MOST_RUNS),
        default=1000,
        metavar="N",
        help="number of further runs in each regime (%(default)s)",
    )
    parser.add_argument(
        "--regime",
        default="",
        metavar="A,B",
        help="forecast only these regimes (default: all that were measured)",
    )
    parser.add_argument(
        "--choose",
        default="",
        metavar="TASK=ACTION,...",
        help="choices of the new runs (default: as measured)",
    )
    parser.add_argument(
        "--learned",
        metavar="CAMPAIGN",
        type=Path,
        help="new runs take what this campaign has learned",
    )
    parser.add_argument(
        *("--what-if", "-w"),
        action="append",
        default=[],
        metavar="CHANGE",
        help="other durations and shares than the training has: move_to_point.mean*=1.5 (a slower "
        "arm), locate_ball.error.share=0.05 (may be repeated)",
    )
    parser.add_argument(
        "--replicates",
        type=whole(20),
        default=400,
        metavar="B",
        help="number of bootstrap samples, at least 20 (%(default)s)",
    )
    add_seed_argument(parser)


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="register the forecast in this file, which must not exist yet",
    )
    parser.add_argument(
        "--doubtful",
        action="store_true",
        help="register the forecast even if it does not repeat its own training",
    )
    parser.add_argument(
        "--compare",
        nargs=2,
        metavar=("FORECAST", "CAMPAIGN"),
        type=Path,
        help="compare with what was measured",
    )
    parser.add_argument("--markdown", metavar="FILE", type=Path, help="write the table as Markdown")
    add_json_argument(parser, "everything")


def run(options: argparse.Namespace) -> int:
    """Forecast, or compare: exit code 1 when the forecast is doubtful or disagrees."""
    if options.compare is not None:
        why = "a registered forecast is compared as it is; leave this out beside --compare"
        refuse_idle(options, why, heeded={"compare", "markdown", "json"})
        registered, folder = options.compare
        return _compare(registered, folder, options)
    if options.task is None or options.estimates is None:
        raise CommandError(
            2,
            "give TASK and --estimates CAMPAIGN to forecast (`petrobot campaign TASK --out "
            "CAMPAIGN` measures one), or --compare FORECAST CAMPAIGN",
        )
    why = "a forecast has no table; give it beside --compare"
    refuse_idle(options, why, idle={"markdown"})
    if options.out is None:
        why = "nothing is registered without --out FILE; add that, or leave this out"
        refuse_idle(options, why, idle={"doubtful"})
    return _forecast(options)


def _forecast(options: argparse.Namespace) -> int:
    from petrobot.coordinator.analysis.time.whatif import read_change
    from petrobot.coordinator.studies.forecast.registered import register, write
    from petrobot.coordinator.studies.forecast.tables import forecast_text

    task = load_task(options.task)
    cell = cell_finder(options.services, options.task)(task)
    file = task_path(options.task)
    trainings, estimates, about = _trainings(task, file, options.estimates, options.plant, cell)
    names = [name for name in options.regime.split(",") if name] or list(trainings)
    changes = [read_change(text) for text in options.what_if]
    requests = {
        name: replace(_request(task, trainings, about, name, options), changes=changes)
        for name in names
    }
    if options.services is not None:
        _refuse_other_cell(task, options.services, requests, about)
    with told_if_slow(f"{task.name}: simulating further trials"):
        made = register(task, trainings, requests, about, estimates, cell)
    doubtful = any(said["doubts"] for said in made["regimes"].values())
    registered = options.out is not None and (options.doubtful or not doubtful)
    if registered:
        write(options.out, made)
    if options.json:
        write_json(options.json, made)
    if options.json != "-":
        print(forecast_text(made))
        if registered:
            print(f"registered: {options.out}  sha256 {made['sha256'][:16]}")
    if doubtful and not options.doubtful:
        kept = (
            ""
            if options.out is None
            else f"; {options.out} is not written; --doubtful registers it anyway"
        )
        print(f"petrobot forecast: DOUBTFUL, see above{kept}", file=sys.stderr)
        return 1
    return 0


def _refuse_other_cell(
    task: Task, services: Path, requests: Mapping[str, Request], about: Mapping[str, Any]
) -> None:
    """Check that the new trials can run with this location file as the forecast assumes. Raises
    CommandError for another physics, or an action that is on no node."""
    directory = load_directory(services)
    try:
        physics = physics_of(directory)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    # empty: no laboratory, or its package is not installed here
    if physics and not same_physics(about.get("physics", ""), physics):
        raise CommandError(
            2,
            f"{services}: its physics is {physics or FIRST_PHYSICS!r}, but the estimates are of "
            f"{about.get('physics', '') or FIRST_PHYSICS!r}; train with this location file",
        )
    for name, request in requests.items():
        for primitive, chosen in request.choices.items():
            for action, probability in chosen.items():
                if probability > 0 and action not in directory.actions:
                    raise CommandError(
                        2,
                        f"regime {name or '-'}: {primitive}={action} is chosen in {task.name}, but "
                        f"{services} gives {action} to no node; choose another one with --choose",
                    )


def _trainings(
    task: Task, file: Path, path: Path, plant: str | None, cell: Cell | None
) -> tuple[dict[str, Training], Estimates, dict[str, Any]]:
    """Training trials by regime in a cell, the estimates, and what the forecast says about where
    they come from."""
    from petrobot.coordinator.studies.campaign.observed import estimates_of
    from petrobot.coordinator.studies.campaign.plan import TASK_COPY, digest, read_manifest
    from petrobot.coordinator.studies.campaign.table import TABLE, read_table
    from petrobot.coordinator.studies.forecast.history import (
        by_regime,
        of_this_form,
        read_estimates,
        trainings_of,
    )

    if not path.is_dir():
        kept = read_estimates(path, plant)
        known = kept.estimates
        _refuse_other_names(task, path, {key.primitive_task: [key.action] for key in known.tallies})
        return (
            trainings_of(task, known, cell),
            known,
            {
                "estimates": {"file": path.name, "sha256": digest(path)},
                **_told(kept.physics, kept.plant),
            },
        )
    plan = read_manifest(path)
    own = plan.plant
    if plant not in (None, own):
        raise CommandError(2, f"{path}: --plant {plant}: the campaign's runs are {own}")
    _refuse_other_task(task, plan, path)
    rows = list(read_table(path / TABLE))
    ran = load_task(str(path / TASK_COPY)) if (path / TASK_COPY).is_file() else None
    same = digest(file) == plan.digests["task"] or _same_form(task, ran)
    earlier = by_regime(ran, rows, cell) if ran is not None and not same else {}
    if not same:
        rows = of_this_form(task, ran, rows)
    found = {
        regime: replace(training, earlier=earlier.get(regime))
        for regime, training in by_regime(task, rows, cell, same).items()
    }
    if not found:
        raise CommandError(2, f"{path}: the table holds no trial yet")
    if not any(len(training.runs) for training in found.values()):
        raise CommandError(
            2,
            f"{path / TABLE}: it has no run of an action place and an action of {file}, which has "
            "changed: train again",
        )
    about = {
        "estimates": {
            "campaign": path.name,
            "seed": plan.seed,
            "block": plan.block,
            "sha256": digest(path / TABLE),
        },
        "task_sha256": digest(file),
        **_told(plan.physics, own),
    }
    return found, estimates_of(task, rows, path.name), about


def _told(physics: str, plant: str = "") -> dict[str, str]:
    """Return what a forecast says of the plant that it was trained in, and of the simulated
    laboratory's physics, if it has several."""
    return {k: v for k, v in (("plant", plant), ("physics", physics)) if v}


def _same_form(task: Task, ran: Task | None) -> bool:
    """Return whether the trials of a campaign are trials of the task, by the campaign's copy of its
    task file, which older campaigns lack; another number of runs is no change."""
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.studies.forecast.history import same_form

    return ran is not None and same_form(with_runs(ran, 1)[0], with_runs(task, 1)[0])


def _refuse_other_task(task: Task, plan: CampaignPlan, path: Path) -> None:
    """Check that the campaign ran a task of this name, if its file still exists. Raises
    CommandError."""
    from petrobot.coordinator.studies.campaign.plan import MANIFEST

    if not Path(plan.task).is_file():
        return
    name = load_task(plan.task).name
    if name != task.name:
        raise CommandError(
            2,
            f"{path / MANIFEST}: task: the campaign ran {name}, not {task.name}; give "
            f"--estimates of {task.name}",
        )


def _refuse_other_names(task: Task, path: Path, found: Mapping[str, Iterable[str]]) -> None:
    """Check that the estimates file has primitive tasks of this task. Raises CommandError."""
    if not set(found) & set(task.flat.primitive_tasks):
        raise CommandError(
            2,
            f"{path}: it holds estimates of {', '.join(sorted(found))}; {task.name} has "
            f"{', '.join(task.flat.primitive_tasks)}",
        )


def _request(
    task: Task,
    trainings: Mapping[str, Training],
    about: Mapping[str, Any],
    regime: str,
    options: argparse.Namespace,
) -> Request:
    from petrobot.coordinator.studies.campaign.policies import learned_choices
    from petrobot.coordinator.studies.forecast.choices import choices_of
    from petrobot.coordinator.studies.forecast.predict import Request

    if regime not in trainings:
        raise CommandError(2, f"--regime {regime}: not measured; there are {', '.join(trainings)}")
    choices: dict[str, Mapping[str, float]] = dict(choices_of(trainings[regime]))
    learned = dict[str, dict[str, str]]()
    if options.learned is not None:
        learned = learned_choices(
            options.learned,
            task.name,
            mock=about.get("plant") == MOCK,
            physics=about.get("physics", ""),
        )
    if options.learned is not None and regime not in learned:
        raise CommandError(
            2,
            f"--learned {options.learned}: nothing was learned of regime {regime or '-'}; "
            f"there are {', '.join(learned)}",
        )
    asked = {
        name: (action, f"--learned {options.learned}")
        for name, action in learned.get(regime, {}).items()
        if name in choices  # a place that training never entered stays at probability 0
    }
    chosen = pairs("--choose", filter(None, options.choose.split(",")), "TASK=ACTION")
    asked |= {name: (action, "--choose") for name, action in chosen.items()}
    for name, (action, option) in asked.items():
        primitive = task.primitive_tasks.get(name)
        if primitive is None or action not in primitive.alternatives:
            known = ", ".join(primitive.alternatives if primitive else task.primitive_tasks)
            raise CommandError(
                2, f"{option}: {name}={action} is not known to {task.name}; choose among {known}"
            )
        choices[name] = {action: 1.0}
    return Request(options.runs, choices, options.seed, options.replicates)


def _compare(registered: Path, folder: Path, options: argparse.Namespace) -> int:
    from petrobot.coordinator.studies.forecast.tables import agreement_markdown, agreement_text

    found = compared(registered, folder)
    if options.markdown is not None:
        make_folder(options.markdown.parent)
        write_whole(options.markdown, agreement_markdown(found))
    if options.json:
        write_json(options.json, found)
    if options.json != "-":
        print(agreement_text(found))
    return 0 if found["agrees"] else 1


def fitting(registered: Path, forecast: dict[str, Any], plan: CampaignPlan) -> Task:
    """Return the task of a campaign that may be compared with a registered forecast. Raises
    CommandError."""
    task = load_task(plan.task)
    if task.name != forecast["task"]:
        raise CommandError(
            2, f"{registered} forecasts {forecast['task']}, the campaign runs {task.name}"
        )
    training = forecast["estimates"]
    if training.get("seed") == plan.seed and training.get("block") == plan.block:
        raise CommandError(
            2,
            f"{registered} was trained on these trials (seed {plan.seed}): run the campaign "
            "with another --seed",
        )
    for regime, counts in _planned(plan, task).items():
        _refuse_other_choices(registered, forecast, regime, counts)
    return task


def _planned(plan: CampaignPlan, task: Task) -> dict[str, dict[str, dict[str, float]]]:
    """Return by regime how a campaign that learns nothing will choose; empty if its location file
    is not here."""
    from petrobot.coordinator.studies.campaign.policies import learns, policy_of

    if learns(plan.selector) or not Path(plan.services).is_file():
        return {}
    policy = policy_of(plan, task, load_directory(Path(plan.services)))
    out: dict[str, dict[str, dict[str, float]]] = {}
    for block in plan.blocks:
        for weights in policy.weights(block):
            for name, shares in weights.items():
                counts = out.setdefault(block.regime, {}).setdefault(name, {})
                for action, p in shares.items():
                    counts[action] = counts.get(action, 0.0) + p
    return {
        r: {name: _certain(counts) for name, counts in chosen.items()} for r, chosen in out.items()
    }


def _certain(counts: Mapping[str, float]) -> dict[str, float]:
    """Return the shares of a plan with the weight of a thousand runs: they are known exactly,
    however few runs it has."""
    whole = sum(counts.values())
    return {action: 1000.0 * n / whole for action, n in counts.items()}


def _refuse_other_choices(
    registered: Path,
    forecast: Mapping[str, Any],
    regime: str,
    counts: Mapping[str, Mapping[str, float]],
) -> None:
    """Check that the runs of each regime choose as their forecast says. Raises CommandError."""
    from petrobot.coordinator.studies.forecast.choices import in_words, misfit, remedy

    said = forecast["regimes"].get(regime)
    names = [] if said is None else misfit(said, counts)
    if said is not None and names:
        raise CommandError(
            2,
            f"{registered} is of other choices, regime {regime or '-'}: it forecasts "
            f"{in_words(said['choices'], names)}; the "
            f"campaign chooses {in_words(counts, names)}: {remedy(said['choices'], names)}, "
            "or forecast what it chooses "
            "(petrobot forecast --choose)",
        )


def compared(registered: Path, folder: Path) -> dict[str, Any]:
    """Compare a registered forecast with what a campaign measured. Raises CommandError if they do
    not belong together."""
    from petrobot.coordinator.studies.campaign.plan import read_manifest
    from petrobot.coordinator.studies.campaign.table import TABLE, began, read_table
    from petrobot.coordinator.studies.forecast.agreement import agreement
    from petrobot.coordinator.studies.forecast.choices import choice_counts
    from petrobot.coordinator.studies.forecast.history import by_regime
    from petrobot.coordinator.studies.forecast.registered import read

    forecast, plan = read(registered), read_manifest(folder)
    task = fitting(registered, forecast, plan)
    expected = forecast.get("physics", "")
    if not same_physics(expected, plan.physics):
        raise CommandError(
            2,
            f"{registered}: forecast for the physics {expected or FIRST_PHYSICS!r}, but {folder} "
            f"ran with {plan.physics or FIRST_PHYSICS!r}; compare it with a campaign of the same "
            "physics ([nodes.NAME] physics in services.toml)",
        )
    measured = by_regime(task, read_table(folder / TABLE))
    for regime, training in measured.items():
        _refuse_other_choices(registered, forecast, regime, choice_counts(training))
    try:
        found = agreement(forecast, measured)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    first = began(folder)
    return {
        "task": task.name,
        "forecast": {
            "file": registered.name,
            "sha256": forecast["sha256"],
            "registered_at": forecast["registered_at"],
        },
        "campaign": {"folder": folder.name, "seed": plan.seed, "began_at": first},
        "registered_before": first is not None and forecast["registered_at"] <= first,
        "same_block": forecast["estimates"].get("block") in (None, plan.block),
        "doubts": {
            name: said["doubts"] for name, said in forecast["regimes"].items() if said.get("doubts")
        },
        "what_if": {
            name: said["what_if"] for name, said in forecast["regimes"].items() if "what_if" in said
        },
        "same_task_file": forecast.get("task_sha256") in (None, plan.digests["task"]),
        **found,
    }
