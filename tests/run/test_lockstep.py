"""How long a mission run in simulated time waits for an event that nothing raises."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.engine import Finished
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.run import lockstep
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import loads
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.lockstep.party import TICK
from tests.run.scripted_cell import scripts, services_text

TASK = """schema = 1
[task]
name = "waits"
final = "counted == 1"
[primitive_tasks]
wave = { goal = "the button was answered", alternatives = ["wave"], deadline = 2.0 }
count = { goal = "the part is counted", alternatives = ["count"], deadline = 2.0 }
[events]
button = { scope = "external" }
tick = { scope = "external", memory = "pulse" }
[places]
listening = { tokens = 1, listen = true }
wave = { kind = "action", task = "wave", listen = true }
arm = { kind = "resource", tokens = 1 }
key = { kind = "resource" }
todo = { tokens = 1 }
count = { kind = "action", task = "count" }
counted = { kind = "control" }
[transitions]
pressed = { in = ["listening", "arm"], out = ["wave"], event = "button" }
waved = { in = ["wave:normal"], out = ["listening", "arm"] }
tired = { in = ["wave:error"], out = ["listening", "arm"] }
part = { in = ["todo", "key"], out = ["count"] }
done = { in = ["count:normal"], out = ["counted"] }
lost = { in = ["count:error"], out = ["counted"] }
"""
PART = 'part = { in = ["todo", "key"], out = ["count"] }'
BUTTON = 'part = { in = ["todo"], out = ["count"], event = "button" }'
TICKED = 'part = { in = ["todo"], out = ["count"], event = "tick" }'
SLOW = '[timers.tick]\nnode = "node"\nperiod = 35.0\n'
PATIENCE = 20.0
LOST = 'lost = { in = ["count:error"], out = ["key"] }'
FULL = (
    TASK.replace(PART, 'part = { in = ["todo"], out = ["count"] }')
    .replace("counted = {", "counted = { capacity = 1,")
    .replace("todo = { tokens = 1 }", "todo = { tokens = 2 }")
    .replace("counted == 1", "counted == 2")
    .replace("listening = { tokens = 1,", "listening = {")
    .replace('lost = { in = ["count:error"], out = ["counted"] }', LOST)
)
"""The second part finds no room, and its run has not ended in error. No button is looked for."""
NEVER = "aborted: waited 20 s of simulated time, and no operator can act: "


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less, so that the tests are fast."""
    monkeypatch.setattr(lockstep, "PATIENCE", PATIENCE)


def led(
    text: str, services: str = "", attended: bool = False, seconds: float = 5 * PATIENCE
) -> tuple[Finished | None, float]:
    """Return how a run ended, and when (s of simulated time); None if it has not ended by then."""
    task = loads(text)
    directory = parse(services_text(task) + services, Path("services.toml"))
    cell, party = lockstep_cell(directory, Setting(task), scripts(task, {}))
    party.attended = attended
    cell.run(lambda: party.over, round(seconds / TICK))
    return party.mission.executor.finished, cell.now


@pytest.mark.parametrize(
    ("old", "new", "waits_for"),
    [
        ("", "", "pressed waits for button; part needs key, which is empty"),
        # What a listening branch does by itself is no progress of the task.
        ('event = "button"', "after = 3.0", "part needs key, which is empty"),
        (PART, BUTTON, "pressed waits for button; part waits for button"),
    ],
)
def test_a_run_that_waits_for_an_event_without_an_operator_ends(
    old: str, new: str, waits_for: str
) -> None:
    """Nothing but an event could help, and nothing raises it."""
    end, now = led(TASK.replace(old, new))
    assert end is not None and end.status is Status.ERROR
    assert end.reason.startswith(NEVER), end.reason
    assert waits_for in end.reason
    assert PATIENCE <= now < PATIENCE + 4.0


def test_a_run_that_no_event_can_continue_ends_at_once() -> None:
    """Its campaign would simulate half an hour for each such trial."""
    end, now = led(FULL)
    assert end is not None and end.status is Status.ERROR
    assert end.reason.startswith("aborted: nothing can happen any more, and no"), end.reason
    assert "counted (capacity 1), which holds 1" in end.reason and now < PATIENCE / 2


def test_with_an_operator_it_waits() -> None:
    """The operator may still raise the event, or add a token."""
    for text in (TASK, FULL):
        end, _ = led(text, attended=True)
        assert end is None


def test_it_waits_for_the_timers_of_the_location_file() -> None:
    """A timer may take longer than a run waits for a button."""
    end, now = led(TASK.replace(PART, TICKED), SLOW)
    assert end is not None and end.status is Status.SUCCESS
    assert 35.0 <= now < 40.0


def test_progress_begins_a_new_wait() -> None:
    """Each firing of the task itself, and each run that does not only listen, ends a wait."""
    again = TASK.replace(PART, TICKED).replace('out = ["counted"]', 'out = ["todo"]', 1)
    end, _ = led(again, SLOW.replace("35.0", "15.0"))
    assert end is None


CROSSED = """schema = 1
[task]
name = "crossed"
final = "done == 2"
[primitive_tasks]
work = { goal = "it is done", alternatives = ["work"], deadline = 2.0 }
[events]
tick = { scope = "external" }
[places]
one = { tokens = 1, holds = "arm" }
two = { tokens = 1, holds = "scale" }
arm = { kind = "resource" }
scale = { kind = "resource" }
blinks = { tokens = 1 }
work = { kind = "action", task = "work" }
done = { kind = "control" }
[transitions]
first = { in = ["one", "scale"], out = ["done", "scale"] }
second = { in = ["two", "arm"], out = ["done", "arm"] }
blink = { in = ["blinks"], out = ["work"], event = "tick" }
blinked = { in = ["work:normal"], out = ["blinks"] }
dark = { in = ["work:error"], out = ["blinks"] }
"""
"""Each part holds what the other needs. Beside them a branch goes on that is not of the task."""


def test_a_run_that_can_never_end_is_stuck_although_another_branch_goes_on() -> None:
    """It once went on for 75,000 s of simulated time without a word."""
    end, now = led(CROSSED, SLOW.replace("35.0", "5.0"))
    assert end is not None and end.status is Status.ERROR
    assert end.reason == (
        "aborted: the task can never end, whatever still happens, and no operator can act: first "
        "needs scale, which is empty; second needs arm, which is empty"
    )
    assert now < lockstep.LOOK + 1.0


@pytest.mark.parametrize(
    "rescue",
    [
        # One error of an action that has never failed would free the arm.
        'dark = { in = ["work:error"], out = ["blinks", "arm"] }',
        'dark = { in = ["work:error", "one"], out = ["blinks", "done"] }',
        'blink_all = { in = ["blinks", "two"], out = ["work", "done"], when = "false" }',
    ],
)
def test_a_run_that_goes_round_but_may_still_end_is_not_cut(rescue: str) -> None:
    """It may poll for something that comes late."""
    text = CROSSED.replace('dark = { in = ["work:error"], out = ["blinks"] }', rescue)
    end, _ = led(text, SLOW.replace("35.0", "5.0"), seconds=5 * lockstep.LOOK)
    assert end is None


def test_with_an_operator_a_run_that_can_never_end_goes_on() -> None:
    """The operator may add the token."""
    end, _ = led(CROSSED, SLOW.replace("35.0", "5.0"), attended=True)
    assert end is None
