"""Measure how well the finders find parts: `python -m tests.picking.measure [REGIME ...]`."""

from __future__ import annotations

import math
import sys
import time

import numpy as np

from petrobot.services.picking.model import cell_named
from petrobot.services.picking.seeing import FINDERS
from tests.sim.picking.bench import scene

SEEDS, NEAR = range(1000, 1040), 0.008


def main(regimes: list[str]) -> None:
    """Print a row for each regime and finder: share of parts found within 8 mm, of these the share
    with the right kind, mean error (mm), false parts an image, CPU time (ms) an image."""
    cell = cell_named()
    for regime in regimes:
        for name, find in FINDERS.items():
            errors, kinds, count, false, spent = [], 0, 0, 0, 0.0
            for seed in SEEDS:
                parts, image = scene(seed, regime)
                begin = time.process_time()
                found = find(image, cell)
                spent += time.process_time() - begin
                count += len(parts)
                for part in parts:
                    if not found:
                        continue
                    x, y = part.x, part.y
                    near = min(found, key=lambda f: math.hypot(f.x - x, f.y - y))
                    away = math.hypot(near.x - part.x, near.y - part.y)
                    if away < NEAR:
                        errors.append(1e3 * away)
                        kinds += near.kind == part.kind
                false += sum(
                    all(math.hypot(f.x - p.x, f.y - p.y) >= NEAR for p in parts) for f in found
                )
            print(
                f"| `{regime}` | {name} | {len(errors) / count:.1%} | {kinds / len(errors):.1%} "
                f"| {np.mean(errors):.1f} | {false / len(SEEDS):.2f} "
                f"| {1e3 * spent / len(SEEDS):.1f} |"
            )


if __name__ == "__main__":
    main(sys.argv[1:] or ["plain", "plain+dim", "plain+shadow", "plain+person"])
