"""The times of runs as operators see them."""

from __future__ import annotations

import pytest

from petrobot.coordinator.engine import (
    CancelRun,
    Hold,
    HoldRun,
    Instruction,
    ReleaseRun,
    RunHeld,
    StartRun,
)
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.operator.run_state import ChangePublisher
from petrobot.coordinator.run.recording import mission_time
from petrobot.coordinator.task import Counts
from petrobot.coordinator.task.file import loads
from tests.operator.conftest import TASK

RUN = "look#1"
HELD, CANNOT = RunHeld(RUN, Hold.HELD), RunHeld(RUN, Hold.CANNOT)
ASK, GO, CANCEL = HoldRun(RUN), ReleaseRun(RUN), CancelRun(RUN, Counts.NONE, "", 1.0)


@pytest.mark.parametrize(
    ("steps", "since", "held"),
    [
        ([(2.0, ASK)], None, 0.0),
        ([(2.0, ASK), (2.5, HELD)], 2.5, 0.0),
        ([(2.0, ASK), (2.5, HELD), (6.0, GO)], None, 3.5),
        ([(2.5, HELD), (6.0, GO), (7.0, HELD), (9.0, GO)], None, 5.5),
        ([(2.5, HELD), (4.0, ASK), (4.5, HELD), (6.0, GO)], None, 3.5),  # asked again in the pause
        ([(2.5, HELD), (4.0, ASK), (4.5, CANNOT)], None, 2.0),
        ([(2.0, ASK), (2.5, CANNOT), (6.0, GO)], None, 0.0),
        ([(2.5, HELD), (4.0, CANCEL)], None, 1.5),
    ],
)
def test_the_time_in_which_a_run_was_held_is_known(
    steps: list[tuple[float, Instruction | RunHeld]], since: float | None, held: float
) -> None:
    """Its deadline stands still then, so its time may not run on the page."""
    publisher = ChangePublisher(Feed(), loads(TASK, "moving.toml"), origin=100.0)
    publisher.begin("m", "realtime")
    publisher.instruction(101.0, StartRun(RUN, "look", "look", "look_twice", {}, 5.0))
    for time, step in steps:
        if isinstance(step, RunHeld):
            publisher.stimulus(100.0 + time, step)
        else:
            publisher.instruction(100.0 + time, step)
    run = publisher.feed.state["runs"][RUN]
    assert (run["started"], run["held_since"], run["held_for"]) == (1.0, since, held)


@pytest.mark.parametrize("now", [0.006349999, 0.006350001, 0.31764999999, 12.34565000001])
def test_a_time_is_rounded_as_the_journal_rounds_it(now: float) -> None:
    """Page and log may not differ in the last digit."""
    publisher = ChangePublisher(Feed(), loads(TASK, "moving.toml"))
    publisher.begin("m", "realtime")
    publisher.instruction(now, StartRun(RUN, "look", "look", "look_twice", {}, 5.0))
    stored = mission_time(now, 0.0)
    assert stored != now and publisher.feed.state["runs"][RUN]["started"] == round(stored, 4)
