"""Timers that the engine armed, on the coordinator's clock."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class _Timer:
    due: float
    held: float | None = None
    """Seconds left while it is held."""


class Timers:
    """By key; times in seconds on the clock of whoever calls."""

    def __init__(self) -> None:
        self._timers: dict[str, _Timer] = {}

    def __contains__(self, key: str) -> bool:
        return key in self._timers

    def __len__(self) -> int:
        return len(self._timers)

    def arm(self, now: float, key: str, seconds: float) -> None:
        """Be over in so many seconds."""
        self._timers[key] = _Timer(now + seconds)

    def disarm(self, key: str) -> None:
        """It is not wanted any more."""
        self._timers.pop(key, None)

    def hold(self, now: float, key: str) -> None:
        """Stop it; what is left is kept."""
        if (timer := self._timers.get(key)) and timer.held is None:
            timer.held = max(0.0, timer.due - now)

    def release(self, now: float, key: str) -> None:
        """Go on with what is left."""
        if (timer := self._timers.get(key)) and timer.held is not None:
            timer.due, timer.held = now + timer.held, None

    def over(self, now: float) -> list[str]:
        """Take out those that are over, the earliest first."""
        keys = sorted(
            (t.due, k) for k, t in self._timers.items() if t.held is None and t.due <= now
        )
        for _, key in keys:
            del self._timers[key]
        return [key for _, key in keys]

    def due(self) -> float | None:
        """When the next one is over."""
        return min((t.due for t in self._timers.values() if t.held is None), default=None)
