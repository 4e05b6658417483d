"""Listening side: a `Callee` on asyncio.

    server = Server(callee, on_orders=node.take)
    await server.start("127.0.0.1", 7001)
    ...
    callee.finish(server.now(), Outcome(id, "success", values))
    server.flush()

Inline services (`Offer.inline`) are answered inside the loop; all other calls become orders for
`on_orders`.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections import OrderedDict
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final

from petrobot.services.comm.calls.callee import Callee, Order
from petrobot.services.comm.calls.link import (
    READ_BUFFER,
    Alarm,
    AsyncLink,
    LinkLimits,
    LinkTiming,
    stop_accepting,
)
from petrobot.services.comm.protocol.messages import (
    Answer,
    Bye,
    Call,
    Hello,
    Message,
    Outcome,
    Refuse,
)
from petrobot.services.comm.protocol.security import Keys, is_loopback, require_key
from petrobot.services.comm.protocol.wire import ConnectionState, ProtocolError, Side
from petrobot.services.comm.tls.credentials import DAY, look_again, may_speak_as, name_on
from petrobot.services.comm.tls.listener import Admission, TlsListener

_log = logging.getLogger(__name__)

# Limits of a listening end (sans-I/O): failed handshakes per address, messages per caller.

KNOWN: Final = 1_024
"""How many addresses are remembered with their failures; then the one whose last failure is oldest
is forgotten."""


class TokenBucket:
    """A token bucket: `rate` per second on average, at most `burst` at once."""

    __slots__ = ("_at", "_burst", "_level", "_rate")

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self._rate, self._burst = rate, burst
        self._level, self._at = burst, now

    def level(self, now: float) -> float:
        """Return how many tokens are left; below 0, how many were taken in advance."""
        self._level = min(self._burst, self._level + (now - self._at) * self._rate)
        self._at = now
        return self._level

    def take(self, now: float, amount: float) -> float:
        """Take tokens; return the seconds until they are no longer owed (0: there were enough)."""
        self._level = self.level(now) - amount
        return max(0.0, -self._level / self._rate)


class FailedHandshakes:
    """Failed handshakes by address: an address that only connects, or guesses keys, is ignored for
    a while.

    A caller with the right key fails none, so its own address never makes it wait. `rate` per
    second and `burst` at once are allowed.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()

    def admits(self, now: float, address: str) -> bool:
        """Return whether this address may try a handshake."""
        bucket = self._buckets.get(address)
        return bucket is None or bucket.level(now) >= 1.0

    def failed(self, now: float, address: str) -> None:
        """Count a failed handshake of this address."""
        bucket = self._buckets.pop(address, None) or TokenBucket(self._rate, self._burst, now)
        self._buckets[address] = bucket
        if bucket.level(now) >= 1.0:
            bucket.take(now, 1.0)
        if len(self._buckets) > KNOWN:
            self._buckets.popitem(last=False)


OnOrders = Callable[[float, list[Order]], None]
AT_ONCE = 16
"""Answers that share one write: the caller reads them while the next ones are made."""
BACKLOG = 128
"""Connections that may wait to be accepted."""
ACCEPTED = 16
"""Connections accepted in one turn of the loop: many new connections must not delay the callers
that are already connected."""
COUNTED = 256
"""The rate of a caller is checked after this many messages."""


class _ServerLink(AsyncLink):
    """A caller's connection."""

    def __init__(self, server: Server) -> None:
        super().__init__(
            Side.SERVER, server.callee.name, server.key, server.timing, server.limits, server.buffer
        )
        self._server = server
        self.peer = ""
        """The caller's name, once it is welcome."""
        self.address = ""
        limits = server.limits
        self._taken = 0
        self._budget = TokenBucket(limits.messages, limits.messages_at_once, self.now())

    def made(self) -> None:
        self.address, _ = self.ends()
        self._server.came(self)

    def took(self, now: float, messages: list[Message]) -> None:
        callee, peer = self._server.callee, self.peer
        self._taken += len(messages)
        if self._taken >= COUNTED and not self._in_time(now):
            return
        at_once = min(len(messages), AT_ONCE)
        for message in messages:
            if (
                type(message) is Call
                and peer
                and (answer := callee.answer_inline(now, peer, message)) is not None
            ):
                # Fast path for inline services: the answer is written before it is stored, so that
                # the caller reads it while this process stores it.
                answer, frame = self._framed(answer)
                self.frames.append(frame)
                if len(self.frames) >= at_once:
                    self.write()
                callee.keep(now, peer, answer, len(frame) or None)
            elif isinstance(message, Hello):
                self._greet(now, message)
                peer = self.peer
            elif peer:
                callee.receive(now, peer, message)
        if self.frames:
            self.write()
        self._server.flush(now)

    def _framed(self, answer: Outcome) -> tuple[Outcome, bytes]:
        """Return a result and its frame; if no frame can carry it, an ERROR result in its place."""
        try:
            return answer, self.connection.send(answer)
        except ProtocolError as fault:
            if self.connection.state is not ConnectionState.OPEN:
                # The caller's BYE came with the call. The stored result is there when it is back.
                return answer, b""
            answer = _bad_result(answer, fault)
            return answer, self.connection.send(answer)

    def beaten(self, now: float, count: int) -> bool:
        self._taken += count
        return self._taken < COUNTED or self._in_time(now)

    def _in_time(self, now: float) -> bool:
        """Pause reading from a caller that sends too fast. Return False if it was far too fast and
        is disconnected."""
        wait = self._budget.take(now, self._taken)
        self._taken = 0
        if wait <= 0.0 or self._transport is None:
            return True
        self._server.count("too_fast")
        if wait > self.timing.silence / 2:
            limits = self.limits
            text = (
                f"at most {limits.messages_at_once} messages at once and "
                f"{limits.messages:g} per second: send fewer"
            )
            self.end(f"too_fast: {text}", Refuse("too_fast", text))
            return False
        self._transport.pause_reading()
        self.loop.call_later(wait, self._go_on)
        return True

    def _go_on(self) -> None:
        self._heart.heard = self.now()  # the silence was ours: reading was paused
        if self._transport is not None and not self.slow:
            self._transport.resume_reading()

    def certified(self) -> str | None:
        """Return the name on the caller's certificate; None without TLS."""
        if self._server.tls is None or self._transport is None:
            return None
        return name_on(self.certificate())

    def _greet(self, now: float, hello: Hello) -> None:
        certified = self.certified()
        if certified is not None and not may_speak_as(certified, hello.role, hello.name):
            text = (
                f"the certificate of {certified or 'no name'} does not allow the caller to act as "
                f"{hello.role} {hello.name}"
            )
            self._server.count("certificate")
            self.end(f"certificate: {text}", Refuse("certificate", text))
            return
        answer = self._server.callee.link_up(now, hello.name, hello, local=self._is_local())
        if isinstance(answer, Refuse):
            self.end(f"{answer.code}: {answer.text}", answer)
            return
        self.send((answer,))
        self.peer = hello.name
        self.opened()
        self._server.welcomed(self)

    def _is_local(self) -> bool:
        there, here = self.ends()
        return not there or there == here or is_loopback(there)

    def unsendable(self, message: Message, fault: ProtocolError) -> Message | None:
        if isinstance(message, Outcome):
            return _bad_result(message, fault)
        if isinstance(message, Answer):
            return Answer(message.id, False, {"cause": fault.code, "text": fault.text})
        return None

    def faulted(self, opening: bool, fault: ProtocolError) -> None:
        self._server.count(fault.code)

    def over(self, now: float) -> None:
        self._server.gone(self, now)


def _bad_result(outcome: Outcome, fault: ProtocolError) -> Outcome:
    text = f"its result cannot be sent: {fault.text}"
    return Outcome(outcome.id, "error", {}, "bad_result", text, outcome.executed, outcome.seconds)


class Server:
    """Serves a callee at one address. `on_orders(now, orders)` receives the callee's orders, in the
    loop."""

    def __init__(
        self,
        callee: Callee,
        *,
        on_orders: OnOrders | None = None,
        key: Keys | None = None,
        tls: ssl.SSLContext | None = None,
        timing: LinkTiming | None = None,
        limits: LinkLimits | None = None,
    ) -> None:
        """`tls`: mutual TLS; each caller must use the name on its certificate."""
        self.callee = callee
        self.key = key
        self.tls = tls
        self.timing = timing or LinkTiming()
        self.limits = limits or LinkLimits()
        self.faults: dict[str, int] = {}
        """How often callers broke the protocol, by code."""
        self.buffer = bytearray(READ_BUFFER)
        self._on_orders = on_orders
        self._links: dict[str, _ServerLink] = {}
        self._opening: dict[_ServerLink, None] = {}
        self._all: set[_ServerLink] = set()
        self._closed = False
        self._server: asyncio.Server | TlsListener | None = None
        self._knocks = FailedHandshakes(self.limits.handshakes, self.limits.handshakes_at_once)
        self._alarm = Alarm(self._advance)
        self._daily: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def now(self) -> float:
        """Return the time on the callee's clock: monotonic, that of the loop (s)."""
        assert self._loop is not None, "the server has not been started"
        return self._loop.time()

    async def start(self, host: str, port: int) -> None:
        """Listen. Raises KeyNeededError if other hosts could connect and there is no key, OSError
        if the address cannot be used."""
        require_key(self.callee.name, host, self.key or self.tls is not None)
        self._closed = False
        self._loop = asyncio.get_running_loop()
        if self.tls is None:
            at_once = max(1, min(ACCEPTED, self.limits.opening // 4))
            server = await self._loop.create_server(
                lambda: _ServerLink(self), host, port, backlog=at_once
            )
            for sock in server.sockets:
                with sock.dup() as own:
                    # asyncio accepts `backlog` connections per turn of the loop and passes the same
                    # number to listen(). We want few per turn but a long queue.
                    own.listen(BACKLOG)
            self._server = server
        else:
            listener = TlsListener(host, port, self.tls, self.timing.handshake, self.limits.opening)
            self._server = listener
            self._look_at_certificates()
            listener.start(Admission(lambda: _ServerLink(self), self.admits, self.failed))

    @property
    def address(self) -> tuple[str, int]:
        """Return the address at which it listens."""
        assert self._server is not None, "the server has not been started"
        host, port = self._server.sockets[0].getsockname()[:2]
        return str(host), int(port)

    @property
    def connected(self) -> tuple[str, ...]:
        """Return the names of the connected callers."""
        return tuple(self._links)

    async def close(self, text: str = "the node stops") -> None:
        """Say BYE to all callers and stop listening."""
        self._closed = True
        if isinstance(self._server, asyncio.Server):
            await stop_accepting(self._server)
        elif self._server is not None:
            self._server.close()
        for link in list(self._all):
            if link.connection.state is ConnectionState.OPEN:
                link.end(text, Bye(text))
            else:
                link.cut(text)
        self._alarm.cancel()
        if self._daily is not None:
            self._daily.cancel()
        if self._server is not None:
            await self._server.wait_closed()
        while self._all:
            await asyncio.sleep(0)

    def flush(self, now: float | None = None) -> None:
        """Deliver the callee's orders and send its messages. Call it after each report to the
        callee."""
        now = self.now() if now is None else now
        callee = self.callee
        if self._on_orders is not None:
            while orders := callee.orders():
                self._on_orders(now, orders)
        messages = callee.messages()
        if len(messages) == 1:
            peer, message = messages[0]
            link = self._links.get(peer)
            if link is not None:
                link.send_one(message)
        elif messages:
            by_peer: dict[str, list[Message]] = {}
            for peer, message in messages:
                by_peer.setdefault(peer, []).append(message)
            for peer, its in by_peer.items():
                self._send(peer, its)
        if callee.soonest < self._alarm.due:
            self._alarm.set(callee.due())

    def _send(self, peer: str, messages: list[Message]) -> None:
        link = self._links.get(peer)
        if link is not None:
            link.send(messages)

    def _advance(self) -> None:
        now = self.now()
        self.callee.advance(now)
        self.flush(now)

    def _look_at_certificates(self) -> None:
        """Check once a day whether a certificate expires soon: a node may run for years."""
        assert self._loop is not None
        look_again(datetime.now(UTC))
        self._daily = self._loop.call_later(DAY, self._look_at_certificates)

    # Reports of connections.

    def came(self, link: _ServerLink) -> None:
        """A connection is established. Above the limits the oldest connection without WELCOME is
        closed, which may be this one."""
        if self._closed:  # it was accepted before, and is reported only now
            link.cut("the node stops")
            return
        if self.tls is None and not self.admits(link.address):
            link.cut("too many handshakes of its address have failed")
            self.count("knocks")
            return
        self._all.add(link)
        self._opening[link] = None
        if len(self._opening) > self.limits.opening or len(self._all) > self.limits.connections:
            oldest = next(iter(self._opening))
            self._opening.pop(oldest)  # now, because `gone` follows in a later turn of the loop
            self.failed(oldest.address)
            oldest.cut("too many connections")

    def welcomed(self, link: _ServerLink) -> None:
        """A caller was welcomed; an older connection of its name is closed."""
        self._opening.pop(link, None)
        older = self._links.get(link.peer)
        self._links[link.peer] = link
        _log.info("link of %s (%s) is up", link.peer, link.address)
        if older is not None:
            older.cut("a newer connection of its name took its place")

    def count(self, fault: str) -> None:
        """Count a fault of a caller."""
        self.faults[fault] = self.faults.get(fault, 0) + 1

    def admits(self, address: str) -> bool:
        """Return whether connections of this address are accepted."""
        spared = self.limits.spare_loopback and is_loopback(address)
        return spared or self._knocks.admits(self.now(), address)

    def failed(self, address: str) -> None:
        """A connection of this address ended before it was welcomed."""
        self._knocks.failed(self.now(), address)

    def gone(self, link: _ServerLink, now: float) -> None:
        """A connection has ended."""
        level = logging.INFO if link.peer else logging.DEBUG  # strangers must not fill the log
        _log.log(level, "link of %s (%s) is lost: %s", link.peer, link.address, link.reason)
        if link in self._opening:
            self.failed(link.address)
        self._all.discard(link)
        self._opening.pop(link, None)
        if link.peer and self._links.get(link.peer) is link:
            del self._links[link.peer]
            self.callee.link_down(now, link.peer)
            self.flush(now)
