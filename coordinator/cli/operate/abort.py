"""Abort the active run: its actions are cancelled, their devices stop, and it ends in ERROR."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot abort"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""
    return command.give(options, "abort", told=_told)


async def _told(client: OperatorClient, answer: command.Answer) -> str:
    return "aborted: its actions are being stopped"
