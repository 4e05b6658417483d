"""Run a task: in real time over the nodes of services.toml, or in lock step in simulated time."""

from __future__ import annotations

import argparse
import asyncio
import importlib
import os
import sys
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    add_dry_run_argument,
    add_json_argument,
    add_mock_argument,
    add_services_argument,
    cell_path,
    load_directory,
    load_task,
    objections,
    refuse_arguments,
    refuse_misplaced,
    task_path,
)
from petrobot.coordinator.cli.options import (
    add_journal_arguments,
    add_log_level_argument,
    add_page_port_argument,
    journal_folder,
    named_port,
    page_line,
    pairs,
    parameter_of,
    parameter_texts,
    recorded,
    refuse_idle,
    tidy,
)
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.services.host.command_line import LARGEST_SEED, MOST_RUNS, number, probability, whole

if TYPE_CHECKING:
    from petrobot.coordinator.learning.session import LearningSetting
    from petrobot.coordinator.operator.prepare import RunRequest
    from petrobot.coordinator.operator.session import RunSession
    from petrobot.coordinator.operator.start_from import Recorded
    from petrobot.coordinator.run.interfaces import Observer
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory

MODES = ("realtime", "lockstep")
SEED = 1
EXAMPLE = "petrobot run catch_ball --mode lockstep --runs 20 --seed 1 --json out.json"
SELECTORS = (
    "nikolic_fu",
    "nikolic_fu_fast",
    "tracking",
    "reward_inaction",
    "discretised_pursuit",
    "ucb1",
    "thompson",
    "fixed",
    "round_robin",
)
"""The selectors' names, for --help without importing numpy. A test compares them with the
selectors themselves."""


REFUSED = {
    "task": "the task is that of the recorded run",
    "runs": "the marking says how many runs are left",
    "learn": "a run that starts in the middle of another would distort what was learned",
    "use": "the choices are those of the recorded run",
    "services": "the cell is that of the recorded run",
    "join": "it simulates its own cell",
    "up": "it simulates its own cell",
    "dry_run": "it simulates its own cell",
}
"""Options that cannot be combined with --from, and why."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    _add_task_arguments(parser)
    _add_cell_arguments(parser)
    add_learning_arguments(parser)
    add_start_from_arguments(parser)
    add_output_arguments(parser)
    add_journal_arguments(parser)
    add_page_arguments(parser)
    add_log_level_argument(parser)
    parser.add_argument(
        "--quiet", action="store_true", help="no progress, and no search of the net for faults"
    )
    add_services_argument(parser)
    parser.set_defaults(folder=None)


def _add_task_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "task",
        nargs="?",
        help="a task file, or the name of a task that comes with petrobot (with --from: leave it "
        "out)",
    )
    parser.add_argument(
        "--runs",
        type=whole(most=MOST_RUNS),
        metavar="N",
        help="how many times to run the task (default: the tokens in its runs place)",
    )
    parser.add_argument(
        "--mode", choices=MODES, help=f"default: {MODES[0]}, with --from {MODES[1]}"
    )
    parser.add_argument(
        "--seed",
        type=whole(0, LARGEST_SEED),
        metavar="S",
        help=f"seed of all random numbers (default: {SEED}, with --from that of the recorded run)",
    )
    parser.add_argument("--regime", metavar="NAME", help="short for --set regime=NAME")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a parameter of the task",
    )
    parser.add_argument(
        "--use",
        action="append",
        default=[],
        metavar="TASK=ACTION",
        help="always use this action for this primitive task",
    )


def _add_cell_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--processes",
        type=int,
        choices=(1, 0),
        default=1,
        help="lock step: 1 for one process, 0 for one process per node",
    )
    parser.add_argument(
        "--join",
        action="store_true",
        help="lock step, one process per node: use the nodes that `petrobot up --lockstep` started",
    )
    parser.add_argument(
        "--up",
        action="store_true",
        help="start the nodes of this host for this run, and stop them after it",
    )
    add_dry_run_argument(parser)
    add_mock_argument(parser)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--json` and `--report`."""
    add_json_argument(parser, "the result")
    parser.add_argument(
        "--report", metavar="FOLDER", type=Path, help="write a report into this folder"
    )


def add_page_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say whether and where a real-time run serves the operator's page."""
    parser.add_argument(
        "--no-page",
        action="store_true",
        help="do not serve the operator's page; commands such as `petrobot pause` still work",
    )
    add_page_port_argument(parser)


def add_learning_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say whether, where and how a command learns."""
    parser.add_argument(
        "--learn",
        metavar="FILE",
        type=Path,
        help="learn which actions are best, and store it in this estimates file",
    )
    parser.add_argument(
        "--selector",
        choices=SELECTORS,
        metavar="NAME",
        help=f"how actions are chosen: {', '.join(SELECTORS)} (with --learn)",
    )
    parser.add_argument(
        "--target",
        type=probability,
        metavar="R",
        help="choose only among actions that reach this reliability (with --learn)",
    )
    parser.add_argument(
        "--credit",
        choices=("action", "task"),
        help="what judges a choice: how its own run ended (default), or whether the goal of the "
        "task was met (with --learn)",
    )
    parser.add_argument(
        "--context",
        action="append",
        metavar="NAME|CONDITION",
        help="learn separately for each value of a parameter or variable, or for a condition "
        "(default: regime, if the task has it)",
    )
    parser.add_argument(
        "--prior",
        nargs="?",
        type=number(above=0.0),
        const=True,
        metavar="N",
        help="start from what is known of another plant (the simulated one, for a real cell), as "
        "from N trials of each action (with --learn; N: 10)",
    )
    parser.add_argument(
        "--frozen",
        action="store_true",
        help="choose by what was learned before, and learn nothing (with --learn)",
    )


def add_start_from_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--from` and `--going`."""
    parser.add_argument(
        "--from",
        dest="starts_from",
        metavar="RUN[:RECORD]",
        help="start from a recorded run: simulate its task from the state after one of its "
        "records, in lock step, as a new run (`petrobot log` numbers the records; default: 0, the "
        "beginning)",
    )
    parser.add_argument(
        "--going",
        action="append",
        default=[],
        metavar="[PLACE=]END",
        help="with --from: how the actions that were active at that record continue: again (start "
        "again, the default), success, failure or error[:CAUSE]; for one place, or for all",
    )


def run(options: argparse.Namespace) -> int:
    """Check the task, run it, print and write its result."""
    if options.journal is None and (options.mode == "lockstep" or options.starts_from is not None):
        why = "needs --journal FOLDER: without it, a run in lock step is not kept"
        refuse_idle(options, why, idle={"keep", "durable"})
    if options.starts_from is not None:
        return conduct(_from_record(options), options, "lockstep")
    if options.task is None:
        raise CommandError(2, "give a task to run, or a recorded run with --from")
    if options.going:
        raise CommandError(2, "--going needs --from RUN")
    options.mode = options.mode or MODES[0]
    options.seed = SEED if options.seed is None else options.seed
    lockstep = options.mode == "lockstep"
    if lockstep:
        refuse_idle(options, "a run in lock step starts its own nodes; leave it out", idle={"up"})
        refuse_idle(options, "a run in lock step serves no page; leave it out", idle={"page_port"})
    elif not options.join:
        refuse_idle(
            options, "only for --mode lockstep; in real time, nodes are joined", idle={"processes"}
        )
    task = load_task(options.task)
    directory = load_directory(cell_path(options.services, options.task, task), options.dry_run)
    if options.join and (not lockstep or options.processes != 0):
        raise CommandError(
            2, "--join needs --mode lockstep --processes 0; in real time, nodes are always joined"
        )
    _refuse_unfit(task, directory)
    if (lockstep or options.up) and not options.join:
        where = {"everywhere": lockstep, "scripted": options.mock is not None}
        refuse_misplaced(directory, **where)
        refuse_arguments(task, options.task, directory, **where)
    request = _request(task, directory, options)
    if not lockstep and not options.quiet:
        nodes = ", ".join(directory.nodes)
        print(f"checking {task.name}, then connecting to {nodes}", file=sys.stderr, flush=True)
    _warn(task, directory, options)
    if not lockstep:
        refuse_stopped(directory)
        _tell_of_waiting(options)
    text = task_path(options.task).read_text(encoding="utf-8")

    def make(observers: Sequence[Observer]) -> RunSession:
        from petrobot.coordinator.operator.prepare import prepare

        return prepare(request, task, text, directory, observers)

    return conduct(make, options, options.mode)


def conduct(
    make: Callable[[Sequence[Observer]], RunSession], options: argparse.Namespace, mode: str
) -> int:
    """Make a session, lead it to its end, print and write its result. Return the exit code."""
    from petrobot.coordinator.cli.output import give, kept_streams
    from petrobot.coordinator.launch import RequestError
    from petrobot.coordinator.learning.estimates_file import EstimatesError
    from petrobot.coordinator.operator.session import interruptible
    from petrobot.coordinator.operator.start_from import DepartureError
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.run.mission import UNSCORED
    from petrobot.coordinator.run.recording import JournalStore, ReplayError
    from petrobot.coordinator.run.timeline import Timeline
    from petrobot.services.comm.location_file import DirectoryError

    made: list[RunSession] = []
    timeline = None if options.report is None else Timeline()  # it grows with the run

    async def lead() -> None:
        with kept_streams(options.json == "-") if mode == "lockstep" else nullcontext():
            with interruptible():  # importing a simulated cell may take seconds
                made.append(make([] if timeline is None else [timeline]))
                store = made[0].mission.executor.store
                if timeline is not None and isinstance(store, JournalStore):
                    timeline.origin = store.origin  # its times are those of `petrobot log`
            await (_lead_lockstep if mode == "lockstep" else _lead_realtime)(made[0], options)

    try:
        asyncio.run(lead())
    except KeyboardInterrupt:
        folder = made[0].folder if made and made[0].mission.executor.finished is None else None
        if folder is not None and folder.exists():  # one that had not begun leaves none
            up = " --up" * options.up
            print(f"`petrobot resume {folder}{up}` continues this run", file=sys.stderr)
        raise
    except JournalError as fault:
        if not made:
            raise CommandError(2, str(fault)) from fault
        again = f"correct that, then `petrobot resume {made[0].folder}` continues this run"
        raise CommandError(1, f"{fault}; {again}") from fault
    except (RequestError, DepartureError, EstimatesError, ReplayError, DirectoryError) as fault:
        done = bool(made) and made[0].mission.executor.finished is not None
        again = (
            f"; the run has ended: `petrobot resume {made[0].folder}` gives its result"
            if (done and made[0].folder is not None)
            else ""
        )
        raise CommandError(2, f"{fault}{again}") from fault
    [session] = made
    give(session, options, timeline)
    tidy(options, session.folder)
    result = session.result()
    return 0 if result["status"] == "success" and UNSCORED not in result else 1


async def _lead_lockstep(session: RunSession, options: argparse.Namespace) -> None:
    from petrobot.coordinator.cli.output import progress

    with progress(options) as watch:
        await session.lead(watch)


async def _lead_realtime(session: RunSession, options: argparse.Namespace) -> None:
    """Lead a session over its nodes; with --up, start those of this host first."""
    from petrobot.coordinator.cli.output import progress
    from petrobot.coordinator.launch import local_nodes

    # All that is imported must be there before the nodes are connected: a coordinator that imports
    # does not answer them, and on a busy host they take it for lost.
    for module in ("petrobot.coordinator.operator.station", "petrobot.coordinator.page.server"):
        importlib.import_module(module)
    directory = session.mission.executor.directory
    try:
        async with local_nodes(directory, mock=options.mock) if options.up else nullcontext():
            await session.connect()
            async with served(session, options):
                with progress(options) as watch:
                    await session.lead(watch)
    finally:
        await session.abandon()  # does nothing after `lead`


@asynccontextmanager
async def served(session: RunSession, options: argparse.Namespace) -> AsyncIterator[None]:
    """Serve the operator's page, or with --no-page the operator's protocol alone, while the run is
    active."""
    from petrobot.coordinator.cli.loading import ESTIMATES, SHIPPED, own_tasks
    from petrobot.coordinator.operator.run_address import RunAddress
    from petrobot.coordinator.operator.station import offered
    from petrobot.coordinator.page.server import start_page

    operation = session.operate()
    directory, callers = session.mission.executor.directory, session.mission.callers
    assert session.folder is not None
    with named_port(options.page_port):
        page = await start_page(
            operation,
            tasks_folder=own_tasks(directory),
            shipped=SHIPPED,
            port=options.page_port,
            offers=lambda: offered(
                directory, lambda action, node: callers[node].up and action in callers[node].offers
            ),
            runs=session.folder.parent,
            services=directory.source,
            estimates=session.estimates or ESTIMATES,
            plant=session.plant,
            page=not options.no_page,
        )
    if not options.no_page:
        print(page_line(page.url), file=sys.stderr, flush=True)
    services = str(directory.source.resolve())
    session.address = RunAddress(session.identity, page.base, page.token, os.getpid(), services)
    try:
        yield
    finally:
        await page.close()


# --- the request ------------------------------------------------------------------------------


def _refuse_unfit(task: Task, directory: Directory) -> None:
    from petrobot.coordinator.analysis.may_run import may_run

    refusal = may_run(task, cell_of(directory)).refusal()
    if refusal:
        raise CommandError(2, refusal)


def _warn(task: Task, directory: Directory, options: argparse.Namespace) -> None:
    """Print what a short search of the state space finds against the task. The run still starts."""
    if options.quiet:
        return
    for objection in objections(task, cell_of(directory)):
        print(f"warning: {objection} (details: petrobot check {options.task})", file=sys.stderr)


def _tell_of_waiting(options: argparse.Namespace) -> None:
    """Say which run still waits for `resume`. The new one starts."""
    from petrobot.coordinator.operator.run_address import waiting

    folder = journal_folder(options)
    for name in waiting(folder)[:1] if folder is not None else ():
        print(
            f"{name} was interrupted: this is a new run; `petrobot resume {name}` continues that "
            "one",
            file=sys.stderr,
        )


def refuse_stopped(directory: Directory) -> None:
    """Refuse to run, or to continue, while an emergency stop holds devices: every action would fail
    at once."""
    from petrobot.coordinator.operator.emergency_stop import still_stopped

    stopped = still_stopped(directory)
    if stopped:
        text = (
            f"{', '.join(stopped)}: an emergency stop still holds the devices; when the cell is "
            "safe, run `petrobot estop --clear`"
        )
        raise CommandError(2, text)


def _request(task: Task, directory: Directory, options: argparse.Namespace) -> RunRequest:
    from petrobot.coordinator.operator.prepare import JOINED, LAUNCHED, ONE_PROCESS, RunRequest

    chosen = pairs("--use", options.use, "TASK=ACTION")
    for primitive, action in chosen.items():
        known = task.primitive_tasks.get(primitive)
        if known is None or action not in known.alternatives:
            choices = ", ".join(known.alternatives) if known else ", ".join(task.primitive_tasks)
            raise CommandError(
                2, f"--use {primitive}={action}: unknown in task {task.name}; choose from {choices}"
            )
        if action not in directory.actions:
            raise CommandError(
                2, f"--use {primitive}={action}: {directory.source} has no action {action}"
            )
    nodes = JOINED if options.join else LAUNCHED if options.processes == 0 else ONE_PROCESS
    return RunRequest(
        options.mode,
        options.runs,
        options.seed,
        _parameters(task, options),
        chosen,
        _learning(options),
        pace=0.0,
        folder=journal_folder(options),
        durable=options.durable,
        mock=options.mock,
        nodes=nodes,
        ordered=options.ordered,
    )


def _parameters(task: Task, options: argparse.Namespace) -> Mapping[str, Any]:
    given = parameter_texts(options)
    return {name: parameter_of(task, name, text) for name, text in given.items()}


def _learning(options: argparse.Namespace) -> LearningSetting | None:
    """How the run learns. None if it does not learn; then no estimates file is read."""
    if options.learn is None:
        for name in ("selector", "target", "credit", "context", "prior", "frozen"):
            if getattr(options, name):
                raise CommandError(
                    2, f"--{name} needs --learn FILE: without it nothing is read or learned"
                )
        return None
    from petrobot.coordinator.learning.selectors import ACTION, DEFAULT
    from petrobot.coordinator.learning.session import PRIOR_TRIALS, LearningSetting

    contexts = None if options.context is None else tuple(part for part in options.context if part)
    return LearningSetting(
        options.learn,
        options.selector or DEFAULT,
        options.target,
        contexts,
        frozen=options.frozen,
        credit=options.credit or ACTION,
        prior=PRIOR_TRIALS if options.prior is True else options.prior,
    )


# --- from a recorded run ----------------------------------------------------------------------


def _from_record(options: argparse.Namespace) -> Callable[[Sequence[Observer]], RunSession]:
    """Return a function that prepares a simulated run from a point of a recorded one."""
    for name, why in REFUSED.items():
        said = f"--{name.replace('_', '-')}"
        if getattr(options, name):
            raise CommandError(
                2, f"--from cannot have {'a task' if name == 'task' else said}: {why}"
            )
    if options.mode == "realtime" or options.processes != 1:
        raise CommandError(
            2, "--from only simulates, in one process: a real cell is not in the recorded state"
        )
    name, record = _named(options.starts_from)
    found: Recorded = recorded(name)

    def make(observers: Sequence[Observer]) -> RunSession:
        from petrobot.coordinator.operator.prepare import RecordedPoint, RunRequest, prepare_from
        from petrobot.coordinator.run.folder import DEFAULT

        run = found.journal.path.parent.name
        request = RunRequest(
            "lockstep",
            seed=options.seed,
            parameters=_parameters(found.task, options),
            pace=0.0,
            start=RecordedPoint(run, record, _going(options.going)),
            folder=options.journal or DEFAULT,
            durable=options.durable,
            mock=options.mock,
        )
        return prepare_from(request, found, observers)

    return make


def _named(text: str) -> tuple[str, int]:
    run, colon, record = text.rpartition(":")
    if not colon:
        return text, 0
    if not record.isascii() or not record.isdigit():
        raise CommandError(2, f"--from {text}: expected RUN:RECORD with a number, such as last:20")
    return run, int(record)


def _going(texts: list[str]) -> dict[str, str] | str:
    from petrobot.coordinator.operator.start_from import AGAIN

    if any("=" not in text for text in texts):
        if len(texts) > 1:
            raise CommandError(2, "--going: give one END for all places, or PLACE=END for each")
        return texts[0]
    return dict(text.split("=", 1) for text in texts) if texts else AGAIN
