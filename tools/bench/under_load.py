"""Repeat the tests that start processes while every core is busy, and report how often each failed.

    python -m tools.bench.under_load 20            all tests marked `processes`
    python -m tools.bench.under_load 3 --all       the whole suite
    python -m tools.bench.under_load 5 tests/cli   those of a folder (further arguments go to
                                                   pytest)

Each round runs three tests at a time per core, which mostly wait, beside one busy process per core,
and has a time limit. The output of pytest is kept in reports/under_load. Exit code 1 if a test
failed in any round, or a round reached its limit.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from tools.bench.processes import load

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "reports" / "under_load"
ROUND_LIMIT_S = 3600
BUSY = "import os; parent = os.getppid()\nwhile os.getppid() == parent: sum(range(10_000))"
"""Program of a busy process; it ends by itself when its parent process has ended."""


@contextlib.contextmanager
def busy_cores() -> Iterator[None]:
    """Keep every core busy."""
    burners = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def one_round(number: int, marks: str, chosen: list[str]) -> tuple[int, list[str]]:
    """Run the tests once. Return how many ran, and the names of those that failed."""
    report = KEPT / f"round-{number}.xml"
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n",
        str(3 * (os.cpu_count() or 1)),
        "--dist",
        "worksteal",
        "-m",
        marks,
        f"--junitxml={report}",
        *chosen,
    ]
    with busy_cores(), report.with_suffix(".txt").open("w", encoding="utf-8") as said:
        try:
            done = subprocess.run(
                command, cwd=ROOT, stdout=said, stderr=said, timeout=ROUND_LIMIT_S, check=False
            )
        except subprocess.TimeoutExpired:
            return 0, [f"the whole round (not done after {ROUND_LIMIT_S} s)"]
    if done.returncode not in (0, 1):
        return 0, [f"the whole round (pytest ended with {done.returncode}, see {said.name})"]
    cases = list(ElementTree.parse(report).iter("testcase"))
    ran = [case for case in cases if case.find("skipped") is None]
    failed = {
        f"{c.get('classname')}::{c.get('name')}"
        for c in ran
        if any(c.find(k) is not None for k in ("failure", "error"))
    }
    return len(ran), sorted(failed)


def main() -> int:
    """Repeat, count, report."""
    # so that pytest and the busy processes end too
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rounds", type=int, help="how often to repeat the tests")
    parser.add_argument("--all", action="store_true", help="the whole suite")
    options, chosen = parser.parse_known_args()
    marks = "not proof" if options.all else "processes and not proof"
    rounds = options.rounds
    shutil.rmtree(KEPT, ignore_errors=True)
    KEPT.mkdir(parents=True)
    failures: Counter[str] = Counter()
    for number in range(1, rounds + 1):
        ran, failed = one_round(number, marks, chosen)
        failures.update(failed)
        print(
            f"round {number} of {rounds}: {ran} tests ran, {len(failed)} failed (load {load()})",
            flush=True,
        )
    for name, count in failures.most_common():
        print(f"failed {count} of {rounds}: {name}")
    print(
        f"{'nothing' if not failures else len(failures)} failed in {rounds} rounds; what "
        f"pytest said: {KEPT}"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
