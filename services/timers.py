"""Timers of a node: external pulse events on an absolute grid, only while somebody listens."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

SLACK = 1e-6  # s: binary fractions of a period must not cost a whole tick


class Timers:
    """A machine: `advance(now)` gives the names whose time has come; `wanted(name)` says whether anyone listens.

    Pulses lie on the grid start + k * period, where start is the moment of the first advance: so they do not drift, and
    neither listening nor load moves them. Pulses missed while the process stood still are left out, not made up for.
    """

    def __init__(self, periods: Mapping[str, float], wanted: Callable[[str], bool]) -> None:
        self._periods = dict(periods)
        self._wanted = wanted
        self._next: dict[str, float] = {}

    def advance(self, now: float) -> list[str]:
        """Names whose pulse is due and wanted, in the order of services.toml."""
        fired = []
        for name, period in self._periods.items():
            due = self._next.setdefault(name, now + period)
            if now + SLACK < due:
                continue
            self._next[name] = due + period * (1 + math.floor((now + SLACK - due) / period))
            if self._wanted(name):
                fired.append(name)
        return fired

    def due(self) -> float | None:
        """When a wanted pulse comes next (s), None if nobody listens."""
        return min((t for name, t in self._next.items() if self._wanted(name)), default=None)
