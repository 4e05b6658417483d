"""Verify a net and forecast it: a task, or a net of another tool (PNML, PIPE, GreatSPN, TINA)."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from coordinator.cli.loading import task_path, write_json

if TYPE_CHECKING:
    from coordinator.analysis.commands import Outcome

EXAMPLE = "petrobot analyse catch_ball --json analysis.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("file", help="a net or task file, or the name of a task that comes with petrobot")
    parser.add_argument("--view", choices=("ordinary", "gspn"), default="ordinary", help="default: %(default)s")
    parser.add_argument(
        "--rates", metavar="FILE", help="a rates file, or the word unit, for a net without rates of its own"
    )
    parser.add_argument(
        "--states", type=int, default=5_000_000, metavar="N", help="most markings (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=float, metavar="S", help="longest search; what was found until then is told")
    parser.add_argument("--memory", type=int, default=2048, metavar="MIB", help="most memory (default: %(default)s)")
    parser.add_argument("--json", metavar="FILE", help="write the answer as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Analyse."""
    from coordinator.analysis.commands import analyse_command
    from coordinator.analysis.space import Limits
    from coordinator.taskfile import load

    limits = Limits(states=options.states, seconds=options.seconds, memory=options.memory << 20, clock=time.monotonic)
    path = task_path(options.file)
    return give(analyse_command(path, load, view=options.view, rates=options.rates, limits=limits), options.json)


def give(outcome: Outcome, json_file: str | None) -> int:
    """Print and write what an analysis command found; gives its exit code."""
    if json_file:
        write_json(json_file, outcome.data)
    if json_file != "-":
        print(outcome.text)
    return outcome.code
