"""Verify a net and forecast it: a task, or a net of another tool (PNML, PIPE, GreatSPN, TINA)."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from petrobot.coordinator.analysis.limits import OUT_OF_MEMORY, OutOfTime, until
from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    SLOW,
    add_estimates_argument,
    add_json_argument,
    add_services_argument,
    cell_finder,
    measurements,
    task_path,
    write_json,
)
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.services.host.command_line import number, whole
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.commands import CommandResult
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.net import Net

EXAMPLE = "petrobot analyse catch_ball --view gspn --what-if locate_ball.error.share=0.01"
TOLD_EVERY = 0.5
"""Seconds between two lines of progress."""
SECONDS, MEMORY = 60.0, 2 << 30
"""The most seconds and bytes of a command that has no options for them."""
REASON_LETTERS = 150
"""Longest reason that is written below a picture (characters); the rest is cut."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
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
        default=SECONDS,
        metavar="S",
        help="longest time of the analysis, 0 for no limit; what was found by then is "
        "reported, the rest is unknown (default: %(default)g)",
    )
    parser.add_argument(
        "--memory",
        type=whole(),
        default=MEMORY >> 20,
        metavar="MIB",
        help="most memory (default: %(default)s)",
    )
    parser.add_argument(
        *("--what-if", "-w"),
        action="append",
        default=[],
        metavar="CHANGE",
        help="judge a change beside the file as it is: runs=10 (tokens of that place), "
        "locate_ball.error.share=0.05, serve.rate=2 (may be repeated)",
    )
    add_estimates_argument(parser)
    add_services_argument(parser)
    parser.add_argument(
        "--measure",
        action="append",
        default=[],
        metavar="NAME=EXPRESSION",
        help="also report a number of your own: 'p95=time(0.95)', 'late(20)', "
        "'busy=1-marked(arm_free)', 'rate(serve)/rate(arrive)' (may be repeated)",
    )
    parser.add_argument(
        "--pictures",
        metavar="FOLDER",
        help="draw each refused verdict with the firings that lead there",
    )
    add_json_argument(parser, "the answer")


def run(options: argparse.Namespace) -> int:
    """Analyse the net; print and write what was found. Return the exit code."""
    from petrobot.coordinator.analysis.commands import analyse_command
    from petrobot.coordinator.analysis.net.space import SearchLimits

    if options.view == "ordinary":
        why = "the ordinary view has no times; leave it out, or --view"
        refuse_idle(options, why, idle={"rates", "measure"})
    longest = options.seconds or None
    limits = SearchLimits(
        states=options.states, seconds=longest, memory=options.memory << 20, clock=time.monotonic
    )
    path = task_path(options.file)
    with progress_of_search(limits) as watched, bounded_memory(limits.memory or 0):
        outcome = analyse_command(
            path,
            view=options.view,
            rates=options.rates,
            limits=watched,
            changes=options.what_if,
            structure=bool(options.json),
            measure=measurements(options.estimates),
            measures=options.measure,
            cell_of=cell_finder(options.services, options.file),
        )
    code = give(outcome, options.json)
    if options.pictures and outcome.analysis is not None:
        _draw(outcome.analysis, path, Path(options.pictures), quiet=options.json == "-")
    return code


def _draw(analysis: Analysis, path: Path, folder: Path, *, quiet: bool) -> None:
    from petrobot.coordinator.task.file import load

    made = draw_witnesses(analysis, load(path) if path.suffix == ".toml" else analysis.net, folder)
    if not quiet:
        print(
            "\n".join(f"drawn: {picture}" for picture in made)
            or "no picture: nothing was refused with a witness"
        )


@contextmanager
def progress_of_search(limits: SearchLimits) -> Iterator[SearchLimits]:
    """Return the limits with a progress line in the terminal; unchanged where there is no
    terminal."""

    if not sys.stderr.isatty():
        yield limits
        return
    begun, told = time.monotonic(), [0.0]

    def tell(found: int, expanded: int) -> None:
        now = time.monotonic()
        if now - told[0] >= TOLD_EVERY and now - begun >= SLOW:
            told[0] = now
            print(
                f"\r{found} markings found, {expanded} looked at, {now - begun:.0f} s "
                "(Ctrl-C: what is known by now)",
                end="",
                file=sys.stderr,
            )

    yield replace(limits, progress=tell)
    if told[0]:
        print(file=sys.stderr)


LEAST = 64 << 20
"""Bytes that an analysis may always allocate, however much memory the process has already."""


@contextmanager
def bounded_memory(most: int = MEMORY) -> Iterator[None]:
    """Limit this process to this many bytes; beyond them Python raises MemoryError.

    The system counts private writable mappings (RLIMIT_DATA, setrlimit(2)), which is what numpy
    allocates. Mappings that are reserved but not resident are allowed for.
    """
    import resource

    held = {}
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        key, _, rest = line.partition(":")
        if key in ("VmData", "VmRSS"):
            held[key] = int(rest.split()[0]) << 10
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = held["VmData"] + max(most - held["VmRSS"], LEAST)
    limit = min((n for n in (wanted, soft, hard) if n != resource.RLIM_INFINITY), default=wanted)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


@contextmanager
def bounded(file: str) -> Iterator[None]:
    """Limit a command that has no options for it to SECONDS and MEMORY. Raises CommandError if it
    has no answer by then; one with a partial answer stops by itself (`overtime`)."""
    full = CommandError(2, f"{file}: the memory was used up; use a smaller net")
    try:
        with bounded_memory(), until(time.monotonic() + SECONDS, time.monotonic, MEMORY):
            yield
    except OUT_OF_MEMORY as fault:
        raise full from fault
    except OutOfTime as late:
        text = f"{file}: stopped after {SECONDS:g} s: {late}; use a smaller net"
        raise CommandError(1, text) from late


def give(outcome: CommandResult, json_file: str | None) -> int:
    """Print and write what an analysis command found, and return its exit code. Raises CommandError
    for bad input."""
    from petrobot.coordinator.analysis.commands import BAD_INPUT

    if json_file:
        write_json(json_file, outcome.data)
    if outcome.code == BAD_INPUT:
        raise CommandError(BAD_INPUT, outcome.text)
    if json_file != "-":
        print(outcome.text)
    return outcome.code


# --- pictures of refuted verdicts ----------------------------------------------------------------


def draw_witnesses(analysis: Analysis, model: Task | Net, folder: Path) -> list[Path]:
    """Write an SVG for each verdict that is refuted with a witness, and return the paths. Raises
    CommandError."""
    made = []
    try:
        make_folder(folder)
        for name, verdict in refused(analysis):
            assert verdict.witness is not None
            path = folder / f"{analysis.name}-{name}.svg"
            write_whole(path, picture(model, name, verdict.reason, verdict.witness))
            made.append(path)
    except OSError as fault:
        raise CommandError(
            2, f"{fault.filename or folder}: {fault.strerror or fault}; name a folder to write to"
        ) from fault
    return made


def refused(analysis: Analysis) -> Iterator[tuple[str, PropertyVerdict]]:
    """Return the verdicts that do not hold and have a witness. "Safe" is left out for a task:
    several tokens are several runs to do."""
    order = sorted(analysis.verdicts().items(), key=lambda item: item[0] != "one_run_each")
    for name, verdict in order:
        if (
            verdict.holds is False
            and verdict.witness is not None
            and not (analysis.progress and name == "safe")
        ):
            yield name, verdict
    for recovery in analysis.progress.recoveries if analysis.progress else ():
        for name, verdict in (("possible", recovery.possible), ("sure", recovery.almost_sure)):
            if verdict.holds is False and verdict.witness is not None:
                yield f"{recovery.error_exit}-recovery-{name}", verdict
                break


def picture(model: Task | Net, name: str, reason: str, witness: Witness) -> str:
    """Draw the net after the witness's firings, and number each transition by when it fired (a loop
    follows them)."""
    from petrobot.coordinator.drawing import Overlay, draw
    from petrobot.coordinator.task.net import Net

    net = model if isinstance(model, Net) else model.net
    marking = tuple(witness.marking.get(place, 0) for place in net.places)
    told = reason if len(reason) <= REASON_LETTERS else f"{reason[: REASON_LETTERS - 1]}…"
    overlay = Overlay(
        path=(*witness.firings, *witness.loop), legend=f"{name.replace('_', ' ')}: NO. {told}"
    )
    return draw(model, error_branches=True, marking=marking, overlay=overlay)
