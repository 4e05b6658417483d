"""How a node watches its processes: who is told what, when a hanging one is killed, and that every
run ends once."""

from __future__ import annotations

import socket
from collections.abc import Callable
from itertools import pairwise, product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from petrobot.services.node.worker_host import (
    MARGIN,
    NEXT,
    NOT_READY,
    PAUSES,
    SILENT,
    START_LIMIT,
    Happening,
    Hosting,
    Stage,
    WorkerPlace,
)
from petrobot.services.node.worker_pool import WorkerPool
from petrobot.services.worker.pipe import NewestLink
from petrobot.services.worker.process import (
    COMMAND,
    FAILED,
    LINK_LOST,
    PING,
    PONG,
    READY,
    STREAM_AT,
    WANTED,
    Setup,
)
from petrobot.services.worker.remote import EMERGENCY_STOP
from petrobot.services.worker.runner import GRACE, STOP_LIMIT
from petrobot.services.worker.runs import (
    Answered,
    Begin,
    Ended,
    Hold,
    Order,
    Raised,
    Stop,
    Told,
    flat,
    record,
)
from tests.node.conftest import Clock
from tests.waiting import Limit


class FakeChild:
    """A child process that does what the test says."""

    def __init__(
        self,
        setup: Setup,
        heard: Callable[[Any, list[list[Any]]], None],
        ended: Callable[[Any], None],
        link: Any,
    ) -> None:
        self.setup = setup
        self._heard = heard
        self._ended = ended
        self.code: int | None = None
        self.closed = self.dead = False
        self.begun = 1 << 30
        """How many of its runs it says to have begun: all of them, unless a test says otherwise."""
        self.link = link
        self.linked = link is not None
        self._drop(link)
        self.pid = id(self) % 10_000
        self.got: list[list[Any]] = []
        self.passed: list[socket.socket] = []
        self.killed = self.left = False

    def say(self, items: list[Any]) -> None:
        self._heard(self, [items])

    def post(self, items: list[Any]) -> None:
        self.got.append(items)

    def _drop(self, end: socket.socket | None) -> None:
        if end is not None:
            end.close()

    def pass_link(self, end: socket.socket, word: str) -> None:
        self.passed.append(end)
        self._drop(end)
        self.post([word])

    def kill(self, why: str = "") -> None:
        self.killed = True

    def leave(self) -> None:
        self.left = self.closed = True

    def describe(self) -> str:
        return "it was ended by SIGTEST"

    def die(self, code: int = -9) -> None:
        self.code, self.closed, self.dead = code, True, True
        self._ended(self)

    def ready(self, period: float | None = None, **streams: int) -> None:
        self.say([READY, {"period": period, "streams": streams, "fifo": False}])

    def orders(self) -> list[Order]:
        kinds = {"begin", "stop", "answered", "hold"}
        return [record(items) for items in self.got if items[0] in kinds]  # type: ignore[misc]


class KeepingChild(FakeChild):
    """One that keeps its ends of sockets open."""

    def _drop(self, end: socket.socket | None) -> None: ...


class HostBench:
    """A host of runs whose processes are fake, on a clock of its own."""

    place: WorkerPlace | WorkerPool

    def __init__(self, device: str, child: type[FakeChild] = FakeChild) -> None:
        self.child = child
        self.clock = Clock(100.0)
        self.children: list[FakeChild] = []
        self.wanted: list[str] = []
        self.reports: list[Any] = []
        setup = Setup("services.toml", "", "node", device)
        self.hosting = Hosting(
            setup, self.clock, lambda: None, self.wanted.append, spawn=self._spawn
        )

    def _spawn(self, *arguments: Any) -> Any:
        self.children.append(self.child(*arguments))
        return self.children[-1]

    def begin(self, identity: str = "r", deadline: float | None = None) -> None:
        self.place.take(self.clock.now, Begin(identity, "act", {}, deadline))

    def run(self, seconds: float = 0.0) -> list[Any]:
        """Advance exactly when it says that it is due, as the shell does."""
        until, fresh = self.clock.now + seconds, []
        limit = Limit("nothing more to be due", steps=100_000)
        while limit.left():
            self.place.advance(self.clock.now)
            fresh += self.place.reports()
            due = self.place.due()
            if due is None or due > until:
                break
            self.clock.now = max(due, self.clock.now + 1e-6)
        self.clock.now = max(until, self.clock.now)
        self.reports += fresh
        return fresh


class Bench(HostBench):
    """A place of one device whose processes are fake."""

    place: WorkerPlace

    def __init__(self, device: str = "arm", child: type[FakeChild] = FakeChild) -> None:
        super().__init__(device, child)
        self.place = WorkerPlace(self.hosting)
        self.place.start()

    def cyclic(self) -> tuple[FakeChild, FakeChild]:
        """Bring up driver and actions of a cyclic device."""
        self.children[-1].ready(0.004, points=4711)
        self.children[-1].ready()
        return self.children[-2], self.children[-1]

    def ended(self, identity: str = "r") -> Ended:
        (end,) = [r for r in self.reports if isinstance(r, Ended) and r.id == identity]
        return end


def test_a_device_without_cycle_has_one_process() -> None:
    bench = Bench()
    (child,) = bench.children
    assert (child.setup.device, bool(bench.place.ready)) == ("arm", False)
    bench.begin()
    assert child.orders() == []
    child.ready()
    assert bench.place.ready and child.orders() == [Begin("r", "act", {}, None)]
    child.say(flat(Ended("r", "success", {"x": 1})))
    bench.run(0.0)
    assert bench.ended().values == {"x": 1} and bench.place.pids() == {"actions": child.pid}


def test_a_cyclic_device_has_two_with_a_link_between_them() -> None:
    bench = Bench(child=KeepingChild)
    driver, actions = bench.cyclic()
    assert bench.place.streams == {"points": 4711} and set(bench.place.pids()) == {
        "actions",
        "driver",
    }
    near, far = NewestLink(driver.passed[0]), NewestLink(actions.link)
    assert near.send([1]) and far.newest() == [1]
    far.close()
    near.close()


def test_what_comes_up_passes_through() -> None:
    bench = Bench("")
    (child,) = bench.children
    child.ready()
    child.say(flat(Raised("r", "seen", {})))
    child.say([WANTED, "points"])
    bench.place.take(0.0, Answered("r/1", "success"))
    bench.place.stream_at("points", "h", 1, "t")
    assert bench.run(0.0) == [Raised("r", "seen", {})] and bench.wanted == ["points"]
    assert child.got[-2:] == [flat(Answered("r/1", "success")), [STREAM_AT, "points", "h", 1, "t"]]


@pytest.mark.parametrize("answers", [False, True])
def test_a_run_that_does_not_end_at_its_deadline(answers: bool) -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    begun = bench.clock.now
    bench.begin(deadline=1.0)
    bench.run(1.0)
    assert (
        actions.orders()[-1] == Stop("r", "deadline", "not over after 1 s")
        and actions.got[-1][0] == PING
    )
    if answers:
        actions.say([PONG, 1])
    bench.run(SILENT + 0.01)
    assert ([COMMAND, "halt", "halt"] in driver.got) == (not answers), "the device is stopped first"
    patience = GRACE + STOP_LIMIT + MARGIN if answers else GRACE
    bench.run(patience - SILENT - 0.03)
    assert not actions.killed
    bench.run(0.05)
    assert bool(actions.killed)
    actions.die()
    assert [c for c in driver.got if c[0] == COMMAND][-1][2] == "halt"
    assert bench.run(0.0) == [], "a run ends when its device stands still, not before"
    driver.say(flat(Told("halt1", "stopped")))
    bench.run(0.0)
    end = bench.ended()
    assert (end.cause, end.executed) == ("deadline", "yes") and "its process was killed" in end.text
    assert end.seconds == pytest.approx(bench.clock.now - begun, abs=0.1)


@pytest.mark.parametrize("stops", [True, False])
def test_a_dead_worker(stops: bool) -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    actions.die()
    if stops:
        driver.say(flat(Told("halt1", "stopped")))
    bench.run(STOP_LIMIT + MARGIN + 0.01)
    end = bench.ended()
    assert (end.cause, end.executed) == ("worker_died", "unknown") and "SIGTEST" in end.text
    assert ("not known to stand still" in end.text) == (not stops)
    assert len(bench.children) == 3 and not driver.killed, (
        "only the actions' process is started again"
    )
    bench.children[-1].ready()
    bench.begin("next")
    assert bench.children[-1].orders() == [Begin("next", "act", {}, None)]


def test_a_dead_driver_takes_the_actions_with_it() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    driver.die()
    assert actions.killed
    actions.die()
    bench.run(1.0)
    assert (bench.ended().cause, bench.ended().executed) == ("device_died", "unknown")
    new_driver, _ = bench.cyclic()
    assert new_driver is not driver and bench.place.ready


def test_one_that_keeps_dying_is_started_more_and_more_slowly() -> None:
    bench = Bench("")
    starts = [bench.clock.now]
    for _ in range(6):
        bench.children[-1].die()
        count = len(bench.children)
        limit = Limit("a new child", steps=100)
        while len(bench.children) == count and limit.left():
            due = bench.place.due()
            assert due is not None
            bench.clock.now = max(bench.clock.now, due)
            bench.place.advance(bench.clock.now)
        starts.append(bench.clock.now)
    pauses = [b - a for a, b in pairwise(starts)]
    assert pauses == sorted(pauses) and pauses[0] == 0.0 and pauses[-1] >= 4.0


def test_a_call_waits_for_a_starting_process_but_not_for_ever() -> None:
    bench = Bench()
    bench.children[0].say([FAILED, "no bus"])
    bench.begin("short", 1.0)
    bench.begin("long")
    bench.run(1.1)
    assert bench.ended("short").executed == "no"
    bench.run(NOT_READY)
    assert (bench.ended("long").cause, bench.ended("long").executed) == ("not_ready", "no")
    assert "no bus" in bench.ended("long").text


def test_hold_reaches_device_and_runs_and_moves_deadlines() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin(deadline=1.0)
    bench.place.command(bench.clock.now, "h", "hold")
    assert driver.got[-1] == [COMMAND, "h", "hold"]
    driver.say(flat(Told("h", "held")))
    assert actions.orders()[-1] == Hold(True)
    assert [type(r) for r in bench.run(10.0)] == [Told], (
        "the deadline does not pass while it is held"
    )
    bench.place.command(bench.clock.now, "r", "release")
    assert actions.orders()[-1] == Hold(False)
    bench.run(0.9)
    assert not [o for o in actions.orders() if isinstance(o, Stop)]
    bench.run(0.2)
    assert [o.cause for o in actions.orders() if isinstance(o, Stop)] == ["deadline"]


def test_a_device_that_cannot_hold_goes_on() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.place.command(bench.clock.now, "h", "hold")
    driver.say(flat(Told("h", "cannot hold")))
    assert not [o for o in actions.orders() if isinstance(o, Hold)]


def test_stop_by_command() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    bench.place.command(bench.clock.now, "s", "stop")
    assert driver.got[-1] == [COMMAND, "s", "stop"]
    assert actions.orders()[-1] == Stop("r", "stopped", "by command")


def test_closing_lets_all_children_go() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.place.close(bench.clock.now)
    assert driver.left and actions.left
    bench.run(60.0)
    assert len(bench.children) == 2


class Storm:
    """A place under any order of what may happen to it, with the books of its runs and of its
    processes."""

    def __init__(self, kind: str) -> None:
        self.bench = Bench("" if kind == "none" else "arm")
        self.kind = kind
        self.begun: list[str] = []
        self.ready_children: set[int] = set()

    def living(self) -> list[FakeChild]:
        return [child for child in self.bench.children if not child.dead]

    def make_ready(self, child: FakeChild) -> None:
        """As a real one: once, while it lives and its pipe is open."""
        if not child.dead and not child.closed and id(child) not in self.ready_children:
            self.ready_children.add(id(child))
            child.ready(0.004 if self.kind == "cyclic" and not child.linked else None)

    def happen(self, act: str) -> None:
        bench, now = self.bench, self.bench.clock.now
        living, dead = self.living(), [child for child in self.bench.children if child.dead]
        drivers = [child for child in living if not child.linked]
        workers = [child for child in living if child.linked or self.kind != "cyclic"]
        newest = f"r{len(self.begun) - 1}"
        if act == "begin":
            self.begun.append(f"r{len(self.begun)}")
            bench.begin(self.begun[-1], 1.0)
        elif act == "ready" and living:
            self.make_ready(living[-1])
        elif act == "driver dies" and drivers:
            drivers[-1].die()
        elif act == "nothing begun":
            for child in living:
                child.begun = 0
        elif act == "actions die" and workers:
            workers[-1].die()
        elif act == "link lost" and workers:
            workers[-1].die(LINK_LOST)
        elif act == "end" and workers:
            had = [o.id for o in workers[-1].orders() if isinstance(o, Begin)]
            if newest in had:
                workers[-1].say(flat(Ended(newest, "success")))
        elif act == "no memory" and workers:
            workers[-1].say(flat(Ended(newest, "error", {}, "out_of_memory")))
        elif act == "late words":
            for child in dead:
                child.ready(0.004)
                child.ready()
                child.say(flat(Ended(newest, "success")))
                child.say([FAILED, "long ago"])
        elif act == "garbage" and living:
            living[-1].say(["nothing", 1])
            living[-1].say([])
        elif act == "failed" and living:
            living[-1].say([FAILED, "no bus"])
            living[-1].die(0)
        elif act == "stop":
            bench.place.take(now, Stop(newest))
        elif act in ("hold", "release", "status", EMERGENCY_STOP):
            bench.place.command(now, act, act)
            for child in living:
                if [COMMAND, act, act] in child.got:
                    child.say(flat(Told(act, "held" if act == "hold" else "done")))
        elif act == "halted" and drivers:
            drivers[-1].say(flat(Told("halt1", "stopped")))
        elif act == "wait":
            bench.run(1.5)
        bench.run(0.0)

    def kill_the_killed(self) -> None:
        for child in self.living():
            if child.killed or child.left:
                child.die()

    def settle(self) -> None:
        """Time passes: what was killed dies, what was started becomes ready, and devices answer."""
        self.bench.place.command(self.bench.clock.now, "end of hold", "release")
        for _ in range(20):
            self.kill_the_killed()
            for child in self.living():
                self.make_ready(child)
            self.bench.run(2.0)

    def ends_well(self) -> None:
        """It is ready, takes a run, and every run that it has taken has ended once."""
        self.settle()
        place = self.bench.place
        assert place.ready and place.condition == ("up", ""), (place.stage, place.condition)
        wanted = {"actions", "driver"} if self.kind == "cyclic" else {"actions"}
        assert set(place.pids()) == wanted and len(self.living()) == len(wanted)
        self.bench.begin("last", 1.0)
        worker = self.living()[-1]
        assert Begin("last", "act", {}, 1.0) in worker.orders()
        worker.say(flat(Ended("last", "success")))
        self.bench.run(30.0)
        ends = [report.id for report in self.bench.reports if isinstance(report, Ended)]
        assert sorted(ends) == sorted([*self.begun, "last"])


ACTS = (
    *(
        "begin",
        "ready",
        "driver dies",
        "actions die",
        "late words",
        "end",
        "stop",
        "wait",
        "link lost",
    ),
    *(
        "no memory",
        "garbage",
        "failed",
        "nothing begun",
        "hold",
        "release",
        "status",
        EMERGENCY_STOP,
        "halted",
    ),
)


@settings(max_examples=300, deadline=None)
@given(
    kind=st.sampled_from(["cyclic", "device", "none"]),
    acts=st.lists(st.sampled_from(ACTS), max_size=30),
)
def test_whatever_happens_it_is_ready_again_and_every_run_ends_once(
    kind: str, acts: list[str]
) -> None:
    storm = Storm(kind)
    for act in acts:
        storm.happen(act)
    storm.ends_well()


@pytest.mark.parametrize("kind", ["cyclic", "device", "none"])
def test_every_order_of_deaths_and_starts_ends_well(kind: str) -> None:
    """All sequences of five of the acts that move the place from one stage to another."""
    for acts in product(
        ("begin", "ready", "driver dies", "actions die", "late words", "wait"), repeat=5
    ):
        storm = Storm(kind)
        for act in acts:
            storm.happen(act)
        storm.ends_well()


def test_every_stage_can_be_reached_and_left_by_the_table() -> None:
    reached = {Stage.DOWN, *NEXT.values()}
    assert reached == set(Stage)
    for stage in set(Stage) - {Stage.CLOSED}:
        assert {happening for at, happening in NEXT if at is stage} > {Happening.CLOSE}, stage
    waiting = {Stage.DRIVER_STARTS, Stage.ACTIONS_START, Stage.ACTIONS_DOWN, Stage.READY}
    assert all(NEXT[stage, Happening.ALL_ENDED] is Stage.DOWN for stage in waiting)


@pytest.mark.parametrize("stopped", [False, True])
def test_a_run_that_a_dead_process_had_not_begun_waits_for_the_next_one(stopped: bool) -> None:
    bench = Bench("")
    bench.children[0].ready()
    bench.begin("begun")
    bench.begin("not begun")
    if stopped:
        bench.place.take(bench.clock.now, Stop("not begun"))
    bench.children[0].begun = 1
    bench.children[0].die()
    ends = {r.id: (r.cause, r.executed) for r in bench.run(1.0) if isinstance(r, Ended)}
    assert ends == {"begun": ("worker_died", "unknown")} | (
        {"not begun": ("cancelled", "no")} if stopped else {}
    )
    bench.children[1].ready()
    bench.run(0.0)
    begins = [order.id for order in bench.children[1].orders() if isinstance(order, Begin)]
    assert begins == ([] if stopped else ["not begun"])


def test_the_end_of_a_former_process_does_not_touch_the_present_one() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    driver.die()
    bench.run(0.0)
    new_driver, new_actions = bench.cyclic()
    assert {driver, actions}.isdisjoint({new_driver, new_actions})
    actions.die()
    actions.ready()
    bench.run(0.0)
    assert bench.place.ready and set(bench.place.pids()) == {"actions", "driver"}
    assert len(bench.children) == 4


def test_status_says_what_the_place_is_doing() -> None:
    def status() -> Told:
        bench.place.command(bench.clock.now, "s", "status")
        for child in bench.children:
            if not child.dead and [COMMAND, "s", "status"] in child.got:
                child.got.clear()
                child.say(flat(Told("s", "up")))
        (told,) = [r for r in bench.run(0.0) if isinstance(r, Told)]
        return told

    bench = Bench()
    assert status().answer == "starting"
    driver, actions = bench.cyclic()
    assert status().answer == "up"
    actions.die()
    assert (status().answer, "SIGTEST" in status().data["text"]) == ("restarting", True)
    bench.children[-1].ready()
    assert status().answer == "up"
    driver.die()
    assert (status().answer, "driver" in status().data["text"]) == ("restarting", True)
    bench.run(PAUSES[1])
    bench.children[-1].say([FAILED, "no bus"])
    bench.children[-1].die(0)
    assert (status().answer, status().data["text"]) == ("failed", "no bus")


def test_a_process_that_never_becomes_ready_is_killed_and_started_again() -> None:
    bench = Bench()
    bench.run(START_LIMIT - 0.1)
    assert [child.killed for child in bench.children] == [False]
    bench.run(0.2)
    assert [child.killed for child in bench.children] == [True]
    bench.children[0].die()
    bench.run(1.0)
    assert len(bench.children) == 2


def test_a_command_is_answered_although_its_process_dies() -> None:
    bench = Bench()
    bench.cyclic()
    bench.place.command(bench.clock.now, "p", "picture")
    bench.children[0].die()
    assert [(r.id, r.answer) for r in bench.run(0.0) if isinstance(r, Told)] == [("p", "not ready")]
