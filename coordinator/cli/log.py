"""Print a recorded run, or the log of a node; export a run: JSON lines, XES for process mining,
MCAP for Foxglove."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError, file_of
from petrobot.coordinator.cli.loading import add_services_argument, load_directory
from petrobot.coordinator.cli.options import recorded, refuse_idle
from petrobot.coordinator.run.folder import NODE_LOGS
from petrobot.services.host.json_text import without_controls
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.engine import Engine, RunRecorded
    from petrobot.coordinator.operator.start_from import Recorded
    from petrobot.coordinator.run.recording import RecordedStep

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

    if (log := _node_log(options)) is not None:
        why = "the log of a node is text; leave it out"
        refuse_idle(options, why, idle={"format", "mcap"})
        _write(options.out, _node_lines(log))
        return 0
    found = recorded(options.run)
    why = "it is for the log of a node, and this is a run; leave it out"
    refuse_idle(options, why, idle={"services", "logs"})
    if options.mcap is not None:
        why = "--mcap names the file and the format; leave this out"
        refuse_idle(options, why, idle={"format", "out"})
    with file_of(options.mcap or options.out, "name a file that can be written"):
        if options.mcap is not None:
            _write_mcap(options.mcap, found)
        else:
            text = options.format == "text"
            _write(options.out, _text(found) if text else _exported(options.format, found))
    return 0


def _node_log(options: argparse.Namespace) -> Path | None:
    """Return the log of the named node; None if the name is that of a run, or of no node."""
    from petrobot.coordinator.run.folder import NoRunError, journal_of

    with contextlib.suppress(NoRunError):
        journal_of(options.run)
        return None
    try:
        directory = load_directory(options.services)
    except InputError:
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


def _node_lines(log: Path) -> Iterator[str]:
    from petrobot.coordinator.run.supervisor import older_part

    for part in (older_part(log), log):
        with (
            contextlib.suppress(FileNotFoundError),
            part.open(encoding="utf-8", errors="replace") as lines,
        ):
            yield from (line.rstrip("\n") for line in lines)


def _write_mcap(path: Path, found: Recorded) -> None:
    from petrobot.coordinator.run.export import write_mcap

    count = write_mcap(path, found.journal, found.engine.compiled.net, found.steps())
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
    from petrobot.coordinator.run.recording import Remark, TakeOver, with_asides

    header = found.journal.header
    how = f"{header['mode']}  {found.plant}  seed {header['seed']}"
    yield f"{header['mission']}  {header['date']}  {how}"
    if found.journal.torn_bytes:
        yield f"(a torn tail of {found.journal.torn_bytes} bytes was dropped)"
    event, again, until = None, 0, ""
    for step in with_asides(found.journal, found.steps()):
        at = f"{step.time:.3f} s"
        if isinstance(step, Remark):
            rows = [("remarked", step.author, step.text)]
        elif isinstance(step, TakeOver):
            rows = [("resumed", "", step.told)]
        else:
            rows = list(_lines(step, found.engine))
        # A button that was pressed while no coordinator was there would fill the screen.
        if rows == [event]:
            again, until = again + 1, at
            continue
        if again and rows:
            yield _repeated(again, until)
        if rows:
            event, again = rows[0] if rows[0][0] == "event" else None, 0
        for word, of, text in rows:
            line = f"{step.number:5} {at:>12}  {word:9} {of:20} {text}".rstrip()
            yield line if isinstance(step, Remark | TakeOver) else without_controls(line)
    if again:
        yield _repeated(again, until)


def _repeated(again: int, until: str) -> str:
    return f"{'':20}the same {again} times more, until {until}"


def _lines(step: RecordedStep, engine: Engine) -> Iterator[tuple[str, str, str]]:
    """Yield a word, the element concerned and a text for all that happened in a step."""
    from petrobot.coordinator.engine import (
        Corrected,
        Finished,
        Fired,
        Marked,
        Paused,
        Report,
        Resumed,
        RunRecorded,
        StartRun,
    )
    from petrobot.coordinator.operator.event_texts import told

    net = engine.compiled.net
    yield from _cause(step, engine)
    for one in step.instructions:
        if isinstance(one, Fired):
            yield "fired", one.transition, net.describe(one.after)
        elif isinstance(one, Marked):
            yield "marked", one.place, f"{told(step.stimulus)}  {net.describe(one.after)}"
        elif isinstance(one, StartRun):
            yield "started", one.run, one.action
        elif isinstance(one, RunRecorded):
            yield "ended", one.run, _ended(one)
        elif isinstance(one, Corrected):
            why = f"  {one.cause}: {one.text}".rstrip(": ") if one.cause else ""
            was = f"{one.status.value.upper()}, was {one.was.value.upper()}"
            yield "judged", one.run, was + why
        elif isinstance(one, Paused):
            yield "paused", "", one.reason
        elif isinstance(one, Resumed):
            yield "continued", "", "for one firing" if one.steps else ""
        elif isinstance(one, Report):
            yield one.severity.value, one.of, one.text
        elif isinstance(one, Finished):
            yield "finished", "", f"{one.status.value.upper()}: {one.told}"


def _cause(step: RecordedStep, engine: Engine) -> Iterator[tuple[str, str, str]]:
    """Yield what came from outside; not what a line about its effect says."""
    from petrobot.coordinator.engine import (
        Abort,
        EventOccurred,
        ForceExit,
        Override,
        RaiseEvent,
        RunRaised,
        SetBreakpoints,
    )
    from petrobot.coordinator.operator.event_texts import told, unserved

    text = told(step.stimulus)
    match step.stimulus:
        case EventOccurred(event, source):
            of = f"from {source}" if source else ""
            yield "event", event, ": ".join(filter(None, (of, unserved(step, engine))))
        case RaiseEvent(event):
            how = ("raised by the operator", unserved(step, engine))
            yield "event", event, ": ".join(filter(None, how))
        case RunRaised(run, event):
            how = (f"raised by {run}", unserved(step, engine))
            yield "event", event, ": ".join(filter(None, how))
        case ForceExit(of) | Override(of):
            yield "operator", of, text
        case SetBreakpoints():
            yield "operator", "", text
        case Abort(reason):
            yield "aborted", "", reason or "by the operator"
