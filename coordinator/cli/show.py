"""Draw a task as SVG: places, transitions, tokens and events; error branches are hidden unless
asked for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import load_task, task_path
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.drawing import Overlay
    from petrobot.coordinator.task import Task

EXAMPLE = "petrobot show catch_ball --errors --out catch_ball.svg"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("task", help="a task file, or the name of a task that comes with petrobot")
    parser.add_argument("--errors", action="store_true", help="draw the error branches too")
    parser.add_argument(
        "--inside", metavar="MACRO", default="", help="draw what is inside a macro place"
    )
    parser.add_argument(
        "--graph", action="store_true", help="draw the reachability graph instead (of any net file)"
    )
    parser.add_argument(
        "--heat",
        action="store_true",
        help="colour the action places by their share of the mean time",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        default="-",
        help="where to write the SVG (default: standard output)",
    )


def run(options: argparse.Namespace) -> int:
    """Draw."""
    svg = _graph(options.task) if options.graph else _net(options)
    if options.out == "-":
        print(svg)
        return 0
    try:
        write_whole(Path(options.out), svg)
    except OSError as fault:
        text = f"{options.out}: {fault.strerror or fault}; give --out a file that can be written"
        raise CommandError(2, text) from fault
    return 0


def _net(options: argparse.Namespace) -> str:
    from petrobot.coordinator.drawing import draw

    task = load_task(options.task)
    overlay = _heat(task) if options.heat else None
    try:
        return draw(task, error_branches=options.errors, overlay=overlay, inside=options.inside)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault


def _heat(task: Task) -> Overlay:
    """The forecast's bottleneck: how much of the mean time each action place takes. Raises
    CommandError."""
    from petrobot.coordinator.analysis.report import analyse, heat
    from petrobot.coordinator.drawing import Overlay

    analysis = analyse(task, view="gspn")
    shares = heat(analysis)
    if not shares:
        raise CommandError(
            2, f"{task.name}: no heat without a forecast: {'; '.join(analysis.notes)}"
        )
    most = max(shares, key=lambda place: shares[place])
    told = (
        f"Warm: share of the mean time by the forecast; the bottleneck is {most} with "
        f"{100 * shares[most]:.0f} %."
    )
    return Overlay(heat=shares, legend=told)


def _graph(name: str) -> str:
    from petrobot.coordinator.analysis.commands import graph_command
    from petrobot.coordinator.task.file import load

    outcome = graph_command(task_path(name), load)
    if outcome.code:
        raise CommandError(outcome.code, outcome.text)
    return str(outcome.data["svg"])
