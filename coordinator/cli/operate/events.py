"""Raise an external event by hand, instead of a sensor."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot raise image_tick"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("event", help="an external event of the task")
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""

    def data(client: OperatorClient) -> dict[str, Any]:
        external = {
            name: one for name, one in client.state["events"].items() if one["scope"] == "external"
        }
        return {"event": command.named(external, options.event, "external event")}

    async def told(client: OperatorClient, answer: command.Answer) -> str:
        return f"raised {options.event}"

    return command.give(options, "raise_event", data, told)
