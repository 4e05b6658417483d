"""The connection of two members of a lock-step cell: Ticks out, Ticks in, in order."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Sequence
from typing import Final

from petrobot.services.comm.cell import CellError
from petrobot.services.comm.messages import Bye, Hello, Message, Refuse, Tick
from petrobot.services.comm.wire import Connection, ProtocolError

_CHUNK: Final = 1 << 18


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
