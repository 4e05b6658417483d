"""Write a remark into the journal of the active run; it changes nothing."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli.operate import hand

EXAMPLE = 'petrobot remark "a visitor touched the table"'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("text", help="one line of at most 1,000 characters")
    hand.add_arguments(parser, controls=False)


def run(options: argparse.Namespace) -> int:
    """Remark."""
    return hand.give(options, "remark", lambda client: {"text": options.text})
