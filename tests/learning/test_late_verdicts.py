"""Deferred verdicts and the estimates file: R is corrected exactly once, wherever the mission run
was interrupted and whatever happened to the file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.learning.records import Correction, Record, RunEnd
from petrobot.coordinator.learning.session import LearningSession, LearningSetting, session_of
from petrobot.coordinator.task import Task
from tests.run.judged_parts import LEARNED, PARTS, directory, learned, sorting

SELECTOR = "round_robin"


@pytest.fixture(scope="module")
def task() -> Task:
    """A task in which parts are picked provisionally and judged later."""
    return sorting()


def whole(task: Task, path: Path) -> LearningSession:
    """A mission run that learned but was not saved."""
    session = LearningSession(task, LearningSetting(path, SELECTOR), seed=1)
    cell, party = lockstep_cell(
        directory(), Setting(task, runs=PARTS, seed=1, selector=session.selector)
    )
    assert cell.run(lambda: party.over, 100_000)
    return session


def shown(session: LearningSession, records: Sequence[Record]) -> LearningSession:
    """Return the session after these records, as a resume replays them."""
    for record in records:
        session.selector.records.append(record)
        session.learning.apply(record)
    return session


def taken_up(task: Task, session: LearningSession, records: Sequence[Record]) -> LearningSession:
    """Continue a session in another process up to these records."""
    header = {"seed": 1, "learning": json.loads(json.dumps(session.beginning()))}
    again = session_of(task, header)
    assert again is not None
    return shown(again, records)


def kept(path: Path) -> Mapping[str, tuple[dict[Any, int], int]]:
    """Return for each action the file's numbers of its runs, and how many were corrected."""
    tallies = EstimatesFile(path).read().estimates.tallies
    return {
        key.action: (dict(t.counts), t.corrected)
        for key, t in tallies.items()
        if key.primitive_task == "pick"
    }


TRUE = {action: (counts, corrected) for action, (counts, corrected, _) in LEARNED.items()}


def test_wherever_it_was_interrupted_each_verdict_counts_once(task: Task, tmp_path: Path) -> None:
    """Interrupted at any record: run and verdict fall on one side, or the run is counted and saved
    before its verdict."""
    one = whole(task, tmp_path / "none.db")
    records = one.selector.records
    assert sum(isinstance(r, Correction) for r in records) == 5
    assert learned(one.selector) == LEARNED
    for done in range(1, len(records) + 1):
        path = tmp_path / f"{done}.db"
        first = LearningSession(task, LearningSetting(path, SELECTOR), seed=1)
        taken_up(task, first, records[:done]).save()
        resumed = taken_up(task, first, records)
        resumed.save()
        assert kept(path) == TRUE, f"interrupted after {done} of {len(records)} records"
        states = EstimatesFile(path).read().states(SELECTOR)
        assert states == resumed.learning.state() == one.learning.state()


def split(task: Task, path: Path, between: Callable[[], None]) -> None:
    """Count and save all runs, change the file, then deliver the score's verdict on the third
    pick."""
    records = whole(task, path.with_name("none.db")).selector.records
    last = max(n for n, r in enumerate(records) if isinstance(r, Correction))
    first = LearningSession(task, LearningSetting(path, SELECTOR), seed=1)
    taken_up(task, first, records[:last]).save()
    between()
    taken_up(task, first, records).save()


def test_a_verdict_counts_once_in_files_merged_before_and_after_it(
    task: Task, tmp_path: Path
) -> None:
    """Another machine received the run before its verdict, and receives the verdict later, any
    number of times."""
    path, other = tmp_path / "here.db", tmp_path / "there.db"
    split(task, path, lambda: EstimatesFile(other).merge(path))
    assert kept(other)["pick_left"] == ({("failure", "crooked"): 1, ("success", ""): 2}, 1), (
        "provisional until then"
    )
    for _ in range(2):
        EstimatesFile(other).merge(path)
        EstimatesFile(path).merge(other)
    assert kept(path) == kept(other) == TRUE


def test_a_verdict_on_a_run_forgotten_or_copied_meanwhile_changes_nothing(
    task: Task, tmp_path: Path
) -> None:
    """The runs no longer belong to this file: no run of another origin is corrected in their
    place."""
    path = tmp_path / "reset.db"
    split(task, path, EstimatesFile(path).reset)
    assert kept(path) == {}
    path, aside = tmp_path / "copied.db", tmp_path / "aside.db"

    def copy() -> None:
        shutil.copy(path, aside)
        aside.replace(path)

    split(task, path, copy)
    assert kept(path)["pick_left"][1] == 1, "as in the copied file"
    assert sum(kept(path)["pick_left"][0].values()) == 3


def test_a_verdict_on_a_forgotten_run_does_not_change_runs_after_the_reset(
    task: Task, tmp_path: Path
) -> None:
    """The new runs look like the forgotten run but are not mistaken for it."""
    path = tmp_path / "learned.db"

    def reset_and_learn() -> None:
        EstimatesFile(path).reset()
        whole(task, path).save()

    split(task, path, reset_and_learn)
    assert kept(path) == TRUE


def test_a_verdict_names_the_end_that_it_corrects(task: Task, tmp_path: Path) -> None:
    records = whole(task, tmp_path / "none.db").selector.records
    judged = [r for r in records if isinstance(r, Correction)]
    ends = [r for r in records if isinstance(r, RunEnd) and r.primitive_task == "pick"]
    assert judged
    assert {id(r.was) for r in judged} <= {id(r.outcome) for r in ends}
