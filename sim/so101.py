"""A laboratory with nothing but the servos of SO-101 arms, for their drivers: one arm for each
serial line. Cells with parts, cameras and contact are in folders of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.bus.feetech import FeetechBus, so101
from petrobot.sim.laboratory_party import LaboratoryParty

HELD = 2048.0 + 200.0
"""Where the jaw of each gripper meets what it holds (steps): a part of 0.3 rad."""


class Servos(LaboratoryParty):
    """The arms by device; each gripper finds a part between its fingers."""

    services = ()

    def __init__(self, directory: Directory, name: str) -> None:
        super().__init__(name, directory.party, f"{name} so101", directory.hash)
        self._arms: dict[str, FeetechBus] = {}

    def tick(self, now: float) -> None:
        """Let the servos move."""
        for bus in self._arms.values():
            bus.advance(TICK)
        self.now = now + TICK

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        """Answer as the servos of this device."""
        if device not in self._arms:
            self._arms[device] = so101([0.0] * 5 + [1.0])
            self._arms[device].servos[6].low = HELD
        return self._arms[device].receive(data)

    def take_on_bus(self, now: float, frames: Sequence[Frame]) -> None:
        """It has no CAN bus."""

    def take_frames(self) -> Sequence[Frame]:
        """It has no CAN bus."""
        return ()

    def serve(self, service: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """It has no services."""
        raise ValueError(f"no service {service!r}")

    def make_ready(self, arguments: Mapping[str, Any]) -> None:
        """Nothing takes long."""

    def close(self) -> None:
        """Nothing is held."""


def make_laboratory(directory: Directory, name: str) -> Servos:
    """Make the laboratory of a simulated node."""
    return Servos(directory, name)
