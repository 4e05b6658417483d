"""The process of a cyclic driver: its commands, and stopping the driver when a process ends."""

from __future__ import annotations

import math
import select
import socket
import threading
from collections.abc import Callable
from typing import Any

import pytest

from petrobot.services.action import Context, Result, success
from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.protocol.messages import (
    Answer,
    Call,
    Cancel,
    Command,
    Outcome,
)
from petrobot.services.device import Driver
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.worker.device_process import LINKED, DeviceLoop
from petrobot.services.worker.pipe import (
    NewestLink,
    Pipe,
    link_pair,
)
from petrobot.services.worker.remote import (
    EMERGENCY_STOP,
    NODE_SILENT,
    CyclicDriver,
    DeviceCommand,
    DeviceError,
    RemoteDriver,
)
from tests.node.conftest import Clock
from tests.waiting import Limit


class Stub(Driver):
    """A driver that records its commands."""

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


def test_commands_are_numbered_executed_in_order_and_acknowledged() -> None:
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


@pytest.mark.parametrize("cause", [EMERGENCY_STOP, NODE_SILENT])
def test_a_run_ends_whose_device_was_stopped_while_its_process_did_not_look(cause: str) -> None:
    """Only the newest state counts, and it says that the device accepts commands again. A run that
    begins later goes on."""
    clock, cyclic = Clock(), CyclicDriver(Stub())
    remote = RemoteDriver(lambda command: None, clock)
    remote.take(cyclic.state())

    async def wait(ctx: Context) -> Result:
        await ctx.sleep(9.0)
        return success()

    entry = ActionEntry("act", "tests:none", "task", "here", "base")
    place = InlineHost({"act": entry}, clock=clock, remote=remote, substitutes={"act": wait})
    place.take(0.0, Call("before", "act"))
    place.advance(0.0)
    if cause == EMERGENCY_STOP:
        cyclic.emergency_stop(0.0)
        cyclic.clear_emergency()
    else:
        cyclic.node_silent(0.0)
        cyclic.node_speaks()
    remote.take(cyclic.state())
    assert remote.barred == ""
    place.advance(clock.now)
    (end,) = (report for report in place.reports() if isinstance(report, Outcome))
    assert (end.id, end.status, end.cause) == ("before", "error", cause)
    place.take(0.0, Call("after", "act"))
    place.advance(clock.now)
    assert place.runs == ("after",) and not list(place.reports())


class Ports:
    """Empty ports of a driver."""

    def poll(self) -> None: ...

    def withhold(self, cause: str) -> None: ...

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
    """A device loop in a thread, with the other ends of its sockets."""

    def __init__(self, driver: Moving) -> None:
        node, loop_end = socket.socketpair()
        self.descriptors, far = socket.socketpair()
        self.node, self._far, self._loop_end = Pipe(node), far, Pipe(loop_end)
        loop = DeviceLoop(driver, Ports(), self._loop_end, far)  # type: ignore[arg-type]  # all that it uses
        self.thread = threading.Thread(target=loop.run)
        self.thread.start()

    def link(self) -> NewestLink:
        """Attach a new worker."""
        near, far = link_pair()
        socket.send_fds(self.descriptors, [b"."], [far.fileno()])
        far.close()
        self.node.post([LINKED])
        return NewestLink(near)

    def told(self) -> Answer:
        """Return the next message of the loop to its node."""
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
    """Read states until one fulfils the condition."""
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


def test_a_driver_that_fails_is_stopped_before_its_process_ends() -> None:
    class Failing(Moving):
        def step(self, now: float) -> None:
            if "stop" not in self.log:
                raise KeyError("the sensor")
            super().step(now)

    driver = Failing()
    driver.moving = True
    (node, loop_end), (near, far) = socket.socketpair(), socket.socketpair()
    failed = pytest.raises(DeviceError, match="its driver failed: KeyError")
    with node, loop_end, near, far, failed:
        DeviceLoop(driver, Ports(), Pipe(loop_end), far).run()  # type: ignore[arg-type]
    assert "stop" in driver.log and driver.closed_while_moving is False


@pytest.mark.parametrize(
    ("verb", "answer"), [("hold", "held"), ("release", "released"), ("status", "up")]
)
def test_the_node_commands_the_driver_itself(verb: str, answer: str) -> None:
    process = Process(Moving())
    process.node.post(Command("c", verb))
    told = process.told()
    assert (told.id, told.data["answer"], told.data["state"]) == ("c", answer, {"n": 0})
    process.end()
