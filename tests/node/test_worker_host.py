"""How a node watches its processes: which messages each one gets, when a hanging one is killed, and
that every run ends once."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from itertools import pairwise, product
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.comm.protocol.messages import (
    Answer,
    Call,
    Cancel,
    Command,
    Event,
    Outcome,
    Ping,
    Pong,
)
from petrobot.services.node.emergency_stops import BEAT_EVERY
from petrobot.services.node.inline_host import HOLD, RELEASE, answer_of
from petrobot.services.node.worker_host import (
    HUNG,
    MARGIN,
    NEXT,
    NOT_READY,
    PAUSES,
    SILENT,
    START_LIMIT,
    HostEvent,
    Hosting,
    HostStage,
    WorkerHost,
)
from petrobot.services.node.worker_pool import WorkerPool
from petrobot.services.worker.pipe import Item, NewestLink
from petrobot.services.worker.process import (
    FAILED,
    LINK_LOST,
    READY,
    STREAM_AT,
    WANTED,
    Setup,
)
from petrobot.services.worker.remote import EMERGENCY_STOP
from petrobot.services.worker.runner import GRACE, STOP_LIMIT, Order
from tests.node.conftest import Clock
from tests.waiting import Limit


class FakeChild:
    """A child process that is played by the test."""

    def __init__(
        self,
        setup: Setup,
        heard: Callable[[Any, list[Item]], None],
        ended: Callable[[Any], None],
        link: Any,
    ) -> None:
        self.setup = setup
        self._heard = heard
        self._ended = ended
        self.code: int | None = None
        self.last_word = b""
        self.closed = self.dead = False
        self.begun = 1 << 30
        """How many of its runs it reports as begun; by default all."""
        self.given = 0
        self.link = link
        self.linked = link is not None
        self._drop(link)
        self.pid = 1 + id(self) % 10_000
        self.got: list[Any] = []
        self.passed: list[socket.socket] = []
        self.killed = self.left = self.unsent = self.frozen = False

    def say(self, item: Item) -> None:
        self._heard(self, [item])

    def post(self, item: Item) -> None:
        self.got.append(item)

    def give(self, call: Call) -> None:
        self.given += 1
        self.post(call)

    def not_begun(self) -> int:
        return max(0, self.given - self.begun)

    def take_back(self) -> int:
        count = self.not_begun()
        self.given -= count
        return count

    def words(self) -> list[Any]:
        """Return the messages to it that are not messages of the node protocol."""
        return [item for item in self.got if isinstance(item, list)]

    def commands(self) -> list[Command]:
        """Return the commands that it got."""
        return [item for item in self.got if isinstance(item, Command)]

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

    def die(self, code: int = -9, last_word: bytes = b"") -> None:
        self.last_word = last_word
        self.code, self.closed, self.dead = code, True, True
        self._ended(self)

    def ready(self, period: float | None = None, **streams: tuple[str, int]) -> None:
        self.say([READY, {"period": period, "streams": streams, "fifo": False}])

    def orders(self) -> list[Order]:
        """Return the messages about runs that it got."""
        orders = (Call, Cancel, Outcome)
        return [item for item in self.got if isinstance(item, orders) or item in (HOLD, RELEASE)]


class KeepingChild(FakeChild):
    """A child process that keeps its ends of sockets open."""

    def _drop(self, end: socket.socket | None) -> None: ...


class HostBench:
    """A worker host with fake processes and a simulated clock."""

    place: WorkerHost | WorkerPool

    def __init__(self, device: str, child: type[FakeChild] = FakeChild) -> None:
        self.child = child
        self.clock = Clock(100.0)
        self.children: list[FakeChild] = []
        self.wanted: list[str] = []
        self.reports: list[Any] = []
        self.deadlines: dict[str, float] = {}
        """Deadline of each run (s). A node watches deadlines; here the bench does."""
        setup = Setup("services.toml", "", "node", device)
        self.hosting = Hosting(
            setup, self.clock, lambda plain_ends: None, self.wanted.append, spawn=self._spawn
        )

    def _spawn(self, *arguments: Any) -> Any:
        self.children.append(self.child(*arguments))
        return self.children[-1]

    def begin(self, identity: str = "r", deadline: float | None = None) -> None:
        if deadline is not None:
            self.deadlines[identity] = self.clock.now + deadline
        self.place.take(self.clock.now, Call(identity, "act", {}, deadline))

    def _stop_late(self) -> None:
        for run, due in list(self.deadlines.items()):
            if self.clock.now >= due:
                del self.deadlines[run]
                self.place.take(self.clock.now, Cancel(run, "deadline: late"))

    def run(self, seconds: float = 0.0) -> list[Any]:
        """Advance the host exactly when it is due, as the node's shell does."""
        until, fresh = self.clock.now + seconds, []
        limit = Limit("nothing more to be due", steps=100_000)
        while limit.left():
            self._stop_late()
            self.place.advance(self.clock.now)
            fresh += self.place.reports()
            due = min([self.place.due() or math.inf, *self.deadlines.values()])
            if due > until:
                break
            self.clock.now = max(due, self.clock.now + 1e-6)
        self.clock.now = max(until, self.clock.now)
        self.reports += fresh
        return fresh


class Bench(HostBench):
    """The worker host of one device, with fake processes."""

    place: WorkerHost

    def __init__(self, device: str = "arm", child: type[FakeChild] = FakeChild) -> None:
        super().__init__(device, child)
        self.place = WorkerHost(self.hosting)
        self.place.start()

    def cyclic(self) -> tuple[FakeChild, FakeChild]:
        """Start driver and actions of a cyclic device."""
        self.children[-1].ready(0.004, points=("10.0.0.1", 4711))
        self.children[-1].ready()
        return self.children[-2], self.children[-1]

    def ended(self, identity: str = "r") -> Outcome:
        (end,) = [r for r in self.reports if isinstance(r, Outcome) and r.id == identity]
        return end


def test_a_device_without_cycle_has_one_process() -> None:
    bench = Bench()
    (child,) = bench.children
    assert (child.setup.device, bool(bench.place.ready)) == ("arm", False)
    bench.begin()
    assert child.orders() == []
    child.ready()
    assert bench.place.ready and child.orders() == [Call("r", "act", {}, None)]
    child.say(Outcome("r", "success", {"x": 1}))
    bench.run(0.0)
    assert bench.ended().values == {"x": 1} and bench.place.pids() == {"actions": child.pid}


def test_a_cyclic_device_has_two_with_a_link_between_them() -> None:
    bench = Bench(child=KeepingChild)
    driver, actions = bench.cyclic()
    assert bench.place.streams == {"points": ("10.0.0.1", 4711)} and set(bench.place.pids()) == {
        "actions",
        "driver",
    }
    near, far = NewestLink(driver.passed[0]), NewestLink(actions.link)
    assert near.send([1]) and far.newest() == [1]
    far.close()
    near.close()


def test_messages_of_processes_are_passed_on() -> None:
    bench = Bench("")
    (child,) = bench.children
    child.ready()
    child.say(Event("seen", "act", 0, {}, "r"))
    child.say([WANTED, "points"])
    bench.place.take(0.0, Outcome("r/1", "success"))
    bench.place.stream_at("points", "h", 1, "t")
    assert bench.run(0.0) == [Event("seen", "act", 0, {}, "r")] and bench.wanted == ["points"]
    assert child.got[-2:] == [Outcome("r/1", "success"), [STREAM_AT, "points", "h", 1, "t"]]


@pytest.mark.parametrize("answers", [False, True])
def test_a_run_that_does_not_end_at_its_deadline(answers: bool) -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    begun = bench.clock.now
    bench.begin(deadline=1.0)
    bench.run(1.0)
    assert actions.orders()[-1] == Cancel("r", "deadline: late") and type(actions.got[-1]) is Ping
    if answers:
        actions.say(Pong(actions.got[-1].number))
    bench.run(SILENT + 0.01)
    assert (Command("halt", "halt") in driver.got) == (not answers), "the device is stopped first"
    patience = GRACE + STOP_LIMIT + MARGIN if answers else GRACE
    bench.run(patience - SILENT - 0.03)
    assert not actions.killed
    bench.run(0.05)
    assert bool(actions.killed)
    actions.die()
    assert driver.commands()[-1].verb == "halt"
    assert bench.run(0.0) == [], "a run ends when its device stands still, not before"
    driver.say(answer_of("halt1", "stopped", {}))
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
        driver.say(answer_of("halt1", "stopped", {}))
    bench.run(STOP_LIMIT + MARGIN + 0.01)
    end = bench.ended()
    assert (end.cause, end.executed) == ("worker_died", "unknown") and "SIGTEST" in end.text
    assert ("not known to stand still" in end.text) == (not stops)
    assert len(bench.children) == 3 and not driver.killed, (
        "only the actions' process is started again"
    )
    bench.children[-1].ready()
    bench.begin("next")
    assert bench.children[-1].orders() == [Call("next", "act", {}, None)]


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


def test_a_process_that_keeps_dying_is_restarted_after_growing_pauses() -> None:
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


def test_hold_reaches_device_and_runs() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    bench.place.command(bench.clock.now, Command("h", "hold"))
    assert driver.got[-1] == Command("h", "hold")
    driver.say(answer_of("h", "held", {}))
    assert actions.orders()[-1] == HOLD
    assert [type(r) for r in bench.run(10.0)] == [Answer]
    bench.place.command(bench.clock.now, Command("r", "release"))
    assert actions.orders()[-1] == RELEASE
    bench.run(2.0)
    assert not [o for o in actions.orders() if isinstance(o, Cancel)]


def test_a_hold_that_is_answered_after_its_release_holds_nothing() -> None:
    """Pause and continue reach the node together: before, the run stood still for ever."""
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    bench.place.command(bench.clock.now, Command("h", "hold"))
    bench.place.command(bench.clock.now, Command("r", "release"))
    driver.say(answer_of("h", "held", {}))
    assert HOLD not in actions.orders()


@pytest.mark.parametrize("kind", ["cyclic", "one process"])
def test_a_hold_ends_with_its_run_even_if_it_was_not_read_before(kind: str) -> None:
    bench = Bench()
    if kind == "cyclic":
        holder, actions = bench.cyclic()
    else:
        bench.children[-1].ready()
        holder = actions = bench.children[-1]
    bench.begin("first")
    bench.place.command(bench.clock.now, Command("h", "hold"))
    actions.say(Outcome("first", "success"))
    bench.begin("next")
    told = [item for item in holder.got if isinstance(item, Command) or item == RELEASE]
    assert told == [Command("h", "hold"), RELEASE], "in this order, before the next run"
    holder.say(answer_of("h", "held", {}))
    assert HOLD not in actions.orders()
    bench.begin("third")  # nor does a new process hold it
    actions.die()
    bench.run(5.0)
    assert not any(HOLD in child.orders() for child in bench.children)


def test_a_device_that_cannot_hold_goes_on() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.place.command(bench.clock.now, Command("h", "hold"))
    driver.say(answer_of("h", "cannot hold", {}))
    assert not [o for o in actions.orders() if o == HOLD]


def test_stop_by_command() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.begin()
    bench.place.command(bench.clock.now, Command("s", "stop"))
    assert driver.got[-1] == Command("s", "stop")
    assert actions.orders()[-1] == Cancel("r", "stopped: by command")


def test_closing_ends_all_children() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.place.close(bench.clock.now)
    assert driver.left and actions.left
    bench.run(60.0)
    assert len(bench.children) == 2


def beats(bench: HostBench, seconds: float, *frozen: FakeChild) -> None:
    """Let the node ping its processes meanwhile; all but the frozen ones answer."""
    until = bench.clock.now + seconds
    while bench.clock.now < until:
        bench.run(BEAT_EVERY)
        bench.place.beat(bench.clock.now)
        for child in bench.children:
            pings = [item for item in child.got if isinstance(item, Ping)]
            if pings and not child.dead and child not in frozen:
                child.say(Pong(pings[-1].number))


@pytest.mark.parametrize(
    "run", ["no run", "a run", "a run in a stopped process", "a run that has not begun"]
)
@pytest.mark.parametrize("victim", ["driver", "actions", "only"])
def test_a_process_that_must_answer_and_does_not_is_killed(victim: str, run: str) -> None:
    """All but one in which the code of a run may take long."""
    bench = Bench()
    if victim == "only":
        bench.children[0].ready()
    else:
        bench.cyclic()
    frozen = bench.children[0 if victim == "driver" else -1]
    beats(bench, 10 * HUNG)
    if run != "no run":
        bench.begin()
        bench.children[-1].begun = int(run != "a run that has not begun")
        bench.children[-1].frozen = run == "a run in a stopped process"
    beats(bench, HUNG - 2 * BEAT_EVERY, frozen)
    assert not any(child.killed for child in bench.children)
    beats(bench, 4 * BEAT_EVERY, frozen)
    killed = victim == "driver" or run != "a run"
    assert [child.killed for child in bench.children] == [
        killed and child is frozen for child in bench.children
    ]


def test_a_driver_that_hangs_is_replaced_and_its_successor_stops_the_device() -> None:
    bench = Bench()
    driver, _ = bench.cyclic()
    bench.begin()
    beats(bench, HUNG + 2 * BEAT_EVERY, driver)
    driver.die()
    bench.run(0.0)
    assert (bench.ended().cause, bench.ended().executed) == ("device_died", "unknown")
    bench.cyclic()
    assert bench.children[-2].commands() == [Command("", "stop")] and not driver.commands()
    bench.place.command(bench.clock.now, Command("s", "status"))
    bench.children[-2].say(answer_of("s", "up", {}))
    (status,) = [r for r in bench.run(0.0) if isinstance(r, Answer)]
    assert (status.data["answer"], status.data["restarts"]) == ("up", 1)
    assert status.data["last_death"] == "the process of its driver died: it was ended by SIGTEST"


def test_a_process_that_survives_its_kill_is_killed_again_and_has_no_successor() -> None:
    """Nothing can end a process that hangs in the kernel: its device must not get two drivers."""
    bench = Bench()
    driver, _ = bench.cyclic()
    for _ in range(3):
        driver.killed = False
        beats(bench, HUNG + 2 * BEAT_EVERY, driver)
        assert driver.killed and len(bench.children) == 2


def test_a_driver_with_a_long_period_answers_once_in_a_period() -> None:
    bench = Bench()
    driver = bench.children[0]
    driver.ready(4.0)
    bench.children[-1].ready()
    beats(bench, HUNG + 4.0, driver)
    assert not driver.killed
    beats(bench, 8.0, driver)
    assert driver.killed


def test_a_node_that_stood_still_does_not_kill_its_processes() -> None:
    """What they answered meanwhile is still unread."""
    bench = Bench()
    children = bench.cyclic()
    beats(bench, 1.0)
    for _ in range(10):
        bench.run(2 * HUNG)
        beats(bench, HUNG - 2 * BEAT_EVERY, *children)
    assert not any(child.killed for child in children)


def test_a_process_that_is_being_started_need_not_answer() -> None:
    bench = Bench()
    beats(bench, START_LIMIT - 1.0, *bench.children)
    assert not any(child.killed for child in bench.children)
    bench.children[0].ready(0.004)
    actions = bench.children[-1]
    beats(bench, START_LIMIT - 1.0, actions)
    assert not any(child.killed for child in bench.children)


def test_an_answer_to_an_earlier_ping_does_not_say_that_a_run_was_told_to_stop() -> None:
    bench = Bench()
    driver, actions = bench.cyclic()
    bench.place.beat(bench.clock.now)
    before = actions.got[-1].number
    bench.begin(deadline=1.0)
    bench.run(1.0)
    actions.say(Pong(before))
    driver.say(Pong(before + 100))
    bench.run(SILENT + 0.01)
    assert Command("halt", "halt") in driver.got


class Storm:
    """A worker host under events in any order, with a record of its runs and its processes."""

    def __init__(self, kind: str) -> None:
        self.bench = Bench("" if kind == "none" else "arm")
        self.kind = kind
        self.begun: list[str] = []
        self.ready_children: set[int] = set()

    def living(self) -> list[FakeChild]:
        return [child for child in self.bench.children if not child.dead]

    def make_ready(self, child: FakeChild) -> None:
        """Report ready as a real process does: once, while it lives and its pipe is open."""
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
            workers[-1].die(1, LINK_LOST)
        elif act == "end" and workers:
            had = [o.id for o in workers[-1].orders() if isinstance(o, Call)]
            if newest in had:
                workers[-1].say(Outcome(newest, "success"))
        elif act == "no memory" and workers:
            workers[-1].say(Outcome(newest, "error", {}, "out_of_memory"))
        elif act == "late words":
            for child in dead:
                child.ready(0.004)
                child.ready()
                child.say(Outcome(newest, "success"))
                child.say([FAILED, "long ago"])
        elif act == "garbage" and living:
            living[-1].say(["nothing", 1])
            living[-1].say([])
        elif act == "failed" and living:
            living[-1].say([FAILED, "no bus"])
            living[-1].die(0)
        elif act == "stop":
            bench.place.take(now, Cancel(newest))
        elif act in ("hold", "release", "status", EMERGENCY_STOP):
            bench.place.command(now, Command(act, act))
            for child in living:
                if Command(act, act) in child.got:
                    child.say(answer_of(act, "held" if act == "hold" else "done", {}))
        elif act == "halted" and drivers:
            drivers[-1].say(answer_of("halt1", "stopped", {}))
        elif act == "wait":
            bench.run(1.5)
        elif act == "beats":
            self.beat(2.0)
        bench.run(0.0)

    def beat(self, seconds: float) -> None:
        """Let time pass; a process that begins nothing is frozen, which pings show."""
        if frozen := [child for child in self.living() if child.begun == 0]:
            beats(self.bench, seconds, *frozen)
        else:
            self.bench.run(seconds)

    def kill_the_killed(self) -> None:
        for child in self.living():
            if child.killed or child.left:
                child.die()

    def settle(self) -> None:
        """Let time pass: killed processes die, started ones become ready, and devices answer."""
        self.bench.place.command(self.bench.clock.now, Command("end of hold", "release"))
        for _ in range(20):
            self.kill_the_killed()
            for child in self.living():
                self.make_ready(child)
            self.beat(2.0)

    def ends_well(self) -> None:
        """Check that the host is ready and accepts a run, and that each accepted run has ended
        once."""
        self.settle()
        place = self.bench.place
        assert place.ready and place.condition == ("up", ""), (place.stage, place.condition)
        wanted = {"actions", "driver"} if self.kind == "cyclic" else {"actions"}
        assert set(place.pids()) == wanted and len(self.living()) == len(wanted)
        self.bench.begin("last", 1.0)
        worker = self.living()[-1]
        assert Call("last", "act", {}, 1.0) in worker.orders()
        worker.say(Outcome("last", "success"))
        self.bench.run(30.0)
        ends = [report.id for report in self.bench.reports if isinstance(report, Outcome)]
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
        "beats",
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
def test_after_any_events_it_is_ready_again_and_every_run_ends_once(
    kind: str, acts: list[str]
) -> None:
    storm = Storm(kind)
    for act in acts:
        storm.happen(act)
    storm.ends_well()


@pytest.mark.once
@pytest.mark.parametrize("kind", ["cyclic", "device", "none"])
def test_every_order_of_deaths_and_starts_ends_well(kind: str) -> None:
    """All sequences of four of the events that move the host from one stage to another."""
    for acts in product(
        ("begin", "ready", "driver dies", "actions die", "late words", "wait"), repeat=4
    ):
        storm = Storm(kind)
        for act in acts:
            storm.happen(act)
        storm.ends_well()


def test_every_stage_can_be_entered_and_left_by_the_table() -> None:
    reached = {HostStage.DOWN, *NEXT.values()}
    assert reached == set(HostStage)
    for stage in set(HostStage) - {HostStage.CLOSED}:
        assert {happening for at, happening in NEXT if at is stage} > {HostEvent.CLOSE}, stage
    waiting = {
        HostStage.DRIVER_STARTS,
        HostStage.ACTIONS_START,
        HostStage.ACTIONS_DOWN,
        HostStage.READY,
    }
    assert all(NEXT[stage, HostEvent.ALL_ENDED] is HostStage.DOWN for stage in waiting)


@pytest.mark.parametrize("stopped", [False, True])
def test_a_run_that_a_dead_process_had_not_begun_waits_for_the_next_one(stopped: bool) -> None:
    bench = Bench("")
    bench.children[0].ready()
    bench.begin("begun")
    bench.begin("not begun")
    if stopped:
        bench.place.take(bench.clock.now, Cancel("not begun"))
    bench.children[0].begun = 1
    bench.children[0].die()
    ends = {r.id: (r.cause, r.executed) for r in bench.run(1.0) if isinstance(r, Outcome)}
    assert ends == {"begun": ("worker_died", "unknown")} | (
        {"not begun": ("cancelled", "no")} if stopped else {}
    )
    bench.children[1].ready()
    bench.run(0.0)
    begins = [order.id for order in bench.children[1].orders() if isinstance(order, Call)]
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


def test_status_describes_the_stage() -> None:
    def status() -> Answer:
        bench.place.command(bench.clock.now, Command("s", "status"))
        for child in bench.children:
            if not child.dead and Command("s", "status") in child.got:
                child.got.clear()
                child.say(answer_of("s", "up", {}))
        (told,) = [r for r in bench.run(0.0) if isinstance(r, Answer)]
        return told

    bench = Bench()
    assert status().data["answer"] == "starting"
    driver, actions = bench.cyclic()
    assert status().data["answer"] == "up"
    actions.die()
    assert (status().data["answer"], "SIGTEST" in status().data["text"]) == ("restarting", True)
    bench.children[-1].ready()
    assert status().data["answer"] == "up"
    driver.die()
    assert (status().data["answer"], "driver" in status().data["text"]) == ("restarting", True)
    bench.run(PAUSES[1])
    bench.children[-1].say([FAILED, "no bus"])
    bench.children[-1].die(0)
    assert (status().data["answer"], status().data["text"]) == ("failed", "no bus")


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
    bench.place.command(bench.clock.now, Command("p", "picture"))
    bench.children[0].die()
    assert [(r.id, r.data["answer"]) for r in bench.run(0.0) if isinstance(r, Answer)] == [
        ("p", "not ready")
    ]
