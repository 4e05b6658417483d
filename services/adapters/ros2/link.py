"""The connection to rosbridge: a WebSocket in a thread of its own, or a simulated robot."""

from __future__ import annotations

import asyncio
import importlib
import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Protocol

import aiohttp

from petrobot import SessionThread
from petrobot.services.adapters.ros2.protocol import LARGEST, Message, parse

CONNECTING = 5.0
"""Limit of an attempt to connect (s)."""


class RosbridgeLink(Protocol):
    """What a driver uses of `SessionThread`, or of a simulation in its place. Its news are ("up",
    None), ("down", why), ("message", message) and ("refused", why)."""

    up: bool
    count: int
    why: str

    def news(self) -> Iterator[tuple[str, Any]]:
        """Remove and return what has come."""

    def send(self, item: Message) -> None:
        """Send a message."""

    def close(self) -> None:
        """End the connection."""


def connect(url: str, heartbeat: float) -> SessionThread:
    """Keep a connection to `url` (ws:// or wss://) open. After `heartbeat` s without a message the
    server must answer a ping (0: no pings)."""
    return SessionThread(partial(_serve, url, heartbeat or None))


async def _serve(url: str, heartbeat: float | None, session: SessionThread) -> None:
    async with aiohttp.ClientSession(trust_env=False) as http:
        async with asyncio.timeout(CONNECTING):
            socket = await http.ws_connect(url, heartbeat=heartbeat, max_msg_size=LARGEST)
        async with socket:
            session.opened()
            both = [asyncio.create_task(end(session, socket)) for end in (_read, _write)]
            try:
                done, _ = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            finally:
                for task in both:
                    task.cancel()


async def _read(session: SessionThread, socket: aiohttp.ClientWebSocketResponse) -> None:
    async for frame in socket:
        if frame.type is aiohttp.WSMsgType.TEXT:
            try:
                session.tell("message", parse(frame.data))
            except ValueError as fault:
                session.tell("refused", str(fault))
        elif frame.type is aiohttp.WSMsgType.ERROR:
            raise ConnectionError(f"broken: {socket.exception()}")
        else:
            session.tell("refused", "a binary message")
        await session.room()  # the driver is busy: let the server wait


async def _write(session: SessionThread, socket: aiohttp.ClientWebSocketResponse) -> None:
    while (message := await session.get()) is not None:
        await socket.send_str(json.dumps(message, allow_nan=False))


class SimulatedLink:
    """Replaces rosbridge by a simulated robot of the user: a class with `receive(now, message)` and
    `step(now)`, which return the messages that rosbridge would send."""

    def __init__(self, path: str, clock: Callable[[], float]) -> None:
        module, _, name = path.partition(":")
        self._robot, self._clock = getattr(importlib.import_module(module), name)(), clock
        self._news: list[tuple[str, Any]] = [("up", None)]
        self.up, self.count, self.why = False, 0, "not connected yet"

    def news(self) -> Iterator[tuple[str, Any]]:
        """Return what the robot has sent."""
        self._take(self._robot.step(self._clock()))
        found, self._news = self._news, []
        self.up, self.count = True, 1
        yield from found

    def send(self, item: Message) -> None:
        """Pass a message to the robot."""
        self._take(self._robot.receive(self._clock(), _copy(item)))

    def close(self) -> None:
        """Do nothing."""

    def _take(self, messages: Iterable[Message]) -> None:
        self._news += [("message", _copy(message)) for message in messages]


def _copy(message: Message) -> Message:
    return parse(json.dumps(message, allow_nan=False))
