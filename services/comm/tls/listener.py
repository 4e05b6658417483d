"""A listening TLS socket whose handshakes are bounded: asyncio's own would begin one for every
connection that comes.

Each handshake of asyncio's TLS has a buffer of 256 KiB, so 10,000 strangers would take 2.5 GiB
before one showed a certificate. Here a connection costs a socket until its first bytes are there;
then its handshake begins. Of both kinds there are so many at most; the oldest gives way, so that a
good caller, who is quick, gets in between any number of slow ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

ACCEPTED: Final = 32
"""Connections taken in one turn of the loop."""


@dataclass(frozen=True)
class Admission:
    """What a listener asks its owner."""

    protocol: Callable[[], asyncio.BaseProtocol]
    """Makes the protocol of a connection whose handshake is over."""
    admits: Callable[[str], bool]
    """Whether an address may try."""
    failed: Callable[[str], None]
    """Is told the address of one whose handshake came to nothing."""


class TlsListener:
    """Listens on one address. Not for threads: the running loop owns it."""

    def __init__(
        self, host: str, port: int, tls: ssl.SSLContext, handshake: float, limit: int
    ) -> None:
        """`handshake`: seconds that one may take; `limit`: how many at a time. Raises OSError."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=128)
        self._listener.setblocking(False)
        self._tls, self._handshake, self._limit = tls, handshake, limit
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[socket.socket, tuple[str, asyncio.TimerHandle]] = {}
        """Connections that have said nothing: their address, and when they must have."""
        self._shaking: dict[asyncio.Task[None], None] = {}
        self._ending: set[asyncio.Task[None]] = set()
        self._admission: Admission | None = None

    @property
    def sockets(self) -> tuple[socket.socket, ...]:
        """The listening socket, as of an `asyncio.Server`."""
        return (self._listener,)

    def start(self, admission: Admission) -> None:
        """Listen."""
        self._admission = admission
        self._loop.add_reader(self._listener, self._accept, admission)

    def close(self) -> None:
        """Listen no more; handshakes under way are broken off."""
        if self._listener.fileno() >= 0:
            self._loop.remove_reader(self._listener)
            self._listener.close()
        for sock in list(self._waiting):
            self._drop(sock)
        for task in list(self._shaking):
            self._break_off(task)

    async def wait_closed(self) -> None:
        """Until no handshake is under way."""
        while self._ending:
            await asyncio.wait(list(self._ending))

    def _accept(self, admission: Admission) -> None:
        for _ in range(ACCEPTED):
            try:
                sock, address = self._listener.accept()
            except (BlockingIOError, ConnectionError):
                return
            if not admission.admits(address[0]):
                sock.close()
                continue
            if len(self._waiting) >= self._limit:
                self._turn_away(next(iter(self._waiting)))
            sock.setblocking(False)
            timer = self._loop.call_later(self._handshake, self._turn_away, sock)
            self._waiting[sock] = address[0], timer
            self._loop.add_reader(sock, self._begin, sock, admission)

    def _turn_away(self, sock: socket.socket) -> None:
        address = self._drop(sock)
        if self._admission is not None:
            self._admission.failed(address)

    def _drop(self, sock: socket.socket, close: bool = True) -> str:
        """Wait for this one no more; gives its address."""
        address, timer = self._waiting.pop(sock)
        timer.cancel()
        self._loop.remove_reader(sock)
        if close:
            sock.close()
        return address

    def _begin(self, sock: socket.socket, admission: Admission) -> None:
        """Its first bytes are there."""
        address = self._drop(sock, close=False)
        if len(self._shaking) >= self._limit:
            self._break_off(next(iter(self._shaking)))
        task = self._loop.create_task(self._shake(sock, address, admission))
        self._shaking[task] = None
        task.add_done_callback(partial(self._forget, sock, address, admission))

    def _break_off(self, task: asyncio.Task[None]) -> None:
        self._shaking.pop(task, None)
        self._ending.add(task)
        task.cancel()

    def _forget(
        self, sock: socket.socket, address: str, admission: Admission, task: asyncio.Task[None]
    ) -> None:
        self._shaking.pop(task, None)
        self._ending.discard(task)
        if task.cancelled():  # broken off, perhaps before it began
            admission.failed(address)
            with contextlib.suppress(OSError):
                sock.close()

    async def _shake(self, sock: socket.socket, address: str, admission: Admission) -> None:
        try:
            await self._loop.connect_accepted_socket(
                admission.protocol, sock, ssl=self._tls, ssl_handshake_timeout=self._handshake
            )
        except (OSError, TimeoutError):
            admission.failed(address)
