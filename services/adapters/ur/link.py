"""A TCP connection that never waits: it connects, sends and receives between two steps."""

from __future__ import annotations

import importlib
import ipaddress
import socket
from collections.abc import Callable
from typing import Any

FIRST_PAUSE, LONGEST_PAUSE = 0.25, 4.0
"""Seconds between two attempts to connect: doubled each time."""
CONNECTING = 2.0
"""Seconds that an attempt may take."""
UNSENT = 1 << 16
"""Most bytes that may wait to be sent: with more, the other end does not read, and the link is
closed."""


class Link:
    """Keeps one connection open; connects again with growing pauses."""

    def __init__(self, host: str, port: int) -> None:
        """Raises ValueError for a host that is not an address: looking up a name would wait."""
        try:
            self._family = {4: socket.AF_INET, 6: socket.AF_INET6}[
                ipaddress.ip_address(host).version
            ]
        except ValueError as fault:
            raise ValueError(f"host: expected an IP address, found {host!r}") from fault
        self._address = host, port
        self._socket: socket.socket | None = None
        self._pause, self._next, self._since = FIRST_PAUSE, 0.0, 0.0
        self._unsent = bytearray()
        self.up = False
        self.connections = 0
        """How many connections were made."""
        self.why = "not connected yet"

    def poll(self, now: float) -> bytes:
        """Connect if needed; return the bytes received."""
        received = bytearray()
        try:
            if self._socket is None:
                if now >= self._next:
                    self._connect(now)
            elif not self.up:
                self._look(now)
            if self.up and self._socket is not None:
                self._flush(self._socket)
                while len(received) < UNSENT:
                    data = self._socket.recv(65536)
                    if not data:
                        raise ConnectionError("the controller has closed the connection")
                    received += data
        except BlockingIOError:
            pass
        except OSError as fault:
            self.drop(now, str(fault))
        return bytes(received)

    def _connect(self, now: float) -> None:
        self._socket, self._since = socket.socket(self._family, socket.SOCK_STREAM), now
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.connect(self._address)

    def _look(self, now: float) -> None:
        """Check whether a connection that was begun is complete."""
        assert self._socket is not None
        if fault := self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(fault, f"{self._address[0]}:{self._address[1]} refuses (errno {fault})")
        try:
            self._socket.getpeername()
        except OSError:
            if now - self._since > CONNECTING:
                raise ConnectionError("nothing answers at this address") from None
            return
        self.up, self.connections = True, self.connections + 1

    def _flush(self, near: socket.socket) -> None:
        if self._unsent:
            del self._unsent[: near.send(self._unsent)]

    def send(self, now: float, data: bytes) -> None:
        """Send over the present connection, if there is one."""
        if not self.up or not data:
            return
        self._unsent += data
        try:
            assert self._socket is not None
            self._flush(self._socket)
        except BlockingIOError:
            if len(self._unsent) > UNSENT:
                self.drop(now, "the controller does not read")
        except OSError as fault:
            self.drop(now, str(fault))

    def settled(self) -> None:
        """Note that the connection works: when it breaks, the next attempt follows at once."""
        self._pause = FIRST_PAUSE

    def drop(self, now: float, why: str) -> None:
        """Close the connection, and try another one later."""
        self.close()
        self.why, self._next = why, now + self._pause
        self._pause = min(LONGEST_PAUSE, 2.0 * self._pause)

    def close(self) -> None:
        """Close it."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self.up = None, False
        self._unsent.clear()


class LoopbackLink:
    """A connection to a simulated controller in this process."""

    def __init__(self, controller: Any, port: int) -> None:
        self._controller, self._port = controller, port
        self._session: Any = None
        self.up, self.connections, self.why = False, 0, ""

    def poll(self, now: float) -> bytes:
        """Return the bytes received."""
        if self._session is None or self._session.closed:
            self._session, self.up = self._controller.connect(self._port), True
            self.connections += 1
        return bytes(self._session.drain())

    def send(self, now: float, data: bytes) -> None:
        """Send."""
        if self._session is not None and data:
            self._session.receive(data)

    def settled(self) -> None:
        """Do nothing."""

    def drop(self, now: float, why: str) -> None:
        """Connect again."""
        self.why = why
        self.close()

    def close(self) -> None:
        """Close it."""
        if self._session is not None:
            self._session.closed = True
        self._session, self.up = None, False


def links(
    host: str, ports: list[int], usual: list[int]
) -> tuple[list[Link | LoopbackLink], Callable[[float], None]]:
    """Return the links to the ports of a controller, and a function that lets its time pass: `host`
    is an IP address, or `module:Class` of a simulated controller."""
    module, colon, name = host.partition(":")
    if not colon or "." not in module or name[:1].isdigit() or not name.isidentifier():
        return [Link(host, port) for port in ports], lambda now: None
    try:
        controller = getattr(importlib.import_module(module), name)()
    except (ImportError, AttributeError) as fault:
        raise ValueError(f"host: {host!r} cannot be loaded: {fault}") from fault
    return [LoopbackLink(controller, port) for port in usual], controller.advance
