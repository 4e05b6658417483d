"""Replay a recorded run: compute every marking and instruction again, and fail at the first
difference."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import add_json_argument, write_json
from petrobot.coordinator.cli.options import recorded

EXAMPLE = "petrobot replay last"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", help="a run's id or folder, or `last`")
    add_json_argument(parser, "the outcome")


def run(options: argparse.Namespace) -> int:
    """Replay. Return 0 if everything is the same, 1 if there is a difference."""
    from petrobot.coordinator.run.recording import ReplayError

    found = recorded(options.run)
    count, firings = 0, 0
    try:
        for step in found.steps():
            count, firings = count + 1, step.state.firings
    except ReplayError as fault:
        raise CommandError(1, str(fault)) from fault
    torn = found.journal.torn_bytes
    outcome = {
        "run": found.journal.header["mission"],
        "stimuli": count,
        "firings": firings,
        "torn_bytes": torn,
        "same": True,
    }
    if options.json:
        write_json(options.json, outcome)
    if options.json != "-":
        tail = f"; a torn tail of {torn} bytes was dropped" if torn else ""
        print(
            f"{outcome['run']}: {count} stimuli and {firings} firings replayed, all as "
            f"recorded{tail}"
        )
    return 0
