"""Pause the active run: nothing fires or starts, and each node reports whether its devices hold."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot pause"
WORDS = {
    "held": "holds",
    "cannot_hold": "CANNOT HOLD: its action continues",
    "stopped": "stands still",
    "idle": "runs no action: nothing was asked to hold",
    "lost": "DID NOT ANSWER",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print what each node reports. Return 3 if one did not answer: it could
    not be paused."""
    return command.give(options, "pause", told=_told, code=_code)


def _code(answer: command.Answer) -> int:
    return 3 if "lost" in answer.get("nodes", {}).values() else 0


async def _told(client: OperatorClient, answer: command.Answer) -> str:
    nodes = answer.get("nodes", {})
    lines = [f"  {node:12} {WORDS.get(said, said)}" for node, said in nodes.items()]
    return "\n".join(
        ["paused; next: `petrobot continue`, or `petrobot step` for one firing", *lines]
    )
