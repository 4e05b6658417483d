"""Lock step across processes: a full mesh of TCP connections, one Tick message a peer and tick.

A member runs the parties that live in its process. Its Tick of number k carries all that it sent a
peer at k and says that nothing of k follows; a member runs tick k + 1 as soon as it has the Tick k
of every peer. So sends overlap with the others' work, and nobody waits for an answer. A peer that
is silent for `patience` seconds of wall time is lost.

The cell ends when one member says Bye instead of its Tick k: everybody has then run the ticks up to
k, no more, as in one process.

A member in `returning` may be lost and come back as another process (a coordinator that is
resumed): the others wait for it where they stand. They may differ by a tick, since it can have been
killed between two of its Ticks. Each tells the new process the last Tick that it has sent; that one
gives the missing marks, empty, and goes on behind the newest. What was on its way to the dead
process is lost, as with any broken connection: the node protocol says it again.
"""

from __future__ import annotations

import contextlib
import secrets
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from petrobot.services.comm.location_file import COORDINATOR
from petrobot.services.comm.location_file.host_checks import cannot_listen
from petrobot.services.comm.lockstep.cell import CellError, Delays, LocalParties, LockStepCell
from petrobot.services.comm.lockstep.party import Party, Posted
from petrobot.services.comm.protocol.messages import Bye, Hello, Message, Refuse, Tick, Welcome
from petrobot.services.comm.protocol.security import NONCE_BYTES, UNPROVEN, Keys, require_key
from petrobot.services.comm.protocol.wire import (
    NEWEST_VERSION,
    OLDEST_VERSION,
    Connection,
    ProtocolError,
    Side,
)

__all__ = ["CellError", "Delays", "LockStepCell", "Member", "PartyLostError", "TickLink"]


# The connection of two members of a lock-step cell: Ticks out, Ticks in, in order.


class PartyLostError(CellError):
    """A member of the cell is gone; `member` says which."""

    def __init__(self, member: str, text: str) -> None:
        super().__init__(f"{member}: {text}")
        self.member = member


class TickLink:
    """The connection to one peer. Never blocks.

    `before` is the broken connection that this one takes the place of: its Ticks still count, and
    what the peer repeats of them is left out. A member that `joins` a cell that goes on takes any
    Tick as the first.
    """

    def __init__(
        self,
        peer: str,
        sock: socket.socket,
        connection: Connection,
        early: Sequence[Message] = (),
        *,
        before: TickLink | None = None,
        joins: bool = False,
    ) -> None:
        sock.setblocking(False)
        self.peer = peer
        self.sock = sock
        self.ended: str | None = None
        """Text of the peer's Bye: who ended the cell and why."""
        self._connection = connection
        self._unsent = bytearray()
        self._ticks: deque[Tick] = deque(before._ticks if before is not None else ())
        self.newest: int | None = before.newest if before is not None else None if joins else -1
        """Number of the newest Tick that came."""
        self._repeats = before is not None
        self._take(early)

    @property
    def unsent(self) -> bool:
        """Whether bytes still wait for room in the socket."""
        return bool(self._unsent)

    def rest(self) -> bytes:
        """Take out the bytes that still wait."""
        rest = bytes(self._unsent)
        self._unsent.clear()
        return rest

    def has(self, number: int) -> bool:
        """Whether the peer's Tick of this number is in."""
        return self.newest is not None and self.newest >= number

    def pop(self, number: int) -> Tick:
        """The Tick of this number; older ones are left out."""
        while (tick := self._ticks.popleft()).number < number:
            pass
        return tick

    def send(self, message: Message) -> None:
        """Send a message, or as much of it as fits now; one that has ended is sent nothing more."""
        if self.ended is not None:
            return
        self._unsent += self._connection.send(message)
        self.flush()

    def flush(self) -> None:
        """Send what still waits. Raises PartyLostError if the peer is gone."""
        try:
            while self._unsent:
                del self._unsent[: self.sock.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as fault:
            raise PartyLostError(self.peer, f"its connection broke: {fault.strerror}") from None

    def read(self) -> None:
        """Take in what has arrived. Raises PartyLostError if the peer is gone, failed or broke the
        protocol."""
        try:
            data = self.sock.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError as fault:
            raise PartyLostError(self.peer, f"its connection broke: {fault.strerror}") from None
        if not data:
            if self.ended is None:
                raise PartyLostError(self.peer, "its process ended without a word")
            return
        try:
            self._take(self._connection.receive_data(data))
        except ProtocolError as fault:
            self._take(fault.before)
            raise PartyLostError(self.peer, f"it broke the protocol: {fault}") from None

    def _take(self, messages: Sequence[Message]) -> None:
        for message in messages:
            if isinstance(message, Tick):
                if self._repeats and self.newest is not None and message.number <= self.newest:
                    continue
                if self.newest is not None and message.number != self.newest + 1:
                    raise PartyLostError(
                        self.peer, f"tick {message.number} came after tick {self.newest}"
                    )
                self.newest = message.number
                self._ticks.append(message)
            elif isinstance(message, Bye):
                self.ended = message.text
            elif isinstance(message, Refuse):
                raise PartyLostError(self.peer, message.text)
            else:
                raise PartyLostError(
                    self.peer, f"a {type(message).__name__} has no place in lock step"
                )


def family(host: str) -> socket.AddressFamily:
    """Of an address written as a number."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def tune(sock: socket.socket) -> None:
    """Send at once what is to be sent."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def handshake(
    sock: socket.socket, connection: Connection, hello: Hello | None, deadline: float
) -> list[Message]:
    """Blocking: say HELLO if this side begins, go on until the other side has said something for
    the owner."""
    if hello is not None:
        sock.sendall(connection.send(hello))
    while True:
        sock.settimeout(max(deadline - time.monotonic(), 0.001))
        data = sock.recv(_CHUNK)
        if not data:
            raise ConnectionError("the other side hung up")
        messages = connection.receive_data(data)
        if out := connection.data_to_send():
            sock.sendall(out)
        if messages:
            return messages


_CHUNK: Final = 1 << 18
_RETRY: Final = 0.02
"""Seconds between attempts to reach a member that does not listen yet."""
_LINGER: Final = 1.0
"""Seconds that an ended member waits for the others to have read its Bye."""


class Member:
    """One process of a lock-step cell. `addresses` (host, port) name all members, this one too;
    `name` is among them.

    `hosts` says which member each party of the cell lives in; without it each member is one party
    of its own name. `directory` (hash of services.toml) must be the same in all. `patience` is how
    long a mark may be missing, `joining` how long members may take to come together (s of wall
    time; importing takes some on a busy host). Members in `returning` may be away for `absence` (s
    of wall time); one that comes back itself `rejoins`.
    """

    def __init__(
        self,
        name: str,
        parties: Sequence[Party],
        addresses: Mapping[str, tuple[str, int]],
        *,
        hosts: Mapping[str, str] | None = None,
        delays: Delays | None = None,
        directory: str = "",
        key: Keys | None = None,
        patience: float = 10.0,
        joining: float = 60.0,
        listener: socket.socket | None = None,
        returning: Collection[str] = (),
        absence: float = 600.0,
        rejoins: bool = False,
    ) -> None:
        self.name = name
        self.tick = 0
        """The next tick to run."""
        self._addresses = addresses
        self._hosts = dict(hosts) if hosts is not None else {member: member for member in addresses}
        self._half = LocalParties(parties, delays or Delays(), self._hosts)
        self._directory = directory
        self._key = key
        self._patience = patience
        self._joining = joining
        self._listener = listener
        self._links: dict[str, TickLink] = {}
        self._returning = frozenset(returning) - {name}
        self._absence = absence
        self._rejoins = rejoins
        self._boot = secrets.token_hex(8)

    # Coming together.

    def open(self) -> None:
        """Listen, reach the members sorted before this one, wait for those sorted after it.

        Raises PartyLostError for one that does not come within `joining`, CellError for one that
        does not fit.
        """
        before = sorted(peer for peer in self._addresses if peer < self.name)
        after = {peer for peer in self._addresses if peer > self.name}
        deadline = time.monotonic() + self._joining
        listener = self._listener or self._listen()
        try:
            for peer in before:
                self._links[peer] = self._reach(peer, deadline)
            while after:
                link = self._admit(listener, after, deadline)
                if link is not None:
                    after.discard(link.peer)
                    self._links[link.peer] = link
        except BaseException:
            self._abandon("it could not join the cell")
            raise
        finally:
            if any(peer > self.name for peer in self._returning):
                self._listener = listener
            else:
                listener.close()
        if self._rejoins:
            self._find_place(deadline)

    def _listen(self) -> socket.socket:
        host, port = self._addresses[self.name]
        require_key(self.name, host, self._key)
        try:
            return socket.create_server(
                (host, port), family=family(host), backlog=len(self._addresses)
            )
        except OSError as fault:
            key = COORDINATOR if self.name == COORDINATOR else f"nodes.{self.name}"
            raise CellError(cannot_listen(key, host, port, fault)) from None

    def _connection(self, side: Side, server: str) -> Connection:
        nonce = secrets.token_bytes(NONCE_BYTES) if self._key is not None else b""
        return Connection(side, server, key=self._key, nonce=nonce)

    def _find_place(self, deadline: float) -> None:
        """Join a cell that goes on: hear where everybody is, give the missing marks, go on behind
        the newest."""
        while missing := [link for link in self._links.values() if link.newest is None]:
            self._wait(missing, deadline)
        last = {link.peer: link.newest for link in self._links.values() if link.newest is not None}
        self.tick = max(last.values()) + 1
        for peer, link in self._links.items():
            for number in range(last[peer], self.tick):
                link.send(Tick(number))

    def _readmit(self, peer: str) -> None:
        """A member that may return is gone: wait for it, and tell it the last tick that was sent
        from here."""
        lost = self._links.pop(peer)
        lost.sock.close()
        deadline = time.monotonic() + self._absence
        link = None
        while link is None:
            try:
                if peer < self.name:
                    link = self._reach(peer, deadline, lost)
                elif self._listener is not None:
                    link = self._admit(self._listener, {peer}, deadline, lost)
                if link is not None:
                    link.send(Tick(self.tick - 1))
            except PartyLostError:
                link = None  # it was gone again before it had come
                if time.monotonic() + _RETRY >= deadline:
                    raise
                time.sleep(_RETRY)
        self._links[peer] = link

    def _reach(self, peer: str, deadline: float, before: TickLink | None = None) -> TickLink:
        host, port = self._addresses[peer]
        while True:
            try:
                sock = socket.create_connection(
                    (host, port), timeout=max(deadline - time.monotonic(), _RETRY)
                )
                break
            except OSError as fault:
                if time.monotonic() + _RETRY >= deadline:
                    raise PartyLostError(
                        peer, f"nobody answers on {host}:{port}: {fault}"
                    ) from None
                time.sleep(_RETRY)
        tune(sock)
        connection = self._connection(Side.CLIENT, peer)
        hello = Hello(
            OLDEST_VERSION, NEWEST_VERSION, "party", self.name, self._boot, 0, self._directory
        )
        try:
            early = handshake(sock, connection, hello, deadline)
        except (OSError, ProtocolError) as fault:
            sock.close()
            raise PartyLostError(peer, f"no lock step with {host}:{port}: {fault}") from None
        answer = early[0]
        if isinstance(answer, Welcome):
            return TickLink(peer, sock, connection, early[1:], before=before, joins=self._rejoins)
        sock.close()
        text = answer.text if isinstance(answer, Refuse) else "it did not welcome us"
        if not connection.proven:
            raise PartyLostError(peer, f"{UNPROVEN}: {text}")
        raise CellError(f"{peer}: {text}")

    def _admit(
        self,
        listener: socket.socket,
        after: set[str],
        deadline: float,
        before: TickLink | None = None,
    ) -> TickLink | None:
        """The next member that connects; None if it was a stranger."""
        listener.settimeout(max(deadline - time.monotonic(), 0.001))
        try:
            sock, _ = listener.accept()
        except TimeoutError:
            raise PartyLostError(
                min(after), f"it did not join the cell in {self._joining:g} s"
            ) from None
        tune(sock)
        connection = self._connection(Side.SERVER, self.name)
        try:
            hello = handshake(sock, connection, None, min(deadline, time.monotonic() + 1.0))[0]
            refusal = self._refusal(hello, after)
            if refusal is None and isinstance(hello, Hello):
                welcome = Welcome(NEWEST_VERSION, self.name, self._boot, directory=self._directory)
                sock.sendall(connection.send(welcome))
                return TickLink(hello.name, sock, connection, before=before, joins=self._rejoins)
            sock.sendall(connection.send(refusal or Refuse("malformed", "no HELLO")))
        except ProtocolError as fault:
            with contextlib.suppress(OSError):
                sock.sendall(connection.refusal(Refuse(fault.code, fault.text[:500])))
        except OSError:
            pass
        sock.close()
        return None

    def _refusal(self, hello: Message, after: set[str]) -> Refuse | None:
        if not isinstance(hello, Hello) or hello.role != "party" or hello.name not in after:
            return Refuse(
                "not_a_party",
                f"{self.name} waits for the lock-step parties {', '.join(sorted(after))}",
            )
        if hello.directory != self._directory:
            return Refuse(
                "directory",
                f"{hello.name} and {self.name} have different services.toml: copy one to both",
            )
        return None

    # Going on together.

    def run(self, until: Callable[[], bool] | None = None, max_ticks: int | None = None) -> str:
        """Run ticks until `until()` holds after one, `max_ticks` are over, or another member ends
        the cell.

        Gives why it ended: "until", "max_ticks", or "NAME: text" of the member that ended it.
        Raises PartyLostError for a member that is gone or silent, and whatever a party of this
        process raises; the others are told either way.
        """
        try:
            why = self._run(until, max_ticks)
        except BaseException as fault:
            self._abandon(f"it failed: {type(fault).__name__}: {fault}")
            raise
        self._leave(why if why not in ("until", "max_ticks") else f"{self.name}: {why}")
        return why

    def _run(self, until: Callable[[], bool] | None, max_ticks: int | None) -> str:
        while True:
            if self.tick == max_ticks:
                return "max_ticks"
            if self.tick and (ended := self._gather(self.tick - 1)) is not None:
                return ended
            outside = self._half.step(self.tick)
            self.tick += 1
            if until is not None and until():
                return "until"
            if self.tick != max_ticks:
                self._scatter(self.tick - 1, outside)

    def _scatter(self, number: int, outside: Sequence[Posted]) -> None:
        sent: dict[str, list[Posted]] = {}
        for posted in outside:
            sent.setdefault(self._hosts[posted.envelope.party], []).append(posted)
        for peer, link in self._links.items():
            envelopes = sent.get(peer)
            try:
                link.send(Tick(number, tuple(envelopes)) if envelopes else Tick(number))
            except PartyLostError:
                if peer not in self._returning:
                    raise  # else it is missed, and waited for, when its own Tick is due

    def _gather(self, number: int) -> str | None:
        """Wait for every peer's Tick of this number and deliver it; gives why the cell has ended,
        if it has."""
        deadline = time.monotonic() + (self._absence if self._returning else self._patience)
        links = self._links.values()
        while True:
            missing = [link for link in links if not link.has(number)]
            for link in missing:
                if link.ended is not None:
                    return link.ended
            if not missing:
                break
            self._wait(missing, deadline)
        for link in links:
            self._deliver(link.peer, link.pop(number))
        return None

    def _wait(self, missing: Sequence[TickLink], deadline: float) -> None:
        """Block until a socket has something to read, or room for what is still to go out."""
        poll = select.poll()
        by_number = {link.sock.fileno(): link for link in self._links.values()}
        for link in self._links.values():
            if link in missing or link.peer in self._returning:
                poll.register(link.sock, select.POLLIN)
        for number, link in by_number.items():
            if link.unsent:
                poll.register(number, select.POLLIN | select.POLLOUT)
        ready = poll.poll(max(deadline - time.monotonic(), 0.0) * 1000.0)
        if not ready:
            patience = self._absence if self._returning else self._patience
            raise PartyLostError(
                missing[0].peer, f"no end of tick {self.tick - 1} for {patience:g} s: lost"
            )
        for number, what in ready:
            link = by_number[number]
            try:
                if what & select.POLLOUT:
                    link.flush()
                if what & ~select.POLLOUT:
                    link.read()
            except PartyLostError:
                if link.peer not in self._returning:
                    raise
                self._readmit(link.peer)

    def _deliver(self, peer: str, tick: Tick) -> None:
        for posted in tick.envelopes:
            envelope = posted.envelope
            if posted.due <= tick.number or self._hosts.get(envelope.party) != self.name:
                raise PartyLostError(
                    peer,
                    f"an envelope of {envelope.source} to {envelope.party} does not belong here",
                )
            self._half.own(envelope.source, peer)
            self._half.deliver(tick.number, posted)

    # Going apart.

    def _leave(self, text: str) -> None:
        """Say Bye to all, and wait until they have read it: closing at once could take it from
        them."""
        for link in self._links.values():
            with contextlib.suppress(PartyLostError, ProtocolError):
                link.send(Bye(text))
        self._close(_LINGER)

    def _abandon(self, text: str) -> None:
        for link in self._links.values():
            with contextlib.suppress(PartyLostError, ProtocolError):
                link.send(Refuse("failed", text[:1000]))
        self._close(_LINGER)

    def _close(self, linger: float) -> None:
        deadline = time.monotonic() + linger
        for link in self._links.values():
            with contextlib.suppress(OSError):
                link.sock.settimeout(max(deadline - time.monotonic(), 0.001))
                link.sock.sendall(link.rest())
                link.sock.shutdown(socket.SHUT_WR)
                while time.monotonic() < deadline and link.sock.recv(_CHUNK):
                    pass
            link.sock.close()
        self._links.clear()
        if self._listener is not None:
            self._listener.close()
