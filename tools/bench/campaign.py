"""Measure what a campaign adds to its cells: CPU seconds per trial in a block and in a bare
lock-step cell with the same seeds, alternating.

    python -m tools.bench.campaign [--trials N] [--rounds N]
    python -m tools.bench.campaign --against ../older   the bare cell beside another checkout's

The first round of each fills caches and is not counted. The other checkout has its own `.venv`; its
bench may be in `tests/bench`. Both run in turns, each time in a new process.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from pathlib import Path

from msgspec.structs import replace

from petrobot.coordinator.cli.loading import task_path
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.studies.campaign.block import LoadedPlan, run_block
from petrobot.coordinator.studies.campaign.plan import CampaignPlan

ROOT = Path(__file__).parents[2]


def bare(bench: LoadedPlan, seed: int, trials: int) -> float:
    """Return the CPU seconds of `petrobot run` without its terminal and report."""
    begun = time.process_time()
    cell, party = lockstep_cell(bench.directory, Setting(bench.task, {"regime": "B"}, trials, seed))
    cell.run(lambda: party.over, 10_000_000)
    return time.process_time() - begun


def block(bench: LoadedPlan, seed: int, trials: int) -> float:
    """Return the CPU seconds of the same trials as a campaign's block."""
    begun = time.process_time()
    one = replace(bench.plan.blocks[0], seed=seed, count=trials)
    run_block(bench, one, [{}] * trials)
    return time.process_time() - begun


def told(python: Path | str, folder: Path) -> float:
    """Return the CPU seconds of a trial in a bare cell that the bench of a checkout prints."""
    where = "tools" if (folder / "tools" / "bench").exists() else "tests"
    command = [str(python), "-m", f"{where}.bench.campaign", "--rounds", "1"]
    text = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout
    (line,) = (line for line in text.splitlines() if line.startswith("bare cell"))
    return float(line.split()[2])


def against(older: Path, rounds: int) -> None:
    """Print how many times faster the bare cell is than that of another checkout."""
    ratios = []
    for _ in range(rounds):
        before, now = told(older.resolve() / ".venv/bin/python", older), told(sys.executable, ROOT)
        ratios.append(before / now)
        print(f"older {before:.4f}, now {now:.4f} CPU s a trial, {before / now:.3f} times as fast")
    print(f"median {statistics.median(ratios):.3f}")


def main() -> None:
    """Print both and their ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--trials", type=int, default=4, metavar="N", help="in each cell (%(default)s)"
    )
    parser.add_argument(
        "--rounds", type=int, default=3, metavar="N", help="that count (%(default)s)"
    )
    parser.add_argument("--against", type=Path, metavar="FOLDER", help="another checkout")
    options = parser.parse_args()
    if options.against is not None:
        against(options.against, options.rounds)
        return
    bench = LoadedPlan.of(
        CampaignPlan(
            str(task_path("catch_ball")),
            str(ROOT / "services.toml"),
            options.trials,
            ("B",),
            block=options.trials,
        )
    )
    times: dict[str, list[float]] = {"bare cell": [], "campaign block": []}
    for seed in range(1, options.rounds + 2):
        times["bare cell"].append(bare(bench, seed, options.trials) / options.trials)
        times["campaign block"].append(block(bench, seed, options.trials) / options.trials)
    for name, spent in times.items():
        print(f"{name:16}{statistics.mean(spent[1:]):.4f} CPU s a trial")
    ratios = [b / a for a, b in zip(*(spent[1:] for spent in times.values()), strict=True)]
    print(f"{'ratio':16}{statistics.mean(ratios):.3f}  ({', '.join(f'{r:.3f}' for r in ratios)})")


if __name__ == "__main__":
    main()
