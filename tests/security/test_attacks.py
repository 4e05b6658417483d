"""Attacks on a node's server over real sockets: they are refused with a clear message or cut off,
memory stays bounded, and an honest client is still served."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import struct
import subprocess
import sys
import textwrap
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.wire import Connection, ProtocolError, Side
from tests.comm.ends import head
from tests.security.conftest import HELLO, KEY, MIB, GoodClient, Stranger, Victim, frame
from tests.waiting import Limit, beat

pytestmark = pytest.mark.processes
Start = Callable[..., Victim]
AUTH = b"\x20vision" + bytes(32)
STRANGE = m.Hello(2, 2, "client", "mallory", "m1")
TOLERATED = 24 * MIB
"""Most growth of the server's resident set under attack (bytes)."""


# --- bad handshakes and frames ----------------------------------------------------------------


async def wrong_key(stranger: Stranger) -> None:
    """Use a guessed key."""
    with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, ProtocolError):
        await stranger.open(bytes(32), STRANGE)


async def no_key(stranger: Stranger) -> None:
    """Use no key."""
    await stranger.say(frame(STRANGE))


async def older_version(stranger: Stranger) -> None:
    """Offer an older version, which might have fewer checks."""
    await stranger.say(frame(m.Hello(0, 0, "client", "mallory", "m1", auth=AUTH)))


async def newer_version(stranger: Stranger) -> None:
    """Offer a version that the server does not know."""
    await stranger.say(frame(m.Hello(7, 9, "client", "mallory", "m1", auth=AUTH)))


async def downgraded_version(stranger: Stranger) -> None:
    """Change the versions of an honest HELLO in transit: its proof is of another transcript."""
    honest = Connection(Side.CLIENT, "vision", key=KEY, nonce=bytes(32))
    hello = honest.send(m.Hello(1, 4, "client", "ana", "a1"))
    await stranger.say(hello.replace(struct.pack("BB", 1, 4), struct.pack("BB", 1, 2), 1))
    body = await stranger._body()
    honest.receive_data(len(body).to_bytes(4, "big") + body)
    await stranger.say(honest.data_to_send())


async def old_epoch(stranger: Stranger) -> None:
    """Connect as an earlier coordinator (an older epoch) with the right key."""
    with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, ProtocolError):
        await stranger.open(KEY, m.Hello(2, 2, "coordinator", "coord", "c0", 2))


async def taken_name(stranger: Stranger) -> None:
    """Connect as another process with the honest client's name and epoch."""
    with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, ProtocolError):
        await stranger.open(KEY, m.Hello(2, 2, "coordinator", "coord", "c9", 3))


async def repeated_frame(stranger: Stranger) -> None:
    """Send the same sealed CALL twice."""
    connection = await stranger.open(KEY, STRANGE)
    sealed = connection.send(m.Call("m/1", "echo"))
    await stranger.say(sealed + sealed)


async def left_out_frame(stranger: Stranger) -> None:
    """Drop a sealed CALL, and forward the next one."""
    connection = await stranger.open(KEY, STRANGE)
    connection.send(m.Call("m/1", "echo"))
    await stranger.say(connection.send(m.Call("m/2", "echo")))


async def changed_frame(stranger: Stranger) -> None:
    """Change one bit of a sealed CALL in transit."""
    connection = await stranger.open(KEY, STRANGE)
    sealed = bytearray(connection.send(m.Call("m/1", "echo", {"speed": 0.1})))
    sealed[-20] ^= 1
    await stranger.say(bytes(sealed))


async def unsealed_frame(stranger: Stranger) -> None:
    """Send a CALL without a seal on a sealed connection."""
    await stranger.open(KEY, STRANGE)
    await stranger.say(frame(m.Call("m/1", "echo", {"much": "x" * 60})))


async def oversized_hello(stranger: Stranger) -> None:
    """Announce a length of 4 GiB; it is refused after its first six bytes."""
    await stranger.say(b"\xff\xff\xff\xff" + frame(STRANGE)[4:])


async def oversized_call(stranger: Stranger) -> None:
    """Announce 17 MiB on an open connection."""
    await stranger.open(KEY, STRANGE)
    await stranger.say(head(17 * MIB) + frame(m.Call("m/1", "echo"))[4:])


async def out_of_turn(stranger: Stranger) -> None:
    """Send a CALL before HELLO."""
    await stranger.say(frame(m.Call("m/1", "echo")))


async def sealed(stranger: Stranger, body: bytes) -> None:
    """Return a frame with any body, correctly sealed."""
    connection = await stranger.open(KEY, STRANGE)
    await stranger.say(connection._frame(body))


async def deep_message(stranger: Stranger) -> None:
    """Send arguments nested 5,000 deep."""
    await sealed(stranger, b"\x94\x04\xa3m/1\xa4echo" + b"\x81\xa1a" * 5_000 + b"\xc0")


async def many_containers(stranger: Stranger) -> None:
    """Send a million empty arrays: 1 MB as bytes, 70 MB as Python objects."""
    await sealed(
        stranger,
        b"\x94\x04\xa3m/1\xa4echo\x81\xa1a"
        + b"\xdd"
        + (10**6).to_bytes(4, "big")
        + b"\x90" * 10**6,
    )


async def strange_extension(stranger: Stranger) -> None:
    """Send one of msgpack's extension types."""
    await sealed(stranger, msgpack.packb([4, "m/1", "echo", {"x": msgpack.ExtType(5, b"0" * 100)}]))


ATTACKS: list[tuple[Callable[[Stranger], Awaitable[None]], str]] = [
    (wrong_key, "wrong_key"),
    (no_key, "key_needed"),
    (older_version, "version"),
    (newer_version, "version"),
    (downgraded_version, "wrong_key"),
    (old_epoch, "old_epoch"),
    (taken_name, "name_taken"),
    (repeated_frame, "bad_seal"),
    (left_out_frame, "bad_seal"),
    (changed_frame, "bad_seal"),
    (unsealed_frame, "bad_seal"),
    (oversized_hello, "too_large"),
    (oversized_call, "too_large"),
    (out_of_turn, "out_of_turn"),
    (deep_message, "malformed"),
    (many_containers, "malformed"),
    (strange_extension, "malformed"),
]


async def test_every_attack_is_refused_with_its_code(victim: Start) -> None:
    """One after the other against one server: the code is right, its memory does not grow, and the
    honest client is not affected."""
    server = victim(key=KEY.hex(), timing={"handshake": 60.0, "silence": 60.0})
    async with server.good_client() as good:
        codes: dict[str, str] = {}
        for attack, _ in ATTACKS:
            stranger = await Stranger.at(server)
            await attack(stranger)
            codes[attack.__name__] = await stranger.refused()
            stranger.close()
            await good.still_served(2)
        assert codes == {attack.__name__: code for attack, code in ATTACKS}
        await server.only_link()
    assert server.grown() < TOLERATED


async def test_a_replayed_session_is_refused(victim: Start) -> None:
    """Everything that an honest client sent is replayed to the same server, and to another boot of
    it: the challenge differs."""
    for server in (victim(key=KEY.hex()), victim(key=KEY.hex())):
        session = await Stranger.at(server)
        connection = await session.open(KEY, STRANGE)
        await session.say(connection.send(m.Call("m/1", "echo", {"n": 1})))
        assert isinstance(decoded := await session._body(), bytes) and b"success" in decoded
        session.close()
        replay = await Stranger.at(server)
        await replay.say(session.said)
        assert await replay.refused() == "wrong_key"
        replay.close()


async def test_a_replayed_server_is_not_trusted(victim: Start) -> None:
    """A stranger replays a recorded server to a client: the proof is of another nonce, so the
    client does not trust it."""
    server = victim(key=KEY.hex())
    session = await Stranger.at(server)
    await session.open(KEY, STRANGE)
    session.close()

    async def impostor(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(64)
        writer.write(session.heard)
        with contextlib.suppress(ConnectionError):
            await reader.read()
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()
        over.set()

    over = asyncio.Event()
    fake = await asyncio.start_server(impostor, "127.0.0.1", 0)
    connection = Connection(Side.CLIENT, "vision", key=KEY, nonce=os.urandom(32))
    reader, writer = await asyncio.open_connection(*fake.sockets[0].getsockname())
    writer.write(connection.send(HELLO))
    with pytest.raises(ProtocolError, match="wrong_key"):
        while data := await reader.read(4096):
            connection.receive_data(data)
            writer.write(connection.data_to_send())
    writer.close()
    await writer.wait_closed()
    async with asyncio.timeout(60.0):
        await over.wait()
    fake.close()
    await fake.wait_closed()


# --- too many, too slow, too fast -------------------------------------------------------------


@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "sealed"])
async def test_slow_loris(victim: Start, keyed: bool) -> None:
    """Two hundred connections send a HELLO slowly, byte by byte: all are closed, and the honest
    client is served."""
    server = victim(timing={"handshake": 0.5}, **({"key": KEY.hex()} if keyed else {}))
    hello = frame(m.Hello(2, 2, "client", "mallory", "m1", auth=AUTH if keyed else b""))

    async def drip() -> None:
        stranger = await Stranger.at(server)
        try:
            for byte in hello:
                await stranger.say(bytes([byte]))
                await beat(0.05)
                if stranger.writer.is_closing() or stranger.reader.at_eof():
                    return
            assert await stranger.refused() == ""
        finally:
            stranger.close()

    async with server.good_client() as good:
        dripping = [asyncio.create_task(drip()) for _ in range(200)]
        await good.still_served(50)
        async with server_second(server) as second:
            await second.still_served(5)
        await asyncio.gather(*dripping)
        await good.still_served()
        await server.only_link()
    assert server.grown() < TOLERATED


def server_second(server: Victim) -> Any:
    """Connect another honest client during the attack."""
    return _second(server)


@contextlib.asynccontextmanager
async def _second(server: Victim) -> Any:
    good = GoodClient(server.client(m.Hello(2, 2, "coordinator", "second", "s1", 1)))
    await good.begin()
    try:
        yield good
    finally:
        await good.end()


BOUNDED_FILES = 64 + 2 * 128 + 2 * 64 + 40
"""File descriptors: connections being opened, those that one pass of the event loop accepts, those
that it closes, and what a process always has open."""
CROWD = """
import json, resource, select, socket, sys
host, port, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
crowd = []
for _ in range(count):
    one = socket.socket()
    one.setblocking(False)
    one.connect_ex((host, port))
    crowd.append(one)
    if len(crowd) % 50 == 0:
        select.select([], [], [], 0.005)
print(len(crowd), flush=True)
sys.stdin.readline()
"""


@contextlib.asynccontextmanager
async def crowd_at(server: Victim, count: int) -> Any:
    """Start a process that opens so many connections and keeps them."""
    command = [sys.executable, "-c", textwrap.dedent(CROWD), *map(str, (*server.address, count))]
    crowd = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield crowd
    finally:
        crowd.kill()
        crowd.communicate()


@pytest.mark.parametrize("link", ["plain", "sealed", "TLS"])
async def test_ten_thousand_connections(
    victim: Start, link: str, certificates: Path, many_files: None
) -> None:
    """Connections, descriptors and memory stay bounded; connected clients are served all the time,
    and a new one can connect."""
    how: dict[str, Any] = {
        "plain": {},
        "sealed": {"key": KEY.hex()},
        "TLS": {"folder": str(certificates)},
    }[link]
    server = victim(**how)
    async with server.good_client() as good, crowd_at(server, 10_000) as crowd:
        assert crowd.stdout is not None
        opened = asyncio.create_task(asyncio.to_thread(crowd.stdout.readline))
        limit = Limit("the crowd to be there")
        while not opened.done() and limit.left():
            await good.still_served(10)
            about = await asyncio.to_thread(server.about)
            assert about["opening"] <= 64 and about["fds"] < BOUNDED_FILES, about
        assert int(await opened) == 10_000
        async with _second(server) as second:
            await second.still_served()
        await good.still_served()
    assert server.grown() < (TOLERATED if link != "TLS" else 64 * MIB)


@pytest.mark.parametrize("link", ["plain", "TLS"])
async def test_strangers_leave_files_to_a_process_that_may_open_few(
    victim: Start, link: str, certificates: Path
) -> None:
    """A node without a free file would not hear an emergency stop."""
    server = victim(files=64, **({"folder": str(certificates)} if link == "TLS" else {}))
    async with server.good_client() as good, crowd_at(server, 150) as crowd:
        assert crowd.stdout is not None
        assert int(await asyncio.to_thread(crowd.stdout.readline)) == 150
        for _ in range(5):
            assert (await asyncio.to_thread(server.about))["fds"] < 64
            async with _second(server) as second:
                await second.still_served()
            await good.still_served()


async def test_an_address_that_fails_too_often_is_cut_off(victim: Start) -> None:
    """An address that guesses keys is, after some failures, cut before it sends anything; other
    addresses are served."""
    limits = {"handshakes": 0.001, "handshakes_at_once": 10, "spare_loopback": False}
    server = victim(key=KEY.hex(), limits=limits)
    async with server.good_client() as good:
        codes = []
        for _ in range(20):
            stranger = await Stranger.at(server, source="127.0.0.2")
            await wrong_key(stranger)
            codes.append(await stranger.refused())
            stranger.close()
        assert codes[:10] == ["wrong_key"] * 10 and set(codes[12:]) == {""}
        assert server.about()["faults"]["knocks"] >= 8
        await good.still_served()
        async with _second(server) as second:
            await second.still_served()


async def test_a_flood_of_messages_is_limited(victim: Start) -> None:
    """A caller that sends far more than allowed is disconnected, one that sends a little more is
    delayed; others are not affected."""
    server = victim(limits={"messages": 500.0, "messages_at_once": 1_000})
    usual = victim(limits={"messages": 60_000.0, "messages_at_once": 1_000})
    for one, stays in ((server, False), (usual, True)):
        async with one.good_client() as good:
            flood = await Stranger.at(one)
            await flood.open(None, STRANGE)
            burst = b"".join(frame(m.Ping(n)) for n in range(4_000))
            sending = asyncio.create_task(_flood(flood, burst))
            about, limit = dict[str, Any](), Limit("the server to notice the flood")
            # A part that comes alone may only be delayed: who sends on is disconnected later.
            while (
                not about.get("faults", {}).get("too_fast")
                or ("mallory" in about["connected"]) is not stays
            ) and limit.left():
                await good.still_served(30)
                about = await asyncio.to_thread(one.about)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            flood.writer.transport.abort()  # not closed: closing would wait for unsent data
            await good.still_served()
        assert one.grown() < TOLERATED


async def _flood(stranger: Stranger, burst: bytes) -> None:
    """Send until the connection ends: a silent caller would be lost for another reason."""

    async def swallow() -> None:
        while _swallowed := await stranger.reader.read(1 << 16):
            pass

    swallowing = asyncio.create_task(swallow())
    try:
        with contextlib.suppress(ConnectionError):
            while True:
                stranger.writer.write(burst)
                await stranger.writer.drain()
    finally:
        swallowing.cancel()
        await asyncio.gather(swallowing, return_exceptions=True)


@pytest.mark.parametrize("reads", [0, 10], ids=["never reads", "reads 10 bytes a second"])
async def test_a_caller_that_does_not_read_is_cut_off(victim: Start, reads: int) -> None:
    """Its results pile up at the server, up to a limit; others are not affected."""
    server = victim(keeping={"result_bytes": 8 * MIB})
    async with server.good_client() as good:
        stranger = await Stranger.at(server)
        await stranger.open(None, STRANGE)
        stranger.writer.transport.pause_reading()  # type: ignore[attr-defined]
        sock = stranger.writer.transport.get_extra_info("socket")
        limit, number = Limit("the server to cut it off"), 0
        connected = True
        while connected and limit.left():
            with contextlib.suppress(ConnectionError):
                calls = [m.Call(f"m/{number + n}", "big", {"bytes": MIB // 2}) for n in range(20)]
                number += len(calls)
                await stranger.say(b"".join(map(frame, calls)) + frame(m.Ping(number)))
            if reads:
                with contextlib.suppress(OSError):
                    os.read(sock.fileno(), reads)
            await beat(1.0)
            connected = "mallory" in (await asyncio.to_thread(server.about))["connected"]
        await good.still_served()
        stranger.writer.transport.abort()
    assert server.grown() < 64 * MIB + TOLERATED


async def test_unacknowledged_results_do_not_fill_the_memory(victim: Start) -> None:
    """A caller acknowledges nothing: the results kept for it are limited in bytes, not only in
    number."""
    server = victim(keeping={"result_bytes": 8 * MIB}, timing={"silence": 60.0})
    async with server.good_client() as good:
        stranger = await Stranger.at(server)
        await stranger.open(None, STRANGE)
        for number in range(80):
            await stranger.say(frame(m.Call(f"m/{number}", "big", {"bytes": MIB // 2})))
            while not isinstance(answer := await stranger.hears(), m.Outcome):
                await stranger.say(frame(m.Pong(1)))
            assert answer.status == "success"
        stranger.said = stranger.heard = b""
        await stranger.say(frame(m.Call("m/79", "big", {"bytes": 1})))
        kept = await stranger.hears()
        assert isinstance(kept, m.Outcome) and len(kept.values["b"]) == MIB // 2, (
            "the newest is still there"
        )
        await stranger.say(frame(m.Call("m/0", "big", {"bytes": 1})))
        forgotten = await stranger.hears()
        assert isinstance(forgotten, m.Outcome) and forgotten.cause == "forgotten"
        await good.still_served()
        stranger.close()
    assert server.grown() < 8 * MIB + TOLERATED


# --- random bytes -----------------------------------------------------------------------------


def random_bytes(chance: random.Random) -> bytes:
    """Return the bytes of one connection: noise, or a valid beginning with some bytes changed."""
    good = bytearray(
        frame(STRANGE) + frame(m.Call("m/1", "echo", {"x": [1, 2, {"y": "z"}]})) + frame(m.Ping(1))
    )
    if chance.random() < 0.3:
        return chance.randbytes(chance.randrange(1, 400))
    for _ in range(chance.randrange(1, 6)):
        good[chance.randrange(len(good))] = chance.randrange(256)
    if chance.random() < 0.3:
        good += chance.randbytes(chance.randrange(1, 5_000))
    return bytes(good)


async def _bombard(server: Victim, over: Callable[[int], bool], seed: int) -> int:
    chance, sent, limit = random.Random(seed), 0, Limit("the end of the bombardment", 300.0)
    while not over(sent) and limit.left():
        with contextlib.suppress(ConnectionError):
            stranger = await Stranger.at(server)
            await stranger.say(random_bytes(chance))
            stranger.writer.transport.abort()
        sent += 1
    return sent


@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "sealed"])
async def test_random_bytes(victim: Start, keyed: bool) -> None:
    """A few hundred connections send random bytes."""
    server = victim(**({"key": KEY.hex()} if keyed else {}))
    async with server.good_client() as good:
        await asyncio.gather(*(_bombard(server, lambda n: n >= 100, seed) for seed in range(4)))
        await good.still_served()
    assert server.grown() < TOLERATED


@pytest.mark.proof
@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "sealed"])
async def test_random_bytes_for_minutes(victim: Start, keyed: bool) -> None:
    """The same for two minutes each."""
    server = victim(**({"key": KEY.hex()} if keyed else {}))
    end = time.monotonic() + 120.0
    async with server.good_client() as good:
        sent = await asyncio.gather(
            *(_bombard(server, lambda _: time.monotonic() > end, s) for s in range(4))
        )
        assert sum(sent) > 1_000
        await good.still_served()
        await server.only_link()
    assert server.grown() < TOLERATED


def feed(data: bytes) -> None:
    """Feed these bytes to both ends of the protocol, in every state that a stranger can reach; only
    ProtocolError is allowed."""
    for key in (None, KEY):
        for side in Side:
            connection = Connection(side, "vision", key=key, nonce=bytes(32) if key else b"")
            if side is Side.CLIENT:
                connection.send(HELLO)
            try:
                for message in connection.receive_data(data):
                    if isinstance(message, m.Hello):
                        connection.send(m.Welcome(2, "vision", "v1"))
                connection.receive_data(data)
            except ProtocolError as refused:
                assert refused.code and refused.text, "a refusal says why"


@given(st.binary(max_size=600), st.integers(0, 200), st.integers(0, 15))
@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_arbitrary_bytes_raise_nothing_but_protocol_error(
    data: bytes, kept: int, which: int
) -> None:
    """As the first bytes, and after a valid beginning."""
    feed(data)
    feed(beginnings()[which][:kept] + data)


def beginnings() -> list[bytes]:
    """Return valid sessions to begin with: HELLO, then one message of each kind that a client may
    send."""
    said: list[m.Message] = [
        m.Call("m/1", "echo", {"x": [1, 2.5, {"y": b"z"}]}, 2.0),
        m.ResultAck("m/1", ("m/2",)),
        m.Cancel("m/1", "why"),
        m.EventAck("s", 3),
        m.Subscribe(("a", "b")),
        m.Command("c", "hold", "arm", {"run": "r"}),
        m.Ping(1),
        m.Tick(0),
        m.StreamOpen("points", 0.02, "t"),
        m.SetPoint(1, (1.0, 2.0)),
        m.Withdraw(),
        m.Bye("x"),
        m.Refuse("c", "t"),
    ]
    back: list[m.Message] = [
        m.Welcome(2, "v", "b", ("echo",)),
        m.Challenge(bytes(32)),
        m.Outcome("m/1", "success", {"n": 1}),
    ]
    return [frame(STRANGE) + frame(one) for one in said] + [frame(one) for one in back]


FUZZ = """
import sys, pathlib
sys.path.insert(0, {root!r})
import atheris
with atheris.instrument_imports(include=["petrobot.services.comm"]):
    from tests.security.test_attacks import beginnings, feed
for number, data in enumerate(beginnings()):
    pathlib.Path({corpus!r}, str(number)).write_bytes(data)
limits = ["-max_total_time={seconds}", "-max_len=4096", "-rss_limit_mb=1024"]
atheris.Setup([sys.argv[0], {corpus!r}, *limits], feed)
atheris.Fuzz()
"""


@pytest.mark.proof
def test_coverage_guided_bytes_for_minutes(tmp_path: Path) -> None:
    """Three minutes of atheris, if it is installed: it searches for bytes that reach new code."""
    pytest.importorskip("atheris")
    script = FUZZ.format(
        root=str(Path(__file__).resolve().parents[2]), corpus=str(tmp_path), seconds=180
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
