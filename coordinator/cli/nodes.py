"""Ask every node of services.toml whether it is up, what it offers, and how its devices are."""

from __future__ import annotations

import argparse
import asyncio
import json
from typing import Any

from coordinator.cli.loading import add_services_argument, load_directory, write_json

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
    from coordinator.asking import ask_all

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
    for column in ("node", "address", "", "offers", "devices"):
        table.add_column(column)
    for node, answer in answers.items():
        state = "[green]up[/]" if answer["up"] else "[red]away[/]"
        devices = answer.get("status", {}).get("devices", {})
        shown = ", ".join(devices) if isinstance(devices, dict) else json.dumps(devices)
        table.add_row(node, answer["address"], state, ", ".join(answer.get("offers", [answer.get("why", "")])), shown)
    Console().print(table)
