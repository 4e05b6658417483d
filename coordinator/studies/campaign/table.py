"""The table of a campaign on disk: one CSV file that grows only by whole blocks, in order, so that
an interrupted campaign can continue."""

from __future__ import annotations

import csv
import fcntl
import importlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.studies.campaign.plan import TABLE as TABLE, Block, CampaignError
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial, waits_of
from petrobot.coordinator.task import Kind, Task
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import sync_folder, write_whole

# --- rows ---
# A trial as a row and back. The columns depend on the task and its score.

GENERAL = (
    "n",
    "regime",
    "seed",
    "k",
    "block",
    "begun",
    "status",
    "cause",
    "completed",
    "goals",
    "time",
    "at",
    "mission_s",
)
"""`n`: number in the campaign; `k`: number in the mission run with `seed`; `time`: duration of the
trial (s); `at`: its begin (s since the mission began)."""
BY_PLACE = ("status", "cause", "seconds", "cost")
"""Columns of the trial's first run in each place; the column `runs` holds all runs."""
LAST = ("more", "runs", "waits", "fired")
"""JSON columns: results of the task's own that the first block did not have; RunEntry.to_plain of
each run; Trial.waits; Trial.fired."""


class TrialRow(Struct):
    """A trial of a campaign. `trial` is None if the mission run was given up before the trial
    began."""

    n: int
    regime: str
    seed: int
    k: int
    block: int
    mission_s: float
    trial: Trial | None
    score: dict[str, Any] = field(default_factory=dict)
    """The task's own results, as `table.column`."""

    @property
    def runs(self) -> Sequence[RunEntry]:
        """Runs of the trial; none if it did not begin."""
        return self.trial.runs if self.trial is not None else ()


def rows_of(block: Block, result: Mapping[str, Any]) -> list[TrialRow]:
    """Return the rows of a block's result."""
    trials = {t["k"]: Trial.from_plain(t) for t in result["trials"]}
    return [
        TrialRow(
            block.first + k,
            block.regime,
            block.seed,
            k,
            block.index,
            result["mission_s"],
            trials.get(k),
            dict(result["score"][k - 1]),
        )
        for k in range(1, block.count + 1)
    ]


def columns(task: Task, rows: Sequence[TrialRow]) -> list[str]:
    """Return the columns of a table: general ones, those of the task file, and those of the task's
    score in these first rows."""
    chosen = [f"chosen.{name}" for name in task.primitive_tasks]
    places = [
        f"{p.name}.{part}"
        for p in task.flat.places.values()
        if p.kind is Kind.ACTION
        for part in BY_PLACE
    ]
    own = list(dict.fromkeys(key for row in rows for key in row.score))
    return [*GENERAL, *chosen, *places, *own, *LAST]


def cells(task: Task, row: TrialRow, names: Sequence[str]) -> list[str]:
    """Return a row as texts, in the order of the columns."""
    found = {**_general(row), **_runs(task, row), **row.score}
    more = {k: v for k, v in row.score.items() if k not in names}
    found["more"] = _json(more) if more else ""
    return [_text(found.get(name)) for name in names]


def _general(row: TrialRow) -> dict[str, Any]:
    base = {name: getattr(row, name) for name in ("n", "regime", "seed", "k", "block", "mission_s")}
    trial = row.trial
    if trial is None:
        return {**base, "begun": False}
    return {
        **base,
        **{n: getattr(trial, n) for n in ("status", "cause", "completed", "goals", "time")},
        "begun": True,
        "at": trial.begun,
        "waits": _json([list(w) for w in trial.waits]),
        "fired": _json(trial.fired),
        "runs": _json([run.to_plain() for run in trial.runs]),
    }


def _runs(task: Task, row: TrialRow) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for run in row.runs:
        primitive = task.primitive_task_of(run.place).name
        found.setdefault(f"chosen.{primitive}", run.action)
        if f"{run.place}.status" not in found:
            found |= {f"{run.place}.{part}": getattr(run, part) for part in BY_PLACE}
    return found


def _json(data: Any) -> str:
    return json_text(data, separators=(",", ":"), ensure_ascii=False)


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(round(value, 9))
    if isinstance(value, str):
        # a bare carriage return would end a line of the CSV file
        return value.replace("\r\n", "\n").replace("\r", "\n")
    return str(value) if isinstance(value, int) else _json(value)


def read_row(record: Mapping[str, str]) -> TrialRow:
    """Read a row from its texts. Raises KeyError or ValueError if the record is not a row."""
    trial = None
    if record["begun"] == "true":
        trial = Trial(
            int(record["k"]),
            float(record["at"]),
            _number(record["time"]),
            record["completed"] == "true",
            int(record["goals"]),
            record["status"],
            record["cause"],
            [RunEntry.from_plain(run) for run in json.loads(record["runs"])],
            waits_of(json.loads(record["waits"])),
            json.loads(record["fired"]),
        )
    own = {key: value_of(text) for key, text in record.items() if _is_own(key) and text != ""}
    own |= json.loads(record["more"]) if record.get("more") else {}
    return TrialRow(
        int(record["n"]),
        record["regime"],
        int(record["seed"]),
        int(record["k"]),
        int(record["block"]),
        float(record["mission_s"]),
        trial,
        own,
    )


def _is_own(key: str) -> bool:
    """Return whether a column may belong to the score; columns of places are read from `runs`."""
    return "." in key and not key.startswith("chosen.") and key.rpartition(".")[2] not in BY_PLACE


def _number(text: str) -> float | None:
    return float(text) if text else None


def value_of(text: str) -> Any:
    """Return the value of a cell's text, as far as a text shows it."""
    if text in ("true", "false"):
        return text == "true"
    try:
        return json.loads(text)
    except ValueError:
        return text


# --- the table on disk ---

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
        """Append the rows of a block; they are on disk when this returns. Raises OSError, also if
        the table that has the blocks before it is gone."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        first = self._columns is None
        if self._columns is None:
            self._columns = columns(self._task, rows)
            writer.writerow(self._columns)
        for row in rows:
            writer.writerow(cells(self._task, row, self._columns))
        with self.path.open("xb" if first else "r+b") as file:
            file.seek(0, os.SEEK_END)
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
LONGEST_LINE = 1_000
SESSIONS = "sessions.csv"
SESSION_COLUMNS = ("began_at", "workers", "wall_s", "blocks", "lost")


def note_block(folder: Path, block: Block, result: Mapping[str, Any]) -> None:
    """Append the cost of a block: process id, CPU time, wall time and simulated time (s), memory
    (MiB)."""
    took = [
        block.index,
        *(result[name] for name in ("pid", "cpu_s", "wall_s", "mission_s", "rss_mb")),
    ]
    # Without fsync: these costs are only reported. So a full disk or a power cut may have torn the
    # last row, which is cut off.
    with (folder / TIMES).open("a+b") as file:
        begin = file.seek(max(0, file.tell() - LONGEST_LINE))
        end = begin + file.read().rfind(b"\n") + 1
        file.truncate(end)
        file.write(_lines([took] if end else [TIME_COLUMNS, took]).encode())


def note_sessions(folder: Path, sessions: Iterable[Mapping[str, Any]]) -> None:
    """Write all sessions at once, so that a kill leaves either the old file or the new one."""
    rows = [[session[name] for name in SESSION_COLUMNS] for session in sessions]
    write_whole(folder / SESSIONS, _lines([SESSION_COLUMNS, *rows]))


def times(folder: Path) -> list[dict[str, str]]:
    """Return the costs of the blocks, in the order in which they ended; a block that was run again
    is there twice. A row that a full disk or a power cut has torn is left out."""
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
        return list(csv.DictReader(line for line in file if line.endswith("\n")))
