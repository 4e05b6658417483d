"""Misbehaving peers on real sockets: they are cut off or refused while good callers are served."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import random

import pytest

from petrobot.services.comm.calls.caller import PeerLost
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import LIMITS
from petrobot.services.comm.protocol.messages import Executed
from tests.comm.ends import HELLO, Coordinator, Node, frame, read_all, until, welcome
from tests.waiting import Limit


async def test_a_silent_peer_is_cut_off(open_node: Node) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(frame(HELLO))
    async with asyncio.timeout(60.0):
        said = await read_all(reader)
    assert b"vision" not in said and frame(m.Ping(1)) in said
    writer.close()
    assert open_node.server.connected == ()


async def test_a_silent_node_is_lost_at_once(open_node: Node) -> None:
    async def frozen(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(welcome(await reader.read(1000)))
        await read_all(reader)
        writer.close()

    server = await asyncio.start_server(frozen, "127.0.0.1", 0)
    coordinator = Coordinator(*server.sockets[0].getsockname())
    outcome = await coordinator.client.call("echo")
    assert (outcome.cause, outcome.executed) == ("lost", Executed.UNKNOWN)
    assert "silent" in (await coordinator.notice(PeerLost)).reason
    await coordinator.client.close()
    server.close()
    await server.wait_closed()


@pytest.mark.parametrize(
    "said", [b"", b"\x00", frame(HELLO)[:-1]], ids=["nothing", "a byte", "half a hello"]
)
async def test_a_slow_handshake_is_cut_off_off(open_node: Node, said: bytes) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(said)
    async with asyncio.timeout(60.0):
        assert await read_all(reader) == b""
    writer.close()


async def test_idle_connections_do_not_keep_a_good_caller_out(open_node: Node) -> None:
    idle = [await asyncio.open_connection(*open_node.server.address) for _ in range(40)]
    coordinator = open_node.client()
    assert (await coordinator.client.call("echo")).status == "success"
    assert len(open_node.server._all) <= 8
    for _, writer in idle:
        writer.close()
    await coordinator.client.close()


async def test_a_peer_that_does_not_read_is_cut_off_and_its_memory_freed(open_node: Node) -> None:
    reader, writer = await asyncio.open_connection(*open_node.server.address)
    writer.write(frame(HELLO))
    payload = {"b": bytes(1 << 18)}
    with contextlib.suppress(ConnectionError):
        for n in range(400):
            writer.write(frame(m.Call(str(n), "echo", payload, None, 1)))
            await writer.drain()
            if not open_node.server.connected and n > 10:
                break
    await until(lambda: not open_node.server.connected)
    writer.close()
    del reader


def _malformed(random_: random.Random) -> bytes:
    """Return one connection's malformed bytes."""
    good = bytearray(
        frame(HELLO) if random_.random() < 0.5 else frame(m.Call("1", "echo", {"x": [1, 2]}))
    )
    what = random_.randrange(6)
    if what == 0:
        return random_.randbytes(random_.randrange(1, 80))
    if what == 1:
        good[random_.randrange(4, len(good))] ^= 1 << random_.randrange(8)
        return bytes(good)
    if what == 2:
        return (LIMITS[1] + random_.randrange(1, 1 << 30)).to_bytes(4, "big") + bytes(good[4:])
    if what == 3:
        return frame(HELLO) + random_.randbytes(random_.randrange(1, 200))
    if what == 4:
        return frame(HELLO) + b"\x00\x00\x04\x00" + b"\x94\x04\xa1c\xa1s" + b"\x81\xa1a" * 300
    return frame(HELLO) + bytes(good[: random_.randrange(len(good))]) + random_.randbytes(9)


async def _attack(address: tuple[str, int], frames: int, seed: int) -> None:
    random_ = random.Random(seed)
    for n in range(frames):
        with contextlib.suppress(ConnectionError):
            reader, writer = await asyncio.open_connection(*address)
            data = _malformed(random_)
            writer.write(data.replace(b"\xa5coord", f"\xa5{n % 1000:05d}".encode("latin-1")))
            if n % 10 == 0:
                writer.write_eof()
                await read_all(reader)
            writer.transport.abort()


async def _served_under_attack(frames: int) -> None:
    node = Node(timing=LinkTiming(handshake=0.2))
    await node.server.start("127.0.0.1", 0)
    coordinator = node.client(timing=LinkTiming())
    assert await coordinator.client.connected(60.0)
    attack = asyncio.gather(*(_attack(node.server.address, frames // 4, seed) for seed in range(4)))
    served = 0
    limit = Limit("the end of the attack")
    while not attack.done() and limit.left():
        assert (await coordinator.client.call("echo", {"n": served})).values == {"n": served}
        served += 1
    await attack
    await until(lambda: node.server.connected == ("coord",) and len(node.server._all) == 1)
    assert not any(isinstance(notice, PeerLost) for notice in coordinator.notices)
    assert served and {
        "malformed",
        "unknown_kind",
        "too_large",
        "out_of_turn",
        "version",
        "no_key_here",
        "bad_check",
    } >= set(node.server.faults)
    assert sum(node.server.faults.values()) > frames // 4
    assert len(node.server.callee._peers._peers) <= 300
    await coordinator.client.close()
    await node.server.close()
    gc.collect()
    assert not [one for one in gc.get_objects() if type(one).__name__ == "_ServerLink"], (
        "a connection was kept"
    )


async def test_malformed_frames_do_not_disturb_a_good_caller() -> None:
    await _served_under_attack(1_500)


@pytest.mark.proof
async def test_malformed_frames_do_not_disturb_a_good_caller_in_full() -> None:
    await _served_under_attack(100_000)
