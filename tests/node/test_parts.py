"""The small machines of a node: global memory, timers, outlets, set points, remote drivers, pipes,
scripts."""

from __future__ import annotations

import asyncio
import math
import os
import select
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from petrobot.services.action import Context, Result, Status, failure, provisional, success
from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.protocol.messages import (
    Answer,
    Call,
    Cancel,
    Command,
    Executed,
    Outcome,
)
from petrobot.services.device import Driver
from petrobot.services.host.parent_death import until_ended
from petrobot.services.node import memory as memory_module
from petrobot.services.node.inline_host import HOLD, InlineHost, answer_of
from petrobot.services.node.memory import GlobalMemory, event_name
from petrobot.services.node.node import EventTimers
from petrobot.services.rehearsal import StillRunningError, rehearse
from petrobot.services.scripted import ScriptError, load
from petrobot.services.worker.device_process import LINKED, DeviceLoop
from petrobot.services.worker.outlets import Outlets, Sent
from petrobot.services.worker.pipe import (
    MALFORMED,
    NewestLink,
    Permits,
    Pipe,
    link_pair,
    permit_counter,
)
from petrobot.services.worker.remote import CyclicDriver, DeviceCommand, RemoteDriver
from petrobot.services.worker.setpoints import SetpointReceiver
from tests.node.conftest import Clock
from tests.waiting import Limit

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


# --- global memory ----------------------------------------------------------------------------


class MemoryMachine(RuleBasedStateMachine):
    """The memory against a dictionary of (value, version), in any order of calls."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[str, Any, int]] = []
        self.memory = GlobalMemory(
            lambda name, value, version: self.told.append((name, value, version))
        )
        self.model: dict[str, tuple[Any, int]] = {}
        self.writes = 0

    def _wrote(self, name: str, value: Any) -> None:
        self.model[name] = (value, self.model.get(name, (None, 0))[1] + 1)
        self.writes += 1
        assert self.told[-1] == (name, *self.model[name])

    @rule(name=st.sampled_from("abc"), value=PLAIN)
    def put(self, name: str, value: Any) -> None:
        result = self.memory.call("memory.put", {"name": name, "value": value})
        self._wrote(name, value)
        assert result.values == {"version": self.model[name][1]}

    @rule(name=st.sampled_from("abc"), version=st.integers(0, 4), value=PLAIN)
    def compare_and_set(self, name: str, version: int, value: Any) -> None:
        current = self.model.get(name, (None, 0))
        result = self.memory.call(
            "memory.compare_and_set", {"name": name, "version": version, "value": value}
        )
        if version == current[1]:
            self._wrote(name, value)
            assert result.status is Status.SUCCESS
        else:
            assert (result.status, result.cause) == (Status.FAILURE, "changed")
            assert (result.values["value"], result.values["version"]) == current

    @rule(name=st.sampled_from("abc"))
    def get(self, name: str) -> None:
        value, version = self.model.get(name, (None, 0))
        assert self.memory.call("memory.get", {"name": name}).values == {
            "value": value,
            "version": version,
        }

    @invariant()
    def every_change_is_told_once(self) -> None:
        assert len(self.told) == self.writes
        listed = self.memory.call("memory.list", {}).values["versions"]
        assert listed == {name: version for name, (_, version) in sorted(self.model.items())}


TestMemory = MemoryMachine.TestCase
TestMemory.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


@pytest.mark.parametrize(
    ("service", "arguments", "cause", "says"),
    [
        ("memory.get", {}, "bad_arguments", "name"),
        ("memory.get", {"name": ""}, "bad_arguments", "give a text of 1 to 200 characters"),
        ("memory.get", {"name": 3}, "bad_arguments", "give a text"),
        ("memory.put", {"name": "x"}, "bad_arguments", "value"),
        ("memory.put", {"name": "x", "value": 1, "force": True}, "bad_arguments", "force"),
        (
            "memory.compare_and_set",
            {"name": "x", "version": "1", "value": 1},
            "bad_arguments",
            "memory.get returned",
        ),
        ("memory.put", {"name": "x", "value": bytes(1 << 21)}, "too_large", "the limit is 1048576"),
    ],
)
def test_the_memory_refuses(service: str, arguments: dict[str, Any], cause: str, says: str) -> None:
    result = GlobalMemory(lambda *_: None).call(service, arguments)
    assert (result.status, result.cause) == (Status.ERROR, cause) and says in result.text


def test_the_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_module, "VARIABLES", 3)
    monkeypatch.setattr(memory_module, "TOTAL_BYTES", 1000)
    memory = GlobalMemory(lambda *_: None)
    for name in "abc":
        assert (
            memory.call("memory.put", {"name": name, "value": bytes(300)}).status is Status.SUCCESS
        )
    assert memory.call("memory.put", {"name": "d", "value": 1}).cause == "memory_full"
    assert memory.call("memory.put", {"name": "a", "value": bytes(600)}).cause == "memory_full"
    assert memory.call("memory.put", {"name": "a", "value": bytes(200)}).values == {"version": 2}
    assert event_name("a") == "memory:a"


# --- timers, outlets, set points --------------------------------------------------------------


@given(
    period=st.floats(0.004, 1.0),
    steps=st.lists(st.floats(0.001, 0.5), min_size=1, max_size=60),
)
def test_timers_lie_on_an_absolute_grid(period: float, steps: list[float]) -> None:
    timers, now, fired = EventTimers({"beat": period}), 10.0, 0
    timers.advance(now)
    for step in steps:
        now += step
        fired += len(timers.advance(now))
        due = timers.due()
        assert due is not None and now < due + 1e-5 <= now + period + 2e-5
        assert math.isclose((due - 10.0) / period, round((due - 10.0) / period), abs_tol=1e-4), (
            "it left its grid"
        )
    assert fired <= (now - 10.0) / period + 1e-3, "a pulse too many"
    if max(steps) < period:
        assert fired == math.floor((now - 10.0) / period + 1e-6) or math.isclose(
            (now - 10.0) / period, round((now - 10.0) / period), abs_tol=1e-3
        )


def test_timers_that_there_are_none_of() -> None:
    timers = EventTimers({})
    assert timers.advance(1.0) == [] and timers.due() is None


@settings(max_examples=40, deadline=None)
@given(
    publications=st.lists(st.tuples(st.integers(0, 100), st.booleans()), max_size=30),
    period_ticks=st.integers(1, 10),
)
def test_an_outlet_sends_the_newest_at_most_once_a_period(
    publications: list[tuple[int, bool]], period_ticks: int
) -> None:
    period, outlets = 0.004 * period_ticks, Outlets({"s": 0.004 * period_ticks})
    at = dict(publications)
    newest: tuple[float, float] | None = None
    times: list[float] = []
    for tick in range(120):
        now = 0.004 * tick
        if tick in at:
            if at[tick]:
                outlets.publish(now, "run", "s", [float(tick)])
                newest = (float(tick), now)
            else:
                outlets.withdraw("s")
                newest = None
        for sent in outlets.advance(now):
            assert newest is not None
            assert sent == Sent("run", "s", (newest[0],), max(0.0, now - newest[1]))
            times.append(now)
        due = outlets.due()
        assert (due is None) == (newest is None)
        assert due is None or due > now - 1e-5
    assert all(b - a >= period - 2e-3 for a, b in pairwise(times))
    outlets.publish(1.0, "run", "s", [1.0])
    outlets.withdraw("s", "other run")
    assert outlets.due() is not None
    outlets.close("run")
    assert outlets.due() is None


def test_a_set_point_ages_and_goes_stale() -> None:
    clock = Clock()
    point = SetpointReceiver(0.02, clock)
    assert (point.values, point.age, point.held, point.count) == (None, math.inf, math.inf, 0)
    clock.now = 1.0
    point.take([1.0, 2.0], held=0.015)
    clock.now = 1.06
    assert (point.values, round(point.age, 6), round(point.held, 6)) == ((1.0, 2.0), 0.06, 0.075)
    clock.now = 1.061
    assert (point.values, round(point.age, 6)) == (None, 0.061)
    point.take([3.0, 4.0])
    assert (point.values, point.held, point.count) == ((3.0, 4.0), 0.0, 2)
    point.withdraw()
    assert (point.values, point.count) == (None, 2)


# --- remote driver ----------------------------------------------------------------------------


class Stub(Driver):
    """A driver that writes down what it is told."""

    period: float | None = 0.004

    def __init__(self) -> None:
        self.log: list[Any] = []
        self.moving = False

    def command(self, now: float, body: Any) -> None:
        self.log.append(body)
        if "bad" in body:
            raise ValueError("no")
        self.moving = True

    def step(self, now: float) -> None:
        self.log.append("step")

    def state(self) -> dict[str, Any]:
        return {"n": len(self.log)}

    def stop(self, now: float) -> None:
        self.moving = False

    def stopped(self) -> bool:
        return not self.moving

    def hold(self, now: float) -> str:
        return "held"

    def release(self, now: float) -> None: ...

    def close(self) -> None: ...


def test_commands_are_numbered_taken_in_order_and_answered_for() -> None:
    clock, posted, driver = Clock(), list[DeviceCommand](), Stub()
    remote, cyclic = RemoteDriver(posted.append, clock), CyclicDriver(driver)
    assert remote.age == math.inf and not remote.stopped() and remote.state == {}
    assert (remote.send({"a": 1}), remote.send({"bad": 1})) == (1, 2)
    remote.take(cyclic.state())
    assert not remote.stopped(), "a state from before the commands says nothing about them"
    for command in posted:
        cyclic.take(0.0, command)
    clock.now = 0.5
    remote.take(cyclic.step(0.5))
    assert (remote.handled, remote.refused, remote.state, remote.age) == (2, "no", {"n": 3}, 0.0)
    assert not remote.stopped()
    remote.stop(0.5)
    assert not remote.stopped()
    cyclic.take(0.5, posted[-1])
    remote.take(cyclic.step(0.504))
    assert remote.stopped() and remote.handled == 3
    cyclic.forget()
    assert cyclic.state().handled == 0
    with pytest.raises(TypeError, match=r"command\.x"):
        remote.send({"x": object()})


# --- pipes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "what",
    [
        Call("r", "act", {"a": [1, {"b": b"x"}]}, 1.5, seed=3),
        Cancel("r", "deadline: late"),
        Outcome("r/1", "success", {"x": 1}),
        HOLD,
        Outcome("r", "error", {}, "lost", "text", Executed.NO, 0.5, 0.1),
        answer_of("c", "held", {"q": [0.0]}),
    ],
)
def test_messages_cross_a_socket(what: Any) -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    a.post(what)
    assert b.read() == [what]
    a.close()
    assert b.read() == [] and b.closed
    b.close()


@pytest.mark.parametrize("items", [[4, 1], [999, "x"], [True], [7, "r", "success", {}, "", "", 1]])
def test_a_list_that_is_no_message_becomes_a_word_after_what_came_before(items: list[Any]) -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    a.post(["before"])
    a.post(items)
    first, word = b.read()
    assert first == ["before"] and isinstance(word, list) and word[0] == MALFORMED
    a.close()
    b.close()


def test_a_pipe_keeps_what_does_not_fit() -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    for n in range(40):
        a.post(["n", n, bytes(100_000)])
    assert bool(a.unsent)
    got: list[int] = []
    limit = Limit("40 items")
    while len(got) < 40 and limit.left():
        got += [items[1] for items in b.read() if isinstance(items, list)]
        a.flush()
    assert (got, a.unsent) == (list(range(40)), False)
    b.close()
    a.post(["1"])
    a.post(["2"])
    assert a.closed
    a.close()


def test_last_words_are_read_although_the_other_end_takes_nothing_more() -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    b.post(["last", "words"])
    b.close()
    a.post(["1"])
    assert a.closed and a.read() == [["last", "words"]]
    a.close()


def test_bytes_that_are_no_record_are_refused() -> None:
    near, far = socket.socketpair()
    a = Pipe(near)
    far.send(b"\xc1")
    with pytest.raises(ValueError):
        a.read()
    a.close()
    far.close()


def test_each_permit_is_taken_once_also_after_the_end_of_the_worker() -> None:
    descriptor = permit_counter()
    node, worker = Permits(os.dup(descriptor)), Permits(descriptor)
    for _ in range(3):
        node.give()
    assert worker.take()
    worker.close()
    assert [node.take() for _ in range(3)] == [True, True, False]
    node.close()


@pytest.mark.processes
@pytest.mark.parametrize("missing", [False, True])
async def test_the_end_of_a_process_is_noticed_whoever_holds_its_pipe(
    missing: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the kernel's notice, and where there is none (before Linux 5.3)."""
    if missing:
        monkeypatch.delattr(os, "pidfd_open")
    process = subprocess.Popen(
        ["sh", "-c", "sleep 60 & echo $!; exec sleep 60"], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    holder = int(process.stdout.readline())
    waiting = asyncio.create_task(until_ended(process.pid))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.shield(waiting), 0.1)
    process.kill()
    await asyncio.wait_for(waiting, 60.0)
    assert process.wait(60.0) == -signal.SIGKILL
    os.kill(holder, signal.SIGKILL)
    process.stdout.close()


@pytest.mark.parametrize("by", ["order", "command"])
def test_a_hold_ends_with_runs_that_were_stopped_before_they_began(by: str) -> None:
    clock = Clock()
    entry = ActionEntry("act", "tests:none", "task", "here")
    place = InlineHost({"act": entry}, clock=clock, substitutes={"act": lambda ctx: success()})
    place.command(0.0, Command("h", "hold"))
    place.take(0.0, Call("held", "act"))
    if by == "order":
        place.take(0.0, Cancel("held"))
    else:
        place.command(0.0, Command("s", "stop"))
    place.take(0.0, Call("next", "act"))
    place.advance(0.0)
    ends = {report.id: report.status for report in place.reports() if isinstance(report, Outcome)}
    assert ends == {"held": "error", "next": "success"}


def test_of_states_only_the_newest_counts() -> None:
    near, far = link_pair()
    driver, actions = NewestLink(near), NewestLink(far)
    for n in range(5):
        assert driver.send([n])
    assert actions.newest() == [4] and actions.newest() is None
    assert [actions.send([n]) for n in range(3)] == [True] * 3
    assert driver.read() == [[0], [1], [2]]
    with pytest.raises(ValueError, match="do not fit into one datagram"):
        driver.send([bytes(1 << 20)])
    sent, limit = 0, Limit("a full line", steps=100_000)
    while driver.send([bytes(1000)]) and limit.left():
        sent += 1
    assert (sent > 10, driver.closed) == (True, False), (
        "a reader that stands still must not stop the writer"
    )
    actions.close()
    assert (driver.send([0]), driver.closed) == (False, True)
    driver.close()


# --- scripts ----------------------------------------------------------------------------------


def test_a_script_is_played_line_by_line(tmp_path: Path) -> None:
    file = tmp_path / "script.toml"
    file.write_text(
        "schema = 1\n[actions.one]\nseconds = [0.2, 0.4]\nvalues = { x = 1 }\n"
        '[[actions.two]]\nstatus = "failure"\ncause = "c"\ntext = "t"\nseconds = 0.1\n'
        'events = [{ after = 0.05, name = "half", data = { y = 2 } }, { after = 9.0, name = '
        '"never" }]\n'
        "[[actions.two]]\n"
    )
    script = load(file)
    played = [rehearse(script["two"], anything=1) for _ in range(3)]
    assert [(p.result.status, p.result.cause) for p in played] == [
        ("failure", "c"),
        ("success", ""),
        ("failure", "c"),
    ]
    assert [(round(t, 3), name, data) for t, name, data in played[0].events] == [
        (0.052, "half", {"y": 2})
    ]
    times = {rehearse(script["one"], seed=seed).seconds for seed in range(8)}
    assert len(times) > 3 and all(0.2 - 1e-9 <= t <= 0.4 + 0.004 for t in times)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("schema = 2", "schema: write schema = 1"),
        ("schema = 1\n[action.x]", "action: unknown table; did you mean 'actions'?"),
        ("schema = 1\nactions = 3", "actions: write [actions.NAME] tables"),
        ("schema = 1\n[actions.x]\nstate = 1", "actions.x: unknown key 'state'"),
        (
            'schema = 1\n[actions.x]\nstatus = "good"',
            'status is \'good\'; write "success", "failure" or "error"',
        ),
        (
            "schema = 1\n[actions.x]\nseconds = [2, 1]",
            "seconds is [2, 1]; write a number, or [shortest, longest]",
        ),
        ("schema = 1\n[actions.x]\nvalues = 1", "values is 1; write a table"),
        ("schema = 1\n[actions.x]\nevents = [{ name = 1 }]", "event {'name': 1}; write"),
        ("schema = 1\n[actions]\nx = 1", "actions.x: is 1; write a table with status"),
        ("schema = ", "not valid TOML"),
    ],
)
def test_bad_scripts_are_refused(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "script.toml"
    file.write_text(text)
    with pytest.raises(ScriptError) as caught:
        load(file)
    assert says in str(caught.value) and str(file) in str(caught.value)


# --- rehearsals -------------------------------------------------------------------------------


def test_a_rehearsal_tells_all_that_an_action_did() -> None:
    async def act(ctx: Context, *, n: int) -> Result:
        ctx.progress(0.5)
        ctx.publish("s", [1.0])
        answer = await ctx.call("add", n=n)
        await ctx.put("sum", answer.values["sum"])
        if not await ctx.wait(lambda: ctx.device["light"], 1.0):
            return failure("dark")
        ctx.raise_event("seen")
        return success(sum=await ctx.get("sum"), unknown=(await ctx.call("nobody")).cause)

    lamp = {"light": False}
    played = rehearse(
        act,
        device=lamp,
        services={"add": lambda n: success(sum=n + 1)},
        streams={"s": 0.02},
        world=lambda now: lamp.update(light=now > 0.5),
        n=4,
    )
    assert (
        played.result.values == {"sum": 5, "unknown": "unknown_service"}
        and 0.5 < played.seconds < 0.52
    )
    assert [name for _, name, _ in played.calls] == ["add", "memory.put", "memory.get", "nobody"]
    assert (
        len(played.published) == 26 and played.progress == [(0.0, 0.5)] and len(played.events) == 1
    )


def test_a_rehearsal_shows_what_is_provisional_and_what_was_judged() -> None:
    async def act(ctx: Context, run: str) -> Result:
        await ctx.sleep(0.1)
        ctx.verdict(run, Status.FAILURE, "crooked")
        with pytest.raises(ValueError, match=r"pass ctx\.run of the run's own context"):
            ctx.verdict("pick#1", Status.FAILURE)
        with pytest.raises(ValueError, match="good"):
            ctx.verdict(run, "good")  # type: ignore[arg-type]
        return provisional(failure("loose", "may hold", force=1.0))

    played = rehearse(act, run="m/pick#1")
    assert played.result == Result(
        Status.FAILURE, {"force": 1.0}, "loose", "may hold", deferred=True
    )
    assert [(run, status, cause) for _, run, status, cause in played.verdicts] == [
        ("m/pick#1", "failure", "crooked")
    ]


def test_a_script_may_be_provisional(tmp_path: Path) -> None:
    file = tmp_path / "script.toml"
    file.write_text("schema = 1\n[actions.one]\ndeferred = true\n")
    assert rehearse(load(file)["one"]).result.deferred
    file.write_text('schema = 1\n[actions.one]\ndeferred = "later"\n')
    with pytest.raises(ScriptError, match=r"actions\.one: deferred is 'later'; write true"):
        load(file)


def test_a_rehearsal_has_a_limit() -> None:
    async def act(ctx: Context) -> Result:
        await ctx.sleep(100.0)
        return success()

    with pytest.raises(StillRunningError, match="has not ended after 2 s"):
        rehearse(act, limit=2.0)
    assert rehearse(act, cancel_after=1.0).result.cause == "cancelled"


def test_a_rehearsal_that_does_not_end_says_what_was_done_last_and_no_more() -> None:
    async def count(ctx: Context) -> Result:
        while True:
            number, _ = await ctx.get_versioned("parts", 0)
            await ctx.compare_and_set("parts", 99, number + 1)

    with pytest.raises(StillRunningError, match=r"\d+ calls, the last: .*memory\.") as raised:
        rehearse(count, limit=2.0, memory={"parts": 4})
    assert len(str(raised.value)) < 400


def test_a_rehearsal_has_memory_and_streams_without_a_location_file() -> None:
    class Desk(Driver):
        period = 0.01
        shown = 0.0

        def step(self, now: float) -> None:
            values = self.ports.stream("place").values
            self.shown = 0.0 if values is None else values[0]

    desk = Desk({}, None)  # type: ignore[arg-type]

    async def tell(ctx: Context) -> Result:
        ctx.publish("place", [await ctx.get("parts")])
        await ctx.sleep(0.1)
        with pytest.raises(ValueError, match=r"expected a list of numbers, found \{'x': 1\}"):
            ctx.publish("place", {"x": 1})  # type: ignore[arg-type]
        return success(shown=desk.shown)

    played = rehearse(tell, device=desk, memory={"parts": 4})
    assert played.result.values == {"shown": 4.0}
    assert {(stream, values) for _, stream, values in played.published} == {("place", (4.0,))}


# --- the process of a cyclic driver -----------------------------------------------------------


class Ports:
    """Nothing around a driver."""

    def poll(self) -> None: ...

    def raised(self) -> list[tuple[str, dict[str, Any]]]:
        return []


class Moving(Stub):
    """Moves from its first command until it is stopped; needs ten cycles to come to rest."""

    def __init__(self) -> None:
        super().__init__()
        self.stopping = 0
        self.closed_while_moving: bool | None = None

    def step(self, now: float) -> None:
        self.stopping = max(0, self.stopping - 1)
        if self.stopping == 0 and "stop" in self.log:
            self.moving = False

    def stop(self, now: float) -> None:
        self.log.append("stop")
        self.stopping = self.stopping or 10

    def close(self) -> None:
        self.closed_while_moving = self.moving


class Process:
    """A device loop in a thread, with all ends of its sockets."""

    def __init__(self, driver: Moving) -> None:
        node, loop_end = socket.socketpair()
        self.descriptors, far = socket.socketpair()
        self.node, self._far, self._loop_end = Pipe(node), far, Pipe(loop_end)
        loop = DeviceLoop(driver, Ports(), self._loop_end, far)  # type: ignore[arg-type]  # all that it uses
        self.thread = threading.Thread(target=loop.run)
        self.thread.start()

    def link(self) -> NewestLink:
        """A new worker."""
        near, far = link_pair()
        socket.send_fds(self.descriptors, [b"."], [far.fileno()])
        far.close()
        self.node.post([LINKED])
        return NewestLink(near)

    def told(self) -> Answer:
        """The next that the loop says to its node."""
        limit = Limit("a word of the loop")
        while True:
            limit.left()
            select.select([self.node], [], [], 10.0)
            if items := self.node.read():
                assert isinstance(items[0], Answer)
                return items[0]

    def end(self) -> None:
        self.node.close()
        self.thread.join(60.0)
        self.descriptors.close()
        self._far.close()
        self._loop_end.close()
        assert not self.thread.is_alive()


def states(link: NewestLink, until: Callable[[list[Any]], bool]) -> list[Any]:
    """Read states until one fits."""
    limit = Limit("a state that fits")
    while True:
        limit.left()
        select.select([link], [], [], 10.0)
        state = link.newest()
        assert not link.closed
        if state is not None and until(state):
            return state


def test_the_driver_is_stopped_when_its_worker_dies() -> None:
    driver = Moving()
    process = Process(driver)
    link = process.link()
    link.send([1, "command", {"go": 1}])
    assert states(link, lambda s: s[0] == 1)[2] is False, "it does not say that it moves"
    link.close()
    process.node.post(Command("h", "halt"))
    told = process.told()
    assert (told.id, told.data["answer"]) == ("h", "stopped")
    second = process.link()
    assert states(second, lambda s: True)[0] == 0, "the new worker's commands are counted from 1"
    second.close()
    process.end()


def test_the_driver_is_stopped_before_the_process_leaves_a_dead_node() -> None:
    driver = Moving()
    process = Process(driver)
    link = process.link()
    link.send([1, "command", {"go": 1}])
    states(link, lambda s: s[0] == 1)
    process.end()
    assert "stop" in driver.log and driver.closed_while_moving is False
    link.close()


@pytest.mark.parametrize(
    ("verb", "answer"), [("hold", "held"), ("release", "released"), ("status", "up")]
)
def test_the_node_commands_the_driver_itself(verb: str, answer: str) -> None:
    process = Process(Moving())
    process.node.post(Command("c", verb))
    told = process.told()
    assert (told.id, told.data["answer"], told.data["state"]) == ("c", answer, {"n": 0})
    process.end()
