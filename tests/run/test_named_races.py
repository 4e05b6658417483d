"""Race conditions reported for other coordination systems, replayed with our executor and a node
whose messages the test writes.

ros/executive_smach issues 53 and 98, uleroboticsgroup/yasmin issues 62 and 102,
PlanSys2/ros2_planning_system pull requests 399 and 400.
"""

from __future__ import annotations

import pytest

from petrobot.coordinator.engine import Abort, Begin, CancelRun, RunRecorded
from petrobot.coordinator.run.calls import ESCALATION, STOP_MARGIN
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.protocol import messages as m
from tests.run.toy_arm import TIDY, WORK, Bench

STOPPED = "preempted by rung"


@pytest.mark.parametrize("end_first", [True, False])
def test_smach_53_a_preemption_at_the_end_is_either_executed_or_reported(
    end_first: bool,
) -> None:
    """There, a request that arrived as the children completed was counted as served, but was not.

    Here the order of arrival decides: the event preempts the run, or finds the run ended and is
    reported as early.
    """
    bench = Bench().begin()
    both: list[m.Message] = [m.Outcome(WORK, "success"), m.Event("bell", "desk", 1)]
    bench.say(1.0, *(both if end_first else both[::-1]))
    assert bench.fired == ["go", "worked" if end_first else "rung"]
    assert bench.reports == (["early_event"] if end_first else [])
    assert bench.calls() == [TIDY] and len(bench.records) == 1


@pytest.mark.parametrize("own", ["success", "failure", "error"])
def test_smach_98_a_preempted_run_counts_as_its_arc_declares_not_as_its_result(
    own: str,
) -> None:
    """There, a container that was already ending returned its own outcome, and the state machine
    took the wrong transition."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.say(1.1, m.Outcome(WORK, own))
    (record,) = bench.records
    assert (record.status, record.cancelled) == (Status.SUCCESS, True) and own in record.text
    assert bench.fired == ["go", "rung"], "the preempting branch, and no other"


@pytest.mark.parametrize("accepted", [True, False])
def test_yasmin_62_a_cancel_straight_after_the_start_reaches_the_run(accepted: bool) -> None:
    """There, the machine ran, its current state was still empty, and the cancel reached no
    state."""
    bench = Bench()
    bench.link(0.0)
    bench.executor.stimulate(0.0, Begin())
    bench.ring(0.0)
    assert bench.sent(m.Call, m.Cancel)[-1] == m.Cancel(WORK, STOPPED), (
        "behind its CALL, so that it cannot overtake it"
    )
    if accepted:
        bench.say(0.1, m.Accept(WORK))
    bench.say(
        0.2,
        m.Outcome(
            WORK, "error", {}, "cancelled", "", m.Executed.YES if accepted else m.Executed.NO
        ),
    )
    (record,) = bench.records
    assert record.status is (Status.SUCCESS if accepted else None), (
        "what never began says nothing about reliability"
    )
    assert bench.calls() == [TIDY]


def test_yasmin_62_a_run_cancelled_before_it_could_be_sent_is_never_sent() -> None:
    """Its node is away: the call is not sent, not even when the node is back."""
    bench = Bench()
    bench.caller.connecting(0.0)
    bench.executor.stimulate(0.0, Begin())
    bench.ring(0.1)
    bench.go(0.2)
    assert (bench.records[0].run, bench.records[0].executed) == ("work#1", Executed.NO)
    bench.link(0.5)
    assert bench.calls() == [TIDY]


def test_yasmin_102_a_second_cancel_stops_what_came_after_the_first() -> None:
    """There, the first cancel set a flag, and later cancels were ignored while the machine ran its
    next states."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.say(1.1, m.Outcome(WORK, "error", {}, "cancelled"))
    bench.say(1.2, m.Accept(TIDY))
    assert bench.sent(m.Cancel) == [m.Cancel(WORK, STOPPED)]
    bench.executor.stimulate(1.3, Abort("by hand"))
    assert bench.sent(m.Cancel) == [m.Cancel(TIDY, "aborted: by hand")] and len(bench.records) == 1
    bench.say(1.4, m.Outcome(TIDY, "error", {}, "cancelled"))
    assert bench.executor.finished is not None and bench.executor.finished.status is Status.ERROR
    assert [r.run for r in bench.records] == ["work#1", "tidy#1"]


def test_plansys2_399_a_performer_that_never_answers_does_not_block_the_task() -> None:
    """There, the executor stayed in RUNNING for ever. Here the wait ends in ERROR after the
    deadline and 5 s for the stop routine."""
    bench = Bench().begin()
    bench.go(9.9)
    assert bench.records == []
    bench.go(10.0)
    (record,) = bench.records
    assert (record.status, record.cause, record.executed) == (
        Status.ERROR,
        "no_answer",
        Executed.UNKNOWN,
    )
    bench.go(60.0)
    assert bench.executor.finished is not None and bench.executor.finished.status is Status.ERROR


def test_plansys2_399_a_cancelled_performer_that_never_answers_is_reported_stuck() -> None:
    bench = Bench().begin()
    bench.ring(1.0)
    bench.go(1.0 + 1.0 + ESCALATION)
    assert "stuck_run" in bench.reports and bench.executor.finished is not None


def test_plansys2_400_a_silent_performer_is_never_replaced_by_a_second_one() -> None:
    """There, after 5 s without feedback, another performer got the action while the first might
    still execute it."""
    bench = Bench().begin()
    ids: list[str] = []
    for second in range(1, 60):
        bench.go(float(second))
        ids += bench.calls()
    assert WORK not in ids and ids == [], "no call is made again, and nothing else is given the arm"
    assert bench.records[0].executed is Executed.UNKNOWN


def test_plansys2_400_a_performer_that_did_not_accept_is_not_called_again() -> None:
    """It may still execute the action: its call is not repeated, and no run gets the arm until the
    node must have stopped it."""
    bench = Bench()
    bench.link(0.0)
    bench.executor.stimulate(0.0, Begin())
    assert bench.calls() == [WORK]
    ids: list[str] = []
    for tenth in range(1, 40):
        bench.go(tenth / 10)
        ids += bench.calls()
    assert ids == [] and bench.records[0].cause == "not_accepted"
    bench.go(1.0 + 1.0 + STOP_MARGIN)
    assert bench.calls() == [TIDY]


def test_plansys2_400_no_run_gets_the_arm_before_the_first_performer_releases_it() -> None:
    bench = Bench().begin()
    bench.ring(1.0)
    bench.go(3.0)
    assert bench.calls() == []
    bench.say(3.0, m.Outcome(WORK, "error", {}, "cancelled"))
    assert bench.calls() == [TIDY]


def test_every_cancel_is_answered_once() -> None:
    """In any order of messages, a cancelled run has one `RunRecorded`."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.say(1.1, m.Outcome(WORK, "error", {}, "cancelled"), m.Outcome(WORK, "success"))
    given = [i for step in bench.steps for i in step.instructions]
    assert (
        sum(isinstance(i, CancelRun) for i in given)
        == sum(isinstance(i, RunRecorded) for i in given)
        == 1
    )
