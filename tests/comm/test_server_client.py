"""The machines on real sockets: liveness, limits, faults of peers, and good callers served throughout."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import random
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from services.comm import messages as m
from services.comm.callee import Callee, CancelRun, Offer, Order, StartRun
from services.comm.caller import Answered, Caller, Ended, Notice, PeerBack, PeerLost
from services.comm.client import Client
from services.comm.codec import LIMITS, encode
from services.comm.link import Beat, Heart, Limits, Link, Timing
from services.comm.messages import Executed
from services.comm.security import KeyNeededError
from services.comm.server import Server

QUICK = Timing(heartbeat=0.05, silence=0.2, handshake=0.3, backoff=(0.01, 0.05))
HELLO = m.Hello(1, 1, "coordinator", "coord", "c1", 1)


def _echo(now: float, call: m.Call) -> m.Outcome:
    return m.Outcome(call.id, "success", call.arguments)


def _callee(name: str = "motion") -> Callee:
    offers = {
        "echo": Offer(inline=_echo),
        "big": Offer(inline=lambda now, call: m.Outcome(call.id, "success", {"b": bytes(17 << 20)})),
        "move": Offer(device="arm", orphan_time=0.1),
    }
    return Callee(name, "n1", offers)


class Node:
    """A server and what it was ordered to do."""

    def __init__(self, **options: Any) -> None:
        self.orders: list[Order] = []
        self.server = Server(_callee(), on_orders=self._take, **{"timing": QUICK, **options})
        self.ordered = asyncio.Event()

    def _take(self, now: float, orders: list[Order]) -> None:
        self.orders += orders
        self.ordered.set()

    async def order(self, kind: type[Any]) -> Any:
        """The next order of this kind."""
        async with asyncio.timeout(5.0):
            while not any(isinstance(order, kind) for order in self.orders):
                self.ordered.clear()
                await self.ordered.wait()
        return next(order for order in self.orders if isinstance(order, kind))

    def client(self, hello: m.Hello = HELLO, **options: Any) -> Coordinator:
        return Coordinator(*self.server.address, hello, **options)


class Coordinator:
    """A client and what it was told."""

    def __init__(self, host: str, port: int, hello: m.Hello = HELLO, **options: Any) -> None:
        self.notices: list[Notice] = []
        self.told = asyncio.Event()
        self.caller = Caller("motion", hello)
        self.client = Client(host, port, self.caller, on_notices=self._take, **{"timing": QUICK, **options})
        self.client.start()

    def _take(self, now: float, notices: list[Notice]) -> None:
        self.notices += notices
        self.told.set()

    async def notice(self, kind: type[Any], number: int = 1) -> Any:
        """The so-manieth notice of this kind."""
        async with asyncio.timeout(5.0):
            while len(found := [notice for notice in self.notices if isinstance(notice, kind)]) < number:
                self.told.clear()
                await self.told.wait()
        return found[number - 1]

    def call(self, id_: str, service: str, **arguments: Any) -> None:
        self.caller.call(self.client.now(), m.Call(id_, service, arguments))
        self.client.flush()


@pytest.fixture
async def node(key: bytes | None) -> AsyncIterator[Node]:
    """A node with a key or without."""
    one = Node(key=key)
    await one.server.start("127.0.0.1", 0)
    yield one
    await one.server.close()


@pytest.fixture
async def open_node() -> AsyncIterator[Node]:
    """A node without a key."""
    one = Node(limits=Limits(connections=8, opening=4, buffer_high=1 << 16, buffer_hard=1 << 20))
    await one.server.start("127.0.0.1", 0)
    yield one
    await one.server.close()


async def _until(condition: Callable[[], bool]) -> None:
    """Wait until it holds: looked at again whenever a server, a client or a heart has done something."""
    stirred = asyncio.Event()
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((Server, "arm"), (Server, "gone"), (Client, "flush"), (Link, "_beat")):
            patch.setattr(owner, name, _and_then(getattr(owner, name), stirred.set))
        async with asyncio.timeout(5.0):
            while not condition():
                stirred.clear()
                await stirred.wait()


def _and_then(method: Callable[..., Any], do: Callable[[], None]) -> Callable[..., Any]:
    def both(*arguments: Any) -> Any:
        result = method(*arguments)
        do()
        return result

    return both


async def test_a_service_and_an_action(node: Node, key: bytes | None) -> None:
    coordinator = node.client(key=key)
    assert await coordinator.client.connected(5.0)
    outcome = await coordinator.client.call("echo", {"x": [1, 2.5, "a", b"b", None]}, deadline=1.0)
    assert outcome.status == "success" and outcome.values == {"x": [1, 2.5, "a", b"b", None]}
    many = await asyncio.gather(*(coordinator.client.call("echo", {"n": n}) for n in range(200)))
    assert [one.values["n"] for one in many] == list(range(200))
    coordinator.call("1", "move", to=1)
    start = await node.order(StartRun)
    assert start.call.id == "1"
    callee = node.server.callee
    callee.feedback(node.server.now(), "1", 0.5)
    callee.finish(node.server.now(), "1", "success", {"p": 1})
    node.server.flush()
    assert (await coordinator.notice(Ended)).outcome.values == {"p": 1}
    coordinator.caller.acknowledge(coordinator.client.now(), "1")
    coordinator.client.flush()
    await _until(lambda: not callee._results.of("coord"))
    await coordinator.client.close()
    await _until(lambda: node.server.connected == ())


async def test_calls_of_several_clients_of_a_process_have_ids_of_their_own(open_node: Node) -> None:
    other = Node()
    await other.server.start("127.0.0.1", 0)
    first, second = open_node.client(), other.client()
    calls = [asyncio.ensure_future(one.client.call("move")) for one in (first, second)]
    ids = {(await node.order(StartRun)).call.id for node in (open_node, other)}
    assert len(ids) == 2, "one of them is the parent or the key of something else"
    for call, node, told in zip(calls, (open_node, other), (first, second), strict=True):
        callee = node.server.callee
        callee.finish(node.server.now(), next(iter(callee.running())), "success")
        node.server.flush()
        assert (await call).status == "success"
        await told.client.close()
    await other.server.close()


async def test_a_command_and_an_event(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(5.0)
    coordinator.caller.command(coordinator.client.now(), m.Command("k1", "status"))
    coordinator.client.flush()
    await open_node.order(object)
    open_node.server.callee.answer(open_node.server.now(), "k1", True, {"arm": "held"})
    open_node.server.flush()
    assert (await coordinator.notice(Answered)).answer.data == {"arm": "held"}
    await coordinator.client.close()


async def test_cancelling_the_future_cancels_the_call(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(5.0)
    task = asyncio.ensure_future(coordinator.client.call("move"))
    await open_node.order(StartRun)
    task.cancel()
    cancel = await open_node.order(CancelRun)
    callee = open_node.server.callee
    callee.finish(open_node.server.now(), cancel.id, "error", cause="cancelled")
    open_node.server.flush()
    await _until(lambda: not coordinator.caller.under_way())
    await _until(lambda: not callee._results.of("coord"))
    await coordinator.client.close()


async def test_a_result_or_a_call_too_large_for_a_frame_ends_that_call_alone(node: Node, key: bytes | None) -> None:
    coordinator = node.client(key=key)
    assert await coordinator.client.connected(5.0)
    huge, too_big, fine = await asyncio.gather(
        coordinator.client.call("big"),
        coordinator.client.call("echo", {"b": bytes(17 << 20)}),
        coordinator.client.call("echo", {"b": 1}),
    )
    assert (huge.cause, huge.executed) == ("bad_result", Executed.YES)
    assert (too_big.cause, too_big.executed) == ("too_large", Executed.NO)
    assert fine.status == "success"
    await coordinator.client.close()


async def test_the_heart_keeps_an_idle_link_up_and_a_broken_one_comes_back(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(5.0)
    link = open_node.server._links["coord"]
    await _until(lambda: link._pings + coordinator.client._link._pings >= 6)  # type: ignore[union-attr]
    assert not any(isinstance(notice, PeerLost) for notice in coordinator.notices)
    coordinator.call("1", "move")
    await open_node.order(StartRun)
    link.cut("a fault")
    back = await coordinator.notice(PeerBack, 2)
    assert back.same_boot and back.runs == ("1",)
    assert not any(isinstance(order, CancelRun) for order in open_node.orders)
    await coordinator.client.close()


async def test_a_run_whose_caller_is_gone_is_stopped(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(5.0)
    coordinator.call("1", "move")
    await open_node.order(StartRun)
    await coordinator.client.close()
    assert (await open_node.order(CancelRun)).reason == "orphan"


async def test_nobody_listens(open_node: Node) -> None:
    address = open_node.server.address
    await open_node.server.close()
    coordinator = Coordinator(*address)
    assert not await coordinator.client.connected(0.05)
    coordinator.caller.call(coordinator.client.now(), m.Call("1", "echo"))
    coordinator.caller.advance(coordinator.client.now() + 2.0)
    coordinator.client.flush()
    outcome = (await coordinator.notice(Ended)).outcome
    assert (outcome.cause, outcome.executed) == ("unreachable", Executed.NO)
    await coordinator.client.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
async def test_other_hosts_cannot_connect_without_a_key(host: str) -> None:
    with pytest.raises(KeyNeededError, match="motion: refuses to listen"):
        await Node().server.start(host, 0)


@pytest.mark.parametrize(
    ("hello", "key", "code"),
    [
        (m.Hello(2, 9, "coordinator", "coord", "c1"), None, "version"),
        (m.Hello(1, 1, "coordinator", "coord", "c1"), b"k" * 32, "no_key_here"),
    ],
)
async def test_a_refused_caller_is_told_why_and_its_calls_end(
    open_node: Node, hello: m.Hello, key: bytes | None, code: str
) -> None:
    coordinator = open_node.client(hello, key=key)
    outcome = await coordinator.client.call("echo")
    assert (outcome.cause, outcome.executed) == ("refused", Executed.NO)
    assert code in outcome.text
    await coordinator.client.close()


async def test_a_wrong_key_is_told_to_both(key: bytes | None) -> None:
    node = Node(key=b"k" * 32)
    await node.server.start("127.0.0.1", 0)
    coordinator = node.client(key=key)
    outcome = await coordinator.client.call("echo")
    assert outcome.cause == "refused" and ("wrong_key" if key else "key_needed") in outcome.text
    assert set(node.server.faults) == {"wrong_key" if key else "key_needed"}
    await coordinator.client.close()
    await node.server.close()


async def test_a_second_process_of_a_name_is_refused_and_a_newer_epoch_takes_over(open_node: Node) -> None:
    first = open_node.client()
    assert await first.client.connected(5.0)
    second = open_node.client(m.Hello(1, 1, "coordinator", "coord", "c2", 1))
    outcome = await second.client.call("echo")
    assert "name_taken" in outcome.text
    await second.client.close()
    third = open_node.client(m.Hello(1, 1, "coordinator", "coord", "c3", 2))
    assert await third.client.connected(5.0)
    await first.notice(PeerLost)
    outcome = await first.client.call("echo")
    assert "old_epoch" in outcome.text and outcome.executed is Executed.NO
    assert (await third.client.call("echo")).status == "success"
    await first.client.close()
    await third.client.close()


# Peers that do not behave.


def _frame(message: m.Message) -> bytes:
    body = encode(message)
    return len(body).to_bytes(4, "big") + body


async def _read_all(reader: asyncio.StreamReader) -> bytes:
    with contextlib.suppress(ConnectionError):
        return await reader.read()
    return b""


async def test_a_peer_that_is_silent_is_cut(open_node: Node) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(_frame(HELLO))
    async with asyncio.timeout(5.0):
        said = await _read_all(reader)
    assert b"vision" not in said and _frame(m.Ping(1)) in said
    writer.close()
    assert open_node.server.connected == ()


async def test_a_node_that_is_silent_is_lost_at_once(open_node: Node) -> None:
    async def frozen(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        writer.write(_frame(m.Welcome(1, "motion", "n1", ("echo",))))
        await _read_all(reader)
        writer.close()

    server = await asyncio.start_server(frozen, "127.0.0.1", 0)
    coordinator = Coordinator(*server.sockets[0].getsockname())
    outcome = await coordinator.client.call("echo")
    assert (outcome.cause, outcome.executed) == ("lost", Executed.UNKNOWN)
    assert "silent" in (await coordinator.notice(PeerLost)).reason
    await coordinator.client.close()
    server.close()
    await server.wait_closed()


@pytest.mark.parametrize("said", [b"", b"\x00", _frame(HELLO)[:-1]], ids=["nothing", "a byte", "half a hello"])
async def test_a_slow_handshake_is_cut(open_node: Node, said: bytes) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(said)
    async with asyncio.timeout(5.0):
        assert await _read_all(reader) == b""
    writer.close()


async def test_idle_connections_do_not_keep_a_good_caller_out(open_node: Node) -> None:
    idle = [await asyncio.open_connection(*open_node.server.address) for _ in range(40)]
    coordinator = open_node.client()
    assert (await coordinator.client.call("echo")).status == "success"
    assert len(open_node.server._all) <= 8
    for _, writer in idle:
        writer.close()
    await coordinator.client.close()


async def test_one_that_does_not_read_is_cut_and_its_memory_given_back(open_node: Node) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(_frame(HELLO))
    payload = {"b": bytes(1 << 18)}
    with contextlib.suppress(ConnectionError):
        for n in range(400):
            writer.write(_frame(m.Call(str(n), "echo", payload, None, 1)))
            await writer.drain()
            if not open_node.server.connected and n > 10:
                break
    await _until(lambda: not open_node.server.connected)
    writer.close()
    del reader


def _malformed(random_: random.Random) -> bytes:
    """A connection's worth of bytes that is no good."""
    good = bytearray(_frame(HELLO) if random_.random() < 0.5 else _frame(m.Call("1", "echo", {"x": [1, 2]})))
    what = random_.randrange(6)
    if what == 0:
        return random_.randbytes(random_.randrange(1, 80))
    if what == 1:
        good[random_.randrange(4, len(good))] ^= 1 << random_.randrange(8)
        return bytes(good)
    if what == 2:
        return (LIMITS[1] + random_.randrange(1, 1 << 30)).to_bytes(4, "big") + bytes(good[4:])
    if what == 3:
        return _frame(HELLO) + random_.randbytes(random_.randrange(1, 200))
    if what == 4:
        return _frame(HELLO) + b"\x00\x00\x04\x00" + b"\x94\x04\xa1c\xa1s" + b"\x81\xa1a" * 300
    return _frame(HELLO) + bytes(good[: random_.randrange(len(good))]) + random_.randbytes(9)


async def _attack(address: tuple[str, int], frames: int, seed: int) -> None:
    random_ = random.Random(seed)
    for n in range(frames):
        with contextlib.suppress(ConnectionError):
            reader, writer = await asyncio.open_connection(*address)
            data = _malformed(random_)
            writer.write(data.replace(b"\xa5coord", f"\xa5{n % 1000:05d}".encode("latin-1")))
            if n % 10 == 0:
                writer.write_eof()
                await _read_all(reader)
            writer.transport.abort()


async def _served_under_attack(frames: int) -> None:
    node = Node(timing=Timing(handshake=0.2))
    await node.server.start("127.0.0.1", 0)
    coordinator = node.client(timing=Timing())
    assert await coordinator.client.connected(5.0)
    attack = asyncio.gather(*(_attack(node.server.address, frames // 4, seed) for seed in range(4)))
    served = 0
    while not attack.done():
        assert (await coordinator.client.call("echo", {"n": served})).values == {"n": served}
        served += 1
    await attack
    await _until(lambda: node.server.connected == ("coord",) and len(node.server._all) == 1)
    assert not any(isinstance(notice, PeerLost) for notice in coordinator.notices)
    assert served and {"malformed", "unknown_kind", "too_large", "out_of_turn", "version", "no_key_here"} >= set(
        node.server.faults
    )
    assert sum(node.server.faults.values()) > frames // 4
    assert len(node.server.callee._peers._peers) <= 300
    await coordinator.client.close()
    await node.server.close()
    gc.collect()
    assert not [one for one in gc.get_objects() if type(one).__name__ == "_ServerLink"], "a connection was kept"


async def test_malformed_frames_do_not_disturb_a_good_caller() -> None:
    await _served_under_attack(5_000)


@pytest.mark.proof
async def test_malformed_frames_do_not_disturb_a_good_caller_in_full() -> None:
    await _served_under_attack(100_000)


# Peers that are stopped from outside.

SERVER = """
import asyncio
from services.comm.callee import Callee, Offer
from services.comm.server import Server

async def main():
    server = Server(Callee("motion", "n1", {"move": Offer()}))
    await server.start("127.0.0.1", 0)
    print(server.address[1], flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.mark.processes
@pytest.mark.parametrize(
    ("how", "says"), [(signal.SIGKILL, "hung up"), (signal.SIGSTOP, "silent")], ids=["killed", "frozen"]
)
async def test_a_node_process_is_killed_or_frozen_in_mid_run(how: signal.Signals, says: str) -> None:
    process = subprocess.Popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        port = int(await asyncio.to_thread(process.stdout.readline))
        coordinator = Coordinator("127.0.0.1", port)
        coordinator.call("1", "move")
        assert await coordinator.client.connected(5.0)
        process.send_signal(how)
        lost = await coordinator.notice(PeerLost)
        assert says in lost.reason or (how == signal.SIGKILL and "broke" in lost.reason)
        outcome = (await coordinator.notice(Ended)).outcome
        assert (outcome.cause, outcome.executed) == ("lost", Executed.UNKNOWN)
        await coordinator.client.close()
    finally:
        process.kill()
        process.communicate()


# The heart alone.


def test_the_heart_pings_then_gives_up() -> None:
    heart = Heart(0.0, Timing())
    seen: list[tuple[float, Beat]] = []
    while not seen or seen[-1][1] is not Beat.LOST:
        seen.append((heart.due(), heart.advance(heart.due())))
    assert seen == [(0.25, Beat.PING), (0.5, Beat.PING), (0.75, Beat.PING), (1.0, Beat.LOST)]


def test_what_is_heard_puts_the_end_off() -> None:
    heart = Heart(0.0, Timing())
    for tick in range(1, 40):
        heart.heard = tick * 0.25 - 0.1
        assert heart.advance(heart.due()) is Beat.NOTHING
    assert heart.due() == pytest.approx(10.0)


def test_a_process_that_stood_still_itself_listens_before_it_blames_the_other() -> None:
    heart = Heart(0.0, Timing())
    assert heart.advance(5.0) is Beat.PING
    assert heart.due() == pytest.approx(5.25)
    assert heart.advance(5.25) is Beat.LOST
