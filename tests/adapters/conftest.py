"""Drivers of adapters in tests with foreign devices."""

from __future__ import annotations

import selectors
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, cast

import pytest

from petrobot import Driver, rehearse
from tests.waiting import PATIENCE_S, Limit


class PortsClock(Driver):
    """First base of a driver: the clock of its ports is that of its steps."""

    def step(self, now: float) -> None:
        cast(Any, self.ports).now = now
        super().step(now)


def rehearsed(story: Callable[..., Any], arm: Driver, world: Callable[[float], None]) -> None:
    """Play a story, which ends in success, with the arm and its world; then close the arm."""
    try:
        told = rehearse(story, device=arm, world=world).result
    finally:
        arm.close()
    assert told.status == "success", told


class SmallRelay:
    """A server on this host that passes bytes on to another one, in both directions, for one client
    after the other, until it stalls: as at a pulled cable, what a client sends then stays with the
    client's system."""

    def __init__(self) -> None:
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen()
        self.port = self._listener.getsockname()[1]
        self.late = bytearray()
        """What the client has delivered after the stall."""
        self._stalled, self._over = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, port: int) -> None:
        """Pass the bytes of clients on to a port of this host."""
        self._thread = threading.Thread(target=self._serve, args=(port,))
        self._thread.start()

    def stall(self) -> None:
        """Read nothing more of it."""
        self._stalled.set()

    def read(self) -> bytes:
        """Read on until the client's connection ends; return what came."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(2 * PATIENCE_S)
            assert not self._thread.is_alive()
        return bytes(self.late)

    def close(self) -> None:
        self.stall()
        self.read()
        self._listener.close()

    def _serve(self, port: int) -> None:
        self._listener.settimeout(0.05)
        limit = Limit("the stall")
        while not self._stalled.is_set() and limit.left():
            with suppress(TimeoutError):
                near, _ = self._listener.accept()
                with near:
                    with suppress(ConnectionError):  # this client's; there may be another one
                        self._pass_on(near, port, limit)
                    if self._stalled.is_set():
                        self._read_late(near)

    def _pass_on(self, near: socket.socket, port: int, limit: Limit) -> None:
        """Until the stall, or until one of the two ends."""
        with (
            socket.create_connection(("127.0.0.1", port)) as far,
            selectors.DefaultSelector() as ready,
        ):
            ready.register(near, selectors.EVENT_READ, far)
            ready.register(far, selectors.EVENT_READ, near)
            while not self._stalled.is_set() and limit.left():
                for found, _ in ready.select(0.02):
                    source, sink = (cast(socket.socket, s) for s in (found.fileobj, found.data))
                    if not (data := source.recv(4096)):
                        return
                    sink.sendall(data)

    def _read_late(self, near: socket.socket) -> None:
        self._over.wait(PATIENCE_S)
        near.settimeout(PATIENCE_S)
        with suppress(ConnectionResetError):
            while data := near.recv(65536):
                self.late += data


@pytest.fixture
def relay() -> Iterator[SmallRelay]:
    made = SmallRelay()
    yield made
    made.close()
