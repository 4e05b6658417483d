"""How often transitions fire and how long those that wait for events wait: rates belong to the
place that waits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from petrobot.coordinator.learning.statistics import EMPTY, Moments, whole


@dataclass(frozen=True, slots=True, order=True)
class PassageKey:
    """A transition of a task, in a context."""

    task: str
    transition: str
    context: str = ""


@dataclass(frozen=True, slots=True)
class Flow:
    """Firings of one transition. Immutable, mergeable."""

    fired: int = 0
    waits: Moments = EMPTY
    """Seconds from the marking that enabled it to each firing."""

    def to_plain(self) -> list[Any]:
        """Plain data."""
        return [self.fired, self.waits.to_plain()]

    @classmethod
    def of_plain(cls, data: Sequence[Any]) -> Flow:
        """What `to_plain` gave. Raises ValueError or TypeError."""
        fired, waits = whole(data[0], "firings"), Moments.of_plain(data[1])
        whole(waits.n, "waits", fired)
        return cls(fired, waits)

    def adding(self, waited: float | None = None) -> Flow:
        """With one more firing."""
        return Flow(self.fired + 1, self.waits if waited is None else self.waits.adding(waited))


def merge(one: Flow, other: Flow) -> Flow:
    """Of both sets of firings."""
    return Flow(one.fired + other.fired, one.waits.merged(other.waits))
