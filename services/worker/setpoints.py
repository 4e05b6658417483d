"""The receiving end of a set-point stream: newest value wins, and a watchdog on its age."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from petrobot.services.comm.streams.stream import STALE_AFTER

SLACK = 1e-6  # s: three periods to the tick are not yet too old


class SetpointReceiver:
    """Implements `services.device.Setpoint` for the driver, and `Sink` for the receiver of the
    stream's messages."""

    def __init__(self, period: float, clock: Callable[[], float]) -> None:
        self._limit = STALE_AFTER * period + SLACK
        self._clock = clock
        self._values: tuple[float, ...] | None = None
        self._arrived = -math.inf
        self._published = -math.inf
        self._count = 0

    @property
    def values(self) -> tuple[float, ...] | None:
        """The newest set point; None before the first one, and if it is stale (older than three
        periods)."""
        return self._values if self.age <= self._limit else None

    @property
    def age(self) -> float:
        """Time since the newest one arrived (s; inf before the first)."""
        return self._clock() - self._arrived

    @property
    def held(self) -> float:
        """Time since the sender first sent these values, without their transport (s). A repetition
        does not make them younger."""
        return self._clock() - self._published

    @property
    def count(self) -> int:
        """Number of set points that arrived."""
        return self._count

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """Accept a set point whose values its sender first sent `held` seconds ago."""
        now = self._clock()
        self._values, self._arrived, self._published = tuple(values), now, now - held
        self._count += 1

    def withdraw(self) -> None:
        """Note that the sender withdrew it or has ended: it is stale at once."""
        self._values = None
