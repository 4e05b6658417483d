"""Race conditions: two messages that cross, in either order. Each case has one right outcome, and
no token is lost or doubled.

If another coordination system had a bug in such a case, the test names its issue;
tests/run/test_named_races.py has all of them with a node.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from petrobot.coordinator.engine import (
    Abort,
    CancelRun,
    Chosen,
    EventOccurred,
    Hold,
    Mode,
    Pause,
    Phase,
    Resume,
    RunEnded,
    RunHeld,
    RunRaised,
    RunRecorded,
    RunStarted,
    StopConfirmed,
    StopFailed,
    TimerFired,
)
from petrobot.coordinator.task import Executed, Status

Plays = Callable[..., Any]
OK, FAIL, ERR = Status.SUCCESS, Status.FAILURE, Status.ERROR
CATCH = {
    "caught": {"in": "a:preempt=success", "out": "h", "event": "ball"},
    "missed": {"in": "a:normal", "out": "h"},
    "broken": {"in": "a:error", "out": "r"},
    "home": {"in": "h:normal", "out": "done"},
    "lost": {"in": "h:error", "out": "r"},
}
ARM = {"do_a": "arm", "do_h": "arm"}


def test_completion_crosses_with_cancel_recorded_and_moves_nothing(play: Plays) -> None:
    """A result after the cancel must not end anything a second time (SMACH #98: it gave the
    outcome)."""
    p = play(
        "a!=1 h! r done",
        CATCH,
        "ball*",
        devices=ARM,
        out={"a": {"v": "point"}},
        variables={"point": 0},
    )
    p(EventOccurred("ball"))
    assert p.started == ["a#1"]
    p(RunEnded("a#1", FAIL, "passed", values={"v": 9}, seconds=1.5))
    (record,) = p.of(RunRecorded)
    assert (record.status, record.cancelled, record.seconds) == (
        OK,
        True,
        1.5,
    ) and "failure" in record.text
    assert p.state.variables["point"] == 0 and p.fired == ["caught"] and p.started == ["a#1", "h#1"]
    p(StopConfirmed("a#1"), RunEnded("a#1", ERR))
    assert p.fired == ["caught"] and p.reports == ["unknown_run", "unknown_run"]


def test_cancel_crosses_with_completion_the_event_comes_too_late(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*", devices=ARM)
    p(RunEnded("a#1", FAIL), EventOccurred("ball"))
    assert p.fired == ["missed"] and p.of(CancelRun) == [] and p.reports == ["early_event"]


def test_event_before_arming_is_forgotten(play: Plays) -> None:
    """The ball falling out of the cup at home must not count for the next run."""
    p = play(
        "x=1 a! h! r done", {**CATCH, "go": {"in": "x", "out": "a", "event": "tick"}}, "ball* tick"
    )
    p(EventOccurred("ball"), EventOccurred("tick"))
    assert p.marked == {"a": 1} and p.reports == ["early_event"]


def test_event_before_arming_is_kept_where_that_is_declared(play: Plays) -> None:
    p = play(
        "x=1 a! h! r done", {**CATCH, "go": {"in": "x", "out": "a", "event": "tick"}}, "ball+ tick"
    )
    p(EventOccurred("ball"), EventOccurred("tick"))
    assert p.marked == {"h": 1} and p.started == ["h#1"], (
        "a run that is preempted before it starts never starts"
    )


def test_preempt_and_normal_end_pending_together_normal_end_first(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(Pause(), EventOccurred("ball"), RunEnded("a#1", FAIL))
    assert p.fired == [] and p.state.flags == {"ball"}
    p(Resume())
    assert p.fired == ["missed"] and p.of(CancelRun) == []


def test_preempt_and_normal_end_pending_together_preempt_first_where_declared(play: Plays) -> None:
    net = {**CATCH, "caught": {**CATCH["caught"], "priority": 1}}
    p = play("a!=1 h! r done", net, "ball*")
    p(Pause(), EventOccurred("ball"), RunEnded("a#1", FAIL), Resume())
    assert p.fired == ["caught"] and p.of(CancelRun) == [] and p.of(RunRecorded)[0].status is FAIL


def test_error_end_and_preempt_pending_together(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(Pause(), EventOccurred("ball"), RunEnded("a#1", ERR), Resume())
    assert p.fired == ["broken"]


def test_nothing_uses_a_device_before_the_cancelled_run_has_stopped(play: Plays) -> None:
    """PlanSys2 #400: two performers for one token."""
    p = play("a!=1 h! r done", CATCH, "ball*", devices=ARM)
    p(EventOccurred("ball"))
    assert (
        p.marked == {"h": 1} and p.started == ["a#1"] and p.state.run("h#1").phase is Phase.WAITING
    )
    p(StopConfirmed("a#1"))
    assert p.started == ["a#1", "h#1"]


def test_start_at_once_does_not_wait(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*", devices=ARM, at_once=("h",))
    p(EventOccurred("ball"))
    assert p.started == ["a#1", "h#1"]


def test_run_that_cannot_be_stopped_keeps_its_fence_and_the_next_one_errs_without_executing(
    play: Plays,
) -> None:
    """PlanSys2 #399: a performer that never answers."""
    p = play("a!=1 h! r done", CATCH, "ball*", devices=ARM)
    p(EventOccurred("ball"), StopFailed("a#1", "no answer for 2 s"))
    assert p.fired == ["caught", "lost"] and p.started == ["a#1"]
    (record,) = p.of(RunRecorded)
    assert (record.run, record.status, record.cause, record.executed) == (
        "h#1",
        ERR,
        "device_fenced",
        Executed.NO,
    )
    assert p.state.run("a#1").phase is Phase.STUCK
    p(StopConfirmed("a#1"))
    assert not p.state.stopping


def test_device_fenced_for_good_refuses_later_runs_too(play: Plays) -> None:
    net = {**CATCH, "again": {"in": "r", "out": "h", "event": "retry"}}
    p = play("a!=1 h! r done", net, "ball* retry", devices=ARM)
    p(EventOccurred("ball"), StopFailed("a#1"), EventOccurred("retry"))
    assert p.fired == ["caught", "lost", "again", "lost"] and p.started == ["a#1"]
    p(StopConfirmed("a#1"), EventOccurred("retry"))
    assert p.started == ["a#1", "h#3"]


def test_cancel_crosses_with_accept(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*", devices=ARM)
    p(EventOccurred("ball"), RunStarted("a#1"))
    assert p.state.run("a#1").phase is Phase.STOPPING
    p(StopConfirmed("a#1", Executed.NO))
    assert p.of(RunRecorded)[0].status is None, (
        "a run that never executed says nothing about reliability"
    )


def test_cancel_before_the_choice_is_made(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*", alternatives={"a": ("one", "two")})
    p(EventOccurred("ball"))
    assert p.of(CancelRun) == [] and p.started == ["h#1"]
    p(Chosen("a#1", "one"))
    assert p.started == ["h#1"] and p.reports == ["no_choice"]


def test_inhibitor_counts_a_stopping_run_as_still_there(play: Plays) -> None:
    p = play(
        "a!=1 x=1 y",
        {"t": {"in": "a:preempt=none", "event": "e"}, "u": {"in": "x !a", "out": "y"}},
        "e",
    )
    p(EventOccurred("e"))
    assert p.fired == ["t"] and p.marked == {"x": 1}
    p(StopConfirmed("a#1"))
    assert p.fired == ["t", "u"]


def test_capacity_counts_a_stopping_run_as_still_there(play: Plays) -> None:
    p = play(
        "a!=1/1 x=1",
        {"t": {"in": "a:preempt=none", "event": "e"}, "u": {"in": "x", "out": "a"}},
        "e",
    )
    p(EventOccurred("e"))
    assert p.fired == ["t"]
    p(StopConfirmed("a#1"))
    assert p.fired == ["t", "u"] and p.started == ["a#1", "a#2"]


def test_server_is_not_free_before_the_cancelled_run_has_stopped(play: Plays) -> None:
    p = play("a!1=2", {"t": {"in": "a:preempt=none", "event": "e"}}, "e")
    p(EventOccurred("e"))
    assert p.started == ["a#1"] and [r.id for r in p.state.tokens["a"]] == ["a#2"]
    p(StopConfirmed("a#1"))
    assert p.started == ["a#1", "a#2"]


def test_restart_of_a_place_by_its_own_preemption(play: Plays) -> None:
    p = play(
        "a!=1",
        {"t": {"in": "a:preempt=none", "out": "a", "event": "e"}},
        "e",
        devices={"do_a": "arm"},
    )
    p(EventOccurred("e"))
    assert p.marked == {"a": 1} and p.started == ["a#1"]
    p(StopConfirmed("a#1"))
    assert p.started == ["a#1", "a#2"]


def test_timer_fires_after_the_run_has_ended(play: Plays) -> None:
    p = play(
        "a!=1 y z",
        {
            "t": {"in": "a:normal", "out": "y"},
            "late": {"in": "a:preempt=failure", "out": "z", "after": 5.0},
        },
    )
    key = p.state.timers["late"].key
    p(RunEnded("a#1", OK), TimerFired(key))
    assert p.fired == ["t"] and p.marked == {"y": 1}


def test_raised_event_of_a_run_that_is_stopping_is_dropped(play: Plays) -> None:
    net = {
        "t": {"in": "a:preempt=none", "out": "a", "event": "e"},
        "u": {"in": "a:going x", "event": "seen"},
    }
    p = play("a!=1 x=1", net, "e seen<a")
    p(EventOccurred("e"), RunRaised("a#1", "seen"))
    assert p.fired == ["t"] and p.reports == ["unknown_run"]


def test_result_comes_twice(play: Plays) -> None:
    """SMACH #98: a second result must not move a second token."""
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(RunEnded("a#1", OK), RunEnded("a#1", OK))
    assert p.fired == ["missed"] and p.marked == {"h": 1} and p.reports == ["unknown_run"]


def test_hold_answer_comes_after_resume(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(Pause(), Resume(), RunHeld("a#1", Hold.HELD))
    assert p.state.run("a#1").phase is not Phase.HELD


def test_run_ends_while_paused(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(Pause(), RunEnded("a#1", OK))
    assert p.fired == [] and p.marked == {"a": 1}
    p(Resume())
    assert p.fired == ["missed"]


@pytest.mark.parametrize("last", [StopConfirmed("a#1"), RunEnded("a#1", OK)])
def test_abort_ends_when_every_run_has_stopped(play: Plays, last: Any) -> None:
    p = play("a!=1 h!=1 r done", CATCH, "ball*")
    p(Abort("fire"))
    assert p.state.mode is Mode.ABORTING and sorted(c.run for c in p.of(CancelRun)) == [
        "a#1",
        "h#1",
    ]
    p(StopConfirmed("h#1"))
    assert not p.finished
    p(last)
    assert p.finished.status is ERR and p.finished.reason == "aborted: fire" and p.fired == []


def test_abort_with_a_run_that_cannot_be_stopped_says_so(play: Plays) -> None:
    p = play("a!=1 h! r done", CATCH, "ball*")
    p(Abort(), StopFailed("a#1"))
    assert p.finished.status is ERR and "a#1 could not be stopped" in p.finished.reason
