"""Ask every node of services.toml whether it is up, what it offers, and how its devices are."""

from __future__ import annotations

import argparse
import asyncio
import json
import secrets
from typing import TYPE_CHECKING, Any

from coordinator.cli.loading import add_services_argument, load_directory, write_json

if TYPE_CHECKING:
    from services.comm.directory import Directory

EXAMPLE = "petrobot nodes --json -"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    add_services_argument(parser)
    parser.add_argument(
        "--timeout", type=float, default=2.0, metavar="S", help="seconds to wait (default: %(default)s)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the answers as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Ask; 0 when all are up, 3 otherwise."""
    directory = load_directory(options.services)
    answers = asyncio.run(_ask_all(directory, options.timeout))
    if options.json:
        write_json(options.json, answers)
    if options.json != "-":
        _print(answers)
    return 0 if all(answer["up"] for answer in answers.values()) else 3


async def _ask_all(directory: Directory, timeout: float) -> dict[str, Any]:
    asked = await asyncio.gather(*(_ask(directory, node, timeout) for node in directory.nodes))
    return dict(zip(directory.nodes, asked, strict=True))


async def _ask(directory: Directory, node: str, timeout: float) -> dict[str, Any]:
    from coordinator.realtime import credentials_of
    from services.comm.caller import Caller
    from services.comm.client import Client
    from services.comm.messages import Command, Hello
    from services.comm.notice import Answered, Notice, PeerLost
    from services.comm.wire import NEWEST_VERSION, OLDEST_VERSION

    entry, name = directory.nodes[node], f"asking-{secrets.token_hex(4)}"
    caller = Caller(node, Hello(OLDEST_VERSION, NEWEST_VERSION, "client", name, name, 0, directory.hash), auto_ack=True)
    told: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
    refused: list[str] = []

    def hear(_: float, notices: list[Notice]) -> None:
        for notice in notices:
            if isinstance(notice, Answered) and not told.done():
                told.set_result(dict(notice.answer.data))
            elif isinstance(notice, PeerLost):
                refused.append(notice.reason)

    proves = credentials_of(directory)
    client = Client(entry.host, entry.port, caller, on_notices=hear, key=proves.key, tls=proves.client())
    client.start()
    answer: dict[str, Any] = {"address": f"{entry.host}:{entry.port}", "up": await client.connected(timeout)}
    if answer["up"]:
        caller.command(client.now(), Command(f"{name}/status", "status"))
        client.flush()
        status = await asyncio.wait_for(told, timeout)
        answer |= {"offers": list(caller.offers), "boot": caller.boot, "version": NEWEST_VERSION, "status": status}
    elif refused:
        answer["why"] = refused[-1]
    await client.close()
    return answer


def _print(answers: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for column in ("node", "address", "", "offers", "devices"):
        table.add_column(column)
    for node, answer in answers.items():
        state = "[green]up[/]" if answer["up"] else "[red]away[/]"
        devices = answer.get("status", {}).get("devices", {})
        shown = ", ".join(devices) if isinstance(devices, dict) else json.dumps(devices)
        table.add_row(node, answer["address"], state, ", ".join(answer.get("offers", [answer.get("why", "")])), shown)
    Console().print(table)
