"""Simulate a net many times with random times and choices: mean times and probabilities with
confidence intervals."""

from __future__ import annotations

import argparse
from typing import Any

from petrobot.coordinator.cli.loading import (
    add_estimates_argument,
    add_json_argument,
    add_seed_argument,
    add_services_argument,
    cell_finder,
    measurements,
    task_path,
    told_if_slow,
)
from petrobot.services.host.command_line import number, whole

EXAMPLE = "petrobot simulate catch_ball --replicas 2000 --seed 1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "file", help="a net or task file, or the name of a task that comes with petrobot"
    )
    parser.add_argument(
        "--rates",
        metavar="FILE",
        help="a rates file, or the word unit, for a net without rates of its own",
    )
    parser.add_argument(
        "--replicas",
        type=whole(),
        default=1000,
        metavar="N",
        help="number of simulations (default: %(default)s)",
    )
    parser.add_argument(
        "--horizon",
        type=number(above=0.0),
        metavar="S",
        help="stop each simulation after S simulated seconds; needed for a net that never ends",
    )
    add_seed_argument(parser)
    add_estimates_argument(parser)
    add_services_argument(parser)
    parser.add_argument(
        "--what-if",
        "-w",
        action="append",
        default=[],
        metavar="CHANGE",
        help="a change, written as for `petrobot analyse`; may be repeated",
    )
    add_json_argument(parser, "the answer")


def run(options: argparse.Namespace) -> int:
    """Simulate the net; print and write the answer."""
    import numpy as np

    from petrobot.coordinator.analysis.commands import simulate_command
    from petrobot.coordinator.cli.analyse import bounded, give

    random = np.random.default_rng(options.seed)
    given: dict[str, Any] = {
        "rates": options.rates,
        "replicas": options.replicas,
        "horizon": options.horizon,
    }
    given["changes"] = options.what_if
    given["measure"] = measurements(options.estimates)
    given["cell_of"] = cell_finder(options.services, options.file)
    with (
        bounded(options.file),
        told_if_slow(f"simulating {options.replicas} replicas (fewer: --replicas)"),
    ):
        found = simulate_command(task_path(options.file), random, **given)
    return give(found, options.json)
