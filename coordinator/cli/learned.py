"""Show what was learned, of actions or of a whole task; merge estimates files; freeze, thaw or
reset a primitive task."""

from __future__ import annotations

import argparse
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.learned_show import (
    asked_question,
    measured_task,
    print_table,
    refuse_unknown_context,
    refuse_unknown_cost,
    show,
    task_line,
)
from petrobot.coordinator.cli.loading import (
    add_json_argument,
    estimates_path,
    load_task,
    write_json,
)
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.services.host.command_line import number, probability

# `learned task`: R, C and J of primitive tasks and of a whole task, from an estimates file through
# the task's net.

if TYPE_CHECKING:
    from petrobot.coordinator.learning.estimates_file import FileContents
    from petrobot.coordinator.learning.propagation import Uncertain


def show_task(kept: FileContents, options: argparse.Namespace) -> int:
    """Print R, C and J of the whole task, computed from the estimates of its actions."""
    if len(options.more) != 1:
        raise CommandError(2, "which task? Write `petrobot learned task FILE TASK`")
    if options.budget is not None:
        raise CommandError(2, "--budget is for `learned show`; a task has one cost")
    found = figures(kept, options.more[0], options)
    if options.json:
        write_json(options.json, found)
    if options.json != "-":
        _print(found)
    return 0


def figures(kept: FileContents, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures as plain data: of the primitive tasks, and of the task for one token in
    its runs place."""
    from petrobot.coordinator.analysis.time.measured import NoEstimate
    from petrobot.coordinator.cli.analyse import bounded
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.learning.objective import common_weight
    from petrobot.coordinator.learning.propagation import propagate

    task, _ = with_runs(load_task(name), 1)
    context = options.context
    known = {name: kept.estimates.of(name, context) for name in task.primitive_tasks}
    refuse_unknown_cost({name: of for name, of in known.items() if of}, options)
    asked = {name: asked_question(kept, name, options) for name in known}
    rho = common_weight(asked.values())
    try:
        with bounded(name):
            found = propagate(task, kept.estimates, context, questions=asked, rho=rho)
    except (NoEstimate, ValueError) as fault:
        raise CommandError(2, f"{task.name}: {fault}") from fault
    parts = [
        {
            "primitive_task": p.primitive_task,
            "runs": p.runs,
            "measure": p.measure,
            "R": _known(p.reliability.value),
            "R_interval": _interval(p.reliability),
            "C": _known(p.cost.value),
            "C_interval": _interval(p.cost),
            "J": _known(p.j),
            "J_interval": list(p.j_bounds) if all(map(isfinite, p.j_bounds)) else None,
            "declared_costs": dict(task.primitive_tasks[p.primitive_task].costs)
            if p.measure == task.primitive_tasks[p.primitive_task].cost
            else {},
        }
        for p in found.parts.values()
    ]
    return {
        "task": task.name,
        "source": kept.plant,
        "context": context,
        "primitive_tasks": parts,
        "scenario": found.scenario,
        "R_conj": found.conjunctive,
        "R_conj_interval": _interval(found.reliability),
        "R_goal": found.goal,
        "P_complete": found.complete,
        "product": found.product,
        "cost": _known(found.cost.value),
        "cost_interval": _interval(found.cost),
        "uncosted": list(found.uncosted),
        "rho": found.rho,
        "J": _known(found.j.value),
        "J_interval": _interval(found.j),
        "mean_time": _known(found.forecast.done.mean),
        "measured": measured_task(kept, task.name, options),
        "assumptions": list(found.forecast.view.assumptions),
    }


def _interval(number: Uncertain) -> list[float] | None:
    bounds = [number.lower, number.upper]
    return bounds if all(map(isfinite, bounds)) else None


def _known(x: float) -> float | None:
    return x if isfinite(x) else None


def _print(found: dict[str, Any]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(
        title=found["task"], title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    table.show_edge = table.pad_edge = False
    declared = any(part["declared_costs"] for part in found["primitive_tasks"])
    for column in ("primitive task", "runs", "R", "C", *(["C declared"] if declared else []), "J"):
        table.add_column(
            column, justify="left" if column == "primitive task" else "right", no_wrap=True
        )
    for part in found["primitive_tasks"]:
        table.add_row(
            part["primitive_task"],
            _cell(part["runs"]),
            _cell(part["R"], part["R_interval"]),
            _cell(part["C"], part["C_interval"]),
            *([_declared(part["declared_costs"])] if declared else []),
            _cell(part["J"], part["J_interval"]),
        )
    print_table(console, table)
    for key, words in (
        ("R_conj", "every run a success"),
        ("product", "product of the primitive tasks' R (R_conj, if they run in series)"),
        ("R_goal", "met goals for each run"),
        ("P_complete", "reaches its final marking"),
        ("cost", "expected cost of one run of the task" + _why_no_cost(found)),
        ("J", f"1 - R_conj + rho C, with rho {found['rho']:.4g}"),
        ("mean_time", "s, mean time of one run of the task"),
    ):
        number = _cell(found[key], found.get(f"{key}_interval"))
        console.print(f"  {key:10} {number:>8}  {words}", highlight=False)
    if found["measured"] is not None:
        console.print(f"  measured: {task_line(found['measured'])}", highlight=False)
    if found["scenario"] is not None and found["context"] is None:
        console.print(
            f"  The task is judged in the scenario that is hardest for it: {found['scenario']}.",
            highlight=False,
        )
    if found["source"]:
        console.print(f"  From {found['source']} runs.", highlight=False)
    for assumption in found["assumptions"]:
        console.print(f"  assumed: {assumption}", highlight=False, style="dim")


def _declared(costs: dict[str, float]) -> str:
    return ", ".join(f"{action} {cost:.4g}" for action, cost in costs.items()) or "-"


def _why_no_cost(found: dict[str, Any]) -> str:
    measures = {p["measure"] for p in found["primitive_tasks"]}
    if found["cost"] is None and len(measures) > 1:
        return f"; {', '.join(sorted(measures))} do not add: give --cost"
    lack = ", ".join(found["uncosted"])
    part = "" if found["cost"] is None else "left out of its interval and of that of J, "
    return f"; {part}not known: the cost of {lack}" if lack else ""


def _cell(value: float | None, interval: list[float] | None = None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" + (f" [{interval[0]:.4g}, {interval[1]:.4g}]" if interval else "")


if TYPE_CHECKING:
    from petrobot.coordinator.learning.estimates_file import EstimatesFile, FileContents

EXAMPLE = (
    "petrobot learned show learned.db --target 0.95\n  petrobot learned merge "
    "learned.db other_machine.db"
)
_FILES = {"verb", "file", "more"}
_SHOWN = {*_FILES, "context", "plant", "cost", "target", "budget", "rho", "json"}
HEEDED: dict[str, set[str]] = {
    "show": _SHOWN,
    "task": _SHOWN,
    "merge": _FILES,
    "freeze": _FILES,
    "thaw": _FILES,
    "reset": {*_FILES, "plant", "selectors"},
}
"""The options that each verb uses."""
VERBS = tuple(HEEDED)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("verb", choices=VERBS, help="what to do with the file")
    parser.add_argument("file", type=Path, help="an estimates file, as `run --learn FILE` keeps it")
    parser.add_argument(
        "more",
        nargs="*",
        metavar="FILE|TASK",
        help="merge: files to merge into it; else: primitive tasks (all)",
    )
    parser.add_argument(
        "--context",
        metavar="TEXT",
        help="show, task: only this context (default: all; show takes them as scenarios)",
    )
    parser.add_argument(
        "--plant",
        metavar="NAME",
        help="show, task, reset: runs of this plant: real, simulated, dry-run or mock (default: "
        "the first of these that the file has, of which none is pooled with another; reset: all)",
    )
    parser.add_argument(
        "--cost",
        metavar="MEASURE",
        help="wall, cpu, count or value:NAME (default: the one that they were judged by when "
        "they were run)",
    )
    parser.add_argument(
        "--target",
        type=probability,
        metavar="R",
        help="target reliability: which scenarios and actions meet it (default: the one they "
        "were judged by)",
    )
    parser.add_argument(
        "--budget",
        type=number(above=0.0),
        metavar="C",
        help="find the most reliable actions that cost at most this",
    )
    parser.add_argument(
        "--rho",
        type=number(least=0.0),
        metavar="W",
        help="weight of cost in J (default: 1 / the largest cost)",
    )
    parser.add_argument(
        "--selectors",
        action="store_true",
        help="reset: forget selectors' states, keep the estimates",
    )
    add_json_argument(parser, "what is shown")


def run(options: argparse.Namespace) -> int:
    """Do what was asked for, and return the exit code."""
    from petrobot.coordinator.learning.estimates_file import EstimatesFile, said

    why = f"learned {options.verb} makes no use of it; leave it out"
    refuse_idle(options, why, heeded=HEEDED[options.verb])
    file = EstimatesFile(options.file)
    if options.verb == "merge":
        return _merge(file, options)
    file = EstimatesFile(estimates_path(options.file))
    kept = file.read(options.plant)
    if options.plant is not None and options.plant not in kept.plants:
        known = ", ".join(sorted(map(said, kept.plants))) or "none"
        raise CommandError(2, f"{options.file}: --plant {options.plant}: expected one of: {known}")
    if options.verb == "task":
        refuse_unknown_context(kept, _tasks(kept), options)
        return show_task(kept, options)
    _refuse_unknown(kept, options)
    if options.verb == "show":
        return show(kept, options.more or _tasks(kept), options)
    if options.verb == "reset":
        for task in options.more or [None]:
            file.reset(task, selectors_only=options.selectors, plant=options.plant)
    else:
        _freeze(file, kept, options)
    print(f"{options.file}: {options.verb} {', '.join(options.more) or 'everything'}: done")
    return 0


def _merge(file: EstimatesFile, options: argparse.Namespace) -> int:
    if not options.more:
        raise CommandError(
            2, f"merge into {options.file} what? Give one or more other estimates files"
        )
    for other in options.more:
        file.merge(Path(other))
    kept = file.read()
    runs = sum(t.runs + t.censored for e in kept.plants.values() for t in e.tallies.values())
    print(f"{options.file}: {len(options.more)} merged; {runs} runs in all")
    return 0


def _tasks(kept: FileContents) -> list[str]:
    return sorted(
        {k.primitive_task for found in kept.plants.values() for k in found.tallies}
        | {task for task, _ in kept.selectors}
    )


def _refuse_unknown(kept: FileContents, options: argparse.Namespace) -> None:
    for task in options.more:
        if task not in _tasks(kept):
            raise CommandError(
                2,
                f"{options.file} has no primitive task {task!r}; it has: "
                f"{', '.join(_tasks(kept)) or 'none'}",
            )


def _freeze(file: EstimatesFile, kept: FileContents, options: argparse.Namespace) -> None:
    for (task, name), state in kept.selectors.items():
        if not options.more or task in options.more:
            file.put_selectors({(task, name): {**state, "frozen": options.verb == "freeze"}})
