"""The operator's commands: pause, step, breakpoints, tokens, events, forced exits, abort."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    ArmTimer,
    CancelRun,
    Choose,
    Chosen,
    EventOccurred,
    ForceExit,
    Hold,
    HoldRun,
    HoldTimer,
    Marked,
    Override,
    Pause,
    Paused,
    RaiseEvent,
    ReleaseRun,
    ReleaseTimer,
    RemoveTokens,
    Resume,
    RunEnded,
    RunHeld,
    RunRecorded,
    RunStarted,
    SetBreakpoints,
    StartRun,
    Step,
    StopConfirmed,
    TimerFired,
    VariableChanged,
)
from petrobot.coordinator.task import Reference, Status

Plays = Callable[..., Any]
OK, ERR = Status.SUCCESS, Status.ERROR
LINE = {
    "go": {"in": "x", "out": "a", "event": "e"},
    "good": {"in": "a:normal", "out": "b"},
    "bad": {"in": "a:error"},
    "end": {"in": "b:normal", "out": "y"},
}


def test_pause_asks_runs_to_hold_and_resume_releases_them(play: Plays) -> None:
    p = play("x a!=1 b! y", LINE, "e")
    assert p(Pause("look")) == [Paused("look"), HoldRun("a#1")]
    p(RunHeld("a#1", Hold.HELD))
    assert p.state.run("a#1").phase == "held"
    assert ReleaseRun("a#1") in p(Resume()) and p.state.run("a#1").phase == "running"


@pytest.mark.parametrize("answer", [Hold.CANNOT, Hold.STOPPED])
def test_run_that_cannot_hold_is_reported(play: Plays, answer: Hold) -> None:
    p = play("x a!=1 b! y", LINE, "e")
    p(Pause(), RunHeld("a#1", answer))
    assert p.reports == ["not_held"] and p.state.run("a#1").phase == "starting"


def test_paused_nothing_fires_or_starts(play: Plays) -> None:
    p = play("x=1 a!1=2 b! y", LINE, "e")
    p(Pause(), EventOccurred("e"), RunEnded("a#1", OK))
    assert p.fired == [] and p.started == ["a#1"]
    p(Resume())
    assert p.fired == ["good"] and p.started == ["a#1", "a#2", "b#1"]


def test_timers_stop_with_the_pause_and_those_of_a_run_when_it_holds(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "after": 5.0},
        "late": {"in": "a:preempt=none", "after": 3.0},
    }
    p = play("x=1 a!=1 y", net)
    keys = {a.transition: a.key for a in p.of(ArmTimer)}
    assert HoldTimer(keys["t"]) in p(Pause()) and HoldTimer(keys["late"]) not in p.all
    p(RunHeld("a#1", Hold.HELD))
    assert HoldTimer(keys["late"]) in p.all
    released = p(Resume())
    assert {i.key for i in released if isinstance(i, ReleaseTimer)} == set(keys.values())


def test_the_timer_of_a_run_that_cannot_hold_continues_in_a_pause(play: Plays) -> None:
    p = play("a!=1 y", {"late": {"in": "a:preempt=none", "out": "y", "after": 3.0}})
    p(Pause(), RunHeld("a#1", Hold.CANNOT), TimerFired(p.of(ArmTimer)[0].key))
    assert p.fired == []
    p(Resume())
    assert p.fired == ["late"]


def test_step_fires_one_transition(play: Plays) -> None:
    p = play(
        "x=1 y z w",
        {
            "t": {"in": "x", "out": "y", "event": "e"},
            "u": {"in": "y", "out": "z"},
            "v": {"in": "z", "out": "w"},
        },
        "e+",
    )
    p(Pause(), EventOccurred("e"))
    for expected in (["t"], ["t", "u"], ["t", "u", "v"]):
        p(Step())
        assert p.fired == expected and p.state.mode == "paused"


def test_step_starts_the_run_of_its_firing_and_waits_for_the_next_one(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e+")
    p(Pause(), RaiseEvent("e"), Step())
    assert p.started == ["a#1"] and p.state.mode == "paused"
    p(Step())
    assert p.state.mode == "stepping"
    p(RunEnded("a#1", OK))
    assert p.fired == ["go", "good"] and p.state.mode == "paused" and p.started == ["a#1", "b#1"]


def test_step_releases_held_runs_when_nothing_can_fire_yet(play: Plays) -> None:
    p = play("x a!=1 b! y", LINE, "e")
    p(Pause(), RunHeld("a#1", Hold.HELD))
    assert ReleaseRun("a#1") in p(Step())


def test_pulse_of_a_stepped_step_serves_the_rest_of_it_and_no_other(play: Plays) -> None:
    net = {n: {"in": n + "0", "out": n + "1", "event": "e"} for n in ("t", "u")}
    net["v"] = {"in": "t1", "out": "t2", "event": "e"}
    p = play("t0=1 u0=1 t1 u1 t2", net, "e")
    p(Step(), EventOccurred("e"))
    assert p.fired == ["t"] and p.state.mode == "paused"
    p(Step())
    assert p.fired == ["t", "u"]
    p(Resume())
    assert p.fired == ["t", "u"] and p.marked == {"t1": 1, "u1": 1}


def test_breakpoint_before_a_transition_keeps_its_pulse(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e")
    p(SetBreakpoints(("go",)), EventOccurred("e"))
    assert p.fired == [] and p.of(Paused)[0].reason == "breakpoint before go"
    p(Resume())
    assert p.fired == ["go"] and p.started == ["a#1"] and p.state.suspended is None


def test_breakpoint_at_a_place_pauses_before_its_run_starts(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e")
    p(SetBreakpoints(("a",)), EventOccurred("e"))
    assert p.fired == ["go"] and p.started == [] and p.state.mode == "paused"
    p(Resume())
    assert p.started == ["a#1"]


def test_unknown_breakpoint_is_refused_and_the_others_set(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e")
    p(SetBreakpoints(("gone", "good")))
    assert p.reports == ["refused"] and p.state.breakpoints == {"good"}


def test_an_override_is_kept_for_the_primitive_task_until_it_is_given_back(play: Plays) -> None:
    """It also works before the beginning; an unknown task or alternative is refused and changes
    nothing."""
    p = play("x=1 a! b! y", LINE, "e", alternatives={"a": ("do_a", "do_a_slowly")})
    p(Override("a", "do_a_slowly"), Override("a", "do_b"), Override("nothing", "do_a"))
    assert p.state.overrides == {"a": "do_a_slowly"} and p.reports == ["refused", "refused"]
    p(EventOccurred("e"))
    assert p.of(Choose)[0].of == "a", (
        "the choice is still put, so that it is recorded with its reason"
    )
    p(Override("a"))
    assert p.state.overrides == {}


def test_a_net_resumed_in_a_pause_asks_every_run_to_hold_again(play: Plays) -> None:
    """The earlier coordinator may have died before the nodes answered, or before they were
    asked."""
    p = play("x=1 a! b! y", LINE, "e")
    p(EventOccurred("e"), RunStarted("a#1"), Pause("by hand"))
    assert [type(order) for order in p.engine.outstanding(p.state)] == [StartRun, HoldRun]
    p(Resume())
    assert [type(order) for order in p.engine.outstanding(p.state)] == [StartRun]


def test_tokens_can_be_changed_in_control_places_only(play: Plays) -> None:
    p = play("x/2 a! b! y r~", LINE, "e")
    p(AddTokens("x", 2))
    assert p.marked == {"x": 2} and p.of(Marked)[0].before == (0, 0, 0, 0, 0)
    for command in (
        AddTokens("x"),
        AddTokens("a"),
        AddTokens("r"),
        AddTokens("nowhere"),
        AddTokens("x", -1),
        RemoveTokens("x", 3),
    ):
        before = p.state.marking
        p(command)
        assert p.state.marking == before
    assert p.reports == ["refused"] * 6
    p(RemoveTokens("x", 2))
    assert p.marked == {}


def test_added_token_enables_at_once(play: Plays) -> None:
    p = play("x y", {"t": {"in": "x", "out": "y"}})
    p(AddTokens("x"))
    assert p.fired == ["t"]


def test_no_slip_of_the_finger_makes_a_number_that_cannot_be_stored(play: Plays) -> None:
    p = play("x y", {"t": {"in": "x y", "out": "y"}})
    p(AddTokens("x", 10**30))
    assert p.reports == ["refused"] and p.marked == {}


def test_removed_token_forgets_the_latched_event_that_waited_with_it(play: Plays) -> None:
    p = play("x=1 a!=1", {"t": {"in": "x a:normal", "event": "e"}}, "e*")
    p(EventOccurred("e"), RemoveTokens("x"))
    assert not p.state.flags


def test_forced_exit_cancels_counts_none_and_ignores_event_and_condition(play: Plays) -> None:
    net = {"t": {"in": "a:normal r", "out": "y", "event": "e", "when": "ready"}}
    p = play("a!=1 r~=1 y", net, "e", {"ready": False})
    p(ForceExit("t"))
    assert p.marked == {"y": 1} and p.of(CancelRun)[0].counts == "none"
    p(StopConfirmed("a#1", seconds=2.0))
    assert p.of(RunRecorded)[0].status is None and p.of(RunRecorded)[0].seconds == 2.0


def test_forced_exit_of_a_run_that_is_done_cancels_nothing(play: Plays) -> None:
    p = play(
        "a!=1 y", {"t": {"in": "a:error", "out": "y"}, "n": {"in": "a:normal", "event": "e"}}, "e"
    )
    p(RunEnded("a#1", OK), ForceExit("t"))
    assert p.marked == {"y": 1} and p.of(CancelRun) == []


@pytest.mark.parametrize("name", ["u", "v", "w", "nothing"])
def test_forced_exit_is_refused_where_it_makes_no_sense(play: Plays, name: str) -> None:
    net = {
        "u": {"in": "a:normal r"},
        "v": {"in": "x", "event": "e"},
        "w": {"in": "a:error", "out": "f"},
    }
    p = play("a!=1 r~ x=1 f=1/1", net, "e")
    p(ForceExit(name))
    assert p.reports == ["refused"] and p.fired == []


def test_step_and_pause_after_the_end_are_refused(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e", final="x == 1")
    assert p.finished.status is OK
    p(Pause(), Step(), Resume(), Abort())
    assert p.reports == ["finished"] * 4 and p.state.mode == "finished"


def test_step_and_pause_while_an_abort_stops_runs_are_refused(play: Plays) -> None:
    p = play("x a!=1 b! y", LINE, "e")
    p(Abort())
    before = p.state
    p(Pause(), Step(), Resume())
    assert p.reports == ["refused"] * 3 and before.mode == "aborting"
    assert p.state == replace(before, stimuli=p.state.stimuli)


def test_pause_waits_for_an_outstanding_draw_but_abort_does_not(play: Plays) -> None:
    net = {
        "t": {"in": "x", "weight": 1.0, "event": "e"},
        "u": {"in": "x", "weight": 1.0, "event": "e"},
    }
    p = play("x=1", net, "e")
    (choose,) = p(EventOccurred("e"))
    p(Pause())
    assert p.state.mode == "running"
    p(Chosen(choose.key, "t"))
    assert p.fired == ["t"] and p.state.mode == "paused"
    q = play("x=1", net, "e")
    q(EventOccurred("e"), Abort())
    assert q.finished.status is ERR


def test_a_token_of_the_operator_does_not_prevent_the_end(play: Plays) -> None:
    p = play(
        "x=1 a!=1 y",
        {"t": {"in": "a:normal", "out": "y"}, "e": {"in": "a:error"}},
        final="x == 0 and y == 1",
    )
    p(RunEnded("a#1", OK))
    assert not p.finished
    p(RemoveTokens("x"))
    assert p.finished.status is OK


def test_outstanding_orders_are_those_without_an_answer(play: Plays) -> None:
    net = {
        "t": {"in": "a:preempt=none", "event": "e"},
        "late": {"in": "x", "after": 5.0},
        "n": {"in": "b:normal"},
    }
    p = play(
        "a!=1 b!=1 c!=1 x=1",
        net,
        "e",
        alternatives={"c": ("one", "two")},
        args={"b": {"v": Reference("k")}},
        variables={"k": 4},
    )
    begun = [i for i in p.all if isinstance(i, (StartRun, CancelRun, Choose, ArmTimer))]
    assert sorted(map(repr, p.engine.outstanding(p.state))) == sorted(map(repr, begun))
    (_, cancel) = p(EventOccurred("e"))
    p(VariableChanged("k", 5), RunEnded("b#1", OK), Pause())
    left = p.engine.outstanding(p.state)
    kinds = sorted(type(i).__name__ for i in left)
    assert kinds == ["ArmTimer", "CancelRun", "Choose", "HoldTimer"] and cancel in left
    p(StopConfirmed("a#1"), Resume(), TimerFired(p.of(ArmTimer)[0].key), Chosen("c#1", "two"))
    (start,) = p.engine.outstanding(p.state)
    assert start == p.of(StartRun)[-1] and start.action == "two"


def test_outstanding_start_keeps_the_arguments_that_it_had(play: Plays) -> None:
    p = play(
        "b!=1", {"n": {"in": "b:normal"}}, args={"b": {"v": Reference("k")}}, variables={"k": 4}
    )
    p(VariableChanged("k", 5), Pause(), RunHeld("b#1", Hold.HELD))
    assert p.engine.outstanding(p.state) == (p.of(StartRun)[0], HoldRun("b#1")) and p.of(StartRun)[
        0
    ].arguments == {"v": 4}


def test_outstanding_draw(play: Plays) -> None:
    net = {n: {"in": "x", "weight": 1.0, "event": "e"} for n in ("t", "u")}
    p = play("x=1", net, "e")
    (choose,) = p(EventOccurred("e"))
    assert p.engine.outstanding(p.state) == (choose,)


def test_only_awaited_events_are_worth_a_stimulus(play: Plays) -> None:
    p = play("x=1 a! b! y", LINE, "e f")
    assert p.engine.awaits(p.state, "e") and not p.engine.awaits(p.state, "f")
    p(EventOccurred("e"))
    assert not p.engine.awaits(p.state, "e")


def test_a_kept_event_is_worth_a_stimulus_until_its_flag_is_set(play: Plays) -> None:
    """Timers of a node do not number their events: what is not passed on is lost."""
    p = play("x=1 a! b! y", LINE, "e f+")
    assert p.engine.awaits(p.state, "f")
    p(EventOccurred("f"))
    assert "f" in p.state.flags and not p.engine.awaits(p.state, "f")
