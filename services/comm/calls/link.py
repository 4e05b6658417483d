"""One asyncio connection: passes bytes to a `Connection` and back, with heartbeat and limits.

`client.py` and `server.py` build on it.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import resource
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from enum import Enum, auto
from typing import Any, TypeVar

from msgspec import Struct, field

from petrobot.services.comm.protocol.messages import (
    Bye,
    Event,
    Feedback,
    Message,
    Ping,
    Pong,
    Refuse,
)
from petrobot.services.comm.protocol.security import NONCE_BYTES, Keys
from petrobot.services.comm.protocol.wire import Connection, ConnectionState, ProtocolError, Side

_log = logging.getLogger(__name__)

READ_BUFFER = 1 << 16
"""Most bytes read at once. They are decoded before another connection is read; in the worst case
(only empty maps) that takes about 25 ms."""
FIRST_READ = 1 << 13
"""Most bytes read at once while messages are shorter. All messages that were read at once are
handled before another connection is read; a coordinator stores each event."""
HEARD = 4096
"""So many bytes of an incomplete frame count as a sign of life. Fewer do not: a frame that arrives
byte by byte, or whose length was changed on its way, must not block the frames behind it for longer
than silence would."""
_HEARTBEATS = frozenset((Ping, Pong))
_OWN = frozenset((Ping, Pong, Bye, Refuse))
"""Kinds that the connection handles itself."""


class LinkTiming(Struct, frozen=True):
    """Times of a connection (s)."""

    heartbeat: float = 0.25
    """PING is sent after this silence, and after twice this time in which nothing was sent."""
    silence: float = 1.0
    """After this silence the other side counts as frozen or cut off."""
    handshake: float = 2.0
    """Longest time from connection to WELCOME."""
    user_timeout: float = 1.5
    """TCP_USER_TIMEOUT: unacknowledged data for this long breaks the connection."""
    backoff: tuple[float, float] = (0.05, 1.0)
    """Shortest and longest pause between attempts to connect."""


def allowed(most: int, share: int) -> int:
    """Return how many connections may be open: `most`, or this share of the files that the process
    may open. A process without a free file can accept nobody, and its emergency stop is not
    reached."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return most if files == resource.RLIM_INFINITY else min(most, files // share)


async def stop_accepting(server: asyncio.Server) -> None:
    """Close a server's ports. Its connections stay open.

    asyncio makes the transport of a connection one turn of the loop after it accepted it. If the
    server is closed in between, that fails and leaves the connection open."""
    loop = asyncio.get_running_loop()
    for sock in server.sockets:
        loop.remove_reader(sock)
    await asyncio.sleep(0)
    server.close()


class LinkLimits(Struct, frozen=True):
    """Limits of a server and its connections."""

    connections: int = field(default_factory=lambda: allowed(256, 4))
    opening: int = field(default_factory=lambda: allowed(64, 8))
    """Most connections that have not shown who they are; above it the oldest of them is closed."""
    handshakes: float = 20.0
    """Failed handshakes per second that one address may cause on average."""
    handshakes_at_once: int = 100
    """Failed handshakes that one address may cause at once. Above it the address is cut off before
    anything is read from it."""
    spare_loopback: bool = True
    """Whether addresses of this host are exempt from that: one process must not lock out all others
    on the host."""
    messages: float = 200_000.0
    """Messages per second that a caller may send on average. Above it reading from this caller
    pauses for a while."""
    messages_at_once: int = 20_000
    """Messages that a caller may send at once."""
    buffer_high: int = 1 << 20
    """Unsent bytes above which a connection is slow: progress and pulses are dropped."""
    buffer_hard: int = 64 << 20
    """Unsent bytes above which a connection is cut. Above half of them nothing more is read from a
    caller."""


class Beat(Enum):
    """What a heartbeat requires now."""

    NOTHING = auto()
    PING = auto()
    LOST = auto()


class Heartbeat:
    """Watches the silence of the other side (sans-I/O)."""

    __slots__ = ("_due", "_read_once", "_timing", "heard", "quiet")

    def __init__(self, now: float, timing: LinkTiming) -> None:
        self._timing = timing
        self.heard = now
        """When something last arrived (s); set by the reader."""
        self.quiet = 0
        """How often `advance` was called since something was sent; set to 0 by the writer."""
        self._due = now + timing.heartbeat
        self._read_once = False
        """Whether it was time to give up, and only what has arrived was still to be read."""

    def advance(self, now: float) -> Beat:
        """Return what to do at `now`. Call it when `due`."""
        # Only time in which this process ran counts: what the other side sent meanwhile may still
        # be in the socket, and on the same host it may not have run either.
        awake = min(now, self._due)
        if awake >= self.heard + self._timing.silence:
            if self._read_once:
                return Beat.LOST
            # After SIGCONT asyncio handles its timers before it looks at its sockets.
            self._read_once, self._due = True, now
            return Beat.NOTHING
        self._read_once = False
        self.heard = min(now, self.heard + now - awake)
        self._due = min(now + self._timing.heartbeat, self.heard + self._timing.silence)
        self.quiet += 1
        # Who only reads must be heard, too: on a slow line the other side's PING waits behind what
        # it sends.
        due = self.quiet > 1 or now - self.heard >= self._timing.heartbeat
        return Beat.PING if due else Beat.NOTHING

    def due(self) -> float:
        """Return when to call `advance` next (s)."""
        return self._due


class Alarm:
    """A timer of the running loop that calls `act`. An earlier time that is set stays: a call too
    many costs less than a timer for each message."""

    __slots__ = ("_act", "_timer", "due", "late")

    def __init__(self, act: Callable[[], None]) -> None:
        self.due = math.inf
        """When `act` is called (s, clock of the loop)."""
        self.late = 0.0
        """How long after that it was called last (s): the loop was busy or had no processor."""
        self._act = act
        self._timer: asyncio.TimerHandle | None = None

    def set(self, due: float | None) -> None:
        """Call `act` at `due` (s; None: never), or at the earlier time that is set."""
        if due is not None and due < self.due:
            self.cancel()
            self.due = due
            self._timer = asyncio.get_running_loop().call_at(due, self._ring)

    def cancel(self) -> None:
        """Do not call `act`."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self.due = None, math.inf

    def _ring(self) -> None:
        self.late = asyncio.get_running_loop().time() - self.due
        self.cancel()
        self._act()


class AsyncLink(asyncio.BufferedProtocol):
    """Base class of both ends. Subclasses handle messages in `took` and the end of the connection
    in `over`.

    All connections of an owner read into the same `buffer`: its content is taken out before
    anything else is read. asyncio would otherwise allocate a buffer of 256 KiB for each read, which
    costs more than all other work here.
    """

    def __init__(
        self,
        side: Side,
        server: str,
        key: Keys | None,
        timing: LinkTiming,
        limits: LinkLimits,
        buffer: bytearray,
    ) -> None:
        nonce = secrets.token_bytes(NONCE_BYTES) if key is not None else b""
        self.connection = Connection(side, server, key=key, nonce=nonce)
        self.loop = asyncio.get_running_loop()
        self.now = clock_of(self.loop)
        self._logs = _log.isEnabledFor(logging.DEBUG)
        self.timing = timing
        self.limits = limits
        self.slow = False
        self.reason = ""
        """Why the connection ended."""
        self.silent = False
        """Whether it ended because the other side was silent."""
        self.frames: list[bytes] = []
        """Frames that the connection has made and that are not written yet. They already have their
        numbers (the seal counts frames), so they must be written before all others."""
        self._view = memoryview(buffer)
        self._given = self._first = self._view[:FIRST_READ]
        """What is read into next: only the first part, unless a long message has begun."""
        self.behind = -math.inf
        """When a read last took all that it could, or a part of a long frame (s): more was on its
        way."""
        self._transport: asyncio.Transport | None = None
        self._heart = Heartbeat(0.0, timing)
        self._unheard = 0
        """Bytes of an incomplete frame since the last sign of life."""
        self._timer: asyncio.TimerHandle | None = None
        self._pings = 0
        self._asked: tuple[int, float] | None = None
        """The first PING without its PONG: its number, and when it was sent (s)."""
        self.read = 0.0
        """The other side has surely read what was sent before this time (s): on a slow line with
        much to carry this is long ago."""
        self._opening = True

    # For subclasses.

    def made(self) -> None:
        """The connection is established."""

    def took(self, now: float, messages: list[Message]) -> None:
        """Handle received messages."""

    def beaten(self, now: float, count: int) -> bool:
        """`count` heartbeats arrived. Return False if the connection was ended for it."""
        return True

    def over(self, now: float) -> None:
        """The connection has ended, `reason` says why. Called once."""

    def unsendable(self, message: Message, fault: ProtocolError) -> Message | None:
        """No frame can carry this message; return what to send in its place, or None."""
        return None

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=self.limits.buffer_high)
        sock = transport.get_extra_info("socket")
        if sock is not None and sock.family in (socket.AF_INET, socket.AF_INET6):
            _tune(sock, self.timing)
        now = self.now()
        self._timer = self.loop.call_at(now + self.timing.handshake, self._handshake_over)
        self.made()

    def get_buffer(self, sizehint: int) -> memoryview:
        # A memoryview, not the bytearray: under TLS asyncio slices it, and a slice of a bytearray
        # is a copy.
        return self._given

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._given[:nbytes])
        full = nbytes == len(self._given)
        now = self.now()
        try:
            messages = self.connection.receive_data(data)
        except ProtocolError as fault:
            self._refuse(now, fault)
            return
        self._given = self._view if full and not messages else self._first
        if self._logs:  # kinds and ids alone: results may hold tickets
            named = [f"{type(one).__name__} {getattr(one, 'id', '')}" for one in messages]
            _log.debug("received %d bytes: %s", nbytes, ", ".join(named))
        self._unheard += nbytes
        if messages or self._unheard >= HEARD:
            self._heart.heard = now
            self._unheard = 0
            self.behind = self.behind if messages else now
        if full:
            self.behind = now
        if len(messages) == 1 and type(messages[0]) not in _OWN and not self._opening:
            self.took(now, messages)
            return
        if (
            self._opening
            and self._transport is not None
            and (out := self.connection.data_to_send())
        ):
            self._transport.write(out)
        self._sort(now, messages)

    def _sort(self, now: float, messages: list[Message]) -> None:
        """Handle heartbeats here and pass the rest on. BYE or REFUSE ends the connection after the
        messages before it were handled."""
        if not messages:
            return
        last = messages[-1]
        pings = [message for message in messages if type(message) in _HEARTBEATS]
        if pings:
            if not self.beaten(now, len(pings)):
                return
            messages = [message for message in messages if type(message) not in _HEARTBEATS]
            answered = max((one.number for one in pings if type(one) is Pong), default=0)
            if self._asked is not None and answered >= self._asked[0]:
                self.read, self._asked = self._asked[1], None
            self.send([Pong(ping.number) for ping in pings if type(ping) is Ping])
        if messages:
            self.took(now, messages)
        if isinstance(last, Refuse):
            self.end(f"{last.code}: {last.text}")
        elif isinstance(last, Bye):
            self.end(last.text or "it left")

    def pause_writing(self) -> None:
        self.slow = True

    def resume_writing(self) -> None:
        self.slow = False
        if self.connection.side is Side.SERVER and self._transport is not None:
            self._heart.heard = self.now()  # the silence was ours if reading was paused
            self._transport.resume_reading()

    def connection_lost(self, fault: Exception | None) -> None:
        if not self.reason:
            self.reason = (
                f"the connection broke: {fault}" if fault is not None else "the other side hung up"
            )
        if self._timer is not None:
            self._timer.cancel()
        self._transport = None
        self.over(self.now())

    # What the owner asks for.

    def opened(self) -> None:
        """The handshake is finished: start the heartbeat."""
        self._opening = False
        self.read = now = self.now()
        self._heart = Heartbeat(now, self.timing)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_at(self._heart.due(), self._beat)

    def ping(self, now: float) -> None:
        """Ask whether the other side has read what was sent: `read` will tell."""
        self._pings += 1
        self._asked = self._asked or (self._pings, now)
        self.send((Ping(self._pings),))

    def send(self, messages: Sequence[Message]) -> None:
        """Send messages in one write. `unsendable` replaces a message that no frame can carry."""
        if self.frames:
            self.write()
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        self._heart.quiet = 0
        transport.write(self._all_bytes(messages))
        if self.slow:
            self._bear(transport)

    def send_one(self, message: Message) -> None:
        """Send one message."""
        if self.slow or self.frames or self._transport is None or self._transport.is_closing():
            self.send((message,))
            return
        self._heart.quiet = 0
        self._transport.write(self._bytes(message))

    def write(self) -> None:
        """Write the waiting frames at once."""
        frames, self.frames = self.frames, []
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        self._heart.quiet = 0
        transport.write(frames[0] if len(frames) == 1 else b"".join(frames))
        if self.slow:
            self._bear(transport)

    def _bear(self, transport: asyncio.Transport) -> None:
        waiting, hard = transport.get_write_buffer_size(), self.limits.buffer_hard
        if waiting > hard:
            self.cut(f"it does not read: more than {hard} bytes wait for it")
        elif waiting > hard / 2 and self.connection.side is Side.SERVER:
            transport.pause_reading()

    def _all_bytes(self, messages: Sequence[Message]) -> bytes:
        if not self.slow and not self._opening:
            with contextlib.suppress(ProtocolError):
                return self.connection.send_all(messages)
        return b"".join([self._bytes(message) for message in messages])

    def _bytes(self, message: Message) -> bytes:
        if self.slow and (
            type(message) is Feedback or (type(message) is Event and not message.number)
        ):
            return b""
        try:
            return self.connection.send(message)
        except ProtocolError as fault:
            if self.connection.state is not ConnectionState.OPEN:
                # The peer's BYE came together with the message that is being answered.
                return b""
            instead = self.unsendable(message, fault)
            return b"" if instead is None else self.connection.send(instead)

    def end(self, reason: str, last: Message | None = None) -> None:
        """Send a last message (Bye, Refuse) and close the connection once it is written."""
        transport = self._transport
        if transport is None:
            return
        self.reason = self.reason or reason
        if self.frames:
            self.write()
        if last is not None and not transport.is_closing():
            with contextlib.suppress(ProtocolError):
                transport.write(self.connection.send(last))
        transport.close()

    def cut(self, reason: str) -> None:
        """Close the connection at once."""
        self.reason = self.reason or reason
        if self._transport is not None:
            self._transport.abort()

    def certificate(self) -> dict[str, Any] | None:
        """Return the other end's certificate as `ssl.SSLSocket.getpeercert` does; None without
        TLS."""
        return None if self._transport is None else self._transport.get_extra_info("peercert")

    def ends(self) -> tuple[str, str]:
        """Return the addresses of the other and of this end; empty where there are none."""
        if self._transport is None:
            return "", ""
        return _host(self._transport.get_extra_info("peername")), _host(
            self._transport.get_extra_info("sockname")
        )

    def _refuse(self, now: float, fault: ProtocolError) -> None:
        opening = self.connection.version == 0
        self._sort(now, list(fault.before))
        # The state machine is closed already, so `refusal` makes the frame (with a seal, if the
        # connection has one).
        self.reason = self.reason or str(fault)
        if self._transport is not None and not self._transport.is_closing():
            refusal = self.connection.refusal(Refuse(fault.code, fault.text[:500]))
            self._transport.write(refusal)
            self._transport.close()
        self.faulted(opening, fault)

    def faulted(self, opening: bool, fault: ProtocolError) -> None:
        """The other side broke the protocol (for subclasses that count this)."""

    def _handshake_over(self) -> None:
        self.cut(f"no handshake within {self.timing.handshake:g} s: is it a node of petrobot?")

    def _beat(self) -> None:
        now = self.now()
        beat = self._heart.advance(now)
        if beat is Beat.LOST:
            self.silent = True
            self.cut(f"silent for {self.timing.silence:g} s: frozen or cut off")
            return
        self._timer = self.loop.call_at(self._heart.due(), self._beat)
        if beat is Beat.PING:
            self.ping(now)


def clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Return the clock of a loop; for asyncio's own loop the function that its `time` calls, which
    saves a call."""
    return time.monotonic if type(loop).time is asyncio.BaseEventLoop.time else loop.time


def futures_of(loop: asyncio.AbstractEventLoop) -> Callable[[], asyncio.Future[Any]]:
    """Return a factory of the loop's futures; for asyncio's own loop the class itself, which saves
    a call."""
    usual = getattr(type(loop), "create_future", None) is asyncio.BaseEventLoop.create_future
    return functools.partial(asyncio.Future, loop=loop) if usual else loop.create_future


T = TypeVar("T")


def in_thread(work: Callable[[], T]) -> asyncio.Future[T]:
    """Do what may block in a thread of its own. The threads of the loop's executor are few, and the
    process waits for them at its end: a name server that does not answer would block all others."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def end(finish: Callable[[], None]) -> None:
        if not done.done():
            finish()

    def run() -> None:
        try:
            finish = functools.partial(done.set_result, work())
        except Exception as fault:
            finish = functools.partial(done.set_exception, fault)
        with contextlib.suppress(RuntimeError):  # the loop was closed, because this took so long
            loop.call_soon_threadsafe(end, finish)

    threading.Thread(target=run, daemon=True).start()
    return done


def _host(address: object) -> str:
    return str(address[0]) if isinstance(address, tuple) and address else ""


def _tune(sock: socket.socket, timing: LinkTiming) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(timing.user_timeout * 1000))
