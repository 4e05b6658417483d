"""Fire one transition of a paused run, or pause an active one after its next firing."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot step"
PATIENCE = 2.0
"""How long to wait for the firing before the answer says that it is still to come (s)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print which transition fired."""
    seen = 0

    def look(client: OperatorClient) -> dict[str, object]:
        nonlocal seen
        seen = int(client.state["mission"].get("firings", 0))
        return {}

    async def told(client: OperatorClient, answer: command.Answer) -> str:
        if not await client.until(
            lambda state: state["mission"].get("firings", 0) > seen, PATIENCE
        ):
            return "no transition can fire yet; the run will pause after the next firing"
        firing = client.state["firings"][-1]
        answer["firing"] = firing
        return f"fired {firing['transition']} ({firing['cause']})"

    return command.give(options, "step", look, told)
