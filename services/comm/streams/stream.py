"""Set points from node to node, each stream on a connection of its own: newest value wins.

The sender opens with the handshake of the node protocol (role "stream"), then STREAM_OPEN, then one
SET_POINT a period for as long as it stands by its values, and WITHDRAW when it does no more.
Nothing here waits: a value that finds no room is dropped, since a newer one follows; the receiver
drains its sockets to the newest value, and withdraws it once it is older than three periods, what
it lost on its way included. Pacing is the sender's loop's.
"""

from __future__ import annotations

import contextlib
import math
import secrets
import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from petrobot.services.comm.protocol.messages import (
    Bye,
    Hello,
    Message,
    Ping,
    Refuse,
    SetPoint,
    StreamOpen,
    Welcome,
    Withdraw,
)
from petrobot.services.comm.protocol.security import NONCE_BYTES, UNPROVEN, Keys, require_key, same
from petrobot.services.comm.protocol.wire import (
    NEWEST_VERSION,
    OLDEST_VERSION,
    Connection,
    ConnectionState,
    ProtocolError,
    Side,
)

# One end of a set-point stream: its connection without waiting, and what of the arrived counts.

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


class StreamConnection:
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


__all__ = ["STALE_AFTER", "Incoming", "Inlet", "Sink", "StreamReceiver", "StreamSender"]

_CONNECTIONS: Final = 16
_ADMITTED: Final = 4
"""Connections taken in a poll, and"""
_STRANGERS_CHUNK: Final = 2048
"""bytes read in a poll from one that has not opened a stream: strangers must not hold up the servo
loop that polls."""
_HANDSHAKE: Final = 2.0
_RETRY: Final = 0.1


class StreamSender:
    """Sending end of one stream, for the loop of a worker: `send` never blocks, the connection
    looks after itself.

    It connects when there is first something to send, and again at most every 0.1 s when that fails
    or the receiver is gone. `name` says who sends, `receiver` the name of the device that is to
    receive: another one is sent nothing.
    """

    def __init__(
        self,
        name: str,
        stream: str,
        period: float,
        host: str,
        port: int,
        *,
        receiver: str,
        ticket: str = "",
        key: Keys | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.refusal = ""
        """Why the receiver refused the stream; empty if it did not."""
        self.dropped = 0
        """How many set points found no connection or no room."""
        self._hello = Hello(OLDEST_VERSION, NEWEST_VERSION, "stream", name, secrets.token_hex(8))
        self._open = StreamOpen(stream, period, ticket)
        self._address = (host, port)
        self._receiver = receiver
        self._key = key
        self._clock = clock
        self._line: StreamConnection | None = None
        self._greeted = False
        self._again = -math.inf
        self._opened = 0.0
        self._number = 0

    @property
    def up(self) -> bool:
        """Whether the receiver has welcomed the stream."""
        return self._line is not None and self._line.connection.state is ConnectionState.OPEN

    def send(self, values: Sequence[float], held: float = 0.0) -> bool:
        """Send the newest values, which the sender has stood by for `held` seconds. False if they
        were dropped."""
        line = self._line if self.up else self.advance()
        if line is not None and line.unsent:
            line = self.advance()
        if line is None or line.unsent:
            self.dropped += 1
            return False
        self._number += 1
        elapsed = self._clock() - self._opened
        sent = self._write(line, SetPoint(self._number, tuple(map(float, values)), held, elapsed))
        self.advance()  # what the receiver said can wait until the value is on its way
        return sent

    def withdraw(self) -> None:
        """Stand by the last values no more."""
        line = self.advance()
        if line is not None:
            self._write(line, Withdraw())

    def close(self) -> None:
        """End the stream."""
        line = self._line
        if line is not None:
            with contextlib.suppress(OSError, ProtocolError):
                line.write(line.connection.send(Bye("the stream ends")))
        self._drop(0.0)

    def advance(self) -> StreamConnection | None:
        """Look after the connection: connect, shake hands, notice its end. Gives it when the stream
        is open."""
        now = self._clock()
        if self._line is None and now >= self._again:
            self._connect(now)
        line = self._line
        if line is None:
            return None
        try:
            self._greet(line)
            for message in line.read():
                self._take(line, message)
            line.write(b"")
        except OSError:
            self._drop(now + _RETRY)
        except ProtocolError as fault:
            self.refusal = str(fault)
            self._drop(now + _RETRY)
        return self._line if self.up else None

    def _write(self, line: StreamConnection, message: Message) -> bool:
        try:
            line.write(line.connection.send(message))
        except OSError:
            self._drop(self._clock() + _RETRY)
            return False
        return True

    def _connect(self, now: float) -> None:
        host = self._address[0]
        sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self._line = StreamConnection(sock, Side.CLIENT, self._receiver, self._key)
        self._greeted = False
        try:
            self._line.tune()
            sock.connect(self._address)
        except BlockingIOError:
            return
        except OSError:
            self._drop(now + _RETRY)

    def _greet(self, line: StreamConnection) -> None:
        if self._greeted:
            return
        fault = line.sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if fault:
            raise OSError(fault, "no connection")
        try:
            line.sock.getpeername()
        except OSError:
            return  # still connecting
        self._greeted = True
        line.write(line.connection.send(self._hello))

    def _take(self, line: StreamConnection, message: Message) -> None:
        if isinstance(message, Welcome):
            self.refusal = ""
            self._opened, self._number = self._clock(), 0
            line.write(line.connection.send(self._open))
        elif isinstance(message, Refuse):
            proven = "" if line.connection.proven else f"{UNPROVEN}: "
            self.refusal = f"{proven}{message.code}: {message.text}"
            self._drop(self._clock() + _RETRY)
            raise ConnectionResetError(self.refusal)
        elif isinstance(message, Bye):
            raise ConnectionResetError(message.text)

    def _drop(self, again: float) -> None:
        if self._line is not None:
            self._line.sock.close()
        self._line = None
        self._again = again


@dataclass(slots=True, eq=False)
class _Guest:
    line: StreamConnection
    since: float
    stream: str = ""
    inlet: Inlet | None = None


class StreamReceiver:
    """Receiving end of a process: listens, and at each `poll` passes the newest value of each
    stream to its sink.

    Raises KeyNeededError when other hosts could connect and there is no key.
    """

    def __init__(
        self,
        name: str,
        streams: Mapping[str, Incoming],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        key: Keys | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        require_key(name, host, key)
        self.faults = 0
        """How many connections broke the protocol or were refused."""
        self._name = name
        self._boot = secrets.token_hex(8)
        self._streams = streams
        self._key = key
        self._clock = clock
        self._guests: dict[int, _Guest] = {}
        """By the number of their sockets."""
        self._ready = select.epoll()
        self._listener = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
        self._listener.setblocking(False)
        self._ready.register(self._listener, select.EPOLLIN)

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    def sockets(self) -> list[socket.socket]:
        """What to wait on, for a loop that would rather wait than poll each cycle."""
        return [self._listener, *(guest.line.sock for guest in self._guests.values())]

    def poll(self) -> None:
        """Take in all that has arrived; never blocks."""
        # Asked for first: a read of each socket in vain is an exception each, and this is called in
        # every servo cycle.
        ready = {number for number, _ in self._ready.poll(0.0)}
        now = self._clock()
        for number, guest in list(self._guests.items()):
            if number in ready or guest.line.unsent:
                self._serve(now, guest)
            else:
                self._wait(now, guest)
        if self._listener.fileno() in ready:
            self._admit(now)

    def close(self) -> None:
        """Listen no more and end all streams."""
        for guest in list(self._guests.values()):
            self._end(guest)
        self._ready.close()
        self._listener.close()

    def _admit(self, now: float) -> None:
        with contextlib.suppress(OSError):
            for _ in range(_ADMITTED):
                sock, _ = self._listener.accept()
                line = StreamConnection(sock, Side.SERVER, self._name, self._key)
                line.tune()
                self._ready.register(sock, select.EPOLLIN)
                newest = self._guests[sock.fileno()] = _Guest(line, now)
                if len(self._guests) > _CONNECTIONS:
                    self._end(
                        next((one for one in self._guests.values() if one.inlet is None), newest)
                    )

    def _wait(self, now: float, guest: _Guest) -> None:
        """Nothing came: what is there grows older."""
        if guest.inlet is not None:
            guest.inlet.receive(now, ())
        elif now > guest.since + _HANDSHAKE:
            self._end(guest)

    def _serve(self, now: float, guest: _Guest) -> None:
        try:
            messages = (
                guest.line.read()
                if guest.inlet is not None
                else guest.line.read(1, _STRANGERS_CHUNK)
            )
            guest.line.write(b"")
        except ProtocolError as fault:
            if guest.inlet is not None:
                guest.inlet.receive(now, fault.before)
            self._refuse(guest, Refuse(fault.code, fault.text[:500]))
            return
        except OSError:
            self._end(guest)
            return
        rest = self._open(guest, messages) if guest.inlet is None else messages
        if guest.inlet is not None:
            guest.inlet.receive(now, rest)
            if any(isinstance(message, Bye) for message in rest):
                self._end(guest)
        elif guest.inlet is None and now > guest.since + _HANDSHAKE:
            self._end(guest)

    def _open(self, guest: _Guest, messages: list[Message]) -> list[Message]:
        """Lead a connection through HELLO and STREAM_OPEN; gives what came after."""
        for position, message in enumerate(messages):
            if isinstance(message, Hello):
                welcome = Welcome(NEWEST_VERSION, self._name, self._boot, tuple(self._streams))
                self._say(guest, welcome)
            elif isinstance(message, StreamOpen):
                refusal = self._refusal(message)
                if refusal is not None:
                    self._refuse(guest, refusal)
                    return []
                self._replace(guest, message.stream)
                return messages[position + 1 :]
            elif not isinstance(message, Ping):
                self._refuse(guest, Refuse("out_of_turn", "a stream begins with STREAM_OPEN"))
                return []
        return []

    def _refusal(self, opening: StreamOpen) -> Refuse | None:
        incoming = self._streams.get(opening.stream)
        if incoming is None:
            return Refuse(
                "unknown_stream",
                f"{self._name} takes no stream {opening.stream}: see [streams] in services.toml",
            )
        if not math.isclose(opening.period, incoming.period):
            text = (
                f"{opening.stream} has a period of {incoming.period:g} s here, "
                f"{opening.period:g} s there"
            )
            return Refuse("period", f"{text}: copy the same services.toml to both hosts")
        if incoming.ticket and not same(opening.ticket.encode(), incoming.ticket.encode()):
            return Refuse(
                "ticket",
                f"the ticket for {opening.stream} is not the one that {self._name} gave out",
            )
        return None

    def _replace(self, guest: _Guest, stream: str) -> None:
        """A stream has one sender: the newest."""
        for older in [one for one in self._guests.values() if one.stream == stream]:
            self._end(older)
        incoming = self._streams[stream]
        guest.stream, guest.inlet = stream, Inlet(incoming.period, incoming.sink)

    def _say(self, guest: _Guest, message: Message) -> None:
        with contextlib.suppress(OSError, ProtocolError):
            guest.line.write(guest.line.connection.send(message))

    def _refuse(self, guest: _Guest, refusal: Refuse) -> None:
        self.faults += 1
        with contextlib.suppress(OSError):
            guest.line.write(guest.line.connection.refusal(refusal))
        self._end(guest)

    def _end(self, guest: _Guest) -> None:
        number = guest.line.sock.fileno()
        if self._guests.get(number) is guest:
            del self._guests[number]
            guest.line.sock.close()  # and with it epoll lets it go
            if guest.inlet is not None:
                self._streams[guest.stream].sink.withdraw()
