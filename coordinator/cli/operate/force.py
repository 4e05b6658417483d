"""Fire an outgoing transition of an action place, even while its run is active. The run counts
neither as success nor as failure."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.operate import command

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot force catch_ball missed"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("place", help="an action place of the task")
    parser.add_argument("exit", help="an outgoing transition of that place")
    command.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Give the command, and print the answer."""

    async def told(client: OperatorClient, answer: command.Answer) -> str:
        return f"fired {options.exit}, and took the token out of {options.place}"

    return command.give(options, "force_exit", lambda client: _data(client, options), told)


def _data(client: OperatorClient, options: argparse.Namespace) -> dict[str, Any]:
    arcs = (client.state["task"] or {"arcs": []})["arcs"]
    exits: dict[str, dict[str, None]] = {}
    for arc in arcs:
        if arc["direction"] == "in" and arc.get("end"):
            exits.setdefault(arc["place"], {})[arc["transition"]] = None
    place = command.named(exits, options.place, "action place")
    run_id = next((run["id"] for run in client.state["runs"].values() if run["place"] == place), "")
    return {
        "run": run_id,
        "transition": command.named(exits[place], options.exit, f"outgoing transition of {place}"),
    }
