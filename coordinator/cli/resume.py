"""Go on with a run whose coordinator was killed: marking restored, nodes asked for their runs, nothing done twice."""

from __future__ import annotations

import argparse
import asyncio
import time
from typing import TYPE_CHECKING, Any

from coordinator.cli import CommandError
from coordinator.cli.replaying import Recorded, recorded

if TYPE_CHECKING:
    from coordinator.mission.mission import Mission
    from coordinator.mission.partners import Observer
    from coordinator.record.timeline import Timeline

EXAMPLE = "petrobot resume last --json out.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    from pathlib import Path

    from coordinator.cli.run import add_page_arguments

    parser.add_argument("run", help="a run's id or folder, or `last`")
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON (- for standard output)")
    parser.add_argument("--report", metavar="FOLDER", type=Path, help="leave a report in this folder")
    add_page_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress in the terminal")


def run(options: argparse.Namespace) -> int:
    """Resume."""
    from coordinator.cli.giving import give
    from coordinator.mission.mission import MissionError
    from coordinator.record.journal import JournalError
    from coordinator.record.recording import ReplayError
    from coordinator.record.runfolder import RESULT
    from services.comm.cell import CellError

    found = recorded(options.run)
    folder, mode = found.journal.path.parent, found.journal.header["mode"]
    if (folder / RESULT).exists():
        raise CommandError(2, f"{options.run}: the run had ended; its result is {folder / RESULT}")
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
    return 0 if result["status"] == "success" else 1


def _resume_lockstep(found: Recorded, options: argparse.Namespace) -> tuple[Mission, Timeline, dict[str, Any]]:
    """Nodes that wait for their coordinator are joined; a cell that ended with it is made again from its seed."""
    from coordinator.cli.giving import progress
    from coordinator.cli.learning import resumed_selector, saved
    from coordinator.cli.lockstep import JOINED, rejoin, retrace

    selector, session = resumed_selector(found.task, found.journal.header)
    with saved(session) as learned, progress(options) as watch:
        if found.journal.header["cell"] == JOINED:
            mission, timeline = rejoin(found, selector, [] if session is None else [session.selector], watch)
        else:
            mission, timeline = retrace(found, selector, watch)
    return mission, timeline, learned


async def _resume(found: Recorded, options: argparse.Namespace) -> tuple[Mission, Timeline, dict[str, Any]]:
    from coordinator.cli.learning import resumed_selector, saved
    from coordinator.cli.run import drive
    from coordinator.launch import resumed_mission
    from coordinator.record.timeline import Timeline

    timeline = Timeline()
    now = asyncio.get_running_loop().time()
    selector, session = resumed_selector(found.task, found.journal.header)
    observers: list[Observer] = [timeline] if session is None else [timeline, session.selector]
    mission, go_on = resumed_mission(found.directory, found.task, found.engine, found.journal, observers, now, selector)
    options.folder = found.journal.path.parent
    with saved(session) as learned:
        await drive(found.directory, mission, options, go_on)
    return mission, timeline, learned
