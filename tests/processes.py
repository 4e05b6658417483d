"""Processes in tests: who descends from whom, who still runs, and signals to them."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable
from pathlib import Path


def children(process: int) -> set[int]:
    """The processes that this one has started and not reaped; none if it has ended."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
    except OSError:
        return set()
    return {int(child) for child in text.split()}


def parent(process: int) -> int:
    """The parent of a process; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def below(process: int) -> set[int]:
    """All processes that descend from this one."""
    found = children(process)
    return found.union(*map(below, found))


def alive(process: int) -> bool:
    """Whether it still runs (a zombie does not)."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def kill(processes: Iterable[int], how: signal.Signals = signal.SIGKILL) -> None:
    """Send each of them the signal. One that has ended meanwhile gets none: a worker ends with its
    node, whichever of the two the test names first."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, how)
