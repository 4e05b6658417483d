"""Verdicts on the execution graph: small tasks with known answers, each with its cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.execution import graph
from petrobot.coordinator.analysis.execution.chain import chain_of
from petrobot.coordinator.analysis.execution.graph import MOVES, execute, in_words, with_operator
from petrobot.coordinator.analysis.execution.progress import MENDED, NAMES, Progress, progress_of
from petrobot.coordinator.analysis.limits import until
from petrobot.coordinator.analysis.may_run import Budget, may_run
from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.space import explore
from petrobot.coordinator.analysis.report import analyse
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import forecast
from petrobot.coordinator.task import (
    Estimate,
    Inhibitor,
    Kind,
    Status,
    Task,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import load, loads
from petrobot.coordinator.task.net import Net
from tests.analysis.broken import with_button, with_stop
from tests.analysis.random_nets import state_machines
from tests.engine.conftest import make_task
from tests.engine.test_expansion import TRIES

TASKS = Path(__file__).parents[2] / "coordinator" / "tasks"


def judged(task: Task, limit: int = 40_000) -> Progress:
    return progress_of(OrdinaryView(task), limit)


def codes(task: Task) -> set[str]:
    return {finding.code for finding in may_run(task, None, Budget()).report.findings}


class Case(Struct, frozen=True):
    """A small task that gets stuck, and the words that must describe its dead end."""

    places: str
    net: Mapping[str, Mapping[str, Any]]
    final: str
    told: tuple[str, ...]
    events: str = ""
    more: Mapping[str, Any] | None = None

    @property
    def task(self) -> Task:
        """Return the task."""
        return make_task(self.places, self.net, self.events, final=self.final, **(self.more or {}))


KEEPS_THE_ARM = {
    "next": {"in": "parts arm", "out": "look"},
    "seen": {"in": "look:normal", "out": "arm"},
    "dropped": {"in": "look:error", "out": "bin"},
}
STUCK: dict[str, Case] = {
    "an ended run waits for a token that does not come back": Case(
        "arm~=1 parts=2 tray=1 look!",
        {
            "next": {"in": "parts arm", "out": "look"},
            "seen": {"in": "look:normal tray", "out": "arm"},
            "lost": {"in": "look:error", "out": "arm"},
        },
        "parts == 0 and arm == 1",
        ("look (ended in success)", "tray", "taken by `seen`, and no transition returns it"),
    ),
    "each of two branches holds what the other wants": Case(
        "arm~=1 camera~=1 a=1 b=1 done hold_arm! hold_camera! both_a! both_b!",
        {
            "take_arm": {"in": "a arm", "out": "hold_arm"},
            "take_camera": {"in": "b camera", "out": "hold_camera"},
            "want_camera": {"in": "hold_arm:normal camera", "out": "both_a"},
            "want_arm": {"in": "hold_camera:normal arm", "out": "both_b"},
            "arm_back": {"in": "hold_arm:error", "out": "a arm"},
            "camera_back": {"in": "hold_camera:error", "out": "b camera"},
            "done_a": {"in": "both_a:normal", "out": "arm camera done"},
            "done_b": {"in": "both_b:normal", "out": "arm camera done"},
            "fail_a": {"in": "both_a:error", "out": "arm camera done"},
            "fail_b": {"in": "both_b:error", "out": "arm camera done"},
        },
        "done == 2",
        (
            "want_camera needs camera, which is empty: taken by `take_camera`, still held with "
            "hold_camera",
            "want_arm needs arm, which is empty: taken by `take_arm`, still held with hold_arm",
        ),
    ),
    "a branch forgets to return the arm": Case(
        "arm~=1 parts=2 bin look!",
        KEEPS_THE_ARM,
        "parts == 0 and arm == 1",
        ("next needs arm, which is empty: taken by `next`, never returned by `dropped`",),
    ),
    "an error branch ends in a place that nothing takes from": Case(
        "arm~=1 parts=2 bin. look!",
        KEEPS_THE_ARM,
        "parts == 0 and arm == 1 and bin == 0",
        (
            "next needs arm, which is empty: taken by `next`, still held with bin, and no "
            "transition takes bin",
        ),
    ),
    "a stock is used up": Case(
        "tips=5 more arm~=1 jobs=6 fill! refill! tubes spin! warm look! broken",
        {
            "next": {"in": "jobs arm tips", "out": "fill"},
            "filled": {"in": "fill:normal", "out": "tubes arm"},
            "spilt": {"in": "fill:error", "out": "jobs arm tips"},
            "fetch": {"in": "more !tips", "out": "refill"},
            "fetched": {"in": "refill:normal", "out": "tips*3"},
            "not_fetched": {"in": "refill:error", "out": "broken"},
            "start": {"in": "tubes*2", "out": "spin"},
            "spun": {"in": "spin:normal", "out": "warm"},
            "spin_bad": {"in": "spin:error", "out": "broken"},
            "see": {"in": "warm arm", "out": "look"},
            "seen": {"in": "look:normal", "out": "arm"},
            "unseen": {"in": "look:error", "out": "arm"},
        },
        "jobs == 0 and arm == 1 and tubes == 0",
        ("next needs tips, which is empty", "tips: taken by `next`; only `spilt`"),
        more={"final_error": parse("broken >= 1")},
    ),
    "one of two exits gives back too little": Case(
        "slots~=2 jobs=4 broken fill! tubes spin! look!",
        {
            "next": {"in": "jobs slots", "out": "fill"},
            "filled": {"in": "fill:normal", "out": "tubes"},
            "spilt": {"in": "fill:error", "out": "jobs slots"},
            "start": {"in": "tubes*2", "out": "spin"},
            "spun": {"in": "spin:normal", "out": "look"},
            "spin_bad": {"in": "spin:error", "out": "broken"},
            "seen": {"in": "look:normal", "out": "slots"},
            "unseen": {"in": "look:error", "out": "slots*2"},
        },
        "jobs == 0 and slots == 2",
        ("next needs slots, which is empty: taken by `next`, never returned by `seen`",),
        more={"final_error": parse("broken >= 1")},
    ),
    "a preempting event can only come while the run is active": Case(
        "go=1 hold! done",
        {
            "begin": {"in": "go", "out": "hold"},
            "stop": {"in": "hold:preempt=none", "event": "bell", "out": "done"},
            "broken": {"in": "hold:error", "out": "go"},
        },
        "done == 1",
        ("no transition takes what ended in hold that way",),
        "bell*",
    ),
    "a going arc tests a run that has ended": Case(
        "go=1 watch! ready=1 done",
        {
            "begin": {"in": "go", "out": "watch"},
            "fetch": {"in": "watch:going ready", "event": "bell", "out": "done"},
            "end": {"in": "watch:normal done"},
            "fail": {"in": "watch:error done"},
        },
        "watch == 0 and done == 0 and ready == 0 and go == 0",
        ("end needs done, which is empty: only `fetch` can fill it",),
        "bell",
    ),
    "a join waits for a run that ended in the other way": Case(
        "go=1 a! b! done",
        {
            "begin": {"in": "go", "out": "a b"},
            "both": {"in": "a:normal b:normal", "out": "done"},
            "neither": {"in": "a:error b:error", "out": "done"},
        },
        "done == 1",
        ("a (ended in", "b (ended in"),
    ),
    "no condition is true of what the run wrote": Case(
        "go=1 look! low high",
        {
            "begin": {"in": "go", "out": "look"},
            "few": {"in": "look:normal", "out": "low", "when": "n < 3"},
            "many": {"in": "look:normal", "out": "high", "when": "n > 3"},
            "fail": {"in": "look:error", "out": "low"},
        },
        "low == 1 or high == 1",
        ("has a false condition (n < 3)", "has a false condition (n > 3)"),
        more={"variables": {"n": 0}, "out": {"look": {"n": "n"}}},
    ),
    "a branch of a join is lost while idle resources could begin again": Case(
        "go=1 arm~=1 camera~=1 move! look! l r done",
        {
            "fork": {"in": "go arm camera", "out": "move look"},
            "moved": {"in": "move:normal", "out": "l arm"},
            "failed": {"in": "move:error", "out": "r arm"},
            "seen": {"in": "look:normal", "out": "r camera"},
            "unseen": {"in": "look:error", "out": "r camera"},
            "join": {"in": "l r", "out": "done"},
        },
        "done == 1 and arm == 1 and camera == 1 and l == 0 and r == 0",
        ("join needs l, which is empty: only `moved` can fill it, but `failed` took move",),
    ),
    "an error branch forgets what the end asks for": Case(
        "parts=2 arm~=1 grasp! drop! boxes",
        {
            "next": {"in": "parts arm", "out": "grasp"},
            "got": {"in": "grasp:normal", "out": "drop"},
            "lost": {"in": "grasp:error", "out": "arm"},
            "dropped": {"in": "drop:normal", "out": "arm boxes"},
            "fallen": {"in": "drop:error", "out": "arm boxes"},
        },
        "parts == 0 and arm == 1 and boxes == 2",
        (
            "boxes == 2 (it holds 0)",
            "boxes: only `dropped`, `fallen` can fill it, but `lost` took grasp",
        ),
    ),
    "a slot is given back twice, and a mark is never taken away": Case(
        "raw=2 slots~=2 feed! packed",
        {
            "load": {"in": "raw slots", "out": "feed"},
            "fed": {"in": "feed:normal", "out": "packed slots*2"},
            "failed": {"in": "feed:error", "out": "packed slots"},
        },
        "raw == 0 and slots == 2 and packed == 0",
        (
            "the end asks for slots == 2 (it holds 4) and packed == 0 (it holds 2)",
            "slots: taken: 2 by `load`; returned: 4 by `fed`",
            "packed: filled by `fed`, and no transition takes it",
        ),
    ),
    "the last step of a branch that several exits enter loses the arm": Case(
        "jobs=2 arm~=1 reach! home!",
        {
            "start": {"in": "jobs arm", "out": "reach"},
            "reached": {"in": "reach:normal", "out": "arm"},
            "bark": {"in": "reach:preempt=error", "out": "home", "event": "bell"},
            "fail": {"in": "reach:error", "out": "home"},
            "homed": {"in": "home:normal", "out": ""},
            "again": {"in": "home:error", "out": "home"},
        },
        "jobs == 0 and arm == 1",
        ("start needs arm, which is empty: taken by `start`, never returned by `homed`",),
        "bell",
    ),
    "an exit leaves a token of its step behind": Case(
        "jobs=2 arm~=1 reach! dog",
        {
            "start": {"in": "jobs arm", "out": "reach dog"},
            "reached": {"in": "reach:normal", "out": "arm"},
            "bark": {"in": "dog reach:preempt=error", "out": "arm", "event": "bell"},
            "fail": {"in": "dog reach:error", "out": "arm"},
        },
        "jobs == 0 and arm == 1 and dog == 0",
        ("reach: taken by `reached`, which left dog",),
        "bell",
    ),
    "what is barred comes after the step that would remove the bar": Case(
        "jobs=3 bay~=2 wait want cross! busy",
        {
            "send": {"in": "jobs", "out": "wait"},
            "enter": {"in": "wait !busy", "out": "want busy"},
            "go": {"in": "want bay", "out": "cross"},
            "left": {"in": "cross:normal busy", "out": "bay"},
            "lost": {"in": "cross:error busy", "out": "wait"},
        },
        "jobs == 0 and bay == 2",
        (
            "go needs bay, which is empty",
            "go needs bay, which is empty: taken by `go`, never returned by `lost`",
        ),
    ),
    "a capacity bars the way for good": Case(
        "go=2 look! box/1",
        {
            "begin": {"in": "go", "out": "look"},
            "store": {"in": "look:normal", "out": "box"},
            "fail": {"in": "look:error", "out": "go"},
        },
        "go == 0 and look == 0",
        (
            "store is barred by box (capacity 1), which holds 1",
            "box: no transition takes any out of it",
        ),
    ),
}


CELL = "parts=3 arm~=1/1 camera~=1/1 look! grasp! place! done recover! broken"
PICK: Mapping[str, Mapping[str, Any]] = {
    "next": {"in": "parts arm camera", "out": "look"},
    "seen": {"in": "look:normal", "out": "grasp camera"},
    "unseen": {"in": "look:error", "out": "arm camera parts"},
    "grasped": {"in": "grasp:normal", "out": "place"},
    "missed": {"in": "grasp:error", "out": "recover"},
    "placed": {"in": "place:normal", "out": "arm done"},
    "dropped": {"in": "place:error", "out": "recover"},
    "recovered": {"in": "recover:normal", "out": "arm done"},
    "gone": {"in": "recover:error", "out": "broken"},
}
"""A task without faults: three parts, an arm and a camera; `broken` is its `final_error`."""


def seeded(*told: str, cell: str = CELL, **changes: Mapping[str, Any]) -> Case:
    """Return the correct task with a fault."""
    net = {**PICK, **{name: {**PICK.get(name, {}), **new} for name, new in changes.items()}}
    more = {"final_error": parse("broken == 1")}
    return Case(cell, net, "parts == 0 and arm == 1 and camera == 1", told, "bell*", more)


STUCK |= {
    "a resource is not given back": seeded(
        "next needs camera, which is empty: taken by `next`, never returned by `seen`",
        seen={"out": "grasp"},
    ),
    "an error branch gives back only one of two": seeded(
        "next needs camera, which is empty: taken by `next`, never returned by `unseen`",
        unseen={"out": "arm parts"},
    ),
    "a resource is given back twice": seeded(
        "placed is barred by arm (capacity 1, and it adds 2), which holds 0",
        placed={"out": "arm*2 done"},
    ),
    "a resource is given back twice into a place without capacity": seeded(
        "no transition takes what is left, and the end asks for arm == 1 (it holds 4), or for "
        "broken == 1",
        cell=CELL.replace("arm~=1/1", "arm~=1"),
        placed={"out": "arm*2 done"},
    ),
    "a preempt arc loses the arm": seeded(
        "next needs arm, which is empty: taken by `next`, never returned by `stop`",
        stop={"in": "grasp:preempt=none", "event": "bell"},
    ),
    "an inhibitor looks at the wrong place": seeded(
        "next is barred by done, which holds 1", next={"in": "parts arm camera !done"}
    ),
    "a place has too little room": seeded(
        "placed is barred by done (capacity 2), which holds 2",
        cell=CELL.replace("done", "done/2"),
    ),
    "a flag is not set again": seeded(
        "next needs ready, which is empty: taken by `next`, never returned by `placed`",
        cell=f"{CELL} ready=1",
        next={"in": "parts arm camera ready"},
        unseen={"out": "arm camera parts ready"},
        recovered={"out": "arm done ready"},
    ),
    "an arc takes two parts at once": seeded(
        "next needs 2 of parts, which holds 1", next={"in": "parts*2 arm camera"}
    ),
    "a branch that tries again loses what it takes again": seeded(
        "grasped needs tray, which is empty: taken by `grasped`, never returned by `dropped`",
        cell=f"{CELL} tray=1",
        grasped={"in": "grasp:normal tray"},
        dropped={"out": "grasp"},
        placed={"out": "arm done tray"},
    ),
    "an error branch is missing": seeded(
        "no transition takes what ended in place that way", dropped={"in": "place:normal"}
    ),
}


SORT = "parts=3 arm~=1 tries=2 fetch! park! broken depot store hand"
SORTING: Mapping[str, Mapping[str, Any]] = {
    "parked": {"in": "park:normal tries", "out": "arm parts", "priority": 1},
    "tired": {"in": "park:normal !tries", "out": "broken arm"},
    "no_park": {"in": "park:error", "out": "broken arm"},
    "next": {"in": "parts arm !broken", "out": "fetch"},
    "fetched": {"in": "fetch:normal", "out": "arm"},
    "no_fetch": {"in": "fetch:error", "out": "park"},
}
"""A correct task that parks the arm after an error, at most twice."""


@pytest.mark.parametrize(
    ("changes", "final", "told"),
    [
        ({"fetched": {"out": "depot"}}, "arm == 1", "next needs arm, which is empty"),
        ({"no_fetch": {"out": "parts"}}, "arm == 1", "next needs arm, which is empty"),
        ({}, "arm == 2", "no transition takes what is left, and the end asks for arm == 2 (it "),
        (
            {},
            "(arm > 1 or arm > 2) and arm == 2",
            "no transition takes what is left, and the end asks for parts == 0 and (arm > 1 or "
            "arm > 2) and arm == 2, or for",
        ),
        (
            {"fetched": {"out": "hand"}, "stored": {"in": "hand depot", "out": "arm store"}},
            "arm == 1",
            "stored needs depot, which is empty",
        ),
    ],
)
def test_the_first_cause_is_the_one_from_which_the_others_follow(
    changes: Mapping[str, Mapping[str, Any]], final: str, told: str
) -> None:
    """A counter that holds its tokens is not what is stuck, nor is what waits for a token that
    another transition holds up."""
    net = {**SORTING, **{name: {**SORTING.get(name, {}), **new} for name, new in changes.items()}}
    final, end = f"parts == 0 and {final}", parse("broken == 1")
    verdict = judged(make_task(SORT, net, final=final, final_error=end)).deadlock_free
    assert verdict.holds is False
    assert verdict.reason.partition(": ")[2].startswith(told), verdict


def test_tokens_that_came_back_are_not_called_lost() -> None:
    final, end = "parts == 0 and arm == 2", parse("broken == 1")
    verdict = judged(make_task(SORT, SORTING, final=final, final_error=end)).deadlock_free
    assert verdict.details[0] == "arm: only `parked`, `tired`, `no_park`, `fetched` can fill it"


HELD = """
schema = 1
[task]
name = "park"
final = "parts == 0 and arm == 1"
[primitive_tasks]
look = { deadline = 9.0 }
carry = { deadline = 9.0 }
[places]
parts = { kind = "control", tokens = 2 }
arm = { kind = "resource", tokens = 1 }
look = { kind = "action", holds = ["arm"] }
carry = { kind = "action", holds = ["arm"] }
parked = { holds = ["arm"] }
[transitions]
next = { in = ["parts"], out = ["look"] }
seen = { in = ["look:normal"], out = ["carry"] }
lost = { in = ["look:error"], out = ["parts"] }
put = { in = ["carry:normal"], out = ["parked"] }
dropped = { in = ["carry:error"] }
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ('"parts == 0 and arm == 1"', '"parts == 0 and parked >= 1 and arm == 1"'),
        ('parked = { holds = ["arm"] }', 'parked = { holds = ["arm"], listen = true }'),
    ],
)
def test_a_place_that_nothing_takes_from_keeps_what_it_holds(old: str, new: str) -> None:
    """The step that led there is as designed."""
    verdict = judged(loads(HELD.replace(old, new))).deadlock_free
    assert verdict.reason.endswith("next needs arm, which is empty")
    told = "arm: taken by `next`, still held with parked, and no transition takes parked"
    assert verdict.details[0] == told


def test_of_the_copies_that_tries_makes_only_the_nearest_is_told() -> None:
    net: dict[str, dict[str, Any]] = {
        "go": {"in": "parts", "out": "look"},
        "seen": {"in": "look:normal tray", "out": "done"},
        "lost": {"in": "look:error", "out": "done"},
    }
    task = make_task("parts=2 tray=1 look! done", net, final="done == 2")
    look = replace(task.places["look"], tries=3)
    verdict = judged(replace(task, places={**task.places, "look": look})).deadlock_free
    assert verdict.reason.endswith(": seen needs tray, which is empty")
    assert verdict.details[0] == "tray: taken by `seen`, and no transition returns it"


def test_a_run_that_can_still_end_is_not_what_is_stuck() -> None:
    """`again` only waits for the run to end in another way."""
    net: dict[str, dict[str, Any]] = {
        "begin": {"in": "parts spare", "out": "put"},
        "laid": {"in": "put:normal", "out": "put"},
        "again": {"in": "put:error left", "out": "put left"},
        "full": {"in": "count", "out": "spare"},
    }
    task = make_task("parts=2 spare~=1 left=1 put! count", net, final="parts == 0 and spare == 1")
    assert judged(task).sound.reason == (
        "stuck with parts left put: begin needs spare, which is empty"
    )


@pytest.mark.parametrize(
    ("steps", "told"),
    [
        (0, []),
        (3, [1, 2, 3]),
        (16, range(1, 17)),
        (60, [1, 2, 3, 4, 5, "(45 more)", 51, 52, 53, 54, 55, 56, 57, 58, 59, 60]),
    ],
)
def test_of_a_long_path_people_are_told_the_beginning_and_the_end(
    steps: int, told: Sequence[object]
) -> None:
    assert in_words(range(1, steps + 1)) == list(map(str, told))


def test_the_right_task_has_no_fault() -> None:
    answer = may_run(seeded().task, None, Budget())
    assert answer.ok and not answer.objections()


@pytest.mark.parametrize("what", STUCK)
def test_a_dead_end_is_found_replayed_and_explained(what: str) -> None:
    case = STUCK[what]
    found = judged(case.task)
    verdict = found.deadlock_free
    assert verdict.holds is False and found.sound.holds is False
    assert verdict.witness is not None and verdict.witness.steps
    lines = (verdict.reason, *verdict.details)
    for words in case.told:
        # the fate of the tokens that are missing has a line of its own
        lack, empty, fate = words.partition(", which is empty: ")
        assert any(lack in line for line in lines), lines
        if empty:
            assert f"{lack.rpartition(' ')[2]}: {fate}" in lines
    *_, last = case.task.net.replay(verdict.witness.firings)
    marked = {p: n for p, n in zip(case.task.net.places, last, strict=True) if n}
    assert marked == verdict.witness.marking
    answer = may_run(case.task, None, Budget())
    assert not answer.ok and any("deadlock free" in line for line in answer.objections())


@pytest.mark.parametrize("what", STUCK)
def test_a_branch_that_listens_does_not_hide_what_is_stuck(what: str) -> None:
    """Something can always fire, and where an error of the branch ends in `final_error`, an end can
    be reached. Neither helps the task."""
    case = STUCK[what]
    task = with_button(case.task, "broken" if case.task.final_error else "idle")
    task = replace(task, final_error=task.final_error and parse("broken > 0"))
    found = judged(task)
    assert found.deadlock_free.holds and found.sound.holds is False
    lines = (found.sound.reason, *found.sound.details)
    for words in case.told:
        lack, empty, fate = words.partition(", which is empty: ")
        # What still fires takes something, so only the rest of that sentence is told.
        lack = lack.removeprefix("no transition takes what is left, and ").partition(", or for")[0]
        assert any(lack in line for line in lines), lines
        if empty:
            assert f"{lack.rpartition(' ')[2]}: {fate}" in lines
    assert ("; only a further error ends it" in lines[-1]) is bool(case.task.final_error)
    answer = may_run(task, None, Budget())
    assert not answer.ok and any("sound" in line for line in answer.objections())


@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("what", STUCK)
def test_a_stop_button_does_not_hide_what_is_stuck(what: str, reset: bool) -> None:
    """It could be pressed all the time, so nothing but a person would end what hangs."""
    found = judged(with_stop(STUCK[what].task, reset=reset))
    assert found.deadlock_free.holds and found.sound.holds is False
    assert found.sound.reason.startswith("the task can only give up") or (
        found.sound.details[-1] == "nothing else can happen; only halt ends it"
    )


def test_a_stop_button_may_stay_unpressed() -> None:
    """No warning says that the task hangs without it; of an event that the task needs, one does."""
    assert "external-wait" not in codes(with_stop(seeded().task))
    needs = seeded(next={"in": "parts arm camera", "event": "bell"}).task
    assert "external-wait" in codes(with_stop(needs))


@pytest.mark.parametrize("reset", [False, True])
def test_a_stop_button_whose_token_others_need_does_not_hide_what_is_stuck(reset: bool) -> None:
    """Pressed while a run is active, it gives up where that run ends."""
    release = {"release": {"in": "halted", "event": "again", "out": "running"}}
    task = make_task(
        "parts=2 running=1 halted look! held",
        {
            "begin": {"in": "parts", "out": "look"},
            "next": {"in": "look:normal parts running", "out": "look running"},
            "lost": {"in": "look:error running", "out": "held running"},
            "halt": {"in": "running", "event": "stop", "out": "halted"},
            "last": {"in": "look:normal running !parts", "out": "running"},
            **(release if reset else {}),
        },
        "stop+ again+",
        final="parts == 0 and held == 0 and look == 0",
        final_error=parse("halted == 1"),
    )
    found = judged(task)
    assert found.deadlock_free.holds and found.sound.holds is False
    later, asked, *_ = found.sound.details
    assert later.startswith("later, with ") and asked.startswith("the end asks for held == 0")
    assert found.sound.details[-1] == "nothing else can happen; only halt ends it"


def test_an_event_that_begins_a_wait_is_no_stop_button() -> None:
    """Each round gives up by itself unless another event comes in time, and none can be left out.
    After a round was lost, the others are still needed to give up."""
    task = make_task(
        "parts=3 turn=1 stored lost waits bad",
        {
            "red": {"in": "parts turn", "event": "red", "out": "waits"},
            "green": {"in": "parts turn", "event": "green", "out": "waits"},
            "good": {"in": "waits", "event": "came", "out": "stored turn"},
            "late": {"in": "waits", "after": 5.0, "out": "lost turn"},
        },
        "red green came",
        final="stored == 3",
        final_error=parse("parts == 0 and lost > 0"),
    )
    assert judged(task).sound.holds


def test_a_switch_is_no_stop_button() -> None:
    """A person may switch to manual and back; giving up after an error may wait for the latter."""
    task = make_task(
        "parts=2 look! lost auto=1 manual",
        {
            "next": {"in": "parts !look !manual", "out": "look"},
            "seen": {"in": "look:normal"},
            "bad": {"in": "look:error", "out": "lost"},
            "to_manual": {"in": "auto", "event": "hand", "out": "manual"},
            "to_auto": {"in": "manual", "event": "back", "out": "auto"},
        },
        "hand back",
        final="parts == 0 and lost == 0",
        final_error=parse("parts == 0 and lost > 0"),
    )
    assert judged(task).sound.holds


@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("halts", [False, True])
def test_a_stop_button_is_not_a_fault(halts: bool, reset: bool) -> None:
    """Where it bars what would follow, `final` cannot be reached after it; else it only marks."""
    task = with_stop(seeded().task, reset=reset)
    bar = Inhibitor("halted", 1)
    first = replace(task.transitions["next"], inhibitors=(bar,) * halts)
    answer = may_run(replace(task, transitions={**task.transitions, "next": first}), None, Budget())
    assert answer.ok and not answer.objections()


def test_giving_up_may_wait_for_events_that_the_task_needs_anyhow() -> None:
    """A part that was lost is not missed before all others have come, and each may go left or
    right."""
    task = make_task(
        "parts=3 stored left! right!",
        {
            "to_left": {"in": "parts", "event": "red", "out": "left"},
            "to_right": {"in": "parts", "event": "green", "out": "right"},
            "good": {"in": "left:normal", "out": "stored"},
            "well": {"in": "right:normal", "out": "stored"},
            "lost": {"in": "left:error"},
            "gone": {"in": "right:error"},
        },
        "red green",
        final="stored == 3",
        final_error=parse("parts == 0 and stored < 3"),
    )
    assert judged(task).sound.holds


@pytest.mark.parametrize("broken", ["idle", "broken"])
def test_a_branch_that_listens_is_not_a_fault(broken: str) -> None:
    task = replace(seeded().task, final_error=parse("broken > 0"))
    answer = may_run(with_button(task, broken), None, Budget())
    assert answer.ok and not answer.objections()


def test_giving_up_may_wait_for_a_person_or_for_runs_that_are_active() -> None:
    """After an error `final` cannot be reached; the end needs the other run and the button."""
    task = make_task(
        "go=1 a! b! ready lost broken",
        {
            "begin": {"in": "go", "out": "a b"},
            "good": {"in": "a:normal", "out": "ready"},
            "bad": {"in": "a:error", "out": "lost"},
            "done": {"in": "b:normal", "out": "ready"},
            "gone": {"in": "b:error", "out": "lost"},
            "seen": {"in": "lost", "event": "button", "out": "broken"},
        },
        "button",
        final="ready == 2",
        final_error=parse("broken > 0 and lost == 0"),
    )
    assert judged(task).sound.holds


LEFT_BEHIND: dict[str, tuple[dict[str, dict[str, Any]], str, str]] = {
    "nothing has written the variable of a condition": (
        {
            "good": {"in": "act:normal", "when": "n > 5"},
            "fair": {"in": "act:normal", "when": "n <= 5"},
        },
        "places.act",
        "a run that ended is still there: good waits for a variable (n > 5)",
    ),
    "an internal event must come before the end": (
        {"good": {"in": "act:normal", "event": "spark"}},
        "places.act",
        "a run that ended is still there: good waits for spark, which no run of act has raised",
    ),
    "the other run of a join ended otherwise": (
        {
            "begin": {"in": "go", "out": "act other"},
            "good": {"in": "act:normal other:normal"},
            "lost": {"in": "other:error"},
        },
        "places.act",
        "good needs a run of other that ended in success or failure",
    ),
    "each holds what the other needs": (
        {
            "begin": {"in": "go hook rail", "out": "act other"},
            "good": {"in": "act:normal rail", "out": "rail hook"},
            "well": {"in": "other:normal hook", "out": "rail hook"},
            "bad": {"in": "act:error", "out": "hook"},
            "lost": {"in": "other:error", "out": "rail"},
        },
        "places.act",
        "ended runs of act and other are still there: good needs rail, which is empty",
    ),
}


@pytest.mark.parametrize("what", LEFT_BEHIND)
def test_a_run_that_is_left_at_the_end_is_a_warning(what: str) -> None:
    """`final` does not name the place, so the engine ends the mission run with SUCCESS."""
    more, key, words = LEFT_BEHIND[what]
    net = {"begin": {"in": "go", "out": "act"}, "bad": {"in": "act:error"}, **more}
    marking = "go=1 act! hook=1 rail=1" + " other!" * ("other" in str(net))
    unset = {"n": Variable("n", VariableType.INT)} if "n > 5" in words else {}
    task = make_task(marking, net, final="go == 0", events="spark<act")
    task = replace(task, variables=unset)
    judged_ = may_run(task, None, Budget())
    assert judged_.ok and judged_.analysis is not None
    (found,) = [f for f in judged_.report.findings if f.code == "left-behind" and f.key == key]
    assert found.severity == "warning" and words in found.text
    assert found.details[-1].lstrip().startswith(("act ends in", "other ends in"))
    assert not any("act 0 to 1" in note for note in judged_.analysis.notes)
    net["left"] = {"in": "act:normal", "priority": -1}
    task = make_task(marking, net, final="go == 0 and act == 0", events="spark<act")
    task = replace(task, variables=unset)
    keys = {f.key for f in may_run(task, None, Budget()).report.findings if f.code == "left-behind"}
    assert key not in keys


def test_the_cause_of_a_dead_end_names_the_variable_without_a_value() -> None:
    """The inhibitor arc only follows from it: `next` comes last."""
    task = make_task(
        "go=2 look! seen box",
        {
            "next": {"in": "go !seen !look", "out": "look"},
            "read": {"in": "look:normal", "out": "seen"},
            "unread": {"in": "look:error", "out": "seen"},
            "large": {"in": "seen", "out": "box", "when": "n > 5"},
            "small": {"in": "seen", "out": "box", "when": "n <= 5"},
        },
        final="go == 0 and seen == 0",
        variables={"n": 0},
        out={"look": {"n": "n"}},
    )
    unset = replace(task, variables={"n": replace(task.variables["n"], initial=None)})
    found = judged(unset).deadlock_free
    assert found.reason == "stuck with go seen: large has a false condition (n > 5): n has no value"
    assert found.details[-1] == "next is barred by seen, which holds 1"


def test_a_run_that_is_always_active_keeps_the_task_from_its_end() -> None:
    net = {
        "poll": {"in": "cpu", "out": "look"},
        "seen": {"in": "look:normal", "out": "cpu"},
        "unseen": {"in": "look:error", "out": "cpu"},
    }
    found = judged(make_task("cpu~=1 look! parts", net, final="parts == 0")).sound
    asked = "the end asks for no active run of look (only places with `listen` may have one)"
    assert found.holds is False and asked in found.details


def test_a_queue_that_only_the_operator_fills_is_searched_for_a_few_tokens() -> None:
    """He could add a token again and again: each leaves the place at once."""
    net = {"next": {"in": "parts", "out": "look"}, "bad": {"in": "look:error", "out": "look"}}
    net["seen"] = {"in": "look:normal"}
    task = make_task("parts=1 look!", net, final="parts == 0")
    task = replace(task, places={**task.places, "look": replace(task.places["look"], servers=1)})
    x = with_operator(execute(task), limit=2_000)
    assert x.complete and max(sum(s.marking) for s in x.states) == 1 + MOVES


def test_what_only_listens_is_not_what_is_stuck() -> None:
    """The cause is the part that the preempting transition lost, not that it could do so again."""
    task = make_task(
        "parts=2 done watch=1 move! fix!",
        {
            "go": {"in": "parts", "out": "move"},
            "n": {"in": "move:normal", "out": "done"},
            "e": {"in": "move:error", "out": "parts"},
            "low_now": {"in": "move:preempt=none watch", "out": "fix", "event": "low"},
            "charged": {"in": "fix:normal", "out": "watch"},
            "ce": {"in": "fix:error", "out": "watch"},
        },
        "low",
        final="done == 2",
    )
    watch = replace(task.places["watch"], kind=Kind.PLAIN, listen=True)
    found = judged(replace(task, places={**task.places, "watch": watch})).deadlock_free
    assert found.reason.endswith("the end asks for done == 2 (it holds 1)")
    assert found.details[0] == "done: only `n` can fill it, but `low_now` took move"


def test_values_are_written_as_in_conditions() -> None:
    task = make_task(
        "parts=1 other",
        {
            "next": {"in": "parts", "sets": (("seen", parse("true")),)},
            "far": {"in": "parts", "out": "other", "when": "ready and seen"},
        },
        final="parts == 0",
        variables={"seen": False, "ready": False},
    )
    assert judged(task).quasi_live.reason == (
        "far can never fire: its condition (ready and seen) is never true: "
        "ready is only ever false and seen is only ever false or true"
    )


def test_a_condition_that_is_never_true_is_why_a_transition_never_fires() -> None:
    task = make_task(
        "parts=1 look! other",
        {
            "next": {"in": "parts", "out": "look", "sets": (("n", parse("2")),)},
            "far": {"in": "look:normal", "out": "other", "when": "n == 3"},
            "near": {"in": "look:normal", "when": "n != 3"},
            "lost": {"in": "look:error"},
        },
        final="parts == 0",
        variables={"n": 0},
    )
    assert judged(task).quasi_live.reason == (
        "far can never fire: its condition (n == 3) is never true: n is only ever 0 or 2"
    )


def test_free_resources_are_not_what_is_stuck() -> None:
    task = make_task(
        "go=1 arm~=1 done", {"lose": {"in": "go arm", "out": "arm"}}, final="done == 1"
    )
    found = judged(task).deadlock_free
    assert found.reason.startswith("stuck with free resources alone: no transition takes what is")
    assert found.details == ("done: nothing ever fills it", "marked: arm")


def test_a_transition_that_never_fires_names_who_takes_its_tokens_first() -> None:
    net: dict[str, dict[str, Any]] = {
        "ask": {"in": "head", "out": "poll", "priority": 2},
        "asked": {"in": "poll:normal", "out": "head"},
        "unasked": {"in": "poll:error", "out": "head"},
        "clean": {"in": "jobs head", "out": "head"},
    }
    found = judged(make_task("jobs=1 head~=1 poll!", net, final="jobs == 0")).quasi_live
    assert found.reason.startswith("clean can never fire: in every state at rest it needs head")
    assert "because `ask` takes it first" in found.reason


@pytest.mark.parametrize(
    ("final", "said"), [("shelf == 1", "the mission ends"), ("shelf == 9", "others fire")]
)
def test_a_timer_that_never_fires_names_the_end_that_comes_first(final: str, said: str) -> None:
    net: dict[str, dict[str, Any]] = {
        "store": {"in": "bag", "out": "shelf"},
        "full": {"in": "shelf", "out": "bag", "after": 6.0},
        "sold": {"in": "shelf", "out": "gone", "after": 2.0},
    }
    found = judged(make_task("bag=1 shelf gone", net, final=final)).quasi_live
    assert found.reason.startswith("full can never fire: ")
    assert f"whenever its arcs are satisfied, {said} before its event or time" in found.reason


def test_a_transition_that_never_fires_tells_tokens_from_ends_of_runs() -> None:
    """Both runs are there at once, but the first error ends the other run before it can fail."""
    net: dict[str, dict[str, Any]] = {
        "split": {"in": "part", "out": "near far"},
        "join": {"in": "near:normal far:normal", "out": "done"},
        "both": {"in": "near:error far:error", "out": "done"},
        "one": {"in": "near:error far:preempt=none", "out": "done"},
        "other": {"in": "far:error near:preempt=none", "out": "done"},
    }
    found = judged(make_task("part=1 near! far! done", net, final="done == 1")).quasi_live
    assert found.reason == (
        "both can never fire: in no state at rest are the tokens that it needs (near, far) there "
        "together, with each run ended, or still active, as its arc asks"
    )


def test_a_transition_that_never_fires_names_who_goes_first_by_priority() -> None:
    """Its tokens are left there only where the task has given up: that bars it, and is no cause."""
    net: dict[str, dict[str, Any]] = {
        "easy": {"in": "jobs arm !dead", "out": "pick", "priority": 1},
        "hard": {"in": "jobs arm !dead", "out": "pick"},
        "picked": {"in": "pick:normal", "out": "arm"},
        "broke": {"in": "pick:error", "out": "arm dead"},
    }
    task = make_task("jobs=2 arm~=1 pick! dead", net, final="jobs == 0 and arm == 1 and dead == 0")
    found = judged(replace(task, final_error=parse("dead > 0"))).quasi_live
    assert found.reason == "hard can never fire: whenever it could, `easy` goes first, by priority"


@pytest.mark.parametrize("reset", [False, True])
def test_a_counter_that_nothing_resets_is_why_there_is_no_way_back(reset: bool) -> None:
    """The work is back after `fixed`, but the third error will be the last one."""
    net: dict[str, dict[str, Any]] = {
        "ok": {"in": "a:normal", "out": "done"},
        "bad": {"in": "a:error", "out": "fix failures"},
        "fixed": {"in": "fix:normal", "out": "a"},
        "not_fixed": {"in": "fix:error", "out": "fix failures"},
        "give_up": {"in": "fix:error failures*3", "out": "lost", "priority": 1},
        "give_up_too": {"in": "a:error failures*3", "out": "lost", "priority": 1},
    }
    if reset:
        net["forget"] = {"in": "failures a:going", "priority": 2}
    task = make_task("a!=1 fix! failures done lost", net, final="done == 1")
    found = {r.name: r for r in judged(replace(task, final_error=parse("lost == 1"))).recoveries}
    told = (
        "failures counts as an error that remains: an error branch fills it, and nothing empties "
        "it unless the task gives up"
    )
    assert (found["bad"].kappa == -1) is not reset
    assert (told in found["bad"].possible.details) is not reset
    assert not found["give_up"].possible.details


def test_a_place_where_the_task_gives_up_is_no_counter() -> None:
    """The run of its other branch is still being stopped after the error."""
    task = make_task(
        "a!=1 b!=1 done broken",
        {
            "well": {"in": "a:normal b:normal", "out": "done"},
            "bad": {"in": "a:error", "out": "broken"},
            "bad_too": {"in": "b:error", "out": "broken"},
        },
        final="done == 1 and broken == 0",
    )
    task = replace(task, final_error=parse("broken > 0"))
    (bad,) = (r for r in judged(task).recoveries if r.name == "bad")
    assert bad.kappa == -1 and not bad.possible.details


def test_what_a_winner_took_is_told_where_others_can_fill_the_place() -> None:
    """`quick` has priority over the task's own way to its end."""
    net: dict[str, dict[str, Any]] = {
        "made": {"in": "make:normal", "out": "part go"},
        "unmade": {"in": "make:error", "out": "part go"},
        "begin": {"in": "go", "out": "look"},
        "quick": {"in": "part", "out": "bin", "priority": 1},
        "seen": {"in": "part look:normal", "out": "done"},
        "unseen": {"in": "look:error", "out": "look"},
    }
    found = judged(
        make_task("make!=1 look! go part bin done", net, final="done == 1")
    ).deadlock_free
    assert found.details[0] == "part: taken by `quick`; only `made`, `unmade` can fill it"


def test_a_transition_that_never_fires_names_who_takes_its_runs_first() -> None:
    net = {**SORTING, "tired": {"in": "park:normal", "out": "broken arm", "priority": 2}}
    final, end = "parts == 0 and arm == 1", parse("broken == 1")
    found = judged(make_task(SORT, net, final=final, final_error=end)).quasi_live
    assert found.reason == (
        "parked can never fire: in every state at rest it needs a run of park that ended in "
        "success or failure, because `tired` takes it first"
    )


def test_of_a_ring_that_never_begins_only_its_own_transitions_are_told() -> None:
    net: dict[str, dict[str, Any]] = {
        "after": {"in": "end", "out": "done"},
        "far": {"in": "gate", "out": "look"},
        "seen": {"in": "look:normal", "out": "gate end"},
        "lost": {"in": "look:error", "out": "gate end"},
        "near": {"in": "parts", "out": "done"},
    }
    task = make_task("parts=1 gate look! end done", net, final="done == 1")
    assert judged(task).quasi_live.reason == (
        "far can never fire: it needs gate, which only `seen`, `lost` can fill; and so neither "
        "can after, seen, lost"
    )


def test_a_retry_is_not_why_its_place_is_never_entered() -> None:
    net: dict[str, dict[str, Any]] = {
        "far": {"in": "gate", "out": "look"},
        "seen": {"in": "look:normal", "out": "done"},
        "lost": {"in": "look:error", "out": "done"},
        "near": {"in": "parts", "out": "done"},
    }
    task = make_task("parts=1 gate look! done", net, final="done == 1")
    look = replace(task.places["look"], tries=2)
    assert judged(replace(task, places={**task.places, "look": look})).quasi_live.reason == (
        "far can never fire: it needs gate, which nothing ever fills; and so neither can seen, "
        "lost, look.retry"
    )


def test_a_task_that_gives_up_after_three_errors_is_sound() -> None:
    """`final_error` is also fulfilled in passing, but only a state at rest is an end."""
    task = make_task(
        "go=1 act! left=2 failed done",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "done"},
            "bad": {"in": "act:error", "out": "failed"},
            "again": {"in": "failed left", "out": "act"},
        },
        final="done == 1",
        final_error=parse("failed == 1"),
    )
    found = judged(task)
    assert found.sound.holds and found.deadlock_free.holds
    assert found.live.holds is False and found.live.witness is not None
    assert found.live.reason == "after failed no transition fires again"
    assert found.mended["live"].holds and found.mended["live"].assumption == MENDED
    assert may_run(task, None, Budget()).ok


@pytest.mark.parametrize(
    ("other", "steps", "severity"),
    [("failure", 60_000, None), ("error", 60_000, "error"), ("failure", 1, "note")],
)
def test_exits_that_read_another_run_are_judged_with_the_graph(
    other: str, steps: int, severity: str | None
) -> None:
    """`act` starts only after a normal end of `first`. Without a complete graph it is a note."""
    task = make_task(
        "go=1 first! act! done failed",
        {
            "begin": {"in": "go", "out": "first"},
            "next": {"in": "first:normal", "out": "act"},
            "good": {"in": "act:normal", "out": "done", "when": "first.status == 'success'"},
            "half": {"in": "act:normal", "out": "done", "when": f"first.status == '{other}'"},
            "first_bad": {"in": "first:error", "out": "failed"},
            "bad": {"in": "act:error", "out": "failed"},
        },
        final="done == 1",
        final_error=parse("failed == 1"),
    )
    answer = may_run(task, None, Budget(steps=steps))
    found = {f.severity.value for f in answer.report.findings if f.code == "uncovered-exit"}
    assert found == ({severity} if severity else set())
    assert answer.report.ok is (severity != "error")


def test_a_dead_end_is_why_only_an_error_leads_to_the_end() -> None:
    """Its cause is told once, and no advice about another one stands beside it."""
    task = make_task(
        "go=1 act! done lamp",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal lamp", "out": "done"},
            "bad": {"in": "act:error", "out": "done"},
        },
        final="done == 1",
    )
    assert judged(task).deadlock_free.holds is False
    found = may_run(task, None, Budget()).report.findings
    assert not [f for f in found if f.code == "end-by-error"]


@pytest.mark.parametrize("also", ["", " and waiting == 0"])
def test_an_end_that_only_an_error_leads_to_is_a_warning(also: str) -> None:
    """The token that waits for the button is never gone before `nod` ends in ERROR."""
    task = make_task(
        "go=1 act! waiting=1 nod!",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal"},
            "bad": {"in": "act:error"},
            "pressed": {"in": "waiting", "out": "nod", "event": "button"},
            "nodded": {"in": "nod:normal", "out": "waiting"},
            "broken": {"in": "nod:error"},
        },
        events="button+",
        final=f"go == 0 and act == 0{also}",
    )
    found = [f for f in may_run(task, None, Budget()).report.findings if f.code == "end-by-error"]
    assert [f.severity.value for f in found] == ["warning"] * bool(also)
    assert not also or any("nod ends in error" in line for line in found[0].details), found


def test_a_branch_that_can_never_fire_is_reported_with_its_reason() -> None:
    task = make_task(
        "go=1 act! done bin",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "done"},
            "bad": {"in": "act:error", "out": "bin done"},
            "never": {"in": "bin*2", "out": "done"},
        },
        final="done == 1",
    )
    verdict = judged(task).quasi_live
    assert verdict.holds is False
    assert verdict.reason == (
        "never can never fire: it needs 2 of bin, which never holds more than 1"
    )


def test_more_tokens_than_a_place_ever_holds_are_the_cause() -> None:
    """Who took the one token of `arm` first does not matter: there are never two."""
    task = make_task(
        "todo=3 arm~=1 belt/1 cut! done",
        {
            "take": {"in": "todo arm", "out": "cut"},
            "cut_ok": {"in": "cut:normal", "out": "belt arm"},
            "cut_bad": {"in": "cut:error", "out": "todo arm"},
            "pick": {"in": "belt arm*2", "out": "done arm*2"},
        },
        final="todo == 0 and done == 3",
    )
    found = judged(task)
    assert found.quasi_live.reason == (
        "pick can never fire: it needs 2 of arm, which never holds more than 1"
    )
    assert "arm: it never holds more than 1" in found.deadlock_free.details
    assert not any("still held" in line for line in found.deadlock_free.details)


def test_what_holds_the_missing_token_says_why_it_stays() -> None:
    """`done` keeps the key as long as the last run of `act` did not end in failure."""
    task = make_task(
        "jobs=2 key~=1 act! clean! done",
        {
            "begin": {"in": "jobs", "out": "act"},
            "good": {"in": "act:normal key", "out": "clean"},
            "bad": {"in": "act:error key", "out": "key"},
            "cleaned": {"in": "clean:normal", "out": "done"},
            "dirty": {"in": "clean:error", "out": "key"},
            "give": {"in": "done", "out": "key", "when": "act.status == 'failure'"},
        },
        final="jobs == 0 and key == 1",
    )
    details = judged(task).deadlock_free.details
    at = details.index("key: taken by `good`, still held with done")
    assert details[at + 1] == "done: give has a false condition (act.status == 'failure')"


def test_branches_that_wait_for_each_other_are_told_by_the_token_that_is_missing() -> None:
    task = make_task(
        "go=1 act! sort! done bin",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "done"},
            "bad": {"in": "act:error", "out": "done"},
            "special": {"in": "act:normal bin", "out": "sort", "priority": 1},
            "sorted": {"in": "sort:normal", "out": "bin done"},
            "lost": {"in": "sort:error", "out": "bin done"},
        },
        final="done == 1",
    )
    reason = judged(task).quasi_live.reason
    assert reason == (
        "special can never fire: it needs bin, which only `sorted`, `lost` can fill; and so "
        "neither can sorted, lost"
    )


def test_a_forecast_that_is_certain_of_a_task_that_is_not_sound_says_so() -> None:
    """The estimates know no failure, for which the task has no way."""
    task = make_task(
        "go=1 act! done",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "done", "when": "act.status == 'success'"},
            "bad": {"in": "act:error", "out": "done"},
        },
        final="done == 1",
    )
    known = {Status.SUCCESS: Estimate(0.9, 1.0), Status.ERROR: Estimate(0.1, 1.0)}
    primitives = {
        n: replace(p, estimates=known, deadline=1e6) for n, p in task.primitive_tasks.items()
    }
    found = analyse(replace(task, primitive_tasks=primitives), view="gspn")
    assert not found.verdicts()["sound"].holds
    assert "P_complete is 1, but the task is not sound" in found.text()


def test_endless_firing_is_reported() -> None:
    task = make_task(
        "go=1 a b act!",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "a"},
            "bad": {"in": "act:error", "out": "go"},
            "forth": {"in": "a", "out": "b"},
            "back": {"in": "b", "out": "a"},
        },
        final="a == 9",
    )
    verdict = judged(task).deadlock_free
    assert verdict.holds is False
    assert verdict.reason == "back, forth can fire for ever without time passing"


def test_a_loop_that_never_ends_is_not_sound() -> None:
    task = make_task(
        "go=1 act! done",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "go"},
            "bad": {"in": "act:error", "out": "go"},
        },
        final="done == 1",
    )
    found = judged(task)
    assert found.deadlock_free.holds and found.sound.holds is False
    assert found.sound.details == (
        "the end asks for done == 1 (it holds 0)",
        "done: nothing ever fills it",
        "the task can continue for ever, but never reaches done == 1",
    )


def test_a_watching_run_that_keeps_the_task_from_its_end_is_named() -> None:
    """As a watcher of a button does whose place does not say `listen`."""
    net = {
        "begin": {"in": "go", "out": "act"},
        "good": {"in": "act:normal", "out": "done"},
        "bad": {"in": "act:error", "out": "done"},
        "again": {"in": "watch:normal", "out": "watch"},
        "anew": {"in": "watch:error", "out": "watch"},
    }
    task = make_task("go=1 act! watch!=1 done", net, final="done == 1")
    assert judged(task).sound.details[0] == (
        "the task would end, but waits for the run in watch; if it may be cancelled then, write "
        "listen = true there"
    )
    places = {**task.places, "watch": replace(task.places["watch"], listen=True)}
    assert judged(replace(task, places=places)).sound.holds


@pytest.mark.parametrize("readings", range(12))
def test_what_is_not_judged_in_time_is_unknown(readings: int) -> None:
    """The time is used up at some reading of the clock, also in the middle of a verdict."""
    found, whole = judged(seeded().task), judged(seeded().task).verdicts()
    with until(float(readings), count().__next__):
        verdicts = found.verdicts()
    assert {name: v.holds for name, v in verdicts.items() if v.holds is not None}.items() <= {
        name: v.holds for name, v in whole.items()
    }.items()
    assert verdicts["stable"].holds is None


def test_a_task_that_can_only_give_up_is_not_sound() -> None:
    """Somebody expects two tokens of a resource that has one, and a bell rings for ever."""
    net = {
        "good": {"in": "act:normal", "out": "arm"},
        "bad": {"in": "act:error", "out": "broken"},
        "again": {"in": "arm", "event": "bell", "out": "act"},
    }
    ends: dict[str, Any] = {"final": "arm == 2", "final_error": parse("broken == 1")}
    found = judged(make_task("arm~=1 act! broken", net, "bell", **ends))
    assert found.deadlock_free.holds and found.sound.holds is False
    assert found.sound.reason == "the task can only give up: it never comes to arm == 2"
    assert found.sound.witness is not None  # so that `check` refuses it


def test_an_incomplete_graph_proves_nothing_but_still_refutes() -> None:
    grows = make_task(
        "go=1 act! bin",
        {
            "begin": {"in": "go", "out": "act"},
            "good": {"in": "act:normal", "out": "go bin"},
            "bad": {"in": "act:error", "out": "bin"},
        },
        final="bin == 1 and go == 3",
    )
    found = judged(grows, 40)
    assert found.deadlock_free.holds is False and found.live.holds is None
    fine = replace(
        grows,
        transitions={
            **grows.transitions,
            "bad": replace(grows.transitions["bad"], outputs=grows.transitions["good"].outputs),
        },
    )
    verdicts = judged(fine, 40).verdicts()
    assert {verdicts[name].holds for name in NAMES if name != "quasi_live"} == {None}
    unknown = judged(fine, 40).deadlock_free
    assert unknown.holds is None and "more than 40 stimuli and firings" in unknown.reason


def test_the_assumption_of_the_verdicts_is_told_once() -> None:
    """Some are proved on the cut execution graph, others on the ends net."""
    found = analyse(load(TASKS / "catch_ball.toml"), steps=1_000)
    assert found.progress is not None and not found.progress.x.complete
    assert found.text().count("These hold for the executed task if ") == 1


@pytest.mark.parametrize(
    ("final", "told"),
    [
        (
            "arm == 1",
            ["with 1 run: proved: bounded, deadlock free", "with 2 runs: proved: "],
        ),
        ("arm == 1 and done == 0", ["with 1 run: not deadlock free: stuck with done: "]),
    ],
)
def test_a_task_that_is_too_large_is_searched_with_fewer_runs(
    final: str, told: Sequence[str]
) -> None:
    """The fault shows at the end of the last run only, far beyond the limit."""
    task = seeded(cell=CELL.replace("parts=3", "parts=40")).task
    task = replace(task, final=parse(f"parts == 0 and {final}"), runs_place="parts")
    found = analyse(task, steps=300)
    assert found.progress is not None and not found.progress.x.complete and not found.objections
    assert [line[: len(words)] for line, words in zip(found.with_fewer, told, strict=True)] == told
    assert set(found.with_fewer) <= set(found.to_json(structure=False)["notes"])
    assert not analyse(task).fewer  # where the whole graph is known, it is not asked


def test_a_path_tells_the_usual_reason() -> None:
    """`tries` asks whether a run ended by an emergency stop. A run that did not is no such case."""
    words = [end for _, end in execute(loads(TRIES)).names.ends["grasp"]]
    errors = [text for text in words if text.startswith("error")]
    assert words[0] == "success"
    assert "reason 'other'" in errors[0] and "reason 'emergency_stop'" in errors[-1]


KEPT = """
schema = 1
[task]
name = "kept"
final = "parts == 0 and arm == 1"
final_error = "broken > 0"
[primitive_tasks]
work = { deadline = 1.0 }
load = { deadline = 1.0 }
wave = { deadline = 1.0 }
[events]
button = { memory = "latched", early = "keep" }
[places]
parts = { kind = "control", tokens = 1 }
arm = { kind = "resource", tokens = 1 }
broken = {}
work = { kind = "action" }
load = { kind = "action", holds = "arm" }
ready = { tokens = 1, listen = true }
wave = { kind = "action", holds = "arm", listen = true }
[transitions]
start = { in = ["parts"], out = ["work", "load"] }
worked = { in = ["work:normal"] }
failed = { in = ["work:error"], out = ["broken"] }
loaded = { in = ["load:normal"] }
spilled = { in = ["load:error"], out = ["broken"] }
pressed = { in = ["ready"], out = ["wave"], event = "button" }
waved = { in = ["wave:normal"], out = ["ready"] }
tired = { in = ["wave:error"], out = ["ready"] }
"""


@pytest.mark.parametrize("end", ["error", "failure"])
def test_an_event_that_is_served_when_the_mission_is_lost_does_not_stop_it(end: str) -> None:
    """`pressed` waits for the arm, which the transition gives back by which the mission is lost:
    after an ERROR, or after another end that alone leads to `final_error`."""
    text = KEPT
    if end == "failure":
        good, bad = (f"""when = 'load.status {sign} "success"' }}""" for sign in ("==", "!="))
        spilt = f'spilt = {{ in = ["load:normal"], out = ["broken"], {bad}'
        old = 'loaded = { in = ["load:normal"] }'
        text = text.replace(old, f"{old[:-2]}, {good}\n{spilt}")
    found = judged(loads(text))
    assert found.sound.holds, found.sound.reason


def test_the_order_of_timers_is_kept() -> None:
    """The shorter of two timers that are armed together elapses first, so `late` never fires."""
    net: dict[str, dict[str, Any]] = {
        "soon": {"in": "wait", "out": "a", "after": 1.0},
        "late": {"in": "wait", "out": "b", "after": 2.0},
    }
    found = judged(make_task("wait=1 a b", net, final="a == 1"))
    assert found.quasi_live.holds is False and found.quasi_live.reason.startswith("late ")
    assert found.deadlock_free.holds and len(found.x) == 2


@pytest.mark.parametrize(
    ("gone", "matters"), [("a b", False), ("a", True)], ids=["both go on", "one gets stuck"]
)
def test_a_conflict_is_a_note_unless_a_verdict_depends_on_it(gone: str, matters: bool) -> None:
    """`first` and `second` compete for the same token; the engine fires `first`."""
    net: dict[str, dict[str, Any]] = {
        "first": {"in": "token", "out": "a"},
        "second": {"in": "token", "out": "b"},
        **{f"end_{p}": {"in": p, "out": "done", "after": 1.0} for p in gone.split()},
    }
    task = make_task("token=1 a b done", net, final="done == 1")
    answer = may_run(task, None, Budget())
    (found,) = (f for f in answer.report.findings if f.code == "unsettled-conflict")
    assert "may both want the last token of token" in found.text
    assert found.severity == ("error" if matters else "note")
    assert answer.ok is not matters
    assert ("deadlock free: stuck with b" in found.text) is matters
    assert ("second may have to wait" in found.remedy) is not matters


@pytest.mark.parametrize(
    ("weights", "told"),
    [((2.0, None), "the weight of first does not count: second has none"), ((None, None), "")],
)
def test_a_weight_that_does_not_count_is_named(
    weights: tuple[float | None, float | None], told: str
) -> None:
    """The engine draws only if all rivals have a weight."""
    net: dict[str, dict[str, Any]] = {
        "first": {"in": "token", "out": "a", "weight": weights[0]},
        "second": {"in": "token", "out": "b", "weight": weights[1]},
    }
    task = make_task("token=1 a b", net, final="a == 1 or b == 1")
    for budget in (Budget(), None):  # on the graph, and on the arcs alone
        report = may_run(task, None, budget).report
        (found,) = (f for f in report.findings if f.code == "unsettled-conflict")
        assert told in found.text and ("weight" in found.text) is bool(told)


@pytest.mark.parametrize(("given", "most"), [("runs", 0), ("runs*2", 2)])
def test_a_runs_place_that_grows_is_noted(given: str, most: int) -> None:
    """A campaign has one row for each token of the beginning, whatever is added later."""
    net: dict[str, dict[str, Any]] = {
        "go": {"in": "runs", "out": "look"},
        "seen": {"in": "look:normal"},
        "again": {"in": "look:error spare", "out": given},
        "lost": {"in": "look:error !spare"},
    }
    task = make_task("runs=1 spare=2 look!", net, final="runs == 0", runs_place="runs")
    found = [f for f in may_run(task, None, Budget()).report.findings if f.code == "more-runs"]
    assert len(found) == (most > 0)
    assert all(f"runs can hold {most} tokens, more than the 1" in f.text for f in found)


def test_transitions_that_are_never_enabled_together_are_not_a_conflict() -> None:
    net: dict[str, dict[str, Any]] = {
        "first": {"in": "token", "out": "phase"},
        "second": {"in": "phase token2", "out": "done"},
        "third": {"in": "phase", "out": "done", "after": 1.0},
    }
    task = make_task("token=1 token2 phase done", net, final="done == 1")
    codes = [f.code for f in may_run(task, None, Budget()).report.findings]
    assert "unsettled-conflict" not in codes


def test_a_variable_that_no_place_writes_is_named() -> None:
    net = {"go": {"in": "a", "out": "b", "when": "n > 3"}}
    found = judged(make_task("a=1 b", net, variables={"n": 0}, final="b == 1"))
    assert found.sound.holds and "n may take any value at any time" in found.sound.assumption
    assert found.notes == ("assumes that n may take any value at any time",)


# --- recovery -------------------------------------------------------------------------------


def arm(attempts: int, *, give_up: bool = True) -> Task:
    """One action with an error exit, `attempts` retries, and a proper end."""
    net = {
        "start": {"in": "idle runs", "out": "move"},
        "done": {"in": "move:normal", "out": "idle"},
        "fault": {"in": "move:error", "out": "recover"},
        "recovered": {"in": "recover:normal", "out": "clean"},
        "again": {"in": "recover:error left", "out": "recover used"},
        "forgive": {"in": "clean used", "out": "clean left"},
        "back": {"in": "clean !used", "out": "idle"},
    }
    if give_up:
        net["give_up"] = {"in": "recover:error !left", "out": "out_of_order"}
    places = f"idle=1 runs=2 move! recover! clean left={attempts} used out_of_order"
    return make_task(
        places,
        net,
        final="runs == 0 and idle == 1",
        final_error=parse("out_of_order == 1"),
        runs_place="runs",
        goal_transitions=("done",),
    )


@pytest.mark.parametrize("attempts", [1, 2, 3])
def test_kappa_counts_the_errors_that_recovery_survives(attempts: int) -> None:
    found = {r.error_exit: r for r in judged(arm(attempts)).recoveries}
    fault = found["fault"]
    assert fault.alone and fault.possible.holds is True
    assert fault.almost_sure.holds is False and fault.almost_sure.witness is not None
    assert fault.kappa == attempts and fault.strategy[:2] == ("recovered", "back")
    assert fault.lost == (1, 1)
    assert not found["again"].alone and found["again"].kappa == 0 and found["again"].lost == (0, 0)
    give_up = found["give_up"]
    assert give_up.lost == (0, 1)
    assert give_up.kappa == -1 and give_up.possible.holds is False and not give_up.alone


def test_recovery_that_is_never_given_up_survives_any_number_of_errors() -> None:
    task = arm(0, give_up=False)
    again = replace(task.transitions["again"], inputs=task.transitions["again"].inputs[:1])
    outputs = tuple(o for o in again.outputs if o.place == "recover")
    again = replace(again, outputs=outputs)
    found = judged(replace(task, transitions={**task.transitions, "again": again}))
    fault = next(r for r in found.recoveries if r.error_exit == "fault")
    assert fault.kappa is None and fault.almost_sure.holds


@pytest.mark.parametrize(
    ("final", "back", "kappa"),
    [("parts == 0", True, None), ("parts == 0 and skipped < 2", False, -1)],
)
def test_a_counter_of_errors_that_nothing_reads_is_no_error_state(
    final: str, back: bool, kappa: int | None
) -> None:
    """Its tokens never leave it, so no way led back although the task goes on as before."""
    net = {
        "next": {"in": "parts", "out": "grasp"},
        "grasped": {"in": "grasp:normal"},
        "missed": {"in": "grasp:error", "out": "skipped"},
    }
    (missed,) = judged(make_task("parts=1 grasp! skipped", net, final=final)).recoveries
    assert (missed.possible.holds, missed.kappa) == (back, kappa)


@pytest.mark.once
def test_the_shipped_tasks_may_run() -> None:
    for path in sorted(TASKS.glob("*.toml")):
        found = judged(load(path))
        assert found.x.complete
        again = {"live", "proper", "stable", "controllable"}
        refused = {name for name, verdict in found.verdicts().items() if not verdict.holds}
        assert refused == again == {n for n, v in found.mended.items() if v.holds}, path.stem
        assert may_run(load(path), None, Budget()).ok


def test_the_catching_task_survives_three_further_errors() -> None:
    found = judged(load(TASKS / "catch_ball.toml"))
    kappa = {r.error_exit: r.kappa for r in found.recoveries}
    assert kappa["move_failed"] == kappa["catch_failed"] == kappa["home_failed"] == 3
    assert kappa["not_located"] is None and kappa["give_up"] == -1
    sure = {r.error_exit: r.almost_sure.holds for r in found.recoveries}
    assert sure["not_located"] and not sure["move_failed"]
    assert len(found.x) == 418


# --- how probable the way back is, and how long it takes ----------------------------------------


def with_estimates(task: Task, given: Mapping[str, tuple[float, float, float]]) -> Task:
    """Declare by primitive task: the share of errors, and the mean times (s) of success and
    error."""
    primitives = dict(task.primitive_tasks)
    for name, (share, good, bad) in given.items():
        estimates = {
            Status.SUCCESS: Estimate(1 - share, good, 0.5),
            Status.ERROR: Estimate(share, bad, 0.5),
        }
        primitives[name] = replace(primitives[name], estimates=estimates, deadline=1e6)
    return replace(task, primitive_tasks=primitives)


@pytest.mark.parametrize("attempts", [1, 3])
@pytest.mark.parametrize("q", [0.05, 0.5])
def test_probability_and_mean_time_of_a_recovery_are_those_of_its_trials(
    attempts: int, q: float
) -> None:
    """Trials that fail with probability q and take 3 s, or succeed after 6 s."""
    task = with_estimates(arm(attempts), {"move": (0.1, 1.0, 2.0), "recover": (q, 6.0, 3.0)})
    odds = judged(task).odds
    p, mean = odds.by_exit["fault"]
    ways = [(q**k * (1 - q), 3.0 * k + 6.0) for k in range(attempts + 1)]
    assert p == pytest.approx(1 - q ** (attempts + 1), abs=1e-12)
    assert mean == pytest.approx(sum(w * t for w, t in ways) / p, rel=1e-9)
    assert odds.by_exit["give_up"][0] == 0.0 and not odds.missing


def test_recovery_from_an_arm_fault_agrees_with_the_estimates() -> None:
    found = judged(load(TASKS / "catch_ball.toml"))
    p, mean = found.odds.by_exit["move_failed"]
    assert p == pytest.approx(1 - 0.05**4, abs=1e-12) and mean == pytest.approx(6.158, abs=1e-3)
    assert found.odds.by_exit["give_up"][0] == 0.0


@pytest.mark.once
@pytest.mark.parametrize("name", ["catch_ball", "follow_track"])
def test_the_chain_completes_as_probably_as_the_stochastic_view(name: str) -> None:
    """Two models are made from the same numbers in different ways. follow_track has conditions on
    values that runs write; the two models assume different frequencies for them."""
    task = load(TASKS / f"{name}.toml")
    found = judged(task)
    chain = chain_of(found.x)
    expected = forecast(stochastic_view(task, stages=chain.stages, timer_stages=chain.stages))
    begins = np.arange(len(found.x.source))[found.x.source == 0]
    back = chain.back(begins, found.x.final)
    assert back is not None
    near = 1e-9 if name == "catch_ball" else 2e-4
    assert back[0] == pytest.approx(expected.completion_probability, abs=near)


def test_a_preempting_event_races_with_the_run() -> None:
    """An exponential run of mean 1 s against an event of mean 3 s: 3/4 end by themselves."""
    net = {
        "fault": {"in": "act:error", "out": "mend"},
        "good": {"in": "act:normal", "out": "done"},
        "back": {"in": "mend:normal", "out": "done"},
        "worse": {"in": "mend:error", "out": "lost"},
        "stop": {"in": "mend:preempt=none", "event": "bell", "out": "lost"},
    }
    task = make_task(
        "act!=1 mend! done lost", net, "bell", final="done == 1", final_error=parse("lost == 1")
    )
    sure = {Status.SUCCESS: Estimate(1.0, 1.0, 1.0), Status.ERROR: Estimate(0.0, 0.0)}
    task = with_estimates(task, {"act": (0.5, 1.0, 1.0)})
    mend = replace(task.primitive_tasks["mend"], estimates=sure, deadline=1e6)
    task = replace(task, primitive_tasks={**task.primitive_tasks, "mend": mend})
    bell = replace(task.events["bell"], mean_wait=3.0)
    odds = judged(replace(task, events={"bell": bell})).odds
    assert "worse" not in odds.by_exit
    p, mean = odds.by_exit["fault"]
    assert p == pytest.approx(0.75, abs=1e-9) and mean == pytest.approx(0.75, abs=1e-9)


def test_causes_of_an_error_are_distinguished_where_they_matter() -> None:
    """After a drive fault nothing repairs the arm; after any other error an action does."""
    net: dict[str, dict[str, Any]] = {
        "good": {"in": "act:normal", "out": "done"},
        "fault": {"in": "act:error", "out": "stopped"},
        "mend": {"in": "stopped", "out": "done", "when": "act.reason != 'drive'", "after": 1.0},
        "leave": {"in": "stopped", "out": "lost", "when": "act.reason == 'drive'", "after": 1.0},
    }
    task = make_task(
        "act!=1 stopped done lost", net, final="done == 1", final_error=parse("lost == 1")
    )
    found = judged(with_estimates(task, {"act": (0.5, 1.0, 1.0)}))
    named = {r.name: r for r in found.recoveries}
    assert named["fault ('drive')"].possible.holds is False
    others = [r for r in named.values() if r.cause and r.cause != "'drive'"]
    assert others and all(r.almost_sure.holds for r in others)
    assert found.odds.by_exit["fault ('drive')"][0] == 0.0
    p, mean = found.odds.by_exit[others[0].name]
    assert p == 1.0 and mean == pytest.approx(1.0)


def test_measured_numbers_replace_declared_ones() -> None:
    task = with_estimates(arm(1), {"move": (0.1, 1.0, 2.0), "recover": (0.5, 6.0, 3.0)})
    ends = {Status.SUCCESS: Estimate(0.9, 1.0, 0.5), Status.ERROR: Estimate(0.1, 1.0, 0.5)}
    measured = Measured(runs={("recover", "do_recover"): ends})
    odds = progress_of(OrdinaryView(task), 10_000, measured).odds
    assert odds.by_exit["fault"][0] == pytest.approx(0.99, abs=1e-12)


def test_a_measured_preemption_is_a_cause_by_which_its_run_ends() -> None:
    """The chain takes each transition as often as the stochastic view does."""
    ends = {
        "intercept_upright": {Status.SUCCESS: Estimate(0.8, 1.0, 0.3)},
        "intercept_tilted": {Status.SUCCESS: Estimate(0.6, 1.0, 0.3)},
        "follow_and_wait": {Status.FAILURE: Estimate(0.05, 1.2, 0.3)},
    }
    error = {Status.ERROR: Estimate(0.1, 0.5, 0.5)}
    shares = {"intercept_upright": 0.1, "intercept_tilted": 0.3, "follow_and_wait": 0.85}
    places = {"move_to_point": "caught_early", "catch_ball": "caught"}
    of = {name: "catch_ball" if name == "follow_and_wait" else "move_to_point" for name in ends}
    measured = Measured(
        runs={(of[name], name): {**given, **error} for name, given in ends.items()},
        preempted={
            (of[name], name): {places[of[name]]: Estimate(share, 0.5, 0.4)}
            for name, share in shares.items()
        },
        choice={"move_to_point": {"intercept_upright": 0.25, "intercept_tilted": 0.75}},
    )
    task = load(TASKS / "catch_ball.toml")
    x = judged(task).x
    chain = chain_of(x, measured)
    view = stochastic_view(task, measured, stages=chain.stages, timer_stages=chain.stages)
    expected = forecast(view)
    begin = chain.back(np.flatnonzero(x.source == 0), x.final)
    assert begin is not None
    assert begin[0] == pytest.approx(expected.completion_probability, abs=1e-9)
    taken = chain.taken
    for name in ("move_failed", "catch_failed", "caught", "caught_early", "missed"):
        edges = np.flatnonzero(x.firing([name]))
        found = taken[np.isin(chain.edge, edges)].sum()
        assert found == pytest.approx(expected.firings[name], rel=1e-9), name


def test_without_an_estimate_there_is_no_probability() -> None:
    task = with_estimates(arm(1), {"move": (0.1, 1.0, 2.0)})
    odds = judged(task).odds
    assert odds.missing == "no estimate for `recover`" and not odds.by_exit
    assert "no probability: no estimate for `recover`" in analyse(task).text()
    sure = with_estimates(arm(1), {"move": (0.0, 1.0, 2.0), "recover": (0.1, 1.0, 2.0)})
    assert "no probability: by these numbers never taken: " in analyse(sure).text()


def test_the_same_task_gives_the_same_graph() -> None:
    task = load(TASKS / "catch_ball.toml")
    one, other = execute(task), execute(task)
    assert one.steps == other.steps and np.array_equal(one.target, other.target)


@settings(max_examples=60, deadline=None)
@given(state_machines(tokens=1), st.data())
def test_almost_sure_attraction_is_the_value_one_of_the_decision_process(
    net: Net, data: st.DataObject
) -> None:
    """Against an enumeration of all memoryless strategies.

    A strategy leaves out free edges; all others are equally likely. A vertex wins if and only if
    under some strategy every vertex that is reached can still reach the goal.
    """
    space = explore(net)
    edges, n = len(space.target), len(space)
    assume(0 < edges <= 9)
    free = np.array(data.draw(st.lists(st.booleans(), min_size=edges, max_size=edges)))
    goal = np.arange(n) == data.draw(st.integers(0, n - 1))
    graph = Graph(n, space.source, space.target)
    expected = np.zeros(n, dtype=bool)
    choices = np.flatnonzero(free)
    for pick in range(1 << len(choices)):
        kept = ~free
        kept[choices[[bool(pick >> k & 1) for k in range(len(choices))]]] = True
        kept &= ~goal[space.source]
        can = graph.backward(goal, kept)
        for v in range(n):
            reached = [graph.path(v, np.arange(n) == u, kept) is not None for u in range(n)]
            expected[v] |= bool(can[reached].all())
    assert np.array_equal(graph.almost_sure(goal, free), expected)


# --- what only the operator's tokens make possible -----------------------------------------------


def test_the_operators_tokens_can_make_the_catching_task_stuck() -> None:
    found = judged(load(TASKS / "catch_ball.toml"))
    assert found.deadlock_free.holds
    notes = found.by_hand(20_000)
    recovered = next(n for n in notes if "arm_recovered" in n.reason)
    assert recovered.reason.startswith("stuck with ")
    assert "forgive is barred by attempts (capacity 3), which holds 3" in recovered.reason
    assert "arm_back is barred by failed_attempts, which holds 1" in recovered.details
    for note in notes:
        assert note.witness is not None
        commands = [step for step in note.witness.steps if step.startswith("the operator ")]
        assert commands == ["the operator adds a token to failed_attempts -> nothing"]


def test_each_state_after_the_operators_tokens_can_be_replayed() -> None:
    own = execute(arm(1))
    x = with_operator(own, limit=20_000)
    assert len(x) > len(own) and x.states[: len(own)] == own.states
    for i in range(len(x)):
        state = x.engine.initial()
        for stimulus in x.stimuli(i):
            state, _ = x.engine.handle(state, stimulus)
        assert state == x.states[i]
    dead = np.flatnonzero(x.dead)
    assert len(dead) and not x.dead[: len(own)].any()
    assert all(any(s.text.startswith("the operator") for s in x.path(int(i))) for i in dead)


def test_a_conflict_that_needs_the_operators_token_is_a_note() -> None:
    """Only the operator can mark the cup as dirty; while the arm is away, both transitions wait for
    it."""
    net: dict[str, dict[str, Any]] = {
        "pick": {"in": "parts arm", "out": "act"},
        "picked": {"in": "act:normal", "out": "arm"},
        "lost": {"in": "act:error", "out": "arm"},
        "clean": {"in": "dirty arm", "out": "wash"},
        "washed": {"in": "wash:normal", "out": "arm"},
        "unwashed": {"in": "wash:error", "out": "arm"},
    }
    task = make_task(
        "parts=2 arm~=1 dirty/1 act! wash!", net, final="parts == 0 and arm == 1 and dirty == 0"
    )
    found = judged(task)
    assert not found.contests and found.deadlock_free.holds
    (note,) = found.by_hand(20_000)
    assert note.reason == "pick and clean may both want the last token of arm"
    path = ("the operator adds a token to dirty -> nothing", "act ends in success -> picked")
    assert note.witness is not None and note.witness.steps[-2:] == path


def test_two_actions_of_one_device_never_run_at_the_same_time() -> None:
    """The transition that needs both at once is reported only if it is known that they share a
    device."""
    net: dict[str, dict[str, Any]] = {
        "start": {"in": "begin", "out": "drive look"},
        "seen": {"in": "drive:preempt=success look:normal", "out": "end"},
        "blind": {"in": "drive:preempt=success look:error", "out": "end"},
        "broken": {"in": "drive:error !look", "out": "end"},
        "driven": {"in": "drive:normal !look", "out": "end"},
    }
    task = make_task("begin=1 end drive! look!", net, final="end == 1")
    actions = [a for p in task.primitive_tasks.values() for a in p.alternatives]
    apart = progress_of(OrdinaryView(task), 40_000, None, {a: a for a in actions})
    assert "seen" not in apart.quasi_live.reason
    shared = progress_of(OrdinaryView(task), 40_000, None, dict.fromkeys(actions, "arm"))
    assert not shared.quasi_live.holds and "seen can never fire" in shared.quasi_live.reason


def test_only_runs_that_end_in_error_are_retries() -> None:
    """A value that reads like the end of a run is none."""
    net = {
        "go": {"in": "a", "out": "b", "when": "word == 'one ends in error'"},
        "back": {"in": "b", "out": "a", "when": "word == 'two ends in error'"},
        "end": {"in": "a", "out": "done", "when": "word == 'end'"},
    }
    task = make_task("a=1 b done", net, variables={"word": ""}, final="done == 1")
    x = execute(task)
    assert len([step for step in x.steps if "ends in error" in step.text and step.firings]) == 2
    assert x.retries == ()
    assert execute(arm(1, give_up=False)).retries == ()
    again = {
        "good": {"in": "act:normal", "out": "done"},
        "again": {"in": "act:error", "out": "act"},
    }
    assert execute(make_task("act!=1 done", again, final="done == 1")).retries == (("again",),)


def test_a_variable_without_a_value_is_why_a_transition_never_fires() -> None:
    """The tokens are there; what is missing is the value."""
    task = make_task(
        "parts=1 work! look! seen",
        {
            "next": {"in": "parts", "out": "work"},
            "worked": {"in": "work:normal", "out": "seen"},
            "spoilt": {"in": "work:error", "out": "seen"},
            "left": {"in": "seen", "when": "side == 1"},
            "right": {"in": "seen", "out": "look", "when": "side == 2"},
            "looked": {"in": "look:normal", "out": "seen"},
            "lost": {"in": "look:error", "out": "seen"},
        },
        final="parts == 0 and seen == 0",
        variables={"side": 0},
        out={"look": {"side": "side"}},
    )
    task = replace(task, variables={"side": Variable("side", VariableType.INT)})
    assert judged(task).quasi_live.reason.startswith(
        "left can never fire: when its tokens are there, it has a false condition (side == 1): "
        "side has no value; right"
    )


def test_a_place_that_never_holds_enough_is_told_with_the_number() -> None:
    net = {"next": {"in": "parts grip*2", "out": "done"}, "back": {"in": "done", "out": "grip"}}
    task = make_task("parts=1 grip~=1 done", net, final="parts == 0 and done == 0")
    assert judged(task).quasi_live.reason.startswith(
        "next can never fire: it needs 2 of grip, which never holds more than 1"
    )


def test_what_the_end_asks_for_comes_before_a_place_that_it_wants_empty() -> None:
    """The task has done all its work, and a token stays where the end wants none."""
    net = {"next": {"in": "parts idle", "out": "look"}}
    net |= {"seen": {"in": "look:normal", "out": "idle"}}
    net |= {"lost": {"in": "look:error", "out": "idle"}}
    task = make_task("parts=1 idle=1 look!", net, final="parts == 0 and idle == 0")
    assert judged(task).deadlock_free.reason == (
        "stuck with idle: the end asks for idle == 0 (it holds 1), and next needs parts, which "
        "is empty"
    )


def test_a_false_condition_is_told_with_who_wrote_its_variable() -> None:
    busy, free = (("busy", parse("1")),), (("busy", parse("0")),)
    task = make_task(
        "parts=2 arm~=1 look!",
        {
            "next": {"in": "parts arm", "out": "look", "when": "busy == 0", "sets": busy},
            "seen": {"in": "look:normal", "out": "arm"},
            "lost": {"in": "look:error", "out": "arm", "sets": free},
        },
        final="parts == 0",
        variables={"busy": 0},
    )
    verdict = judged(task).deadlock_free
    assert verdict.reason == "stuck with parts: next has a false condition (busy == 0)"
    assert verdict.details[0] == "busy: `next` set it to 1; otherwise only `lost` sets it"


def test_a_resource_that_an_ended_run_keeps_is_told_with_what_that_run_lacks() -> None:
    task = make_task(
        "parts=1 arm~=1 look! cup",
        {
            "next": {"in": "parts arm", "out": "look"},
            "seen": {"in": "look:normal cup", "out": "arm cup"},
            "lost": {"in": "look:error", "out": "arm"},
        },
        final="parts == 0",
    )
    verdict = judged(task).returned
    assert verdict.holds is False
    assert "look has ended: seen needs cup, which is empty" in verdict.details


def crossed(steps: int, door: bool, stop: bool = False) -> Task:
    """Return a task of two arms that each make some steps, then take two tools in opposite order.
    Beside them a door opens and closes for ever, or three lamps shine a few times."""
    text = """schema = 1
[task]
name = "crossed"
final = "left == 1 and right == 1"
final_error = "broken > 0"
[errors]
to = "broken"
[primitive_tasks]
move = { goal = "it is there", deadline = 5.0 }
[events]
opens = { memory = "latched", early = "keep" }
closes = { memory = "latched", early = "keep" }
[places]
left = {}
right = {}
broken = {}
pen = { kind = "resource", tokens = 1 }
knife = { kind = "resource", tokens = 1 }
shut = { tokens = 1, listen = true }
open = { listen = true }
"""
    places, arcs = list[str](), list[str]()
    for arm, first, second in (("left", "pen", "knife"), ("right", "knife", "pen")):
        places.append(f"{arm}_ready = {{ tokens = 1 }}")
        places += [f'{arm}{n} = {{ kind = "action", task = "move" }}' for n in range(steps + 2)]
        arcs.append(f'{arm}_go = {{ in = ["{arm}_ready"], out = ["{arm}0"] }}')
        for n in range(steps + 1):
            tool = {steps - 1: f', "{first}"', steps: f', "{second}"'}.get(n, "")
            arcs.append(f'{arm}_{n} = {{ in = ["{arm}{n}:normal"{tool}], out = ["{arm}{n + 1}"] }}')
        given = f'["{arm}", "pen", "knife"]'
        arcs.append(f'{arm}_end = {{ in = ["{arm}{steps + 1}:normal"], out = {given} }}')
    if door:
        arcs.append('opened = { in = ["shut"], out = ["open"], event = "opens" }')
        arcs.append('closed = { in = ["open"], out = ["shut"], event = "closes" }')
    if stop:
        text = text.replace(
            "[events]\n", '[events]\nstop = { memory = "latched", early = "keep" }\n'
        )
        places.append("running = { tokens = 1, listen = true }")
        arcs.append('halt = { in = ["running"], out = ["broken"], event = "stop" }')
    for lamp in () if door else ("red", "green", "blue"):
        places.append(f"{lamp}_left = {{ tokens = 4 }}")
        places.append(f'{lamp} = {{ kind = "action", task = "move" }}')
        arcs.append(f'{lamp}_on = {{ in = ["{lamp}_left", "!{lamp}"], out = ["{lamp}"] }}')
        arcs.append(f'{lamp}_off = {{ in = ["{lamp}:normal"] }}')
    return loads("\n".join([text, *places, "[transitions]", *arcs, ""]))


@pytest.mark.parametrize(
    ("door", "steps", "limit", "refuted"),
    [(True, 12, 9_000, {"sound"}), (False, 4, 20_000, {"sound", "deadlock_free"})],
)
def test_a_dead_end_far_from_the_beginning_is_found_by_random_plays(
    door: bool,
    steps: int,
    limit: int,
    refuted: set[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Breadth first, the other branch swells the graph, so that its limit is reached long before.
    With the door the arms are stuck, while it can go on for ever: not a dead end of the graph."""
    view = OrdinaryView(crossed(steps, door))
    found = progress_of(view, limit)
    assert not found.x.complete
    assert {name for name, v in found.verdicts().items() if v.holds is False} == refuted
    verdict = found.sound if door else found.deadlock_free
    witness = verdict.witness
    assert witness is not None
    assert {"pen", "knife"}.isdisjoint(witness.marking)
    told = " ".join((verdict.reason, *verdict.details))
    assert "needs knife, which is empty" in told and "needs pen, which is empty" in told
    state = next(i for i in range(len(found.x)) if found.x.marked(i) == witness.marking)
    after = found.x.engine.initial()
    for stimulus in found.x.stimuli(state):
        after, _ = found.x.engine.handle(after, stimulus)
    assert after == found.x.states[state]
    again = progress_of(view, limit)
    assert (again.x.states, again.x.steps) == (found.x.states, found.x.steps)
    monkeypatch.setattr(graph, "PLAYS", limit + 1)  # so that there are none
    assert progress_of(view, limit).sound.holds is None


@pytest.mark.parametrize(("steps", "limit"), [(12, 9_000), (20, 9_000)])
def test_a_stop_button_does_not_hide_what_random_plays_find(steps: int, limit: int) -> None:
    """Most plays press it, and after it `final` is out of reach: careful ones do not."""
    found = progress_of(OrdinaryView(crossed(steps, door=True, stop=True)), limit)
    assert not found.x.complete and found.sound.holds is False
    told = " ".join((found.sound.reason, *found.sound.details))
    assert "needs knife, which is empty" in told and "needs pen, which is empty" in told
