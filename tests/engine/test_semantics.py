"""The semantics: branches, events, conditions, timers, servers, results, the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from petrobot.coordinator.engine import (
    ArmTimer,
    Begin,
    Choose,
    Chosen,
    Corrected,
    DisarmTimer,
    EventOccurred,
    Finished,
    Fired,
    Policy,
    RunEnded,
    RunRaised,
    RunRecorded,
    StartRun,
    TimerFired,
    VariableChanged,
    Verdict,
)
from petrobot.coordinator.engine.step import RECORDED
from petrobot.coordinator.task import Executed, Reference, Status, Task
from petrobot.coordinator.task.conditions import parse
from tests.effort import calls

Plays = Callable[..., Any]
OK, FAIL, ERR = Status.SUCCESS, Status.FAILURE, Status.ERROR
BRANCHES = {"good": {"in": "a:normal", "out": "done"}, "bad": {"in": "a:error", "out": "broken"}}


@pytest.mark.parametrize(("status", "place"), [(OK, "done"), (FAIL, "done"), (ERR, "broken")])
def test_success_and_failure_leave_by_the_normal_branch(
    play: Plays, status: Status, place: str
) -> None:
    p = play("a!=1 done broken", BRANCHES)
    assert p.started == ["a#1"] and p.marked == {"a": 1}
    p(RunEnded("a#1", status))
    assert p.marked == {place: 1}


def test_start_carries_task_deadline_and_arguments_as_they_are_then(play: Plays) -> None:
    args = {"a": {"speed": 0.5, "where": Reference("point")}}
    p = play("x=1 a!", {"t": {"in": "x", "out": "a", "event": "e"}}, "e", {"point": 1}, args=args)
    p(VariableChanged("point", 7), EventOccurred("e"))
    (start,) = p.of(StartRun)
    assert (start.primitive_task, start.action, start.deadline) == ("a", "do_a", 10.0)
    assert start.arguments == {"speed": 0.5, "where": 7}


def test_end_is_latched_so_that_a_join_waits_for_it(play: Plays) -> None:
    p = play("a!=1 b!=1 done", {"join": {"in": "a:normal b:normal", "out": "done"}})
    p(RunEnded("a#1", OK))
    assert p.fired == [] and p.marked == {"a": 1, "b": 1}
    p(RunEnded("b#1", FAIL))
    assert p.fired == ["join"] and p.marked == {"done": 1}


def test_a_pulse_serves_ready_transitions_and_disappears(play: Plays) -> None:
    net = {"t": {"in": "x", "out": "y", "event": "tick"}, "u": {"in": "a:normal", "out": "x"}}
    p = play("x a!=1 y", net, events="tick")
    p(EventOccurred("tick"), RunEnded("a#1", OK))
    assert p.marked == {"x": 1}
    p(EventOccurred("tick"))
    assert p.marked == {"y": 1}


def test_pulse_is_broadcast_and_fires_each_transition_once(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "z", "event": "tick"},
        "u": {"in": "y", "out": "z", "event": "tick"},
    }
    p = play("x=2 y=1 z", net, events="tick")
    p(EventOccurred("tick"))
    assert sorted(p.fired) == ["t", "u"] and p.marked == {"x": 1, "z": 2}


def test_a_pulse_does_not_serve_transitions_that_its_firing_enables(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "tick"},
        "u": {"in": "y", "out": "z", "event": "tick"},
    }
    p = play("x=1 y z", net, events="tick")
    p(EventOccurred("tick"))
    assert p.marked == {"y": 1}


def test_latched_event_waits_for_the_run_to_end_and_is_consumed_once(play: Plays) -> None:
    net = {
        "t": {"in": "a:normal", "out": "b", "event": "go"},
        "u": {"in": "b:normal", "out": "done", "event": "go"},
    }
    p = play("a!=1 b! done", net, events="go*")
    p(EventOccurred("go"), EventOccurred("go"))
    assert p.state.flags == {"go"}
    p(RunEnded("a#1", OK), RunEnded("b#1", OK))
    assert p.fired == ["t"] and not p.state.flags
    p(EventOccurred("go"))
    assert p.marked == {"done": 1}


def test_latched_event_is_forgotten_with_the_tokens_that_waited_for_it(play: Plays) -> None:
    net = {
        "t": {"in": "a:normal", "event": "go"},
        "off": {"in": "a:error", "out": "b"},
        "again": {"in": "b", "out": "a", "event": "retry"},
    }
    p = play("a!=1 b", net, events="go* retry")
    p(EventOccurred("go"), RunEnded("a#1", ERR))
    assert not p.state.flags
    p(EventOccurred("retry"), RunEnded("a#2", OK))
    assert p.fired == ["off", "again"]


def test_latched_event_does_not_outlive_a_token_that_comes_back_in_the_same_firing(
    play: Plays,
) -> None:
    net = {"t": {"in": "a:normal", "event": "go"}, "retry": {"in": "a:error", "out": "a"}}
    p = play("a!=1", net, events="go*")
    p(EventOccurred("go"), RunEnded("a#1", ERR))
    assert p.marked == {"a": 1} and not p.state.flags


def test_duplicate_numbered_event_is_taken_once(play: Plays) -> None:
    p = play("x=3 y", {"t": {"in": "x", "out": "y", "event": "go"}}, events="go*")
    p(
        EventOccurred("go", "gate", 1),
        EventOccurred("go", "gate", 1),
        EventOccurred("go", "gate", 2),
    )
    assert p.marked == {"x": 1, "y": 2}


def test_internal_event_is_latched_to_its_run(play: Plays) -> None:
    net = {
        "t": {"in": "a:going x", "out": "y", "event": "seen"},
        "u": {"in": "a:normal", "out": "a"},
    }
    p = play("a!=1 x=2 y", net, events="seen<a")
    p(RunRaised("a#1", "seen"))
    assert p.marked == {"a": 1, "x": 1, "y": 1} and p.started == ["a#1"]
    p(RunEnded("a#1", OK))
    assert p.started == ["a#1", "a#2"] and p.fired == ["t", "u"]
    p(RunRaised("a#1", "seen"))
    assert p.fired == ["t", "u"] and p.reports == ["unknown_run"]


def test_internal_event_of_another_primitive_task_is_refused(play: Plays) -> None:
    p = play("a!=1 b!=1", {"t": {"in": "a:preempt=none", "event": "seen"}}, events="seen<a")
    p(RunRaised("b#1", "seen"))
    assert p.reports == ["unknown_event"] and p.fired == []


def test_preempt_cancels_and_counts(play: Plays) -> None:
    p = play(
        "a!=1 done", {"t": {"in": "a:preempt=success", "out": "done", "event": "go"}}, events="go"
    )
    (fired, cancel) = p(EventOccurred("go"))
    assert fired.runs == ("a#1",) and (cancel.run, cancel.counts) == ("a#1", "success")
    assert p.marked == {"done": 1} and set(p.state.stopping) == {"a#1"}


SEEN = {
    "left": {"in": "a:normal", "out": "l", "when": "seen"},
    "right": {"in": "a:normal", "out": "r", "when": "not seen"},
}


@pytest.mark.parametrize(("value", "place"), [(True, "l"), (False, "r")])
def test_results_are_written_before_the_end_is_judged(play: Plays, value: bool, place: str) -> None:
    p = play("a!=1 l r", SEEN, variables={"seen": not value}, out={"a": {"mark": "seen"}})
    p(RunEnded("a#1", OK, values={"mark": value, "other": 3}))
    assert p.marked == {place: 1}


@pytest.mark.parametrize("values", [{"mark": "yes"}, {}], ids=["wrong kind", "missing"])
def test_value_that_does_not_fit_leaves_none_and_no_branch_sees_the_old_one(
    play: Plays, values: dict[str, Any]
) -> None:
    p = play("a!=1 l r", SEEN, variables={"seen": True}, out={"a": {"mark": "seen"}})
    p(RunEnded("a#1", OK, values=values))
    assert p.marked == {"a": 1} and p.state.variables["seen"] is None
    assert p.reports[0] == "bad_value" and "nowhere_to_go" in p.reports
    p(VariableChanged("seen", False))
    assert p.marked == {"r": 1}


def test_value_that_is_not_listed_leaves_none(play: Plays) -> None:
    p = play("a!=1 l", {"t": {"in": "a:normal", "out": "l", "when": "side == 'left'"}},
             variables={"side": "left"}, values={"side": ("left", "right")},
             out={"a": {"code": "side"}})  # fmt: skip
    p(RunEnded("a#1", OK, values={"code": "middle"}))
    assert p.marked == {"a": 1} and p.reports[:2] == ["bad_value", "nowhere_to_go"]
    assert p.state.variables["side"] is None
    p(VariableChanged("side", "above"))
    assert p.reports.count("bad_value") == 2 and p.state.variables["side"] is None


def test_older_journals_take_values_that_are_not_listed(play: Plays) -> None:
    p = play("a!=1 l", {"t": {"in": "a:normal", "out": "l"}}, policy=RECORDED[4],
             variables={"side": "left"}, values={"side": ("left", "right")},
             out={"a": {"code": "side"}})  # fmt: skip
    p(RunEnded("a#1", OK, values={"code": "middle"}))
    assert p.state.variables["side"] == "middle" and "bad_value" not in p.reports


def test_reason_and_status_are_variables(play: Plays) -> None:
    net = {
        "lost": {"in": "a:error", "out": "l", "when": "a.reason == 'lost'"},
        "else": {"in": "a:error", "out": "r", "when": "a.reason != 'lost'"},
        "weak": {"in": "a:normal", "out": "w", "when": "a.status == 'failure'"},
        "fine": {"in": "a:normal", "out": "f", "when": "a.status == 'success'"},
    }
    for end, place in [
        ((ERR, "lost"), "l"),
        ((ERR, "cold"), "r"),
        ((FAIL, ""), "w"),
        ((OK, ""), "f"),
    ]:
        p = play("a!=1 l r w f", net)
        p(RunEnded("a#1", end[0], end[1]))
        assert p.marked == {place: 1}


def test_condition_on_status_takes_the_run_that_satisfies_it(play: Plays) -> None:
    net = {
        "fine": {"in": "a:normal go", "out": "f", "when": "a.status == 'success'"},
        "open": {"in": "shut", "out": "go", "event": "e"},
    }
    p = play("a!2=2 shut=1 go f", net, "e")
    p(RunEnded("a#1", FAIL), RunEnded("a#2", OK), EventOccurred("e"))
    assert p.fired == ["open", "fine"] and [r.id for r in p.state.tokens["a"]] == ["a#1"]


def test_nowhere_to_go_is_reported_once(play: Plays) -> None:
    p = play(
        "a!=1 x=1 y",
        {"t": {"in": "a:normal", "when": "seen"}, "u": {"in": "x", "out": "y", "event": "e"}},
        events="e",
        variables={"seen": False},
    )
    p(RunEnded("a#1", OK))
    p(EventOccurred("e"))
    assert p.reports.count("nowhere_to_go") == 1
    p(VariableChanged("seen", True))
    assert p.fired == ["u", "t"]


def test_unwritten_name_makes_a_condition_false_and_is_reported(play: Plays) -> None:
    p = play("x=1", {"t": {"in": "x", "when": "level > 1"}}, variables={"level": 2}, begin=False)
    p(Begin(variables={"level": None}))
    assert p.fired == [] and p.reports == ["condition"]
    p(VariableChanged("level", 5))
    assert p.fired == ["t"]


def test_after_timer_is_armed_fires_and_is_disarmed(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "late": {"in": "x", "out": "z", "after": 2.5},
    }
    p = play("x=2 y z", net, events="e")
    (arm,) = p.of(ArmTimer)
    assert (arm.transition, arm.seconds) == ("late", 2.5)
    p(EventOccurred("e"))
    assert p.marked == {"x": 1, "y": 1} and p.of(DisarmTimer) == []
    p(TimerFired(arm.key))
    assert p.marked == {"y": 1, "z": 1}
    p(TimerFired(arm.key))
    assert p.fired == ["t", "late"]


def test_after_timer_starts_again_for_another_run(play: Plays) -> None:
    net = {
        "retry": {"in": "a:error", "out": "a"},
        "long": {"in": "a:preempt=failure", "out": "z", "after": 9.0},
    }
    p = play("a!=1 z", net)
    p(RunEnded("a#1", ERR))
    first, second = p.of(ArmTimer)
    assert first.key != second.key and [d.key for d in p.of(DisarmTimer)] == [first.key]
    p(TimerFired(first.key))
    assert p.fired == ["retry"]
    p(TimerFired(second.key))
    assert p.fired == ["retry", "long"] and p.marked == {"z": 1}


def test_timer_starts_again_after_its_own_firing(play: Plays) -> None:
    p = play("x=2 y", {"late": {"in": "x", "out": "y", "after": 2.0}})
    p(TimerFired(p.of(ArmTimer)[0].key))
    assert p.fired == ["late"] and len(p.of(ArmTimer)) == 2
    p(TimerFired(p.of(ArmTimer)[1].key))
    assert p.fired == ["late", "late"]


def test_timer_starts_again_when_a_firing_takes_its_token_and_gives_it_back(play: Plays) -> None:
    """Between taking and giving the token, the transition is not enabled, even if no time
    passes."""
    net = {
        "t": {"in": "x", "out": "x", "event": "e"},
        "late": {"in": "x", "out": "z", "after": 9.0},
        "other": {"in": "y", "out": "z", "after": 9.0},
    }
    p = play("x=1 y=1 z", net, events="e")
    late, other = p.of(ArmTimer)
    p(EventOccurred("e"))
    assert p.fired == ["t"] and [d.key for d in p.of(DisarmTimer)] == [late.key]
    again = p.of(ArmTimer)[2]
    assert again.transition == "late" and again.key != late.key
    p(TimerFired(late.key))
    assert p.fired == ["t"], "the timer of the former token counts no more"
    p(TimerFired(other.key))
    assert p.fired == ["t", "other"], "a timer whose token was not touched runs on"
    p(TimerFired(again.key))
    assert p.fired == ["t", "other", "late"]


def test_timer_belongs_to_the_run_that_it_would_take(play: Plays) -> None:
    net = {"t": {"in": "a:normal"}, "long": {"in": "a:preempt=failure", "out": "z", "after": 9.0}}
    p = play("a!2=2 z", net)
    p(RunEnded("a#1", OK))
    first, second = p.of(ArmTimer)
    p(TimerFired(first.key))
    assert p.fired == ["t"]
    p(TimerFired(second.key))
    assert p.fired == ["t", "long"]


def test_elapsed_timer_waits_for_its_condition(play: Plays) -> None:
    p = play(
        "x=1 y",
        {"t": {"in": "x", "out": "y", "after": 1.0, "when": "ready"}},
        variables={"ready": False},
    )
    p(TimerFired(p.of(ArmTimer)[0].key))
    assert p.fired == []
    p(VariableChanged("ready", True))
    assert p.fired == ["t"]


def test_servers_run_at_once_and_the_rest_queue_first_in_first_out(play: Plays) -> None:
    p = play("a!2=4 done", {"t": {"in": "a:normal", "out": "done"}, "e": {"in": "a:error"}})
    assert p.started == ["a#1", "a#2"]
    p(RunEnded("a#2", OK))
    assert p.started == ["a#1", "a#2", "a#3"] and p.marked == {"a": 3, "done": 1}
    p(RunEnded("a#1", ERR), RunEnded("a#3", OK))
    assert p.started[-1] == "a#4" and p.reports == []


def test_a_long_queue_costs_in_proportion_to_its_length(play: Plays) -> None:
    def effort(tokens: int) -> int:
        p = play(f"a!1={tokens} x", {"t": {"in": "a:normal", "out": "x"}})
        called = calls(lambda: p(RunEnded("a#1", OK)))
        assert p.started == ["a#1", "a#2"]
        return called

    # The runs of the place were counted for each token that waits: 4 times as many.
    assert effort(400) < 3 * effort(200)


def test_first_done_is_first_taken(play: Plays) -> None:
    p = play(
        "a!2=2 shut=1 go",
        {"t": {"in": "a:normal go"}, "open": {"in": "shut", "out": "go", "event": "e"}},
        "e",
    )
    p(RunEnded("a#2", OK), RunEnded("a#1", OK), EventOccurred("e"))
    assert p.of(Fired)[-1].runs == ("a#2",)


def test_second_token_in_a_one_safe_place_is_reported_and_waits(play: Plays) -> None:
    p = play(
        "x=2 a!", {"t": {"in": "x", "out": "a"}, "n": {"in": "a:normal"}, "e": {"in": "a:error"}}
    )
    assert p.reports == ["unsafe"] and p.started == ["a#1"]
    p(RunEnded("a#1", OK))
    assert p.started == ["a#1", "a#2"]


def test_alternatives_are_chosen_when_a_server_is_free(play: Plays) -> None:
    p = play("a!1=2", {"n": {"in": "a:normal"}}, alternatives={"a": ("slow", "fast")})
    (choose,) = p.of(Choose)
    assert (choose.key, choose.of, choose.alternatives) == (
        "a#1",
        "a",
        ("slow", "fast"),
    ) and p.started == []
    p(Chosen("a#1", "fast", "lowest J"))
    assert p.of(StartRun)[0].action == "fast"
    p(RunEnded("a#1", OK))
    assert p.of(Choose)[1].key == "a#2"
    p(Chosen("a#2", "slow"), Chosen("a#2", "slow"))
    assert [s.action for s in p.of(StartRun)] == ["fast", "slow"] and p.reports == ["no_choice"]


def test_deferred_verdict_corrects_once_and_moves_nothing(play: Plays) -> None:
    p = play("a!=1 done broken", BRANCHES)
    p(RunEnded("a#1", OK, deferred=True))
    assert p.of(RunRecorded)[0].deferred and p.marked == {"done": 1}
    p(Verdict("a#1", FAIL, "slipped"), Verdict("a#1", OK))
    (corrected,) = p.of(Corrected)
    assert (corrected.was, corrected.status, corrected.cause) == (OK, FAIL, "slipped")
    assert p.marked == {"done": 1} and p.reports == ["no_verdict_due"]


def test_a_verdict_may_come_before_the_end_of_its_run(play: Plays) -> None:
    """The run's node and the judge's node have different links, so the verdict may come first. It
    is kept until the run ends, and counts once."""
    p = play("a!=1 done broken", BRANCHES)
    p(Verdict("a#1", FAIL, "slipped", "seen from above"), Verdict("a#1", OK))
    assert p.of(Corrected) == [] and p.reports == ["no_verdict_due"]
    p(RunEnded("a#1", OK, deferred=True), Verdict("a#1", OK))
    (corrected,) = p.of(Corrected)
    assert (corrected.was, corrected.status, corrected.cause, corrected.text) == (
        OK,
        FAIL,
        "slipped",
        "seen from above",
    )
    assert p.marked == {"done": 1} and p.reports == ["no_verdict_due"] * 2


def test_a_verdict_on_a_final_result_changes_nothing(play: Plays) -> None:
    p = play("a!=1 done broken", BRANCHES)
    p(Verdict("a#1", FAIL), RunEnded("a#1", OK), Verdict("a#1", FAIL), Verdict("b#7", OK))
    assert p.of(Corrected) == [] and p.reports == ["no_verdict_due"] * 3


def test_a_verdict_that_agrees_keeps_the_cause(play: Plays) -> None:
    p = play("a!=1 done broken", BRANCHES)
    p(RunEnded("a#1", FAIL, "loose", deferred=True), Verdict("a#1", FAIL))
    (corrected,) = p.of(Corrected)
    assert (corrected.was, corrected.status, corrected.cause) == (FAIL, FAIL, "loose")


def test_records_for_the_estimates(play: Plays) -> None:
    p = play("a!=1 done broken", BRANCHES)
    p(RunEnded("a#1", ERR, "no_node", "unreachable", Executed.NO, seconds=0.1))
    (record,) = p.of(RunRecorded)
    assert (record.primitive_task, record.action, record.status, record.executed) == (
        "a",
        "do_a",
        ERR,
        Executed.NO,
    )


@pytest.mark.parametrize(
    ("end", "status", "words"),
    [(OK, OK, "final"), (ERR, ERR, "given up")],
    ids=["designed", "honest"],
)
def test_the_end(
    task: Callable[..., Task], play: Plays, end: Status, status: Status, words: str
) -> None:
    p = play("a!=1 done broken", BRANCHES, final="done == 1", final_error=parse("broken == 1"))
    p(RunEnded("a#1", end))
    assert p.finished is not None and p.finished.status is status and words in p.finished.reason
    p(EventOccurred("nothing"))
    assert p.reports == ["finished"]


def test_dead_marking_ends_in_error(play: Plays) -> None:
    p = play(
        "a!=1 x", {"t": {"in": "a:normal", "out": "x"}, "u": {"in": "a:error"}}, policy=Policy()
    )
    p(RunEnded("a#1", OK))
    assert (
        isinstance(p.finished, Finished)
        and p.finished.status is ERR
        and "no transition" in p.finished.reason
    )


def test_nothing_happens_before_begin(play: Plays) -> None:
    p = play("x=1 y", {"t": {"in": "x", "out": "y"}}, begin=False)
    p(EventOccurred("e"))
    assert p.reports == ["not_begun"] and p.fired == []
    p(Begin(), Begin())
    assert p.fired == ["t"] and p.reports == ["not_begun", "begun"]


def test_parameters_are_taken_and_wrong_ones_reported(play: Plays) -> None:
    p = play(
        "x=1 y",
        {"t": {"in": "x", "out": "y", "when": "regime == 'B'"}},
        parameters={"regime": "A"},
        begin=False,
    )
    p(Begin({"regime": "B", "colour": "red"}))
    assert p.fired == ["t"] and p.reports == ["bad_parameter"]
