"""Start one node of services.toml on this host (the same as python -m petrobot.services NAME)."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from petrobot.coordinator.cli.loading import add_services_argument, services_path
from petrobot.coordinator.cli.options import add_log_level_argument

EXAMPLE = "petrobot node vision --services services.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("name", help="the node's name in services.toml")
    add_services_argument(parser)
    add_log_level_argument(parser, "info")


def run(options: argparse.Namespace) -> int:
    """Become the node."""
    become(
        "petrobot.services",
        options.name,
        "--services",
        str(services_path(options.services)),
        "--log-level",
        options.log_level,
    )


def become(module: str, *arguments: str) -> NoReturn:
    """Replace this process by `python -m module arguments`. A child process would survive when its
    parent is killed."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
