"""Kills, floods, old calls, cut links and reboots in any order: no action runs twice, and no action
that ran is reported as not executed."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.coordinator.engine import Begin, RunRecorded
from petrobot.coordinator.run.calls import STOP_MARGIN
from petrobot.coordinator.run.recording import RecordedStep
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.calls.callee import Callee, Offer, Retention
from petrobot.services.comm.protocol import messages as m
from tests.run.toy_arm import TIDY, WORK, Bench

KEEPING = Retention(results=10.0, result_count=2, id_groups=2)
TURNS = 300
"""Steps of 0.5 s within which every mission run of these tests ends, whatever happened before."""


class World:
    """A coordinator whose steps are all recorded, and a node whose actions end when the test ends
    them."""

    def __init__(self, keeping: Retention = KEEPING) -> None:
        self.now = 0.0
        self.boots = self.epoch = 1
        self.floods = 0
        self.keeping = keeping
        self.started: Counter[str] = Counter()
        self.active: list[str] = []
        self.journal: list[RecordedStep] = []
        self.callee = self._callee()
        first = Bench()
        self.bench: Bench | None = first
        self.connect()
        first.executor.stimulate(0.0, Begin())

    def _callee(self) -> Callee:
        offers: dict[str, Offer] = {
            n: Offer(device="arm", orphan_time=1.0) for n in ("do_work", "do_tidy")
        }
        offers["flood"] = Offer(inline=lambda now, call: m.Outcome(call.id, "success"))
        return Callee("motion", f"n{self.boots}", offers, keeping=self.keeping)

    # --- what happens -------------------------------------------------------------------------

    def connect(self) -> None:
        """The coordinator reaches the node."""
        if self.bench is not None and not self.bench.caller.up:
            welcome = self.callee.link_up(self.now, "m", self.bench.caller.hello)
            assert isinstance(welcome, m.Welcome), welcome
            self.bench.link(self.now, welcome.boot, welcome.runs)

    def cut(self, arrives: bool) -> None:
        """The link breaks; what was on its way to the node arrives, or is lost."""
        if self.bench is None or not self.bench.caller.up:
            return
        sent = self.bench.sent()
        for message in sent if arrives else ():
            self.callee.receive(self.now, "m", message)
        self.bench.caller.link_down(self.now, "cut")
        self.callee.link_down(self.now, "m")
        self._obey()

    def kill(self, arrives: bool) -> None:
        """kill -9 of the coordinator: what it recorded is all that is left."""
        if self.bench is not None:
            self.cut(arrives)
            self.journal += self.bench.steps
            self.bench = None

    def resume(self) -> None:
        """Another process takes over."""
        if self.bench is None:
            self.epoch += 1
            self.bench = Bench(epoch=self.epoch)
            for step in self.journal:
                self.bench.executor.replay(step.time, step)
            for seen in (self.bench.steps, self.bench.fired, self.bench.records):
                seen.clear()
            self.bench.now = self.now
            self.connect()
            self.bench.executor.adopt(self.now)

    def flood(self, calls: int) -> None:
        """Another client makes many calls under other ids, and acknowledges the results or not."""
        self.callee.link_up(self.now, "flood", m.Hello(2, 2, "client", "flood", "f1"))
        for _ in range(calls):
            self.floods += 1
            id_ = f"flood {self.floods} flood"
            self.callee.receive(self.now, "flood", m.Call(id_, "flood"))
            if self.floods % 3:
                self.callee.receive(self.now, "flood", m.ResultAck(id_))

    def disaster(self) -> None:
        """Kill the coordinator, let all its runs end, and flood the node: the case that the guard
        is for."""
        self.kill(True)
        self.finish()
        self.flood(15)

    def reboot(self) -> None:
        """The node is started again."""
        self.cut(False)
        self.boots += 1
        self.active.clear()
        self.callee = self._callee()

    def finish(self) -> None:
        """End the oldest active run."""
        if self.active:
            self.callee.finish(self.now, m.Outcome(self.active.pop(0), "success"))

    def ring(self) -> None:
        """The bell preempts work."""
        if self.bench is not None and self.bench.caller.up:
            self.bench.ring(self.now, 1)

    def pass_time(self, seconds: float) -> None:
        """Let so much time pass without a message."""
        self.now += seconds
        self.callee.advance(self.now)
        self._obey()
        if self.bench is not None:
            self.bench.go(self.now)

    def exchange(self) -> None:
        """Deliver all messages that are in transit."""
        for _ in range(4):
            if self.bench is None or not self.bench.caller.up:
                return
            for message in self.bench.sent():
                self.callee.receive(self.now, "m", message)
            self._obey()
            for peer, message in self.callee.messages():
                if peer == "m":
                    self.bench.say(self.now, message)

    def _obey(self) -> None:
        for order in self.callee.orders():
            if isinstance(order, m.Call):
                self.started[order.id] += 1
                self.active.append(order.id)
            elif isinstance(order, m.Cancel) and order.id in self.active:
                self.active.remove(order.id)
                self.callee.finish(self.now, m.Outcome(order.id, "error", cause="cancelled"))

    # --- what must hold -----------------------------------------------------------------------

    def end(self) -> list[RunRecorded]:
        """Let the mission run end, and check it. Return the records of its runs."""
        for _ in range(TURNS):
            self.resume()
            self.connect()
            self.exchange()
            self.finish()
            self.pass_time(0.5)
            assert self.bench is not None
            if self.bench.executor.finished is not None:
                break
        else:
            raise AssertionError(f"it does not end: {self.started}")
        twice = [id_ for id_, count in self.started.items() if count > 1]
        assert not twice, f"executed twice: {twice}"
        steps = [*self.journal, *self.bench.steps]
        records = [i for step in steps for i in step.instructions if isinstance(i, RunRecorded)]
        for record in records:
            assert record.executed is not Executed.NO or not self.started[f"m/{record.run}"], record
        return records


SOME = [
    st.tuples(st.just("exchange")),
    st.tuples(st.just("exchange")),
    st.tuples(st.just("finish")),
    st.tuples(st.just("kill"), st.booleans()),
    st.tuples(st.just("kill"), st.booleans()),
    st.tuples(st.just("resume")),
    st.tuples(st.just("resume")),
    st.tuples(st.just("cut"), st.booleans()),
    st.tuples(st.just("connect")),
    st.tuples(st.just("flood"), st.sampled_from([1, 4, 15])),
    st.tuples(st.just("disaster")),
    st.tuples(st.just("pass_time"), st.sampled_from([0.1, 0.9, 2.5, 11.0, 7_200.0])),
    st.tuples(st.just("ring")),
    st.tuples(st.just("reboot")),
]
OPERATIONS = st.lists(st.one_of(SOME), max_size=30)


def _live_through(operations: list[tuple[object, ...]]) -> World:
    world = World()
    for name, *arguments in operations:
        getattr(world, str(name))(*arguments)
    return world


@settings(max_examples=100, deadline=None)
@given(OPERATIONS)
def test_nothing_runs_twice(operations: list[tuple[object, ...]]) -> None:
    assert _live_through(operations).end(), "no run was recorded"


@pytest.mark.proof
@settings(max_examples=50_000, deadline=None)
@given(OPERATIONS)
def test_nothing_runs_twice_in_full(operations: list[tuple[object, ...]]) -> None:
    assert _live_through(operations).end(), "no run was recorded"


@pytest.mark.parametrize("accepted", [True, False], ids=["accepted", "accept lost"])
@pytest.mark.parametrize("how", ["count", "age", "flood"])
def test_a_run_that_the_node_has_forgotten_ends_unknown_and_its_device_is_fenced(
    how: str, accepted: bool
) -> None:
    """The node has dropped its result (too many, or too old), or even its id; the coordinator's
    journal knows that it was ordered."""
    world = World(
        Retention(results=10.0, result_count=2, id_groups=100_000 if how != "flood" else 2)
    )
    if accepted:
        world.exchange()
    world.kill(True)
    assert world.active == [WORK]
    world.finish()
    if how == "age":
        world.pass_time(86_400.0)
    else:
        world.flood(20)
    world.resume()
    bench = world.bench
    assert bench is not None
    if accepted:
        assert bench.calls() == [], "that it was accepted is known: nothing is asked"
    else:
        world.exchange()
    (record,) = bench.records
    assert (record.run, record.status, record.cause) == ("work#1", Status.ERROR, "forgotten")
    assert record.executed is Executed.UNKNOWN and bench.fired == ["failed"]
    assert bench.calls() == [], "the arm is fenced"
    bench.go(world.now + STOP_MARGIN)
    assert bench.calls() == [TIDY]


def test_a_forgotten_run_that_was_stopping_has_stopped_when_its_fence_ends() -> None:
    world = World()
    world.exchange()
    world.ring()
    world.kill(True)
    world.flood(20)
    world.resume()
    assert world.bench is not None and world.bench.calls() == [] and world.bench.records == []
    world.bench.go(world.now + STOP_MARGIN)
    (record,) = world.bench.records
    assert record.cancelled and record.executed is Executed.UNKNOWN
    assert world.bench.calls() == [TIDY]


def test_a_cancelled_run_of_an_earlier_boot_is_never_reported_as_not_executed() -> None:
    """A run is ordered, cancelled, and executed for a moment; then both processes are killed. The
    node's new process does not know the run, and still says so after the next kill of the
    coordinator."""
    world = World()
    world.ring()
    world.kill(True)
    assert world.started == {WORK: 1}
    world.reboot()
    world.resume()
    world.exchange()
    world.kill(False)
    (record, *_) = world.end()
    assert record.run == "work#1" and record.cancelled and record.executed is Executed.UNKNOWN


def test_a_lost_call_is_executed_by_a_node_that_has_forgotten_nothing() -> None:
    """The guard does not prevent calls where it is not needed, not even a day later."""
    world = World(Retention())
    world.kill(False)
    world.flood(2_000)
    world.pass_time(86_400.0)
    records = world.end()
    assert [(r.run, r.status) for r in records] == [
        ("work#1", Status.SUCCESS),
        ("tidy#1", Status.SUCCESS),
    ]
    assert world.started == {WORK: 1, TIDY: 1}
