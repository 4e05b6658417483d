"""Measure the CPU time of the rover's laboratory (not a test): `python
tests/sim/track/measure_track.py [REGIME ...]`.

CPU milliseconds per simulated second while a driver that knows the true state follows the track at
0.5 m/s, by part, with 25 images/s; also the cost of an idle tick, of an image, and of a new
experiment.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[3]), str(Path(__file__).parent)]

IDLE_TICKS, IMAGES = 20_000, 500


def measure(regime: str) -> None:
    """One paragraph of figures."""
    from conftest import ROVER_FILE, RoverBench  # type: ignore[import-not-found]

    from petrobot.sim.track.truth import read_track_site
    from tests.sim.measure_world import TimeMeter

    bench = RoverBench(read_track_site(ROVER_FILE), seed=1, regime=regime)
    begun = time.process_time()
    for seed in range(1, 11):
        bench.lab.serve("laboratory_prepare", {"seed": seed, "regime": regime})
    prepared = (time.process_time() - begun) / 10.0
    bench.enable()
    bench.want_images(25.0)
    lab, meter = bench.lab, TimeMeter()
    meter.watch(lab, "receive", "frames in")
    meter.watch(lab, "advance", "world, frames and images out")
    meter.watch(lab, "picture", "  of it images")
    began = lab.now
    score = bench.follow(0.5)
    seconds = lab.now - began
    print(
        f"{regime}: {seconds:.1f} s simulated, finished {score['finished']}, "
        f"{score['rms_mm']:.1f} mm rms"
    )
    for name, spent in meter.seconds.items():
        print(f"  {name:30s} {1e3 * spent / seconds:6.2f} ms/s")
    print(f"  {'a new experiment':30s} {1e3 * prepared:6.2f} ms")
    _single(bench)


def _single(bench: Any) -> None:
    lab = bench.lab
    del lab.picture  # the method itself again, not its measured stand-in
    for speed in (0.0, 0.5):
        lab.rover.speed = speed
        begun = time.process_time()
        for _ in range(IMAGES):
            lab.picture(lab.rover.now)
        print(
            f"  {f'an image at {speed} m/s':30s} "
            f"{1e6 * (time.process_time() - begun) / IMAGES:6.1f} us"
        )
    lab.exposures.want(lab.now, 0.0, 9)
    begun = time.process_time()
    for _ in range(IDLE_TICKS):
        lab.tick(lab.now)
        lab.take_frames()
    print(
        f"  {'a tick while it stands':30s} "
        f"{1e6 * (time.process_time() - begun) / IDLE_TICKS:6.1f} us"
    )


if __name__ == "__main__":
    for name in sys.argv[1:] or ["mixed", "arcs+flash+slip"]:
        measure(name)
