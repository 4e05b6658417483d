"""The table of a campaign on disk: one CSV file that grows only by whole blocks, in order, so that
an interrupted campaign can continue."""

from __future__ import annotations

import csv
import fcntl
import importlib
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from petrobot.coordinator.studies.campaign.plan import TABLE as TABLE
from petrobot.coordinator.studies.campaign.plan import Block, CampaignError
from petrobot.coordinator.studies.campaign.rows import TrialRow, cells, columns, read_row
from petrobot.coordinator.task import Task
from petrobot.services.host.whole_file import sync_folder, write_whole

PARQUET = "table.parquet"


class CampaignTable:
    """The table of a campaign in its folder."""

    def __init__(self, folder: Path, task: Task) -> None:
        self.path = folder / TABLE
        self._task = task
        self._columns: list[str] | None = None

    def recover(self, blocks: Sequence[Block]) -> int:
        """Remove incomplete blocks that an interruption left, and return the number of complete
        ones. Raises CampaignError."""
        if not self.path.exists():
            return 0
        ends = _record_ends(self.path)
        header = next(ends, None)
        if header is None:
            self.path.unlink()
            return 0
        done, end, trials = 0, header, 0
        for block in blocks:
            last = None
            while trials < block.first + block.count and (last := next(ends, None)) is not None:
                trials += 1
            if last is None:
                break
            done, end = done + 1, last
        with self.path.open("r+b") as file:
            self._columns = next(csv.reader(io.StringIO(file.read(header).decode("utf-8"))))
            file.truncate(end)
        return done

    def append(self, rows: Sequence[TrialRow]) -> None:
        """Append the rows of a block; they are on disk when this returns."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        if self._columns is None:
            self._columns = columns(self._task, rows)
            writer.writerow(self._columns)
        for row in rows:
            writer.writerow(cells(self._task, row, self._columns))
        first = not self.path.exists()
        with self.path.open("ab") as file:
            file.write(out.getvalue().encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())
        if first:
            sync_folder(self.path.parent)

    def rows(self) -> Iterator[TrialRow]:
        """Yield all rows."""
        return read_table(self.path) if self.path.exists() else iter(())


def read_table(path: Path) -> Iterator[TrialRow]:
    """Yield the rows of a table. Raises CampaignError naming the line that cannot be read."""
    csv.field_size_limit(1 << 26)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for number, record in enumerate(csv.DictReader(file), 2):
                try:
                    yield read_row(record)
                except (KeyError, ValueError, TypeError) as fault:
                    raise CampaignError(
                        f"{path}: line {number}: not a row of a campaign: {fault!r}"
                    ) from fault
    except OSError as fault:
        raise CampaignError(f"{path}: {fault.strerror or fault}") from fault


def _record_ends(path: Path) -> Iterator[int]:
    """Yield the byte offset after each complete record: after a newline outside quotes."""
    quoted, end = False, 0
    with path.open("rb") as file:
        for line in file:
            end += len(line)
            quoted ^= line.count(b'"') % 2 == 1
            if not quoted and line.endswith(b"\n"):
                yield end


def write_parquet(folder: Path) -> Path | None:
    """Write the table as Parquet beside the CSV file; None if pyarrow is not installed."""
    try:
        arrow_csv: Any = importlib.import_module("pyarrow.csv")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        return None
    target = folder / PARQUET
    options = arrow_csv.ParseOptions(newlines_in_values=True)
    parquet.write_table(arrow_csv.read_csv(folder / TABLE, parse_options=options), target)
    return target


# --- lock ---

# Only one process at a time writes a campaign's folder. If it is killed, the operating system
# releases its lock.

LOCK = "running.lock"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the folder's lock. Raises CampaignError if another process holds it, or if the folder
    cannot be written."""
    try:
        file = (folder / LOCK).open("a+", encoding="ascii")
    except OSError as fault:
        raise CampaignError(
            f"{folder}: {fault.strerror or fault}; give --out a folder that can be written"
        ) from fault
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            file.seek(0)
            who = file.read().strip() or "?"
            raise CampaignError(
                f"{folder}: process {who} is running this campaign; wait until it has finished, "
                f"or end it (kill {who})"
            ) from fault
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


# --- cost of a campaign: one row for each block (times.csv) and for each session (sessions.csv) ---

TIMES = "times.csv"
TIME_COLUMNS = ("block", "worker", "cpu_s", "wall_s", "mission_s", "rss_mb")
SESSIONS = "sessions.csv"
SESSION_COLUMNS = ("began_at", "workers", "wall_s", "blocks", "lost")


def note_block(folder: Path, block: Block, result: Mapping[str, Any]) -> None:
    """Append the cost of a block: process id, CPU time, wall time and simulated time (s), memory
    (MiB)."""
    took = [
        block.index,
        *(result[name] for name in ("pid", "cpu_s", "wall_s", "mission_s", "rss_mb")),
    ]
    # Without fsync: these costs are only reported, nothing depends on them.
    rows = [took] if (folder / TIMES).exists() else [TIME_COLUMNS, took]
    with (folder / TIMES).open("a", encoding="utf-8", newline="") as file:
        file.write(_lines(rows))


def note_sessions(folder: Path, sessions: Iterable[Mapping[str, Any]]) -> None:
    """Write all sessions at once, so that a kill leaves either the old file or the new one."""
    rows = [[session[name] for name in SESSION_COLUMNS] for session in sessions]
    write_whole(folder / SESSIONS, _lines([SESSION_COLUMNS, *rows]))


def times(folder: Path) -> list[dict[str, str]]:
    """Return the costs of the blocks, in the order in which they ended; a block that was run again
    is there twice."""
    return _read(folder / TIMES)


def sessions(folder: Path) -> list[dict[str, str]]:
    """Return the sessions so far, the first one first."""
    return _read(folder / SESSIONS)


def began(folder: Path) -> str | None:
    """Return when the first session of a campaign began (UTC, ISO 8601); None if it is unknown."""
    known = sessions(folder)
    return known[0]["began_at"] if known else None


def _lines(rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
