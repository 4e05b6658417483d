"""Pause the active run before a transition fires or when a token enters a place. Without a name,
list the breakpoints."""

from __future__ import annotations

import argparse
import asyncio
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot break start"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("element", nargs="?", help="a transition or place of the task")
    parser.add_argument("--off", action="store_true", help="remove this breakpoint")
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Set, remove or list breakpoints."""
    if options.element is None:
        return asyncio.run(_list(options))
    return command.give(options, "breakpoint", lambda client: _data(client, options), _told)


def _data(client: OperatorClient, options: argparse.Namespace) -> dict[str, Any]:
    task = client.state["task"] or {"places": [], "transitions": []}
    kinds = {one["name"]: kind for kind in ("places", "transitions") for one in task[kind]}
    name = options.element.rpartition(".")[2]
    return {
        "element": f"{kinds[command.named(kinds, name, 'place or transition')]}.{name}",
        "on": not options.off,
    }


async def _told(client: OperatorClient, answer: command.Answer) -> str:
    answer["breakpoints"] = client.state["breakpoints"]
    return _words(client.state["breakpoints"])


def _words(breakpoints: list[str]) -> str:
    return f"breakpoints: {', '.join(breakpoints)}" if breakpoints else "no breakpoints"


async def _list(options: argparse.Namespace) -> int:
    from petrobot.coordinator.operator.client import OperatorError

    address = command.find(options)
    try:
        async with command.connect(address, options.name) as client:
            breakpoints = client.state["breakpoints"]
    except OperatorError as fault:
        raise CommandError(3, f"{address.run}: {fault}") from fault
    command.show(
        options, {"run": address.run, "ok": True, "breakpoints": breakpoints}, _words(breakpoints)
    )
    return 0
