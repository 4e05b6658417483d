"""A SO-101 with a simulated bus, stepped together with its driver on one clock."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from petrobot import ByteLine, Ports
from petrobot.services.adapters.so101.arm import Arm
from petrobot.sim.bus.feetech import FeetechBus, so101


class Line(ByteLine):
    """The serial line to a simulated bus, in this process."""

    def __init__(self, bus: FeetechBus) -> None:
        self.bus, self.arrived, self.cut = bus, b"", False

    def send(self, data: bytes) -> None:
        self.check()
        self.arrived += self.bus.receive(data)

    def receive(self) -> bytes:
        self.check()
        arrived, self.arrived = self.arrived, b""
        return arrived

    def close(self) -> None:
        self.cut = True

    def check(self) -> None:
        if self.cut:
            raise ConnectionError("the cable is pulled")


class Rig:
    """Ports of a simulated arm; `open` opens its line, `folder` has its files."""

    def __init__(self, bus: FeetechBus | None = None, folder: Path = Path()) -> None:
        self.now = 0.0
        self.bus = bus or so101()
        self.folder = folder
        self.plugged, self.opened = True, 0
        self.line: ByteLine | None = None
        self.open: Callable[[], ByteLine] = lambda: Line(self.bus)

    def serial(self, port: str, baud: int) -> ByteLine:
        self.opened += 1
        if not self.plugged:
            raise ConnectionError(f"no {port}")
        self.line = self.open()
        return self.line

    def cable(self, plugged: bool) -> None:
        """Pull the cable, or put it back."""
        self.plugged = plugged
        if not plugged and isinstance(self.line, Line):
            self.line.cut = True

    def file(self, path: str) -> bytes:
        return (self.folder / path).read_bytes()

    def write_file(self, path: str, content: bytes) -> None:
        (self.folder / path).write_bytes(content)

    def arm(self, **keys: Any) -> SimulatedArm:
        """Its driver."""
        return SimulatedArm({"port": "/dev/ttyACM0", **keys}, cast(Ports, self))


class SimulatedArm(Arm):
    """The driver, whose servos move between its steps."""

    def step(self, now: float) -> None:
        rig = cast(Rig, self.ports)
        rig.now = now
        for _ in range(2):
            rig.bus.advance(self.period / 2)
        super().step(now)

    def run(self, seconds: float) -> None:
        """Let so much time pass."""
        for _ in range(round(seconds / self.period)):
            self.step(self.ports.now + self.period)

    def ready(self) -> SimulatedArm:
        """Let it start."""
        self.run(0.3)
        assert self.state()["faults"] == {} and self.stopped()
        return self
