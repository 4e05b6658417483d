"""Add or remove tokens of a control place: more or fewer runs, another path."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot token runs +2"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("place", help="a control place of the task")
    parser.add_argument("tokens", type=_change, help="how many to add (+2) or to remove (-1)")
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""
    verb = "add_tokens" if options.tokens > 0 else "remove_tokens"

    def data(client: OperatorClient) -> dict[str, Any]:
        place = command.named(client.state["marking"], options.place, "place")
        return {"place": place, "count": abs(options.tokens)}

    async def told(client: OperatorClient, answer: command.Answer) -> str:
        answer["tokens"] = client.state["marking"].get(options.place)
        return f"{options.place} holds {answer['tokens']} tokens"

    return command.give(options, verb, data, told)


def _change(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not value:
        raise argparse.ArgumentTypeError(
            f"expected how many tokens to add or remove, such as +1 or -1, got {text}"
        )
    return value
