"""The port of the operator's page: how it is given, and what is said when it cannot be had."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from petrobot.coordinator.cli import CommandError


def add_page_port_argument(parser: argparse.ArgumentParser) -> None:
    """`--page-port`."""
    parser.add_argument(
        "--page-port",
        type=_port,
        default=0,
        metavar="PORT",
        help="the page's port (default: a free one)",
    )


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(
            f"{text} is no port: give a number from 1 to 65535, or 0 for a free one"
        )
    return int(text)


@contextmanager
def named_port(port: int) -> Iterator[None]:
    """Around the start of a page. Raises CommandError (2) when its port cannot be had."""
    try:
        yield
    except OSError as fault:
        raise CommandError(
            2, f"port {port}: {fault.strerror or fault}; choose another with --page-port"
        ) from fault
