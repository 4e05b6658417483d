"""Server and client on real sockets: calls, commands and events, liveness, and refused callers."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import re
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

import pytest

from petrobot.services.comm.calls.caller import Notice, Patience, PeerLost
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Answer, Executed, Outcome, Welcome
from petrobot.services.comm.protocol.security import KeyNeededError
from tests import waiting
from tests.comm.ends import Coordinator, Node, slow_line, until
from tests.ports import free_ports


async def test_a_service_and_an_action(node: Node, key: bytes | None) -> None:
    coordinator = node.client(key=key)
    assert await coordinator.client.connected(60.0)
    outcome = await coordinator.client.call("echo", {"x": [1, 2.5, "a", b"b", None]}, deadline=1.0)
    assert outcome.status == "success" and outcome.values == {"x": [1, 2.5, "a", b"b", None]}
    many = await asyncio.gather(*(coordinator.client.call("echo", {"n": n}) for n in range(200)))
    assert [one.values["n"] for one in many] == list(range(200))
    coordinator.call("1", "move", to=1)
    start = await node.order(m.Call)
    assert start.id == "1"
    callee = node.server.callee
    callee.feedback(node.server.now(), "1", 0.5)
    callee.finish(node.server.now(), m.Outcome("1", "success", {"p": 1}))
    node.server.flush()
    assert (await coordinator.notice(Outcome)).values == {"p": 1}
    coordinator.caller.acknowledge(coordinator.client.now(), "1")
    coordinator.client.flush()
    await until(lambda: not callee._results.of("coord"))
    await coordinator.client.close()
    await until(lambda: node.server.connected == ())


@pytest.mark.parametrize("turns", range(5))
async def test_a_connection_accepted_while_the_server_closes_is_closed(turns: int) -> None:
    """asyncio accepted it in one turn of the loop, and the server was closed before the next: the
    connection was left to the garbage collector."""
    node = Node()
    await node.server.start("127.0.0.1", 0)
    with warnings.catch_warnings(record=True) as seen, socket.socket() as client:
        warnings.simplefilter("always")
        client.connect(node.server.address)
        for _ in range(turns):
            await asyncio.sleep(0)
        await node.server.close()
        gc.collect()
        client.setblocking(False)
        with contextlib.suppress(ConnectionResetError):
            async with asyncio.timeout(60.0):
                assert await asyncio.get_running_loop().sock_recv(client, 1) == b""
    assert [str(one.message) for one in seen] == []


async def test_names_that_nobody_resolves_delay_no_other_peer(
    node: Node, key: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They blocked all threads of the loop's executor, so another peer was not reached, and the
    process did not end, until the name server had answered."""
    answered, known = threading.Event(), socket.getaddrinfo

    def look_up(host: str, *rest: Any, **options: Any) -> list[Any]:
        if host.endswith(".example"):
            answered.wait(120.0)
            raise socket.gaierror(socket.EAI_AGAIN, "no answer")
        return known(host, *rest, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    _, port = node.server.address
    absent = [Coordinator(f"absent{n}.example", port) for n in range(40)]
    there = Coordinator("localhost", port, key=key)
    try:
        assert await there.client.connected(60.0)
        assert not answered.is_set()
    finally:
        answered.set()
        for one in (*absent, there):
            await one.client.close()


def named(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> str:
    """Return a host's name that stands for these addresses."""
    known, name = socket.getaddrinfo, "robot.example"

    def look_up(host: str, *rest: Any, **options: Any) -> list[Any]:
        those = addresses if host == name else (host,)
        return [found for one in those for found in known(one, *rest, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    return name


async def complains(client: Client, why: str) -> None:
    """Wait until a client says why it has no connection."""
    await until(lambda: re.match(why, client.trouble) is not None)


@contextlib.contextmanager
def dead_address(port: int) -> Iterator[None]:
    """Let 127.0.0.2 answer nothing at a port: its queue is full, so the kernel drops what comes."""
    with contextlib.ExitStack() as held:
        silent = held.enter_context(socket.create_server(("127.0.0.2", port), backlog=0))
        for _ in range(4):
            one = held.enter_context(socket.socket())
            one.setblocking(False)
            one.connect_ex(silent.getsockname())
        yield


async def test_a_host_that_answers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    (port,) = free_ports(1)
    with dead_address(port):
        for host, why in (
            (named(monkeypatch, "127.0.0.2"), f"no answer: .* its firewall let TCP port {port} "),
            ("127.0.0.2", "no answer$"),
        ):
            client = Coordinator(host, port).client
            await complains(client, why)
            await client.close()


@pytest.mark.parametrize(
    ("other", "why"),
    [("127.0.0.2", "connection refused"), ("255.255.255.255", r"[a-z ]+, connection refused")],
)
async def test_why_none_of_several_addresses_answers(
    other: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (port,) = free_ports(1)
    coordinator = Coordinator(named(monkeypatch, other, "127.0.0.1"), port)
    await complains(coordinator.client, f"{why}$")
    await coordinator.client.close()


async def test_a_peer_is_reached_though_one_of_its_addresses_is_dead(
    node: Node, key: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name with two addresses, as of a computer with a cable and a radio link: each attempt ended
    while it waited for the first one, so the second was never tried."""
    _, port = node.server.address
    name = named(monkeypatch, "127.0.0.2", "127.0.0.1")
    with dead_address(port):
        coordinator = Coordinator(name, port, key=key)
        try:
            assert await coordinator.client.connected(60.0)
        finally:
            await coordinator.client.close()


async def test_calls_of_several_clients_of_a_process_have_different_ids(open_node: Node) -> None:
    other = Node()
    await other.server.start("127.0.0.1", 0)
    first, second = open_node.client(), other.client()
    calls = [asyncio.ensure_future(one.client.call("move")) for one in (first, second)]
    ids = {(await node.order(m.Call)).id for node in (open_node, other)}
    assert len(ids) == 2, "one of them is the parent or the key of something else"
    for call, node, told in zip(calls, (open_node, other), (first, second), strict=True):
        callee = node.server.callee
        callee.finish(node.server.now(), Outcome(next(iter(callee.running())), "success"))
        node.server.flush()
        assert (await call).status == "success"
        await told.client.close()
    await other.server.close()


async def test_an_accept_behind_many_events_is_not_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The coordinator needs longer for the events before it than it waits for ACCEPT."""
    open_node = Node(timing=LinkTiming())
    await open_node.server.start("127.0.0.1", 0)
    coordinator = open_node.client(timing=LinkTiming())
    coordinator.caller.patience = Patience(accept=0.1)
    longest = [0]

    def slow(now: float, notices: list[Notice]) -> None:
        time.sleep(0.0005 * len(notices))
        longest[0] = max(longest[0], len(notices))
        coordinator._take(now, notices)

    monkeypatch.setattr(coordinator.client, "_on_notices", slow)
    assert await coordinator.client.connected(60.0)
    coordinator.caller.subscribe(coordinator.client.now(), ("noise",))
    coordinator.client.flush()
    await until(lambda: bool(open_node.server.callee.events._listeners))
    for _ in range(2000):
        open_node.server.callee.raise_event(0.0, "noise", {"text": 100 * "x"}, latched=True)
    open_node.server.flush()
    outcome = await asyncio.wait_for(coordinator.client.call("echo", {"n": 1}), 60.0)
    assert outcome.values == {"n": 1}
    assert len([n for n in coordinator.notices if isinstance(n, m.Event)]) == 2000
    assert longest[0] < 200, "so many events are stored before anybody else is heard"
    await coordinator.client.close()
    await open_node.server.close()


@pytest.mark.parametrize("slow", ["up", "down"])
async def test_large_messages_on_a_slow_line_arrive(slow: str) -> None:
    """Sent over several times the silence and the wait for ACCEPT."""
    timing = LinkTiming(heartbeat=0.1, silence=0.5)
    node = Node(timing=timing)
    await node.server.start("127.0.0.1", 0)
    async with slow_line(node.server.address, **{slow: 3e6}) as address:
        coordinator = Coordinator(*address, timing=timing)
        coordinator.caller.patience = Patience(accept=0.3)
        assert await coordinator.client.connected(60.0)
        image = {"image": bytes(3 << 20)}
        calls = [coordinator.client.call("echo", image, deadline=0.1) for _ in range(2)]
        outcomes = await asyncio.wait_for(asyncio.gather(*calls), 60.0)
        assert [(one.status, one.cause, one.text) for one in outcomes] == 2 * [("success", "", "")]
        assert all(one.values == image for one in outcomes)
        assert not any(isinstance(notice, PeerLost) for notice in coordinator.notices)
        await coordinator.client.close()
    await node.server.close()


async def test_a_node_hears_its_caller_while_a_large_result_is_on_its_way() -> None:
    timing = LinkTiming(heartbeat=0.1, silence=0.5)
    node = Node(timing=timing)
    await node.server.start("127.0.0.1", 0)
    async with slow_line(node.server.address, down=3e6) as address:
        coordinator = Coordinator(*address, timing=timing)
        assert await coordinator.client.connected(60.0)
        image = {"image": bytes(7 << 20)}
        large = asyncio.ensure_future(coordinator.client.call("echo", image))
        await until(lambda: node.server._links["coord"].slow)
        coordinator.call("1", "move")
        assert (await node.order(m.Call)).id == "1"
        assert node.server._links["coord"].slow and not large.done()
        assert (await asyncio.wait_for(large, 60.0)).values == image
        await coordinator.client.close()
    await node.server.close()


async def test_a_command_and_an_event(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(60.0)
    coordinator.caller.command(coordinator.client.now(), m.Command("k1", "status"))
    coordinator.client.flush()
    await open_node.order(object)
    open_node.server.callee.answer(open_node.server.now(), "k1", True, {"arm": "held"})
    open_node.server.flush()
    assert (await coordinator.notice(Answer)).data == {"arm": "held"}
    await coordinator.client.close()


async def test_cancelling_the_future_cancels_the_call(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(60.0)
    task = asyncio.ensure_future(coordinator.client.call("move"))
    await open_node.order(m.Call)
    task.cancel()
    cancel = await open_node.order(m.Cancel)
    callee = open_node.server.callee
    callee.finish(open_node.server.now(), m.Outcome(cancel.id, "error", cause="cancelled"))
    open_node.server.flush()
    await until(lambda: not coordinator.caller.pending)
    await until(lambda: not callee._results.of("coord"))
    await coordinator.client.close()


async def test_a_result_or_call_too_large_for_a_frame_ends_only_that_call(
    node: Node, key: bytes | None
) -> None:
    coordinator = node.client(key=key)
    assert await coordinator.client.connected(60.0)
    huge, too_big, fine = await asyncio.gather(
        coordinator.client.call("big"),
        coordinator.client.call("echo", {"b": bytes(17 << 20)}),
        coordinator.client.call("echo", {"b": 1}),
    )
    assert (huge.cause, huge.executed) == ("bad_result", Executed.YES)
    assert (too_big.cause, too_big.executed) == ("too_large", Executed.NO)
    assert fine.status == "success"
    await coordinator.client.close()


async def test_the_heartbeat_keeps_an_idle_link_and_a_broken_one_is_restored(
    open_node: Node,
) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(60.0)
    link = open_node.server._links["coord"]
    await until(lambda: link._pings + coordinator.client._link._pings >= 6)  # type: ignore[union-attr]
    assert not any(isinstance(notice, PeerLost) for notice in coordinator.notices)
    coordinator.call("1", "move")
    await open_node.order(m.Call)
    link.cut("a fault")
    back = await coordinator.notice(Welcome, 2)
    assert back.boot == (await coordinator.notice(Welcome)).boot and back.runs == ("1",)
    assert not any(isinstance(order, m.Cancel) for order in open_node.orders)
    await coordinator.client.close()


async def test_a_call_outlives_a_host_that_stands_still(open_node: Node) -> None:
    """Both ends stand still for longer than the wait for ACCEPT."""
    coordinator = open_node.client()
    assert await coordinator.client.connected(60.0)
    coordinator.call("1", "move")
    time.sleep(coordinator.caller.patience.accept + 0.2)
    await open_node.order(m.Call)
    callee = open_node.server.callee
    callee.finish(open_node.server.now(), m.Outcome("1", "success"))
    open_node.server.flush()
    outcome = await coordinator.notice(Outcome)
    assert (outcome.status, outcome.text) == ("success", "")
    await coordinator.client.close()


async def test_a_run_whose_caller_is_gone_is_stopped(open_node: Node) -> None:
    coordinator = open_node.client()
    assert await coordinator.client.connected(60.0)
    coordinator.call("1", "move")
    await open_node.order(m.Call)
    await coordinator.client.close()
    assert (await open_node.order(m.Cancel)).reason == "orphan"


async def test_a_call_to_a_closed_port(open_node: Node) -> None:
    address = open_node.server.address
    await open_node.server.close()
    coordinator = Coordinator(*address)
    assert not await coordinator.client.connected(0.05)
    coordinator.caller.call(coordinator.client.now(), m.Call("1", "echo"))
    coordinator.caller.advance(coordinator.client.now() + 2.0)
    coordinator.client.flush()
    outcome = await coordinator.notice(Outcome)
    assert (outcome.cause, outcome.executed) == ("unreachable", Executed.NO)
    await coordinator.client.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
async def test_other_hosts_cannot_connect_without_a_key(host: str) -> None:
    with pytest.raises(KeyNeededError, match="motion: refuses to listen"):
        await Node().server.start(host, 0)


@pytest.mark.parametrize(
    ("hello", "key", "cause", "code"),
    [
        (m.Hello(3, 9, "coordinator", "coord", "c1"), None, "refused", "version"),
        (m.Hello(2, 2, "coordinator", "coord", "c1"), b"k" * 32, "unreachable", "no_key_here"),
    ],
)
async def test_a_refused_caller_gets_the_reason_and_its_calls_end(
    open_node: Node, hello: m.Hello, key: bytes | None, cause: str, code: str
) -> None:
    """Without a key they end at once; with a key, an unproven refusal ends nothing, and the client
    tries again. In both cases nobody waits for a connection until the time is over."""
    coordinator = open_node.client(hello, key=key)
    async with asyncio.timeout(60.0):
        assert not await coordinator.client.connected(10_000.0)
    outcome = await coordinator.client.call("echo")
    assert (outcome.cause, outcome.executed) == (cause, Executed.NO)
    assert code in outcome.text and ("unauthenticated refusal" in outcome.text) is (key is not None)
    await coordinator.client.close()


async def test_both_sides_report_a_wrong_key(key: bytes | None) -> None:
    node = Node(key=b"k" * 32)
    await node.server.start("127.0.0.1", 0)
    coordinator = node.client(key=key)
    outcome = await coordinator.client.call("echo")
    assert outcome.cause == ("unreachable" if key else "refused")
    assert (
        "unauthenticated refusal: wrong_key" if key else "refuses the connection: key_needed"
    ) in outcome.text
    assert set(node.server.faults) == {"wrong_key" if key else "key_needed"}
    await coordinator.client.close()
    await node.server.close()


async def test_a_second_process_of_a_name_is_refused_and_a_newer_epoch_takes_over(
    open_node: Node,
) -> None:
    first = open_node.client()
    assert await first.client.connected(60.0)
    second = open_node.client(m.Hello(2, 2, "coordinator", "coord", "c2", 1))
    outcome = await second.client.call("echo")
    assert "name_taken" in outcome.text
    assert not await second.client.connected(0.3)
    await first.client.close()  # it may end at any time: this one is waited for
    assert await second.client.connected(60.0)
    await second.client.close()
    first = open_node.client()
    assert await first.client.connected(60.0)
    third = open_node.client(m.Hello(2, 2, "coordinator", "coord", "c3", 2))
    assert await third.client.connected(60.0)
    await first.notice(PeerLost)
    outcome = await first.client.call("echo")
    assert "old_epoch" in outcome.text and outcome.executed is Executed.NO
    assert (await third.client.call("echo")).status == "success"
    await first.client.close()
    await third.client.close()


async def test_the_reason_of_a_failed_attempt_stays_while_the_next_one_is_under_way() -> None:
    """Else a refused emergency stop gave no reason if its time was over at that moment."""
    attempts: list[asyncio.StreamWriter] = []

    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        attempts.append(writer)
        if len(attempts) == 1:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    coordinator = Coordinator(*server.sockets[0].getsockname())
    await waiting.until(lambda: len(attempts) == 2, "a second attempt")
    assert coordinator.client.answered and coordinator.client.trouble
    await coordinator.client.close()
    for writer in attempts:
        writer.close()
    server.close()


async def test_a_program_that_is_not_a_node_is_suspected(key: bytes | None) -> None:
    """For example a web server at the port of a node."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    coordinator = Coordinator(*server.sockets[0].getsockname(), key=key)
    try:
        suspects = "is it a node of petrobot?"
        await waiting.until(lambda: coordinator.client.trouble.endswith(suspects), suspects)
    finally:
        await coordinator.client.close()
        server.close()
