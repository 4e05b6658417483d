"""`learned task`: R, C and J of primitive tasks and of a whole task, from an estimates file through
the task's net."""

from __future__ import annotations

import argparse
from math import isfinite
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import load_task, write_json

if TYPE_CHECKING:
    from petrobot.coordinator.experience.estimates_file import Kept


def show_task(kept: Kept, options: argparse.Namespace) -> int:
    """Print what the actions' estimates come to, for one run of the task."""
    if len(options.more) != 1:
        raise CommandError(2, "which task? Write `petrobot learned task FILE TASK`")
    found = figures(kept, options.more[0], options.context)
    if options.json:
        write_json(options.json, found)
    if options.json != "-":
        _print(found)
    return 0


def figures(kept: Kept, name: str, context: str | None) -> dict[str, Any]:
    """Plain data: the parts, and the whole for one token in the runs place."""
    from petrobot.coordinator.analysis.stochastic import NoEstimate
    from petrobot.coordinator.experience.propagation import propagate
    from petrobot.coordinator.launch import with_runs

    task, _ = with_runs(load_task(name), 1)
    try:
        found = propagate(task, kept.estimates, context)
    except (NoEstimate, ValueError) as fault:
        raise CommandError(2, f"{task.name}: {fault}") from fault
    units = {p.cost for p in task.primitive_tasks.values() if p.name in found.parts}
    parts = [
        {
            "primitive_task": p.primitive_task,
            "runs": p.runs,
            "R": p.reliability,
            "C": _known(p.cost),
            "J": _known(p.j),
        }
        for p in found.parts.values()
    ]
    return {
        "task": task.name,
        "context": context,
        "primitive_tasks": parts,
        "R_conj": found.conjunctive,
        "R_goal": found.goal,
        "P_complete": found.complete,
        "product": found.product,
        "cost": _known(found.cost) if len(units) == 1 else None,
        "mean_time": _known(found.forecast.done.mean),
        "assumptions": list(found.forecast.view.assumptions),
    }


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
    for column in ("primitive task", "runs", "R", "C", "J"):
        table.add_column(
            column, justify="left" if column == "primitive task" else "right", no_wrap=True
        )
    for part in found["primitive_tasks"]:
        table.add_row(part["primitive_task"], *(_cell(part[k]) for k in ("runs", "R", "C", "J")))
    console.print(table)
    for key, words in (
        ("R_conj", "every run a success"),
        ("product", "product of the primitive tasks' R (R_conj of a mere series)"),
        ("R_goal", "met goals for each run"),
        ("P_complete", "reaches its final marking"),
        ("cost", "expected cost of one run of the task"),
        ("mean_time", "s, mean time of one run of the task"),
    ):
        console.print(f"  {key:10} {_cell(found[key]):>8}  {words}", highlight=False)
    for assumption in found["assumptions"]:
        console.print(f"  assumed: {assumption}", highlight=False, style="dim")


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
