"""A listening TLS socket whose handshakes are bounded: asyncio's own would begin one for every connection that comes.

Each handshake of asyncio's TLS has a buffer of 256 KiB, so 10,000 strangers would take 2.5 GiB before one showed a certificate.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from typing import Final

ACCEPTED: Final = 32
"""Connections taken in one turn of the loop."""


class TlsListener:
    """Listens on one address. Not for threads: the running loop owns it."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext, handshake: float, limit: int) -> None:
        """`handshake`: seconds that one may take; `limit`: how many at a time, the oldest gives way. Raises OSError."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=128)
        self._listener.setblocking(False)
        self._tls, self._handshake, self._limit = tls, handshake, limit
        self._loop = asyncio.get_running_loop()
        self._shaking: dict[asyncio.Task[None], None] = {}
        self.turned_away = 0

    @property
    def sockets(self) -> tuple[socket.socket, ...]:
        """The listening socket, as of an `asyncio.Server`."""
        return (self._listener,)

    def start(
        self,
        protocol: Callable[[], asyncio.BaseProtocol],
        admits: Callable[[str], bool],
        failed: Callable[[str], None],
    ) -> None:
        """Listen. `admits` says whether an address may try, `failed` is told of one whose handshake came to nothing."""
        self._loop.add_reader(self._listener, self._accept, protocol, admits, failed)

    def close(self) -> None:
        """Listen no more; handshakes under way are broken off."""
        if self._listener.fileno() >= 0:
            self._loop.remove_reader(self._listener)
            self._listener.close()
        for task in self._shaking:
            task.cancel()

    async def wait_closed(self) -> None:
        """Until no handshake is under way."""
        while self._shaking:
            await asyncio.wait(list(self._shaking))

    def _accept(
        self,
        protocol: Callable[[], asyncio.BaseProtocol],
        admits: Callable[[str], bool],
        failed: Callable[[str], None],
    ) -> None:
        for _ in range(ACCEPTED):
            try:
                sock, address = self._listener.accept()
            except (BlockingIOError, ConnectionError):
                return
            if not admits(address[0]):
                self.turned_away += 1
                sock.close()
                continue
            if len(self._shaking) >= self._limit:
                next(iter(self._shaking)).cancel()
            task = self._loop.create_task(self._shake(protocol, sock, address[0], failed))
            self._shaking[task] = None
            task.add_done_callback(lambda done: self._shaking.pop(done, None))

    async def _shake(
        self,
        protocol: Callable[[], asyncio.BaseProtocol],
        sock: socket.socket,
        address: str,
        failed: Callable[[str], None],
    ) -> None:
        sock.setblocking(False)
        try:
            await self._loop.connect_accepted_socket(
                protocol, sock, ssl=self._tls, ssl_handshake_timeout=self._handshake
            )
        except asyncio.CancelledError:
            failed(address)
            with contextlib.suppress(OSError):
                sock.close()
            raise
        except (OSError, TimeoutError):
            failed(address)
