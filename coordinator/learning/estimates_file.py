"""The estimates file: what was learned, kept across mission runs in SQLite, and merged between
machines.

Every file has an origin of its own, and keeps the sums of each origin apart. A merge takes the
later version of each origin's sums, so merging is idempotent, commutative and associative: no run
counts twice, however often and in whatever order files travel. What was reset stays forgotten: its
origins are remembered as such. A copy of a file becomes an origin of its own as soon as something
is added to it, so two copies that both went on lose nothing when they meet. A campaign's runs stand
under an origin that is closed: it is the same in whatever file the campaign is counted, so nothing
else is ever added to it.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from petrobot.coordinator.learning.estimate import (
    Firings,
    FiringsKey,
    TallyKey,
    merge_firings,
    merge_tallies,
)
from petrobot.coordinator.learning.estimates_tables import (
    APPLICATION,
    CHOICE,
    COUNTED,
    SCHEMA,
    TABLES,
    add_flow,
    add_tally,
    correct_tally,
    count_session,
    fact,
    flow_of,
    flow_row,
    forget,
    is_empty,
    migrate,
    put_question,
    put_selector,
    question_of,
    questions,
    renew_origin,
    schema,
    state_of,
    take_later,
    take_selector,
    tally_of,
    tally_row,
)
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Correction
from petrobot.services.host.whole_file import make_folder

BUSY = 20.0
"""Seconds that a command waits for another one that is writing the file."""
MACHINE_ID = Path("/etc/machine-id")
"""Tells machines apart (machine-id(5)); where there is none, the file's inode alone tells copies
apart."""


class EstimatesError(Exception):
    """The estimates file cannot be used: file, what is wrong, remedy."""


@dataclass
class FileContents:
    """What a file holds: all origins' estimates together, selectors' states by (primitive task,
    selector)."""

    origin: str = ""
    generation: int = 0
    """Mission runs learned from so far."""
    estimates: Estimates = field(default_factory=Estimates)
    selectors: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    asked: dict[str, tuple[Question, ...]] = field(default_factory=dict)
    """By primitive task: cost measure, target and rho by which its actions were judged where they
    were run; several where origins differ, the first one this file's own or else the one that was
    asked most often."""

    def question(self, primitive_task: str) -> Question:
        """By what the actions of a primitive task are judged if nothing else is asked."""
        if self.asked.get(primitive_task):
            return self.asked[primitive_task][0]
        states = (state for (task, _), state in self.selectors.items() if task == primitive_task)
        return Question(next((str(state["cost"]) for state in states if state.get("cost")), "wall"))

    def states(self, selector: str) -> dict[str, dict[str, Any]]:
        """States of one kind of selector by primitive task."""
        return {task: state for (task, name), state in self.selectors.items() if name == selector}


class EstimatesFile:
    """One estimates file. A file that is not there is made at the first writing; reading one that
    is not there gives nothing."""

    def __init__(self, path: Path, origin: str | None = None) -> None:
        """`origin`: the name of a new file's origin; None: a random one."""
        self.path = path
        self._origin = origin

    # --- reading ------------------------------------------------------------------------------

    def read(self) -> FileContents:
        """All that the file holds. Raises EstimatesError."""
        if not self.path.exists():
            return FileContents()
        with self._open() as db:
            return self._kept(db)

    def _kept(self, db: sqlite3.Connection) -> FileContents:
        if is_empty(db):  # made, but killed before anything was written
            return FileContents()
        about = dict(db.execute("SELECT name, value FROM about"))
        kept = FileContents(about["origin"], int(about["generation"]))
        for row in db.execute("SELECT * FROM tally"):
            key = TallyKey(*row[1:4])
            kept.estimates.tallies[key] = merge_tallies(kept.estimates.tally(key), tally_of(row))
        for row in db.execute("SELECT * FROM flow"):
            where = FiringsKey(*row[1:4])
            kept.estimates.flows[where] = merge_firings(
                kept.estimates.flows.get(where, Firings()), flow_of(row)
            )
        for task, name, state in db.execute("SELECT primitive_task, name, state FROM selector"):
            kept.selectors[task, name] = json.loads(state)
        for _, task, _, *asked in sorted(
            questions(db), key=lambda row: (row[0] != kept.origin, -row[2], row[0])
        ):
            known = kept.asked.get(task, ())
            question = question_of(asked)
            kept.asked[task] = known if question in known else (*known, question)
        return kept

    def records_of(self, mission: str) -> int:
        """How many records of a mission run have been counted already."""
        if not self.path.exists():
            return 0
        with self._open() as db:
            if is_empty(db):
                return 0
            row = db.execute("SELECT records FROM mission WHERE id = ?", (mission,)).fetchone()
            return int(row[0]) if row else 0

    # --- writing ------------------------------------------------------------------------------

    def add(
        self,
        gained: Estimates,
        selectors: Mapping[str, Mapping[str, Any]],
        mission: str = "",
        records: int | None = None,
        late: Iterable[Correction] = (),
        asked: Mapping[str, Question] | None = None,
    ) -> None:
        """Add what a session gained to this file's own origin, and keep its selectors' states
        (primitive task -> state).

        `mission`, `records`: remember that so many records of a mission run are counted, so that
        none counts twice when it is resumed (None: it has ended, nothing need be remembered).
        `late`: verdicts on runs that this file counted before; what was reset meanwhile, or came
        along with a copied file, stays as it is. `asked`: by what actions were judged (primitive
        task -> question).
        """
        with self._writing() as db:
            if fact(db, "origin") == fact(db, "closed"):
                renew_origin(db)
            origin = fact(db, "origin")
            if fact(db, COUNTED + mission) == origin:
                for correction in late:
                    correct_tally(db, origin, correction)
            for key, tally in gained.tallies.items():
                add_tally(db, origin, key, tally)
            for where, flow in gained.flows.items():
                add_flow(db, origin, where, flow)
            for task, state in selectors.items():
                put_selector(db, task, state)
            for task, question in (asked or {}).items():
                row = db.execute(
                    "SELECT version FROM question WHERE origin = ? AND primitive_task = ?",
                    (origin, task),
                )
                put_question(db, origin, task, question, (row.fetchone() or (0,))[0] + 1)
            count_session(db)
            db.execute("DELETE FROM mission WHERE id = ?", (mission,))
            db.execute("DELETE FROM about WHERE name = ?", (COUNTED + mission,))
            if records is not None:
                db.execute("INSERT INTO mission VALUES (?, ?)", (mission, records))
                db.execute("INSERT INTO about VALUES (?, ?)", (COUNTED + mission, origin))

    def put_closed(
        self,
        origin: str,
        estimates: Estimates,
        selectors: Mapping[str, Mapping[str, Any]],
        asked: Mapping[str, Question],
    ) -> None:
        """Write the whole of what was counted under an origin of its own that nobody adds to (a
        campaign's).

        A second time nothing changes; what others have added to the file, or what was reset, stays
        so.
        """
        with self._writing() as db:
            db.execute("INSERT OR IGNORE INTO about VALUES ('closed', ?)", (origin,))
            gone = {
                task
                for (task,) in db.execute(
                    "SELECT primitive_task FROM forgotten WHERE origin = ?", (origin,)
                )
            }
            tallies = [
                tally_row(origin, k, t)
                for k, t in estimates.tallies.items()
                if k.primitive_task not in gone
            ]
            flows = (
                [] if "" in gone else [flow_row(origin, k, f) for k, f in estimates.flows.items()]
            )
            before = db.total_changes
            take_later(db, "tally", tallies)
            take_later(db, "flow", flows)
            if db.total_changes > before:
                count_session(db)
            for task, state in selectors.items():
                take_selector(db, task, state["selector"], state, origin)
            for task, question in asked.items():
                if task not in gone:
                    put_question(db, origin, task, question, 1)

    def put_selectors(self, selectors: Mapping[str, Mapping[str, Any]]) -> None:
        """Replace selectors' states (freezing, overriding by hand)."""
        with self._writing() as db:
            for task, state in selectors.items():
                put_selector(db, task, state)

    def reset(self, primitive_task: str | None = None, *, selectors_only: bool = False) -> None:
        """Forget a primitive task (None: everything): selectors' states, and estimates unless
        `selectors_only`."""
        with self._writing() as db:
            which, given = (
                ("WHERE primitive_task = ?", (primitive_task,)) if primitive_task else ("", ())
            )
            tasks = db.execute(f"SELECT primitive_task FROM selector {which}", given).fetchall()
            own = {fact(db, "origin"), fact(db, "closed")} - {""}
            choices = [(origin, CHOICE + task) for origin in sorted(own) for (task,) in tasks]
            db.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", choices)
            db.execute(f"DELETE FROM selector {which}", given)
            renew_origin(db)
            if selectors_only:
                return
            db.execute(
                "INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, primitive_task "
                f"FROM tally {which}",
                given,
            )
            db.execute(f"DELETE FROM tally {which}", given)
            db.execute(f"DELETE FROM question {which}", given)
            if primitive_task is None:
                db.execute("INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, '' FROM flow")
                db.execute("DELETE FROM flow")

    def merge(self, other: Path) -> None:
        """Take in another file. Raises EstimatesError.

        Estimates of each origin: the later version. Selectors: the state that has learned from more
        trials.
        """
        if not other.exists():
            raise EstimatesError(
                f"{other}: no such file; give an estimates file that `run --learn` has made"
            )
        with EstimatesFile(other)._open() as db:
            if is_empty(db):
                return
            origin = fact(db, "origin")
            rows = {
                name: db.execute(f"SELECT * FROM {name}").fetchall()
                for name in ("tally", "flow", "selector")
            }
            rows["question"] = questions(db)
            gone = db.execute("SELECT * FROM forgotten").fetchall()
            for row in rows["tally"]:
                tally_of(row)
            for row in rows["flow"]:
                flow_of(row)
            for _, _, _, *asked in rows["question"]:
                question_of(asked)
            states = [(task, name, state_of(body)) for task, name, _, body in rows["selector"]]
        with self._writing() as mine:
            for table in ("tally", "flow", "question"):
                take_later(mine, table, rows[table])
            for task, name, state in states:
                take_selector(mine, task, name, state, origin)
            mine.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", gone)
            forget(mine)

    # --- the database -------------------------------------------------------------------------

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction that sees nobody else's half-written work and makes the file if need
        be."""
        try:
            make_folder(self.path.parent)
        except OSError as fault:
            raise EstimatesError(
                f"{self.path}: {fault.strerror}; give a folder that can be made"
            ) from fault
        existed = self.path.exists()
        try:
            with self._open() as db:
                db.execute("BEGIN IMMEDIATE")
                if is_empty(db):
                    self._make(db)
                elif schema(db) < SCHEMA:
                    migrate(db)
                self._settle(db)
                yield db
                db.execute("COMMIT")
        except EstimatesError:
            if not existed and self.path.is_file() and not self.path.stat().st_size:
                self.path.unlink()  # made by this very try, on a disk that is full
            raise

    def _make(self, db: sqlite3.Connection) -> None:
        for statement in TABLES.split(";"):
            if statement.strip():
                db.execute(statement)
        db.execute(f"PRAGMA application_id = {APPLICATION}")
        db.execute(f"PRAGMA user_version = {SCHEMA}")
        db.execute(
            "INSERT INTO about VALUES ('origin', ?)", (self._origin or secrets.token_hex(8),)
        )
        db.execute("INSERT INTO about VALUES ('generation', '0')")

    def _settle(self, db: sqlite3.Connection) -> None:
        """A file that was copied here is an origin of its own from now on; the sums that came along
        stay the old one's."""
        here = _home(self.path)
        known = db.execute("SELECT value FROM about WHERE name = 'home'").fetchone()
        if known is not None and known[0] != here:
            renew_origin(db)
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
                f"{self.path}: its contents do not fit ({fault}); restore it from a copy, or "
                "give another file"
            ) from fault

    def _check(self, db: sqlite3.Connection) -> None:
        empty = is_empty(db)
        application, version = db.execute("PRAGMA application_id").fetchone()[0], schema(db)
        if empty and not application and not version:
            return
        if application != APPLICATION:
            raise EstimatesError(
                f"{self.path}: a database, but no estimates file; give --learn another file"
            )
        if not 1 <= version <= SCHEMA:
            raise EstimatesError(
                f"{self.path}: written with schema {version}, this petrobot reads {SCHEMA}; "
                f"{'upgrade petrobot' if version > SCHEMA else 'start a new file'} or give "
                "another one"
            )


def _home(path: Path) -> str:
    """Which file on which machine this is: another one after copying, the same after renaming."""
    machine = (
        MACHINE_ID.read_text(encoding="ascii", errors="replace").strip()
        if MACHINE_ID.is_file()
        else ""
    )
    return f"{machine}:{path.stat().st_ino}"
