"""A listening TLS socket with a bounded number of handshakes; asyncio's own starts one for every
connection.

Each TLS handshake of asyncio has a buffer of 256 KiB, so 10,000 strangers would take 2.5 GiB before
one of them showed a certificate. Here a connection costs only a socket until its first bytes
arrive; then its handshake begins. The number of both kinds is limited, and the oldest is closed for
a new one. So a good caller, which is quick, is served between any number of slow ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Callable
from functools import partial
from typing import Final

from msgspec import Struct

ACCEPTED: Final = 32
"""Connections accepted in one turn of the loop."""
PAUSE: Final = 0.05
"""Wait after no more could be accepted (s)."""

_log = logging.getLogger(__name__)


class Admission(Struct, frozen=True):
    """What a listener asks its owner."""

    protocol: Callable[[], asyncio.BaseProtocol]
    """Makes the protocol of a connection whose handshake is finished."""
    admits: Callable[[str], bool]
    """Returns whether an address may try."""
    failed: Callable[[str], None]
    """Receives the address of a connection whose handshake failed."""


class TlsListener:
    """Listens at one address. Not thread-safe: the running loop owns it."""

    def __init__(
        self, host: str, port: int, tls: ssl.SSLContext, handshake: float, limit: int
    ) -> None:
        """`handshake`: longest duration of one (s); `limit`: how many at a time. Raises OSError."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=128)
        self._listener.setblocking(False)
        self._tls, self._handshake, self._limit = tls, handshake, limit
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[socket.socket, tuple[str, asyncio.TimerHandle]] = {}
        """Connections that have sent nothing yet: their address, and the timer of their timeout."""
        self._shaking: dict[asyncio.Task[None], None] = {}
        self._ending: set[asyncio.Task[None]] = set()
        self._admission: Admission | None = None
        self._again: asyncio.TimerHandle | None = None
        self._told = False
        """Whether it has been logged that there was no file for another connection."""

    @property
    def sockets(self) -> tuple[socket.socket, ...]:
        """Return the listening socket, as `asyncio.Server` does."""
        return (self._listener,)

    def start(self, admission: Admission) -> None:
        """Begin to listen."""
        self._admission = admission
        self._loop.add_reader(self._listener, self._accept, admission)

    def close(self) -> None:
        """Stop listening; active handshakes are cancelled."""
        if self._listener.fileno() >= 0:
            self._loop.remove_reader(self._listener)
            self._listener.close()
        if self._again is not None:
            self._again.cancel()
        for sock in list(self._waiting):
            self._drop(sock)
        for task in list(self._shaking):
            self._break_off(task)

    async def wait_closed(self) -> None:
        """Wait until no handshake is active."""
        while self._ending:
            await asyncio.wait(list(self._ending))

    def _accept(self, admission: Admission) -> None:
        for _ in range(ACCEPTED):
            try:
                sock, address = self._listener.accept()
            except (BlockingIOError, ConnectionError):
                return
            except OSError as fault:
                self._make_room(fault, admission)
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

    def _make_room(self, fault: OSError, admission: Admission) -> None:
        """This process has no file for another connection: close those that have shown nothing yet,
        and try again soon. Not at once: the loop would do nothing else."""
        if not self._told:
            _log.warning("%s: strangers are turned away", fault.strerror)
            self._told = True
        for sock in list(self._waiting):
            self._turn_away(sock)
        for task in list(self._shaking):
            self._break_off(task)
        self._loop.remove_reader(self._listener)
        self._again = self._loop.call_later(PAUSE, self.start, admission)

    def _turn_away(self, sock: socket.socket) -> None:
        address = self._drop(sock)
        if self._admission is not None:
            self._admission.failed(address)

    def _drop(self, sock: socket.socket, close: bool = True) -> str:
        """Stop waiting for this connection; return its address."""
        address, timer = self._waiting.pop(sock)
        timer.cancel()
        self._loop.remove_reader(sock)
        if close:
            sock.close()
        return address

    def _begin(self, sock: socket.socket, admission: Admission) -> None:
        """Begin the handshake of a connection whose first bytes have arrived."""
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
        if task.cancelled():  # perhaps before it began
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
