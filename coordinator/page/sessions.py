"""The WebSocket of one client: a snapshot, then merged deltas as fast as the client reads them, and
its commands."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from petrobot.coordinator.operator.changes import Pending
from petrobot.coordinator.operator.port import PROTOCOL, VERBS, MissionPort
from petrobot.services.host.json_text import json_text

LONGEST_FAULT = 400
SEND_S = 8.0
"""A client that reads nothing for this long (s) is disconnected; it connects again by itself."""
HELLO_S = 5.0
ALIVE_S = 1.0
PACE_S = 0.012
"""Pause between two deltas to one client (s): no screen needs more."""
COMMANDS_AT_ONCE = 8
NUMBERS_KEPT = 256
"""How many numbers of commands are remembered, so that none is carried out twice."""
MESSAGES_PER_S = 60
LARGEST_MESSAGE = 256 * 1024
LARGEST_SNAPSHOT = 64 * 1024 * 1024
"""For clients: the size of the largest message from the server (with all newest images)."""

_NAME = re.compile(r"[^\w .'-]+")
Encode = Callable[[dict[str, Any]], str]


class BadMessageError(Exception):
    """A client sent an invalid message; the text is sent as the reason of the close."""


def encode(message: Mapping[str, Any]) -> str:
    """Encode a message as JSON text. No value ends the feed or makes the message unreadable."""
    return json_text(message, separators=(",", ":"))


def who_is(name: str, tab: str) -> str:
    """Return a client's name for all others: its name and four digits of its tab's secret, so that
    two clients with one name differ."""
    clean = _NAME.sub("", name).strip()[:24] or "operator"
    return f"{clean} {hashlib.sha256(tab.encode()).hexdigest()[:4]}"


def hang_up(transport: asyncio.Transport | None) -> None:
    """Close a connection at once. `close` waits until its client has read everything: for ever, if
    the client is frozen."""
    if transport is not None:
        transport.abort()


class Session:
    """One connected client."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        transport: asyncio.Transport | None,
        port: MissionPort,
        encoded: Encode,
        commands: set[asyncio.Task[None]],
    ) -> None:
        self._socket = socket
        self._transport = transport
        self._port = port
        self._encoded = encoded
        # Held by the server: a command continues when its client leaves.
        self._all_commands = commands
        self._pending = Pending()
        self._news = asyncio.Event()
        self._answers: list[dict[str, Any]] = []
        self._commands = 0
        self._numbers: deque[int] = deque(maxlen=NUMBERS_KEPT)
        # A token bucket: a second's worth may come at once, as after a stall of the network.
        self._budget = float(MESSAGES_PER_S)
        self._budget_at = asyncio.get_running_loop().time()
        self.who = ""

    async def run(self) -> None:
        """Serve the client until it leaves."""
        try:
            await self._meet()
            stop = self._port.subscribe(self._receive)
            self._pending.stale = True  # The first message is a snapshot.
            self._news.set()
            sender = asyncio.create_task(self._send_all())
            try:
                await self._read_all(sender)
            finally:
                stop()
                await _end(sender)
        except BadMessageError as fault:
            await self._close(WSCloseCode.POLICY_VIOLATION, str(fault).encode()[:120])
        except (ConnectionError, TimeoutError):
            await self._close(WSCloseCode.TRY_AGAIN_LATER)

    async def leave(self) -> None:
        """Close the connection properly, as when the server ends."""
        with contextlib.suppress(Exception):
            async with asyncio.timeout(1.0):
                if self._pending and not self._pending.stale:
                    await self._send(self._encoded(self._pending.take()))  # the reason of the end
                answers, self._answers = self._answers, []
                for answer in answers:
                    await self._send(encode(answer))
                await self._socket.close(
                    code=WSCloseCode.GOING_AWAY, message=b"the coordinator has ended"
                )

    def _receive(self, change: dict[str, Any]) -> None:
        self._pending.add(change)
        self._news.set()

    async def _meet(self) -> None:
        async with asyncio.timeout(HELLO_S):
            hello = _plain(await self._socket.receive())
        if hello.get("type") != "hello" or hello.get("protocol") != PROTOCOL:
            raise BadMessageError(f"say hello first, with protocol {PROTOCOL}")
        self.who = who_is(str(hello.get("name", "")), str(hello.get("tab", "")))

    async def _read_all(self, sender: asyncio.Task[None]) -> None:
        async for message in self._socket:
            if sender.done():
                break
            self._spend()
            self._take(_plain(message))

    def _spend(self) -> None:
        now = asyncio.get_running_loop().time()
        self._budget = min(MESSAGES_PER_S, self._budget + (now - self._budget_at) * MESSAGES_PER_S)
        self._budget_at = now
        self._budget -= 1
        if self._budget < 0:
            raise BadMessageError("too many messages a second")

    def _take(self, message: Mapping[str, Any]) -> None:
        kind = message.get("type")
        if kind == "resync":
            self._pending.stale = True
            self._news.set()
        elif kind == "command":
            self._begin(message)
        else:
            raise BadMessageError("unknown type of message")

    def _begin(self, message: Mapping[str, Any]) -> None:
        number, verb, data = message.get("id"), message.get("verb"), message.get("data", {})
        if not isinstance(number, int) or not isinstance(data, dict):
            raise BadMessageError("a command needs an integer id and an object as data")
        if number in self._numbers:
            self._answer(
                number,
                {"ok": False, "code": "replayed", "text": f"command {number} was given before"},
            )
            return
        self._numbers.append(number)
        if verb != "estop" and self._commands >= COMMANDS_AT_ONCE:
            self._answer(
                number,
                {"ok": False, "code": "busy", "text": "wait for the answers to earlier commands"},
            )
            return
        task = asyncio.create_task(self._carry_out(number, str(verb), data))
        self._all_commands.add(task)
        task.add_done_callback(self._all_commands.discard)

    async def _carry_out(self, number: int, verb: str, data: Mapping[str, Any]) -> None:
        self._commands += 1
        try:
            self._answer(number, await carry_out(self._port, self.who, verb, data))
        finally:
            self._commands -= 1

    def _answer(self, number: int, answer: Mapping[str, Any]) -> None:
        self._answers.append({**answer, "type": "answer", "id": number})
        self._news.set()

    async def _send_all(self) -> None:
        try:
            while not self._socket.closed:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(ALIVE_S):
                        await self._news.wait()
                await self._send_news()
        except (ConnectionError, TimeoutError):
            await self._close(WSCloseCode.TRY_AGAIN_LATER)

    async def _send_news(self) -> None:
        quiet = not self._news.is_set()
        self._news.clear()
        answers, self._answers = self._answers, []
        delta = bool(self._pending) and not self._pending.stale
        if self._pending.stale:
            await self._send_snapshot()
        elif delta:
            await self._send(self._encoded(self._pending.take()))
        # After the changes by the command, so that its client has seen them.
        for answer in answers:
            await self._send(encode(answer))
        if delta:
            await asyncio.sleep(PACE_S)
        elif quiet and not answers:
            await self._send('{"type":"alive"}')

    async def _send_snapshot(self) -> None:
        self._pending.clear()
        snapshot = self._port.snapshot()
        await self._send(
            encode({**snapshot, "type": "snapshot", "protocol": PROTOCOL, "you": self.who})
        )

    async def _send(self, text: str) -> None:
        async with asyncio.timeout(SEND_S):
            await self._socket.send_str(text)

    async def _close(self, code: WSCloseCode, reason: bytes = b"") -> None:
        try:
            with contextlib.suppress(Exception):
                async with asyncio.timeout(1.0):
                    await self._socket.close(code=code, message=reason)
        finally:  # also when this task is cancelled, because `_read_all` saw the end
            hang_up(self._transport)


async def carry_out(
    port: MissionPort, who: str, verb: str, data: Mapping[str, Any]
) -> dict[str, Any]:
    """Pass a command to the mission; an exception there becomes an answer, so that every command is
    answered."""
    if verb not in VERBS:
        return {"ok": False, "code": "unknown_command", "text": f"no command {verb[:40]!r}"}
    try:
        return await port.command(who, verb, data)
    except Exception as fault:
        return {
            "ok": False,
            "code": "fault",
            "text": f"{verb} failed: {type(fault).__name__}: {str(fault)[:LONGEST_FAULT]}",
        }


def _plain(message: Any) -> dict[str, Any]:
    if message.type is not WSMsgType.TEXT:
        raise BadMessageError("send JSON text")
    try:
        value = json.loads(message.data)
    except (ValueError, RecursionError):
        raise BadMessageError("send JSON text") from None
    if not isinstance(value, dict):
        raise BadMessageError("send one JSON object")
    return value


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
