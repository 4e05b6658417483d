"""The pipe between a node and one of its own processes: messages of the node protocol over a local
socket pair. Nothing blocks.

A message is the same msgpack array as on the wire, `[kind, field, ...]`. What only concerns the
process itself (that it is ready, that its node lives) is an array that begins with a word.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import weakref
from pathlib import Path
from typing import Any

import msgpack

from petrobot.services.comm.protocol.codec import ProtocolError, encode, read_fields
from petrobot.services.comm.protocol.messages import Answer, Message

_log = logging.getLogger(__name__)

Item = Message | list[Any]
"""A message, or a list of plain data whose first item is a word."""
MALFORMED = "malformed"
LARGEST = 64 << 20
"""Most bytes of one item, and of what waits to be read."""
CHUNK = 1 << 16
"""Bytes read at once."""
_BUFFER = memoryview(bytearray(CHUNK))
"""What all pipes of this process read into: what came is copied out before another one is read. A
fresh buffer for each read would cost more than the read."""
_ENDS: weakref.WeakSet[socket.socket] = weakref.WeakSet()
"""Sockets of this process that none that it forks may hold: the other side would take it for this
one."""


class _Copy:
    """Whether this process is one that a worker has forked."""

    made = False


def keep_from_copies(*ends: socket.socket) -> None:
    """From now on these sockets, and all pipes and links of this process, are closed in every
    process that it forks or executes.

    A copy that comes back from the action that forked it, and uses the pipe to the node, ends
    there: two processes must not both serve one run, nor both stop one device.
    """
    _ENDS.update(ends)
    for end in _ENDS:
        os.set_inheritable(end.fileno(), False)
    os.register_at_fork(after_in_child=_become_copy)


def _become_copy() -> None:
    _Copy.made = True
    for end in list(_ENDS):
        end.close()


class _End:
    """One end of a socket pair."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        _ENDS.add(end)
        self.socket = end
        self.closed = False
        """Whether it is of no more use."""
        self.lost = False
        """Whether that is so because user code has closed this end, or put another file into its
        place."""

    def fileno(self) -> int:
        """For selectors."""
        return self.socket.fileno()

    def _fail(self, fault: OSError) -> None:
        self.closed = True
        self.lost |= fault.errno not in (errno.EPIPE, errno.ECONNRESET)


class Pipe(_End):
    """One end. `post` sends as much as fits; `read` returns whole items. `closed` is set when the
    other end is gone; what that one sent before can still be read until `ended`."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__(end)
        self.ended = False
        """Whether it is closed and everything that came has been read."""
        self._unsent = bytearray()
        self._packer = msgpack.Packer()
        self._unpacker = msgpack.Unpacker(max_buffer_size=LARGEST)

    @property
    def unsent(self) -> bool:
        """Whether something waits until the other end reads."""
        return bool(self._unsent)

    def report(self, report: Message) -> None:
        """Post what a worker or driver tells its node. An answer that cannot be sent is replaced by
        the reason: the state that a driver returns must not end its process. Raises ProtocolError
        for any other message."""
        try:
            self.post(report)
        except ProtocolError as fault:
            if not isinstance(report, Answer):
                raise
            _log.warning("the answer to a command cannot be sent: %s", fault)
            word = report.data.get("answer")
            self.post(Answer(report.id, True, {"answer": word, "text": fault.text}))

    def post(self, item: Item) -> bool:
        """Send an item. Return False if a part of it did not fit and waits for `flush`. Raises
        ProtocolError for a message that cannot be sent."""
        if _Copy.made:
            os._exit(0)
        if self.closed:
            return True
        data = self._packer.pack(item) if type(item) is list else encode(item)  # type: ignore[arg-type]
        if not self._unsent:
            try:
                sent = self.socket.send(data)
                if sent == len(data):
                    return True
                data = data[sent:]
            except OSError:
                pass  # met again, and dealt with, by `flush`
        self._unsent += data
        self.flush()
        return not self._unsent

    def flush(self) -> None:
        """Send what waits, as much as fits."""
        with contextlib.suppress(BlockingIOError):
            while self._unsent and not self.closed:
                try:
                    del self._unsent[: self.socket.send(self._unsent)]
                except BlockingIOError:
                    raise
                except OSError as fault:
                    self._fail(fault)
                    self._unsent.clear()

    def read(self, most: int | None = None) -> list[Item]:
        """Return all items that arrived, or those in the next `most` bytes (up to `CHUNK`). Raises
        ValueError for data that is not msgpack: user code has written into the pipe."""
        if _Copy.made:
            os._exit(0)
        items: list[Item] = []
        while not self.ended:
            try:
                count = self.socket.recv_into(_BUFFER, most or CHUNK)
            except BlockingIOError:
                break
            except OSError as fault:
                self._fail(fault)
                count = 0
            if not count:
                self.closed = self.ended = True
                break
            try:
                self._unpacker.feed(_BUFFER[:count])
            except msgpack.BufferFull as fault:
                raise ValueError(f"an item of more than {LARGEST} bytes") from fault
            # Taken out before more is read: several large items that came together are more than
            # its buffer holds.
            for unpacked in self._unpacker:
                if (item := _item(unpacked)) is not None:
                    items.append(item)
            if most or (count < CHUNK and not self.closed):
                break  # what is left, and the end of the pipe, wake its reader again
        return items

    def close(self) -> None:
        """Close this end."""
        self.closed = self.ended = True
        self.socket.close()


def _item(unpacked: Any) -> Item | None:
    """Return a message, or a list that begins with a word. Anything but a list is dropped; any
    other list becomes the word MALFORMED, so that the items before it still count."""
    if not isinstance(unpacked, list) or not unpacked:
        return None
    if isinstance(unpacked[0], str):
        return unpacked
    try:
        return read_fields(unpacked)
    except ProtocolError as fault:
        return [MALFORMED, str(fault)]


class Permits:
    """Permits to begin a call, shared by a node and one of its workers.

    The node gives one permit with each call, and the worker takes one before it begins a call. The
    node may take back the permits that are left: those of the calls that were given last. The
    kernel counts the permits (an eventfd), so each is taken exactly once, by the worker or by the
    node, and they can still be read after the worker's end.
    """

    def __init__(self, descriptor: int) -> None:
        """Take over a descriptor of `permit_counter`."""
        self._descriptor = descriptor

    def give(self) -> None:
        """Permit one more call. Do so before the call is sent."""
        os.eventfd_write(self._descriptor, 1)

    def take(self) -> bool:
        """Take one permit; False if none is left."""
        try:
            os.eventfd_read(self._descriptor)
        except BlockingIOError:
            return False
        return True

    def left(self) -> int:
        """Return how many permits are left, without taking any (proc_pid_fdinfo(5))."""
        shown = Path(f"/proc/self/fdinfo/{self._descriptor}").read_text()
        return int(shown.partition("eventfd-count:")[2].split()[0], 16)

    def close(self) -> None:
        """Close the counter."""
        os.close(self._descriptor)


def permit_counter() -> int:
    """Return a descriptor of a counter for `Permits`. Raises OSError."""
    return os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK | os.EFD_SEMAPHORE)


class NewestLink(_End):
    """One end of the link between actions and their driver: commands one way, states the other, as
    datagrams of a SOCK_SEQPACKET pair. Only the newest state counts."""

    def send(self, items: list[Any]) -> bool:
        """Send one datagram. Return False if the other end does not read or is closed. Raises
        ValueError for more than fits into one."""
        data = msgpack.packb(items)
        try:
            self.socket.send(data)
        except BlockingIOError:
            return False
        except OSError as fault:
            if fault.errno == errno.EMSGSIZE:
                raise ValueError(
                    f"{len(data)} bytes do not fit into one datagram; send less"
                ) from fault
            self._fail(fault)
            return False
        return True

    def read(self) -> list[list[Any]]:
        """Return all datagrams that arrived."""
        return [msgpack.unpackb(data) for data in self._datagrams()]

    def newest(self) -> list[Any] | None:
        """Return the last datagram that arrived, None if there is none."""
        datagrams = self._datagrams()
        return msgpack.unpackb(datagrams[-1]) if datagrams else None

    def _datagrams(self) -> list[bytes]:
        datagrams = []
        while not self.closed:
            try:
                data = self.socket.recv(CHUNK)
            except BlockingIOError:
                break
            except OSError as fault:
                self._fail(fault)
                data = b""
            if not data:
                self.closed = True
                break
            datagrams.append(data)
        return datagrams

    def close(self) -> None:
        """Let it go."""
        self.closed = True
        self.socket.close()


def pipe_pair() -> tuple[Pipe, socket.socket]:
    """Return a pipe for this process, and the socket of its other end for a child."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    return Pipe(here), there


def link_pair() -> tuple[socket.socket, socket.socket]:
    """Return the sockets of a `NewestLink` between two children."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
