"""Set points from node to node, each stream on a connection of its own: the newest value wins.

The sender opens with the handshake of the node protocol (role "stream") and STREAM_OPEN. Then it
sends one SET_POINT per period as long as its values must be followed, and WITHDRAW when they must
not. Nothing here blocks: a value that finds no room in the socket is dropped, because a newer one
follows. The receiver reads its sockets up to the newest value, and withdraws it once it is older
than three periods, including its delay on the way. The sender's own loop keeps the period.
"""

from __future__ import annotations

import contextlib
import math
import secrets
import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

from msgspec import Struct

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

STALE_AFTER: Final = 3
"""Age of a set point from which it is too old (periods)."""

_OPEN: Final = ConnectionState.OPEN  # looked up once: members of an Enum class are slow to find
_DRIFT: Final = 1e-4
"""Assumed drift between two clocks (s/s); quartz is ten times better."""
_CHUNK: Final = 1 << 14
_READS: Final = 16
"""Most reads of one connection per poll: a flood must not delay the servo loop that polls."""


class Sink(Protocol):
    """Receives the newest set point of a stream."""

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """A set point has arrived, `held` seconds after its sender first sent these values."""

    def withdraw(self) -> None:
        """The last set point must not be followed: its sender withdrew it or is gone, or it is too
        old."""


class Lateness:
    """Estimates how much longer a message took than the quickest one of its stream.

    The clocks of sender and receiver have an unknown offset. The smallest difference between
    arrival time and the sender's elapsed time is taken as the passage without delay.
    """

    __slots__ = ("_at", "_best")

    def __init__(self) -> None:
        self._best = math.inf
        self._at = 0.0

    def of(self, now: float, elapsed: float) -> float:
        """Return the delay (s) of a message that was sent `elapsed` seconds into the stream and
        arrives at `now`."""
        offset = now - elapsed
        # The quickest passage grows at the rate at which clocks may drift. Otherwise a very old one
        # would make all later messages look late.
        self._best = min(self._best + _DRIFT * (now - self._at), offset)
        self._at = now
        return offset - self._best


class Inlet:
    """Receiving end of one open stream (sans-I/O): drops what is older than three periods.

    The delay of a set point on its way counts as age, so one that was held up is not mistaken for a
    fresh one.
    """

    __slots__ = ("_barred", "_before", "_lateness", "_limit", "_sink", "_until")

    def __init__(self, period: float, sink: Sink, before: float = math.inf) -> None:
        """`before`: how long before the connection a run may have begun whose values count (s): not
        before the last emergency stop was cleared; infinity: there was none."""
        self._limit = STALE_AFTER * period
        self._sink = sink
        self._lateness = Lateness()
        self._until = math.inf
        self._before = before
        self._barred = before < math.inf  # until the sender has said when its run began

    def receive(self, now: float, messages: Sequence[Message]) -> None:
        """Handle what has arrived by `now`: the newest message counts, the others only improve the
        estimate of the delay."""
        newest: Message | None = None
        late = 0.0
        for message in messages:
            if isinstance(message, SetPoint):
                late = self._lateness.of(now, message.elapsed)
                newest = None if self._barred else message
            elif isinstance(message, Withdraw):
                newest, self._barred = message, message.before > self._before
        if isinstance(newest, SetPoint) and late <= self._limit:
            self._until = now - late + self._limit
            self._sink.take(newest.values, newest.held + late)
        elif isinstance(newest, Withdraw) or now > self._until:
            self._until = math.inf
            self._sink.withdraw()


class Incoming(Struct, frozen=True):
    """A stream that a receiver accepts: its period (s), the sink of its values, and the ticket that
    its sender must show."""

    period: float
    sink: Sink
    ticket: str = ""


class StreamConnection:
    """One non-blocking connection, either end; `receiver` is the name of the listening end."""

    def __init__(self, sock: socket.socket, side: Side, receiver: str, key: Keys | None) -> None:
        sock.setblocking(False)
        self.sock = sock
        nonce = secrets.token_bytes(NONCE_BYTES) if key is not None else b""
        self.connection = Connection(side, receiver, key=key, nonce=nonce)
        self.unsent = b""

    def tune(self) -> None:
        """Set small buffers and short timeouts, so that old values do not queue up in the
        kernel."""
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
        if self.unsent:
            data = self.unsent + data
            self.unsent = b""
        elif not data:
            return
        try:
            sent = self.sock.send(data)
        except BlockingIOError:
            sent = 0
        if sent < len(data):
            self.unsent = data[sent:]

    def read(self, reads: int = _READS, chunk: int = _CHUNK) -> list[Message]:
        """Return the messages that have arrived, with at most `reads` reads.

        Raises OSError when the connection is gone, ProtocolError when the other side broke the
        protocol.
        """
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


_CONNECTIONS: Final = 16
_ADMITTED: Final = 4
"""Connections accepted per poll, so that strangers do not delay the servo loop that polls."""
_STRANGERS_CHUNK: Final = 2048
"""Bytes read per poll from a connection that has not opened a stream yet, for the same reason."""
_HANDSHAKE: Final = 2.0
_RETRY: Final = 0.1


class StreamSender:
    """Sending end of one stream, for the loop of a worker. `send` never blocks; the connection is
    maintained in passing.

    It connects when there is first something to send. When that fails or the receiver is gone, it
    tries again at most every 0.1 s. `name` is the sender, `receiver` the device that must receive;
    another device is sent nothing. `host` is an IP address: looking up a name would wait.
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
        self._until = math.inf
        """When the receiver must have welcomed the stream (s)."""
        self._opened = 0.0
        self._number = 0
        self._run: str | None = None
        """The run whose values were sent last on this connection."""

    @property
    def up(self) -> bool:
        """Return whether the receiver has welcomed the stream."""
        return self._line is not None and self._line.connection.state is _OPEN

    def send(
        self, values: Sequence[float], held: float = 0.0, run: str = "", age: float = 0.0
    ) -> bool:
        """Send the newest values, which the sender has held for `held` seconds, of a run that began
        `age` seconds ago. Return False if they were dropped."""
        line = self._line if self.up else self.advance()
        if line is not None and line.unsent:
            line = self.advance()
        if line is None or line.unsent:
            self.dropped += 1
            return False
        self._number += 1
        elapsed = self._clock() - self._opened
        point = SetPoint(self._number, tuple(map(float, values)), held, elapsed)
        if run == self._run:
            sent = self._write(line, point)
        else:
            self._run = run
            sent = self._write(line, Withdraw(max(0.0, age - elapsed)), point)
        self.advance()  # read what the receiver sent only after the value is on its way
        return sent

    def close(self) -> None:
        """End the stream."""
        line = self._line
        if line is not None:
            with contextlib.suppress(OSError, ProtocolError):
                line.write(line.connection.send(Bye("the stream ends")))
        self._drop(0.0)

    def advance(self) -> StreamConnection | None:
        """Maintain the connection: connect, shake hands, notice its end. Return it when the stream
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
            if now >= self._until and not self.up:  # the answer was lost on the way, and its end
                raise TimeoutError
        except OSError:
            self._drop(now + _RETRY)
        except ProtocolError as fault:
            self.refusal = str(fault)
            self._drop(now + _RETRY)
        return self._line if self.up else None

    def _write(self, line: StreamConnection, *messages: Message) -> bool:
        try:
            line.write(b"".join(map(line.connection.send, messages)))
        except OSError:
            self._drop(self._clock() + _RETRY)
            return False
        return True

    def _connect(self, now: float) -> None:
        host = self._address[0]
        sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self._line = StreamConnection(sock, Side.CLIENT, self._receiver, self._key)
        self._greeted, self._until = False, now + _HANDSHAKE
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
            self._opened, self._number, self._run = self._clock(), 0, None
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


class _Guest(Struct, eq=False):
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
        cleared: float = math.inf,
    ) -> None:
        """`cleared`: how long ago an emergency stop of the device was cleared (s): as after `bar`,
        values count only of runs that began later."""
        require_key(name, host, key)
        self.faults = 0
        """How many connections broke the protocol or were refused."""
        self._name = name
        self._boot = secrets.token_hex(8)
        self._streams = streams
        self._key = key
        self._clock = clock
        self._guests: dict[int, _Guest] = {}
        """Connections by the file number of their socket."""
        self._barred_at = clock() - cleared
        """When the device was last in emergency stop (s)."""
        self._ready = select.epoll()
        self._listener = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
        self._listener.setblocking(False)
        self._ready.register(self._listener, select.EPOLLIN)

    @property
    def address(self) -> tuple[str, int]:
        """Return the address at which it listens."""
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    def sockets(self) -> list[socket.socket]:
        """Return the sockets to wait on, for a loop that waits instead of polling each cycle."""
        return [self._listener, *(guest.line.sock for guest in self._guests.values())]

    def poll(self) -> None:
        """Read all that has arrived; never blocks."""
        # epoll first: a read of a socket without data raises an exception, and this function runs
        # in every servo cycle.
        ready = {number for number, _ in self._ready.poll(0.0)}
        now = self._clock()
        for number, guest in list(self._guests.items()):
            if number in ready or guest.line.unsent:
                self._serve(now, guest)
            else:
                self._wait(now, guest)
        if self._listener.fileno() in ready:
            self._admit(now)

    def bar(self) -> None:
        """End all connections; later, values count only of runs that began after this moment."""
        self._barred_at = self._clock()
        for guest in list(self._guests.values()):
            self._end(guest)

    def close(self) -> None:
        """Stop listening and end all streams."""
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
        """Nothing arrived on this connection: its last set point grows older."""
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
        rest = self._open(now, guest, messages) if guest.inlet is None else messages
        if guest.inlet is not None:
            guest.inlet.receive(now, rest)
            if any(isinstance(message, Bye) for message in rest):
                self._end(guest)
        elif guest.inlet is None and now > guest.since + _HANDSHAKE:
            self._end(guest)

    def _open(self, now: float, guest: _Guest, messages: list[Message]) -> list[Message]:
        """Handle HELLO and STREAM_OPEN of a connection; return the messages after them."""
        for position, message in enumerate(messages):
            if isinstance(message, Hello):
                welcome = Welcome(NEWEST_VERSION, self._name, self._boot, tuple(self._streams))
                guest.since = now  # STREAM_OPEN is not sent before
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
                f"{self._name} receives no stream {opening.stream}: see [streams] in services.toml",
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
                f"the ticket for {opening.stream} is not the one that {self._name} issued",
            )
        return None

    def _replace(self, guest: _Guest, stream: str) -> None:
        """Make this connection the sender of a stream; an older one is closed."""
        for older in [one for one in self._guests.values() if one.stream == stream]:
            self._end(older)
        incoming = self._streams[stream]
        before = guest.since - self._barred_at
        guest.stream, guest.inlet = stream, Inlet(incoming.period, incoming.sink, before)

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
            guest.line.sock.close()  # this also removes it from the epoll
            if guest.inlet is not None:
                self._streams[guest.stream].sink.withdraw()
