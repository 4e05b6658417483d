"""The arm's controllers as the laboratory sees them: bytes of the driver in, joint angles, gap and
force of the fingers out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

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


def controller(numbers: Mapping[str, Any]) -> Controller:
    """Return the controller of an arm's file. Raises LaboratoryError."""
    raise LaboratoryError(f"unknown controller {numbers.get('controller')!r}")
