"""A coordinator that dies during an operator's command: in a pause, at a breakpoint, during a
cancel or an abort."""

from __future__ import annotations

import pytest

from petrobot.coordinator.engine import (
    Abort,
    Hold,
    Mode,
    Pause,
    Resume,
    RunHeld,
    SetBreakpoints,
    Step,
)
from petrobot.coordinator.run.calls import STOP_MARGIN
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.calls.events import STOP_EVENT
from petrobot.services.comm.protocol import messages as m
from tests.run.toy_arm import TIDY, WORK, Bench


def held(bench: Bench, now: float) -> m.Command:
    """Return the hold that was sent last, after the node answered that the arm holds."""
    order = next(c for c in bench.sent(m.Command) if isinstance(c, m.Command) and c.verb == "hold")
    bench.say(now, m.Answer(order.id, True, {"answers": {"arm": "held"}, "devices": {}}))
    return order


@pytest.mark.parametrize("answered", [True, False], ids=["held", "not answered yet"])
def test_killed_in_a_pause_it_is_still_paused_and_the_arm_is_asked_to_hold_again(
    answered: bool,
) -> None:
    """It is asked again whatever the node had answered, since it may have been released or
    restarted. Then the run continues as if nothing had happened."""
    bench = Bench().begin()
    bench.executor.stimulate(1.0, Pause("look"))
    if answered:
        held(bench, 1.1)
    after = bench.resumed(2.0, runs=[WORK])
    assert after.executor.state.mode is Mode.PAUSED
    held(after, 2.1)
    run = after.executor.state.run("work#1")
    assert run is not None and run.phase == "held"
    after.say(2.2, m.Outcome(WORK, "success"))
    assert after.fired == [] and after.calls() == [], "an end is kept, and nothing fires in a pause"
    after.executor.stimulate(3.0, Resume())
    assert after.fired == ["worked"] and after.calls() == [TIDY]


def test_killed_in_a_pause_of_a_node_that_cannot_hold() -> None:
    """Its run continues; that is reported again, and nothing fires."""
    bench = Bench().begin()
    bench.executor.stimulate(1.0, Pause())
    bench.executor.stimulate(1.1, RunHeld("work#1", Hold.CANNOT))
    after = bench.resumed(2.0, runs=[WORK])
    order = next(c for c in after.sent(m.Command) if isinstance(c, m.Command))
    after.say(2.1, m.Answer(order.id, False, {"answers": {"arm": "cannot hold"}, "devices": {}}))
    assert after.reports == ["not_held"] * 2 and after.executor.state.mode is Mode.PAUSED


def test_killed_with_breakpoints_set_it_stops_at_them() -> None:
    bench = Bench().begin()
    bench.executor.stimulate(1.0, SetBreakpoints(("worked",)))
    after = bench.resumed(2.0, runs=[WORK])
    after.say(2.1, m.Outcome(WORK, "success"))
    assert after.fired == [] and after.executor.state.mode is Mode.PAUSED
    third = after.resumed(3.0)
    assert (
        third.executor.state.breakpoints == {"worked"}
        and third.executor.state.suspended is not None
    )
    third.executor.stimulate(3.1, Step())
    assert third.fired == ["worked"] and third.executor.state.mode is Mode.PAUSED
    third.executor.stimulate(3.2, Resume())
    assert third.calls() == [TIDY], "once, whichever of the two let it go"


@pytest.mark.parametrize("boot", ["n1", "n2"])
def test_killed_during_a_cancel(boot: str) -> None:
    """The cancel is sent again; no run gets the arm before the cancelled run is known to have
    stopped, even if its node was restarted."""
    bench = Bench().begin()
    bench.ring(1.0)
    after = bench.resumed(1.5, boot=boot, runs=[WORK] if boot == "n1" else [])
    assert TIDY not in after.calls()
    if boot == "n1":
        assert after.executor.state.stopping
        after.say(1.6, m.Outcome(WORK, "error", {}, "cancelled"))
    else:
        after.say(1.6, m.Outcome(WORK, "error", {}, "rebooted", "", m.Executed.UNKNOWN))
        after.go(1.6 + 0.9 * STOP_MARGIN)
        assert after.calls() == [], (
            "the devices of the former process may still be at their stop routines"
        )
        after.go(1.6 + STOP_MARGIN)
    assert after.calls() == [TIDY]
    (record,) = after.records
    assert (record.run, record.cancelled) == ("work#1", True)
    assert record.status is Status.SUCCESS, "as the preempting event says"


def test_killed_during_an_abort_it_ends_and_starts_nothing() -> None:
    """The stop was journaled as an abort: the resumed run waits for the actions that are stopping,
    and ends."""
    bench = Bench().begin()
    bench.executor.stimulate(1.0, Abort("emergency stop by ana"))
    after = bench.resumed(2.0, runs=[WORK])
    assert [type(message) for message in after.sent(m.Call, m.Cancel)] in ([], [m.Call, m.Cancel])
    after.say(2.1, m.Outcome(WORK, "error", {}, "emergency_stop", "", m.Executed.YES))
    finished = after.executor.finished
    assert finished is not None and finished.status is Status.ERROR and "ana" in finished.reason
    assert after.calls() == [] and after.records[0].executed is Executed.YES


@pytest.mark.parametrize("resumed", [False, True])
@pytest.mark.parametrize("executed", list(m.Executed))
def test_an_emergency_stop_that_only_its_node_reports_aborts_the_run(
    resumed: bool, executed: m.Executed
) -> None:
    """The coordinator was frozen or dead when it was given. Once the stop is cleared, nothing may
    move unless somebody starts it: no transition answers such an end."""
    bench = Bench().begin()
    if resumed:
        bench = bench.resumed(2.0, runs=[WORK])
    bench.fired.clear()
    bench.sent()
    bench.say(2.1, m.Outcome(WORK, "error", {m.LATCHED: True}, m.EMERGENCY_STOP, "", executed))
    finished = bench.executor.finished
    assert finished is not None and finished.status is Status.ERROR
    assert finished.reason == "aborted: emergency stop, as motion reports"
    assert bench.fired == [] and bench.calls() == []
    assert bench.reports == [], "the run that ended with the stop is not stopped as well"


def test_a_stop_that_a_driver_reports_is_an_error_that_the_task_may_answer() -> None:
    """The node is not stopped, or not any more: drives must be reset before they move again."""
    bench = Bench().begin()
    bench.say(2.1, m.Outcome(WORK, "error", {}, m.EMERGENCY_STOP, "the drives have no power"))
    assert bench.fired[-1] == "failed" and bench.calls() == [TIDY]


@pytest.mark.parametrize("how", ["told at once", "told when it is back", "told too late"])
def test_an_emergency_stop_aborts_the_run_whichever_way_its_node_tells_it(how: str) -> None:
    """By the pulse, while the link holds; by WELCOME, if the stop was given and cleared while there
    was no link; by the result of a run that was given up."""
    bench = Bench().begin()
    if how == "told at once":
        bench.say(2.0, m.Event(STOP_EVENT, "motion", 0))
    elif how == "told when it is back":
        bench.caller.link_down(1.0, "cut")
        bench.link(2.0, "n1+1", runs=[WORK])
    else:
        bench.caller.link_down(1.0, "silent", final=True)
        assert bench.executor.state.mode is Mode.RUNNING
        values = {m.LATCHED: True, m.STOPS: 1}
        bench.link(1.2, "n1", [WORK])
        bench.say(1.3, m.Outcome(WORK, "error", values, m.EMERGENCY_STOP))
    assert bench.executor.state.mode in (Mode.ABORTING, Mode.FINISHED)
    assert TIDY not in bench.calls()


def test_a_run_that_is_resumed_after_a_stop_was_cleared_continues() -> None:
    """To resume it was decided after the stop. The journal names processes of nodes alone."""
    bench = Bench().begin()
    after = bench.resumed(2.0, boot="n1+1", runs=[WORK])
    (call,) = after.sent(m.Call)
    assert isinstance(call, m.Call) and (call.id, call.boot) == (WORK, "n1+1")
    after.say(2.1, m.Outcome(WORK, "success"))
    assert after.calls() == [TIDY] and after.executor.state.mode is Mode.RUNNING
