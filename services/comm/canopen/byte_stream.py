"""CAN over a byte stream: its framing, and the python-can interface `petrobot_stream` for it.

    bus = can.Bus(interface="petrobot_stream", channel="tcp://127.0.0.1:7303")      # or "unix:///run/cell/can"

Framing, both directions. First each end sends the six bytes `PBCAN\\x02`. Then every frame is
    u32  identifier, big-endian; bit 31 extended (29 bits), bit 30 remote, bit 29 error frame
    u8   DLC, 0 to 8
    DLC bytes of data (none in a remote frame)
    u32  CRC-32 of all that (IEEE 802.3, as zlib's), big-endian: a real bus has a CRC of its own
A hub (`CanHub`) passes each frame on to all ports except the one that sent it, in order of arrival.
A port that sends anything else, or does not read while more than 256 KiB wait for it, is dropped.
Classic CAN only.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import can
from can import typechecking

from petrobot.services.comm.canopen.bus import CanBus, Frame
from petrobot.services.comm.protocol.security import CHECK_BYTES, check

GREETING: Final = b"PBCAN\x02"
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
ID_MASK: Final = (1 << 29) - 1
BACKLOG: Final = 256 * 1024
_HEAD: Final = struct.Struct(">IB")


class StreamFormatError(ConnectionError):
    """The other end does not use this framing."""


def encode(word: int, data: bytes, dlc: int | None = None) -> bytes:
    """Encode one frame. `word` is the identifier with its flag bits; `dlc` differs from the data's
    length in remote frames."""
    frame = _HEAD.pack(word, len(data) if dlc is None else dlc) + data
    return frame + check(frame)


class Splitter:
    """Cuts a byte stream into frames: (word, DLC, data).

    Raises StreamFormatError on a wrong greeting, DLC, identifier or checksum.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._greeted = False

    def feed(self, data: bytes) -> list[tuple[int, int, bytes]]:
        """Add bytes; return the frames that they complete."""
        buffer = self._buffer
        buffer += data
        if not self._greeted and not self._greet():
            return []
        frames, at = [], 0
        while len(buffer) - at >= _HEAD.size:
            word, dlc = _HEAD.unpack_from(buffer, at)
            self._check(word, dlc)
            end = at + _HEAD.size + (0 if word & REMOTE else dlc)
            if len(buffer) < end + CHECK_BYTES:
                break
            if buffer[end : end + CHECK_BYTES] != check(bytes(buffer[at:end])):
                raise StreamFormatError("wrong CRC: a frame was changed on its way")
            frames.append((word, dlc, bytes(buffer[at + _HEAD.size : end])))
            at = end + CHECK_BYTES
        del buffer[:at]
        return frames

    def _greet(self) -> bool:
        start = bytes(self._buffer[: len(GREETING)])
        if start != GREETING[: len(start)]:
            raise StreamFormatError(
                f"expected the greeting {GREETING!r}, got {start!r}: is this a CAN hub?"
            )
        if len(start) < len(GREETING):
            return False
        del self._buffer[: len(GREETING)]
        self._greeted = True
        return True

    @staticmethod
    def _check(word: int, dlc: int) -> None:
        if dlc > 8:
            raise StreamFormatError(f"expected a DLC of at most 8 (classic CAN), got {dlc}")
        if not word & EXTENDED and word & ID_MASK > 0x7FF:
            raise StreamFormatError(f"identifier {word & ID_MASK:#x} does not fit 11 bits")


def parse_channel(channel: str, allow_remote: bool = False) -> tuple[socket.AddressFamily, Any]:
    """Return socket family and address of `tcp://host:port` or `unix:///path`.

    Raises ValueError for anything else, and for another host unless `allow_remote`: the stream is
    neither encrypted nor authenticated.
    """
    parts = urlsplit(channel)
    if parts.scheme == "unix" and parts.path and not parts.netloc:
        return socket.AF_UNIX, parts.path
    if parts.scheme != "tcp" or not parts.hostname or parts.port is None:
        raise ValueError(f"channel {channel!r}: expected tcp://127.0.0.1:7303 or unix:///path")
    if not allow_remote and not _is_loopback(parts.hostname):
        raise ValueError(
            f"channel {channel!r} leaves this host, and the stream is not protected: set "
            "allow_remote=True to allow it"
        )
    return (socket.AF_INET6 if ":" in parts.hostname else socket.AF_INET), (
        parts.hostname,
        parts.port,
    )


def _is_loopback(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


class FrameSocket:
    """A connected non-blocking socket that carries frames."""

    def __init__(self, sock: socket.socket) -> None:
        if sock.family != socket.AF_UNIX:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setblocking(False)
        self.sock = sock
        self._splitter = Splitter()
        self._lock = threading.Lock()  # python-can users receive in one thread and send in another
        self._waiting = bytearray(GREETING)
        self.flush()

    @property
    def pending(self) -> bool:
        """Return whether bytes wait to be sent."""
        return bool(self._waiting)

    def write(self, data: bytes) -> None:
        """Send, and keep what the kernel does not accept. Raises ConnectionError if the other end
        is gone or does not read."""
        with self._lock:
            self._waiting += data
            self._flush()
        if len(self._waiting) > BACKLOG:
            raise ConnectionError("the other end of the CAN stream does not read")

    def flush(self) -> None:
        """Send the waiting bytes, as far as the kernel accepts them."""
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._waiting:
            try:
                sent = self.sock.send(self._waiting)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as reason:
                raise ConnectionError(f"the CAN stream is gone: {reason}") from reason
            del self._waiting[:sent]

    def read(self) -> list[tuple[int, int, bytes]]:
        """Return the frames that have arrived. Raises ConnectionError when the other end is
        gone."""
        frames: list[tuple[int, int, bytes]] = []
        while True:
            try:
                data = self.sock.recv(65536)
            except (BlockingIOError, InterruptedError):
                return frames
            except OSError as reason:
                raise ConnectionError(f"the CAN stream is gone: {reason}") from reason
            if not data:
                if frames:
                    return frames  # these are still valid; the next read raises
                raise ConnectionError("the CAN stream was closed by its other end")
            frames += self._splitter.feed(data)
            if len(data) < 65536:
                return frames

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()


def connect(channel: str, timeout: float = 5.0, allow_remote: bool = False) -> FrameSocket:
    """Connect to the hub of a channel. Raises ConnectionError if there is none, ValueError for a
    bad channel."""
    family, address = parse_channel(channel, allow_remote)
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.settimeout(timeout)
        sock.connect(address)
        return FrameSocket(sock)
    except OSError as reason:
        sock.close()
        raise ConnectionError(
            f"no CAN hub at {channel}: {reason}. Is the bus (the simulated laboratory) up?"
        ) from reason


class StreamBus(can.BusABC):
    """python-can bus on a hub's channel; see the docstring of this module."""

    def __init__(
        self,
        channel: str,
        can_filters: typechecking.CanFilters | None = None,
        connect_timeout: float = 5.0,
        allow_remote: bool = False,
        receive_own_messages: bool = False,
        **kwargs: Any,
    ) -> None:
        """Connect. `bitrate` and other settings of a real bus are accepted and ignored.

        Raises CanInitializationError.
        """
        if kwargs.pop("fd", False):
            raise can.CanInitializationError("petrobot_stream carries classic CAN only, not CAN FD")
        try:
            self._line = connect(channel, connect_timeout, allow_remote)
        except (ConnectionError, ValueError) as reason:
            raise can.CanInitializationError(str(reason)) from reason
        self.channel_info = f"petrobot_stream {channel}"
        self._can_protocol = can.CanProtocol.CAN_20
        self._channel = channel
        self._own = receive_own_messages
        self._waiting: deque[can.Message] = deque()
        super().__init__(channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a classic frame; wait up to `timeout` seconds for room (None: do not wait). Raises
        CanOperationError."""
        if msg.is_fd:
            raise can.CanOperationError("petrobot_stream carries classic CAN only, not CAN FD")
        word = msg.arbitration_id | (EXTENDED if msg.is_extended_id else 0)
        word |= (REMOTE if msg.is_remote_frame else 0) | (ERROR if msg.is_error_frame else 0)
        try:
            self._line.write(encode(word, b"" if msg.is_remote_frame else bytes(msg.data), msg.dlc))
            if timeout and self._line.pending:
                self._drain(time.monotonic() + timeout)
        except ConnectionError as reason:
            raise can.CanOperationError(str(reason)) from reason
        if self._own:
            self._waiting.append(
                _message(word, msg.dlc, bytes(msg.data), self._channel, is_rx=False)
            )

    def fileno(self) -> int:
        """Return the file number of the socket, for select and python-can's asyncio notifier."""
        return self._line.sock.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._line.close()

    def _drain(self, until: float) -> None:
        while self._line.pending and (left := until - time.monotonic()) > 0.0:
            select.select([], [self._line.sock], [], left)
            self._line.flush()
        if self._line.pending:
            raise ConnectionError("the other end of the CAN stream did not read in time")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            try:
                self._fetch(timeout)
            except ConnectionError as reason:
                raise can.CanOperationError(str(reason)) from reason
        return (self._waiting.popleft() if self._waiting else None), False

    def _fetch(self, timeout: float | None) -> None:
        if self._line.pending:
            self._line.flush()
        frames = self._line.read()
        if not frames and timeout != 0.0:
            select.select([self._line.sock], [], [], timeout)
            frames = self._line.read()
        self._waiting += [_message(word, dlc, data, self._channel) for word, dlc, data in frames]


def _message(word: int, dlc: int, data: bytes, channel: str, is_rx: bool = True) -> can.Message:
    return can.Message(
        timestamp=time.time(),
        arbitration_id=word & ID_MASK,
        is_extended_id=bool(word & EXTENDED),
        is_remote_frame=bool(word & REMOTE),
        is_error_frame=bool(word & ERROR),
        dlc=dlc,
        data=data,
        channel=channel,
        is_rx=is_rx,
    )


# --- the hub ---

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
        with contextlib.suppress(OSError):  # also: this process has no file for another one
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
