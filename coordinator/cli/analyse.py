"""Verify a net and forecast it: a task, or a net of another tool (PNML, PIPE, GreatSPN, TINA)."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import task_path, write_json
from petrobot.services.host.command_line import number, whole

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.commands import CommandResult
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.analysis.report import Analysis

EXAMPLE = "petrobot analyse catch_ball --view gspn --what-if locate_ball.error.share=0.01"
TOLD_EVERY, TOLD_AFTER = 0.5, 2.0
"""Seconds between lines of progress, and before the first."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "file", help="a net or task file, or the name of a task that comes with petrobot"
    )
    parser.add_argument(
        "--view",
        choices=("ordinary", "gspn"),
        help="default: gspn for a net with rates, ordinary for all else",
    )
    parser.add_argument(
        "--rates",
        metavar="FILE",
        help="rates of transitions (TOML: `[rates]` and `ID = PER_SECOND` below it), or the "
        "word unit for 1/s each",
    )
    parser.add_argument(
        "--states",
        type=whole(),
        default=5_000_000,
        metavar="N",
        help="most markings (default: %(default)s)",
    )
    parser.add_argument(
        "--seconds",
        type=number(least=0.0),
        default=60.0,
        metavar="S",
        help="longest search of a state space, 0 for no limit; what was found by then is "
        "told (default: %(default)g)",
    )
    parser.add_argument(
        "--memory",
        type=whole(),
        default=2048,
        metavar="MIB",
        help="most memory (default: %(default)s)",
    )
    parser.add_argument(
        *("--what-if", "-w"),
        action="append",
        default=[],
        metavar="CHANGE",
        help="judge a change beside the file as it is: runs=10, "
        "locate_ball.error.share=0.05, serve.rate=2 (may be repeated)",
    )
    parser.add_argument(
        "--pictures",
        metavar="FOLDER",
        help="draw each refused verdict with the firings that lead there",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write the answer as JSON (- for standard output)"
    )


def run(options: argparse.Namespace) -> int:
    """Analyse."""
    from petrobot.coordinator.analysis.commands import analyse_command
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.task.file import load

    longest = options.seconds or None
    limits = SearchLimits(
        states=options.states, seconds=longest, memory=options.memory << 20, clock=time.monotonic
    )
    path = task_path(options.file)
    with progress_of_search(limits) as watched:
        outcome = analyse_command(
            path,
            load,
            view=options.view,
            rates=options.rates,
            limits=watched,
            changes=options.what_if,
        )
    code = give(outcome, options.json)
    if options.pictures and outcome.analysis is not None:
        _draw(outcome.analysis, path, Path(options.pictures), quiet=options.json == "-")
    return code


def _draw(analysis: Analysis, path: Path, folder: Path, *, quiet: bool) -> None:
    from petrobot.coordinator.cli.witnesses import draw_witnesses
    from petrobot.coordinator.task.file import load

    made = draw_witnesses(analysis, load(path) if path.suffix == ".toml" else analysis.net, folder)
    if not quiet:
        print(
            "\n".join(f"drawn: {picture}" for picture in made)
            or "no picture: nothing was refused with a witness"
        )


@contextmanager
def progress_of_search(limits: SearchLimits) -> Iterator[SearchLimits]:
    """The same limits with a line on the terminal that tells how far a long search is; nothing
    elsewhere."""
    from petrobot.coordinator.analysis.commands import limited

    if not sys.stderr.isatty():
        yield limits
        return
    begun, told = time.monotonic(), [0.0]

    def tell(found: int, expanded: int) -> None:
        now = time.monotonic()
        if now - told[0] >= TOLD_EVERY and now - begun >= TOLD_AFTER:
            told[0] = now
            print(
                f"\r{found} markings found, {expanded} looked at, {now - begun:.0f} s "
                "(Ctrl-C: what is known by now)",
                end="",
                file=sys.stderr,
            )

    yield limited(limits, tell)
    if told[0]:
        print(file=sys.stderr)


def give(outcome: CommandResult, json_file: str | None) -> int:
    """Print and write what an analysis command found; gives its exit code. Raises CommandError for
    bad input."""
    from petrobot.coordinator.analysis.commands import BAD_INPUT

    if json_file:
        write_json(json_file, outcome.data)
    if outcome.code == BAD_INPUT:
        raise CommandError(BAD_INPUT, outcome.text)
    if json_file != "-":
        print(outcome.text)
    return outcome.code
