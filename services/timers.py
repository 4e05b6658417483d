"""Timers of a node: external pulse events on an absolute grid."""

from __future__ import annotations

import math
from collections.abc import Mapping

SLACK = 1e-6  # s: binary fractions of a period must not cost a whole tick


class Timers:
    """A machine: `advance(now)` gives the names whose time has come. Who listens is the event
    board's business.

    Pulses lie on the grid start + k * period, where start is the moment of the first advance: so
    they do not drift, and neither listening nor load moves them. Pulses missed while the process
    stood still are left out, not made up for.
    """

    def __init__(self, periods: Mapping[str, float]) -> None:
        self._periods = dict(periods)
        self._next: dict[str, float] = {}

    def advance(self, now: float) -> list[str]:
        """Names whose pulse is due, in the order of services.toml."""
        fired = []
        for name, period in self._periods.items():
            due = self._next.setdefault(name, now + period)
            if now + SLACK < due:
                continue
            self._next[name] = due + period * (1 + math.floor((now + SLACK - due) / period))
            fired.append(name)
        return fired

    def due(self) -> float | None:
        """When the next pulse comes (s), None without timers."""
        return min(self._next.values(), default=None)
