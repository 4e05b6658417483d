"""Run a task many times in parallel lock-step cells, learn if asked to, and leave one table with a
row for each run."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    add_json_argument,
    add_mock_argument,
    add_seed_argument,
    add_services_argument,
    add_task_argument,
    cell_path,
    load_directory,
    load_task,
    refuse_arguments,
    refuse_misplaced,
    refuse_script,
    task_path,
    write_json,
)
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.services.comm.location_file import physics_of
from petrobot.services.host.command_line import MOST_RUNS, number, probability, whole

if TYPE_CHECKING:
    from petrobot.coordinator.studies.campaign.conduct import Campaign
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan
    from petrobot.coordinator.task import Task

HEEDED = {"resume", "workers", "cluster", "check", "json", "quiet"}
"""Options that `--resume` heeds."""
BATCH = 20
"""Runs between two updates of what is learned, if none are given."""
EXAMPLE = (
    "petrobot campaign catch_ball --runs 200 --regime A,B --selector nikolic_fu "
    "--workers 2 --json out.json"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    _add_trials(parser)
    _add_choices(parser)
    _add_execution(parser)
    _add_output(parser)
    add_services_argument(parser)


def _add_trials(parser: argparse.ArgumentParser) -> None:
    add_task_argument(parser, optional=True)
    parser.add_argument(
        "--runs",
        type=whole(most=MOST_RUNS),
        default=100,
        metavar="N",
        help="number of runs in all regimes together (%(default)s)",
    )
    parser.add_argument(
        "--regime",
        metavar="A,B",
        help="regimes that alternate, with the same seeds in each; C@1-5: regime C in the "
        "simulated installations 1 to 5",
    )


def _add_choices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--selector",
        default="fixed",
        metavar="NAME",
        help="fixed, round_robin, random, or one that learns",
    )
    parser.add_argument(
        "--choose", default="", metavar="TASK=ACTION,...", help="actions chosen by hand"
    )
    parser.add_argument(
        "--learned",
        metavar="CAMPAIGN",
        type=Path,
        help="the best actions that this campaign has learned",
    )
    parser.add_argument(
        "--target",
        type=probability,
        metavar="R",
        help="learn and judge by this reliability, not the declared one",
    )
    parser.add_argument(
        "--credit",
        choices=("action", "task"),
        help="what judges a choice: how its own run ended (default), or whether the goal was met",
    )
    parser.add_argument(
        "--rho",
        type=number(least=0.0),
        metavar="X",
        help="weight of cost in J (1 / largest mean cost)",
    )


def _add_execution(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--workers",
        type=whole(most=1024),
        default=os.cpu_count() or 1,
        metavar="K",
        help="processes (%(default)s)",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="workers of this dask scheduler instead, as tcp://host:8786",
    )
    add_seed_argument(parser)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the task"
    )
    parser.add_argument(
        "--block",
        type=whole(),
        metavar="N",
        help="runs in one cell (as many as the task's runs place holds)",
    )
    parser.add_argument(
        "--batch",
        type=whole(),
        metavar="N",
        help=f"runs between two updates of what is learned ({BATCH})",
    )
    add_mock_argument(parser)
    parser.add_argument(
        "--out",
        metavar="FOLDER",
        type=Path,
        help="where table and estimates go (campaigns/TASK-SELECTOR-S-ID)",
    )


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--resume",
        metavar="FOLDER",
        type=Path,
        help="continue this campaign; the same as giving its --out again",
    )
    parser.add_argument(
        "--check",
        metavar="FORECAST",
        type=Path,
        help="compare the result with a registered forecast",
    )
    add_json_argument(parser, "the result")
    parser.add_argument("--quiet", action="store_true", help="no progress in the terminal")


def run(options: argparse.Namespace) -> int:
    """Run or resume the campaign; print and write its result. Return the exit code."""
    from petrobot.coordinator.cli.forecast import compared, fitting
    from petrobot.coordinator.studies.campaign.conduct import Campaign, ProgressLine
    from petrobot.coordinator.studies.campaign.plan import identity, read_manifest
    from petrobot.coordinator.studies.campaign.table import held, write_parquet
    from petrobot.coordinator.studies.forecast.registered import read

    shown = ProgressLine(sys.stderr)
    shown.wanted = shown.wanted and not options.quiet
    if options.resume is not None:
        why = "a campaign is continued as it began; leave this out beside --resume, or begin"
        refuse_idle(options, f"{why} another one with --out", heeded=HEEDED)
        folder, plan = options.resume, read_manifest(options.resume)
    elif options.task is None:
        raise CommandError(2, "give a TASK, or --resume FOLDER")
    else:
        if options.cluster:
            why = "the workers are those of --cluster; leave this out"
            refuse_idle(options, why, idle={"workers"})
        task = load_task(options.task)
        options.services = cell_path(options.services, options.task, task)
        _refuse_unfit(task, options)
        plan = _plan(options, task)
        folder = (
            options.out
            or Path("campaigns") / f"{task.name}-{plan.selector}-{plan.seed}-{identity(plan)[:6]}"
        )
    if options.check is not None:
        # Before the work, not after it
        fitting(options.check, read(options.check), plan)
    campaign = Campaign(folder, plan, shown)
    with _written(folder), held(folder):
        if campaign.complete and options.json != "-":
            print(
                f"nothing left to do: {folder} holds all runs; remove it, or give "
                "another --out, to run them again"
            )
        try:
            asyncio.run(_conduct(campaign, options))
        finally:
            shown.close()
        result = campaign.result()
        write_parquet(folder)
    check = None if options.check is None else compared(options.check, folder)
    write_json(str(folder / "result.json"), result, "--out a folder")
    if options.json:
        write_json(options.json, result if check is None else {**result, "check": check})
    if options.json != "-":
        print(text_of(result))
        _print_check(check)
    return 0 if check is None or check["agrees"] else 1


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    """Turn an OSError, such as a full disk, into CommandError. The folder then contains whole
    blocks only, so the campaign can be resumed."""
    try:
        yield
    except OSError as fault:
        text = (
            f"{fault.filename or folder}: {fault.strerror or fault}; put it back or free some "
            f"space, and resume with --resume {folder}"
        )
        raise CommandError(2, text) from fault


def _print_check(check: dict[str, Any] | None) -> None:
    if check is not None:
        from petrobot.coordinator.studies.forecast.tables import agreement_text

        print(agreement_text(check))


def _refuse_unfit(task: Task, options: argparse.Namespace) -> None:
    from petrobot.coordinator.analysis.may_run import may_run

    directory = load_directory(options.services)
    refusal = may_run(task, cell_of(directory)).refusal(str(directory.source))
    if refusal:
        raise CommandError(2, refusal)
    refuse_script(options.mock, directory, task)
    if not options.cluster:
        scripted = options.mock is not None
        refuse_misplaced(directory, everywhere=True, scripted=scripted)
        refuse_arguments(task, options.task, directory, everywhere=True, scripted=scripted)


async def _conduct(campaign: Campaign, options: argparse.Namespace) -> None:
    from petrobot.coordinator.studies.campaign.pool import ClusterPool, LocalPool

    if options.cluster:
        async with ClusterPool(campaign.plan, options.cluster) as cluster:
            await campaign.run(cluster)
    else:
        async with LocalPool(
            campaign.plan, options.workers, campaign.folder / "workers.log"
        ) as pool:
            await campaign.run(pool)


def _plan(options: argparse.Namespace, task: Task) -> CampaignPlan:
    from petrobot.coordinator.cli.options import pairs, parameter_of, parameter_texts
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest, regimes_of
    from petrobot.coordinator.studies.campaign.policies import learns

    given = parameter_texts(options)
    asked = given.pop("regime", "")
    regimes = regimes_of(asked) or (str(task.parameters.get("regime", "")),)
    if regimes != ("",) and "regime" not in task.parameters:
        raise CommandError(2, f"--regime {asked}: {task.name} has no parameter regime")
    if len(set(regimes)) < len(regimes):
        raise CommandError(2, f"--regime {asked}: name each regime once")
    chosen = pairs("--choose", filter(None, options.choose.split(",")), "TASK=ACTION")
    paths = {"task": str(task_path(options.task)), "services": str(options.services)}
    paths |= {"mock": str(options.mock)} if options.mock else {}
    physics = _physics(options.services)
    return CampaignPlan(
        **{key: str(Path(path).resolve()) for key, path in paths.items()},
        runs=options.runs,
        regimes=regimes,
        seed=options.seed,
        selector=options.selector,
        chosen=chosen,
        parameters={name: parameter_of(task, name, text) for name, text in given.items()},
        block=_block(task, options.block),
        batch=(options.batch or BATCH) if learns(options.selector) else 0,
        options=_selector_options(options, task, regimes, physics),
        digests={key: digest(path) for key, path in paths.items()},
        physics=physics,
    )


def _physics(services: Path) -> str:
    """Return the physics of the simulated laboratory, so that all workers use the same. Raises
    CommandError."""
    try:
        return physics_of(load_directory(services))
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault


def _block(task: Task, wanted: int | None) -> int:
    if not task.runs_place:
        return 1
    place = task.places.get(task.runs_place)
    tokens = 1 if place is None else place.tokens
    most = None if place is None else place.capacity
    if wanted is not None and most is not None and wanted > most:
        text = f"--block {wanted}: {task.runs_place!r} holds at most {most}, its capacity"
        raise CommandError(2, f"{text}; give a smaller block")
    return wanted or max(1, tokens)


def _selector_options(
    options: argparse.Namespace, task: Task, regimes: Sequence[str], physics: str
) -> dict[str, Any]:
    from petrobot.coordinator.studies.campaign.policies import learned_choices, learns

    for name in () if learns(options.selector) else ("credit", "batch"):
        if (value := getattr(options, name)) is not None:
            raise CommandError(
                2,
                f"--{name} {value}: --selector {options.selector} does not learn; give one that "
                f"does, such as nikolic_fu_fast, or leave --{name} out",
            )
    found: dict[str, Any] = {
        name: value
        for name in ("target", "rho", "credit")
        if (value := getattr(options, name)) is not None
    }
    if options.learned is not None:
        if options.selector != "fixed":
            raise CommandError(
                2, f"--learned chooses what was learned; leave --selector {options.selector} out"
            )
        found["by_regime"] = learned = learned_choices(
            options.learned, task.name, mock=bool(options.mock), physics=physics
        )
        if unknown := [regime or "-" for regime in regimes if regime not in learned]:
            raise CommandError(
                2,
                f"--learned {options.learned}: nothing was learned of regime {unknown[0]}; there "
                f"are {', '.join(learned)}",
            )
    return found


def _task_line(found: Mapping[str, Any], wide: int) -> list[str]:
    """Describe R_conj, C and J of the whole task in the regime that is hardest for it."""
    shown = [
        f"{name} {found[name]:.4g} [{found[f'{name}_interval'][0]:.4g}, "
        f"{found[f'{name}_interval'][1]:.4g}]"
        for name in ("R_conj", "C", "J")
        if found.get(name) is not None
    ]
    if found.get("R_conj") is not None:
        shown[0] += " (every run a SUCCESS)"
    where = f" in {found['regime']}, where it is hardest" if found.get("regime") else ""
    return [f"  {'the task':{wide}}{'  '.join(shown)}{where}"] if shown else []


def text_of(result: dict[str, Any]) -> str:
    """Return the result as text for the terminal."""
    lines = [
        f"{result['task']}: {result['begun']} runs, selector {result['selector']}, seed "
        f"{result['seed']}" + (f", {result['plant']}" if "plant" in result else "")
    ]
    if missing := result.get("not_begun"):  # absent in older results
        lines.append(f"  {missing} more never began: their mission run was given up before")
    wide = max(16, *(len(name) + 2 for name in (*result["by_regime"], *result["chosen"])))
    for name, part in [*result["by_regime"].items(), ("all", result)]:
        low, high = part["wilson"]
        goal = (
            ""
            if part["R_goal"] is None
            else f"R_goal {part['R_goal']:.4f} [{low:.4f}, {high:.4f}]  "
        )
        times = (
            "" if part["mean"] is None else f"  mean {part['mean']:.3f} s, 90 % {part['q90']:.3f} s"
        )
        if untimed := part.get("untimed"):  # absent in older results
            times += f" (without {untimed} trials that have no time: some token was not back)"
        lines.append(
            f"  {name or '-':{wide}}{goal}P_complete {part['P_complete'] or 0.0:.4f}{times}"
        )
        for table, sums in part.get("counts", {}).items():
            counted = ", ".join(f"{column} {number}" for column, number in sums.items())
            lines.append(f"  {'':{wide}}{table}: {counted}")
    lines += _task_line(result.get("task_figures") or {}, wide)
    for task, actions in result["chosen"].items():
        if [*actions] != [task]:  # else there is nothing to choose, and the names are equal
            shown = ", ".join(
                f"{a} {n}" + _in_brackets(result, task, a) for a, n in actions.items()
            )
            lines.append(f"  {task:{wide}}{shown}")
            lines += [
                f"  {'':{wide}}{remark}" for remark in _remarks(result["judged"].get(task, {}))
            ]
    for seeds in result.get("copies", ()):
        shown = ", ".join(map(str, seeds[:4])) + (", ..." if len(seeds) > 4 else "")
        lines.append(
            f"  warning: the blocks with the seeds {shown} are copies of each other, to the "
            "microsecond, so one observation. Let actions and drivers draw with ctx.random and "
            "ports.random"
        )
    speed = result["times_real_time_per_core"]
    lines.append(
        f"  {result['sim_s']:.1f} s simulated in {result['wall_s']:.1f} s: {speed} x real "
        "time a core"
    )
    lines.append(f"  table: {result['rows']}")
    return "\n".join(lines)


def _in_brackets(result: dict[str, Any], task: str, action: str) -> str:
    """Return J of an action in brackets, or why it has none."""
    j, judged = result["J"].get(task, {}).get(action), result["judged"].get(task, {})
    if j is not None:
        ends = result.get("J_interval", {}).get(task, {}).get(action)
        return f" (J {j:.3f}" + (f" [{ends[0]:.3f}, {ends[1]:.3f}])" if ends else ")")
    if (
        judged
        and judged["target"]
        and judged["meet_target"]
        and action not in judged["meet_target"]
    ):
        return f" (below R {judged['target']:g})"
    return ""


def _remarks(judged: dict[str, Any]) -> list[str]:
    """Return warnings about J of a primitive task: what it does not show."""
    out = []
    if judged and not judged["meet_target"] and judged["target"] is not None:
        out.append(
            f"no action surely reaches R {judged['target']:g} in any regime: J without a target"
        )
    if judged and not judged["regimes"]:
        out.append(
            "there is no regime in which all were run: J of each in its own regimes, not comparable"
        )
    for action in judged.get("uncosted", ()):
        out.append(
            f"{action}: no run reported {judged['cost']}; its cost is taken as 0. Correct "
            "`cost` or the action"
        )
    return out
