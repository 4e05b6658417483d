"""Processes of a benchmark: started from the same script, one core per process, and quantiles of
what they measure.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def pin(core: int) -> bool:
    """Put this process on one core, ahead of ordinary processes. False where that is not
    permitted."""
    try:
        # A pinned parent passes on its one core, so allow all of them first.
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) < 2:
            return False
        os.sched_setaffinity(0, {cores[core]})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except OSError:
        return False
    return True


def share() -> bool:
    """Put this process and its later children on one core, as ordinary processes. False where that
    is not permitted."""
    if not hasattr(os, "sched_setaffinity"):
        return False
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    return True


def unpin() -> None:
    """Make this an ordinary process on all cores again."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def start(
    script: str, *arguments: str, pinned: bool, python: str = sys.executable
) -> subprocess.Popen[str]:
    """Start the benchmark's script as another process, with another role; its input and output are
    pipes."""
    command = [python, script, *arguments, "--pin" if pinned else "--no-pin"]
    # a checkout that is not installed finds its packages from its own folder
    folder = Path(script).resolve().parents[2]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder
    )


def quantile(values: Sequence[float], q: float) -> float:
    """Return the q-quantile of the measured values."""
    ordered = sorted(values)
    return ordered[min(int(q * len(ordered)), len(ordered) - 1)]


def load() -> str:
    """Return the load averages of this machine over 1, 5 and 15 minutes."""
    return " ".join(f"{one:.2f}" for one in os.getloadavg())


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print a table."""
    columns = list(next(iter(rows.values())))
    print(f"\n{title:28}" + "".join(f"{column:>15}" for column in columns))
    for name, row in rows.items():
        print(f"{name:28}" + "".join(f"{row[column]:15,.2f}" for column in columns))
