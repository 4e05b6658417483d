"""Continue the paused run. (`petrobot resume RUN` is for a run whose coordinator was killed.)"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot continue"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""
    return command.give(options, "resume", told=_told)


async def _told(client: OperatorClient, answer: command.Answer) -> str:
    return "continues"
