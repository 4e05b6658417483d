"""Check every promised figure in full and write them to docs/figures.md (`make proof`).

Each result is stored in docs/figures.json with a hash of the sources that it depends on. A proof
whose sources have not changed is not run again, so an interrupted `make proof` continues where it
stopped, on another machine, too. Where they have changed, ten balls of each figure of the catching
cell, or a hundredth of a study, are run again; if all their numbers are as before, the figure
stands. `--only NAME ...` runs some proofs, `--fresh` forgets the stored results, `--jobs K` runs K
at the same time (speeds are always measured alone), `--page` only writes the page.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from tools.proof import catching, convergence, coverage, credit, learning, physics
from tools.proof.page import figures
from tools.proof.proof import KEPT, ROOT, FigureProof

FIGURES = ROOT / "docs" / "figures.md"
MEASURED = FIGURES.with_suffix(".json")


def proofs() -> list[FigureProof]:
    """Return all proofs, those with the most important figures first."""
    return [
        *catching.proofs(),
        *physics.proofs(),
        *convergence.proofs(),
        *coverage.proofs(),
        *learning.proofs(),
        *credit.proofs(),
    ]


def kept() -> dict[str, dict[str, Any]]:
    """Return the last stored results by name, even if the sources have changed since."""
    if not MEASURED.exists():
        return {}
    data: dict[str, dict[str, Any]] = json.loads(MEASURED.read_text(encoding="utf-8"))
    return data


def prove(proof: FigureProof) -> dict[str, Any]:
    """Measure a figure, and check it against its floor."""
    begun, sources = time.monotonic(), proof.fingerprint()
    result = proof.measure()
    return {
        "sources": sources,
        "holds": proof.holds(result),
        "result": dict(result),
        "minutes": round((time.monotonic() - begun) / 60, 1),
        **({"sample": proof.sample()} if proof.sample else {}),
    }


def stands(proof: FigureProof, found: dict[str, dict[str, Any]]) -> bool:
    """Return whether a figure need not be measured; note it if its sample is as it was."""
    data = found.get(proof.name, {})
    if proof.holds_for(data):
        return True
    if proof.sample is None or "sample" not in data or data["sample"] != proof.sample():
        return False
    data["same_at"] = proof.fingerprint()
    return True


def run(todo: Sequence[FigureProof], jobs: int) -> bool:
    """Run these proofs: several at once, then those that measure speed one by one. False if one
    does not hold."""
    good, done, begun = True, 0, time.monotonic()
    together, alone = [p for p in todo if not p.alone], [p for p in todo if p.alone]
    for group, workers in ((together, jobs), (alone, 1)):
        with ThreadPoolExecutor(workers) as pool:
            waiting = {pool.submit(prove, proof): proof for proof in group}
            for future in as_completed(waiting):
                done += 1
                try:
                    data = future.result()
                except Exception as fault:  # the others are measured all the same
                    print(f"{waiting[future].name}: NOT MEASURED: {fault}")
                    good = False
                    continue
                good = good and data["holds"]
                holds = "holds" if data["holds"] else "DOES NOT HOLD"
                togo = (time.monotonic() - begun) / done * (len(todo) - done) / 60
                print(
                    f"[{done}/{len(todo)}, {togo:.0f} min to go] {waiting[future].name}: "
                    f"{holds}: {data['result']}"
                )
                write(kept() | {waiting[future].name: data})
    return good


def write(measured: dict[str, dict[str, Any]]) -> None:
    """Store the results, and write their page."""
    text = json.dumps({name: measured[name] for name in sorted(measured)}, indent=1)
    MEASURED.write_text(text + "\n", encoding="utf-8")
    FIGURES.write_text(figures(proofs(), measured), encoding="utf-8")


def main() -> int:
    """Run the proofs that have no result for the present sources."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", metavar="NAME", nargs="+", help="some proofs")
    parser.add_argument("--fresh", action="store_true", help="forget what is kept")
    parser.add_argument("--jobs", type=int, default=2, help="how many at once (default 2)")
    parser.add_argument(
        "--page", action="store_true", help="only write docs/figures.md from what is kept"
    )
    options = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    KEPT.mkdir(parents=True, exist_ok=True)
    found = kept()
    if options.page:
        write(found)
        return 0
    chosen = [p for p in proofs() if options.only is None or p.name in options.only]
    with ThreadPoolExecutor(options.jobs) as pool:
        kept_ = list(pool.map(lambda proof: not options.fresh and stands(proof, found), chosen))
    todo = [proof for proof, holds in zip(chosen, kept_, strict=True) if not holds]
    write(found)
    old = all(found[p.name]["holds"] for p in chosen if p not in todo)
    print(f"{len(chosen) - len(todo)} kept, {len(todo)} to measure")
    good = run(todo, options.jobs)
    return 0 if good and old else 1


if __name__ == "__main__":
    sys.exit(main())
