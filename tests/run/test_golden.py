"""Golden journals: runs of shipped tasks that an earlier version recorded, computed again marking
by marking."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import Engine, Finished, Fired, State
from petrobot.coordinator.run.journal import read_journal
from petrobot.coordinator.run.recording import ReplayError, replay
from tests.run.golden.make import STORIES, make

GOLDEN = Path(__file__).parent / "golden"
ENDS = {
    "catch_ball-undisturbed": ("success", 4),
    "catch_ball-missed-and-recovered": ("success", 4),
    "catch_ball-given-up": ("error", 1),
    "follow_track-undisturbed": ("success", 1),
    "follow_track-lost-and-found": ("success", 1),
    "follow_track-given-up": ("error", 1),
}


@pytest.mark.parametrize("name", sorted(STORIES))
def test_every_marking_and_instruction_is_computed_again(name: str) -> None:
    """`replay` fails at the first difference; the status at the end is the recorded one."""
    found = recorded(str(GOLDEN / f"{name}.journal"))
    steps = list(found.steps())
    assert len(steps) == sum(r.kind == "stimulus" for r in found.journal.records) > 10
    (finished,) = [i for i in steps[-1].instructions if isinstance(i, Finished)]
    started = sum(
        isinstance(i, Fired) and i.transition == "start"
        for step in steps
        for i in step.instructions
    )
    assert (finished.status.value, started) == ENDS[name]


@pytest.mark.parametrize("name", sorted(STORIES))
def test_the_same_story_gives_the_golden_markings_today(name: str, tmp_path: Path) -> None:
    """A run of the same story has the same markings in the same order: execution in lock step has
    not changed either."""
    golden, now = (
        read_journal(folder / f"{name}.journal") for folder in (GOLDEN, make(name, tmp_path).parent)
    )

    def markings(journal_records: object) -> list[object]:
        return [r.data["marking"] for r in journal_records if r.kind == "stimulus"]  # type: ignore[attr-defined]

    assert markings(now.records) == markings(golden.records)


def test_a_changed_task_is_noticed_at_the_record_where_it_matters() -> None:
    """The journal does not replay with a task in which an event has another priority."""
    found = recorded(str(GOLDEN / "catch_ball-undisturbed.journal"))
    changed = found.journal.header["task"].replace('out = ["return_home"]', 'out = ["recover_arm"]')
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.task.file import loads

    task, _ = with_runs(loads(changed, "changed"), found.journal.header["runs"])
    seen: list[State] = []
    with pytest.raises(ReplayError, match=r"record \d+ \(RunEnded\): marking was"):
        seen.extend(step.state for step in replay(found.journal, Engine(task)))


def test_another_instruction_with_the_same_markings_is_noticed() -> None:
    """With another deadline all markings are the same; the message names the first run that starts
    with it."""
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.task.file import loads

    found = recorded(str(GOLDEN / "catch_ball-undisturbed.journal"))
    text = found.journal.header["task"]
    changed = re.sub(r"(?m)^deadline = .*$", "deadline = 123.25", text, count=1)
    assert changed != text
    task, _ = with_runs(loads(changed, "changed"), found.journal.header["runs"])
    differs = r"record \d+ .*: the instructions differ .* StartRun .*123\.25"
    with pytest.raises(ReplayError, match=differs):
        list(replay(found.journal, Engine(task)))
