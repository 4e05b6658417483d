"""Measures what docs/mobile.md quotes: detectors on rendered floors, and whole runs seed by seed.

python -m tests.mobile.measure detectors python -m tests.mobile.measure runs arcs --speed 0.5
--first 20000 --count 100 --use recover_track=search_pattern
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import load as load_directory
from petrobot.services.mobile.detection import (
    ScanGrid,
    TemplateBank,
    TrackDetector,
    consensus,
    detect_edges,
    detect_ridge,
)
from tests.mobile.conftest import DrawnFloor, DrawnPose, Photographer
from tests.mobile.test_detection import off_line

ROOT = Path(__file__).parents[2]
TASK = ROOT / "coordinator" / "tasks" / "follow_track.toml"
SERVICES = ROOT / "services" / "mobile" / "track.services.toml"
LONGEST = 600.0
"""s of simulated time that a run may take."""
TICK = 0.004
GOOD = 0.012
"""m, median distance from the line, within which a sight counts as right."""


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    detectors = commands.add_parser("detectors")
    detectors.set_defaults(act=measure_detectors)
    runs = commands.add_parser("runs")
    runs.add_argument("regime")
    runs.add_argument("--speed", type=float, default=0.5)
    runs.add_argument("--first", type=int, default=20000)
    runs.add_argument("--count", type=int, default=100)
    runs.add_argument("--use", action="append", default=[])
    runs.set_defaults(act=measure_runs)
    options = parser.parse_args()
    options.act(options)


# --- detectors --------------------------------------------------------------------------------


def measure_detectors(options: argparse.Namespace) -> None:
    """Each detector on the same 240 images of straights and arcs, in four kinds of light."""
    lights = {
        "nominal": Photographer(),
        "noise x5": Photographer(noise=15.0),
        "dim": Photographer(noise=6.0, black=12.0, white=60.0),
        "dark, loud": Photographer(noise=9.0, black=8.0, white=48.0),
    }
    grid = ScanGrid.of(lights["nominal"].view, 1.2)
    print(f"{'detector':12}{'light':12}{'seen and right':>16}{'median mm':>11}{'CPU ms':>8}")
    for name, detector in _detectors().items():
        for light, photographer in lights.items():
            right, off, seconds = _judge(detector, photographer, grid)
            print(f"{name:12}{light:12}{right:16.3f}{1e3 * off:11.1f}{1e3 * seconds:8.2f}")


def _detectors() -> dict[str, TrackDetector]:
    random = np.random.default_rng(3)
    return {
        "edges": detect_edges,
        "ridge": detect_ridge,
        "consensus": consensus(lambda: random),
        "template": TemplateBank(),
    }


def _judge(
    detector: TrackDetector, photographer: Photographer, grid: ScanGrid
) -> tuple[float, float, float]:
    """Share of images with a right line, median distance of its points (m), and CPU time of an
    image (s)."""
    right, off, cpu = 0, [], 0.0
    cases = list(_cases())
    for floor, pose, s, seed in cases:
        image = photographer(floor, pose, np.random.default_rng(seed))
        begun = time.process_time()
        sight = detector(grid, grid.sample(image), 0.05, None)
        cpu += time.process_time() - begun
        if sight.seen:
            median = float(np.median(off_line(sight, floor, pose, s)))
            right += median < GOOD
            off.append(median)
    return right / len(cases), float(np.median(off)) if off else math.nan, cpu / len(cases)


def _cases() -> Iterator[tuple[DrawnFloor, DrawnPose, float, int]]:
    random = np.random.default_rng(11)
    for seed in range(240):
        floor = DrawnFloor(("SSS", "SLS", "SRS", "SLLS", "SRLS", "SSLS")[seed % 6])
        s = float(random.uniform(0.1, 2.9))
        yield (
            floor,
            floor.at(s, float(random.normal(0.0, 0.02)), float(random.normal(0.0, 0.05))),
            s,
            seed,
        )


# --- runs -------------------------------------------------------------------------------------


def measure_runs(options: argparse.Namespace) -> None:
    """One run a seed, as `petrobot run follow_track --mode lockstep --seed S` makes it."""
    chosen = dict(text.split("=", 1) for text in options.use)
    results = []
    for seed in range(options.first, options.first + options.count):
        result, odd = run(seed, {"regime": options.regime, "speed": options.speed}, chosen)
        results.append(result)
        good = "ok " if result["stopped_at_T"] and result["finished"] else "BAD"
        what = [f"{p['kind']} at {p['s']:.1f}" for p in result["penalties"]]
        times = f"{result['sim_s']:6.1f} s, {result['sim_s'] / result['cpu']:3.0f} x"
        print(
            f"{seed} {good} {times}, rms {result['rms_mm']} max {result['max_mm']} mm",
            *what,
            *odd,
            sep=", ",
            flush=True,
        )
    _summary(results)


def run(
    seed: int, parameters: dict[str, Any], chosen: dict[str, str]
) -> tuple[dict[str, Any], list[str]]:
    """A run's result with its CPU time `cpu` (s), and the runs in it that did not end with
    success."""
    setting = Setting(load(TASK), parameters, None, seed, FirstAlternative(chosen))
    cell, party = lockstep_cell(load_directory(SERVICES), setting)
    begun = time.process_time()
    cell.run(lambda: party.over, round(LONGEST / TICK))
    cpu = time.process_time() - begun
    odd = [f"{r.place}: {r.cause}" for r in party.mission.tally.runs if r.cause]
    return {**party.mission.result("lockstep", 0.0), "cpu": cpu}, odd


def _summary(results: Sequence[dict[str, Any]]) -> None:
    count = len(results)
    good = sum(bool(r["finished"] and r["stopped_at_T"]) for r in results)
    low, high = wilson(good, count)
    gaps, recovered = (sum(r[key] for r in results) for key in ("interruptions", "recovered"))
    rms = [r["rms_mm"] for r in results]
    simulated, cpu = (sum(r[key] for r in results) for key in ("sim_s", "cpu"))
    print(
        f"finished and stopped at the T: {good} of {count} ({good / count:.1%}; 95 %: "
        f"{low:.1%} to {high:.1%})"
    )
    print(
        f"interruptions recovered: {recovered} of {gaps}; penalties: "
        f"{sum(len(r['penalties']) for r in results)}"
    )
    print(
        f"cross-track error: rms {np.mean(rms):.1f} mm (largest {max(rms):.1f}), max "
        f"{max(r['max_mm'] for r in results)} mm"
    )
    print(f"time: mean {simulated / count:.1f} s; {simulated / cpu:.1f} x real time by CPU time")


def wilson(good: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    z, p = 1.96, good / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return middle - half, middle + half


if __name__ == "__main__":
    main()
