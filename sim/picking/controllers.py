"""The arm's controllers as the laboratory sees them: bytes of the driver in, joint angles, gap and
force of the fingers out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

from petrobot.sim.bus.feetech import STEPS, so101
from petrobot.sim.catching.truth import LaboratoryError


class Controller(Protocol):
    """An arm with its gripper, seen from both sides."""

    def receive(self, now: float, data: bytes) -> bytes:
        """Take bytes of the driver; return the answer."""

    def advance(self, now: float, dt: float) -> None:
        """Let `dt` s pass."""

    def joints(self) -> Sequence[float]:
        """Return the joint angles (rad)."""

    def gap(self) -> float:
        """Return how far the fingers are apart, as far as the motor is concerned (m)."""

    def force(self) -> float:
        """Return with how much the fingers press on what stops them (N)."""

    def block(self, gap: float | None) -> None:
        """Let a part stop the fingers at a gap (m); None: nothing is there."""

    def close(self) -> None:
        """Release what it holds."""


class FeetechArm:
    """Bus servos: the last one turns the gripper's jaw, `gap_per_rad` m for each rad."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        gripper = numbers["gripper"]
        self._lever = float(gripper["gap_per_rad"])
        closed = float(gripper["opening"]) / self._lever
        self.bus = so101([*map(float, numbers["poses"]["rest"]), closed])
        *self._arm, self._jaw = self.bus.servos.values()

    def receive(self, now: float, data: bytes) -> bytes:
        """Take packets; return the servos' answers."""
        return self.bus.receive(data)

    def advance(self, now: float, dt: float) -> None:
        """Let the servos move for `dt` s."""
        self.bus.advance(dt)

    def joints(self) -> Sequence[float]:
        """Return the joint angles (rad)."""
        return [servo.angle for servo in self._arm]

    def gap(self) -> float:
        """Return how far the jaw is open (m)."""
        return self._jaw.angle * self._lever

    def force(self) -> float:
        """Return the jaw's force (N): the motor's torque over the lever arm."""
        return max(0.0, -self._jaw.torque) / self._lever

    def block(self, gap: float | None) -> None:
        """Put a stop where a part is; without one, the fingers meet at 0."""
        angle = max(0.0, gap or 0.0) / self._lever
        self._jaw.low = 2048.0 + angle / (2 * math.pi) * STEPS

    def close(self) -> None:
        """Do nothing: all is in memory."""


CONTROLLERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Controller]]] = {
    "feetech": FeetechArm
}


def controller(numbers: Mapping[str, Any]) -> Controller:
    """Return the controller of an arm's file. Raises LaboratoryError, KeyError."""
    name = str(numbers["controller"])
    if name not in CONTROLLERS:
        raise LaboratoryError(
            f"{numbers['name']}: controller: expected {' or '.join(CONTROLLERS)}, found {name!r}"
        )
    return CONTROLLERS[name](numbers)
