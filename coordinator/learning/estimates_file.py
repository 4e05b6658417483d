"""The estimates file: keeps in SQLite what was learned, across mission runs, and merges files of
several machines.

Each file has its own origin (a random name) and stores the sums of each origin separately. A merge
takes the later version of each origin's sums, so merging is idempotent, commutative and
associative: no run counts twice, however often and in whatever order files travel. What was reset
stays forgotten, because the file remembers the reset origins. A copy of a file gets a new origin as
soon as something is added to it, so two copies that both grow lose nothing when they are merged.
The runs of a campaign have a closed origin: it is the same in every file that counts the campaign,
so nothing else is ever added under it.
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
    CAMPAIGN,
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
from petrobot.services.comm.location_file import FIRST_PHYSICS, same_physics
from petrobot.services.host.whole_file import make_folder

BUSY = 20.0
"""Seconds that a command waits while another one writes the file."""
PHYSICS = "physics"
"""Row of the table `about`."""
MACHINE_ID = Path("/etc/machine-id")
"""Distinguishes machines (machine-id(5)). Without it, only the inode of the file tells copies
apart."""


class EstimatesError(Exception):
    """The estimates file cannot be used; the text names the file, what is wrong and what to do."""


@dataclass
class FileContents:
    """Contents of a file: estimates of all origins together, and states of selectors by (primitive
    task, selector)."""

    origin: str = ""
    generation: int = 0
    """Number of mission runs learned from so far."""
    physics: str = ""
    """Name and version of the physics of the simulated laboratory in which all of it was learned;
    empty: not said."""
    estimates: Estimates = field(default_factory=Estimates)
    selectors: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    kinds: dict[tuple[str, str], dict[str, int]] = field(default_factory=dict)
    """By (primitive task, action): in which kind of runs it was measured, and how often. Campaigns
    run in simulated laboratories; a file does not record where a mission ran."""
    asked: dict[str, tuple[Question, ...]] = field(default_factory=dict)
    """By primitive task: the questions (cost measure, target, rho) by which its actions were judged
    when they ran. Several if origins differ; the first one is this file's own, otherwise the one of
    the most sessions."""

    def question(self, primitive_task: str) -> Question:
        """Return by what the actions of a primitive task are judged unless the user asks
        otherwise."""
        if self.asked.get(primitive_task):
            return self.asked[primitive_task][0]
        states = (state for (task, _), state in self.selectors.items() if task == primitive_task)
        return Question(next((str(state["cost"]) for state in states if state.get("cost")), "wall"))

    def states(self, selector: str) -> dict[str, dict[str, Any]]:
        """Return the states of one kind of selector by primitive task."""
        return {task: state for (task, name), state in self.selectors.items() if name == selector}


class EstimatesFile:
    """One estimates file. It is created at the first writing; reading a file that does not exist
    gives empty contents."""

    def __init__(self, path: Path, origin: str | None = None) -> None:
        """`origin`: name of the origin of a new file; None: a random one."""
        self.path = path
        self._origin = origin

    # --- reading ------------------------------------------------------------------------------

    def read(self) -> FileContents:
        """Read the whole file. Raises EstimatesError."""
        if not self.path.exists():
            return FileContents()
        with self._open() as db:
            return self._kept(db)

    def _kept(self, db: sqlite3.Connection) -> FileContents:
        if is_empty(db):  # created, but killed before anything was written
            return FileContents()
        about = dict(db.execute("SELECT name, value FROM about"))
        kept = FileContents(about["origin"], int(about["generation"]), about.get(PHYSICS, ""))
        for row in db.execute("SELECT * FROM tally"):
            key = TallyKey(*row[1:4])
            tally = tally_of(row)
            kept.estimates.tallies[key] = merge_tallies(kept.estimates.tally(key), tally)
            kinds = kept.kinds.setdefault((key.primitive_task, key.action), {})
            kind = "simulated campaigns" if row[0].startswith(CAMPAIGN) else "missions"
            kinds[kind] = kinds.get(kind, 0) + tally.runs + tally.censored
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

    def refuse_other_physics(self, kept: FileContents, physics: str) -> None:
        """Raise EstimatesError if the file's contents were learned with another physics."""
        if kept.estimates.tallies or kept.estimates.flows or kept.selectors:
            _refuse_other_physics(self.path, kept.physics, physics)

    def records_of(self, mission: str) -> int:
        """Return how many records of a mission run the file has counted already."""
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
        physics: str = "",
    ) -> None:
        """Add what a session gained to this file's own origin, and store the states of its
        selectors (primitive task -> state).

        `mission`, `records`: remember that so many records of a mission run are counted, so that
        none counts twice when it is resumed; None: the run finished, nothing to remember. `late`:
        verdicts on runs that this file counted before; sums that were reset since then, or came
        from a copied file, stay as they are. `asked`: by what actions were judged (primitive task
        -> question). `physics`: of the simulated laboratory. Raises EstimatesError, also if the
        file was learned with another one.
        """
        with self._writing() as db:
            self._note_physics(db, physics)
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
        physics: str = "",
    ) -> None:
        """Write all that was counted under a closed origin, to which nothing is ever added (a
        campaign's).

        Writing it a second time changes nothing. What others have added to the file stays, and what
        was reset stays forgotten. `physics`: as for `add`.
        """
        with self._writing() as db:
            self._note_physics(db, physics)
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
        """Replace states of selectors (freezing, overriding by the user)."""
        with self._writing() as db:
            for task, state in selectors.items():
                put_selector(db, task, state)

    def reset(self, primitive_task: str | None = None, *, selectors_only: bool = False) -> None:
        """Forget a primitive task (None: everything): states of selectors, and estimates unless
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
                db.execute("DELETE FROM about WHERE name = ?", (PHYSICS,))

    def merge(self, other: Path) -> None:
        """Merge another file into this one. Raises EstimatesError.

        Estimates: the later version of each origin. Selectors: the state that has learned from more
        trials.
        """
        if not other.exists():
            raise EstimatesError(
                f"{other}: no such file; give an estimates file that `run --learn` has written"
            )
        with EstimatesFile(other)._open() as db:
            if is_empty(db):
                return
            origin, physics = fact(db, "origin"), fact(db, PHYSICS)
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
            if any(rows.values()):
                self._note_physics(mine, physics)
            for table in ("tally", "flow", "question"):
                take_later(mine, table, rows[table])
            for task, name, state in states:
                take_selector(mine, task, name, state, origin)
            mine.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", gone)
            forget(mine)

    # --- the database -------------------------------------------------------------------------

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """Run one transaction, which sees no half-written work of other processes; creates the file
        if necessary."""
        try:
            make_folder(self.path.parent)
        except OSError as fault:
            raise EstimatesError(
                f"{self.path}: cannot create its folder: {fault.strerror}; give another path"
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
                self.path.unlink()  # created by this attempt, on a disk that is full
            raise

    def _note_physics(self, db: sqlite3.Connection, physics: str) -> None:
        """Note the physics of what is added, or refuse it if that of the contents is another."""
        tables = ("tally", "flow", "selector")
        if any(db.execute(f"SELECT 1 FROM {name} LIMIT 1").fetchone() for name in tables):
            _refuse_other_physics(self.path, fact(db, PHYSICS), physics)
        if physics:
            db.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (PHYSICS, physics))

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
        """Give a copied file a new origin; the sums that it contains stay those of the old one."""
        here = _home(self.path)
        known = db.execute("SELECT value FROM about WHERE name = 'home'").fetchone()
        if known is not None and known[0] != here:
            renew_origin(db)
        db.execute("INSERT OR REPLACE INTO about VALUES ('home', ?)", (here,))

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """Open and check the database. Every fault of the file becomes an EstimatesError."""
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
                f"{self.path}: not an estimates file, but another database; give --learn "
                "another file"
            )
        if not 1 <= version <= SCHEMA:
            raise EstimatesError(
                f"{self.path}: expected schema {SCHEMA} or older, got {version}; "
                f"{'upgrade petrobot' if version > SCHEMA else 'start a new file'} or give "
                "another one"
            )


def _refuse_other_physics(path: Path, recorded: str, now: str) -> None:
    if not same_physics(recorded, now):
        raise EstimatesError(
            f"{path}: learned in a laboratory with the physics {recorded or FIRST_PHYSICS!r}, to "
            f"be used with {now or FIRST_PHYSICS!r}: estimates of different physics are not "
            "pooled; "
            "give another file, or write the same `physics` in services.toml ([nodes.NAME] of the "
            "simulated node)"
        )


def _home(path: Path) -> str:
    """Identify the file and its machine: different after copying, the same after renaming."""
    machine = (
        MACHINE_ID.read_text(encoding="ascii", errors="replace").strip()
        if MACHINE_ID.is_file()
        else ""
    )
    return f"{machine}:{path.stat().st_ino}"
