"""The UR arm's driver with the simulated cell's serial line instead of its three TCP connections,
so that it also runs in lock step. For a real arm, write `petrobot.services.adapters.ur.arm:Arm` in
the location file.

A frame on the line is a channel (u8: 0 RTDE, 1 dashboard, 2 program), a length (u16, big endian)
and so many bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final

from petrobot.services.adapters.ur.arm import Arm
from petrobot.services.comm.streams.serial_line import SerialLine
from petrobot.services.device import Ports, key

HEAD: Final = struct.Struct("!BH")


class _Line:
    """The line, and the bytes received on each of its channels."""

    def __init__(self, line: SerialLine) -> None:
        self._line, self._rest = line, b""
        self._came = [b"", b"", b""]

    def take(self, channel: int) -> bytes:
        """Return the bytes received on a channel since the last call."""
        self._rest += self._line.receive()
        while len(self._rest) >= HEAD.size:
            number, size = HEAD.unpack_from(self._rest)
            if len(self._rest) < HEAD.size + size:
                break
            self._came[number % 3] += self._rest[HEAD.size : HEAD.size + size]
            self._rest = self._rest[HEAD.size + size :]
        came, self._came[channel] = self._came[channel], b""
        return came

    def send(self, channel: int, data: bytes) -> None:
        """Send bytes on a channel."""
        self._line.send(HEAD.pack(channel, len(data)) + data)

    def close(self) -> None:
        """Release the line."""
        self._line.close()


class _Channel:
    """One connection, with the methods of `petrobot.services.adapters.ur.link.Link`."""

    def __init__(self, line: _Line, number: int) -> None:
        self._line, self._number = line, number
        self.up, self.connections, self.why = True, 1, ""

    def poll(self, now: float) -> bytes:
        """Return the bytes received."""
        try:
            return self._line.take(self._number)
        except ConnectionError as fault:
            self.drop(now, str(fault))
            return b""

    def send(self, now: float, data: bytes) -> None:
        """Send."""
        if self.up and data:
            self._line.send(self._number, data)

    def settled(self) -> None:
        """Do nothing."""

    def drop(self, now: float, why: str) -> None:
        """Close the connection."""
        self.up, self.why = False, why

    def close(self) -> None:
        """Release the line."""
        self._line.close()


class LineUr(Arm):
    """The driver; its key `host` is not used."""

    host: str = key("127.0.0.1")
    port: str = key(text="serial line of the simulated controller")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        line = _Line(ports.serial(self.port, 1_000_000))
        channels: list[Any] = [_Channel(line, number) for number in range(3)]
        self._link, self._dashboard, self._program = channels
