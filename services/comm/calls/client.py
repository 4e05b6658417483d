"""Connecting side: a `Caller` on asyncio that reconnects until it is closed.

client = Client("127.0.0.1", 7001, caller, on_notices=executor.take)
client.start()
caller.call(client.now(), Call(...)); client.flush()      # its result comes as a notice
outcome = await client.call("memory.get", {"name": "x"})  # or as an awaited outcome
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import itertools
import logging
import math
import os
import random
import re
import socket
import ssl
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

from aiohappyeyeballs import AddrInfoType, start_connection

from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.link import (
    READ_BUFFER,
    Alarm,
    AsyncLink,
    LinkLimits,
    LinkTiming,
    clock_of,
    futures_of,
    in_thread,
)
from petrobot.services.comm.protocol.messages import (
    Bye,
    Call,
    Executed,
    Message,
    Outcome,
    Refuse,
    Welcome,
)
from petrobot.services.comm.protocol.security import UNPROVEN, Keys, is_loopback
from petrobot.services.comm.protocol.wire import ConnectionState, ProtocolError, Side
from petrobot.services.comm.tls.credentials import EXPIRED, NOT_YET_VALID

_log = logging.getLogger(__name__)

OnNotices = Callable[[float, list[Notice]], None]
NOT_TRUSTED = (
    "perhaps our certificate is not trusted there, or has expired: the node only accepts TLS 1.3 "
    "and certificates of its own cell"
)
_FOR_GOOD = frozenset(("version", "key_needed", "wrong_node"))
"""Faults of the opening that another attempt does not cure. With a key, they are found only in a
proven WELCOME."""
KEY_CODES = ("key_needed", "no_key_here", "no_key_there", "wrong_key")
"""Refusals (docs/protocol.md) of a peer with another key."""
_LASTING = _FOR_GOOD.union(KEY_CODES, ("directory", "old_epoch"))
"""Refusals that stay until a person has changed something."""
_FOREIGN = ("malformed", "unknown_kind", "too_large")
"""What the first bytes of a program that is not a node of petrobot look like."""
_NUMBERS = itertools.count(1)
"""Numbers of calls, shared by all clients of this process because two of them may have the same
name and boot."""
_OUTCOMES = frozenset((Outcome,))
_NO_ARGUMENTS: Mapping[str, Any] = {}
STOOD_STILL = 0.05
"""Delay of a timer from which this process counts as having stood still (s)."""
AT_ONCE = 32
"""Calls that share one write: the peer works on them while the next ones are made."""


class _ClientLink(AsyncLink):
    """One connection to the peer."""

    def __init__(self, client: Client) -> None:
        super().__init__(
            Side.CLIENT, client.caller.peer, client.key, client.timing, client.limits, client.buffer
        )
        self._client = client
        self.finished = asyncio.Event()
        self.refusal: Refuse | None = None
        self.refused = ""
        """Code of the refusal, also of one that is not proven."""
        self.welcome = False

    def made(self) -> None:
        self.send((self._client.caller.hello,))

    def took(self, now: float, messages: list[Message]) -> None:
        client = self._client
        if _OUTCOMES.issuperset(map(type, messages)):
            client.took_outcomes(now, messages)  # type: ignore[arg-type]
            return
        for message in messages:
            if isinstance(message, Welcome):
                self.welcome = True
                self.opened()
                client.welcomed(now, self, message)
            elif isinstance(message, Refuse):
                self.refused = message.code
                if self.connection.proven:
                    self.refusal = message
                else:
                    self.reason = f"{UNPROVEN}: {message.code}: {message.text}"
            elif not isinstance(message, Bye):
                client.caller.receive(now, message)
        client.flush(now)

    def unsendable(self, message: Message, fault: ProtocolError) -> Message | None:
        if isinstance(message, Call):
            outcome = Outcome(message.id, "error", {}, fault.code, fault.text, Executed.NO)
            self._client.caller.receive(self.loop.time(), outcome)
        return None

    def faulted(self, opening: bool, fault: ProtocolError) -> None:
        self.refused = fault.code
        if opening and fault.code in _FOR_GOOD:
            self.refusal = Refuse(fault.code, fault.text)

    def over(self, now: float) -> None:
        self.finished.set()
        self._client.gone(now, self)


class Client:
    """Keeps a caller connected to its peer.

    `on_notices(now, notices)` receives the caller's notices in the event loop; the results of calls
    made by `call` are not among them.
    """

    def __init__(
        self,
        host: str,
        port: int,
        caller: Caller,
        *,
        on_notices: OnNotices | None = None,
        key: Keys | None = None,
        tls: ssl.SSLContext | None = None,
        timing: LinkTiming | None = None,
        limits: LinkLimits | None = None,
    ) -> None:
        """`key`: the shared key, or all accepted keys. `tls`: mutual TLS; the other end must then
        show the peer's certificate.

        In any case the other end must have the name of the caller's peer.
        """
        self.host = host
        self.port = port
        self.caller = caller
        self.loop = self._loop = asyncio.get_running_loop()
        self.now = clock_of(self.loop)
        """The caller's clock: monotonic, that of the loop (s)."""
        self.key = key
        self.tls = tls
        self.trouble = ""
        """Why the last attempt to connect failed, until one succeeds: the next attempt has no
        reason of its own before it ends."""
        self.answered = False
        """Whether a process answered the last attempt, even by a refusal: then none needs to be
        launched there."""
        self.timing = timing or LinkTiming()
        self.limits = limits or LinkLimits()
        self.buffer = bytearray(READ_BUFFER)
        self._on_notices = on_notices
        self._link: _ClientLink | None = None
        self._future = futures_of(self._loop)
        self._task: asyncio.Task[None] | None = None
        self._lookup: asyncio.Future[list[AddrInfoType]] | None = None
        self._alarm = Alarm(self._advance)
        self._excused = False
        self._behind = -math.inf
        self._flushing = False
        self._up = asyncio.Event()
        self._decided = asyncio.Event()
        """The peer has welcomed us, or has refused us twice in a row for a lasting reason."""
        self._refusals = 0
        self._prefix = f"{caller.hello.name}/{caller.hello.boot}/"

    def start(self) -> None:
        """Begin to connect."""
        self.caller.connecting(self.now())
        self._task = self._loop.create_task(self._connect_for_ever())

    async def connected(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds for the peer's WELCOME, but not for a peer that keeps
        refusing us; return whether it came."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._decided.wait()
        return self._up.is_set()

    @property
    def certificate_ends(self) -> float | None:
        """Return when the peer's certificate expires (s since 1970); None without TLS and while not
        connected."""
        certificate = None if self._link is None else self._link.certificate()
        return (
            None
            if certificate is None
            else float(ssl.cert_time_to_seconds(certificate["notAfter"]))
        )

    async def close(self) -> None:
        """Say BYE and disconnect; pending calls end as lost."""
        text = "the caller stops"
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        if self._lookup is not None:
            self._lookup.cancel()
        link = self._link
        if link is not None:
            link.end(text, Bye(text) if link.connection.state is ConnectionState.OPEN else None)
            await link.finished.wait()
        self._alarm.cancel()
        self.caller.link_down(self.now(), text, final=True)
        self._tell(self.now())

    # Calls.

    async def call(
        self,
        service: str,
        arguments: Mapping[str, Any] = _NO_ARGUMENTS,
        *,
        deadline: float | None = None,
        seed: int = 0,
    ) -> Outcome:
        """Call a service and return its outcome, which is acknowledged on arrival. Cancelling the
        task cancels the call."""
        id_ = f"{self._prefix}{next(_NUMBERS)}"
        now = self.now()
        future: asyncio.Future[Outcome] = self._future()
        caller = self.caller
        waiting = caller.begin(now, id_, service, arguments, deadline, "", seed, 0, "", future)
        if waiting >= AT_ONCE:
            self.flush(now)
        elif not self._flushing:
            if len(caller.pending) == 1:
                self.flush(now)
            else:
                self._flush_in_a_moment()
        try:
            return await future
        except asyncio.CancelledError:
            self.give_up(id_)
            raise

    def give_up(self, id_: str) -> None:
        """Cancel a call whose result is not wanted any more."""
        self.caller.cancel(self.now(), id_, "its caller gave up")
        self.flush()

    def _flush_in_a_moment(self) -> None:
        """Send later in this turn of the loop, so that all calls made in it share one write."""
        if not self._flushing:
            self._flushing = True
            self._loop.call_soon(self._flush_soon)

    def _flush_soon(self) -> None:
        self._flushing = False
        self.flush()

    def flush(self, now: float | None = None) -> None:
        """Send the caller's messages and deliver its notices. Call it after each use of the
        caller."""
        now = self.now() if now is None else now
        caller = self.caller
        messages = caller.messages(now)
        if messages and self._link is not None:
            if len(messages) == 1:
                self._link.send_one(messages[0])
            else:
                self._link.send(messages)
        if caller.has_news:
            self._tell(now)
        if caller.soonest < self._alarm.due:
            self._alarm.set(caller.due())

    def _tell(self, now: float) -> None:
        notices = self.caller.notices()
        if notices and self._on_notices is not None:
            self._on_notices(now, notices)

    def _advance(self) -> None:
        now = self.now()
        # Not twice in turn: a process that is always late would never give up.
        self._excused = self._alarm.late > STOOD_STILL and not self._excused
        link = self._link
        if self._excused:
            self.caller.stood_still(now)
        elif link is not None and link.read < now - self.caller.patience.accept:
            link.ping(now)  # the other side may not even have read the call
            self.caller.stood_still(now)
        elif link is not None and link.behind > self._behind:
            # What we wait for may have come behind what we were reading then.
            self._behind = link.behind
            self.caller.stood_still(self._behind)
        self.caller.advance(now)
        self.flush(now)

    # The connection.

    async def _connect_for_ever(self) -> None:
        first, longest = self.timing.backoff
        pause = first
        while True:
            link = await self._connect()
            if link is not None:
                await link.finished.wait()
                if link.welcome:
                    pause = first
            # A random part of the pause, so that many clients do not reconnect at the same moment.
            await asyncio.sleep(pause * random.uniform(0.5, 1.0))
            pause = min(2.0 * pause, longest)

    async def _connect(self) -> _ClientLink | None:
        try:
            async with asyncio.timeout(self.timing.silence):
                link = await self._reach()
        except (OSError, TimeoutError) as fault:
            self.trouble, self.answered = self._said(fault), isinstance(fault, ssl.SSLError)
            self.caller.unreached(
                self.now(), self.trouble, gone=isinstance(fault, ConnectionRefusedError)
            )
            self.flush()
            return None
        self.answered = True
        self._link = link
        return link

    async def _look_up(self) -> list[AddrInfoType]:
        """Return the addresses of the peer. A lookup that takes longer than an attempt serves the
        next one."""
        look_up: Callable[[], Any] = partial(
            socket.getaddrinfo, self.host, self.port, type=socket.SOCK_STREAM
        )
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(self.host)
            return cast("list[AddrInfoType]", look_up())
        if self._lookup is None:
            self._lookup = in_thread(look_up)
        try:
            return await asyncio.shield(self._lookup)
        finally:
            if self._lookup.done():
                self._lookup = None

    async def _reach(self) -> _ClientLink:
        # Several addresses in turn would not do: the attempt ends while the first one is silent.
        addresses = await self._look_up()
        pause = self.timing.silence / (2 * len(addresses))
        found = await start_connection(addresses, happy_eyeballs_delay=pause)
        name = self.caller.peer if self.tls is not None else None
        _, link = await self._loop.create_connection(
            lambda: _ClientLink(self), sock=found, ssl=self.tls, server_hostname=name
        )
        return link

    def took_outcomes(self, now: float, outcomes: list[Outcome]) -> None:
        """Handle results. Their owners continue in this turn of the loop; the calls that they make
        now share one write."""
        caller = self.caller
        caller.take_outcomes(now, outcomes)
        if caller.has_news:
            self.flush(now)
        elif len(outcomes) > 1 or caller.soonest < self._alarm.due:
            self._flush_in_a_moment()

    def welcomed(self, now: float, link: _ClientLink, welcome: Welcome) -> None:
        """The peer welcomed a connection."""
        level = logging.INFO if self.trouble else logging.DEBUG  # a first contact is no news
        _log.log(level, "link to %s is up", self.caller.peer)
        self._link, self.trouble = link, ""
        self._up.set()
        self._decided.set()
        self.caller.link_up(now, welcome)

    def gone(self, now: float, link: _ClientLink) -> None:
        """A connection has ended."""
        if self.tls is not None and not link.welcome and link.refusal is None:
            # In TLS 1.3 the client's handshake ends before the server has checked its certificate.
            link.reason += f"; {NOT_TRUSTED}"
        if not link.welcome and link.refusal is None and link.reason.startswith(_FOREIGN):
            link.reason += ": is it a node of petrobot?"
        self.trouble = link.reason
        serving = self._task is not None and not self._task.done()  # not ended by `close`
        # One try after the other may fail.
        level = logging.INFO if link.welcome and serving else logging.DEBUG
        _log.log(level, "link to %s is lost: %s", self.caller.peer, link.reason)
        if self._link is link:
            self._link = None
        self._up.clear()
        self._decided.clear()
        self._refusals = self._refusals + 1 if link.refused in _LASTING else 0
        if self._refusals > 1:
            self._decided.set()
        if link.refusal is not None:
            self.caller.link_refused(now, link.refusal)
        else:
            self.caller.link_down(now, link.reason, final=link.silent)
        self.flush(now)

    def _silence(self) -> str:
        """Return why nothing may answer at all."""
        if is_loopback(self.host):
            return "no answer"
        return f"no answer: is the host on, and does its firewall let TCP port {self.port} pass?"

    def _said(self, fault: Exception) -> str:
        """Return why there is no connection, in words."""
        if isinstance(fault, ssl.SSLCertVerificationError):
            if fault.verify_code == EXPIRED:
                peer = self.caller.peer
                text = f"the certificate of {peer}, or that of its authority, has expired"
                return f"{text}; make a new one with `petrobot keys --tls` and copy it to {peer}"
            early = fault.verify_code == NOT_YET_VALID
            clock = "; set the clock of this computer" if early else ""
            return f"expected the certificate of {self.caller.peer}: {fault.verify_message}{clock}"
        said = str(getattr(fault, "strerror", "") or fault) or self._silence()
        if not isinstance(fault, ssl.SSLError | socket.gaierror):
            # asyncio's text only repeats the address; several addresses may fail in several ways
            found = dict.fromkeys(re.findall(r"\[Errno (\d+)\]", str(fault)))
            said = ", ".join(os.strerror(int(number)).lower() for number in found) or said
        return (
            f"{said}; {NOT_TRUSTED}"
            if self.tls is not None
            and isinstance(fault, ConnectionResetError | ConnectionAbortedError)
            else said
        )
