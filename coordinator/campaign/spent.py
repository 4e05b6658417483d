"""What a campaign took, beside its table: a row for each block (times.csv) and one for each session
(sessions.csv)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from petrobot.coordinator.campaign.plan import Block
from petrobot.services.comm.whole_file import write_whole

TIMES = "times.csv"
TIME_COLUMNS = ("block", "worker", "cpu_s", "wall_s", "mission_s", "rss_mb")
SESSIONS = "sessions.csv"
SESSION_COLUMNS = ("began_at", "workers", "wall_s", "blocks", "lost")


def note_block(folder: Path, block: Block, result: Mapping[str, Any]) -> None:
    """Append what a block took: process id, CPU time, wall time and simulated time (s), memory
    (MB)."""
    took = [
        block.index,
        *(result[name] for name in ("pid", "cpu_s", "wall_s", "mission_s", "rss_mb")),
    ]
    _append(folder / TIMES, TIME_COLUMNS, [took])


def note_sessions(folder: Path, sessions: Iterable[Mapping[str, Any]]) -> None:
    """Write all sessions at once, so that a kill leaves the old file or the new one."""
    rows = [[session[name] for name in SESSION_COLUMNS] for session in sessions]
    write_whole(folder / SESSIONS, _lines([SESSION_COLUMNS, *rows]))


def times(folder: Path) -> list[dict[str, str]]:
    """What the blocks took, in the order they ended; a block that was done again stands there
    twice."""
    return _read(folder / TIMES)


def sessions(folder: Path) -> list[dict[str, str]]:
    """The sessions so far, the first one first."""
    return _read(folder / SESSIONS)


def began(folder: Path) -> str | None:
    """When a campaign's first session began (UTC, ISO 8601); None if it is not known."""
    known = sessions(folder)
    return known[0]["began_at"] if known else None


def _append(path: Path, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Not synced: what a block took is told, and nothing follows from it."""
    rows = rows if path.exists() else [names, *rows]
    with path.open("a", encoding="utf-8", newline="") as file:
        file.write(_lines(rows))


def _lines(rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
