"""A CAN bus as drivers and simulated drives see it: send frames, receive frames, never block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class Frame(NamedTuple):
    """A classic CAN data frame: 11-bit identifier and at most 8 bytes (ISO 11898-1)."""

    id: int
    data: bytes


class CanBus(Protocol):
    """One port on a bus. A port does not receive its own frames."""

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus. Raises ConnectionError when the bus is gone."""

    def receive(self) -> Sequence[Frame]:
        """Return all frames that arrived since the last call, oldest first. Raises ConnectionError
        when the bus is gone."""

    def close(self) -> None:
        """Leave the bus."""
