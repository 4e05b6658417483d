"""Measures what the laboratory costs: `python tests/sim/measure_world.py [REGIME ...]`; no test, figures for people.

CPU milliseconds for a simulated second over whole cycles (wait, throw, catch, empty, home), by part, without images and
with 50 images a second; beside it the machine's speed in this moment, as the time of a fixed piece of Python.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent)]

CYCLES = 10


def reference() -> float:
    """CPU seconds of two million additions, best of five: how fast this core is just now."""
    best = 1e9
    for _ in range(5):
        begun, total = time.process_time(), 0
        for number in range(2_000_000):
            total += number
        best = min(best, time.process_time() - begun)
    return best


class Meter:
    """Adds up the wall time that methods take, with what they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def watch(self, thing: object, method: str, name: str) -> None:
        """Measure a method of an object under a name."""
        original: Callable[..., Any] = getattr(thing, method)

        def measured(*arguments: Any) -> Any:
            begun = time.perf_counter()
            try:
                return original(*arguments)
            finally:
                self.seconds[name] += time.perf_counter() - begun

        setattr(thing, method, measured)


def measure(regime: str, rate: float, parts: bool) -> None:
    """One line of figures."""
    from conftest import CELL_FILE, Bench  # type: ignore[import-not-found]

    from sim.site import read_site

    bench, meter = Bench(read_site(CELL_FILE), seed=1, regime=regime), Meter()
    lab = bench.lab
    bench.enable()
    bench.want_images(rate)
    bench.catch_one()
    if parts:
        for thing, method, name in (
            (lab.plant, "step", "arm"),
            (lab.bus, "step", "arm and drives"),
            (lab, "receive", "frames in"),
            (lab.world, "begin", "ball"),
            (lab.world, "fine_step", "ball"),
            (lab.world, "end", "ball"),
            (lab, "_cup_now", "cup pose"),
            (lab.referee, "enter", "oracle"),
        ):
            meter.watch(thing, method, name)
    begun, simulated = time.process_time(), bench.now
    rows = [bench.catch_one() for _ in range(CYCLES)]
    cpu, simulated = time.process_time() - begun, bench.now - simulated
    lab.close()
    told = ", ".join(f"{name} {1000 * s / simulated:.1f}" for name, s in meter.seconds.items())
    outcomes = dict(Counter(row["outcome"] for row in rows))
    print(
        f"{regime}, {rate:g} images/s: cycle {simulated / CYCLES:.2f} s, {1000 * cpu / simulated:.1f} ms CPU/s "
        f"({simulated / cpu:.1f}x real time with a test master), {outcomes}"
        + (f"\n    of it (ms/s): {told}" if told else "")
    )


if __name__ == "__main__":
    print(f"reference {1000 * reference():.0f} ms (2 M additions)")
    for name in sys.argv[1:] or ["A", "B", "C"]:
        measure(name, 0.001, True)
        measure(name, 0.001, False)
        measure(name, 50.0, False)
    print(f"reference {1000 * reference():.0f} ms")
