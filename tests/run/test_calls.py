"""The dispatcher of runs to nodes: which runs are stopped, fenced, fetched, forgotten and recorded,
with one coordinator process or after a resume."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.engine import Begin, Hold, Pause, Phase, Resume, RunEnded, StartRun
from petrobot.coordinator.run.calls import ESCALATION, STOP_MARGIN, AfterTimers, Dispatch
from petrobot.coordinator.run.journal import JournalError, JournalWriter
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Message
from tests.run.toy_arm import TIDY, WORK, Bench, directory

STOPPED = "preempted by rung"
WITHIN = 1.0
ORPHAN_TIME = 1.0


def done(call: str, status: str = "success", cause: str = "") -> m.Outcome:
    """Return the node's message that a run has ended."""
    return m.Outcome(call, status, cause=cause)


# --- cancel -----------------------------------------------------------------------------------


def test_nothing_starts_on_the_device_before_the_cancelled_run_is_known_to_have_stopped() -> None:
    bench = Bench().begin()
    bench.ring(1.0)
    assert bench.fired[-1] == "rung" and bench.sent(m.Call, m.Cancel) == [m.Cancel(WORK, STOPPED)]
    bench.go(2.0)
    assert bench.calls() == []
    bench.say(2.1, done(WORK, "error", "cancelled"))
    assert bench.calls() == [TIDY]
    assert [(r.run, r.status, r.cancelled) for r in bench.records] == [
        ("work#1", Status.SUCCESS, True)
    ]


def test_a_result_that_crosses_the_cancel_frees_the_device() -> None:
    """The result that comes after the cancel is recorded, moves nothing, and frees the device."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.say(1.1, done(WORK, "failure", "dropped"))
    (record,) = bench.records
    assert (record.status, record.cancelled) == (
        Status.SUCCESS,
        True,
    ) and "failure, dropped" in record.text
    assert bench.fired == ["go", "rung"] and bench.calls() == [TIDY]
    bench.say(1.2, done(WORK, "failure", "dropped"))
    assert bench.fired == ["go", "rung"] and len(bench.records) == 1 and bench.calls() == []


def test_a_preemption_just_after_the_end_cancels_nothing() -> None:
    bench = Bench().begin()
    bench.say(1.0, done(WORK))
    bench.ring(1.0)
    assert (
        bench.fired == ["go", "worked"]
        and bench.sent(m.Cancel) == []
        and bench.reports == ["early_event"]
    )


def test_a_run_that_never_stops_is_stuck_and_the_next_on_its_device_ends_unexecuted() -> None:
    """StopFailed comes after the stop time of the action and the escalation time, not before."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.go(1.0 + WITHIN + ESCALATION - 0.01)
    assert bench.fired == ["go", "rung"]
    bench.go(1.0 + WITHIN + ESCALATION)
    run = bench.executor.state.run("work#1")
    assert run is not None and run.phase is Phase.STUCK
    (record,) = bench.records
    assert (record.run, record.cause, record.executed) == ("tidy#1", "device_fenced", Executed.NO)
    finished = bench.executor.finished
    assert TIDY not in bench.calls() and finished is not None
    assert finished.status is Status.ERROR and "work#1 could not be stopped" in finished.reason


def test_a_late_result_of_a_stuck_run_is_recorded_and_frees_its_device() -> None:
    bench = Bench().begin()
    bench.ring(1.0)
    bench.go(6.0)
    bench.say(9.0, done(WORK, "error", "cancelled"))
    assert bench.executor.state.run("work#1") is None
    assert [r.run for r in bench.records] == ["tidy#1", "work#1"]
    bench.go(9.1)
    assert m.ResultAck(WORK) in bench.sent()


def test_a_node_cut_off_while_stopping_a_run_keeps_the_device_until_its_lease_ends() -> None:
    """The run stays stopping until orphan time and stop time have passed; only then does the next
    one begin."""
    bench = Bench().begin()
    bench.ring(1.0)
    bench.caller.link_down(1.5, "silent", final=True)
    bench.go(1.5)
    free = 1.5 + ORPHAN_TIME + STOP_MARGIN
    bench.go(free - 0.01)
    run = bench.executor.state.run("work#1")
    assert run is not None and run.phase is Phase.STOPPING
    bench.link(free - 0.005, "n1", [WORK])
    assert bench.sent(m.Cancel)[-1] == m.Cancel(WORK, "given up")
    bench.go(free)
    assert bench.calls() == [TIDY]
    assert (bench.records[0].run, bench.records[0].executed) == ("work#1", Executed.UNKNOWN)


# --- lost runs --------------------------------------------------------------------------------


def test_the_device_of_a_lost_run_is_fenced_until_the_node_must_have_stopped_it() -> None:
    """The node is frozen or cut off: ERROR at once, executed unknown; the next run on the device
    waits."""
    bench = Bench().begin()
    bench.caller.link_down(1.0, "silent", final=True)
    bench.go(1.0)
    (record,) = bench.records
    assert (record.cause, record.executed) == ("lost", Executed.UNKNOWN)
    bench.link(1.2, "n1", [WORK])
    bench.go(1.0 + ORPHAN_TIME + STOP_MARGIN - 0.01)
    assert bench.calls() == []
    bench.go(1.0 + ORPHAN_TIME + STOP_MARGIN)
    assert bench.calls() == [TIDY]


def test_a_late_answer_of_the_node_lifts_the_fence_and_changes_nothing_else() -> None:
    bench = Bench().begin()
    bench.caller.link_down(1.0, "silent", final=True)
    bench.link(1.2, "n1", [WORK])
    bench.say(1.3, done(WORK, "error", "orphan"))
    assert bench.calls() == [TIDY] and bench.fired == ["go", "failed"]
    assert len(bench.records) == 1 and bench.reports == ["unknown_run"]
    bench.go(1.4)
    assert m.ResultAck(WORK) in bench.sent()


def test_a_connected_node_that_never_reports_the_end_fences_the_device_for_good() -> None:
    """No result 5 s after the deadline: the device may still move. A run that waits for it ends in
    ERROR at its own deadline, unexecuted."""
    bench = Bench().begin()
    bench.go(10.0)
    assert bench.records[0].cause == "no_answer"
    bench.go(12.9)
    assert bench.calls() == [] and len(bench.records) == 1
    bench.go(13.0)
    assert (bench.records[1].cause, bench.records[1].executed) == ("device_fenced", Executed.NO)
    assert "work#1" in bench.records[1].text and bench.executor.finished is not None


def test_a_restarted_node_ends_a_fence_once_its_devices_must_stand_still() -> None:
    bench = Bench().begin()
    bench.go(10.0)
    bench.caller.link_down(10.2, "killed")
    bench.link(10.5, "n2")
    bench.go(10.5 + STOP_MARGIN - 0.01)
    assert bench.calls() == []
    bench.go(10.5 + STOP_MARGIN)
    assert bench.calls() == [TIDY]


# --- after a resume ---------------------------------------------------------------------------


def test_an_active_run_is_rejoined_under_its_id_at_the_boot_it_was_sent_to() -> None:
    bench = Bench().begin().resumed(2.0, runs=[WORK])
    (call,) = bench.sent(m.Call)
    assert isinstance(call, m.Call) and (call.id, call.boot, call.epoch) == (WORK, "n1", 2)
    bench.say(2.1, m.Accept(WORK), done(WORK))
    assert bench.fired == ["worked"] and bench.calls() == [TIDY]


def test_a_run_sent_to_another_boot_is_asked_for_by_that_boot_and_never_run_again() -> None:
    """The node died too, so the new one answers that it does not know the run."""
    bench = Bench().begin().resumed(2.0, boot="n2")
    (call,) = bench.sent(m.Call)
    assert isinstance(call, m.Call) and (call.id, call.boot) == (WORK, "n1")
    bench.say(2.1, m.Outcome(WORK, "error", {}, "rebooted", "", m.Executed.UNKNOWN))
    assert bench.fired == ["failed"]
    bench.go(2.1 + 0.9 * STOP_MARGIN)
    assert bench.calls() == [], "the former process's arm may still be at its stop routine"
    bench.go(2.1 + STOP_MARGIN)
    (tidy,) = bench.sent(m.Call)
    assert isinstance(tidy, m.Call) and (tidy.id, tidy.boot) == (TIDY, "n2"), (
        "later runs go to whoever is there"
    )


def test_a_run_that_reached_a_later_boot_than_the_one_recorded_is_found_there() -> None:
    """It was sent while the node was away, and the node's next process accepted it."""
    bench = Bench().begin().resumed(2.0, boot="n2", runs=[WORK])
    (call,) = bench.sent(m.Call)
    assert isinstance(call, m.Call) and call.boot == "n2"


@pytest.mark.parametrize("goes_on", [True, False])
def test_on_resume_error_gives_up_active_runs_and_uses_results_of_ended_ones(
    goes_on: bool,
) -> None:
    bench = Bench().begin().resumed(2.0, on_resume="error", runs=[WORK])
    assert bench.calls() == [WORK]
    if not goes_on:
        bench.say(2.1, done(WORK))
        assert bench.fired == ["worked"] and bench.records[0].status is Status.SUCCESS
        return
    bench.say(2.1, m.Accept(WORK))
    assert (bench.records[0].cause, bench.records[0].executed) == ("resumed", Executed.YES)
    assert bench.sent(m.Call, m.Cancel) == [m.Cancel(WORK, "resumed")], (
        "tidy waits until the arm is known to stand still"
    )
    bench.say(2.5, done(WORK, "error", "cancelled"))
    assert bench.calls() == [TIDY]


def test_on_resume_ask_rejoins_and_pauses_for_the_operator() -> None:
    bench = Bench().begin().resumed(2.0, on_resume="ask", runs=[WORK])
    assert bench.calls() == [WORK] and bench.executor.state.mode.value == "paused"
    bench.say(2.1, done(WORK))
    assert bench.fired == []
    bench.executor.stimulate(3.0, Resume())
    assert bench.fired == ["worked"]


def test_runs_that_a_node_still_knows_are_acknowledged_or_stopped() -> None:
    """A run that the journal records as ended may be forgotten by the node; a run that the journal
    does not know is stopped."""
    first = Bench().begin()
    first.say(1.0, m.Accept(WORK), done(WORK))
    bench = Bench(epoch=2)
    for step in first.steps:
        bench.executor.replay(step.time, step)
    bench.link(2.0, "n1", [WORK, "m/work#7", "m/prepare", "other/work#1"])
    bench.executor.adopt(2.0)
    bench.go(2.1)
    sent = bench.sent(m.Cancel, m.ResultAck)
    assert sent == [m.Cancel("m/work#7", "disowned"), m.ResultAck(WORK)]


def test_a_run_given_up_before_the_resume_is_stopped_and_its_fence_remains() -> None:
    first = Bench().begin()
    first.caller.link_down(1.0, "silent", final=True)
    first.go(1.0)
    bench = first.resumed(1.5, runs=[WORK])
    assert bench.sent(m.Cancel, m.Call) == [m.Cancel(WORK, "disowned")]
    bench.go(3.9)
    assert bench.calls() == []
    bench.go(1.0 + ORPHAN_TIME + STOP_MARGIN)
    assert bench.calls() == [TIDY]


def test_a_latched_event_that_came_without_a_coordinator_is_delivered_once() -> None:
    """Its source keeps it until it is acknowledged; one that the killed coordinator had already
    accepted is not accepted again."""
    first = Bench().begin()
    bench = first.resumed(2.0, runs=[WORK])
    bench.ring(2.1, number=1)
    bench.say(2.1, m.Event("bell", "desk", 1))
    assert bench.fired == ["rung"]
    again = bench.resumed(3.0, runs=[WORK])
    assert isinstance(again.executor.state.seen, dict) and again.executor.state.seen == {"desk": 1}
    again.ring(3.1, number=1)
    assert again.fired == []


def test_a_cancelled_run_is_cancelled_again_and_waited_for() -> None:
    first = Bench().begin()
    first.ring(1.0)
    bench = first.resumed(2.0, runs=[WORK])
    assert [type(one) for one in bench.sent(m.Call, m.Cancel)] == [m.Call, m.Cancel]
    bench.say(2.1, m.Accept(WORK))
    assert bench.calls() == []
    bench.say(2.2, done(WORK, "error", "cancelled"))
    assert bench.calls() == [TIDY]


# --- operator ---------------------------------------------------------------------------------


def test_a_held_run_is_not_given_up_even_in_a_long_pause() -> None:
    bench = Bench().begin()
    bench.executor.stimulate(1.0, Pause())
    (hold,) = bench.sent(m.Command)
    assert isinstance(hold, m.Command)
    bench.say(1.1, m.Answer(hold.id, True, {"answers": {"arm": Hold.HELD.value}}))
    bench.go(100.0)
    assert bench.records == []
    bench.executor.stimulate(100.0, Resume())
    bench.go(108.8)
    assert bench.records == []
    bench.go(109.0)
    assert bench.records[0].cause == "no_answer"


def test_a_run_whose_hold_is_answered_after_the_pause_is_given_up() -> None:
    bench = Bench().begin()
    bench.executor.stimulate(1.0, Pause())
    bench.executor.stimulate(1.0, Resume())
    hold, _ = bench.sent(m.Command)
    assert isinstance(hold, m.Command)
    bench.say(1.1, m.Answer(hold.id, True, {"answers": {"arm": Hold.HELD.value}}))
    bench.go(100.0)
    assert bench.records and bench.records[0].cause == "no_answer"


# --- cost -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("durable", "device", "per_start"), [(False, True, 1), (False, False, 0), (True, False, 1)]
)
def test_a_firing_costs_one_sync_if_it_starts_hardware_and_none_otherwise(
    tmp_path: Path, durable: bool, device: bool, per_start: int
) -> None:
    """Result, firing and start of the next run share one sync; nothing else waits for a sync,
    unless everything must be durable."""
    writer = JournalWriter(tmp_path / "run.journal", {})
    store = JournalStore(writer, 0.0, durable=durable)
    bench = Bench(store=store, device='device = "arm"' if device else 'node = "motion"')
    bench.link(0.0)
    before = writer.syncs
    bench.executor.stimulate(0.0, Begin())
    assert writer.syncs - before == per_start
    bench.say(0.1, m.Accept(WORK), done(WORK))
    assert writer.syncs - before == 2 * per_start
    assert (m.ResultAck(WORK) in [*bench.sent()]) is False, (
        "acknowledgements travel together, a little later"
    )
    bench.go(0.1 + 0.5 + 0.05)
    assert store.safe and m.ResultAck(WORK) in bench.sent(), (
        "within half a second the node may forget it all the same"
    )
    assert writer.syncs - before <= 3


def test_nothing_is_sent_if_the_journal_cannot_be_written(tmp_path: Path) -> None:
    """The disk is full: no start is sent without its record in the journal."""
    writer = JournalWriter(tmp_path / "run.journal", {})
    bench = Bench(store=JournalStore(writer, 0.0))
    bench.link(0.0)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, writer._file)
    os.close(full)
    with pytest.raises(
        JournalError, match=r"run\.journal: No space left on device; nothing was sent"
    ):
        bench.executor.stimulate(0.0, Begin())
    assert bench.calls() == []


def test_after_a_sync_that_was_asked_for_none_is_due(tmp_path: Path) -> None:
    """The answer to an operator's command waits for a sync; afterwards the executor has none to
    wake up for."""
    store = JournalStore(JournalWriter(tmp_path / "run.journal", {}), 0.0)
    bench = Bench(store=store)
    bench.link(0.0)
    bench.executor.stimulate(0.0, Begin())
    bench.executor.stimulate(0.1, Pause("by hand"))
    safe: list[float] = []
    bench.executor.when_safe(0.1, safe.append)
    assert safe == [0.1]
    bench.go(0.7)
    due = bench.executor.due()
    assert store.safe and (due is None or due > 0.7)


class SlowDisk:
    """A bench that has begun; a sync of its disk ends when the test says so."""

    def __init__(self, folder: Path) -> None:
        self.bench = Bench(store=JournalStore(JournalWriter(folder / "run.journal", {}), 0.0))
        self._syncing = False
        self.bench.executor.in_background = self._sync
        self.bench.link(0.0)
        self.bench.sent()
        self.bench.executor.stimulate(0.0, Begin())

    def _sync(self, work: Callable[[], None]) -> None:
        assert not self._syncing
        self._syncing = True
        work()  # what is appended from now on needs another one

    def writes(self, now: float) -> list[Message]:
        """End the sync, and return what leaves then."""
        assert self._syncing
        self._syncing = False
        self.bench.executor.synced(now)
        return self.bench.sent(m.Call, m.Cancel, m.Command, m.EventAck, m.ResultAck)


def test_what_comes_while_the_disk_is_slow_waits_for_the_next_sync(tmp_path: Path) -> None:
    """The bell rings while the start of `work` is not yet on disk: it is never started. Otherwise
    it would move for as long as the next sync takes."""
    disk = SlowDisk(tmp_path)
    bench = disk.bench
    bench.ring(0.1)
    bench.go(2.0)
    assert not bench.sent(m.Call, m.Cancel, m.EventAck)
    due = bench.executor.due()
    assert due is None or due > 2.0, "nothing but the end of the sync may wake it"
    assert not disk.writes(2.0)
    assert [type(message) for message in disk.writes(4.0)] == [m.EventAck]
    assert [call.id for call in disk.writes(5.0) if isinstance(call, m.Call)] == [TIDY]
    bench.say(5.1, m.Accept(TIDY), m.Outcome(TIDY, "success"))
    assert bench.executor.finished and not bench.executor.over
    disk.writes(6.0)
    assert bench.executor.over


def test_what_is_held_before_it_has_begun_does_not_move_until_the_hold_is_on_disk(
    tmp_path: Path,
) -> None:
    """The operator pauses while the start of `work` is not yet on disk: start and hold leave
    together."""
    disk = SlowDisk(tmp_path)
    disk.bench.executor.stimulate(0.1, Pause("by hand"))
    assert not disk.writes(2.0)
    call, hold = disk.writes(4.0)
    assert isinstance(call, m.Call) and isinstance(hold, m.Command) and hold.verb == "hold"


def test_only_what_moves_hardware_waits_for_a_slow_disk(tmp_path: Path) -> None:
    """An action without a device starts when its order survives this process."""
    syncs: list[Callable[[], None]] = []
    store = JournalStore(JournalWriter(tmp_path / "run.journal", {}), 0.0)
    bench = Bench(store=store, device='node = "motion"')
    bench.executor.in_background = syncs.append
    bench.link(0.0)
    bench.executor.stimulate(0.0, Begin())
    assert bench.calls() == [WORK] and not syncs
    bench.say(0.1, m.Accept(WORK))
    bench.go(0.6)
    assert len(syncs) == 1, "what has waited for half a second is synced"
    bench.say(0.7, done(WORK))
    assert bench.calls() == [TIDY], "also meanwhile"


def test_an_order_without_a_device_waits_while_a_hung_disk_writes(tmp_path: Path) -> None:
    """The coordinator must not wait for the disk itself: nodes would count as lost."""
    writer = JournalWriter(tmp_path / "run.journal", {})
    bench = Bench(store=JournalStore(writer, 0.0), device='node = "motion"')
    syncs: list[Callable[[], None]] = []
    bench.executor.in_background = syncs.append
    bench.link(0.0)
    with writer._writing:  # held by the sync
        bench.executor.stimulate(0.0, Begin())
        bench.go(0.6)
        assert bench.calls() == [] and len(syncs) == 1
    syncs[0]()
    bench.executor.synced(0.7)
    assert bench.calls() == [WORK]


def test_what_leads_to_no_order_is_written_with_the_next_sync(tmp_path: Path) -> None:
    """Each write may meet a hung disk. Its node keeps what is not acknowledged."""
    writer = JournalWriter(tmp_path / "run.journal", {})
    bench = Bench(store=JournalStore(writer, 0.0), device='node = "motion"')
    bench.link(0.0)
    bench.executor.stimulate(0.0, Begin())
    assert (bench.calls(), writer.unsaved) == ([WORK], False)
    bench.say(0.1, m.Accept(WORK))
    assert (writer.unsaved, writer.pending) == (True, True)
    bench.go(0.6)
    assert (writer.unsaved, writer.pending) == (False, False)


# --- arguments that no message carries --------------------------------------------------------


@pytest.mark.parametrize(
    "arguments", [{"x": {1: 2}}, {"x": [[]] * 60_000, "y": [[]] * 60_000}, {"x": 2**70}]
)
def test_arguments_too_large_for_a_message_end_only_their_run(arguments: dict[str, Any]) -> None:
    """Two results, each small enough, may be too large for one call that gets both."""
    caller = Caller("motion", m.Hello(2, 2, "coordinator", "m", "c1", 1))
    dispatch = Dispatch(directory(), {"motion": caller}, "m", 0)
    (end,) = dispatch.carry_out(0.0, StartRun("work#1", "work", "work", "do_work", arguments, 1.0))
    assert isinstance(end, RunEnded)
    assert (end.run, end.status, end.cause, end.executed) == (
        "work#1",
        Status.ERROR,
        "bad_arguments",
        Executed.NO,
    )
    assert "arguments." in end.text and not dispatch.flights
    assert dispatch.carry_out(0.0, StartRun("work#2", "work", "work", "do_work", {}, 1.0)) == []
    assert list(dispatch.flights) == ["work#2"]


# --- timers -----------------------------------------------------------------------------------


def test_of_timers_that_elapse_together_the_one_armed_first_is_first() -> None:
    """The execution graph assumes this order, whatever the timers are called."""
    timers = AfterTimers()
    for key in ("open#9", "open#10", "close#11"):
        timers.arm(0.0, key, 2.0)
    timers.arm(1.0, "late#12", 0.5)
    timers.arm(1.0, "never#13", 5.0)
    assert timers.over(2.0) == ["late#12", "open#9", "open#10", "close#11"]
    assert len(timers) == 1


def test_a_run_that_ended_in_the_turn_of_its_cancel_is_not_stopped_again() -> None:
    """The bell and the end come together: the run counts as preempted, and nothing is odd."""
    bench = Bench().begin()
    for message in (m.Event("bell", "desk", 1), done(WORK, "success")):
        bench.caller.receive(1.0, message)
    bench.go(1.0)
    assert [record.cancelled for record in bench.records] == [True] and bench.reports == []
    assert bench.calls() == [TIDY]
