"""A serial line as drivers see it: bytes out, bytes in, never wait."""

from __future__ import annotations

import os
import select
from typing import Protocol

BACKLOG = 65536
"""Most bytes that wait to be sent: a line that accepts none for so long is broken."""


class SerialLine(Protocol):
    """One end of a serial line."""

    def send(self, data: bytes) -> None:
        """Send bytes. Raises ConnectionError when the line is gone."""

    def receive(self) -> bytes:
        """Return the bytes that arrived since the last call. Raises ConnectionError when the line
        is gone."""

    def close(self) -> None:
        """Release the line."""


class SerialPort(SerialLine):
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
            raise ConnectionError(f"serial port {path} at {baud} baud: {fault}") from fault
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
