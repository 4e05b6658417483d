"""Drivers of adapters in tests with foreign devices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from petrobot import Driver, rehearse


class PortsClock(Driver):
    """First base of a driver: the clock of its ports is that of its steps."""

    def step(self, now: float) -> None:
        cast(Any, self.ports).now = now
        super().step(now)


def rehearsed(story: Callable[..., Any], arm: Driver, world: Callable[[float], None]) -> None:
    """Play a story, which ends in success, with the arm and its world; then close the arm."""
    try:
        told = rehearse(story, device=arm, world=world).result
    finally:
        arm.close()
    assert told.status == "success", told
