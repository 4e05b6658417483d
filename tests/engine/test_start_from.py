"""A mission run may begin at any point of another one: marking, ended runs, variables and latched
events are the same."""

from __future__ import annotations

import json
from collections import Counter

import pytest
from hypothesis import HealthCheck, assume, given, settings, strategies as st

from petrobot.coordinator.engine import (
    Begin,
    Engine,
    Marked,
    Mode,
    Phase,
    Point,
    Report,
    Standing,
    State,
    point_from_plain,
    to_plain,
)
from petrobot.coordinator.operator.start_from import point_of
from petrobot.coordinator.task import Status, Task
from tests.engine.conftest import make_task
from tests.engine.test_properties import DEVICES, Journal, tasks


def over(state: State) -> Counter[tuple[str, Status | None, str, str]]:
    """Return the ended runs whose tokens wait."""
    return Counter(
        (r.place, r.status, r.cause, r.action) for r in state.runs() if r.phase is Phase.DONE
    )


def alive(state: State) -> Counter[str]:
    """Return the places of runs that have not ended."""
    return Counter(r.place for r in state.runs() if r.phase is not Phase.DONE)


@pytest.mark.once
@settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(tasks(), st.data())
def test_any_point_of_any_run_is_a_beginning(task: Task, data: st.DataObject) -> None:
    set_out_anywhere(task, data)


@pytest.mark.proof
@settings(
    max_examples=5000,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(tasks(), st.data())
def test_any_point_of_any_run_is_a_beginning_at_length(task: Task, data: st.DataObject) -> None:
    set_out_anywhere(task, data)


def set_out_anywhere(task: Task, data: st.DataObject) -> None:
    """Play random stimuli; a run that begins at a state at rest has the same state."""
    journal = Journal(task)
    journal.feed(Begin({}, {"n": 1}))
    for _ in range(data.draw(st.integers(0, 25))):
        possible = journal.stimuli() if data.draw(st.integers(0, 4)) else journal.commands()
        journal.feed(data.draw(st.sampled_from(possible)))
    then = journal.state
    assume(then.mode is Mode.RUNNING and then.suspended is None and not then.stopping)
    assume(not any(t.elapsed for t in then.timers.values()))
    engine = Engine(task, DEVICES, journal.engine.policy)
    point = point_of(engine, then, {})
    assert point_from_plain(json.loads(json.dumps(to_plain(point)))) == point
    now, instructions = engine.handle(engine.initial(), Begin(point=point))
    marked = [i for i in instructions if isinstance(i, Marked)]
    assert [i.after for i in marked] == [then.marking]
    assert now.marking == then.marking
    assert now.flags == then.flags
    assert (over(now), alive(now)) == (over(then), alive(then))
    assert dict(now.variables) == then.variables


TASK = make_task(
    "c=2 r~=1 a! b!",
    {
        "go": {"in": "c r", "out": "a"},
        "done": {"in": "a:normal", "out": "b"},
        "lost": {"in": "a:error", "out": "r"},
        "back": {"in": "b:normal", "out": "r"},
        "bad": {"in": "b:error", "out": "r"},
    },
)


@pytest.mark.parametrize(
    ("standing", "fired"),
    [
        (Standing("a"), []),
        (Standing("a", Status.SUCCESS), ["done"]),
        (Standing("a", Status.FAILURE), ["done"]),
        (Standing("a", Status.ERROR, "slipped"), ["lost", "go"]),
    ],
)
def test_active_runs_begin_again_or_have_ended(standing: Standing, fired: list[str]) -> None:
    """An ended run leaves its place by its status at once; a run that begins again is started."""
    engine = Engine(TASK)
    state, instructions = engine.handle(engine.initial(), Begin(point=Point({"c": 1}, (standing,))))
    assert [i.transition for i in instructions if hasattr(i, "transition")] == fired
    assert state.mode is Mode.RUNNING
    assert sum(state.marking) >= 1


def test_places_unknown_to_the_task_are_reported_and_left_out() -> None:
    """With a point of another task, unknown places are reported, and tokens and runs agree."""
    engine = Engine(TASK)
    point = Point({"c": 1, "a": 3, "nowhere": 1}, (Standing("b"), Standing("r"), Standing("moon")))
    state, instructions = engine.handle(engine.initial(), Begin(point=point))
    told = [i.of for i in instructions if isinstance(i, Report) and i.key == "bad_point"]
    assert told == ["nowhere", "r", "moon"]
    marking = dict(zip(TASK.net.places, state.marking, strict=True))
    assert (marking["a"], marking["b"], marking["c"]) == (0, 1, 1)


def test_a_second_begin_is_ignored() -> None:
    """An active mission run does not jump to another state."""
    engine = Engine(TASK)
    state, _ = engine.handle(engine.initial(), Begin())
    after, _ = engine.handle(state, Begin(point=Point({"c": 9})))
    assert after.marking == state.marking
