"""Ask every node of services.toml whether it is up, what it offers, and how its devices are."""

from __future__ import annotations

import argparse
import asyncio
import json
from datetime import UTC, datetime
from typing import Any

from coordinator.cli.loading import add_services_argument, load_directory, write_json
from services.comm.expiry import SOON

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
    from coordinator.mission.asking import ask_all

    answers = asyncio.run(ask_all(load_directory(options.services), options.timeout))
    if options.json:
        write_json(options.json, answers)
    if options.json != "-":
        _print(answers)
    return 0 if all(answer["up"] for answer in answers.values()) else 3


def _print(answers: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    certified = any("certificate_ends" in answer for answer in answers.values())
    for column in ("node", "address", "", *(["certificate ends"] if certified else []), "offers", "devices"):
        table.add_column(column)
    for node, answer in answers.items():
        state = "[green]up[/]" if answer["up"] else "[red]away[/]"
        devices = answer.get("status", {}).get("devices", {})
        shown = ", ".join(devices) if isinstance(devices, dict) else json.dumps(devices)
        ends = [_ends(answer.get("certificate_ends", ""))] if certified else []
        offers = ", ".join(answer.get("offers", [answer.get("why", "")]))
        table.add_row(node, answer["address"], state, *ends, offers, shown)
    Console().print(table)


def _ends(ends: str) -> str:
    """The day on which a certificate ends, red when that is soon."""
    if not ends:
        return ""
    left = datetime.fromisoformat(ends) - datetime.now(UTC)
    day = ends.partition("T")[0]
    return f"[red]{day}: in {max(left.days, 0)} days; petrobot keys --tls[/]" if left <= SOON else day
