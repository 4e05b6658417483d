"""The estimates file: what was learned, kept across mission runs in SQLite, and merged between machines.

Every file has an origin of its own, and keeps the sums of each origin apart. A merge takes the later version of each origin's
sums, so merging is idempotent, commutative and associative: no run counts twice, however often and in whatever order files
travel. What was reset stays forgotten: its origins are remembered as such. A copy of a file becomes an origin of its own as soon
as something is added to it, so two copies that both went on lose nothing when they meet.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coordinator.learning.estimate import Key, Tally
from coordinator.learning.estimate import merge as merge_tallies
from coordinator.learning.joining import joined, trials
from coordinator.learning.learning import Estimates
from coordinator.learning.passage import Flow, PassageKey
from coordinator.learning.passage import merge as merge_flows

SCHEMA = 1
APPLICATION = 0x70657472
""""petr": SQLite's application_id of these files."""
BUSY = 20.0
"""Seconds that a command waits for another one that is writing the file."""
MACHINE_ID = Path("/etc/machine-id")
"""Tells machines apart (machine-id(5)); where there is none, the file's inode alone tells copies apart."""
CHOICE = "choice of "
"""Before a primitive task's name in the table `forgotten`: its selectors' states are forgotten, not its estimates."""

TABLES = """
CREATE TABLE about(name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE tally(origin TEXT, primitive_task TEXT, action TEXT, context TEXT, version INTEGER NOT NULL, body TEXT NOT NULL,
  PRIMARY KEY(origin, primitive_task, action, context)) WITHOUT ROWID;
CREATE TABLE flow(origin TEXT, task TEXT, transition_name TEXT, context TEXT, version INTEGER NOT NULL, body TEXT NOT NULL,
  PRIMARY KEY(origin, task, transition_name, context)) WITHOUT ROWID;
CREATE TABLE selector(primitive_task TEXT, name TEXT, trials REAL NOT NULL, state TEXT NOT NULL,
  PRIMARY KEY(primitive_task, name)) WITHOUT ROWID;
CREATE TABLE forgotten(origin TEXT, primitive_task TEXT, PRIMARY KEY(origin, primitive_task)) WITHOUT ROWID;
CREATE TABLE mission(id TEXT PRIMARY KEY, records INTEGER NOT NULL) WITHOUT ROWID;
"""


class EstimatesError(Exception):
    """The estimates file cannot be used: file, what is wrong, remedy."""


@dataclass
class Kept:
    """What a file holds: all origins' estimates together, selectors' states by (primitive task, selector)."""

    origin: str = ""
    generation: int = 0
    """Mission runs learned from so far."""
    estimates: Estimates = field(default_factory=Estimates)
    selectors: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    def states(self, selector: str) -> dict[str, dict[str, Any]]:
        """States of one kind of selector by primitive task."""
        return {task: state for (task, name), state in self.selectors.items() if name == selector}


class EstimatesFile:
    """One estimates file. A file that is not there is made at the first writing; reading one that is not there gives nothing."""

    def __init__(self, path: Path, origin: str | None = None) -> None:
        """`origin`: the name of a new file's origin; None: a random one."""
        self.path = path
        self._origin = origin

    # --- reading ---------------------------------------------------------------------------------------------------

    def read(self) -> Kept:
        """All that the file holds. Raises EstimatesError."""
        if not self.path.exists():
            return Kept()
        with self._open() as db:
            return self._kept(db)

    def _kept(self, db: sqlite3.Connection) -> Kept:
        if _is_empty(db):  # made, but killed before anything was written
            return Kept()
        about = dict(db.execute("SELECT name, value FROM about"))
        kept = Kept(about["origin"], int(about["generation"]))
        for row in db.execute("SELECT * FROM tally"):
            key = Key(*row[1:4])
            kept.estimates.tallies[key] = merge_tallies(kept.estimates.tally(key), _tally(row))
        for row in db.execute("SELECT * FROM flow"):
            where = PassageKey(*row[1:4])
            kept.estimates.flows[where] = merge_flows(kept.estimates.flows.get(where, Flow()), _flow(row))
        for task, name, state in db.execute("SELECT primitive_task, name, state FROM selector"):
            kept.selectors[task, name] = json.loads(state)
        return kept

    def records_of(self, mission: str) -> int:
        """How many records of a mission run have been counted already."""
        if not self.path.exists():
            return 0
        with self._open() as db:
            if _is_empty(db):
                return 0
            row = db.execute("SELECT records FROM mission WHERE id = ?", (mission,)).fetchone()
            return int(row[0]) if row else 0

    # --- writing ---------------------------------------------------------------------------------------------------

    def add(
        self,
        gained: Estimates,
        selectors: Mapping[str, Mapping[str, Any]],
        mission: str = "",
        records: int | None = None,
    ) -> None:
        """Add what a session gained to this file's own origin, and keep its selectors' states (primitive task -> state).

        `mission`, `records`: remember that so many records of a mission run are counted, so that none counts twice when it is
        resumed (None: it has ended, nothing need be remembered).
        """
        with self._writing() as db:
            origin = _about(db, "origin")
            for key, tally in gained.tallies.items():
                _add_tally(db, origin, key, tally)
            for where, flow in gained.flows.items():
                _add_flow(db, origin, where, flow)
            for task, state in selectors.items():
                _put_selector(db, task, state)
            db.execute("UPDATE about SET value = CAST(value AS INTEGER) + 1 WHERE name = 'generation'")
            db.execute("DELETE FROM mission WHERE id = ?", (mission,))
            if records is not None:
                db.execute("INSERT INTO mission VALUES (?, ?)", (mission, records))

    def put_selectors(self, selectors: Mapping[str, Mapping[str, Any]]) -> None:
        """Replace selectors' states (freezing, overriding by hand)."""
        with self._writing() as db:
            for task, state in selectors.items():
                _put_selector(db, task, state)

    def reset(self, primitive_task: str | None = None, *, selectors_only: bool = False) -> None:
        """Forget a primitive task (None: everything): selectors' states, and estimates unless `selectors_only`."""
        with self._writing() as db:
            which, given = ("WHERE primitive_task = ?", (primitive_task,)) if primitive_task else ("", ())
            own = _about(db, "origin")
            choices = [
                (own, CHOICE + task) for (task,) in db.execute(f"SELECT primitive_task FROM selector {which}", given)
            ]
            db.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", choices)
            db.execute(f"DELETE FROM selector {which}", given)
            _renew_origin(db)
            if selectors_only:
                return
            db.execute(
                f"INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, primitive_task FROM tally {which}", given
            )
            db.execute(f"DELETE FROM tally {which}", given)
            if primitive_task is None:
                db.execute("INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, '' FROM flow")
                db.execute("DELETE FROM flow")

    def merge(self, other: Path) -> None:
        """Take in another file. Raises EstimatesError.

        Estimates of each origin: the later version. Selectors: the state that has learned from more trials.
        """
        if not other.exists():
            raise EstimatesError(f"{other}: no such file; give an estimates file that `run --learn` has made")
        with EstimatesFile(other)._open() as db:
            if _is_empty(db):
                return
            origin = _about(db, "origin")
            rows = {name: db.execute(f"SELECT * FROM {name}").fetchall() for name in ("tally", "flow", "selector")}
            gone = db.execute("SELECT * FROM forgotten").fetchall()
            for row in rows["tally"]:
                _tally(row)
            for row in rows["flow"]:
                _flow(row)
            states = [(task, name, _state(body)) for task, name, _, body in rows["selector"]]
        with self._writing() as mine:
            _take_later(mine, "tally", rows["tally"], "origin, primitive_task, action, context")
            _take_later(mine, "flow", rows["flow"], "origin, task, transition_name, context")
            for task, name, state in states:
                _take_selector(mine, task, name, state, origin)
            mine.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", gone)
            _forget(mine)

    # --- the database ----------------------------------------------------------------------------------------------

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction that sees nobody else's half-written work and makes the file if need be."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise EstimatesError(f"{self.path}: {fault.strerror}; give a folder that can be made") from fault
        with self._open() as db:
            db.execute("BEGIN IMMEDIATE")
            if _is_empty(db):
                self._make(db)
            self._settle(db)
            yield db
            db.execute("COMMIT")

    def _make(self, db: sqlite3.Connection) -> None:
        for statement in TABLES.split(";"):
            if statement.strip():
                db.execute(statement)
        db.execute(f"PRAGMA application_id = {APPLICATION}")
        db.execute(f"PRAGMA user_version = {SCHEMA}")
        db.execute("INSERT INTO about VALUES ('origin', ?)", (self._origin or secrets.token_hex(8),))
        db.execute("INSERT INTO about VALUES ('generation', '0')")

    def _settle(self, db: sqlite3.Connection) -> None:
        """A file that was copied here is an origin of its own from now on; the sums that came along stay the old one's."""
        here = _home(self.path)
        known = db.execute("SELECT value FROM about WHERE name = 'home'").fetchone()
        if known is not None and known[0] != here:
            _renew_origin(db)
        db.execute("INSERT OR REPLACE INTO about VALUES ('home', ?)", (here,))

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """The database, checked. Every fault of the file becomes an EstimatesError."""
        try:
            with closing(sqlite3.connect(self.path, timeout=BUSY, isolation_level=None)) as db:
                self._check(db)
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                yield db
        except sqlite3.Error as fault:
            raise EstimatesError(
                f"{self.path}: {fault}; restore it from a copy, or give --learn another file"
            ) from fault
        except (ValueError, KeyError, TypeError) as fault:
            raise EstimatesError(
                f"{self.path}: its contents do not fit ({fault}); restore it from a copy, or give another file"
            ) from fault

    def _check(self, db: sqlite3.Connection) -> None:
        empty = _is_empty(db)
        (application,), (version,) = (db.execute(f"PRAGMA {p}").fetchone() for p in ("application_id", "user_version"))
        if empty and not application and not version:
            return
        if application != APPLICATION:
            raise EstimatesError(f"{self.path}: a database, but no estimates file; give --learn another file")
        if version != SCHEMA:
            raise EstimatesError(
                f"{self.path}: written with schema {version}, this petrobot reads {SCHEMA}; "
                f"{'upgrade petrobot' if version > SCHEMA else 'start a new file'} or give another one"
            )


def _home(path: Path) -> str:
    """Which file on which machine this is: another one after copying, the same after renaming."""
    machine = MACHINE_ID.read_text(encoding="ascii", errors="replace").strip() if MACHINE_ID.is_file() else ""
    return f"{machine}:{path.stat().st_ino}"


def _is_empty(db: sqlite3.Connection) -> bool:
    return int(db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]) == 0


def _renew_origin(db: sqlite3.Connection) -> None:
    db.execute("UPDATE about SET value = ? WHERE name = 'origin'", (secrets.token_hex(8),))


def _about(db: sqlite3.Connection, name: str) -> str:
    return str(db.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()[0])


def _add_tally(db: sqlite3.Connection, origin: str, key: Key, gained: Tally) -> None:
    where = (origin, key.primitive_task, key.action, key.context)
    row = db.execute(
        "SELECT * FROM tally WHERE origin = ? AND primitive_task = ? AND action = ? AND context = ?", where
    ).fetchone()
    tally = merge_tallies(_tally(row) if row else Tally(), gained)
    body = json.dumps(tally.to_plain(), separators=(",", ":"))
    db.execute("INSERT OR REPLACE INTO tally VALUES (?, ?, ?, ?, ?, ?)", (*where, tally.changes, body))


def _add_flow(db: sqlite3.Connection, origin: str, key: PassageKey, gained: Flow) -> None:
    where = (origin, key.task, key.transition, key.context)
    row = db.execute(
        "SELECT * FROM flow WHERE origin = ? AND task = ? AND transition_name = ? AND context = ?", where
    ).fetchone()
    flow = merge_flows(_flow(row) if row else Flow(), gained)
    body = json.dumps(flow.to_plain())
    db.execute("INSERT OR REPLACE INTO flow VALUES (?, ?, ?, ?, ?, ?)", (*where, flow.fired, body))


def _put_selector(db: sqlite3.Connection, task: str, state: Mapping[str, Any]) -> None:
    body = json.dumps(state, separators=(",", ":"))
    db.execute("INSERT OR REPLACE INTO selector VALUES (?, ?, ?, ?)", (task, state["selector"], trials(state), body))


def _take_selector(db: sqlite3.Connection, task: str, name: str, state: Mapping[str, Any], origin: str) -> None:
    """Another file's state, unless what was learned there under that origin was reset here."""
    if db.execute(
        "SELECT 1 FROM forgotten WHERE origin = ? AND primitive_task = ?", (origin, CHOICE + task)
    ).fetchone():
        return
    row = db.execute("SELECT state FROM selector WHERE primitive_task = ? AND name = ?", (task, name)).fetchone()
    _put_selector(db, task, state if row is None else joined(_state(row[0]), state))


def _forget(db: sqlite3.Connection) -> None:
    """Drop what some file has reset; if that was this file's own, what it learns from now on is another origin's."""
    db.execute(
        "DELETE FROM tally WHERE EXISTS (SELECT 1 FROM forgotten f WHERE f.origin = tally.origin "
        "AND f.primitive_task = tally.primitive_task)"
    )
    db.execute(
        "DELETE FROM flow WHERE EXISTS (SELECT 1 FROM forgotten f WHERE f.origin = flow.origin "
        "AND f.primitive_task = '')"
    )
    if db.execute("SELECT 1 FROM forgotten WHERE origin = ?", (_about(db, "origin"),)).fetchone():
        _renew_origin(db)


def _take_later(db: sqlite3.Connection, table: str, rows: list[tuple[Any, ...]], key: str) -> None:
    marks = ", ".join("?" for _ in range(key.count(",") + 3))
    db.executemany(
        f"INSERT INTO {table} VALUES ({marks}) ON CONFLICT({key}) DO UPDATE SET version = excluded.version, "
        "body = excluded.body WHERE excluded.version > version",
        rows,
    )


def _tally(row: Sequence[Any]) -> Tally:
    """Of a row of the table `tally`. Raises ValueError naming the row."""
    _, task, action, context, version, body = row
    try:
        tally = Tally.of_plain(json.loads(body))
        _agree(tally.changes, version)
    except (ValueError, KeyError, TypeError) as fault:
        raise ValueError(f"{task}, {action}{_in(context)}: {_said(fault)}") from fault
    return tally


def _agree(changes: int, version: int) -> None:
    """A higher version would win every merge, whatever stands behind it."""
    if changes != version:
        raise ValueError(f"version {version} of what was changed {changes} times")


def _in(context: str) -> str:
    return f" ({context})" if context else ""


def _said(fault: Exception) -> str:
    return f"{fault} is missing" if isinstance(fault, KeyError) else str(fault)


def _state(body: str) -> dict[str, Any]:
    state: dict[str, Any] = json.loads(body)
    trials(state)
    return state


def _flow(row: Sequence[Any]) -> Flow:
    """Of a row of the table `flow`. Raises ValueError naming the row."""
    _, _, transition, context, version, body = row
    try:
        flow = Flow.of_plain(json.loads(body))
        _agree(flow.fired, version)
    except (ValueError, KeyError, TypeError, IndexError) as fault:
        raise ValueError(f"transition {transition}{_in(context)}: {_said(fault)}") from fault
    return flow
