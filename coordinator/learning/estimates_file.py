"""The estimates file: keeps in SQLite what was learned, across mission runs, and merges files of
several machines.

Each file has its own origin (a random name) and stores the sums of each origin separately. A merge
takes the later version of each origin's sums, so merging is idempotent, commutative and
associative: no run counts twice, however often and in which order files are merged. What was reset
stays forgotten, because the file remembers the reset origins. A copy of a file gets a new origin as
soon as something is added to it, so two copies that both grow lose nothing when they are merged.
The runs of a campaign have a closed origin: it is the same in every file that counts the campaign,
so nothing else is ever added under it. Each origin belongs to one plant (scripted, simulated or
real): estimates of different plants are in one file, but are never pooled.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.learning.estimates_tables import (
    APPLICATION,
    CAMPAIGN,
    CHOICE,
    COSTS,
    COUNTED,
    FLOWS,
    IN,
    PLANT,
    SCHEMA,
    SUMS,
    TABLES,
    TALLIES,
    TRIAL,
    TRIALS,
    SumsTable,
    correct_tally,
    count_session,
    fact,
    forget,
    is_empty,
    migrate,
    plants,
    put_fact,
    put_question,
    put_selector,
    question_of,
    questions,
    renew_origin,
    schema,
    selector_name,
    state_of,
    take_later,
    take_selector,
    use_plant,
)
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Correction
from petrobot.services.comm.location_file import (
    DRY_RUN,
    FIRST_PHYSICS,
    MOCK,
    REAL,
    SIMULATED,
    same_physics,
)
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import make_folder

BUSY = 20.0
"""Seconds that a command waits while another one writes the file."""
REMEDY = "give --learn a file that can be written, in a folder that can be"
UNWRITABLE = {
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_READONLY,
}
"""SQLite's primary result codes for a file that is not damaged. A full disk is SQLITE_IOERR where
the file of its shared memory cannot grow."""
PHYSICS = "physics"
"""Row of the table `about`."""
MACHINE_ID = Path("/etc/machine-id")
"""Distinguishes machines (machine-id(5)). Without it, only the inode of the file tells copies
apart."""


class EstimatesError(InputError):
    """The estimates file cannot be used; the text names the file, what is wrong and what to do."""


class FileContents(Struct):
    """Contents of a file: estimates of one plant, all origins together, and states of selectors by
    (primitive task, selector)."""

    origin: str = ""
    generation: int = 0
    """Number of mission runs learned from so far."""
    physics: str = ""
    """Name and version of the physics of the simulated laboratory in which all of it was learned;
    empty: unknown."""
    plant: str = ""
    """Plant of the runs in `estimates`, `kinds` and `states`; empty: unknown."""
    plants: dict[str, Estimates] = field(default_factory=dict)
    """The estimates of every plant of the file."""
    selectors: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    """Of every plant; the selector's name is followed by ` in PLANT`."""
    kinds: dict[tuple[str, str], dict[str, int]] = field(default_factory=dict)
    """By (primitive task, action): in which kind of runs it was measured, and how often."""
    priors: dict[str, tuple[str, float]] = field(default_factory=dict)
    """By plant: the plant whose estimates its learners had as a prior, and for how many trials each
    action's counted."""
    asked: dict[str, tuple[Question, ...]] = field(default_factory=dict)
    """By primitive task: the questions (cost measure, target, rho) by which its actions were judged
    when they ran. Several if origins differ; the first one is this file's own, otherwise the one of
    the most sessions."""

    def rank(self, plant: str) -> tuple[int, int]:
        """Sort key of plants: the one that matters most first."""
        kinds = (REAL, SIMULATED, "", DRY_RUN, MOCK)
        runs = sum(t.runs + t.censored for t in self.plants[plant].tallies.values())
        return kinds.index(plant.partition(" ")[0]), -runs

    def question(self, primitive_task: str) -> Question:
        """Return by what the actions of a primitive task are judged unless the user asks
        otherwise."""
        if self.asked.get(primitive_task):
            return self.asked[primitive_task][0]
        states = (state for (task, _), state in self.selectors.items() if task == primitive_task)
        return Question(next((str(state["cost"]) for state in states if state.get("cost")), "wall"))

    @property
    def estimates(self) -> Estimates:
        """The estimates of the plant."""
        return self.plants.setdefault(self.plant, Estimates())

    def states(self, selector: str) -> dict[str, dict[str, Any]]:
        """Return the states of one kind of selector in the plant by primitive task."""
        kept = selector_name(selector, self.plant)
        return {task: state for (task, name), state in self.selectors.items() if name == kept}


class EstimatesFile:
    """One estimates file. It is created at the first writing; reading a file that does not exist
    gives empty contents."""

    def __init__(self, path: Path, origin: str | None = None) -> None:
        """`origin`: name of the origin of a new file; None: a random one."""
        self.path = path
        self._origin = origin

    # --- reading ------------------------------------------------------------------------------

    def read(self, plant: str | None = None) -> FileContents:
        """Read the whole file. `plant`: the plant of `estimates`; None: the one that
        matters most among those in the file (real, then simulated, unknown, mock; of several real
        ones the one with the most runs). Raises EstimatesError."""
        if not self.path.exists():
            return FileContents(plant=plant or "")
        with self._open() as db:
            return self._kept(db, plant)

    def _kept(self, db: sqlite3.Connection, plant: str | None) -> FileContents:
        if is_empty(db):  # created, but killed before anything was written
            return FileContents(plant=plant or "")
        about = dict(db.execute("SELECT name, value FROM about"))
        kept = FileContents(about["origin"], int(about["generation"]), about.get(PHYSICS, ""))
        places = plants(db)
        kinds: dict[str, dict[tuple[str, str], dict[str, int]]] = {}
        for table in SUMS:
            for row in table.rows(db):
                where, (key, sums) = places.get(row[0], ""), table.read(row)
                into = table.of(kept.plants.setdefault(where, Estimates()))
                into[key] = into[key].merged(sums) if key in into else sums
                if table is TALLIES:
                    by_action = kinds.setdefault(where, {})
                    by_kind = by_action.setdefault((key.primitive_task, key.action), {})
                    kind = _kind(where, campaign=row[0].startswith(CAMPAIGN))
                    by_kind[kind] = by_kind.get(kind, 0) + sums.runs + sums.censored
        for task, name, state in db.execute("SELECT primitive_task, name, state FROM selector"):
            kept.selectors[task, name] = json.loads(state)
            kept.plants.setdefault(name.partition(IN)[2], Estimates())
        kept.plant = min(kept.plants, key=kept.rank, default="") if plant is None else plant
        kept.kinds = kinds.get(kept.plant, {})
        for name, value in about.items():
            if name.startswith(PRIOR):
                trials, _, of = value.partition(" ")
                kept.priors[name.removeprefix(PRIOR)] = (of, float(trials))
        for origin, task, _, *asked in sorted(
            questions(db), key=lambda row: (row[0] != kept.origin, -row[2], row[0])
        ):
            known = kept.asked.get(task, ())
            question = question_of(asked, about.get(f"{COSTS}{origin} {task}", ""))
            kept.asked[task] = known if question in known else (*known, question)
        return kept

    def refuse_other_physics(self, kept: FileContents, physics: str) -> None:
        """Raise EstimatesError if the file's simulated runs had another physics, and those of the
        plant that was read are to have this one."""
        if has_physics(kept.plant) and any(map(has_physics, kept.plants)):
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
        plant: str = "",
        prior: tuple[str, float] | None = None,
    ) -> None:
        """Add what a session gained to this file's own origin, and store the states of its
        selectors (primitive task -> state).

        `mission`, `records`: remember that so many records of a mission run are counted, so that
        none counts twice when it is resumed; None: it cannot be. `late`: verdicts on runs that
        this file counted before; sums that were reset since then, or came from a copied file, stay
        as they are. `asked`: by what actions were judged (primitive task -> question). `physics`:
        of the simulated laboratory. `plant`: where the runs took place. `prior`: the plant whose
        estimates its learners started from, and how many trials they counted. Raises
        EstimatesError, also if the file was learned with another physics.
        """
        with self._writing() as db:
            self._note_physics(db, physics, plant)
            if fact(db, "origin") == fact(db, "closed"):
                renew_origin(db)
            use_plant(db, plant)
            if prior is not None:
                put_fact(db, PRIOR + plant, f"{prior[1]:g} {prior[0]}")
            origin = fact(db, "origin")
            if fact(db, COUNTED + mission) == origin:
                for correction in late:
                    correct_tally(db, origin, correction)
            for table in SUMS:
                for key, sums in table.of(gained).items():
                    table.add(db, origin, key, sums)
            for task, state in selectors.items():
                put_selector(db, task, state, selector_name(state["selector"], plant))
            for task, question in (asked or {}).items():
                row = db.execute(
                    "SELECT version FROM question WHERE origin = ? AND primitive_task = ?",
                    (origin, task),
                )
                put_question(db, origin, task, question, (row.fetchone() or (0,))[0] + 1)
            if not db.execute("SELECT 1 FROM mission WHERE id = ?", (mission,)).fetchone():
                count_session(db)
            if records is not None:
                db.execute("INSERT OR REPLACE INTO mission VALUES (?, ?)", (mission, records))
                put_fact(db, COUNTED + mission, origin)

    def put_closed(
        self,
        origin: str,
        estimates: Estimates,
        selectors: Mapping[str, Mapping[str, Any]],
        asked: Mapping[str, Question],
        physics: str = "",
        plant: str = "",
    ) -> None:
        """Write all that was counted under a closed origin, to which nothing is ever added (a
        campaign's).

        Writing it a second time changes nothing. What others have added to the file stays, and what
        was reset stays forgotten. `physics`, `plant`: as for `add`.
        """
        with self._writing() as db:
            self._note_physics(db, physics, plant)
            if plant:
                put_fact(db, PLANT + origin, plant)
            db.execute("INSERT OR IGNORE INTO about VALUES ('closed', ?)", (origin,))
            gone = {
                task
                for (task,) in db.execute(
                    "SELECT primitive_task FROM forgotten WHERE origin = ?", (origin,)
                )
            }

            def take(table: SumsTable) -> None:
                # what is kept of whole tasks is forgotten under the name ""
                rows = [
                    table.row(origin, key, sums)
                    for key, sums in table.of(estimates).items()
                    if getattr(key, "primitive_task", "") not in gone
                ]
                take_later(db, table.name, rows)

            take(TRIALS)
            before = db.total_changes
            take(TALLIES)
            take(FLOWS)
            if db.total_changes > before:
                count_session(db)
            for task, state in selectors.items():
                take_selector(db, task, selector_name(state["selector"], plant), state, origin)
            for task, question in asked.items():
                if task not in gone:
                    put_question(db, origin, task, question, 1)

    def put_selectors(self, selectors: Mapping[tuple[str, str], Mapping[str, Any]]) -> None:
        """Replace states of selectors, by (primitive task, name) as `FileContents` has them
        (freezing, overriding by the user)."""
        with self._writing() as db:
            for (task, name), state in selectors.items():
                put_selector(db, task, state, name)

    def reset(
        self,
        primitive_task: str | None = None,
        *,
        selectors_only: bool = False,
        plant: str | None = None,
    ) -> None:
        """Forget a primitive task (None: everything) in a plant (None: in all): states of
        selectors, and estimates unless `selectors_only`."""
        with self._writing() as db:
            where = plants(db)
            db.create_function("plant_of", 1, lambda origin: where.get(origin, ""))
            db.create_function("learned_in", 1, lambda name: name.partition(IN)[2])
            task = "coalesce(:task, primitive_task) = primitive_task"
            given = {"task": primitive_task, "plant": plant}
            which = f"WHERE {task} AND coalesce(:plant, learned_in(name)) = learned_in(name)"
            tasks = db.execute(f"SELECT primitive_task FROM selector {which}", given).fetchall()
            own = {fact(db, "origin"), fact(db, "closed")} - {""}
            choices = [(origin, CHOICE + task) for origin in sorted(own) for (task,) in tasks]
            db.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", choices)
            db.execute(f"DELETE FROM selector {which}", given)
            renew_origin(db)
            if selectors_only:
                return
            there = "coalesce(:plant, plant_of(origin)) = plant_of(origin)"
            which = f"WHERE {task} AND {there}"
            db.execute(
                "INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, primitive_task "
                f"FROM tally {which}",
                given,
            )
            db.execute(f"DELETE FROM tally {which}", given)
            db.execute(f"DELETE FROM question {which}", given)
            if primitive_task is None:
                db.execute(
                    "INSERT OR IGNORE INTO forgotten SELECT DISTINCT origin, '' "
                    f"FROM flow WHERE {there}",
                    given,
                )
                db.execute(f"DELETE FROM flow WHERE {there}", given)
                db.execute(f"DELETE FROM trial WHERE {there}", given)
                if plant is None or has_physics(plant):
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
            rows = {table.name: table.rows(db) for table in SUMS}
            rows["question"] = questions(db)
            selectors = db.execute("SELECT primitive_task, name, state FROM selector").fetchall()
            gone = db.execute("SELECT * FROM forgotten").fetchall()
            places, simulated = plants(db), _simulated(db)
            for table in SUMS:
                for row in rows[table.name]:
                    table.read(row)
            costs = {}
            for own, task, _, *asked in rows["question"]:
                costs[own, task] = fact(db, f"{COSTS}{own} {task}")
                question_of(asked, costs[own, task])
            states = [(task, name, state_of(body)) for task, name, body in selectors]
        with self._writing() as mine:
            if simulated:
                self._note_physics(mine, physics)
            for own, place in places.items():
                put_fact(mine, PLANT + own, place)
            for name, learned in rows.items():
                take_later(mine, name, learned)
            for task, name, state in states:
                take_selector(mine, task, name, state, origin)
            mine.executemany("INSERT OR IGNORE INTO forgotten VALUES (?, ?)", gone)
            for own, task, *_ in {*rows["question"]} & {*questions(mine)}:
                put_fact(mine, f"{COSTS}{own} {task}", costs[own, task] or "[]")
            forget(mine)

    # --- the database -------------------------------------------------------------------------

    def refuse_unwritable(self) -> None:
        """Raises EstimatesError if no file can be made here: a run that learns asks before it
        begins."""
        try:
            folder = next(p for p in self.path.absolute().parents if p.exists())
            with TemporaryFile(dir=folder):  # it has no name, so nothing is left of it
                pass
        except OSError as fault:
            raise EstimatesError(f"{self.path}: {fault.strerror}; {REMEDY}") from fault

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
                db.execute(TRIAL)
                self._settle(db)
                yield db
                db.execute("COMMIT")
        except EstimatesError:
            if not existed and self.path.is_file() and not self.path.stat().st_size:
                self.path.unlink()  # created by this attempt, on a disk that is full
            raise

    def _note_physics(self, db: sqlite3.Connection, physics: str, plant: str = "") -> None:
        """Note the physics of what is added, or refuse it if that of the contents is another. Only
        simulated runs have one; runs of an unknown plant count as simulated here."""
        if not has_physics(plant):
            return
        if _simulated(db):
            _refuse_other_physics(self.path, fact(db, PHYSICS), physics)
        if physics:
            put_fact(db, PHYSICS, physics)

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
            remedy = "restore it from a copy, or give --learn another file"
            if getattr(fault, "sqlite_errorcode", 0) & 0xFF in UNWRITABLE:
                remedy = REMEDY
            raise EstimatesError(f"{self.path}: {fault}; {remedy}") from fault
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


PRIOR = "prior of "
"""Prefix of a plant in the table `about`."""


def _kind(plant: str, *, campaign: bool) -> str:
    """Return the kind of runs, in words."""
    if campaign:
        return f"{plant or SIMULATED} campaigns"
    return f"missions ({plant})" if plant else "missions"


def said(plant: str) -> str:
    """Return a plant in words."""
    return plant or "not said"


def has_physics(plant: str) -> bool:
    """Return whether runs of a plant depend on the physics of the simulated laboratory."""
    return plant.partition(" ")[0] not in (MOCK, DRY_RUN, REAL)


def _simulated(db: sqlite3.Connection) -> bool:
    """Return whether the file contains anything whose physics counts."""
    places = plants(db)
    return any(
        has_physics(places.get(origin, ""))
        for table in ("tally", "flow")
        for (origin,) in db.execute(f"SELECT DISTINCT origin FROM {table}")
    ) or any(
        has_physics(name.partition(IN)[2]) for (name,) in db.execute("SELECT name FROM selector")
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
