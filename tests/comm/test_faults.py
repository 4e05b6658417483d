"""Real processes killed (kill -9), frozen (SIGSTOP) and cut off: what the other side is notified
of, in which order, and what stays true.

tools/bench/faults.py measures the times; the tests here hold however busy the machine is.
"""

from __future__ import annotations

import asyncio
import select
import signal
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from petrobot.services.comm.calls.caller import Caller, LateResult, Notice, Patience, PeerLost
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Accept, Executed, Outcome, Welcome
from petrobot.services.comm.streams.stream import Incoming, StreamReceiver
from tests.comm.fault_parts import HOST, STREAM, Cable, LinkFault, first_line, inflict, part
from tests.ports import free_ports

pytestmark = pytest.mark.processes
LIMIT = 60.0


class Told:
    """A coordinator's client that records all notices, in order."""

    def __init__(self, port: int) -> None:
        self.notices: list[Notice] = []
        self.changed = asyncio.Event()
        self.caller = Caller("motion", m.Hello(2, 2, "coordinator", "coord", "c1", 1))
        self.client = Client(HOST, port, self.caller, on_notices=self._take)
        self.client.start()

    def _take(self, now: float, notices: list[Notice]) -> None:
        self.notices += notices
        self.changed.set()

    async def until(self, kind: type[Any], number: int = 1) -> Any:
        """Wait for the `number`-th notice of a kind and return it."""
        async with asyncio.timeout(LIMIT):
            while len(found := [one for one in self.notices if isinstance(one, kind)]) < number:
                self.changed.clear()
                await self.changed.wait()
        return found[number - 1]

    def order(self) -> list[str]:
        """Return the kinds of all notices, in order."""
        return [type(one).__name__ for one in self.notices]

    async def begin(self) -> None:
        """Start a run that stays active at the node."""
        assert await self.client.connected(LIMIT)
        self.caller.call(self.client.now(), m.Call("1", "move"))
        self.client.flush()
        await self.until(Accept)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (LinkFault.KILLED, ("hung up", "broke")),
        (LinkFault.FROZEN, ("silent",)),
        (LinkFault.CUT, ("silent",)),
        (LinkFault.DEAF, ("hung up", "broke")),
    ],
    ids=lambda one: one.value if isinstance(one, LinkFault) else "",
)
async def test_a_node_that_is_lost_is_named_and_its_run_ends_once_with_unknown(
    fault: LinkFault, says: tuple[str, ...]
) -> None:
    with part("node") as process:
        cable = Cable(int(await asyncio.to_thread(first_line, process)))
        told = Told(cable.port)
        await told.begin()
        inflict(fault, process, cable)
        lost = await told.until(PeerLost)
        assert any(one in lost.reason for one in says), lost.reason
        ended = await told.until(Outcome)
        assert (ended.status, ended.cause, ended.executed) == ("error", "lost", Executed.UNKNOWN)
        assert told.order() == ["Welcome", "Accept", "PeerLost", "Outcome"]
        await told.client.close()
        cable.close()


async def test_the_run_of_a_killed_node_ends_as_soon_as_its_port_refuses() -> None:
    """It does not wait for the 2 s that a broken link has to come back. A process that then opens
    the port is another boot and does not receive the call again."""
    (port,) = free_ports(1)
    with part("node", str(port), "n1") as process:
        await asyncio.to_thread(first_line, process)
        told = Told(port)
        await told.begin()
        # Longer than any wait here: only the refusing port can end the run.
        told.caller.patience = told.caller._absence._patience = Patience(reconnect=2 * LIMIT)
        process.kill()
        ended = await told.until(Outcome)
    assert (ended.cause, ended.executed) == (
        "lost",
        Executed.UNKNOWN,
    ) and "nothing listens" in ended.text
    assert told.order() == ["Welcome", "Accept", "PeerLost", "Outcome"]
    told.caller.call(told.client.now(), m.Call("2", "move"))
    told.client.flush()
    late = await told.until(Outcome, 2)
    assert (late.cause, late.executed) == ("unreachable", Executed.NO)
    with part("node", str(port), "n2") as again:
        await asyncio.to_thread(first_line, again)
        back = await told.until(Welcome, 2)
        assert back.boot == "n2" and back.runs == (), "nothing was sent to it"
        told.caller.call(told.client.now(), m.Call("3", "move"))
        told.client.flush()
        await told.until(Accept, 2)
        await told.client.close()
    assert told.order().count("Outcome") >= 2, (
        "the first two once each; the third runs until its caller leaves"
    )


async def test_a_broken_link_to_a_live_node_keeps_its_run() -> None:
    """The connection is reset but the port still accepts connections: the client finds the same
    boot again, and the run continues."""
    with part("node") as process:
        told = Told(int(await asyncio.to_thread(first_line, process)))
        await told.begin()
        for number in range(2, 12):
            assert told.client._link is not None
            told.client._link.cut("a fault")
            back = await told.until(Welcome, number)
            assert back.boot == (await told.until(Welcome)).boot and back.runs == ("1",)
        assert "Outcome" not in told.order()
        await told.client.close()


async def test_a_node_that_thaws_is_back_and_stops_the_run_that_was_given_up() -> None:
    with part("node") as process:
        told = Told(int(await asyncio.to_thread(first_line, process)))
        await told.begin()
        process.send_signal(signal.SIGSTOP)
        await told.until(Outcome)
        process.send_signal(signal.SIGCONT)
        back = await told.until(Welcome, 2)
        assert back.boot == (await told.until(Welcome)).boot and back.runs == ("1",), (
            "the node did not notice, and the run is active"
        )
        late = (await told.until(LateResult)).outcome
        assert (late.id, late.cause, late.executed) == ("1", "cancelled", Executed.YES), (
            "recorded, but nothing fires"
        )
        assert told.order().count("Outcome") == 1
        await told.client.close()


class Watch:
    """A sink that records when values arrived and when they were withdrawn (s, receiver's
    clock)."""

    def __init__(self) -> None:
        self.arrived: list[float] = []
        self.withdrawn: list[float] = []
        self.now = 0.0

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        self.arrived.append(self.now)

    def withdraw(self) -> None:
        self.withdrawn.append(self.now)

    @property
    def valid(self) -> bool:
        """Return whether the last value is valid."""
        return bool(self.arrived) and (not self.withdrawn or self.arrived[-1] > self.withdrawn[-1])


def poll_until(
    receiver: StreamReceiver, watch: Watch, holds: Callable[[], bool], period: float
) -> None:
    """Poll like a servo loop. No poll may find a valid value older than three periods."""
    end = time.monotonic() + LIMIT
    while not holds():
        select.select([], [], [], period / 10)
        watch.now = time.monotonic()
        receiver.poll()
        assert not watch.valid or watch.now - watch.arrived[-1] <= 3 * period, (
            "a value is too old but still valid"
        )
        assert watch.now < end, "the condition did not become true in time"


@pytest.mark.parametrize(
    "fault", [LinkFault.KILLED, LinkFault.FROZEN, LinkFault.CUT], ids=lambda one: one.value
)
@pytest.mark.parametrize("period", [0.004, 0.04])
def test_no_set_point_older_than_three_periods_is_valid_when_its_sender_is_lost(
    fault: LinkFault, period: float
) -> None:
    watch = Watch()
    receiver = StreamReceiver("motion", {STREAM: Incoming(period, watch)}, clock=lambda: watch.now)
    cable = Cable(receiver.address[1])
    with part("sender", str(cable.port), str(period)) as process:
        poll_until(receiver, watch, lambda: len(watch.arrived) >= 20 and watch.valid, period)
        inflict(fault, process, cable)
        # What was on its way may still arrive: the cable's thread may wait for a core.
        poll_until(receiver, watch, lambda: watch.now > watch.arrived[-1] + 10 * period, period)
        last = len(watch.arrived)
        ends = watch.now + 10 * period
        poll_until(receiver, watch, lambda: watch.now > ends, period)
        assert not watch.valid and len(watch.arrived) == last, "the set point stays invalid"
        if fault is LinkFault.FROZEN:
            process.send_signal(signal.SIGCONT)
            poll_until(receiver, watch, lambda: len(watch.arrived) > last and watch.valid, period)
    cable.close()
    receiver.close()
