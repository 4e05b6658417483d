"""The tables of an estimates file: their contents, and the statements that read and change them."""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import inf
from typing import Any, Protocol

from msgspec import Struct
from msgspec.structs import astuple

from petrobot.coordinator.learning.estimate import (
    Firings,
    FiringsKey,
    Tally,
    TallyKey,
    TrialsKey,
    TrialSums,
)
from petrobot.coordinator.learning.learning import Estimates, corrected
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Correction
from petrobot.coordinator.learning.selectors import TOGETHER

State = Mapping[str, Any]


def trials(state: State) -> float:
    """Return the number of trials that a state has learned from, in all contexts. Raises KeyError,
    TypeError or ValueError for anything that is not a state."""
    return sum(float(learner["k"]) for learner in state["learners"].values())


def joined(mine: State, other: State) -> dict[str, Any]:
    """Join two states of one selector that learned separately: take the learner with more trials in
    each context, and `frozen` from `mine`.

    States over different actions do not mix: the one with more trials is taken as a whole. Contexts
    are sorted and ties are decided by the text of the learners, so that merged files agree,
    whichever of them merged the other.
    """
    if list(mine["actions"]) != list(other["actions"]):
        return {**(other if _rank(other) > _rank(mine) else mine), "frozen": mine["frozen"]}
    learners = dict(mine["learners"])
    for context, learner in other["learners"].items():
        if context not in learners or _weight(learner) > _weight(learners[context]):
            learners[context] = learner
    whole = {**mine, "learners": dict(sorted(learners.items()))}
    if TOGETHER in other:  # the learner over combinations of actions
        whole[TOGETHER] = (
            joined(mine[TOGETHER], other[TOGETHER]) if TOGETHER in mine else other[TOGETHER]
        )
    return whole


def _rank(state: State) -> tuple[float, str]:
    return trials(state), json.dumps(state["learners"], sort_keys=True)


def _weight(learner: Mapping[str, Any]) -> tuple[float, str]:
    return float(learner["k"]), json.dumps(learner, sort_keys=True)


SCHEMA = 2
"""Schema 1 had no table `question`. Files of schema 1 are still read; they become schema 2 when
something is written to them."""
APPLICATION = 0x70657472
""""petr": SQLite's application_id of these files."""
CHOICE = "choice of "
"""Prefix of a primitive task's name in the table `forgotten`: only the states of its selectors are
forgotten, not its estimates."""
COSTS = "declared costs of "
"""Prefix of an origin and a primitive task in the table `about`; the value is what the task file
declared as the costs of actions, as JSON."""
COUNTED = "counted "
"""Prefix of a mission run's id in the table `about`: the origin under which its runs were counted
when it was interrupted."""
CAMPAIGN = "campaign/"
"""Prefix of the origins of campaigns."""
PLANT = "plant of "
"""Prefix of an origin in the table `about`: the plant in which its runs took place. Files that are
older than this do not say it."""
ORIGIN_OF = "origin of "
"""Prefix of a plant in the table `about`: the origin under which this file counts its runs."""

QUESTION = """
CREATE TABLE question(origin TEXT, primitive_task TEXT, version INTEGER NOT NULL,
  cost TEXT NOT NULL, target REAL, rho REAL, PRIMARY KEY(origin, primitive_task)) WITHOUT ROWID
"""
TRIAL = """
CREATE TABLE IF NOT EXISTS trial(origin TEXT, task TEXT, context TEXT, version INTEGER NOT NULL,
  body TEXT NOT NULL, PRIMARY KEY(origin, task, context)) WITHOUT ROWID
"""
"""Sums of trials of whole tasks. Files that are older than this table get it when something is
written to them."""
TABLES = f"""
CREATE TABLE about(name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE tally(origin TEXT, primitive_task TEXT, action TEXT, context TEXT,
  version INTEGER NOT NULL, body TEXT NOT NULL,
  PRIMARY KEY(origin, primitive_task, action, context)) WITHOUT ROWID;
CREATE TABLE flow(origin TEXT, task TEXT, transition_name TEXT, context TEXT,
  version INTEGER NOT NULL, body TEXT NOT NULL,
  PRIMARY KEY(origin, task, transition_name, context)) WITHOUT ROWID;
CREATE TABLE selector(primitive_task TEXT, name TEXT, trials REAL NOT NULL, state TEXT NOT NULL,
  PRIMARY KEY(primitive_task, name)) WITHOUT ROWID;
CREATE TABLE forgotten(origin TEXT, primitive_task TEXT,
  PRIMARY KEY(origin, primitive_task)) WITHOUT ROWID;
CREATE TABLE mission(id TEXT PRIMARY KEY, records INTEGER NOT NULL) WITHOUT ROWID;
{QUESTION};
{TRIAL};
"""


def is_empty(db: sqlite3.Connection) -> bool:
    """Return whether nothing was ever written: a kill can leave such a file."""
    return int(db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]) == 0


def schema(db: sqlite3.Connection) -> int:
    """Return the schema version; 0 if the file does not say."""
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def migrate(db: sqlite3.Connection) -> None:
    """Migrate from schema 1. A campaign's own origin is closed from now on; what was added to it
    before cannot be separated."""
    db.execute(QUESTION)
    origin = fact(db, "origin")
    if origin.startswith(CAMPAIGN):
        db.execute("INSERT OR IGNORE INTO about VALUES ('closed', ?)", (origin,))
    db.execute(f"PRAGMA user_version = {SCHEMA}")


def count_session(db: sqlite3.Connection) -> None:
    """Count one more session, so that the next one draws other actions."""
    db.execute("UPDATE about SET value = CAST(value AS INTEGER) + 1 WHERE name = 'generation'")


def renew_origin(db: sqlite3.Connection) -> None:
    """Start a new origin: what is added from now on is stored separately from what was added
    before."""
    db.execute("UPDATE about SET value = ? WHERE name = 'origin'", (secrets.token_hex(8),))
    db.execute("DELETE FROM about WHERE substr(name, 1, ?) = ?", (len(ORIGIN_OF), ORIGIN_OF))


def use_plant(db: sqlite3.Connection, plant: str) -> None:
    """Let what is added now count for a plant: each origin belongs to one, so that no merge can
    pool two of them."""
    origin = fact(db, "origin")
    if plant == fact(db, PLANT + origin):
        return
    used = any(
        db.execute(f"SELECT 1 FROM {table} WHERE origin = ? LIMIT 1", (origin,)).fetchone()
        for table in ("tally", "flow", "question")
    )
    if used or fact(db, PLANT + origin):
        put_fact(db, ORIGIN_OF + fact(db, PLANT + origin), origin)
        put_fact(db, "origin", fact(db, ORIGIN_OF + plant) or secrets.token_hex(8))
    if plant:
        put_fact(db, PLANT + fact(db, "origin"), plant)


def plants(db: sqlite3.Connection) -> dict[str, str]:
    """Return the plant of each origin that says it."""
    rows = db.execute(
        "SELECT substr(name, ?), value FROM about WHERE substr(name, 1, ?) = ?",
        (len(PLANT) + 1, len(PLANT), PLANT),
    )
    return dict(rows.fetchall())


def fact(db: sqlite3.Connection, name: str) -> str:
    """Return a value of the table `about`; "" if it is missing."""
    row = db.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
    return str(row[0]) if row else ""


def put_fact(db: sqlite3.Connection, name: str, value: str) -> None:
    """Set a value of the table `about`."""
    db.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (name, value))


class Sums(Protocol):
    """Sums over runs, firings or trials; `changes` is their version."""

    @property
    def changes(self) -> int: ...

    def merged(self, other: Any) -> Any: ...

    def to_plain(self) -> Any: ...


class SumsTable(Struct, frozen=True):
    """A table of sums: a row holds an origin, the parts of a key, the version, and the sums as
    JSON."""

    name: str
    columns: tuple[str, ...]
    """Those of the primary key."""
    key: Callable[..., Any]
    read_plain: Callable[[Any], Sums]
    of: Callable[[Estimates], dict[Any, Any]]
    """Returns what the table keeps of estimates."""
    title: str
    """Format of a key in messages."""
    added_later: bool = False
    """Old files are without the table until something is written to them."""

    def rows(self, db: sqlite3.Connection) -> list[tuple[Any, ...]]:
        """Return all rows."""
        if self.added_later:
            known = "SELECT 1 FROM sqlite_master WHERE name = ?"
            if not db.execute(known, (self.name,)).fetchone():
                return []
        return db.execute(f"SELECT * FROM {self.name}").fetchall()

    def row(self, origin: str, key: Any, sums: Sums) -> tuple[Any, ...]:
        """Return a row."""
        body = json.dumps(sums.to_plain(), separators=(",", ":"))
        return origin, *astuple(key), sums.changes, body

    def read(self, row: Sequence[Any]) -> tuple[Any, Any]:
        """Return key and sums of a row. Raises ValueError naming it."""
        _, *parts, version, body = row
        key = self.key(*parts)
        try:
            sums = self.read_plain(json.loads(body))
            if sums.changes != version:
                # a version that is too high would win every merge, whatever the contents
                raise ValueError(
                    f"expected version {sums.changes}, the number of changes, got {version}"
                )
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as fault:
            said = f"{fault} is missing" if isinstance(fault, KeyError) else str(fault)
            context = f" ({key.context})" if key.context else ""
            raise ValueError(f"{self.title.format(key=key)}{context}: {said}") from fault
        return key, sums

    def own(self, db: sqlite3.Connection, origin: str, key: Any) -> Any:
        """Return the sums of an origin; None if it has none."""
        where = " AND ".join(f"{column} = ?" for column in self.columns)
        row = db.execute(
            f"SELECT * FROM {self.name} WHERE {where}", (origin, *astuple(key))
        ).fetchone()
        return row and self.read(row)[1]

    def put(self, db: sqlite3.Connection, origin: str, key: Any, sums: Sums) -> None:
        """Replace the sums of an origin."""
        row = self.row(origin, key, sums)
        marks = ", ".join("?" for _ in row)
        db.execute(f"INSERT OR REPLACE INTO {self.name} VALUES ({marks})", row)

    def add(self, db: sqlite3.Connection, origin: str, key: Any, gained: Sums) -> None:
        """Add to the sums of an origin."""
        own: Sums | None = self.own(db, origin, key)
        self.put(db, origin, key, gained if own is None else own.merged(gained))


TALLIES = SumsTable(
    "tally",
    ("origin", "primitive_task", "action", "context"),
    TallyKey,
    Tally.of_plain,
    lambda estimates: estimates.tallies,
    "{key.primitive_task}, {key.action}",
)
FLOWS = SumsTable(
    "flow",
    ("origin", "task", "transition_name", "context"),
    FiringsKey,
    Firings.of_plain,
    lambda estimates: estimates.flows,
    "transition {key.transition}",
)
TRIALS = SumsTable(
    "trial",
    ("origin", "task", "context"),
    TrialsKey,
    TrialSums.of_plain,
    lambda estimates: estimates.trials,
    "trials of {key.task}",
    added_later=True,
)
SUMS = (TALLIES, FLOWS, TRIALS)


def correct_tally(db: sqlite3.Connection, origin: str, correction: Correction) -> None:
    """Apply a verdict to a run that an origin's sums have counted; do nothing if they have not."""
    key = TallyKey(correction.primitive_task, correction.action, correction.context)
    with suppress(KeyError):  # the origin no longer contains the run
        own = TALLIES.own(db, origin, key) or Tally()
        TALLIES.put(db, origin, key, corrected(own, correction))


def put_question(
    db: sqlite3.Connection, origin: str, task: str, asked: Question, version: int
) -> None:
    """Store by what an origin judges the actions of a primitive task."""
    row = (origin, task, version, asked.measure, asked.target, asked.rho)
    db.execute("INSERT OR REPLACE INTO question VALUES (?, ?, ?, ?, ?, ?)", row)
    put_fact(db, f"{COSTS}{origin} {task}", json.dumps(asked.declared))


def questions(db: sqlite3.Connection) -> list[tuple[Any, ...]]:
    """Return the rows of the table `question`; none in a file of schema 1."""
    return db.execute("SELECT * FROM question").fetchall() if schema(db) > 1 else []


def question_of(row: Sequence[Any], costs: str = "") -> Question:
    """Read cost, target and rho; `costs`: the declared ones as JSON. Raises ValueError."""
    cost, target, rho = row
    Tally().cost(cost)
    if target is not None and not 0 < target <= 1:
        raise ValueError(f"target: expected a reliability above 0 and up to 1, got {target!r}")
    if rho is not None and not 0 <= rho < inf:
        raise ValueError(f"rho: expected a number from 0, got {rho!r}")
    declared = tuple((str(action), float(c)) for action, c in json.loads(costs or "[]"))
    return Question(cost, target, rho, declared=declared)


def put_selector(db: sqlite3.Connection, task: str, state: Mapping[str, Any], name: str) -> None:
    """Replace the state of a selector; `name`: its name in this plant (`selector_name`)."""
    body = json.dumps(state, separators=(",", ":"))
    db.execute(
        "INSERT OR REPLACE INTO selector VALUES (?, ?, ?, ?)", (task, name, trials(state), body)
    )


IN = " in "
"""Between the name of a selector and the plant in which it learned."""


def selector_name(selector: str, plant: str) -> str:
    """Return the name under which a selector's state is kept: a learner never mixes plants."""
    return f"{selector}{IN}{plant}" if plant else selector


def take_selector(
    db: sqlite3.Connection, task: str, name: str, state: Mapping[str, Any], origin: str
) -> None:
    """Merge the state of another file, unless what was learned under that origin was reset here."""
    if db.execute(
        "SELECT 1 FROM forgotten WHERE origin = ? AND primitive_task = ?", (origin, CHOICE + task)
    ).fetchone():
        return
    row = db.execute(
        "SELECT state FROM selector WHERE primitive_task = ? AND name = ?", (task, name)
    ).fetchone()
    put_selector(db, task, state if row is None else joined(state_of(row[0]), state), name)


def forget(db: sqlite3.Connection) -> None:
    """Delete what any of the merged files has reset. If that includes this file's own origin, start
    a new one."""
    for table, forgotten in (
        ("tally", "tally.primitive_task"),
        ("question", "question.primitive_task"),
        ("flow", "''"),
        ("trial", "''"),
    ):
        db.execute(
            f"DELETE FROM {table} WHERE EXISTS (SELECT 1 FROM forgotten f WHERE f.origin = "
            f"{table}.origin AND f.primitive_task = {forgotten})"
        )
    gone = {origin for (origin,) in db.execute("SELECT DISTINCT origin FROM forgotten")}
    others = db.execute(
        "SELECT name, value FROM about WHERE substr(name, 1, ?) = ?", (len(ORIGIN_OF), ORIGIN_OF)
    ).fetchall()
    for name, origin in others:
        if origin in gone:
            db.execute("DELETE FROM about WHERE name = ?", (name,))
    if fact(db, "origin") in gone:
        renew_origin(db)


def take_later(db: sqlite3.Connection, table: str, rows: Sequence[Sequence[Any]]) -> None:
    """Insert rows that are not there yet or that have a later version than those that are."""
    columns = [(name, key) for _, name, _, _, _, key in db.execute(f"PRAGMA table_info({table})")]
    keys = ", ".join(name for name, key in columns if key)
    body = ", ".join(f"{name} = excluded.{name}" for name, key in columns if not key)
    marks = ", ".join("?" for _ in columns)
    db.executemany(
        f"INSERT INTO {table} VALUES ({marks}) ON CONFLICT({keys}) DO UPDATE SET {body} "
        "WHERE excluded.version > version",
        rows,
    )


def state_of(body: str) -> dict[str, Any]:
    """Read the state of a selector. Raises KeyError, TypeError or ValueError for anything else."""
    state: dict[str, Any] = json.loads(body)
    if not 0 <= trials(state) < inf:  # otherwise it would win, or lose, every merge
        raise ValueError(f"selector: expected a number of trials from 0, got {trials(state):g}")
    return state
