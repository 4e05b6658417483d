"""The hub of a CAN byte stream: the simulated bus itself, to which ports of this and other
processes connect."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from petrobot.services.comm.canopen.bus import CanBus, Frame
from petrobot.services.comm.canopen.byte_stream import (
    ERROR,
    EXTENDED,
    REMOTE,
    FrameSocket,
    encode,
    parse_channel,
)

PORTS: Final = 64
"""Most ports of other processes at a time: a bus has few, and `select` cannot wait for more than a
thousand."""
_UNSEEN: Final = EXTENDED | REMOTE | ERROR
"""Flags of frames that a `CanBus` does not carry."""


class CanHub:
    """The bus: relays frames between any number of ports on a channel, and provides ports within
    this process.

    It consists of non-blocking sockets; `poll` does what is due. So it runs in a thread
    (`poll(timeout)` waits by itself) or in its owner's loop.
    """

    def __init__(self, channel: str = "tcp://127.0.0.1:0", allow_remote: bool = False) -> None:
        family, address = parse_channel(channel, allow_remote)
        if family == socket.AF_UNIX:
            _remove_dead_socket(address)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        if family != socket.AF_UNIX:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.bind(address)
        self._listener.listen()
        self._listener.setblocking(False)
        self._family = family
        self._lines: dict[int, FrameSocket] = {}
        self._locals: list[LocalPort] = []
        self.dropped: list[str] = []

    @property
    def channel(self) -> str:
        """Return the address to connect to, with the port that the system chose if it was 0."""
        name = self._listener.getsockname()
        if self._family == socket.AF_UNIX:
            return f"unix://{name}"
        host = f"[{name[0]}]" if ":" in name[0] else name[0]
        return f"tcp://{host}:{name[1]}"

    @property
    def ports(self) -> int:
        """Return how many ports of other processes are connected."""
        return len(self._lines)

    def port(self) -> LocalPort:
        """Return a new port for the owner of this hub."""
        port = LocalPort(self)
        self._locals.append(port)
        return port

    def poll(self, timeout: float = 0.0) -> None:
        """Accept, read, relay and write what is due; wait up to `timeout` seconds for something to
        do."""
        readable = [self._listener.fileno(), *self._lines]
        writable = [number for number, line in self._lines.items() if line.pending]
        ready, flushable, _ = select.select(readable, writable, [], timeout)
        for number in flushable:
            self._attempt(number, FrameSocket.flush)
        for number in ready:
            if number == self._listener.fileno():
                self._accept()
            else:
                self._attempt(number, self._relay)

    def close(self) -> None:
        """Disconnect all ports."""
        name = self._listener.getsockname()
        self._listener.close()
        for line in self._lines.values():
            line.close()
        self._lines.clear()
        if self._family == socket.AF_UNIX:
            Path(name).unlink(missing_ok=True)

    def send_from(self, port: LocalPort, frame: Frame) -> None:
        """Pass the frame of a local port on to all others."""
        self._spread(
            encode(frame.id, frame.data), (frame.id, len(frame.data), frame.data), None, port
        )

    def leave(self, port: LocalPort) -> None:
        """Remove a local port."""
        if port in self._locals:
            self._locals.remove(port)

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            sock, _ = self._listener.accept()
            if len(self._lines) >= PORTS:
                self.dropped.append(f"more than {PORTS} ports")
                del self.dropped[:-20]
                sock.close()
                return
            try:
                self._lines[sock.fileno()] = FrameSocket(sock)
            except ConnectionError:
                sock.close()

    def _relay(self, line: FrameSocket) -> None:
        source = line.sock.fileno()
        for word, dlc, data in line.read():
            self._spread(encode(word, data, dlc), (word, dlc, data), source, None)

    def _spread(
        self, raw: bytes, frame: tuple[int, int, bytes], source: int | None, port: LocalPort | None
    ) -> None:
        for number in [number for number in self._lines if number != source]:
            self._attempt(number, lambda line: line.write(raw))
        word, _, data = frame
        if not word & _UNSEEN:
            for other in self._locals:
                if other is not port:
                    other.waiting.append(Frame(word, data))

    def _attempt(self, number: int, what: Callable[[FrameSocket], None]) -> None:
        """Do something with a connection; drop it if that fails."""
        line = self._lines.get(number)
        if line is None:
            return
        try:
            what(line)
        except ConnectionError as reason:
            line.close()
            del self._lines[number]
            self.dropped.append(str(reason))
            del self.dropped[:-20]


def _remove_dead_socket(path: str) -> None:
    """Remove a Unix socket without a listener; raises OSError if a process listens on it."""
    if not Path(path).is_socket():
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except OSError:
            Path(path).unlink(missing_ok=True)
            return
    raise OSError(errno.EADDRINUSE, f"another CAN hub already listens on {path}")


class LocalPort(CanBus):
    """A port of a hub in the same process (`CanBus`)."""

    def __init__(self, hub: CanHub) -> None:
        self._hub: CanHub | None = hub
        self.waiting: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus."""
        if self._hub is None:
            raise ConnectionError("this port has left the bus")
        self._hub.send_from(self, frame)

    def receive(self) -> Sequence[Frame]:
        """Return the frames that the hub has polled."""
        frames = tuple(self.waiting)
        self.waiting.clear()
        return frames

    def close(self) -> None:
        """Leave the bus."""
        if self._hub is not None:
            self._hub.leave(self)
            self._hub = None
