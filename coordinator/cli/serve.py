"""Serve the operator's page until Ctrl-C: draw tasks there, and start them over the nodes."""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    ESTIMATES,
    SHIPPED,
    add_dry_run_argument,
    add_services_argument,
    load_directory,
    own_tasks,
    refuse_script,
)
from petrobot.coordinator.cli.options import (
    add_log_level_argument,
    add_page_port_argument,
    named_port,
    page_line,
)
from petrobot.services.host.command_line import done_before

if TYPE_CHECKING:
    from petrobot.coordinator.operator.station import Station
    from petrobot.coordinator.page.server import Page
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot serve --up"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    # Taken only to say what was probably meant.
    parser.add_argument("task", nargs="?", help=argparse.SUPPRESS)
    add_services_argument(parser)
    parser.add_argument(
        "--tasks",
        metavar="FOLDER",
        type=Path,
        help="folder of your own tasks, made when needed; tasks that come with petrobot are also "
        "offered (default: tasks, or if it is not there, the folder of the location file, if a "
        "task is in it)",
    )
    parser.add_argument(
        "--up",
        action="store_true",
        help="start the nodes of this host, and stop them when this command ends",
    )
    parser.add_argument(
        "--mock", metavar="FILE", type=Path, help="with --up: replace actions by scripted ones"
    )
    add_dry_run_argument(parser)
    add_page_port_argument(parser)
    parser.add_argument(
        "--estimates",
        metavar="FOLDER",
        type=Path,
        default=ESTIMATES,
        help="folder of the estimates files of runs that learn (%(default)s)",
    )
    parser.add_argument(
        "--journal", metavar="FOLDER", type=Path, help="where runs are kept (default: runs)"
    )
    add_log_level_argument(parser, "info")


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    if options.task is not None:
        raise CommandError(
            2,
            f"expected no task, got {options.task!r}: choose it on the page (its file must be in "
            f"--tasks FOLDER), or run it with a page of its own: petrobot run {options.task} --up",
        )
    if options.mock is not None and not options.up:
        raise CommandError(2, "--mock replaces actions of nodes that are started here: add --up")
    directory = load_directory(options.services, options.dry_run)
    refuse_script(options.mock, directory)
    options.tasks = options.tasks or own_tasks(directory)
    return asyncio.run(_serve(directory, options))


async def _serve(directory: Directory, options: argparse.Namespace) -> int:
    from petrobot.coordinator.launch import local_nodes
    from petrobot.coordinator.operator.station import Station
    from petrobot.coordinator.page.task_store import TaskStore
    from petrobot.coordinator.run.folder import DEFAULT
    from petrobot.coordinator.run.realtime import credentials_of

    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    credentials_of(directory)  # report unusable keys before anything is started
    runs = options.journal or DEFAULT
    async with AsyncExitStack() as nodes:
        own = local_nodes(directory, runs / "logs", mock=options.mock) if options.up else None
        if own and not await done_before(stop, nodes.enter_async_context(own)):
            return 0
        station = Station(
            directory, TaskStore(options.tasks, SHIPPED), runs, options.mock, options.estimates
        )
        try:
            await station.look()
            await _page(station, runs, options, stop)
        finally:
            await station.close()
    return 0


async def _page(
    station: Station, runs: Path, options: argparse.Namespace, stop: asyncio.Event
) -> None:
    """Serve the page until `stop` is set; then abort the active run and close the page."""
    from petrobot.coordinator.page.server import start_page

    with named_port(options.page_port):
        page = await start_page(
            station,
            tasks_folder=options.tasks,
            shipped=SHIPPED,
            port=options.page_port,
            offers=station.offers,
            runs=runs,
            starts=station.form,
            services=station.directory.source,
            estimates=options.estimates,
            plant=station.directory.plant(scripted=options.mock is not None, lockstep=False),
        )
    station.address = _addresses(station.directory, page)
    try:
        print(f"{page_line(page.url)}\nCtrl-C stops it", flush=True)
        await stop.wait()
        await station.close()
    finally:
        await page.close()


def _addresses(directory: Directory, page: Page) -> Any:
    from petrobot.coordinator.operator.run_address import RunAddress

    return lambda run: RunAddress(
        run, page.base, page.token, os.getpid(), str(directory.source.resolve())
    )
