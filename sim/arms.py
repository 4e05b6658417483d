"""A laboratory with nothing but arms, for their drivers: the servos of a SO-101 at each serial
line, a UR controller at each TCP host. Cells with parts, cameras and contact are in folders of
their own."""

from __future__ import annotations

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.bus.feetech import FeetechBus, so101
from petrobot.sim.bus.ur_controller import PORTS, ControllerSession, UrController
from petrobot.sim.laboratory_party import LaboratoryParty

HELD = 2048.0 + 200.0
"""Where the jaw of each SO-101's gripper meets what it holds (steps): a part of 0.3 rad."""


class Arms(LaboratoryParty):
    """The arms by device."""

    services = ()
    tcp_ports = PORTS

    def __init__(self, directory: Directory, name: str) -> None:
        super().__init__(name, directory.party, f"{name} arms", directory.hash)
        self._servos: dict[str, FeetechBus] = {}
        self._controllers: dict[str, UrController] = {}

    def tick(self, now: float) -> None:
        for bus in self._servos.values():
            bus.advance(TICK)
        for controller in self._controllers.values():
            controller.advance(now + TICK)
        self.now = now + TICK

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        if device not in self._servos:
            self._servos[device] = so101([0.0] * 5 + [1.0])
            self._servos[device].servos[6].low = HELD
        return self._servos[device].receive(data)

    def connect(self, device: str, port: int) -> ControllerSession:
        return self._controllers.setdefault(device, UrController()).connect(port)


def make_laboratory(directory: Directory, name: str) -> Arms:
    """Make the laboratory of a simulated node."""
    return Arms(directory, name)
