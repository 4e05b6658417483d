"""`python -m experiments.against_trees [--tenth]`: measure what is missing, then print the
tables of docs/experiment.md and draw its pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.against_trees import costs, forecasts, killed, learned, page, verified
from experiments.against_trees.results import FULL, ROOT, TENTH, Results

PARTS = {
    "verified": verified.measure,
    "forecasts": forecasts.measure,
    "learned": learned.measure,
    "costs": costs.measure,
    "killed": killed.measure,
}


def main() -> None:
    """Measure all parts, or those that are named."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.against_trees", description=__doc__
    )
    parser.add_argument("part", nargs="*", help=f"only these of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--tenth", action="store_true", help="a tenth of the size, in 15 minutes")
    parser.add_argument("--workers", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--results", type=Path, metavar="FOLDER", help="where results are kept")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="where pictures are drawn")
    options = parser.parse_args()
    size, name = (TENTH, "tenth") if options.tenth else (FULL, "full")
    results = Results(options.results or ROOT / "reports" / "against_trees" / name)
    for part in options.part or PARTS:
        PARTS[part](results, size, options.workers)
    print(page.tables(results))
    page.draw(results, options.pictures or results.folder)


if __name__ == "__main__":
    main()
