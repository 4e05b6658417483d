"""Launch the simulated laboratory on this host (the same as python -m petrobot.sim)."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli.exec import become
from petrobot.coordinator.cli.loading import add_services_argument, services_path

EXAMPLE = "petrobot sim --services services.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    add_services_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Become the laboratory."""
    become("petrobot.sim", "--services", str(services_path(options.services)))
