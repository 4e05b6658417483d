"""Measure the CPU time of the laboratory (not a test): `python tests/sim/measure_world.py [REGIME
...]`.

CPU milliseconds per simulated second over whole cycles (wait, throw, catch, empty, home), by part,
without images and with 50 images/s; also the machine's current speed, as the time of a fixed piece
of Python.
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
    """Return the CPU seconds of two million additions, best of five: the current speed of this
    core."""
    best = 1e9
    for _ in range(5):
        begun, total = time.process_time(), 0
        for number in range(2_000_000):
            total += number
        best = min(best, time.process_time() - begun)
    return best


class TimeMeter:
    """Adds up the CPU time of methods, including the functions that they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def watch(self, thing: object, method: str, name: str) -> None:
        """Measure a method of an object under a name."""
        original: Callable[..., Any] = getattr(thing, method)

        def measured(*arguments: Any) -> Any:
            begun = time.process_time()
            try:
                return original(*arguments)
            finally:
                self.seconds[name] += time.process_time() - begun

        setattr(thing, method, measured)


def measure(regime: str, rate: float, parts: bool) -> None:
    """One line of figures."""
    from conftest import CELL_FILE, Bench  # type: ignore[import-not-found]

    from petrobot.sim.catching.site import read_site

    bench, meter = Bench(read_site(CELL_FILE), seed=1, regime=regime), TimeMeter()
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
    outcomes: Counter[str] = Counter()
    cycles = []
    for _ in range(CYCLES):
        begun, simulated, before = time.process_time(), bench.now, dict(meter.seconds)
        outcomes[bench.catch_one()["outcome"]] += 1
        simulated = bench.now - simulated
        spent = {
            name: 1000 * (s - before.get(name, 0.0)) / simulated
            for name, s in meter.seconds.items()
        }
        cycles.append((1000 * (time.process_time() - begun) / simulated, simulated, spent))
    lab.close()
    # Other programs slow a whole cycle down: the least disturbed cycle is the most informative.
    cost, simulated, spent = min(cycles, key=lambda cycle: cycle[0])
    told = ", ".join(f"{name} {value:.1f}" for name, value in spent.items())
    print(
        f"{regime}, {rate:g} images/s: cycle {simulated:.2f} s, {cost:.1f} ms CPU/s "
        f"({1000 / cost:.1f}x real time with a "
        f"test master; median {sorted(c[0] for c in cycles)[CYCLES // 2]:.1f}), {dict(outcomes)}"
        + (f"\n    of it (ms/s): {told}" if told else "")
    )


if __name__ == "__main__":
    print(f"reference {1000 * reference():.0f} ms (2 M additions)")
    for name in sys.argv[1:] or ["A", "B", "C"]:
        measure(name, 0.001, True)
        measure(name, 0.001, False)
        measure(name, 50.0, False)
    print(f"reference {1000 * reference():.0f} ms")
