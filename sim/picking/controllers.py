"""The arms' controllers for the laboratory: they receive bytes of the driver, and give joint
angles, gap and force of the fingers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from petrobot.sim.bus.feetech import STEPS, so101
from petrobot.sim.bus.ur_controller import ControllerSession, UrController
from petrobot.sim.catching.truth import LaboratoryError


class Controller(ABC):
    """An arm with its gripper: its interface to the driver, and to the laboratory."""

    @abstractmethod
    def advance(self, now: float, dt: float) -> None:
        """Let `dt` s pass."""

    @abstractmethod
    def joints(self) -> Sequence[float]:
        """Return the joint angles (rad)."""

    @abstractmethod
    def gap(self) -> float:
        """Return the gap between the fingers by the motor's position (m)."""

    @abstractmethod
    def force(self) -> float:
        """Return the force of the fingers on what stops them (N)."""

    @abstractmethod
    def block(self, gap: float | None) -> None:
        """Let a part stop the fingers at a gap (m); None: no part."""

    def receive(self, now: float, data: bytes) -> bytes:
        """Take bytes of the driver's serial line; return the answer."""
        return b""

    def connect(self, port: int) -> ControllerSession:
        """Accept a connection of the driver. Raises LaboratoryError."""
        raise LaboratoryError("this arm has a serial line, and no TCP port")


class FeetechArm(Controller):
    """Bus servos: the last one turns the gripper's jaw, `gap_per_rad` m for each rad."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        gripper = numbers["gripper"]
        self._lever = float(gripper["gap_per_rad"])
        closed = float(gripper["opening"]) / self._lever
        self.bus = so101([*map(float, numbers["poses"]["rest"]), closed])
        *self._arm, self._jaw = self.bus.servos.values()

    def receive(self, now: float, data: bytes) -> bytes:
        return self.bus.receive(data)

    def advance(self, now: float, dt: float) -> None:
        self.bus.advance(dt)

    def joints(self) -> Sequence[float]:
        return [servo.angle for servo in self._arm]

    def gap(self) -> float:
        return self._jaw.angle * self._lever

    def force(self) -> float:
        """Return the jaw's force (N): the motor's torque over the lever arm."""
        return max(0.0, -self._jaw.torque) / self._lever

    def block(self, gap: float | None) -> None:
        """Stop the jaw at a part; without a part, the fingers meet at 0."""
        angle = max(0.0, gap or 0.0) / self._lever
        self._jaw.low = 2048.0 + angle / (2 * math.pi) * STEPS


class UrArm(Controller):
    """A UR controller, and a gripper on its digital outputs and inputs: output 0 closes it, input 0
    says that it holds something, input 1 that its fingers stand."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        gripper = numbers["gripper"]
        self._opening, self._speed = float(gripper["opening"]), float(gripper["speed"])
        self._force, self._gap = float(gripper["force"]), float(gripper["opening"])
        self.ur = UrController([float(q) for q in numbers["poses"]["rest"]])
        self._stop: float | None = None

    def connect(self, port: int) -> ControllerSession:
        return self.ur.connect(port)

    def advance(self, now: float, dt: float) -> None:
        self.ur.advance(now + dt)
        wish = 0.0 if self.ur.digital_out & 1 else self._opening
        step = self._speed * dt
        before = self._gap
        self._gap += max(-step, min(step, wish - self._gap))
        if self._stop is not None:
            self._gap = max(self._gap, self._stop)
        holds = self._stop is not None and wish < self._gap
        self.ur.digital_in = int(holds) | (self._gap == before) << 1

    def joints(self) -> Sequence[float]:
        return self.ur.q

    def gap(self) -> float:
        return self._gap

    def force(self) -> float:
        """Return the force of the fingers (N) while something stops them."""
        return self._force if self._stop is not None and self.ur.digital_out & 1 else 0.0

    def block(self, gap: float | None) -> None:
        self._stop = gap


CONTROLLERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Controller]]] = {
    "feetech": FeetechArm,
    "ur": UrArm,
}


def controller(numbers: Mapping[str, Any]) -> Controller:
    """Return the controller of an arm's file. Raises LaboratoryError, KeyError."""
    name = str(numbers["controller"])
    if name not in CONTROLLERS:
        raise LaboratoryError(
            f"{numbers['name']}: controller: expected {' or '.join(CONTROLLERS)}, found {name!r}"
        )
    return CONTROLLERS[name](numbers)
