"""Caller and callee over a link that loses, repeats and delays messages, with restarts of both:
every action runs at most once, and every call ends."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from hypothesis import given, settings, strategies as st
from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.services.comm.calls.callee import Callee, Offer, Retention
from petrobot.services.comm.calls.caller import Caller, LateResult
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Executed, Outcome, Welcome

COORD = "coord"
DEVICES = 2


class ModelRun(Struct):
    ends: float
    call: m.Call


class World(Struct, dict=True):
    """A coordinator with a journal, a node that runs the actions ordered, and a link between
    them."""

    now: float = 0.0
    epoch: int = 1
    boot: int = 1
    linked: bool = False
    towards_node: list[tuple[float, m.Message]] = field(default_factory=list)
    towards_caller: list[tuple[float, m.Message]] = field(default_factory=list)
    stale: list[m.Message] = field(default_factory=list)
    runs: dict[str, ModelRun] = field(default_factory=dict)
    started: Counter[str] = field(default_factory=Counter)
    finished: set[str] = field(default_factory=set)
    made: dict[str, m.Call] = field(default_factory=dict)
    ended: dict[str, m.Outcome] = field(default_factory=dict)
    late: list[m.Outcome] = field(default_factory=list)
    known_boot: str = ""

    def __post_init__(self) -> None:
        self.numbers = itertools.count(1)
        self.callee = self._new_callee()
        self.caller = self._new_caller()

    def _new_callee(self) -> Callee:
        offers = {f"act{n}": Offer(device=f"arm{n}", orphan_time=1.0) for n in range(DEVICES)}
        offers["get"] = Offer(inline=self._inline)
        offers["flooded"] = Offer(inline=lambda now, call: m.Outcome(call.id, "success"))
        return Callee(
            "motion",
            f"n{self.boot}",
            offers,
            keeping=Retention(results=3.0, result_count=4, id_groups=2),
        )

    def _new_caller(self) -> Caller:
        return Caller("motion", m.Hello(2, 2, "coordinator", COORD, f"c{self.epoch}", self.epoch))

    def _inline(self, now: float, call: m.Call) -> m.Outcome:
        self.started[call.id] += 1
        self.finished.add(call.id)
        return m.Outcome(call.id, "success", call.arguments)

    # Events of the world.

    def call(self, service: str, seconds: float, deadline: float | None) -> None:
        call = m.Call(f"c{next(self.numbers)}", service, {"seconds": seconds}, deadline)
        self.made[call.id] = m.Call(
            call.id, service, call.arguments, deadline, boot=self.known_boot
        )
        self.caller.call(self.now, call)

    def cancel(self, which: int) -> None:
        under_way = tuple(self.caller.pending)
        if under_way:
            self.caller.cancel(self.now, under_way[which % len(under_way)], "not wanted")

    def connect(self) -> None:
        if self.linked:
            return
        answer = self.callee.link_up(self.now, COORD, self.caller.hello)
        assert isinstance(answer, m.Welcome), answer
        self.linked = True
        self.caller.link_up(self.now, answer)

    def cut(self, lost: int, final: bool = False) -> None:
        """Break the link. The newest messages of each direction are lost; lost CALLs may still
        arrive later."""
        if not self.linked:
            return
        self.linked = False
        arrives = self.towards_node[: len(self.towards_node) - lost]
        self.stale += [message for _, message in self.towards_node if isinstance(message, m.Call)]
        for _, message in arrives:
            self.callee.receive(self.now, COORD, message)
        for _, message in self.towards_caller[: len(self.towards_caller) - lost]:
            self.caller.receive(self.now, message)
        self.towards_node.clear()
        self.towards_caller.clear()
        self.callee.link_down(self.now, COORD)
        self.caller.link_down(self.now, "cut", final=final)

    def repeat(self, which: int) -> None:
        """Deliver an earlier CALL again."""
        if self.stale and self.linked:
            self.callee.receive(self.now, COORD, self.stale[which % len(self.stale)])

    def reboot_node(self) -> None:
        self.cut(1000)
        self.boot += 1
        self.runs.clear()
        self.callee = self._new_callee()

    def restart_coordinator(self) -> None:
        """Kill the coordinator (kill -9): only its journal is left, and it makes the calls in it
        again under their ids."""
        self.cut(1000)
        self.epoch += 1
        self.caller = self._new_caller()
        self.caller.connecting(self.now)
        for id_, call in self.made.items():
            if id_ not in self.ended:
                boot = call.boot or "none"
                self.caller.call(self.now, replace(call, boot=boot, again=True))

    def flood(self, calls: int) -> None:
        """Let another client call under unrelated ids. No CALL of ours is in transit for that
        long."""
        self.stale.clear()
        self.callee.link_up(self.now, "flood", m.Hello(2, 2, "client", "flood", "f1"))
        for _ in range(calls):
            id_ = f"flood {next(self.numbers)} flood"
            assert self.callee.answer_inline(self.now, "flood", m.Call(id_, "flooded")) is not None
            self.callee.keep(self.now, "flood", m.Outcome(id_, "success"))
            self.callee.receive(self.now, "flood", m.ResultAck(id_))

    def pass_time(self, seconds: float, delay: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, self.now + 0.1)
            self.turn(delay)

    # Consequences.

    def turn(self, delay: float) -> None:
        self._finish_runs()
        self.callee.advance(self.now)
        self.caller.advance(self.now)
        for _ in range(3):
            self._orders()
            self._exchange(delay)
        for notice in self.caller.notices():
            if isinstance(notice, Outcome):
                assert notice.id not in self.ended, "a call ended twice"
                self.ended[notice.id] = notice
                self.caller.acknowledge(self.now, notice.id)
            elif isinstance(notice, LateResult):
                self.late.append(notice.outcome)
            elif isinstance(notice, Welcome):
                self.known_boot = notice.boot
                self._settle(notice.runs)

    def _settle(self, runs: tuple[str, ...]) -> None:
        """Acknowledge the results that the node still keeps of calls that the journal has as
        ended."""
        for id_ in runs:
            if id_ in self.ended and self.ended[id_].executed is Executed.UNKNOWN:
                self.caller.disown(self.now, id_)
            elif id_ in self.ended:
                self.caller.acknowledge(self.now, id_)

    def _finish_runs(self) -> None:
        for id_, run in list(self.runs.items()):
            if run.ends <= self.now:
                del self.runs[id_]
                self.finished.add(id_)
                self.callee.finish(
                    self.now, m.Outcome(id_, "success", {"seconds": run.call.arguments["seconds"]})
                )

    def _orders(self) -> None:
        for order in self.callee.orders():
            if isinstance(order, m.Call):
                self._start(order)
            elif isinstance(order, m.Cancel) and order.id in self.runs:
                del self.runs[order.id]
                self.callee.finish(
                    self.now, m.Outcome(order.id, "error", cause="cancelled", text=order.reason)
                )

    def _start(self, call: m.Call) -> None:
        if any(run.call.service == call.service for run in self.runs.values()):
            self.callee.finish(
                self.now, m.Outcome(call.id, "error", cause="busy", executed=Executed.NO)
            )
            return
        self.started[call.id] += 1
        self.runs[call.id] = ModelRun(self.now + call.arguments["seconds"], call)

    def _exchange(self, delay: float) -> None:
        due = self.now + delay
        said = self.caller.messages(self.now)
        heard = [message for peer, message in self.callee.messages() if peer == COORD]
        if not self.linked:
            return
        self.towards_node += [(due, message) for message in said]
        self.towards_caller += [(due, message) for message in heard]
        while self.towards_node and self.towards_node[0][0] <= self.now:
            message = self.towards_node.pop(0)[1]
            if isinstance(message, m.Call):
                self.stale.append(message)
            self.callee.receive(self.now, COORD, message)
        while self.towards_caller and self.towards_caller[0][0] <= self.now:
            self.caller.receive(self.now, self.towards_caller.pop(0)[1])


_services = st.sampled_from(["act0", "act1", "get", "nowhere"])
_seconds = st.sampled_from([0.0, 0.1, 0.5, 1.0, 5.0])
OPERATIONS = st.one_of(
    st.tuples(st.just("call"), _services, _seconds, st.none() | st.sampled_from([0.2, 1.0])),
    st.tuples(st.just("call"), _services, _seconds, st.none() | st.sampled_from([0.2, 1.0])),
    st.tuples(
        st.just("pass_time"),
        st.sampled_from([0.1, 0.3, 1.0, 2.5]),
        st.sampled_from([0.0, 0.1, 0.4]),
    ),
    st.tuples(
        st.just("pass_time"),
        st.sampled_from([0.1, 0.3, 1.0, 2.5]),
        st.sampled_from([0.0, 0.1, 0.4]),
    ),
    st.tuples(st.just("cancel"), st.integers(0, 9)),
    st.tuples(st.just("connect")),
    st.tuples(st.just("connect")),
    st.tuples(st.just("cut"), st.integers(0, 5), st.booleans()),
    st.tuples(st.just("repeat"), st.integers(0, 50)),
    st.tuples(st.just("flood"), st.sampled_from([1, 15])),
    st.tuples(st.just("reboot_node")),
    st.tuples(st.just("restart_coordinator")),
)


def _live_through(operations: list[tuple[object, ...]]) -> World:
    world = World()
    world.caller.connecting(0.0)
    world.connect()
    for name, *arguments in operations:
        getattr(world, str(name))(*arguments)
        world.turn(0.0)
    world.connect()
    world.pass_time(15.0, 0.0)
    return world


def _check(world: World) -> None:
    assert not [id_ for id_, count in world.started.items() if count > 1], "an action ran twice"
    assert world.ended.keys() == world.made.keys(), "a call did not end"
    for id_, outcome in world.ended.items():
        if outcome.executed is Executed.NO:
            assert not world.started[id_], (
                f"{id_} ended as not executed ({outcome.cause}), but it did"
            )
        if outcome.status == "success":
            assert (
                id_ in world.finished
                and outcome.values["seconds"] == world.made[id_].arguments["seconds"]
            )
        elif outcome.cause in ("lost", "rebooted", "not_accepted", "no_answer", "forgotten"):
            assert outcome.executed is Executed.UNKNOWN
    for outcome in world.late:
        known = world.ended[outcome.id]
        assert known == outcome or known.executed is Executed.UNKNOWN, (
            "only an unknown result may be corrected later"
        )
    assert not world.callee.running() and not world.caller.pending
    answer = world.callee.link_up(world.now, COORD, world.caller.hello)
    assert isinstance(answer, m.Welcome)
    assert answer.runs == (), "a result was not acknowledged"


@settings(max_examples=150)
@given(st.lists(OPERATIONS, max_size=40))
def test_at_most_once_and_every_call_ends(operations: list[tuple[object, ...]]) -> None:
    _check(_live_through(operations))


@pytest.mark.proof
@settings(max_examples=20_000)
@given(st.lists(OPERATIONS, max_size=120))
def test_at_most_once_and_every_call_ends_in_full(operations: list[tuple[object, ...]]) -> None:
    _check(_live_through(operations))
