"""Folders of mission runs: where a journal is kept, how a run is named on the command line, and
which old runs are removed."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from petrobot.services.host.toml_text import InputError

_INSTALLED = Path(__file__).parents[2]

JOURNAL = "run.journal"
RESULT = "result.json"
DEFAULT = Path("runs")
NODE_LOGS = DEFAULT / "logs"
"""Folder of the logs of the programs that are started for a run, a file for each."""
SEMANTICS = 6
"""The rules by which this engine executes a net, in the header of each journal (key `semantics`).

1 (and no such key): after 1,000 firings without time the net pauses. 2: endless firing ends in
ERROR. 3: every dead end is reported. 4: conflicts over a token are decided first come, first
served, before the order in the file. 5: a variable that lists its `values` takes no other. 6: what
goes first in a step takes no token of a higher priority. A journal is replayed and resumed under
its own rules (`recording.as_recorded`).
"""


class NoRunError(InputError):
    """There is no such mission run; the text names those that exist."""


def header(
    mission: str, task: str, services: str, mode: str, rest: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a journal's header: the texts of task file and services.toml, versions, and all
    settings of the run."""
    return {
        "mission": mission,
        "task": task,
        "services": services,
        "mode": mode,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"petrobot": version("petrobot"), "python": platform.python_version()},
        "semantics": SEMANTICS,
        **rest,
    }


def journal_of(name: str, folder: Path = DEFAULT) -> Path:
    """Return the journal of a run, given by its id, its folder, its journal's path, or `last`.
    Raises NoRunError."""
    path = Path(name)
    candidates = [path, path / JOURNAL, folder / name / JOURNAL]
    if name == "last":
        candidates = sorted(folder.glob(f"*/{JOURNAL}"), key=lambda p: p.stat().st_mtime)[-1:]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    known = sorted(p.parent.name for p in folder.glob(f"*/{JOURNAL}"))
    there = f"{folder.absolute()} holds no run; change to the folder where it was started"
    if known:
        there = f"runs in {folder}: {', '.join(known[-8:])}"
    raise NoRunError(f"no run {name!r}; {there}")


def retain(folder: Path, keep: int) -> list[str]:
    """Remove the oldest finished runs, keep the newest `keep`, and return the removed names. A run
    without a result is never removed."""
    ended = sorted(
        (p for p in folder.glob(f"*/{RESULT}") if (p.parent / JOURNAL).exists()),
        key=lambda p: p.stat().st_mtime,
    )
    removed = [path.parent for path in ended[: max(0, len(ended) - keep)]]
    for path in removed:
        shutil.rmtree(path)
    return [path.name for path in removed]


SKEW = 60 * 10**9
"""How far another computer's clock, such as a file server's, may be ahead (ns)."""


def date_back(folder: Path) -> None:
    """Call it when a run begins and when it ends. Files from the future are of earlier runs, from
    before the clock was set back: date them before this run, in their order. Otherwise one of them
    would remain the newest run, and `retain` would remove the new ones."""
    dated: list[tuple[int, Path]] = []
    for name in (JOURNAL, RESULT):
        for path in folder.glob(f"*/{name}"):
            with contextlib.suppress(OSError):
                dated.append((path.stat().st_mtime_ns, path))
    now = time.time_ns()
    late = sorted((at, path) for at, path in dated if at > now + SKEW)
    for number, (_, path) in enumerate(late):
        with contextlib.suppress(OSError):  # it belongs to another user
            os.utime(path, ns=(now - SKEW + number,) * 2)


def still_there(path: Path) -> Path:
    """Return the path, or, if old records name a shipped file of an installation that is gone, that
    file in this installation."""
    if path.exists():
        return path
    tails = (_INSTALLED.joinpath(*path.parts[n:]) for n in range(1, len(path.parts) - 1))
    return next((tail for tail in tails if tail.exists()), path)
