"""How often transitions fire and how long those that wait for events wait: rates belong to the place that waits."""

from __future__ import annotations

from dataclasses import dataclass

from coordinator.learning.moments import EMPTY, Moments


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

    def adding(self, waited: float | None = None) -> Flow:
        """With one more firing."""
        return Flow(self.fired + 1, self.waits if waited is None else self.waits.adding(waited))


def merge(one: Flow, other: Flow) -> Flow:
    """Of both sets of firings."""
    return Flow(one.fired + other.fired, one.waits.merged(other.waits))
