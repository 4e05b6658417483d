"""Print a recorded run, or the log of a node; export a run: JSON lines, XES for process mining,
MCAP for Foxglove."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import add_services_argument, load_directory
from petrobot.coordinator.cli.recorded_runs import recorded
from petrobot.coordinator.run.folder import NODE_LOGS
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.engine import RunRecorded
    from petrobot.coordinator.operator.start_from import Recorded

EXAMPLE = "petrobot log last --format xes --out run.xes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "run", help="a run's id or folder, or `last`; or a node of services.toml, for its own log"
    )
    add_services_argument(parser)
    parser.add_argument(
        "--logs",
        metavar="FOLDER",
        type=Path,
        default=NODE_LOGS,
        help="folder of the nodes' logs (default: %(default)s)",
    )
    parser.add_argument(
        "--format", choices=("text", "jsonl", "xes"), default="text", help="default: %(default)s"
    )
    parser.add_argument(
        "--mcap",
        metavar="FILE",
        type=Path,
        help="write the run as MCAP instead (needs the package mcap)",
    )
    parser.add_argument(
        "--out", metavar="FILE", default="-", help="file to write to (default: standard output)"
    )


def run(options: argparse.Namespace) -> int:
    """Print or export."""
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.recording import ReplayError

    if (log := _node_log(options)) is not None:
        with log.open(encoding="utf-8", errors="replace") as lines:
            _write(options.out, (line.rstrip("\n") for line in lines))
        return 0
    found = recorded(options.run)
    try:
        if options.mcap is not None:
            _write_mcap(options.mcap, found)
            return 0
        _write(
            options.out,
            _text(found) if options.format == "text" else _exported(options.format, found),
        )
    except JournalError as fault:
        raise CommandError(2, str(fault)) from fault
    except ReplayError as fault:
        raise CommandError(1, str(fault)) from fault
    except OSError as fault:
        text = (
            f"{options.mcap or options.out}: {fault.strerror or fault}; name a file that "
            "can be written"
        )
        raise CommandError(2, text) from fault
    return 0


def _node_log(options: argparse.Namespace) -> Path | None:
    """Return the log of the named node; None if the name is that of a run, or of no node."""
    from petrobot.coordinator.run.folder import NoRunError, journal_of

    with contextlib.suppress(NoRunError):
        journal_of(options.run)
        return None
    try:
        directory = load_directory(options.services)
    except CommandError:
        if options.services is not None:
            raise
        return None  # the error to report is that there is no such run, not a broken location file
    if options.run not in directory.nodes:
        return None
    path: Path = options.logs / f"{options.run}.log"
    if not path.is_file():
        host = directory.nodes[options.run].host
        raise CommandError(
            2,
            f"{path}: node {options.run} has no log here; `petrobot up`, `run` or `serve` write it "
            f"on the node's own host ({host}); give its folder with --logs",
        )
    return path


def _write_mcap(path: Path, found: Recorded) -> None:
    from petrobot.coordinator.run.export import McapMissingError, write_mcap

    try:
        count = write_mcap(path, found.journal, found.engine.compiled.net, found.steps())
    except McapMissingError as fault:
        raise CommandError(2, str(fault)) from fault
    print(f"{path}: {count} messages")


def _exported(form: str, found: Recorded) -> Iterator[str]:
    from petrobot.coordinator.run.export import jsonl, xes

    return (jsonl if form == "jsonl" else xes)(found.journal, found.steps())


def _write(path: str, lines: Iterator[str]) -> None:
    if path == "-":
        for line in lines:
            print(line)
        return
    write_whole(Path(path), "".join(line + "\n" for line in lines))


def _ended(run: RunRecorded) -> str:
    """Return how a run ended, and whether it counts as success or failure."""
    status = run.status.value.upper() if run.status else ""
    if run.cancelled:
        return f"{status or '-'}  {run.taken_away}"
    why = ": ".join(filter(None, (run.cause, run.text)))
    return "provisional " * run.deferred + f"{status}  {why}".rstrip()


def _text(found: Recorded) -> Iterator[str]:
    from petrobot.coordinator.engine import (
        Corrected,
        Finished,
        Fired,
        Report,
        RunRecorded,
        StartRun,
    )
    from petrobot.coordinator.run.recording import Remark, with_remarks

    header, net = found.journal.header, found.engine.compiled.net
    yield f"{header['mission']}  {header['date']}  {header['mode']}  seed {header['seed']}"
    if found.journal.torn_bytes:
        yield f"(a torn tail of {found.journal.torn_bytes} bytes was dropped)"
    for step in with_remarks(found.journal, found.steps()):
        when = f"{step.number:5} {step.time:10.3f} s  "
        if isinstance(step, Remark):
            yield f"{when}remarked {step.author:20} {step.text}"
            continue
        for one in step.instructions:
            if isinstance(one, Fired):
                yield f"{when}fired    {one.transition:20} {net.describe(one.after)}"
            elif isinstance(one, StartRun):
                yield f"{when}started  {one.run:20} {one.action}"
            elif isinstance(one, RunRecorded):
                yield f"{when}ended    {one.run:20} {_ended(one)}"
            elif isinstance(one, Corrected):
                why = f"  {one.cause}: {one.text}".rstrip(": ") if one.cause else ""
                yield (
                    f"{when}judged   {one.run:20} {one.status.value.upper()}, was "
                    f"{one.was.value.upper()}{why}"
                )
            elif isinstance(one, Report):
                yield f"{when}{one.severity.value:8} {one.of:20} {one.text}"
            elif isinstance(one, Finished):
                yield f"{when}finished {one.status.value.upper()}: {one.reason}"
