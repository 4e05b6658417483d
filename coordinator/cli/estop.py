"""Emergency stop: stop all devices through their nodes and their bus, without the coordinator.
Every user of this host may give it."""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from msgspec.structs import asdict

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    add_json_argument,
    add_services_argument,
    load_directory,
    services_path,
    tell_of_demo,
    write_json,
)
from petrobot.coordinator.cli.options import add_runs_argument
from petrobot.coordinator.operator.run_address import RunAddress, find_address
from petrobot.coordinator.run.folder import RESULT, NoRunError, journal_of
from petrobot.coordinator.run.journal import JournalError, read_header
from petrobot.services.comm.location_file import Directory, DirectoryError, parse
from petrobot.services.host.toml_text import InputError

if TYPE_CHECKING:
    from petrobot.coordinator.operator.emergency_stop import Stopped

EXAMPLE = "petrobot estop"
HARDWARE = "press the hardware's emergency stop"
DISK_PATIENCE = 1.0
"""How long to wait for the folder of runs, and for services.toml (s)."""
COORDINATOR_PATIENCE = 1.0
"""How long to wait for the coordinator's answer (s). The coordinator is notified after the devices
were stopped."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "--clear",
        action="store_true",
        help="let the devices accept commands again; nothing moves until an action moves it",
    )
    parser.add_argument(
        "--bus",
        action="store_true",
        help="also stop the devices on this host's buses, without waiting for their node",
    )
    parser.add_argument(
        "--run", metavar="RUN", help="stop the cell of this run (default: the newest active run)"
    )
    add_runs_argument(parser)
    add_json_argument(parser, "the answers")
    add_services_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Stop, or clear. Return 0 if every device has carried it out and a stop is stored, 3
    otherwise."""
    from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, order_all

    try:
        address = _in_time(lambda: _address(options), lambda: None)
        path = options.services or (
            Path(address.services) if address is not None and address.services else None
        )
        directory, begun = _in_time(
            lambda: _cells(options, path, address),
            lambda: (_in_time(lambda: load_directory(path), _hangs), None),
        )
    except InputError as fault:
        if options.clear:
            raise
        raise CommandError(fault.exit_code, f"{fault}\nNOTHING WAS STOPPED: {HARDWARE}") from fault
    # The devices of the demo are stopped, too: who presses the button must not wait for this.
    tell_of_demo(path, directory, f", or {HARDWARE}")
    verb = CLEAR if options.clear else STOP
    ordered = time.perf_counter()
    answers = asyncio.run(order_all(directory, verb, bus=options.bus, begun=begun))
    took = time.perf_counter() - ordered
    coordinator = (
        asyncio.run(_tell(address, options.journal))
        if address is not None and not options.clear
        else ""
    )
    _show(options, answers, coordinator, took)
    return 0 if answers and all(answer.done for answer in answers) else 3


T = TypeVar("T")


def _in_time(read: Callable[[], T], otherwise: Callable[[], T]) -> T:
    """Return what `read` finds on the disk, or `otherwise` if the disk does not answer: a stop must
    not wait for a folder of runs that hangs. On a busy host it may take longer: then this process
    uses its processor."""
    found = Future[T]()

    def in_thread() -> None:
        try:
            found.set_result(read())
        except BaseException as fault:
            found.set_exception(fault)

    Thread(target=in_thread, daemon=True).start()  # a daemon does not keep the process from its end
    used = -1.0
    while (now := time.process_time()) > used + 0.001:
        used = now
        with suppress(TimeoutError):
            return found.result(DISK_PATIENCE)
    print(
        f"a disk has not answered for {DISK_PATIENCE:g} s; continuing without what is on it",
        file=sys.stderr,
    )
    return otherwise()


def _hangs() -> NoReturn:
    raise CommandError(2, "services.toml cannot be read: its disk does not answer")


def _address(options: argparse.Namespace) -> RunAddress | None:
    """Return the address of the active run, or None. The run names the cell, and its coordinator is
    notified."""
    try:
        return find_address(options.run, options.journal)
    except NoRunError:
        if options.run is not None:
            raise
        return None


def _cells(
    options: argparse.Namespace, path: Path | None, address: RunAddress | None
) -> tuple[Directory, Directory | None]:
    """Return the cell of services.toml, and what it was when the active run began, or the newest
    one whose coordinator was killed, if it was edited since (to clear a stop: when the newest run
    began).

    A file that was edited into one that cannot be read, or removed, keeps no stop from the nodes:
    the newest run's is taken."""
    begun, ended = _begun(
        address.run if address is not None else options.run or "last", options.journal
    )
    if path is None and begun is not None and not Path("services.toml").exists():
        path = begun.source if begun.source.parent == Path.cwd() else None
    own = begun is not None and begun.source.resolve() == services_path(path).resolve()
    try:
        directory = load_directory(path)
    except InputError as fault:
        if begun is None or not own:
            raise
        print(f"{fault}\nmeant is the cell as the newest run here began with it", file=sys.stderr)
        return begun, None
    edited = begun is not None and own and begun.hash != directory.hash
    return directory, begun if edited and (options.clear or not ended) else None


def _begun(run: str, folder: Path) -> tuple[Directory | None, bool]:
    """Return the cell that a run began with, None without such a run in real time, and whether that
    run has ended: nodes of one whose coordinator was killed may still move their devices."""
    try:
        then = read_header(path := journal_of(run, folder))
        if then["mode"] == "realtime":
            cell = parse(then["services"], Path(then["services_path"]))
            return cell, path.with_name(RESULT).exists()
    except (NoRunError, JournalError, DirectoryError, OSError, LookupError, ValueError):
        pass
    return None, True


async def _tell(address: RunAddress, folder: Path) -> str:
    """Ask the coordinator to abort its run, so that it starts no recovery. Return what happened, in
    words."""
    from petrobot.coordinator.cli.operate import connect
    from petrobot.coordinator.operator.client import OperatorError

    try:
        async with asyncio.timeout(COORDINATOR_PATIENCE), connect(address, None) as client:
            answer = await client.command("estop")
    except (OperatorError, TimeoutError):
        return f"{address.run}: " + (
            "the coordinator does not answer" if _is_active(address, folder) else "has ended"
        )
    return f"{address.run}: aborted" if answer.get("ok") else f"{address.run}: {answer.get('text')}"


def _is_active(address: RunAddress, folder: Path) -> bool:
    """Whether the run is still active: a run whose devices are stopped may end by itself."""
    try:
        return find_address(address.run, folder) == address
    except NoRunError:
        return False


def _show(
    options: argparse.Namespace, answers: list[Stopped], coordinator: str, took: float
) -> None:
    if options.json:
        data: dict[str, Any] = {
            "nodes": [asdict(answer) for answer in answers],
            "coordinator": coordinator,
        }
        write_json(options.json, {**data, "seconds": round(took, 4)})
    if options.json == "-":
        return
    if not answers:
        print("no node of this cell has devices: nothing to stop")
    for answer in answers:
        for device, said in answer.devices.items():
            # The node has cleared the stop; `said` is what the device's process does.
            late = options.clear and said != "cleared"
            print(f"{answer.node:12} {device:12} {f'cleared ({said})' if late else said}")
        if not answer.answered and not answer.cleared:
            print(f"{answer.node:12} {'':12} NO ANSWER: {answer.why}")
        if answer.open and not options.clear:
            names = ", ".join(answer.open)
            print(f"{answer.node:12} {'':12} NOT KNOWN TO STAND STILL: {names}; {HARDWARE}")
        for said in filter(None, (answer.note, answer.latch)):
            print(f"{answer.node:12} {'':12} {said}")
        if answer.bus:
            print(f"{answer.node:12} {'':12} {answer.bus}")
    if coordinator:
        print(coordinator)
    if not options.clear:
        print(
            "`petrobot estop --clear` lets the devices accept commands again; a device that "
            "services.toml gives to a node of another host meanwhile starts free there"
        )
