"""Run a task: in real time over the nodes of services.toml, or in lock step, where simulated time
is exact."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.learning_options import add_learning_arguments, opened, saved
from petrobot.coordinator.cli.loading import (
    add_services_argument,
    cell_path,
    load_directory,
    load_task,
    refuse_misplaced,
)
from petrobot.coordinator.cli.lockstep import substitutes
from petrobot.coordinator.cli.options import add_page_port_argument, named_port, pairs, parameter_of
from petrobot.coordinator.cli.output import give, progress
from petrobot.coordinator.cli.recorded_runs import (
    add_journal_arguments,
    journal_folder,
    new_store,
    tidy,
)
from petrobot.coordinator.cli.start_from import add_departing_arguments, depart
from petrobot.services.host.command_line import whole

if TYPE_CHECKING:
    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.run.mission import Mission
    from petrobot.coordinator.run.realtime import RealtimeMission
    from petrobot.coordinator.run.timeline import Timeline
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory

MODES = ("realtime", "lockstep")
SEED = 1
MOST_STATES, LONGEST = 20_000, 1.0
"""Markings and seconds that are spent on a task's state space before it runs."""
EXAMPLE = "petrobot run catch_ball --mode lockstep --runs 20 --seed 1 --json out.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "task",
        nargs="?",
        help="a task file, or the name of a task that comes with petrobot (with --from: that "
        "of the run)",
    )
    parser.add_argument(
        "--runs",
        type=whole(),
        metavar="N",
        help="how many runs (default: tokens in the task's runs place)",
    )
    parser.add_argument(
        "--mode", choices=MODES, help=f"default: {MODES[0]}, with --from {MODES[1]}"
    )
    parser.add_argument(
        "--seed",
        type=whole(0),
        metavar="S",
        help=f"of all chance in the run (default: {SEED}, with --from that of the run)",
    )
    parser.add_argument("--regime", metavar="NAME", help="the same as --set regime=NAME")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the task"
    )
    parser.add_argument(
        "--use",
        action="append",
        default=[],
        metavar="TASK=ACTION",
        help="the action for a primitive task",
    )
    parser.add_argument(
        "--processes",
        type=int,
        choices=(1, 0),
        default=1,
        help="lock step: 1 for one process, 0 for one a node",
    )
    parser.add_argument(
        "--join",
        action="store_true",
        help="lock step, one process a node: the nodes wait already (`petrobot up --lockstep`)",
    )
    parser.add_argument(
        "--up",
        action="store_true",
        help="launch the nodes of this host for this run, and end them after it",
    )
    parser.add_argument(
        "--mock", metavar="FILE", type=Path, help="replace actions by scripted ones"
    )
    add_learning_arguments(parser)
    add_departing_arguments(parser)
    parser.add_argument(
        "--json", metavar="FILE", help="write the result as JSON (- for standard output)"
    )
    parser.add_argument(
        "--report", metavar="FOLDER", type=Path, help="leave a report in this folder"
    )
    add_journal_arguments(parser)
    add_page_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress in the terminal")
    add_services_argument(parser)
    parser.set_defaults(folder=None)


def add_page_arguments(parser: argparse.ArgumentParser) -> None:
    """Whether and where the operator's page is served while a real-time run goes on."""
    parser.add_argument(
        "--no-page",
        action="store_true",
        help="serve no operator's page; the command line still steers the run",
    )
    add_page_port_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Check the task, run it, print and write the result."""
    from petrobot.coordinator.launch import mission_id
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.mission import MissionError
    from petrobot.services.comm.location_file import DirectoryError

    if options.departs is not None:
        return depart(options)
    if options.task is None:
        raise CommandError(2, "give a task, or with --from a recorded run")
    if options.going:
        raise CommandError(2, "--going goes with --from")
    options.mode, options.seed = (
        options.mode or MODES[0],
        SEED if options.seed is None else options.seed,
    )
    task = load_task(options.task)
    options.services = cell_path(options.services, options.task, task)
    directory = load_directory(options.services)
    if options.join and (options.mode != "lockstep" or options.processes != 0):
        raise CommandError(
            2, "--join is for --mode lockstep --processes 0: nodes in real time are joined always"
        )
    _refuse_unfit(task, directory)
    if (options.mode == "lockstep" or options.up) and not options.join:
        refuse_misplaced(
            directory, everywhere=options.mode == "lockstep", scripted=options.mock is not None
        )
    substitutes(options.mock, directory)  # refuses a script for actions that there are not
    setting = _setting(task, directory, options)
    _warn(task, options)
    begun = time.perf_counter()
    try:
        if options.mode == "lockstep":
            with saved(options.learning) as learned:
                mission, timeline = _run_lockstep(directory, setting, options)
        else:
            _refuse_stopped(directory)
            options.identity = mission_id(task)
            with saved(options.learning) as learned:
                mission, timeline = asyncio.run(_run_realtime(directory, setting, options))
    except MissionError as fault:
        raise CommandError(2 if fault.bad_input else 1, str(fault)) from fault
    except DirectoryError as fault:
        raise CommandError(2, str(fault)) from fault
    except JournalError as fault:
        raise CommandError(
            1 if options.folder is not None and options.folder.exists() else 2, str(fault)
        ) from fault
    result = {**mission.result(options.mode, time.perf_counter() - begun), **learned}
    give(result, task, timeline, options, options.folder)
    tidy(options)
    return 0 if result["status"] == "success" else 1


def _refuse_unfit(task: Task, directory: Directory) -> None:
    from petrobot.coordinator.task.check import check

    offers = {action: entry.node for action, entry in directory.actions.items()}
    report = check(task, offers, source=str(directory.source))
    faults = [f for f in report.findings if f.severity == "error"]
    if faults:
        lines = "\n".join(f"  {f.key}: {f.text}\n    {f.remedy}" for f in faults)
        raise CommandError(2, f"{task.name} may not run:\n{lines}")


def _warn(task: Task, options: argparse.Namespace) -> None:
    """Say what a short look at the state space finds against running it: whoever runs it all the
    same may want to see that."""
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.analysis.report import analyse

    if options.quiet:
        return
    limits = SearchLimits(states=MOST_STATES, seconds=LONGEST, clock=time.monotonic)
    for name, verdict in analyse(task, limits=limits).objections.items():
        told = (
            f"warning: {task.name}: {name.replace('_', ' ')}: {verdict.reason} (petrobot "
            f"check {options.task} says more)"
        )
        print(told, file=sys.stderr)


def _refuse_stopped(directory: Directory) -> None:
    """A run whose devices obey nobody would end at once, having done nothing."""
    from petrobot.coordinator.operator.emergency_stop import still_stopped

    stopped = still_stopped(directory)
    if stopped:
        text = (
            f"{', '.join(stopped)}: an emergency stop still holds the devices; once the "
            "cell is safe: petrobot estop --clear"
        )
        raise CommandError(2, text)


def _setting(task: Task, directory: Directory, options: argparse.Namespace) -> Setting:
    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.run.interfaces import FirstAlternative

    given = dict(pairs("--set", options.set))
    if options.regime is not None:
        given["regime"] = options.regime
    parameters = {name: parameter_of(task, name, text) for name, text in given.items()}
    chosen = dict(pairs("--use", options.use))
    for primitive, action in chosen.items():
        known = task.primitive_tasks.get(primitive)
        if known is None or action not in known.alternatives:
            choices = ", ".join(known.alternatives) if known else ", ".join(task.primitive_tasks)
            raise CommandError(
                2, f"--use {primitive}={action}: not known to {task.name}; choose among {choices}"
            )
        if action not in directory.actions:
            raise CommandError(
                2, f"--use {primitive}={action}: {directory.source} places no action {action}"
            )
    options.learning = opened(task, directory, chosen, options)
    learning = {} if options.learning is None else {"learning": options.learning.beginning()}
    options.chosen_by = {"chosen": chosen, **learning}
    selector = FirstAlternative(chosen) if options.learning is None else options.learning.selector
    return Setting(task, parameters, options.runs, options.seed, selector)


# --- lock step --------------------------------------------------------------------------------


def _run_lockstep(
    directory: Directory, setting: Setting, options: argparse.Namespace
) -> tuple[Mission, Timeline]:
    from petrobot.coordinator.cli.lockstep import begin
    from petrobot.services.comm.lockstep.cell import CellError

    with progress(options) as watch:
        try:
            return begin(directory, setting, options, watch)
        except CellError as fault:
            raise CommandError(3, str(fault)) from fault


# --- real time --------------------------------------------------------------------------------


async def _run_realtime(
    directory: Directory, setting: Setting, options: argparse.Namespace
) -> tuple[Mission, Timeline]:
    from petrobot.coordinator.launch import realtime_mission
    from petrobot.coordinator.run.timeline import Timeline

    timeline = Timeline()
    identity: str = options.identity
    folder = journal_folder(options)
    assert folder is not None
    options.folder = folder / identity
    now = asyncio.get_running_loop().time()
    store = new_store(
        directory, setting, options, options.folder, identity, now, **options.chosen_by
    )
    mission = realtime_mission(directory, setting, identity, store)
    mission.executor.observers.append(timeline)
    await drive(directory, mission, options)
    return mission, timeline


async def drive(
    directory: Directory,
    mission: Mission,
    options: argparse.Namespace,
    begin: Callable[[float], None] | None = None,
) -> None:
    """Run a mission in real time over its nodes, launching those of this host first if asked to."""
    from petrobot.coordinator.run.realtime import RealtimeMission, UnreachableError, credentials_of
    from petrobot.coordinator.run.supervisor import LaunchError
    from petrobot.services.comm.protocol.security import KeyFileError

    try:
        async with _nodes(directory, options):
            shell = RealtimeMission(mission, directory, credentials_of(directory))
            try:
                await shell.connect()
                async with _page(shell, options):
                    with progress(options) as watch:
                        await _watched(shell.run(begin), mission, watch)
            finally:
                await shell.close()
    except (UnreachableError, LaunchError) as fault:
        raise CommandError(3, str(fault)) from fault
    except KeyFileError as fault:
        raise CommandError(2, str(fault)) from fault


@asynccontextmanager
async def _page(shell: RealtimeMission, options: argparse.Namespace) -> AsyncIterator[None]:
    """The operator's page, or with --no-page his protocol alone, while the mission run goes on."""
    from petrobot.coordinator.cli.loading import SHIPPED
    from petrobot.coordinator.cli.serve import OWN_TASKS
    from petrobot.coordinator.operator.commands import Operation
    from petrobot.coordinator.operator.door_file import Door, door_open
    from petrobot.coordinator.operator.history import JournalHistory
    from petrobot.coordinator.operator.station import offered
    from petrobot.coordinator.page.server import start_page
    from petrobot.coordinator.run.interfaces import FirstAlternative

    selector = shell.mission.executor.selector
    assert isinstance(selector, FirstAlternative)
    operation = Operation(shell, selector)
    history = JournalHistory(options.folder.parent)
    callers, directory = shell.mission.callers, shell.mission.executor.directory
    with named_port(options.page_port):
        page = await start_page(
            operation,
            tasks_folder=OWN_TASKS,
            shipped=SHIPPED,
            port=options.page_port,
            offers=lambda: offered(
                directory, lambda action, node: callers[node].up and action in callers[node].offers
            ),
            history=history,
            page=not options.no_page,
        )
    if not options.no_page:
        print(f"page: {page.url}", file=sys.stderr, flush=True)
    executor = shell.mission.executor
    door = Door(
        executor.mission,
        page.base,
        page.token,
        os.getpid(),
        str(executor.directory.source.resolve()),
    )
    try:
        with door_open(options.folder, door):
            yield
    finally:
        await page.close()
        await operation.close()


def _nodes(directory: Directory, options: argparse.Namespace) -> AbstractAsyncContextManager[Any]:
    if not getattr(options, "up", False):
        return nullcontext()
    from petrobot.coordinator.launch import local_programs
    from petrobot.coordinator.run.supervisor import Supervisor

    return Supervisor(local_programs(directory, mock=options.mock), Path("runs/logs"), notice=print)


async def _watched(
    running: Any, mission: Mission, watch: Callable[[Mission, float], None] | None
) -> None:
    task = asyncio.ensure_future(running)
    while not task.done():
        if watch is not None:
            watch(mission, asyncio.get_running_loop().time())
        await asyncio.wait({task}, timeout=0.1)
    await task
