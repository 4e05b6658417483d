"""Ask every node of services.toml whether it is up, what it offers, and how its devices are."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.loading import (
    add_json_argument,
    add_services_argument,
    load_directory,
    tell_of_demo,
    write_json,
)
from petrobot.services.comm.tls.credentials import SOON
from petrobot.services.host.command_line import number

if TYPE_CHECKING:
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot nodes --json -"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_services_argument(parser)
    parser.add_argument(
        "--timeout",
        type=number(above=0.0),
        default=2.0,
        metavar="S",
        help="how long to wait for answers (default: %(default)s s)",
    )
    add_json_argument(parser, "the answers")


def run(options: argparse.Namespace) -> int:
    """Ask all nodes. Return 0 if all accept calls, 3 otherwise."""
    from petrobot.coordinator.run.node_status import ask_all

    directory = load_directory(options.services)
    tell_of_demo(options.services, directory)
    answers = asyncio.run(ask_all(directory, options.timeout))
    for node, devices in _stopped(directory, answers).items():
        answers[node]["stopped"] = devices
    for answer in answers.values():
        if answer["up"] and (troubles := _troubles(answer["status"])):
            answer |= {"up": False, "not_ready": troubles}
    if options.json:
        write_json(options.json, answers)
    if options.json != "-":
        _print(answers)
    return 0 if all(answer["up"] for answer in answers.values()) else 3


def _troubles(status: Mapping[str, Any]) -> dict[str, str]:
    """Return the devices of a node that would not accept a call now, with the reason. The key
    `actions` stands for actions without a device."""
    said = {
        name: (word, status["devices"].get(name, {})) for name, word in status["answers"].items()
    }
    if "general" in status:
        said["actions"] = (status["general"]["answer"], status["general"])
    return {
        name: f"{word}: {data['text']}" if data.get("text") else word
        for name, (word, data) in said.items()
        if word != "up"
    }


def _stopped(directory: Directory, answers: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return by node the devices that an emergency stop holds: as the node reports, or, if it does
    not run, as its file on this host says."""
    from petrobot.coordinator.operator.emergency_stop import still_stopped
    from petrobot.services.host.emergency_latch import ALL, latch_of

    told = {
        node: list(answer["status"].get("emergency", ()))
        for node, answer in answers.items()
        if answer["up"]
    }
    for node in still_stopped(directory):
        if node not in told:
            latched = latch_of(directory.source, node).stopped()
            own = [device.name for device in directory.devices.values() if device.node == node]
            told[node] = [device for device in own if device in latched or ALL in latched]
    return {node: devices for node, devices in told.items() if devices}


def _print(answers: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_lines=True)
    certified = any("certificate_ends" in answer for answer in answers.values())
    for column in (
        "node",
        "address",
        "",
        *(["certificate ends"] if certified else []),
        "offers",
        "devices",
    ):
        table.add_column(column, overflow="fold")
    for node, answer in answers.items():
        troubles = answer.get("not_ready", {})
        state = (
            "[green]up[/]"
            if answer["up"]
            else "[yellow]not ready[/]"
            if troubles
            else "[yellow]refuses us[/]"
            if answer.get("refuses")
            else "[red]away[/]"
        )
        shown = _devices(answer.get("status", {}), answer.get("stopped", []), troubles)
        ends = [_ends(answer.get("certificate_ends", ""))] if certified else []
        if answer.get("stopped"):
            state += "\n[red]stopped[/]"
        if answer.get("status", {}).get("dry_run"):
            state += "\n[yellow]dry run[/]"
        if answer.get("status", {}).get("scripted"):
            state += "\n[yellow]scripted[/]"
        offers = ", ".join(answer.get("offers", [answer.get("why", "")]))
        table.add_row(node, answer["address"], state, *ends, offers, shown)
    Console().print(table)
    if any(answer.get("stopped") for answer in answers.values()):
        print("stopped: when the cell is safe, give `petrobot estop --clear`")


def _devices(status: Mapping[str, Any], stopped: Sequence[str], troubles: Mapping[str, str]) -> str:
    """Return the names of devices, each with its troubles: an emergency stop, why it accepts no
    call, restarts, refusals, late cycles, dropped events. (Events may also come from a service, the
    memory or the node.)"""
    from rich.markup import escape

    shown, devices = [], status.get("devices", {})
    dropped = status.get("events_dropped", {})
    for device in dict.fromkeys((*devices, *troubles, *stopped, *dropped)):
        said, told = [device], devices.get(device, {})
        if device in stopped:
            said.append("[red]stopped[/]")
        elif device in troubles:
            # the text may come from a driver, with brackets that rich would read as markup
            said.append(f"[yellow]{escape(troubles[device])}[/]")
        if told.get("restarts"):
            last = escape(str(told.get("last_death", "")))
            said.append(f"[yellow]started again {told['restarts']} times, last because {last}[/]")
        if told.get("refused"):
            said.append(f"[yellow]{told['refused']} refused[/]")
        if told.get("overruns"):
            late = told.get("late_ms", 0.0)
            said.append(f"[yellow]{told['overruns']} cycles missed, at most {late:.0f} ms late[/]")
        if dropped.get(device):
            said.append(f"[yellow]{dropped[device]} events dropped[/]")
        shown.append(f"{said[0]} {', '.join(said[1:])}".rstrip())
    return "\n".join(shown)


def _ends(ends: str) -> str:
    """Return the day on which a certificate ends, red if that is soon."""
    if not ends:
        return ""
    left = datetime.fromisoformat(ends) - datetime.now(UTC)
    day = ends.partition("T")[0]
    return (
        f"[red]{day}: in {max(left.days, 0)} days; petrobot keys --tls[/]" if left <= SOON else day
    )
