"""A session with a device whose library uses asyncio, kept open beside a driver's cycle."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import socket
import struct
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator
from typing import Any, Final

from petrobot.services.comm.protocol.plain import plain
from petrobot.services.comm.streams.line import PAUSES

_log = logging.getLogger(__name__)

WAITING: Final = 1000
"""Most items that wait in each direction: that bounds the memory, whatever one end does."""


class SessionThread:
    """Runs a session in a thread of its own, and begins it again, with growing pauses, when it
    ends. The driver's methods never wait for it, and are never called by it.

        self._session = SessionThread(self._serve)
        for kind, item in self._session.news(): ...            # in `step`
        self._session.send(message)

        async def _serve(self, session: SessionThread) -> None:  # in the session's thread
            async with library.connect() as device:
                session.opened()
                while (message := await session.get()) is not None:
                    await device.write(message)
    """

    def __init__(self, serve: Callable[[SessionThread], Awaitable[None]]) -> None:
        """`serve` is one session: what it raises says why there is none."""
        self.up = False
        """Whether there is a session, as far as `news` has shown."""
        self.count = 0
        """How many sessions `news` has shown: another number is another session."""
        self.why = "not connected yet"
        """Why there was none the last time."""
        self._serve, self._loop = serve, asyncio.new_event_loop()
        self._news: deque[tuple[str, Any]] = deque()
        self._outbox: asyncio.Queue[Any] = asyncio.Queue()
        self._task: asyncio.Future[Any] | None = None
        self._opened, self._stopped = 0, ""
        self._open = self._closing = False
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)
        self._thread.start()

    # --- for the driver

    def news(self) -> Iterator[tuple[str, Any]]:
        """Remove and return what the session has told, in order: the pairs of `tell`, ("up", item
        of `opened`), and ("down", why)."""
        for _ in range(len(self._news)):
            kind, item = self._news.popleft()
            if kind in ("up", "down"):
                before, self.up = self.why, kind == "up"
                self.why, self.count = str(item or "") if not self.up else "", self.count + self.up
                if not self.up and self.why != before:  # not at each attempt
                    _log.warning("no connection to the device: %s", self.why)
            yield kind, item

    def send(self, item: Any) -> None:
        """Send to the session that `news` has shown. When that has ended, the item is lost."""
        self._call(self._put, self.count, item)

    def close(self, wait: float = 1.0) -> None:
        """End the session after it has got all that was sent, or after `wait` seconds."""
        for end in (self._finish, self._cancel):
            self._call(end)
            self._thread.join(wait)

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # it is closed
            self._loop.call_soon_threadsafe(function, *arguments)

    # --- for the session

    def opened(self, item: Any = None, sock: Any = None) -> None:
        """Report that the session can be used. `sock` is its socket, as `get_extra_info("socket")`
        of an asyncio transport returns it: when it is closed, what the device has not received is
        dropped."""
        if sock is not None:
            # Else the system still delivers it: minutes later, if a cable was out meanwhile, and
            # after what the next session has sent, such as a stop.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._opened, self._open, self._outbox = self._opened + 1, True, asyncio.Queue(WAITING)
        self.tell("up", item)

    def tell(self, kind: str, item: Any) -> None:
        """Report something to the driver."""
        self._news.append((kind, item))

    async def room(self) -> None:
        """Wait until the driver has read most of the news."""
        while len(self._news) >= WAITING:
            await asyncio.sleep(0.01)

    async def get(self, timeout: float | None = None) -> Any:
        """Return the next item that was sent; None when the session shall end. Raises
        TimeoutError."""
        async with asyncio.timeout(timeout):
            return await self._outbox.get()

    # --- the thread

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._repeat())

    async def _repeat(self) -> None:
        pause = PAUSES[0]
        while not self._closing:
            begun = self._loop.time()
            why = await self._ended(self._serve(self))
            self._open = False
            self.tell("down", why or "it was closed")
            if self._loop.time() - begun > PAUSES[1]:
                pause = PAUSES[0]
            if not self._closing:
                await self._ended(asyncio.sleep(pause))
            pause = min(2 * pause, PAUSES[1])

    async def _ended(self, work: Awaitable[None]) -> str:
        """Wait for the end; return what it raised, in words."""
        self._task, self._stopped = asyncio.ensure_future(work), ""
        (fault,) = list[Any](await asyncio.gather(self._task, return_exceptions=True))
        await asyncio.sleep(0)  # closed transports release their sockets
        silent = "it does not answer" if isinstance(fault, TimeoutError) else type(fault).__name__
        return self._stopped or (str(fault) or silent if fault else "")

    def _put(self, session: int, item: Any) -> None:
        if session == self._opened and self._open:
            try:
                self._outbox.put_nowait(item)
            except asyncio.QueueFull:
                self._stop("the other end does not take what it is sent")

    def _stop(self, why: str) -> None:
        self._stopped = why
        if self._task is not None:
            self._task.cancel()

    def _finish(self) -> None:
        self._closing = True
        if self._open and not self._outbox.full():
            self._outbox.put_nowait(None)
        else:
            self._stop("closed")

    def _cancel(self) -> None:
        self._closing = True
        self._stop("closed")


class SimulatedSession:
    """A simulated device in the place of a `SessionThread`, also for lock step: an object of the
    class `path` ("module:Class") with `receive(now, item)` and `step(now)`, which return what the
    device sends. `news` has each as ("message", item)."""

    def __init__(self, path: str, clock: Callable[[], float]) -> None:
        module, _, name = path.partition(":")
        self.up, self.count, self.why = False, 0, "not connected yet"
        self._device, self._clock = getattr(importlib.import_module(module), name)(), clock
        self._news: list[tuple[str, Any]] = [("up", None)]

    def news(self) -> Iterator[tuple[str, Any]]:
        """Remove and return what the device has sent."""
        self._tell(self._device.step(self._clock()))
        found, self._news = self._news, []
        self.up, self.count = True, 1
        yield from found

    def send(self, item: Any) -> None:
        """Send to the device."""
        self._tell(self._device.receive(self._clock(), plain(item)))

    def close(self, wait: float = 1.0) -> None:
        """Do nothing."""

    def _tell(self, items: Iterable[Any]) -> None:
        self._news += [("message", plain(item)) for item in items]
