"""Processes of a benchmark: started from the same script, one core per process, and quantiles of
what they measure.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence


def pin(core: int) -> bool:
    """Put this process on one core, ahead of ordinary processes. False where that is not
    permitted."""
    try:
        os.sched_setaffinity(
            0, range(os.cpu_count() or 1)
        )  # a parent that is pinned itself has left it one core only
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) < 2:
            return False
        os.sched_setaffinity(0, {cores[core]})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except OSError:
        return False
    return True


def share() -> bool:
    """Put this process, and all that it starts from now on, on one core, as ordinary processes.
    False where that cannot be."""
    if not hasattr(os, "sched_setaffinity"):
        return False
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    return True


def unpin() -> None:
    """Back among ordinary processes, on all cores, as anybody's process is run."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def start(
    script: str, *arguments: str, pinned: bool, python: str = sys.executable
) -> subprocess.Popen[str]:
    """A script of the benchmark again, in another part; its input and its output are pipes."""
    command = [python, script, *arguments, "--pin" if pinned else "--no-pin"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def quantile(values: Sequence[float], q: float) -> float:
    """The q-quantile of what was measured."""
    ordered = sorted(values)
    return ordered[min(int(q * len(ordered)), len(ordered) - 1)]


def load() -> str:
    """How busy this machine is: the load averages of 1, 5 and 15 minutes."""
    return " ".join(f"{one:.2f}" for one in os.getloadavg())


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print a table."""
    columns = list(next(iter(rows.values())))
    print(f"\n{title:28}" + "".join(f"{column:>15}" for column in columns))
    for name, row in rows.items():
        print(f"{name:28}" + "".join(f"{row[column]:15,.2f}" for column in columns))
