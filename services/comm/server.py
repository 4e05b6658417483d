"""The listening end: a `Callee` on asyncio.

    server = Server(callee, on_orders=node.take)
    await server.start("127.0.0.1", 7001)
    ...
    callee.finish(server.now(), id, "success", values)
    server.flush()

Services answered on the spot (`Offer.inline`) never leave the loop; everything else comes to `on_orders`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from services.comm.callee import Callee, Order
from services.comm.link import READ_BUFFER, Limits, Link, Timing
from services.comm.messages import Answer, Bye, Call, Hello, Message, Outcome, Refuse
from services.comm.security import is_loopback, require_key
from services.comm.wire import ProtocolError, Side, State

OnOrders = Callable[[float, list[Order]], None]


class _ServerLink(Link):
    """A caller's connection."""

    def __init__(self, server: Server) -> None:
        super().__init__(Side.SERVER, server.key, server.timing, server.limits, server.buffer)
        self._server = server
        self.peer = ""
        """The caller's name, once it is welcome."""

    def made(self) -> None:
        self._server.came(self)

    def took(self, now: float, messages: list[Message]) -> None:
        callee, peer = self._server.callee, self.peer
        if peer and len(messages) == 1 and type(messages[0]) is Call:
            outcome = callee.answer_inline(now, peer, messages[0])
            if outcome is not None:
                # The shortest way for what is answered on the spot.
                self.send_one(outcome)
                if callee.has_work:
                    self._server.flush(now)
                return
        for message in messages:
            if isinstance(message, Hello):
                self._greet(now, message)
                peer = self.peer
            elif peer:
                callee.receive(now, peer, message)
        self._server.flush(now)

    def _greet(self, now: float, hello: Hello) -> None:
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
            text = f"its result cannot be sent: {fault.text}"
            return Outcome(message.id, "error", {}, "bad_result", text, message.executed, message.seconds)
        if isinstance(message, Answer):
            return Answer(message.id, False, {"cause": fault.code, "text": fault.text})
        return None

    def faulted(self, opening: bool, fault: ProtocolError) -> None:
        self._server.faults[fault.code] = self._server.faults.get(fault.code, 0) + 1

    def over(self, now: float) -> None:
        self._server.gone(self, now)


class Server:
    """Serves a callee on one address. `on_orders(now, orders)` gets what the node has to do, in the loop."""

    def __init__(
        self,
        callee: Callee,
        *,
        on_orders: OnOrders | None = None,
        key: bytes | None = None,
        timing: Timing | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.callee = callee
        self.key = key
        self.timing = timing or Timing()
        self.limits = limits or Limits()
        self.faults: dict[str, int] = {}
        """How often callers broke the protocol, by code."""
        self.buffer = bytearray(READ_BUFFER)
        self._on_orders = on_orders
        self._links: dict[str, _ServerLink] = {}
        self._opening: dict[_ServerLink, None] = {}
        self._all: set[_ServerLink] = set()
        self._server: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def now(self) -> float:
        """The clock that the callee lives by: monotonic, of the loop (s)."""
        assert self._loop is not None, "the server has not been started"
        return self._loop.time()

    async def start(self, host: str, port: int) -> None:
        """Listen. Raises KeyNeededError if other hosts could connect and there is no key, OSError if it cannot be done."""
        require_key(self.callee.name, host, self.key)
        self._loop = asyncio.get_running_loop()
        self._server = await self._loop.create_server(lambda: _ServerLink(self), host, port, backlog=128)

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
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
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
        self._arm()

    def _send(self, peer: str, messages: list[Message]) -> None:
        link = self._links.get(peer)
        if link is not None:
            link.send(messages)

    def _arm(self) -> None:
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

    # What links report.

    def came(self, link: _ServerLink) -> None:
        """A connection stands. Above the limits the oldest one that has not shown who it is gives way, else the new one."""
        self._all.add(link)
        self._opening[link] = None
        if len(self._opening) > self.limits.opening or len(self._all) > self.limits.connections:
            next(iter(self._opening)).cut("too many connections")

    def welcomed(self, link: _ServerLink) -> None:
        """A caller has been welcomed; an older connection of its name is cut."""
        self._opening.pop(link, None)
        older = self._links.get(link.peer)
        self._links[link.peer] = link
        if older is not None:
            older.cut("a newer connection of its name took its place")

    def gone(self, link: _ServerLink, now: float) -> None:
        """A connection is over."""
        self._all.discard(link)
        self._opening.pop(link, None)
        if link.peer and self._links.get(link.peer) is link:
            del self._links[link.peer]
            self.callee.link_down(now, link.peer)
            self.flush(now)
