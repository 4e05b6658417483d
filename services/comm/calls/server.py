"""The listening end: a `Callee` on asyncio.

    server = Server(callee, on_orders=node.take)
    await server.start("127.0.0.1", 7001)
    ...
    callee.finish(server.now(), id, "success", values)
    server.flush()

Services answered on the spot (`Offer.inline`) never leave the loop; everything else comes to
`on_orders`.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import Callable
from datetime import UTC, datetime

from petrobot.services.comm.calls.callee import Callee, Order
from petrobot.services.comm.calls.connection_limits import Bucket, Knocks
from petrobot.services.comm.calls.link import READ_BUFFER, Limits, Link, Timing
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
from petrobot.services.comm.protocol.wire import ProtocolError, Side, State
from petrobot.services.comm.tls.credentials import may_speak_as, name_on
from petrobot.services.comm.tls.expiry import DAY, look_again
from petrobot.services.comm.tls.listener import Admission, TlsListener

_log = logging.getLogger(__name__)

OnOrders = Callable[[float, list[Order]], None]
AT_ONCE = 16
"""Answers that share one write: the caller takes them in while the next ones are made."""
BACKLOG = 128
"""Connections that may wait to be accepted, and"""
ACCEPTED = 16
"""how many are accepted in one turn of the loop: a crowd at the door must not keep those inside
waiting."""
COUNTED = 256
"""Messages of a caller after which its rate is looked at."""


class _ServerLink(Link):
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
        self._budget = Bucket(limits.messages, limits.messages_at_once, self.now())

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
                # The shortest way for what is answered on the spot; the caller reads while its
                # answer is being kept here.
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
        if callee.has_work:
            self._server.flush(now)
        else:
            self._server.arm()

    def _framed(self, answer: Outcome) -> tuple[Outcome, bytes]:
        """A result and its frame; where no frame can carry it, what is answered in its place, which
        is then what is kept."""
        try:
            return answer, self.connection.send(answer)
        except ProtocolError as fault:
            if self.connection.state is not State.OPEN:
                return (
                    answer,
                    b"",
                )  # its last word came with the call: it may ask again when it is back
            answer = _bad_result(answer, fault)
            return answer, self.connection.send(answer)

    def beaten(self, now: float, count: int) -> bool:
        self._taken += count
        return self._taken < COUNTED or self._in_time(now)

    def _in_time(self, now: float) -> bool:
        """Read no more for a while from one that sends faster than it may; False: it is too much,
        and it must go."""
        wait = self._budget.take(now, self._taken)
        self._taken = 0
        if wait <= 0.0 or self._transport is None:
            return True
        self._server.count("too_fast")
        if wait > self.timing.silence / 2:
            limits = self.limits
            text = (
                f"at most {limits.messages_at_once} messages at once and "
                f"{limits.messages:g} a second: send fewer"
            )
            self.end(f"too_fast: {text}", Refuse("too_fast", text))
            return False
        self._transport.pause_reading()
        self.loop.call_later(wait, self._go_on)
        return True

    def _go_on(self) -> None:
        self._heart.heard = self.now()  # it was we who did not listen
        if self._transport is not None and not self.slow:
            self._transport.resume_reading()

    def certified(self) -> str | None:
        """The name on the caller's certificate; None without TLS."""
        if self._server.tls is None or self._transport is None:
            return None
        return name_on(self.certificate())

    def _greet(self, now: float, hello: Hello) -> None:
        certified = self.certified()
        if certified is not None and not may_speak_as(certified, hello.role, hello.name):
            text = (
                f"the certificate of {certified or 'nobody'} does not let you speak as "
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
    """Serves a callee on one address. `on_orders(now, orders)` gets what the node has to do, in the
    loop."""

    def __init__(
        self,
        callee: Callee,
        *,
        on_orders: OnOrders | None = None,
        key: Keys | None = None,
        tls: ssl.SSLContext | None = None,
        timing: Timing | None = None,
        limits: Limits | None = None,
    ) -> None:
        """`tls`: mutual TLS; each caller speaks under the name on its certificate."""
        self.callee = callee
        self.key = key
        self.tls = tls
        self.timing = timing or Timing()
        self.limits = limits or Limits()
        self.faults: dict[str, int] = {}
        """How often callers broke the protocol, by code."""
        self.buffer = bytearray(READ_BUFFER)
        self._on_orders = on_orders
        self._links: dict[str, _ServerLink] = {}
        self._opening: dict[_ServerLink, None] = {}
        self._all: set[_ServerLink] = set()
        self._server: asyncio.Server | TlsListener | None = None
        self._knocks = Knocks(self.limits.handshakes, self.limits.handshakes_at_once)
        self._timer: asyncio.TimerHandle | None = None
        self._daily: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def now(self) -> float:
        """The clock that the callee lives by: monotonic, of the loop (s)."""
        assert self._loop is not None, "the server has not been started"
        return self._loop.time()

    async def start(self, host: str, port: int) -> None:
        """Listen. Raises KeyNeededError if other hosts could connect and there is no key, OSError
        if it cannot be done."""
        require_key(self.callee.name, host, self.key or self.tls is not None)
        self._loop = asyncio.get_running_loop()
        if self.tls is None:
            server = await self._loop.create_server(
                lambda: _ServerLink(self), host, port, backlog=ACCEPTED
            )
            for sock in server.sockets:
                with sock.dup() as own:
                    own.listen(
                        BACKLOG
                    )  # asyncio takes as many in one turn as it lets wait: of that we want less
            self._server = server
        else:
            listener = TlsListener(host, port, self.tls, self.timing.handshake, self.limits.opening)
            self._server = listener
            self._look_at_certificates()
            listener.start(Admission(lambda: _ServerLink(self), self.admits, self.failed))

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        assert self._server is not None, "the server has not been started"
        host, port = self._server.sockets[0].getsockname()[:2]
        return str(host), int(port)

    @property
    def connected(self) -> tuple[str, ...]:
        """Names of the callers that are welcome and here."""
        return tuple(self._links)

    async def close(self, text: str = "the node stops") -> None:
        """Say good-bye to all callers and listen no more."""
        if self._server is not None:
            self._server.close()
        for link in list(self._all):
            if link.connection.state is State.OPEN:
                link.end(text, Bye(text))
            else:
                link.cut(text)
        for timer in (self._timer, self._daily):
            if timer is not None:
                timer.cancel()
        self._timer = self._daily = None
        if self._server is not None:
            await self._server.wait_closed()
        while self._all:
            await asyncio.sleep(0)

    def flush(self, now: float | None = None) -> None:
        """Hand out the callee's orders and messages; call it after each report to the callee."""
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
        self.arm()

    def _send(self, peer: str, messages: list[Message]) -> None:
        link = self._links.get(peer)
        if link is not None:
            link.send(messages)

    def arm(self) -> None:
        """Have the callee's `advance` called when it is due."""
        if self._timer is not None and self._timer.when() <= self.callee.soonest:
            return
        due = self.callee.due()
        if due is None or (self._timer is not None and self._timer.when() <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        assert self._loop is not None
        self._timer = self._loop.call_at(due, self._advance)

    def _advance(self) -> None:
        self._timer = None
        now = self.now()
        self.callee.advance(now)
        self.flush(now)

    def _look_at_certificates(self) -> None:
        """A node may run for years: look each day whether its certificates end."""
        assert self._loop is not None
        look_again(datetime.now(UTC))
        self._daily = self._loop.call_later(DAY, self._look_at_certificates)

    # What links report.

    def came(self, link: _ServerLink) -> None:
        """A connection stands. Above the limits the oldest one that has not shown who it is gives
        way, else the new one."""
        if self.tls is None and not self.admits(link.address):
            link.cut("too many handshakes of its address have failed")
            self.count("knocks")
            return
        self._all.add(link)
        self._opening[link] = None
        if len(self._opening) > self.limits.opening or len(self._all) > self.limits.connections:
            oldest = next(iter(self._opening))
            self._opening.pop(oldest)  # now: it is told of its end in a later turn of the loop only
            self.failed(oldest.address)
            oldest.cut("too many connections")

    def welcomed(self, link: _ServerLink) -> None:
        """A caller has been welcomed; an older connection of its name is cut."""
        self._opening.pop(link, None)
        older = self._links.get(link.peer)
        self._links[link.peer] = link
        _log.info("link of %s (%s) is up", link.peer, link.address)
        if older is not None:
            older.cut("a newer connection of its name took its place")

    def count(self, fault: str) -> None:
        """Count what a caller did wrong."""
        self.faults[fault] = self.faults.get(fault, 0) + 1

    def admits(self, address: str) -> bool:
        """Whether a connection of this address is listened to."""
        spared = self.limits.spare_loopback and is_loopback(address)
        return spared or self._knocks.admits(self.now(), address)

    def failed(self, address: str) -> None:
        """A connection of this address ended before it was welcome."""
        self._knocks.failed(self.now(), address)

    def gone(self, link: _ServerLink, now: float) -> None:
        """A connection is over."""
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
