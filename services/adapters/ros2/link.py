"""The connection to rosbridge: a WebSocket in a thread of its own, or a simulated robot."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import json
import logging
import threading
from collections import deque
from collections.abc import Iterable
from typing import Any

import aiohttp

from petrobot.services.adapters.ros2.protocol import Message, parse

_log = logging.getLogger(__name__)
WAITING = 1000
"""Most messages that wait in each direction. With so many received ones the link stops reading;
with so many unsent ones it disconnects."""
LARGEST = 4 << 20
"""Bytes of the largest message that is received."""
FIRST_PAUSE, LONGEST_PAUSE = 0.2, 5.0
"""Seconds between two attempts to connect: doubled each time."""

Item = tuple[str, Any]
"""One report of a link: ("up", number of the connection), ("down", reason), ("message", message) or
("refused", reason)."""


class WebSocketLink:
    """Keeps one connection to `url` (ws:// or wss://) open, and connects again when it breaks."""

    def __init__(self, url: str, heartbeat: float) -> None:
        """After `heartbeat` s without a message the server must answer a ping (0: no pings)."""
        self._url, self._heartbeat = url, heartbeat or None
        self._inbox: deque[Item] = deque()
        self._epoch = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._outbox: asyncio.Queue[str] | None = None
        self._task: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="rosbridge", daemon=True)
        self._thread.start()

    def poll(self, now: float) -> list[Item]:
        """Return the reports since the last call, in order."""
        return [self._inbox.popleft() for _ in range(len(self._inbox))]

    def send(self, now: float, epoch: int, messages: Iterable[Message]) -> None:
        """Send messages over a connection, if it is still the newest. Never waits."""
        texts = [json.dumps(message, allow_nan=False) for message in messages]
        if texts and self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._put, epoch, texts)

    def close(self) -> None:
        """End the connection and its thread, after all messages were sent."""
        self._closed = True
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._finish)
        self._thread.join(1.0)

    def _finish(self) -> None:
        self._over.set()
        if self._task is not None:
            self._task.cancel()

    def _put(self, epoch: int, texts: list[str]) -> None:
        if epoch != self._epoch or self._outbox is None:
            return
        try:
            for text in texts:
                self._outbox.put_nowait(text)
        except asyncio.QueueFull:
            _log.error("%s does not read what it is sent; the connection is closed", self._url)
            self._outbox = None
            assert self._task is not None
            self._task.cancel("full")

    def _run(self) -> None:
        asyncio.run(self._connect_forever())

    async def _connect_forever(self) -> None:
        self._loop, pause = asyncio.get_running_loop(), FIRST_PAUSE
        async with aiohttp.ClientSession(trust_env=False) as session:
            while not self._closed:
                self._task, begun = asyncio.create_task(self._connect(session)), self._loop.time()
                (ended,) = await asyncio.gather(self._task, return_exceptions=True)
                why = str(ended) or type(ended).__name__ if ended else "closed by rosbridge"
                self._outbox = None
                self._inbox.append(("down", why))
                if self._loop.time() - begun > LONGEST_PAUSE:
                    pause = FIRST_PAUSE
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._over.wait(), pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    async def _connect(self, session: aiohttp.ClientSession) -> None:
        async with asyncio.timeout(LONGEST_PAUSE):
            socket = await session.ws_connect(
                self._url, heartbeat=self._heartbeat, max_msg_size=LARGEST, autoping=True
            )
        async with socket:
            outbox = self._outbox = asyncio.Queue(WAITING)
            self._epoch += 1
            self._inbox.append(("up", self._epoch))
            writer = asyncio.create_task(self._write(socket, outbox))
            try:
                await self._read(socket)
            finally:
                if self._closed:  # messages that were sent just before, such as cancels
                    with contextlib.suppress(Exception):
                        while not outbox.empty():
                            await asyncio.wait_for(socket.send_str(outbox.get_nowait()), 0.5)
                writer.cancel()

    async def _read(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        async for frame in socket:
            if frame.type is aiohttp.WSMsgType.TEXT:
                try:
                    self._inbox.append(("message", parse(frame.data)))
                except ValueError as fault:
                    self._inbox.append(("refused", str(fault)))
            elif frame.type is aiohttp.WSMsgType.ERROR:
                raise ConnectionError(f"broken: {socket.exception()}")
            else:
                self._inbox.append(("refused", "a binary message"))
            while len(self._inbox) >= WAITING:  # the driver is busy: let the server wait
                await asyncio.sleep(0.01)

    async def _write(
        self, socket: aiohttp.ClientWebSocketResponse, outbox: asyncio.Queue[str]
    ) -> None:
        while True:
            text = await outbox.get()
            try:
                await socket.send_str(text)
            except (OSError, aiohttp.ClientError):
                return  # the reader notices


class SimulatedLink:
    """Replaces rosbridge by a simulated robot of the user: a class with `receive(now, message)` and
    `step(now)`, which return the messages that rosbridge would send."""

    def __init__(self, path: str) -> None:
        module, _, name = path.partition(":")
        self._robot = getattr(importlib.import_module(module), name)()
        self._inbox: list[Item] = [("up", 1)]

    def poll(self, now: float) -> list[Item]:
        """Return what the robot has sent."""
        self._take(self._robot.step(now))
        items, self._inbox = self._inbox, []
        return items

    def send(self, now: float, epoch: int, messages: Iterable[Message]) -> None:
        """Pass messages to the robot."""
        for message in messages:
            self._take(self._robot.receive(now, json.loads(json.dumps(message, allow_nan=False))))

    def close(self) -> None:
        """Do nothing."""

    def _take(self, messages: Iterable[Message]) -> None:
        self._inbox += [
            ("message", parse(json.dumps(message, allow_nan=False))) for message in messages
        ]
