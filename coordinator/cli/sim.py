"""Start the simulated laboratory on this host (the same as python -m petrobot.sim)."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli.loading import add_services_argument, services_path
from petrobot.coordinator.cli.node import become
from petrobot.coordinator.cli.options import add_log_level_argument

EXAMPLE = "petrobot sim --services services.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_services_argument(parser)
    add_log_level_argument(parser, "info")


def run(options: argparse.Namespace) -> int:
    """Become the laboratory."""
    services = str(services_path(options.services))
    become("petrobot.sim", "--services", services, "--log-level", options.log_level)
