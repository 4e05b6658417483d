"""Ask every node of services.toml whether it is up, what it offers, and how its devices are."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from coordinator.cli.loading import add_services_argument, load_directory, write_json
from services.comm.expiry import SOON
from services.comm.quantities import number

if TYPE_CHECKING:
    from services.comm.directory import Directory

EXAMPLE = "petrobot nodes --json -"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    add_services_argument(parser)
    parser.add_argument(
        "--timeout", type=number(above=0.0), default=2.0, metavar="S", help="seconds to wait (default: %(default)s)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the answers as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Ask; 0 when all are up, 3 otherwise."""
    from coordinator.mission.asking import ask_all

    directory = load_directory(options.services)
    answers = asyncio.run(ask_all(directory, options.timeout))
    for node, devices in _stopped(directory, answers).items():
        answers[node]["stopped"] = devices
    if options.json:
        write_json(options.json, answers)
    if options.json != "-":
        _print(answers)
    return 0 if all(answer["up"] for answer in answers.values()) else 3


def _stopped(directory: Directory, answers: Mapping[str, Any]) -> dict[str, list[str]]:
    """By node the devices that an emergency stop holds: as it says itself, or as this host says of one that does not run."""
    from coordinator.operator.emergency import still_stopped
    from services.comm.latch import ALL, latch_of

    told = {node: list(answer["status"].get("emergency", ())) for node, answer in answers.items() if answer["up"]}
    for node in still_stopped(directory):
        if node not in told:
            latched = latch_of(directory.source, node).stopped()
            own = [device.name for device in directory.devices.values() if device.node == node]
            told[node] = [device for device in own if device in latched or ALL in latched]
    return {node: devices for node, devices in told.items() if devices}


def _print(answers: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    certified = any("certificate_ends" in answer for answer in answers.values())
    for column in ("node", "address", "", *(["certificate ends"] if certified else []), "offers", "devices"):
        table.add_column(column)
    for node, answer in answers.items():
        state = "[green]up[/]" if answer["up"] else "[red]away[/]"
        shown = _devices(_told(answer.get("status", {})), answer.get("stopped", []))
        ends = [_ends(answer.get("certificate_ends", ""))] if certified else []
        offers = ", ".join(answer.get("offers", [answer.get("why", "")]))
        table.add_row(node, answer["address"], state, *ends, offers, shown)
    Console().print(table)


def _told(status: Mapping[str, Any]) -> dict[str, Any]:
    """By device what it told; of one that did not answer, that it did not."""
    devices = dict(status.get("devices", {}))
    for device, answer in status.get("answers", {}).items():
        if answer != "up" and not devices.get(device, {}).get("text"):
            devices[device] = {**devices.get(device, {}), "text": answer}
    return devices


def _devices(devices: Mapping[str, Any], stopped: Sequence[str]) -> str:
    """Names of devices, each with what is wrong with it: an emergency stop, refused commands, missed cycles, no answer."""
    shown = []
    for device in dict.fromkeys((*devices, *stopped)):
        said = [device]
        if device in stopped:
            said.append("[red]stopped (petrobot estop --clear)[/]")
        said += _troubles(devices.get(device, {}))
        shown.append(" ".join(said))
    return ", ".join(shown)


def _troubles(told: Mapping[str, Any]) -> list[str]:
    """What a device's own status says against it. Its text may come from a driver, so it is escaped."""
    from rich.markup import escape

    found = []
    if told.get("refused"):
        found.append(f"[yellow]{told['refused']} refused[/]")
    if told.get("overruns"):
        found.append(f"[yellow]{told['overruns']} cycles missed, at most {told.get('late_ms', 0.0):.0f} ms late[/]")
    if told.get("text"):
        found.append(f"[red]{escape(str(told['text']))}[/]")
    return found


def _ends(ends: str) -> str:
    """The day on which a certificate ends, red when that is soon."""
    if not ends:
        return ""
    left = datetime.fromisoformat(ends) - datetime.now(UTC)
    day = ends.partition("T")[0]
    return f"[red]{day}: in {max(left.days, 0)} days; petrobot keys --tls[/]" if left <= SOON else day
