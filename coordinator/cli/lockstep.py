"""How `run` and `resume` drive a lock-step cell: in this process, in one process a node, or with
nodes that run already."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import file_line

if TYPE_CHECKING:
    import argparse

    from petrobot.coordinator.cli.recorded_runs import Recorded
    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.run.interfaces import Observer, Selector, Store
    from petrobot.coordinator.run.mission import Mission
    from petrobot.coordinator.run.timeline import Timeline
    from petrobot.services.comm.location_file import Directory

LONGEST = 10**9
"""Ticks."""
LAUNCHED, JOINED = "launched", "joined"
"""How a recorded run came by its nodes: they ended with it, or they wait for its coordinator."""

Watch = Callable[["Mission", float], None]


def begin(
    directory: Directory, setting: Setting, options: argparse.Namespace, watch: Watch | None
) -> tuple[Mission, Timeline]:
    """Run a task in lock step, with a journal if a folder is given for it."""
    from petrobot.coordinator.launch import lockstep_member, lockstep_mission

    store = _new_store(directory, setting, options)
    if options.processes == 1:
        return in_one_process(
            directory, setting, substitutes(options.mock, directory), watch, store
        )
    mission = lockstep_mission(directory, setting, store)
    member, party = lockstep_member(directory, mission, watch)
    timeline = _timed(mission)
    if options.join:
        _go(member, lambda: party.over)
    else:
        asyncio.run(_launched(directory, options.mock, member, lambda: party.over))
    return mission, timeline


def _new_store(directory: Directory, setting: Setting, options: argparse.Namespace) -> Store | None:
    from petrobot.coordinator.cli.recorded_runs import journal_folder, new_store
    from petrobot.coordinator.launch import lockstep_id, mission_id

    folder = journal_folder(options)
    if folder is None:
        return None
    options.folder = folder / mission_id(setting.task)
    more = {"cell": JOINED if options.join else LAUNCHED, **options.chosen_by}
    return new_store(directory, setting, options, options.folder, lockstep_id(setting), 0.0, **more)


def in_one_process(
    directory: Directory,
    setting: Setting,
    substituted: Mapping[str, Callable[..., Any]] | None,
    watch: Watch | None,
    store: Store | None,
) -> tuple[Mission, Timeline]:
    """The whole cell in this process."""
    from petrobot.coordinator.launch import lockstep_cell

    cell, party = lockstep_cell(directory, setting, substituted, watch, store)
    timeline = _timed(party.mission)
    cell.run(lambda: party.over, LONGEST)
    return party.mission, timeline


def retrace(found: Recorded, selector: Selector, watch: Watch | None) -> tuple[Mission, Timeline]:
    """Go on with a run whose cell ended with its coordinator: made again from its seed, compared
    with the journal as far as that goes, and written on from there."""
    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.operator.start_from import departed
    from petrobot.coordinator.run.journal import JournalWriter
    from petrobot.coordinator.run.recording import RetracingStore

    header = found.journal.header
    store = RetracingStore(JournalWriter(found.journal.path), found.journal)
    given = header["parameters"], header["runs"], header["seed"]
    setting = Setting(found.task, *given, selector, departed(header))
    mock = Path(header["mock"]) if header.get("mock") else None
    return in_one_process(
        found.directory, setting, substitutes(mock, found.directory), watch, store
    )


def rejoin(
    found: Recorded, selector: Selector, observers: list[Observer], watch: Watch | None
) -> tuple[Mission, Timeline]:
    """Go on with a run whose nodes wait for their coordinator."""
    from petrobot.coordinator.launch import lockstep_member, resumed_mission
    from petrobot.coordinator.run.timeline import Timeline

    timeline = Timeline()
    seen = [timeline, *observers]
    mission, go_on = resumed_mission(
        found.directory, found.task, found.engine, found.journal, seen, 0.0, selector
    )
    member, party = lockstep_member(found.directory, mission, watch, go_on)
    _go(member, lambda: party.over)
    return mission, timeline


def substitutes(mock: Path | None, directory: Directory) -> Mapping[str, Callable[..., Any]] | None:
    """The scripted actions of a file, None without one."""
    if mock is None:
        return None
    from petrobot.coordinator.launch import SCRIPTED, load_object
    from petrobot.coordinator.task.wording import nearest

    try:
        scripted: Mapping[str, Callable[..., Any]] = load_object(SCRIPTED)(mock)
    except OSError as fault:
        raise CommandError(
            2, f"{mock}: {fault.strerror}; give --mock a file of scripted actions"
        ) from fault
    except Exception as fault:
        raise CommandError(2, str(fault)) from fault
    for name in scripted:
        if name not in directory.actions:
            key = f"actions.{name}"
            what = f"{directory.source} has no such action{nearest(name, directory.actions)}"
            raise CommandError(
                2,
                f"{file_line(mock, key)}: {key}: {what}; name one of its actions, or drop it here",
            )
    return scripted


def _timed(mission: Mission) -> Timeline:
    from petrobot.coordinator.run.timeline import Timeline

    timeline = Timeline()
    mission.executor.observers.append(timeline)
    return timeline


async def _launched(
    directory: Directory, mock: Path | None, member: Any, until: Callable[[], bool]
) -> None:
    from petrobot.coordinator.launch import local_programs
    from petrobot.coordinator.run.supervisor import Supervisor

    programs = local_programs(directory, lockstep=True, mock=mock)
    async with Supervisor(programs, Path("runs/logs"), respawn=False):
        await asyncio.to_thread(_go, member, until)


def _go(member: Any, until: Callable[[], bool]) -> None:
    member.open()
    member.run(until)
