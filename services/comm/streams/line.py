"""One end of a set-point stream: its connection without waiting, and what of the arrived counts."""

from __future__ import annotations

import math
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from petrobot.services.comm.protocol.messages import Message, SetPoint, Withdraw
from petrobot.services.comm.protocol.security import NONCE_BYTES, Keys
from petrobot.services.comm.protocol.wire import Connection, Side

STALE_AFTER: Final = 3
"""Periods after which a set point is too old."""

_DRIFT: Final = 1e-4
"""How much two clocks may drift apart (s/s); quartz is ten times better."""
_CHUNK: Final = 1 << 14
_READS: Final = 16
"""Reads of one connection in a poll: a flood must not hold up the servo loop that polls."""


class Sink(Protocol):
    """Where the newest set point of a stream goes."""

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """A set point has arrived, `held` seconds after its sender first sent these values."""

    def withdraw(self) -> None:
        """It counts no more: its sender does not stand by it, is gone, or it has become too old."""


class Lateness:
    """How much longer a message took than the quickest one of its stream: from arrivals and the
    sender's own durations."""

    __slots__ = ("_at", "_best")

    def __init__(self) -> None:
        self._best = math.inf
        self._at = 0.0

    def of(self, now: float, elapsed: float) -> float:
        """Seconds that a message sent `elapsed` seconds into the stream has lost on its way when it
        arrives at `now`."""
        offset = now - elapsed
        # The quickest passage is forgotten at the rate at which clocks may drift, so an old one
        # cannot make all look late.
        self._best = min(self._best + _DRIFT * (now - self._at), offset)
        self._at = now
        return offset - self._best


class Inlet:
    """Receiving end of one open stream, without socket or clock: what is older than three periods
    does not count.

    What a set point lost on its way counts as age, so one that was held up is not taken for a fresh
    one.
    """

    __slots__ = ("_lateness", "_limit", "_sink", "_until")

    def __init__(self, period: float, sink: Sink) -> None:
        self._limit = STALE_AFTER * period
        self._sink = sink
        self._lateness = Lateness()
        self._until = math.inf

    def receive(self, now: float, messages: Sequence[Message]) -> None:
        """Take what has arrived by `now`: the newest counts, the others only show how late things
        are."""
        newest: Message | None = None
        late = 0.0
        for message in messages:
            if isinstance(message, SetPoint):
                newest, late = message, self._lateness.of(now, message.elapsed)
            elif isinstance(message, Withdraw):
                newest = message
        if isinstance(newest, SetPoint) and late <= self._limit:
            self._until = now - late + self._limit
            self._sink.take(newest.values, newest.held + late)
        elif isinstance(newest, Withdraw) or now > self._until:
            self._until = math.inf
            self._sink.withdraw()


@dataclass(frozen=True, slots=True)
class Incoming:
    """A stream that a receiver takes: its period (s), where its values go, and what its sender must
    show."""

    period: float
    sink: Sink
    ticket: str = ""


class Line:
    """One non-blocking connection, either end; `receiver` is the name of the end that listens."""

    def __init__(self, sock: socket.socket, side: Side, receiver: str, key: Keys | None) -> None:
        sock.setblocking(False)
        self.sock = sock
        nonce = secrets.token_bytes(NONCE_BYTES) if key is not None else b""
        self.connection = Connection(side, receiver, key=key, nonce=nonce)
        self.unsent = b""

    def tune(self) -> None:
        """Small buffers and short timeouts: nothing old is to queue up here."""
        sock = self.sock
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1500)

    def write(self, data: bytes) -> None:
        """Send, or keep what finds no room now. Raises OSError when the connection is gone."""
        data = self.unsent + data
        self.unsent = b""
        if not data:
            return
        try:
            sent = self.sock.send(data)
        except BlockingIOError:
            sent = 0
        self.unsent = data[sent:]

    def read(self, reads: int = _READS, chunk: int = _CHUNK) -> list[Message]:
        """Messages that have arrived, of at most so many reads. Raises OSError when the connection
        is gone, ProtocolError when it is no good."""
        messages: list[Message] = []
        for _ in range(reads):
            try:
                data = self.sock.recv(chunk)
            except BlockingIOError:
                break
            if not data:
                raise ConnectionResetError("the other side hung up")
            messages += self.connection.receive_data(data)
            if out := self.connection.data_to_send():
                self.write(out)
            if len(data) < chunk:
                break
        return messages
