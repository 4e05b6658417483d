"""Ports on a CAN bus for drivers and simulated drives, over the project's stream or any python-can
interface."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from typing import Any

import can

from petrobot.services.comm.canopen.bus import CanBus, Frame
from petrobot.services.comm.canopen.byte_stream import ERROR, EXTENDED, REMOTE, connect, encode


class StreamPort(CanBus):
    """A driver's port on a channel, without the overhead of python-can's messages (`CanBus`)."""

    def __init__(self, channel: str, timeout: float = 5.0, allow_remote: bool = False) -> None:
        self._line = connect(channel, timeout, allow_remote)

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus."""
        self._line.write(encode(frame.id, frame.data))

    def receive(self) -> Sequence[Frame]:
        """Return the standard data frames that have arrived."""
        if self._line.pending:
            self._line.flush()
        return [
            Frame(word, data)
            for word, _, data in self._line.read()
            if not word & (EXTENDED | REMOTE | ERROR)
        ]

    def close(self) -> None:
        """Leave the bus."""
        self._line.close()


class PythonCanBus(CanBus):
    """Any python-can bus as a `CanBus`: standard data frames only."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus."""
        try:
            self._bus.send(
                can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
            )
        except (can.CanError, OSError) as reason:
            text = f"the CAN bus does not accept frames: {_said(reason)}"
            raise ConnectionError(text) from reason

    def receive(self) -> Sequence[Frame]:
        """Return the standard data frames that have arrived."""
        frames = []
        try:
            while (message := self._bus.recv(timeout=0.0)) is not None:
                if not (
                    message.is_extended_id or message.is_remote_frame or message.is_error_frame
                ):
                    frames.append(Frame(message.arbitration_id, bytes(message.data)))
        except (can.CanError, OSError) as reason:
            raise ConnectionError(f"the CAN bus is gone: {_said(reason)}") from reason
        return frames

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


_REMEDIES = {
    errno.ENODEV: "is its adapter plugged in? `ip link` shows the interfaces of this host",
    errno.ENETDOWN: "bring it up, as by `sudo ip link set can0 up type can bitrate 1000000`",
}
"""By error number: what helps with a bus of Linux (docs/deploy.md)."""


def _said(reason: Exception) -> str:
    number = getattr(reason, "errno", None) or getattr(reason, "error_code", None)
    return f"{reason}; {_REMEDIES[number]}" if number in _REMEDIES else str(reason)


def open_can(config: Mapping[str, Any]) -> CanBus:
    """Open the bus of a device: `interface` and `channel` as for python-can; other keys are passed
    on to it.

    `petrobot_stream` is opened directly; socketcan and all others through python-can. Raises
    ConnectionError or ValueError.
    """
    settings = dict(config)
    if not {"interface", "channel"} <= settings.keys():
        raise ValueError(
            'a CAN bus needs interface and channel, as interface = "socketcan", channel = "can0"'
        )
    if settings["interface"] == "petrobot_stream":
        del settings["interface"]
        return StreamPort(**settings)
    try:
        return PythonCanBus(can.Bus(**settings))
    except (can.CanError, OSError) as reason:
        raise ConnectionError(
            f"no CAN bus {settings['interface']} {settings['channel']}: {_said(reason)}"
        ) from reason
