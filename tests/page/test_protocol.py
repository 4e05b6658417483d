"""The live protocol over a real WebSocket: snapshot first, no gaps, slow clients, commands, and
which client may give them."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import pytest

from petrobot.coordinator.operator.changes import apply
from petrobot.coordinator.page import app_state, sessions
from petrobot.coordinator.page.server import Page
from tests.page.stage import Stage
from tests.waiting import beat, until


class Client:
    """A client in Python that keeps the state as the browser does."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.state: dict[str, Any] = {}
        self.deltas = 0
        self.snapshots = 0
        self.answers: dict[int, dict[str, Any]] = {}
        self._number = 0

    async def hear(self) -> str:
        """Receive and apply the next message; return its type. Fails on a gap in the numbers."""
        message = await self.socket.receive_json(timeout=60)
        kind = str(message["type"])
        if kind == "snapshot":
            self.snapshots += 1
            self.state = {k: v for k, v in message.items() if k not in ("type", "protocol")}
        elif kind == "delta":
            self.deltas += 1
            assert message["first"] == self.state["sequence"] + 1, (
                "a gap in the sequence of numbers"
            )
            for change in message["changes"]:
                apply(self.state, change)
            self.state["sequence"], self.state["time"] = message["last"], message["time"]
        elif kind == "answer":
            self.answers[message["id"]] = message
        return kind

    async def until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Receive messages until the condition holds."""
        async with asyncio.timeout(60):
            while not (self.state and holds(self.state)):
                await self.hear()
        return self.state

    async def command(self, verb: str, **data: Any) -> dict[str, Any]:
        """Give a command and wait for its answer."""
        self._number += 1
        await self.socket.send_json(
            {"type": "command", "id": self._number, "verb": verb, "data": data}
        )
        async with asyncio.timeout(60):
            while self._number not in self.answers:
                await self.hear()
        return self.answers[self._number]


@asynccontextmanager
async def joined(page: Page, name: str = "ana", tab: str = "1") -> AsyncIterator[Client]:
    """Connect a client and complete its hello."""
    address = page.url.partition("?")[0] + "api/live"
    headers = {"Authorization": f"Bearer {page.token}"}
    async with aiohttp.ClientSession() as http, http.ws_connect(address, headers=headers) as socket:
        await socket.send_json({"type": "hello", "protocol": 1, "name": name, "tab": tab})
        yield Client(socket)


async def test_clients_that_join_late_see_the_same(page: Page, stage: Stage) -> None:
    """A client that connects at any time reaches the server's state and misses no change."""
    async with joined(page) as first:
        await first.command("take_controls")
        assert (await first.command("start"))["ok"]
        stage.happen("part_there")
        await first.until(lambda s: s["marking"]["look"] == 1)
        async with joined(page, "ben", "2") as late:
            await late.until(lambda s: len(s["firings"]) >= 3)
            target = stage.feed.state["sequence"]
            await asyncio.gather(
                *(c.until(lambda s: s["sequence"] >= target) for c in (first, late))
            )
            assert (await first.command("pause"))["ok"]
            last = stage.feed.state["sequence"]
            await asyncio.gather(*(c.until(lambda s: s["sequence"] >= last) for c in (first, late)))
            for client in (first, late):
                assert {k: v for k, v in client.state.items() if k != "you"} == json.loads(
                    json.dumps(stage.snapshot())
                )


async def test_a_slow_client_gets_merged_changes_and_delays_no_other_client(
    page: Page, stage: Stage
) -> None:
    """A client that reads nothing for thousands of changes needs bounded memory and catches up with
    one message."""
    async with joined(page, "slow") as slow, joined(page, "quick", "2") as quick:
        await slow.until(lambda s: True)
        await quick.until(lambda s: True)
        blob = "x" * 20_000
        for number in range(3_000):
            stage.feed.emit("variable", name=f"v{number % 7}", value=[number, blob])
            if number % 60 == 0:
                await quick.hear()
        last = stage.feed.state["sequence"]
        await quick.until(lambda s: s["sequence"] == last)
        await slow.until(lambda s: s["sequence"] == last)
        assert slow.deltas + slow.snapshots < 200
        assert slow.state["variables"] == stage.feed.state["variables"]


def frozen(page: Page, path: str, *lines: str) -> socket.socket:
    """Send a request from a client that then reads nothing."""
    host = page.base.rpartition("/")[2]
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(("127.0.0.1", int(host.rpartition(":")[2])))
    token = f"Authorization: Bearer {page.token}"
    head = (f"GET {path} HTTP/1.1", f"Host: {host}", token, *lines, "", "")
    client.sendall("\r\n".join(head).encode())
    return client


@pytest.fixture
def large(stage: Stage) -> None:
    """A snapshot that is larger than what a connection holds on its way."""
    for number in range(40):
        stage.feed.emit("variable", name=f"v{number}", value="x" * 250_000)


@pytest.mark.usefixtures("large")
async def test_a_frozen_client_is_disconnected(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its session ended never, so it kept the controls and one of the connections."""
    monkeypatch.setattr(sessions, "SEND_S", 0.2)
    upgrade = ("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13")
    key = "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg=="
    hello = b'{"type":"hello","protocol":1,"name":"ana","tab":"1"}'
    with frozen(page, "/api/live", *upgrade, key) as client:
        client.sendall(bytes([0x81, 0x80 | len(hello)]) + bytes(4) + hello)
        await until(lambda: page.limit.open_connections == 1, "the client's connection")
        await until(lambda: page.limit.open_connections == 0, "the end of the connection")
    assert not page._page_state.sessions


@pytest.mark.usefixtures("large")
async def test_an_answer_that_is_not_read_does_not_outlive_the_page(page: Page) -> None:
    """Its connection was left open: `close` waits until the client has read everything."""
    with frozen(page, "/api/snapshot"):
        await until(page.limit.transports, "the client's connection")
        (transport,) = page.limit.transports()
        assert transport is not None
        await until(transport.get_write_buffer_size, "a part that is not read")
        await page.close()
        assert transport.get_write_buffer_size() == 0


async def test_too_many_firings_are_replaced_by_a_snapshot(page: Page, stage: Stage) -> None:
    """A burst that cannot be merged causes a new snapshot, not a backlog."""
    async with joined(page) as client:
        await client.until(lambda s: True)
        for number in range(5_000):
            stage.feed.emit(
                "fired", firing={"number": number, "transition": "begin", "at": 0.0, "error": False}
            )
        await client.until(lambda s: s["sequence"] == stage.feed.state["sequence"])
        assert client.snapshots == 2
        assert client.state["firings"][-1]["number"] == 4_999


async def test_one_client_holds_the_controls_and_others_ask_for_them(
    page: Page, stage: Stage
) -> None:
    """A second operator is refused, asks for the controls and gets them; every client may give an
    emergency stop."""
    async with joined(page) as ana, joined(page, "ben", "2") as ben:
        await ben.until(lambda s: True)
        assert (await ana.command("take_controls"))["ok"]
        refused = await ben.command("start")
        assert (refused["ok"], refused["code"]) == (False, "not_holder")
        assert (await ben.command("take_controls"))["code"] == "held"
        await ben.command("ask_controls")
        await ana.until(lambda s: s["controls"]["asking"] == [ben.state["you"]])
        await ana.command("release_controls", to=ben.state["you"])
        await ben.until(lambda s: s["controls"]["holder"] == s["you"])
        assert (await ben.command("start"))["ok"]
        assert (await ana.command("estop"))["ok"]
        await ben.until(lambda s: s["mission"]["state"] == "stopped")


async def test_controls_become_free_when_their_holder_is_gone(
    page: Page, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A holder whose last window was closed does not block others for ever; one that only reloads
    the page keeps them."""
    async with joined(page, "ben", "2") as ben:
        async with joined(page) as ana:
            await ana.command("take_controls")
        async with joined(page) as again:
            await again.until(lambda s: s["controls"]["holder"] == s["you"])
            await ben.command("ask_controls")
            assert ben.state["controls"]["holder"] is not None
            monkeypatch.setattr(app_state, "ABSENT_S", 0.3)  # not while she connects again
        await ben.until(lambda s: s["controls"]["holder"] is None)


async def test_a_command_is_completed_when_its_client_leaves(page: Page, stage: Stage) -> None:
    """It is carried out although its client no longer waits for the answer."""
    begun, go = asyncio.Event(), asyncio.Event()
    done: list[str] = []

    async def slow_stop(who: str, data: Any) -> dict[str, Any]:
        begun.set()
        await go.wait()
        done.append(who)
        return {"ok": True}

    stage.__dict__["_estop"] = slow_stop
    async with joined(page) as client:
        await client.socket.send_json({"type": "command", "id": 1, "verb": "estop", "data": {}})
        await asyncio.wait_for(begun.wait(), 60)
    go.set()
    await asyncio.wait_for(page.idle(), 60)
    assert len(done) == 1


async def test_the_command_that_ends_the_run_is_answered(page: Page, stage: Stage) -> None:
    """The coordinator closes while the command is being carried out; its client still gets the
    answer."""
    begun, closing = asyncio.Event(), asyncio.Event()

    async def last(who: str, data: Any) -> dict[str, Any]:
        begun.set()
        await closing.wait()
        return {"ok": True, "last": True}

    stage.__dict__["_estop"] = last
    async with joined(page) as client:
        asked = asyncio.create_task(client.command("estop"))
        await asyncio.wait_for(begun.wait(), 60)
        ended = asyncio.create_task(page.close())
        await beat(0)  # The coordinator has begun to close.
        closing.set()
        assert (await asked)["last"]
        await ended


async def test_an_exception_in_the_mission_is_answered(page: Page, stage: Stage) -> None:
    """A command that raises an exception is answered with the reason, and the connection stays
    open."""
    async with joined(page) as client:
        await client.command("take_controls")
        answer = await client.command("add_tokens")
        assert (answer["ok"], answer["code"]) == (False, "fault")
        assert "place" in answer["text"]
        assert (await client.command("no_such_thing"))["code"] == "unknown_command"


NONSENSE = (
    "no json",
    "[1, 2]",
    '{"type": "whatever"}',
    '{"type": "command", "id": "one", "verb": "pause"}',
    '{"type": "command", "id": 1, "verb": "pause", "data": 3}',
    "[" * 50_000,
)


@pytest.mark.parametrize("sent", [*NONSENSE, b"\x00\x01", b"{}", b"\xff" * 1_000, b""])
async def test_an_invalid_message_ends_the_connection_with_a_reason(
    page: Page, sent: str | bytes
) -> None:
    """A client that violates the protocol, which is text, gets a reason and is disconnected; other
    clients are not affected."""
    async with joined(page) as good, joined(page, "bad", "2") as bad:
        await good.until(lambda s: True)
        await bad.until(lambda s: True)
        send = bad.socket.send_bytes if isinstance(sent, bytes) else bad.socket.send_str
        await send(sent)  # type: ignore[arg-type]
        async with asyncio.timeout(60):
            while not bad.socket.closed:
                await bad.socket.receive()
        assert bad.socket.close_code == aiohttp.WSCloseCode.POLICY_VIOLATION
        assert (await good.command("take_controls"))["ok"]


async def test_a_client_that_floods_the_server_is_disconnected(page: Page) -> None:
    """More messages per second than any person can cause end the connection."""
    async with joined(page) as client:
        await client.until(lambda s: True)
        for _ in range(4 * sessions.MESSAGES_PER_S):
            await client.socket.send_str('{"type": "resync"}')
        async with asyncio.timeout(60):
            while not client.socket.closed:
                await client.socket.receive()
        assert client.socket.close_code == aiohttp.WSCloseCode.POLICY_VIOLATION


async def test_hello_comes_first(page: Page) -> None:
    """A client is served only after it has sent its name and a version that the server supports."""
    address = page.url.partition("?")[0] + "api/live"
    headers = {"Authorization": f"Bearer {page.token}"}
    for first in ({"type": "command", "id": 1, "verb": "estop"}, {"type": "hello", "protocol": 99}):
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(address, headers=headers) as socket,
        ):
            await socket.send_json(first)
            message = await socket.receive(timeout=60)
            assert message.type is aiohttp.WSMsgType.CLOSE


async def test_values_that_json_cannot_hold_do_not_end_the_connection(
    page: Page, stage: Stage
) -> None:
    """Infinities, not-a-numbers and objects outside JSON still reach the client in a readable
    form."""
    async with joined(page) as client:
        await client.until(lambda s: True)
        stage.feed.emit("variable", name="odd", value=[float("inf"), float("nan"), {1, 2}, 1 + 2j])
        await client.until(lambda s: "odd" in s["variables"])
        assert client.state["variables"]["odd"][3] == "(1+2j)"
