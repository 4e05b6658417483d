"""Measure the CPU time that each vision action of the catching cell takes for an image, and print
it as the `compute_time` of services.toml.

    python -m tools.bench.compute [--balls N] [--regime NAME]

Runs the cell in lock step; the alternatives take turns. The time of the simulated camera, which
makes the images, is not counted.
"""

from __future__ import annotations

import argparse
import platform
import statistics
from collections import defaultdict
from pathlib import Path

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import RunEnd
from petrobot.services.comm.location_file import load

ROOT = Path(__file__).parents[2]
MEASURED = ("locate_ball", "track_ball")


def machine() -> str:
    """Name of the processor."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text(encoding="utf-8").splitlines() if cpus.exists() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return f"{next(named, platform.machine())}, Python {platform.python_version()}"


def measured(balls: int, regime: str) -> dict[str, tuple[float, int]]:
    """Return for each action the median CPU seconds per image over its runs, and the number of
    runs."""
    task = load_task("catch_ball")
    selector = LearningSelector(Learning(task, "round_robin"))
    setting = Setting(task, {"regime": regime}, balls, 1, selector)
    cell, party = lockstep_cell(load(ROOT / "services.toml"), setting)
    cell.run(lambda: party.over, 10_000_000)
    spent = defaultdict(list)
    for record in selector.records:
        if isinstance(record, RunEnd) and record.primitive_task in MEASURED:
            images = record.outcome.values.get("images", 0.0)
            if record.outcome.cpu_seconds is not None and images > 0:
                spent[record.action].append(record.outcome.cpu_seconds / images)
    return {name: (statistics.median(times), len(times)) for name, times in spent.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--balls", type=int, default=30, metavar="N", help="(%(default)s)")
    parser.add_argument("--regime", default="B", help="(%(default)s)")
    options = parser.parse_args()
    print(f"# {machine()}; {options.balls} balls of regime {options.regime}")
    for name, (seconds, runs) in sorted(measured(options.balls, options.regime).items()):
        print(f"{name:28}compute_time = {seconds:.2g}  # s an image, median of {runs} runs")


if __name__ == "__main__":
    main()
