"""`petrobot run --from RUN:RECORD`: a simulated run of the same task that sets out where a recorded
one stood."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.options import pairs, parameter_of

if TYPE_CHECKING:
    from pathlib import Path

    from petrobot.coordinator.cli.recorded_runs import Recorded
    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.operator.start_from import Departure
    from petrobot.coordinator.run.recording import JournalStore

REFUSED = {
    "task": "the task comes from the run",
    "runs": "how many runs are left is in the marking",
    "learn": "a run from the middle of another teaches nothing",
    "use": "the choices are those of the run",
    "services": "the cell is that of the run",
    "join": "it has a cell of its own",
    "up": "it has a cell of its own",
}
"""Options that do not go with --from, and why."""


def add_departing_arguments(parser: argparse.ArgumentParser) -> None:
    """`--from`, `--going`."""
    parser.add_argument(
        "--from",
        dest="departs",
        metavar="RUN[:RECORD]",
        help="simulate the task of a recorded run from the state after one of its records "
        "(`petrobot log` numbers them; "
        "0, the default, is its beginning), in lock step, in a run folder of its own",
    )
    parser.add_argument(
        "--going",
        action="append",
        default=[],
        metavar="[PLACE=]END",
        help="with --from: what becomes of the runs that went on then: again (begin anew, "
        "the default), success, failure or "
        "error[:CAUSE]; of one place, or of all",
    )


def depart(options: argparse.Namespace) -> int:
    """Simulate from the point; the exit code says whether the task reached its end."""
    from petrobot.coordinator.cli.lockstep import in_one_process, substitutes
    from petrobot.coordinator.cli.output import give, progress
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.mission import MissionError

    found, departure = _found(options)
    setting = _setting(found, departure, options)
    begun = time.perf_counter()
    try:
        store = _store(found, setting, departure, options)
        with progress(options) as watch:
            mock = substitutes(_mock(found, options), found.directory)
            mission, timeline = in_one_process(found.directory, setting, mock, watch, store)
    except MissionError as fault:
        raise CommandError(2 if fault.bad_input else 1, str(fault)) from fault
    except JournalError as fault:
        raise CommandError(2, str(fault)) from fault
    told = {
        "from": {"run": departure.run, "record": departure.record, "going": dict(departure.going)}
    }
    result = {**mission.result("lockstep", time.perf_counter() - begun), **told}
    give(result, found.task, timeline, options, options.folder)
    return 0 if result["status"] == "success" else 1


def _found(options: argparse.Namespace) -> tuple[Recorded, Departure]:
    from petrobot.coordinator.cli.recorded_runs import recorded
    from petrobot.coordinator.operator.start_from import DepartureError, departure
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.recording import ReplayError

    for name, why in REFUSED.items():
        if getattr(options, name):
            raise CommandError(
                2, f"--from goes with no {'--' if name != 'task' else ''}{name}: {why}"
            )
    if options.mode == "realtime" or options.processes != 1:
        raise CommandError(
            2, "--from simulates in one process: a real cell does not stand where a marking says"
        )
    name, record = _named(options.departs)
    found = recorded(name)
    try:
        run = found.journal.path.parent.name
        return found, departure(found.journal, found.engine, run, record, _going(options.going))
    except (DepartureError, JournalError, ReplayError) as fault:
        raise CommandError(2, str(fault)) from fault


def _named(text: str) -> tuple[str, int]:
    run, colon, record = text.rpartition(":")
    if not colon:
        return text, 0
    if not record.isascii() or not record.isdigit():
        raise CommandError(2, f"--from {text}: write RUN:RECORD, the record as a number")
    return run, int(record)


def _going(texts: list[str]) -> dict[str, str] | str:
    from petrobot.coordinator.operator.start_from import AGAIN

    if any("=" not in text for text in texts):
        if len(texts) > 1:
            raise CommandError(2, "--going: give one END for all, or PLACE=END for each")
        return texts[0]
    return dict(text.split("=", 1) for text in texts) if texts else AGAIN


def _setting(found: Recorded, departure: Departure, options: argparse.Namespace) -> Setting:
    from petrobot.coordinator.operator.start_from import departing

    given = dict(pairs("--set", options.set))
    if options.regime is not None:
        given["regime"] = options.regime
    parameters = {name: parameter_of(found.task, name, text) for name, text in given.items()}
    try:
        return departing(
            found.journal, found.task, found.engine, departure, options.seed, parameters
        )
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault


def _mock(found: Recorded, options: argparse.Namespace) -> Path | None:
    from pathlib import Path

    then: str = found.journal.header.get("mock", "")
    given: Path | None = options.mock
    return given or (Path(then) if then else None)


def _store(
    found: Recorded, setting: Setting, departure: Departure, options: argparse.Namespace
) -> JournalStore:
    from petrobot.coordinator.launch import mission_id
    from petrobot.coordinator.operator.start_from import departed_store
    from petrobot.coordinator.run.folder import DEFAULT

    options.folder = (options.journal or DEFAULT) / mission_id(found.task)
    more: dict[str, Any] = {"durable": options.durable}
    if options.mock is not None:
        more["mock"] = str(options.mock.resolve())
    return departed_store(found.journal, setting, departure, options.folder, more)
