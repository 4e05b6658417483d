"""Lock step across processes: a full mesh of TCP connections, one Tick message per peer and tick.

A member runs the parties of its process. Its Tick number k to a peer carries all envelopes that it
sent to that peer at tick k and also marks the end of tick k. A member runs tick k + 1 as soon as it
has the Tick k of every peer. So sending overlaps with computing, and there is no central process to
wait for. A peer that is silent for `patience` seconds of wall time is lost.

The cell ends when a member sends Bye instead of its Tick k. Every member has then run exactly the
ticks up to k, as in one process.

A member in `returning` may be lost and come back as a new process (a coordinator that is resumed);
the others wait for it. They may be one tick apart, because the old process can have been killed
between two of its Ticks. Each of them sends the new process the number of the last Tick that it
sent to the old one. The new process begins behind the highest of these numbers, and sends the
missing Ticks empty. Envelopes on their way to the dead process are lost, as with any broken
connection; the node protocol repeats what matters.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, Protocol

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.location_file.host_checks import cannot_listen
from petrobot.services.comm.lockstep.cell import (
    CellError as CellError,
    Delays as Delays,
    LocalParties,
    LockStepCell as LockStepCell,
)
from petrobot.services.comm.lockstep.party import Party, Posted
from petrobot.services.comm.protocol.messages import (
    COORDINATOR,
    Bye,
    Hello,
    Message,
    Refuse,
    Tick,
    Welcome,
)
from petrobot.services.comm.protocol.security import (
    NONCE_BYTES,
    UNPROVEN,
    KeyNeededError,
    Keys,
    is_loopback,
    require_key,
)
from petrobot.services.comm.protocol.wire import (
    NEWEST_VERSION,
    OLDEST_VERSION,
    Connection,
    ProtocolError,
    Side,
)
from petrobot.services.comm.tls.credentials import shared_keys


class PartyLostError(CellError):
    """A member of the cell is lost; `member` is its name."""

    def __init__(self, member: str, text: str) -> None:
        super().__init__(member, text)
        self.member, self.text = member, text

    def __str__(self) -> str:
        return f"{self.member}: {self.text}"


class TickLink:
    """The connection to one peer. Never blocks.

    `before` is the broken connection that this one replaces: its Ticks still count, and Ticks that
    the peer repeats are dropped. A member that `joins` an active cell accepts any Tick as the
    first.
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
        """Text of the peer's Bye: which member ended the cell, and why."""
        self._connection = connection
        self._unsent = bytearray()
        self._ticks: deque[Tick] = deque(before._ticks if before is not None else ())
        self.newest: int | None = before.newest if before is not None else None if joins else -1
        """Number of the newest Tick that arrived."""
        self._repeats = before is not None
        self._take(early)

    @property
    def unsent(self) -> bool:
        """Return whether bytes still wait for room in the socket."""
        return bool(self._unsent)

    def rest(self) -> bytes:
        """Take out the bytes that still wait."""
        rest = bytes(self._unsent)
        self._unsent.clear()
        return rest

    def has(self, number: int) -> bool:
        """Return whether the peer's Tick of this number has arrived."""
        return self.newest is not None and self.newest >= number

    def pop(self, number: int) -> Tick:
        """Take out the Tick of this number; older ones are dropped."""
        while (tick := self._ticks.popleft()).number < number:
            pass
        return tick

    def send(self, message: Message) -> None:
        """Send a message, or as much of it as fits now. A peer that said Bye is sent nothing
        more."""
        if self.ended is not None:
            return
        self._unsent += self._connection.send(message)
        self.flush()

    def flush(self) -> None:
        """Send the bytes that still wait. Raises PartyLostError if the peer is gone."""
        try:
            while self._unsent:
                del self._unsent[: self.sock.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as fault:
            raise PartyLostError(self.peer, f"its connection broke: {fault.strerror}") from None

    def read(self) -> None:
        """Read what has arrived. Raises PartyLostError if the peer is gone, has failed or broke the
        protocol."""
        try:
            data = self.sock.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError as fault:
            raise PartyLostError(self.peer, f"its connection broke: {fault.strerror}") from None
        if not data:
            if self.ended is None:
                raise PartyLostError(self.peer, "its process ended without a BYE message")
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
                        self.peer,
                        f"expected tick {self.newest + 1}, got tick {message.number}",
                    )
                self.newest = message.number
                self._ticks.append(message)
            elif isinstance(message, Bye):
                self.ended = message.text
            elif isinstance(message, Refuse):
                raise PartyLostError(self.peer, message.text)
            else:
                raise PartyLostError(
                    self.peer, f"a {type(message).__name__} is not allowed in lock step"
                )


def family(host: str) -> socket.AddressFamily:
    """Return the socket family of a numeric address."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def tune(sock: socket.socket) -> None:
    """Turn off Nagle's algorithm, so that a Tick is sent at once."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def handshake(
    sock: socket.socket, connection: Connection, hello: Hello | None, deadline: float
) -> list[Message]:
    """Blocking: send HELLO if this side begins, and answer the handshake until a message for the
    owner arrives."""
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
_SILENT: Final = 1.0
"""Time in which an address must answer before the host's next one is tried (s)."""
_RETRY: Final = 0.02
"""Pause between attempts to reach a member that does not listen yet (s)."""
_LINGER: Final = 1.0
"""How long a member waits at the end for the others to read its Bye (s)."""


class Member:
    """One process of a lock-step cell. `addresses` (host, port) name all members, including this
    one (`name`).

    `hosts` names the member of each party; without it each member is one party of its own name.
    `directory` (hash of services.toml) must be the same in all members. `patience` is how long a
    Tick may be missing, `joining` how long the members may take to connect (s of wall time; imports
    take long on a busy host). Members in `returning` may be away for `absence` (s of wall time); a
    new process that replaces a lost one sets `rejoins`.
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
        patience: float = 30.0,
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

    # Connecting.

    def open(self) -> None:
        """Listen, connect to the members sorted before this one, and wait for those sorted after
        it.

        Raises PartyLostError for a member that does not connect within `joining`, CellError for one
        that does not fit.
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
        """Join an active cell: receive the last Tick number of every peer, send the missing Ticks
        empty, and continue behind the newest."""
        while missing := [link for link in self._links.values() if link.newest is None]:
            self._wait(missing, deadline)
        last = {link.peer: link.newest for link in self._links.values() if link.newest is not None}
        self.tick = max(last.values()) + 1
        for peer, link in self._links.items():
            for number in range(last[peer], self.tick):
                link.send(Tick(number))

    def _readmit(self, peer: str) -> None:
        """A member that may return is lost: wait for it, and send it the number of the last Tick
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
                link = None  # it was lost again during its handshake
                if time.monotonic() + _RETRY >= deadline:
                    raise
                time.sleep(_RETRY)
        self._links[peer] = link

    def _reach(self, peer: str, deadline: float, before: TickLink | None = None) -> TickLink:
        host, port = self._addresses[peer]
        while True:
            try:
                sock = socket.create_connection(
                    (host, port), timeout=min(_SILENT, max(deadline - time.monotonic(), _RETRY))
                )
                break
            except OSError as fault:
                if time.monotonic() + _RETRY >= deadline:
                    raise PartyLostError(
                        peer, f"no process answers at {host}:{port}: {fault}"
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
            raise PartyLostError(peer, f"cannot connect to {host}:{port}: {fault}") from None
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
        """Return the connection of the next member that connects; None if it was not a member."""
        listener.settimeout(max(deadline - time.monotonic(), 0.001))
        try:
            sock, _ = listener.accept()
        except TimeoutError:
            raise PartyLostError(
                min(after), f"it did not join the cell within {self._joining:g} s"
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

    # Running.

    def run(self, until: Callable[[], bool] | None = None, max_ticks: int | None = None) -> str:
        """Run ticks until `until()` holds after one, `max_ticks` were run, or another member ends
        the cell.

        Return why it ended: "until", "max_ticks", or "NAME: text" of the member that ended it.
        Raises PartyLostError for a member that is gone or silent, and any exception of a party of
        this process; the other members are notified in each case.
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
                    raise  # a returning member is waited for when its own Tick is due

    def _gather(self, number: int) -> str | None:
        """Wait for every peer's Tick of this number and deliver it. Return why the cell has ended,
        None if it has not."""
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
        """Block until a socket has something to read, or room for bytes that still wait."""
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
                missing[0].peer, f"it did not finish tick {self.tick - 1} within {patience:g} s"
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
                    f"its envelope from {envelope.source} to {envelope.party} is late or "
                    "misdirected",
                )
            self._half.own(envelope.source, peer)
            self._half.deliver(tick.number, posted)

    # Leaving.

    def _leave(self, text: str) -> None:
        """Send Bye to all, and wait until they have read it: closing a socket at once could discard
        it."""
        for link in self._links.values():
            with contextlib.suppress(PartyLostError, ProtocolError):
                link.send(Bye(text))
        self._close()

    def _abandon(self, text: str) -> None:
        for link in self._links.values():
            with contextlib.suppress(PartyLostError, ProtocolError):
                link.send(Refuse("failed", text[:1000]))
        self._close()

    def _close(self) -> None:
        deadline = time.monotonic() + _LINGER
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


# --- a process of one party ---


def cell_key(directory: Directory) -> Keys | None:
    """Return the key that seals the ticks of a lock-step cell: the shared key, if there is one.

    Ticks are not sent through TLS (docs/decisions/lock-step-keys.md): with certificates all
    members must be on loopback. Raises KeyNeededError if they are not, KeyFileError for a key file
    that cannot be used.
    """
    if "file" in directory.keys:
        return shared_keys(directory)
    if "certificates" in directory.keys:
        for name, (host, _) in directory.members().items():
            if not is_loopback(host):
                raise KeyNeededError(
                    f"{directory.source}: lock step does not use TLS, and {name} is at {host}: "
                    "for lock step over several hosts "
                    'write file = "cell.key" in place of certificates under [keys] '
                    "(`petrobot keys` makes it), or use one host"
                )
    return None


class Closable(Party, Protocol):
    """A party that holds resources."""

    def close(self) -> None:
        """Release them."""


def run_member(directory: Directory, name: str, party: Closable, awaited: float) -> None:
    """Run the member `name` of a lock-step cell with one process per node, until a member ends the
    cell or SIGTERM arrives.

    `awaited`: how long (s of wall time) to wait for a coordinator that died to come back; 0: not at
    all. Raises CellError when another member is lost, KeyFileError for a key file that cannot be
    used.
    """
    key = cell_key(directory)
    member = Member(
        name,
        [party],
        directory.members(),
        delays=Delays(directory.delays()),
        directory=directory.hash,
        key=key,
        returning={COORDINATOR} if awaited else (),
        absence=awaited,
    )
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    print(f"node {name} ready for lock step, process {os.getpid()}", flush=True)
    try:
        member.open()
        member.run()
    finally:
        party.close()
