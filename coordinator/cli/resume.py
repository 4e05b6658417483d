"""Go on with a run whose coordinator was killed: marking restored, nodes asked for their runs,
nothing done twice."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import write_json
from petrobot.coordinator.cli.recorded_runs import Recorded, recorded

if TYPE_CHECKING:
    from petrobot.coordinator.run.interfaces import Observer
    from petrobot.coordinator.run.mission import Mission
    from petrobot.coordinator.run.timeline import Timeline

EXAMPLE = "petrobot resume last --json out.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    from petrobot.coordinator.cli.run import add_page_arguments

    parser.add_argument("run", help="a run's id or folder, or `last`")
    parser.add_argument(
        "--json", metavar="FILE", help="write the result as JSON (- for standard output)"
    )
    parser.add_argument(
        "--report", metavar="FOLDER", type=Path, help="leave a report in this folder"
    )
    add_page_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress in the terminal")


def run(options: argparse.Namespace) -> int:
    """Resume."""
    from petrobot.coordinator.cli.output import give
    from petrobot.coordinator.run.folder import RESULT
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.mission import MissionError
    from petrobot.coordinator.run.recording import ReplayError
    from petrobot.services.comm.lockstep.cell import CellError

    found = recorded(options.run)
    folder, mode = found.journal.path.parent, found.journal.header["mode"]
    if (result := _result_of(folder / RESULT)) is not None:
        print(
            f"{options.run}: the run had ended, {result['status']}; its result is "
            f"{folder / RESULT}",
            file=sys.stderr,
        )
        if options.json:
            write_json(options.json, result)
        return _exit_code(result)
    begun = time.perf_counter()
    try:
        if mode == "lockstep":
            mission, timeline, learned = _resume_lockstep(found, options)
        else:
            mission, timeline, learned = asyncio.run(_resume(found, options))
    except MissionError as fault:
        raise CommandError(1, str(fault)) from fault
    except CellError as fault:
        raise CommandError(3, str(fault)) from fault
    except (JournalError, ReplayError) as fault:
        raise CommandError(2, str(fault)) from fault
    result = {**mission.result(mode, time.perf_counter() - begun), **learned}
    give(result, found.task, timeline, options, folder)
    return _exit_code(result)


def _result_of(path: Path) -> dict[str, Any] | None:
    """The result that a run has left; None if it has none yet, or only a part of one, which is then
    written again."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return result if isinstance(result, dict) and "status" in result else None


def _exit_code(result: Mapping[str, Any]) -> int:
    """A supervisor that resumes whatever ends is told the same by each resume: 2 is for damage
    alone."""
    return 0 if result["status"] == "success" else 1


def _resume_lockstep(
    found: Recorded, options: argparse.Namespace
) -> tuple[Mission, Timeline, dict[str, Any]]:
    """Nodes that wait for their coordinator are joined; a cell that ended with it is made again
    from its seed."""
    from petrobot.coordinator.cli.learning_options import resumed_selector, saved
    from petrobot.coordinator.cli.lockstep import JOINED, rejoin, retrace
    from petrobot.coordinator.cli.output import progress

    selector, session = resumed_selector(found.task, found.journal.header)
    with saved(session) as learned, progress(options) as watch:
        if found.journal.header["cell"] == JOINED:
            mission, timeline = rejoin(
                found, selector, [] if session is None else [session.selector], watch
            )
        else:
            mission, timeline = retrace(found, selector, watch)
    return mission, timeline, learned


async def _resume(
    found: Recorded, options: argparse.Namespace
) -> tuple[Mission, Timeline, dict[str, Any]]:
    from petrobot.coordinator.cli.learning_options import resumed_selector, saved
    from petrobot.coordinator.cli.run import drive
    from petrobot.coordinator.launch import resumed_mission
    from petrobot.coordinator.run.timeline import Timeline

    timeline = Timeline()
    now = asyncio.get_running_loop().time()
    selector, session = resumed_selector(found.task, found.journal.header)
    observers: list[Observer] = [timeline] if session is None else [timeline, session.selector]
    mission, go_on = resumed_mission(
        found.directory, found.task, found.engine, found.journal, observers, now, selector
    )
    options.folder = found.journal.path.parent
    with saved(session) as learned:
        await drive(found.directory, mission, options, go_on)
    return mission, timeline, learned
