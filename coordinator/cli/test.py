"""Check that the driver of a device keeps the rules of drivers (docs/drivers.md).

The device moves: give commands that are safe from its present position.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import add_services_argument, load_directory
from petrobot.services.comm.location_file import Directory
from petrobot.services.host.command_line import number

ANSWERS_WITHIN = 1.0
"""How long to wait for a node that may run (s)."""
EXAMPLE = """petrobot test driver axis --command '{"to": 0.2}' --command '{"to": 0.4}'"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("what", choices=["driver"], help="what to test")
    parser.add_argument("device", help="name of the device in services.toml")
    add_services_argument(parser)
    parser.add_argument(
        "--command",
        dest="commands",
        type=_command,
        action="append",
        default=[],
        metavar="JSON",
        help="a command that moves the device; give two or more, there and back",
    )
    parser.add_argument(
        "--first",
        type=_command,
        action="append",
        default=[],
        metavar="JSON",
        help="a command that a new driver needs before those, to switch its drives on",
    )
    parser.add_argument(
        "--position",
        dest="positions",
        action="append",
        default=[],
        metavar="KEY",
        help="a key of the state that tells where the device is (default: all numbers that the "
        "commands change)",
    )
    parser.add_argument(
        "--seconds",
        type=number(least=0.1),
        default=5.0,
        metavar="S",
        help="the longest that one of the movements takes (default: %(default)g s)",
    )
    parser.add_argument(
        "--within",
        type=number(least=0.01),
        default=1.0,
        metavar="S",
        help="how soon the device must stand still after a stop (default: %(default)g s)",
    )


def _command(text: str) -> Mapping[str, Any]:
    try:
        body = json.loads(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(f"expected JSON, got {text!r}: {fault}") from fault
    if not isinstance(body, dict):
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text!r}")
    return body


def _refuse_in_use(directory: Directory, device: str) -> None:
    """Refuse to move a device that is stopped, that another process has, or that is on another
    host."""
    from petrobot.coordinator.cli.run import refuse_stopped
    from petrobot.coordinator.run.supervisor import is_local

    if (entry := directory.devices.get(device)) is None:
        return  # the check itself says which devices there are
    refuse_stopped(directory)
    node = directory.nodes[entry.node]
    if not is_local(node.host):
        text = f"{device} is on the host of its node {node.name}, {node.host}: test it there"
        raise CommandError(2, text)
    with suppress(OSError):
        socket.create_connection((node.host, node.port), ANSWERS_WITHIN).close()
        text = (
            f"node {node.name} runs on {node.host}:{node.port} and controls {device}; end it "
            "first: two drivers must not move one device"
        )
        raise CommandError(2, text)


def _progress() -> Callable[[str], None]:
    begin = time.monotonic()

    def tell(what: str) -> None:
        print(f"{time.monotonic() - begin:4.0f} s  {what}", file=sys.stderr, flush=True)

    return tell


def run(options: argparse.Namespace) -> int:
    """Test the driver, and print the faults found."""
    from petrobot.coordinator.launch import load_object

    check_device = load_object("petrobot.services.conformance:check_device")
    directory = load_directory(options.services)
    _refuse_in_use(directory, options.device)
    try:
        found = check_device(
            directory,
            options.device,
            options.commands,
            first=options.first,
            seconds=options.seconds,
            within=options.within,
            positions=options.positions,
            progress=_progress(),
        )
    except (ValueError, OSError) as fault:
        raise CommandError(2, f"{directory.source}: devices.{options.device}: {fault}") from fault
    for text in (*found.faults, *found.notes, *found.busy):
        print(text)
    if not found.faults:
        checked = " that were checked" if found.notes else ""
        doubt = ", as far as this busy computer can tell" if found.busy else ""
        print(f"{options.device}: its driver keeps the rules{checked}{doubt}")
    return 1 if found.faults else 0
