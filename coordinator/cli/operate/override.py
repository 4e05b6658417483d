"""Choose the action of a primitive task by hand, or let the run choose again."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot override track_ball predict_kalman"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("task", help="a primitive task")
    parser.add_argument("action", nargs="?", help="the action to use from now on")
    parser.add_argument("--free", action="store_true", help="let the run choose again")
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""
    if options.free is (options.action is not None):
        raise CommandError(2, f"name an action for {options.task}, or give --free")

    def data(client: OperatorClient) -> dict[str, Any]:
        selectors = client.state["selectors"]
        task = command.named(selectors, options.task, "primitive task")
        if options.action is not None:
            command.named(
                {one["action"]: one for one in selectors[task]["alternatives"]},
                options.action,
                "alternative",
            )
        return {"primitive_task": task, "action": options.action}

    async def told(client: OperatorClient, answer: command.Answer) -> str:
        return f"{options.task}: {options.action or 'chosen freely again'}"

    return command.give(options, "override_selector", data, told)
