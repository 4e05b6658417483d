"""Let a paused run go on for one firing, or stop a running one after the next."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from petrobot.coordinator.cli.operate import hand

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot step"
PATIENCE = 2.0
"""Seconds to wait for the firing before it is said that it is still to come."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    hand.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Step."""
    seen = 0

    def look(client: OperatorClient) -> dict[str, object]:
        nonlocal seen
        seen = int(client.state["mission"].get("firings", 0))
        return {}

    async def told(client: OperatorClient, answer: hand.Answer) -> str:
        if not await client.until(
            lambda state: state["mission"].get("firings", 0) > seen, PATIENCE
        ):
            return "it goes on until something can fire, and pauses then"
        firing = client.state["firings"][-1]
        answer["firing"] = firing
        return f"fired {firing['transition']} ({firing['cause']})"

    return hand.give(options, "step", look, told)
