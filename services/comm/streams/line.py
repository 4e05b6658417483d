"""Lines of bytes as drivers see them, serial or TCP: bytes out, bytes in, never wait. A `Link`
keeps one open."""

from __future__ import annotations

import ipaddress
import math
import os
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

BACKLOG: Final = 65536
"""Most bytes that wait to be sent: a line with more of them is broken. Also most bytes
that one `receive` of a TCP connection returns."""
CONNECTING: Final = 2.0
"""Seconds that a TCP connection may take to be made, and its peer to acknowledge bytes."""
PAUSES: Final = (0.2, 3.2)
"""Shortest and longest time between two attempts to open a line (s): doubled each time."""
UNIX: Final = "unix:"
"""How the host of a simulated robot begins: a path, at which the ports are Unix sockets."""


class ByteLine(Protocol):
    """One end of a line."""

    def send(self, data: bytes) -> None:
        """Send bytes. Raises ConnectionError when the line is gone."""

    def receive(self) -> bytes:
        """Return the bytes that arrived since the last call. Raises ConnectionError when the line
        is gone."""

    def close(self) -> None:
        """Release the line."""


class SerialPort(ByteLine):
    """A serial port of this host, for no other program at the same time."""

    def __init__(self, path: str, baud: int) -> None:
        """Open it: 8 data bits, no parity, 1 stop bit. Raises ConnectionError if it cannot be
        opened, ImportError without pyserial."""
        try:
            import serial
        except ImportError as fault:
            raise ImportError(
                'a serial port needs pyserial: pip install "petrobot[so101]"'
            ) from fault
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as fault:
            why = _obstacle(Path(path)) or fault
            raise ConnectionError(f"serial port {path} at {baud} baud: {why}") from fault
        self._waiting = b""

    def send(self, data: bytes) -> None:
        """Send, and keep what the kernel does not accept yet."""
        # pyserial's own `write` spins while the kernel accepts nothing.
        self._waiting += data
        try:
            self._waiting = self._waiting[os.write(self._port.fileno(), self._waiting) :]
        except BlockingIOError:
            pass
        except (OSError, ValueError) as fault:
            raise ConnectionError(f"the serial port is gone: {fault}") from fault
        if len(self._waiting) > BACKLOG:
            raise ConnectionError("the serial port accepts no bytes")

    def receive(self) -> bytes:
        """Return the bytes that arrived since the last call."""
        if self._waiting:
            self.send(b"")
        try:
            number = self._port.fileno()
            if not select.select([number], [], [], 0.0)[0]:
                return b""
            data = os.read(number, 65536)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as fault:
            raise ConnectionError(f"the serial port is gone: {fault}") from fault
        if not data:  # readable without a byte: hung up
            raise ConnectionError("the serial port is gone: its device was unplugged")
        return data

    def close(self) -> None:
        """Release the port."""
        self._port.close()


ADAPTERS: Final = ("serial/by-id/*", "tty[AU][CS][BM]*")
"""Files of serial adapters in /dev: names that stay the same, and numbered ones."""


def _obstacle(path: Path) -> str:
    """Return why a serial port of this host may not be opened, and what helps; empty if it may."""
    if not path.exists():
        found = next(filter(None, (sorted(Path("/dev").glob(kind)) for kind in ADAPTERS)), [])
        others = ", ".join(map(str, found)) or "no serial adapter"
        return f"there is no such file: is it plugged in? This host has {others}"
    if not os.access(path, os.R_OK | os.W_OK):
        try:
            group = path.group()
        except KeyError:  # a group without a name
            group = str(path.stat().st_gid)
        return f"this user may not open it; `sudo usermod -aG {group} USER`, and log in again"
    return ""


class TcpConnection(ByteLine):
    """A TCP connection, which is made while bytes already wait to be sent. `receive` says that it
    cannot be made."""

    def __init__(self, host: str, port: int) -> None:
        """Begin to connect to an IP address, or to the Unix socket "unix:PATH" with the port behind
        its path. Raises ValueError for anything else: looking up a name would wait."""
        self.where = f"{host}:{port}"
        self._waiting, self._up, self._due = b"", False, time.monotonic() + CONNECTING
        address: tuple[str, int] | str = host, port
        if host.startswith(UNIX):
            family, address = socket.AF_UNIX, unix_socket(host.removeprefix(UNIX), port)
        else:
            try:
                version = ipaddress.ip_address(host).version
            except ValueError as fault:
                raise ValueError(f"host: expected an IP address, found {host!r}") from fault
            family = socket.AF_INET if version == 4 else socket.AF_INET6
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        if family is not socket.AF_UNIX:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # Else the system delivers old commands, also of a process that was killed, minutes
            # later, if a cable was out meanwhile: after those of the next connection.
            limit = round(1000 * CONNECTING)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit)
        self._refused = ""
        try:
            self._socket.connect(address)
        except BlockingIOError:
            pass
        except OSError as fault:
            self._refused = fault.strerror or str(fault)

    def send(self, data: bytes) -> None:
        """Send, and keep what cannot go out yet."""
        self._waiting += data
        if self._connected() and self._waiting:
            try:
                self._waiting = self._waiting[self._socket.send(self._waiting) :]
            except BlockingIOError:
                pass
            except OSError as fault:
                raise ConnectionError(f"{self.where}: {fault.strerror or fault}") from fault
        if len(self._waiting) > BACKLOG:
            raise ConnectionError(f"{self.where} does not read")

    def receive(self) -> bytes:
        """Return the bytes that arrived since the last call."""
        if not self._connected():
            return b""
        received = b""
        try:
            if self._waiting:
                self.send(b"")
            while len(received) < BACKLOG and (data := self._socket.recv(BACKLOG)):
                received += data
        except BlockingIOError:
            return received
        except OSError as fault:
            raise ConnectionError(f"{self.where}: {fault.strerror or fault}") from fault
        if not received:
            raise ConnectionError(f"{self.where} has closed the connection")
        return received

    def _connected(self) -> bool:
        if self._up:
            return True
        code = 0 if self._refused else self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if self._refused or code:
            raise ConnectionError(f"{self.where}: {self._refused or os.strerror(code)}")
        try:
            self._socket.getpeername()
        except OSError:
            if time.monotonic() > self._due:
                raise ConnectionError(f"{self.where}: nothing answers there") from None
            return False
        self._up = True
        return True

    def close(self) -> None:
        """Close it."""
        self._socket.close()


def unix_socket(path: str, port: int) -> str:
    """Return the Unix socket that stands for a port of a simulated robot. Raises ValueError for a
    path that is too long for one."""
    if len(name := f"{path}.{port}") > 107:  # sun_path of unix(7)
        raise ValueError(f"host: expected a path of at most 100 characters, found {path!r}")
    return name


class Link:
    """Keeps a line open: when it was lost, it is opened again, with growing pauses."""

    def __init__(
        self, now: float, open_line: Callable[[], ByteLine], patience: float = math.inf
    ) -> None:
        """Open the line, as `lambda: ports.tcp(host, port)` does. Raises what that raises. A line
        over which nothing arrives for `patience` s is closed."""
        self._open, self._patience, self._heard = open_line, patience, now
        self._line: ByteLine | None = open_line()
        self._since, self._next, self._pause = now, 0.0, PAUSES[0]
        self.count = 1
        """How many lines were opened: another number is another line."""
        self.why = ""
        """Why there is no line."""

    def receive(self, now: float) -> bytes:
        """Return the bytes that have arrived. Without a line return nothing, and open another line
        when that is due."""
        try:
            if self._line is None:
                if now < self._next:
                    return b""
                self._line, self._since, self._heard = self._open(), now, now
                self.count += 1
            data = self._line.receive()
        except OSError as fault:
            self._lose(now, str(fault))
            return b""
        if data:
            self.why, self._heard = "", now
        elif now - self._heard > self._patience:
            self.drop(now, f"nothing came for {self._patience:g} s")
        return data

    def send(self, now: float, data: bytes) -> None:
        """Send over the present line; without one the bytes are lost."""
        try:
            if self._line is not None and data:
                self._line.send(data)
        except OSError as fault:
            self.drop(now, str(fault))

    def drop(self, now: float, why: str) -> None:
        """Give the line up, and open another one later: soon if this one served for long."""
        if self.up:  # else the next one is due already
            self._lose(now, why)

    def _lose(self, now: float, why: str) -> None:
        if self.up and now - self._since > PAUSES[1]:
            self._pause = PAUSES[0]
        self.close()
        self.why, self._next = why, now + self._pause
        self._pause = min(PAUSES[1], 2.0 * self._pause)

    @property
    def up(self) -> bool:
        """Whether there is a line; a TCP connection may still be on its way."""
        return self._line is not None

    def close(self) -> None:
        """Release the line."""
        if self._line is not None:
            self._line.close()
        self._line = None
