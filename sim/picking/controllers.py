"""The arm's controllers as the laboratory sees them: bytes of the driver in, joint angles, gap and
force of the fingers out."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

from petrobot.services.host.json_text import json_text
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


class LineController:
    """A controller that plans its own motion, with a parallel gripper, and speaks lines of JSON
    (`petrobot.services.picking.line_arm`)."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        motion, gripper = numbers["motion"], numbers["gripper"]
        self._fastest, self._rate = float(motion["speed"]), float(motion["acceleration"])
        self._finger_speed, self._force = float(gripper["speed"]), float(gripper["force"])
        self._q = [float(q) for q in numbers["poses"]["rest"]]
        self._begin, self._goal = self._q, self._q
        self._way, self._pace = 0.0, 0.0
        self._gap = self._wish = float(gripper["opening"])
        self._stop: float | None = None
        self._rest = b""

    def receive(self, now: float, data: bytes) -> bytes:
        """Take lines; return one answer for each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        out = b""
        for line in lines:
            with contextlib.suppress(ValueError):
                told = json.loads(line)
                if isinstance(told, dict):
                    self._obey(told)
                    out += json_text(self._report()).encode() + b"\n"
        return out

    def _obey(self, told: Mapping[str, Any]) -> None:
        if "stop" in told:  # brakes on the line on which it moves
            self._goal = self._at(min(self._length(), self._way + self._braking()))
        if "q" in told and len(told["q"]) == len(self._q):
            self._begin, self._goal = list(self._q), [float(q) for q in told["q"]]
            self._way = self._pace = 0.0
        if "grip" in told:
            self._wish = max(0.0, float(told["grip"]))

    def _report(self) -> dict[str, Any]:
        stopped = self._stop is not None and self._gap <= self._stop + 1e-9
        return {
            "q": self._q,
            "moving": self._q != self._goal,
            "grip": round(self._gap, 4),  # its scale has steps of 0.1 mm
            "held": stopped and self._wish < self._gap,
            "closing": self._gap != self._wish and not stopped,
        }

    def _length(self) -> float:
        return max(abs(b - a) for a, b in zip(self._begin, self._goal, strict=True))

    def _braking(self) -> float:
        return self._pace**2 / (2.0 * self._rate)

    def _at(self, way: float) -> list[float]:
        """Return the joints `way` rad (of the joint that moves most) along the line."""
        share = way / self._length() if self._length() > 0.0 else 1.0
        return [a + share * (b - a) for a, b in zip(self._begin, self._goal, strict=True)]

    def advance(self, now: float, dt: float) -> None:
        """Move joints by a trapezoid of speed, and fingers at their speed."""
        if self._q != self._goal:
            left = self._length() - self._way
            slows = math.sqrt(2.0 * self._rate * max(0.0, left))
            self._pace = min(self._fastest, self._pace + self._rate * dt, slows)
            self._way += self._pace * dt
            done = left <= self._pace * dt + 1e-5
            self._q = list(self._goal) if done else self._at(self._way)
        step = self._finger_speed * dt
        self._gap += max(-step, min(step, self._wish - self._gap))
        if self._stop is not None:
            self._gap = max(self._gap, self._stop)

    def joints(self) -> Sequence[float]:
        """Return the joint angles (rad)."""
        return self._q

    def gap(self) -> float:
        """Return how far the fingers are apart (m)."""
        return self._gap

    def force(self) -> float:
        """Return the force of the fingers (N) while something stops them."""
        return self._force if self._stop is not None and self._wish < self._gap else 0.0

    def block(self, gap: float | None) -> None:
        """Put a stop where a part is."""
        self._stop = gap

    def close(self) -> None:
        """Do nothing: all is in memory."""


CONTROLLERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Controller]]] = {
    "feetech": FeetechArm,
    "lines": LineController,
}


def controller(numbers: Mapping[str, Any]) -> Controller:
    """Return the controller of an arm's file. Raises LaboratoryError, KeyError."""
    name = str(numbers["controller"])
    if name not in CONTROLLERS:
        raise LaboratoryError(
            f"{numbers['name']}: controller: expected {' or '.join(CONTROLLERS)}, found {name!r}"
        )
    return CONTROLLERS[name](numbers)
