"""Draw a task as SVG: places, transitions, tokens and events; error branches are hidden unless asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from coordinator.cli import CommandError
from coordinator.cli.loading import load_task, task_path

EXAMPLE = "petrobot show catch_ball --errors --out catch_ball.svg"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("task", help="a task file, or the name of a task that comes with petrobot")
    parser.add_argument("--errors", action="store_true", help="draw the error branches too")
    parser.add_argument("--graph", action="store_true", help="draw the reachability graph instead (of any net file)")
    parser.add_argument("--out", metavar="FILE", default="-", help="where to write the SVG (default: standard output)")


def run(options: argparse.Namespace) -> int:
    """Draw."""
    from coordinator.drawing import draw

    svg = _graph(options.task) if options.graph else draw(load_task(options.task), error_branches=options.errors)
    if options.out == "-":
        print(svg)
        return 0
    try:
        Path(options.out).write_text(svg, encoding="utf-8")
    except OSError as fault:
        raise CommandError(2, f"{options.out}: {fault.strerror or fault}") from fault
    return 0


def _graph(name: str) -> str:
    from coordinator.analysis.commands import graph_command
    from coordinator.taskfile import load

    outcome = graph_command(task_path(name), load)
    if outcome.code:
        raise CommandError(outcome.code, outcome.text)
    return str(outcome.data["svg"])
