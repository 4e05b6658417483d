"""The estimates file: what is kept, what merges, what stays reset, and how a bad file is
refused."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.coordinator.learning.estimate import (
    Firings,
    FiringsKey,
    Observation,
    TallyKey,
    TrialsKey,
    TrialSums,
)
from petrobot.coordinator.learning.estimates_file import EstimatesError, EstimatesFile, FileContents
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.selectors import make
from petrobot.coordinator.task import Status
from tests.learning.conftest import OBSERVATIONS, tally_of

KEY = TallyKey("pick", "pick_fast", "regime=A")
OTHER = TallyKey("place", "place_soft")


def gained(good: int, key: TallyKey = KEY, salt: str = "") -> Estimates:
    """Return what was learned from `good` successes of one action and as many firings."""
    tally = tally_of(
        [Observation(Status.SUCCESS, 0.1 * (i + 1), cpu_seconds=0.01) for i in range(good)], salt
    )
    flow = Firings()
    for _ in range(good):
        flow = flow.adding(0.02)
    sums = TrialSums()
    for i in range(good):
        sums = sums.adding(i % 2 == 0, True, 0.1 * (i + 1), ["pick", "place"])
    trials = {TrialsKey("sorting", "regime=A"): sums}
    return Estimates({key: tally}, {FiringsKey("sorting", "begin", "regime=A"): flow}, trials)


def file_of(path: Path, good: int, key: TallyKey = KEY) -> EstimatesFile:
    """Make a file with its own origin."""
    file = EstimatesFile(path)
    file.add(gained(good, key, path.name), {})
    return file


def known(file: EstimatesFile) -> tuple[Any, Any]:
    """Return a file's estimates in a form that can be compared: everything except the order of
    sums."""
    kept = file.read()
    tallies: dict[Any, Any] = {
        k: (t.counts, t.changes, t.sample) for k, t in kept.estimates.tallies.items()
    }
    tallies |= {k: (t.n, t.success, t.runs) for k, t in kept.estimates.trials.items()}
    return tallies, {k: f.fired for k, f in kept.estimates.flows.items()}


def test_everything_added_is_read_again(tmp_path: Path) -> None:
    """This covers sums of several sessions, selector states and the generation; a missing file
    reads as empty."""
    path = tmp_path / "deep" / "learned.db"
    assert EstimatesFile(path).read() == FileContents()
    selector = make("ucb1", ("pick_fast", "pick_slow"))
    selector.update("regime=A", "pick_fast", Observation(Status.SUCCESS, 1.0))
    for session in range(3):
        EstimatesFile(path).add(gained(4, salt=str(session)), {"pick": selector.state()})
    kept = EstimatesFile(path).read()
    assert kept.generation == 3
    assert kept.estimates.tally(KEY).runs == 12
    assert len(kept.estimates.tally(KEY).sample.kept) == 12
    assert kept.estimates.flows[FiringsKey("sorting", "begin", "regime=A")].waits.n == 12
    assert kept.states("ucb1") == {"pick": selector.state()}
    assert kept.states("thompson") == {}


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seen=OBSERVATIONS.filter(len))
def test_tallies_are_read_exactly_as_written(seen: list[Observation], tmp_path: Path) -> None:
    """This holds for any observations."""
    path = tmp_path / "exact.db"
    path.unlink(missing_ok=True)
    tally = tally_of(seen)
    EstimatesFile(path).add(Estimates({KEY: tally}), {})
    assert EstimatesFile(path).read().estimates.tally(KEY) == tally


def test_merging_counts_every_run_once(tmp_path: Path) -> None:
    """Files of three machines, merged in any order and any number of times, give the same
    result."""
    seen = []
    for order in permutations(range(3)):
        folder = tmp_path / "".join(map(str, order))
        files = [file_of(folder / f"{i}.db", 3 + i, KEY if i else OTHER) for i in range(3)]
        first = files[order[0]]
        for i in (*order[1:], order[1], order[2]):
            first.merge(files[i].path)
        files[order[1]].merge(first.path)
        first.merge(files[order[1]].path)
        tallies, flows = known(first)
        assert known(files[order[1]]) == (tallies, flows)
        seen.append({k: (counts, changes) for k, (counts, changes, _) in tallies.items()})
        assert sum(flows.values()) == 12
    assert all(one == seen[0] for one in seen)
    assert seen[0][KEY][1] == 9


def test_a_merge_takes_the_later_version(tmp_path: Path) -> None:
    """A copy older than the known version changes nothing; a newer one replaces it."""
    one, other = file_of(tmp_path / "one.db", 5), EstimatesFile(tmp_path / "other.db")
    other.merge(one.path)
    one.add(gained(2, salt="more"), {})
    other.merge(one.path)
    assert other.read().estimates.tally(KEY).runs == 7
    one_again = EstimatesFile(tmp_path / "third.db")
    one_again.merge(other.path)
    one_again.merge(one.path)
    assert one_again.read().estimates.tally(KEY).runs == 7


def test_the_selector_that_learned_from_more_is_kept(tmp_path: Path) -> None:
    """Probabilities cannot be summed."""
    states = []
    for name, trials in (("few.db", 3), ("many.db", 30)):
        selector = make("nikolic_fu", ("pick_fast", "pick_slow"))
        for _ in range(trials):
            selector.update("", "pick_slow", Observation(Status.SUCCESS, 1.0))
        states.append(selector.state())
        EstimatesFile(tmp_path / name).add(Estimates(), {"pick": selector.state()})
    few, many = (EstimatesFile(tmp_path / name) for name in ("few.db", "many.db"))
    many.merge(few.path)
    assert many.read().states("nikolic_fu")["pick"] == states[1]
    few.merge(many.path)
    assert few.read().states("nikolic_fu")["pick"] == states[1]


def state_of(name: str, learned: dict[str, int], action: str = "pick_slow") -> dict[str, Any]:
    """Return a selector's state after some successes of one action in each context."""
    selector = make(name, ("pick_fast", "pick_slow"))
    for context, trials in learned.items():
        for _ in range(trials):
            selector.chosen(context, action)
            selector.update(context, action, Observation(Status.SUCCESS, 1.0))
    return selector.state()


def test_learning_in_different_contexts_is_merged(tmp_path: Path) -> None:
    """One machine learned in A and B, the other in B and C: for each context the state with more
    trials is kept, in whichever direction the files merge."""
    states = [
        state_of("nikolic_fu", {"A": 9, "B": 4}),
        state_of("nikolic_fu", {"B": 7, "C": 2}, "pick_fast"),
    ]
    expected = {
        context: states[i]["learners"][context] for context, i in (("A", 0), ("B", 1), ("C", 1))
    }
    for order in ((0, 1), (1, 0)):
        one, other = (EstimatesFile(tmp_path / f"{order[0]}{i}.db") for i in order)
        one.add(Estimates(), {"pick": states[order[0]]})
        other.add(Estimates(), {"pick": states[order[1]]})
        one.merge(other.path)
        assert one.read().states("nikolic_fu")["pick"]["learners"] == expected


def test_states_over_other_actions_are_not_mixed(tmp_path: Path) -> None:
    """Their numbers belong to other actions: the state with more trials is kept whole, frozen or
    not as it was in this file."""
    mine, theirs = make("ucb1", ("pick_fast",)), state_of("ucb1", {"A": 3})
    mine.update("B", "pick_fast", Observation(Status.SUCCESS, 1.0))
    one, other = EstimatesFile(tmp_path / "one.db"), EstimatesFile(tmp_path / "other.db")
    one.add(Estimates(), {"pick": {**mine.state(), "frozen": True}})
    other.add(Estimates(), {"pick": theirs})
    one.merge(other.path)
    assert one.read().states("ucb1")["pick"] == {**theirs, "frozen": True}


def test_a_copy_that_learns_becomes_a_separate_origin(tmp_path: Path) -> None:
    """After a copy to another machine by hand, everything that both learn later counts, and their
    common past counts once."""
    one = file_of(tmp_path / "one.db", 10)
    copy = EstimatesFile(Path(shutil.copy(one.path, tmp_path / "copy.db")))
    one.add(gained(5, salt="one"), {})
    copy.add(gained(3, salt="copy"), {})
    copy.merge(one.path)
    one.merge(copy.path)
    one.merge(copy.path)
    for file in (one, copy):
        assert file.read().estimates.tally(KEY).runs == 18
    renamed = EstimatesFile(one.path.rename(tmp_path / "renamed.db"))
    origin = renamed.read().origin
    renamed.add(gained(1, salt="later"), {})
    assert renamed.read().origin == origin


def test_an_empty_database_file_reads_as_empty(tmp_path: Path) -> None:
    """A process killed between creating the file and its first transaction leaves an empty file: it
    is treated as missing."""
    path = tmp_path / "begun.db"
    path.touch()
    file = EstimatesFile(path)
    assert file.read() == FileContents()
    assert file.records_of("m") == 0
    whole = file_of(tmp_path / "whole.db", 2)
    whole.merge(path)
    assert whole.read().estimates.tally(KEY).runs == 2
    file.add(gained(4), {})
    assert file.read().estimates.tally(KEY).runs == 4


def test_a_damaged_selector_is_not_merged(tmp_path: Path) -> None:
    """One clear error is reported, and the receiving file is unchanged."""
    one, other = file_of(tmp_path / "one.db", 2), EstimatesFile(tmp_path / "other.db")
    other.add(Estimates(), {"pick": state_of("ucb1", {"A": 3})})
    for body in (
        "torn",
        "[]",
        '{"learners": {"A": {}}}',
        '{"learners": {"A": {"k": -5}}}',
        '{"learners": {"A": {"k": NaN}}}',
    ):
        written(other.path, f"UPDATE selector SET state = '{body}'")
        with pytest.raises(EstimatesError, match="do not fit"):
            one.merge(other.path)
    assert not one.read().selectors


@pytest.mark.parametrize("selectors_only", [False, True])
def test_a_selector_that_was_reset_stays_reset(tmp_path: Path, selectors_only: bool) -> None:
    """Not even an old copy of the file restores it; what is learned after the reset is kept."""
    one = file_of(tmp_path / "one.db", 3)
    one.add(Estimates(), {"pick": state_of("nikolic_fu", {"A": 50})})
    copy = Path(shutil.copy(one.path, tmp_path / "copy.db"))
    one.reset("pick", selectors_only=selectors_only)
    one.merge(copy)
    assert not one.read().selectors
    afresh = state_of("nikolic_fu", {"A": 2})
    one.add(Estimates(), {"pick": afresh})
    one.merge(copy)
    assert one.read().states("nikolic_fu")["pick"] == afresh
    assert one.read().estimates.tally(KEY).runs == (3 if selectors_only else 0)


def test_what_is_learned_after_another_files_reset_counts(tmp_path: Path) -> None:
    """A file that learns of a reset of its own runs continues under a new origin, so that the next
    merge does not drop its new runs."""
    one, other = file_of(tmp_path / "one.db", 5), file_of(tmp_path / "other.db", 4)
    one.merge(other.path)
    one.reset("pick")
    other.merge(one.path)
    assert not other.read().estimates.tallies
    other.add(gained(2, salt="after"), {})
    one.merge(other.path)
    other.merge(one.path)
    assert one.read().estimates.tally(KEY).runs == other.read().estimates.tally(KEY).runs == 2


def test_reset_estimates_stay_forgotten(tmp_path: Path) -> None:
    """This holds also when an old copy is merged again; runs after the reset count."""
    one, copy = file_of(tmp_path / "one.db", 5), EstimatesFile(tmp_path / "copy.db")
    one.add(gained(3, OTHER), {})
    copy.merge(one.path)
    one.reset("pick")
    one.add(gained(2, salt="after"), {})
    one.merge(copy.path)
    kept = one.read().estimates
    assert (kept.tally(KEY).runs, kept.tally(OTHER).runs) == (2, 3)
    one.reset()
    one.merge(copy.path)
    assert not one.read().estimates.tallies
    assert not one.read().estimates.flows


def test_selectors_alone_can_be_reset(tmp_path: Path) -> None:
    """The estimates stay: they describe the actions, not the selector that chose them."""
    file = EstimatesFile(tmp_path / "one.db")
    file.add(gained(5), {"pick": make("ucb1", ("pick_fast",)).state()})
    file.reset("pick", selectors_only=True)
    assert file.read().estimates.tally(KEY).runs == 5
    assert not file.read().selectors


def test_two_sessions_at_once_lose_nothing(tmp_path: Path) -> None:
    """Both sessions read the file, and both add what they learned: the sums are added within the
    file, not overwritten."""
    file = file_of(tmp_path / "one.db", 1)
    sessions = [EstimatesFile(tmp_path / "one.db") for _ in range(2)]
    for session in sessions:
        session.read()
    for i, session in enumerate(sessions):
        session.add(gained(4, salt=str(i)), {})
    assert file.read().estimates.tally(KEY).runs == 9


def test_a_reader_sees_the_state_before_an_open_transaction(tmp_path: Path) -> None:
    """SQLite's write-ahead log (WAL): during a transaction, readers see the state before it."""
    file = file_of(tmp_path / "one.db", 3)
    with sqlite3.connect(file.path, isolation_level=None) as db:
        assert db.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
        db.execute("BEGIN IMMEDIATE")
        db.execute("DELETE FROM tally")
        assert file.read().estimates.tally(KEY).runs == 3
        db.execute("ROLLBACK")
    db.close()


def test_records_of_a_mission_are_remembered(tmp_path: Path) -> None:
    """A run that was saved, resumed and saved again counts once."""
    file = EstimatesFile(tmp_path / "one.db")
    assert file.records_of("m") == 0
    file.add(gained(2), {}, "m", 17)
    assert (file.records_of("m"), file.records_of("n")) == (17, 0)


def written(path: Path, statements: str) -> Path:
    """Write a database by hand."""
    db = sqlite3.connect(path)
    db.executescript(statements)
    db.close()
    return path


def asked_of(path: Path, statement: str) -> Path:
    """Write a file with a damaged table of the criteria by which actions were judged."""
    EstimatesFile(path).add(gained(2), {}, asked={"pick": Question("cpu", 0.8, 0.1)})
    return written(path, statement)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda p: p.write_bytes(b"no database at all, but long enough to be looked at" * 9),
            "not a database; restore it",
        ),
        (lambda p: written(p, "CREATE TABLE songs(name)"), "not an estimates file"),
        (lambda p: file_of(p, 2) and written(p, "PRAGMA user_version = 99"), "got 99.*upgrade"),
        (lambda p: file_of(p, 2) and written(p, "PRAGMA user_version = 0"), "got 0.*new file"),
        (lambda p: file_of(p, 2) and written(p, "UPDATE tally SET body = '{}'"), "do not fit"),
        (lambda p: file_of(p, 2) and written(p, "UPDATE tally SET body = 'x'"), "do not fit"),
        (lambda p: file_of(p, 2) and written(p, "DROP TABLE tally"), "no such table"),
        (
            lambda p: asked_of(p, "UPDATE question SET cost = 'pictures'"),
            "'pictures' is not a cost measure",
        ),
        (lambda p: asked_of(p, "UPDATE question SET target = 7"), "target.*got 7.0"),
        (lambda p: asked_of(p, "UPDATE question SET rho = -3"), "rho.*got -3.0"),
        (lambda p: p.mkdir(), "unable to open.*that can be written"),
    ],
    ids=[
        "text",
        "foreign",
        "newer",
        "older",
        "empty body",
        "torn body",
        "no table",
        "cost",
        "target",
        "rho",
        "folder",
    ],
)
def test_a_bad_file_gives_one_clear_error(tmp_path: Path, spoil: Any, said: str) -> None:
    """The error names the file, the fault and the remedy; the file is unchanged."""
    path = tmp_path / "learned.db"
    spoil(path)
    with pytest.raises(EstimatesError, match=said) as fault:
        EstimatesFile(path).read()
    assert str(path) in str(fault.value)
    with pytest.raises(EstimatesError):
        EstimatesFile(tmp_path / "good.db").merge(path)


@pytest.mark.parametrize(
    ("table", "old", "new", "version", "said"),
    [
        (
            "tally",
            '[["success","",2]]',
            '[["success","",-5]]',
            999,
            "pick, pick_fast (regime=A): -5 runs",
        ),
        ("tally", '"unknown":0', '"unknown":7', 2, "pick, pick_fast (regime=A): 7 runs of which"),
        ("tally", '"unknown"', '"unheard"', 2, "'unknown' is missing"),
        ("tally", "{", "{", 999, "expected version 2, the number of changes, got 999"),
        ("flow", "[2,", "[-2,", 999, "transition begin (regime=A): -2 firings"),
        ("flow", "[2,[2,", "[1,[2,", 1, "2 waits: expected a whole number from 0 to 1"),
        ("flow", "[2,", "[2,", 999, "expected version 2"),
    ],
)
def test_a_corrupted_file_does_not_damage_another_file(
    tmp_path: Path, table: str, old: str, new: str, version: int, said: str
) -> None:
    """It is refused by name in every version, and the receiving file is unchanged."""
    one, other = file_of(tmp_path / "one.db", 3), file_of(tmp_path / "other.db", 2)
    written(
        other.path,
        f"UPDATE {table} SET body = replace(body, '{old}', '{new}'), version = {version}",
    )
    before = known(one)
    for use in (other.read, lambda: one.merge(other.path)):
        with pytest.raises(EstimatesError) as fault:
            use()
        assert said in str(fault.value)
        assert str(other.path) in str(fault.value)
    assert known(one) == before


# --- criteria of judgement, and files of schema 1 ---------------------------------------------


def test_the_criteria_by_which_actions_are_judged_are_kept(tmp_path: Path) -> None:
    """They are kept per origin: the file's own criteria win, otherwise those used most often; all
    different ones are listed."""
    one, other, third = (EstimatesFile(tmp_path / f"{i}.db") for i in range(3))
    images, wall = Question("value:images", 0.8, 0.1), Question("wall", 0.9)
    assert one.read().question("pick") == Question()
    for question in (wall, images):
        one.add(gained(1), {}, asked={"pick": question})
    other.add(gained(1), {}, asked={"pick": wall, "place": images})
    assert one.read().asked == {"pick": (images,)}
    for _ in range(2):
        one.merge(other.path)
        other.merge(one.path)
        third.merge(one.path)
    assert one.read().asked == {"pick": (images, wall), "place": (images,)}
    assert other.read().asked == {"pick": (wall, images), "place": (images,)}
    assert third.read().question("pick") == images
    one.reset("pick")
    one.merge(other.path)
    assert set(one.read().asked) == {"place"}


SCHEMA_1 = """
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
PRAGMA application_id = 1885697138;
PRAGMA user_version = 1;
"""
"""A file as petrobot wrote it before schema 2."""


def old_file(path: Path, good: int, origin: str) -> EstimatesFile:
    """Write a file of schema 1 with `good` successes and a selector whose cost is a number of
    images."""
    written(path, SCHEMA_1)
    tally, state = (
        gained(good, salt=origin).tally(KEY),
        state_of("ucb1", {"A": 3}) | {"cost": "value:images"},
    )
    flow = gained(good).flows[FiringsKey("sorting", "begin", "regime=A")]
    with closing(sqlite3.connect(path)) as db, db:
        rows = [("origin", origin), ("generation", "1")]
        db.executemany("INSERT INTO about VALUES (?, ?)", rows)
        where = ("pick", "pick_fast", "regime=A", tally.changes, json.dumps(tally.to_plain()))
        db.execute("INSERT INTO tally VALUES (?, ?, ?, ?, ?, ?)", (origin, *where))
        where = (
            "sorting",
            "begin",
            "regime=A",
            flow.fired,
            json.dumps([flow.fired, flow.waits.to_plain()]),
        )
        db.execute("INSERT INTO flow VALUES (?, ?, ?, ?, ?, ?)", (origin, *where))
        db.execute(
            "INSERT INTO selector VALUES (?, ?, ?, ?)", ("pick", "ucb1", 3.0, json.dumps(state))
        )
    return EstimatesFile(path)


def schema_of(path: Path) -> int:
    """Return the schema of a file on disk."""
    with closing(sqlite3.connect(path)) as db:
        return int(db.execute("PRAGMA user_version").fetchone()[0])


def test_a_file_of_schema_1_is_upgraded_when_something_is_added(tmp_path: Path) -> None:
    """It is read as it is and becomes a file of schema 2 when something is added; nothing is lost
    or counted twice."""
    old = old_file(tmp_path / "old.db", 4, "ab12")
    kept = old.read()
    assert (kept.generation, kept.estimates.tally(KEY).runs, kept.question("pick").measure) == (
        1,
        4,
        "value:images",
    )
    assert schema_of(old.path) == 1
    old.add(gained(3, salt="more"), {}, asked={"pick": Question("cpu", 0.7)})
    kept = old.read()
    assert schema_of(old.path) == 2
    assert (kept.origin, kept.generation, kept.estimates.tally(KEY).runs) == ("ab12", 2, 7)
    assert kept.question("pick") == Question("cpu", 0.7)
    assert set(kept.states("ucb1")) == {"pick"}


def test_old_and_new_files_merge(tmp_path: Path) -> None:
    """They merge in both directions; an old file that is only read is unchanged."""
    old, new = old_file(tmp_path / "old.db", 4, "ab12"), file_of(tmp_path / "new.db", 5)
    for _ in range(2):
        new.merge(old.path)
    assert schema_of(old.path) == 1
    assert new.read().estimates.tally(KEY).runs == 9
    old.merge(new.path)
    old.merge(old_file(tmp_path / "copy.db", 4, "ab12").path)
    assert schema_of(old.path) == 2
    assert known(old) == known(new)


# --- campaigns: closed origins ----------------------------------------------------------------

RUNS = "campaign/0123"
"""The origin of one campaign, the same on every machine."""


def campaign_file(path: Path, good: int = 12) -> EstimatesFile:
    """Write the estimates file that a campaign writes next to its table."""
    file = EstimatesFile(path, RUNS)
    selectors = {"pick": state_of("nikolic_fu", {"regime=A": good})}
    file.put_closed(
        RUNS, gained(good, salt=RUNS), selectors, {"pick": Question("value:images", 0.8)}
    )
    return file


def test_runs_added_to_a_campaigns_file_get_an_origin_of_their_own(tmp_path: Path) -> None:
    """The same campaign ran on two machines, both learned more, and then merge: the campaign's runs
    count once, and so do the runs of each machine."""
    one, other = (campaign_file(tmp_path / f"m{i}.db") for i in (1, 2))
    one.add(gained(6, salt="one"), {})
    one.add(gained(1, salt="one again"), {})
    other.add(gained(9, salt="other"), {})
    both = EstimatesFile(tmp_path / "mm.db")
    for _ in range(2):
        both.merge(one.path)
        both.merge(other.path)
    other.merge(both.path)
    assert known(both) == known(other)
    assert both.read().estimates.tally(KEY).runs == 12 + 7 + 9
    assert both.read().question("pick") == Question("value:images", 0.8)


def test_writing_a_campaign_again_deletes_nothing(tmp_path: Path) -> None:
    """Everything that was run, learned or frozen since stays; nothing counts twice."""
    file = campaign_file(tmp_path / "m.db")
    whole = file.read()
    campaign_file(file.path)
    assert file.read() == whole
    learned = state_of("nikolic_fu", {"regime=A": 30}) | {"frozen": True}
    file.add(gained(6, salt="run"), {"pick": learned}, asked={"pick": Question("wall", 0.5)})
    whole = file.read()
    campaign_file(file.path)
    assert file.read() == whole
    assert whole.estimates.tally(KEY).runs == 18
    assert whole.states("nikolic_fu")["pick"] == learned
    assert whole.asked["pick"] == (Question("wall", 0.5), Question("value:images", 0.8))


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_campaign_that_was_reset_stays_forgotten(tmp_path: Path, goes_on: bool) -> None:
    """It stays forgotten when it is written again, and when another machine's file of it is merged,
    also if a run was added before."""
    file, other = (campaign_file(tmp_path / f"m{i}.db") for i in (1, 2))
    if goes_on:
        file.add(gained(6, salt="run"), {})
    file.reset()
    for again in (lambda: campaign_file(file.path), lambda: file.merge(other.path)):
        again()
        kept = file.read()
        assert not kept.estimates.tallies
        assert not kept.estimates.flows
        assert not kept.selectors
        assert not kept.asked
    file.add(gained(2, salt="afresh"), {})
    other.merge(file.path)
    assert other.read().estimates.tally(KEY).runs == file.read().estimates.tally(KEY).runs == 2


def test_the_origin_of_a_campaigns_file_of_schema_1_is_closed_when_something_is_added(
    tmp_path: Path,
) -> None:
    """A run added after the update therefore merges, and writing the campaign again removes
    nothing."""
    one, other = (old_file(tmp_path / f"m{i}.db", 12, RUNS) for i in (1, 2))
    one.add(gained(6, salt="one"), {})
    assert one.read().origin != RUNS
    campaign_file(other.path)
    other.add(gained(9, salt="other"), {})
    one.merge(other.path)
    assert one.read().estimates.tally(KEY).runs == 27
    mixed = old_file(tmp_path / "mixed.db", 18, RUNS)  # A run was added to it under schema 1.
    campaign_file(mixed.path)
    assert mixed.read().estimates.tally(KEY).runs == 18


def test_merging_from_a_missing_file_is_refused(tmp_path: Path) -> None:
    """No file is created."""
    with pytest.raises(EstimatesError, match="no such file"):
        EstimatesFile(tmp_path / "one.db").merge(tmp_path / "two.db")
    assert not (tmp_path / "one.db").exists()


@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    steps=st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from("amMc"), st.integers(1, 3)), max_size=10
    )
)
def test_files_agree_after_all_were_merged(
    steps: list[tuple[int, str, int]], tmp_path: Path
) -> None:
    """Runs are added and files merged in any order; one file starts under schema 1, one with a
    campaign, and campaigns are written again anywhere. After all files were merged, each holds
    every run exactly once."""
    folder = tmp_path / "crdt"
    for old in folder.glob("*") if folder.exists() else ():
        old.unlink()
    folder.mkdir(exist_ok=True)

    def campaign(number: int, file: EstimatesFile) -> None:
        """Write a campaign with 10 more runs than the one before; several files may hold it."""
        runs = gained(10 * number, salt=f"campaign{number}")
        file.put_closed(f"campaign/{number}", runs, {}, {"pick": Question("cpu", 0.1 * number)})
        campaigns.add(number)

    campaigns: set[int] = set()
    begun = [
        EstimatesFile(folder / "1.db", "campaign/1"),
        EstimatesFile(folder / "2.db", "origin2"),
    ]
    files = [old_file(folder / "0.db", 1, "origin0"), *begun]
    campaign(1, files[1])
    files[2].add(gained(1, salt="begin"), {})
    added = 2
    for number, (i, what, n) in enumerate(steps):
        if what == "a":
            files[i].add(gained(n, salt=str(number)), {})
            added += n
        elif what == "c":
            campaign(n, files[i])
        else:
            files[i].merge(files[(i + n) % 3].path)
    for _ in range(2):
        for i in range(3):
            files[i].merge(files[(i + 1) % 3].path)
    assert {f.read().estimates.tally(KEY).runs for f in files} == {added + 10 * sum(campaigns)}
    assert len({frozenset(f.read().asked.get("pick", ())) for f in files}) == 1


# --- plants -----------------------------------------------------------------------------------


def runs_by_plant(file: EstimatesFile) -> dict[str, int]:
    """Return the number of runs of each plant."""
    plants = file.read().plants
    return {p: sum(t.runs for t in found.tallies.values()) for p, found in plants.items()}


@settings(
    deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b"]),
            st.sampled_from(["", "mock", "simulated", "real", "real cell 2"]),
            st.integers(1, 3),
            st.booleans(),
        ),
        max_size=10,
    )
)
def test_plants_are_never_pooled_however_files_grow_and_merge(
    tmp_path: Path, steps: list[tuple[str, str, int, bool]]
) -> None:
    """Each run is counted once, in its plant, in both of two files that add and merge at random."""
    for old in tmp_path.iterdir():
        old.unlink()
    files = {name: EstimatesFile(tmp_path / f"{name}.db") for name in "ab"}
    expected: dict[str, int] = {}
    for i, (name, plant, count, merge) in enumerate(steps):
        files[name].add(gained(count, salt=str(i)), {}, plant=plant)
        expected[plant] = expected.get(plant, 0) + count
        if merge:
            files["b" if name == "a" else "a"].merge(files[name].path)
    if not steps:
        return
    for file in files.values():
        file.add(Estimates(), {}, plant="simulated")
    files["a"].merge(files["b"].path)
    files["b"].merge(files["a"].path)
    for file in files.values():
        assert runs_by_plant(file) == expected


def test_a_learner_of_one_plant_is_not_continued_in_another(tmp_path: Path) -> None:
    selector = make("nikolic_fu", ("pick_fast", "pick_slow"))
    selector.chosen("", "pick_fast")
    selector.update("", "pick_fast", Observation(Status.SUCCESS, 1.0))
    file = EstimatesFile(tmp_path / "a.db")
    file.add(gained(1), {"pick": selector.state()}, plant="simulated")
    file.add(gained(1), {"pick": {**selector.state(), "learners": {}}}, plant="mock")
    kept = file.read("simulated").states("nikolic_fu")["pick"]
    assert kept["learners"] and not file.read("mock").states("nikolic_fu")["pick"]["learners"]
    assert not file.read("real").states("nikolic_fu")
    assert file.read().plant == "simulated"


def test_the_physics_counts_for_simulated_runs_alone(tmp_path: Path) -> None:
    """A real cell goes on in a file that was learned with any physics; another simulator does
    not."""
    file = EstimatesFile(tmp_path / "a.db")
    file.add(gained(1), {}, physics="portable 1", plant="simulated")
    file.add(gained(2), {}, plant="real")
    file.add(gained(1), {}, physics="bullet 3.2.7", plant="mock")
    with pytest.raises(EstimatesError, match="different physics are not pooled"):
        file.add(gained(1), {}, physics="bullet 3.2.7", plant="simulated")
    assert runs_by_plant(file) == {"simulated": 1, "real": 2, "mock": 1}
    assert file.read().physics == "portable 1" and file.read().plant == "real"


def test_one_plant_alone_can_be_reset(tmp_path: Path) -> None:
    """Estimates and selectors of the others stay, also after a merge of an old copy."""
    file = EstimatesFile(tmp_path / "a.db")
    for plant in ("simulated", "mock"):
        file.add(gained(2), {"pick": state_of("nikolic_fu", {"A": 5})}, plant=plant)
    copy = EstimatesFile(Path(shutil.copy(file.path, tmp_path / "copy.db")))
    file.reset("pick", plant="mock")
    file.merge(copy.path)
    assert runs_by_plant(file).get("mock", 0) == 0 and runs_by_plant(file)["simulated"] == 2
    assert [name for _, name in file.read().selectors] == ["nikolic_fu in simulated"]
    file.reset(plant="simulated")
    assert sum(runs_by_plant(file).values()) == 0 and not file.read().selectors


def test_what_was_reset_in_one_plant_stays_forgotten_in_a_merge(tmp_path: Path) -> None:
    file, other = EstimatesFile(tmp_path / "a.db"), EstimatesFile(tmp_path / "b.db")
    for plant in ("simulated", "mock", "simulated"):
        file.add(gained(1), {}, plant=plant)
    other.merge(file.path)
    file.reset("pick")
    file.add(gained(3), {}, plant="mock")
    file.merge(other.path)
    assert runs_by_plant(file) == {"mock": 3, "simulated": 0}


def test_a_file_without_trials_gets_them_when_something_is_added(tmp_path: Path) -> None:
    """Files that are older than the table of trials are read, merged and continued."""
    file = file_of(tmp_path / "old.db", 4)
    db = sqlite3.connect(file.path)
    db.execute("DROP TABLE trial")
    db.commit()
    db.close()
    key = TrialsKey("sorting", "regime=A")
    assert file.read().estimates.trials == {}
    other = file_of(tmp_path / "new.db", 3)
    other.merge(file.path)
    assert other.read().estimates.trials[key].n == 3
    file.add(gained(2), {})
    assert file.read().estimates.trials[key].n == 2
    db = sqlite3.connect(file.path)
    db.execute("UPDATE trial SET version = 9")
    db.commit()
    db.close()
    with pytest.raises(EstimatesError, match=r"trials of sorting .regime=A.: expected version 2"):
        file.read()
