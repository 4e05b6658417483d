"""Write a remark into the journal of the active run; it changes nothing."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli.operate import command

EXAMPLE = 'petrobot remark "a visitor touched the table"'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("text", nargs="+", help="one line of at most 1,000 characters")
    command.add_arguments(parser, controls=False)


def run(options: argparse.Namespace) -> int:
    """Remark."""
    return command.give(options, "remark", lambda client: {"text": " ".join(options.text)})
