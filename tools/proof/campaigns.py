"""Campaigns that proofs need, and the required figures of campaigns: speed, constant memory, the
same table after a kill.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from msgspec import Struct
from tools.proof.proof import ROOT

from petrobot.coordinator.studies.campaign.table import TABLE, TrialRow, read_table
from tests.waiting import Limit

FAST = 15.0
"""Floor of the speed: simulated seconds per second and core."""
GROWTH_MB = 5.0
"""Most memory that a worker may gain between its first blocks and its last ones (MiB)."""
GROWTH = 0.05
"""Share by which a later worker may need more memory than the first ones. Workers are replaced from
time to time, so memory that native libraries never free does not add up during a long campaign."""

Result = dict[str, Any]


class Sizes(Struct, frozen=True):
    """Sizes of the campaigns; the full proof has share 1."""

    share: float
    workers: int
    folder: Path
    task: str = "catch_ball"
    services: Path | None = None

    @property
    def given(self) -> tuple[str, ...]:
        """Return the options of every campaign."""
        return (
            self.task,
            *(("--services", str(self.services)) if self.services else ()),
            "--quiet",
        )

    def of(self, throws: int, least: int = 20) -> int:
        """Return a number of throws, scaled by the share."""
        return max(least, round(throws * self.share))


def petrobot(*arguments: str, codes: Sequence[int] = (0,)) -> None:
    """Run a command. Raises RuntimeError with its output if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "petrobot.coordinator", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in codes:
        raise RuntimeError(
            f"petrobot {' '.join(arguments)}: exit "
            f"{done.returncode}\n{done.stdout[-1000:]}{done.stderr[-2000:]}"
        )


def campaign(sizes: Sizes, name: str, throws: int, seed: int, regime: str, *more: str) -> Result:
    """Return the result of a campaign in its folder; run it unless it is there already."""
    folder = sizes.folder / name
    path = folder / "result.json"
    if path.exists() and json.loads(path.read_text(encoding="utf-8"))["begun"]:
        kept: Result = json.loads(path.read_text(encoding="utf-8"))
        if (kept["runs"], kept["seed"], ",".join(kept["regimes"])) == (throws, seed, regime):
            return kept
    print(f"  {name}: {throws} throws of {regime}, seed {seed}", flush=True)
    given = ("--runs", str(throws), "--seed", str(seed), "--regime", regime, "--out", str(folder))
    petrobot("campaign", *sizes.given, *given, "--workers", str(sizes.workers), *more)
    result: Result = json.loads(path.read_text(encoding="utf-8"))
    return result


def rows_of(sizes: Sizes, name: str) -> list[TrialRow]:
    """Return the table of a campaign."""
    return list(read_table(sizes.folder / name / TABLE))


def speed(sizes: Sizes, options: argparse.Namespace) -> Result:
    """Measure the speed of a campaign, the memory of its workers, and whether a campaign that is
    killed several times gives the same table."""
    found = campaign(sizes, "speed", sizes.of(1000), 80, options.regimes.split(",")[0])
    peaks = largest_memory(sizes.folder / "speed" / "times.csv")
    first, later = max(peaks[: found["workers"]]), max(peaks[found["workers"] :], default=None)
    gained = memory_gained(sizes.folder / "speed" / "times.csv")
    flat = gained <= GROWTH_MB and (later is None or later <= (1.0 + GROWTH) * first)
    same, kills = interrupted(sizes, sizes.of(120, 24), options.regimes.split(",")[0])
    holds = found["times_real_time_per_core"] >= FAST and flat and same
    return {
        "throws": found["begun"],
        "workers": found["workers"],
        "cycle (s)": round(found["sim_s"] / found["begun"], 3),
        "minutes": round(found["wall_s"] / 60, 2),
        "times real time a core": found["times_real_time_per_core"],
        "times real time a CPU second": found["times_real_time_per_cpu_s"],
        "largest memory of the first workers (MiB)": first,
        "of the later ones (MiB)": "there were none" if later is None else later,
        "gained by a worker in its life (MiB)": gained,
        "killed": kills,
        "same table when killed": same,
        "holds": holds,
    }


def memory_gained(times: Path) -> float:
    """Return the largest gain of a worker (MiB), from the median of its third to eighth block to
    the median of its last six."""
    by_worker: dict[str, list[float]] = {}
    with times.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            by_worker.setdefault(row["worker"], []).append(float(row["rss_mb"]))
    gains = [median(rss[-6:]) - median(rss[2:8]) for rss in by_worker.values() if len(rss) >= 16]
    return round(max(gains, default=0.0), 1)


def largest_memory(times: Path) -> list[float]:
    """Return the largest memory of each worker (MiB), in the order in which they began."""
    by_worker: dict[str, float] = {}
    with times.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            by_worker[row["worker"]] = max(by_worker.get(row["worker"], 0.0), float(row["rss_mb"]))
    return list(by_worker.values())


def interrupted(sizes: Sizes, throws: int, regime: str) -> tuple[bool, int]:
    """Return whether a campaign that is killed several times gives the same table as one that is
    not, and how often it was killed."""
    chosen = ("--seed", "81", "--regime", regime, "--selector", "nikolic_fu_fast")
    given = (*sizes.given, "--runs", str(throws), *chosen)
    whole, part = sizes.folder / "whole", sizes.folder / "killed"
    for folder in (whole, part):
        shutil.rmtree(folder, ignore_errors=True)
    petrobot("campaign", *given, "--workers", str(sizes.workers), "--out", str(whole))
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "campaign",
        *given,
        "--workers",
        "1",
        "--out",
        str(part),
    ]
    chance, kills = random.Random(1), 0
    table = part / TABLE
    while kills < 4:
        going = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wanted = (table.stat().st_size if table.exists() else 0) + chance.randint(1, 20_000)
        limit = Limit("the next rows of the table", 3600.0)
        while (
            going.poll() is None
            and limit.left()
            and not (table.exists() and table.stat().st_size >= wanted)
        ):
            time.sleep(0.02)
        if going.poll() is not None:
            break
        going.send_signal(signal.SIGKILL)
        going.wait()
        kills += 1
    petrobot("campaign", *given, "--workers", str(sizes.workers), "--out", str(part))
    return (whole / TABLE).read_bytes() == table.read_bytes(), kills
