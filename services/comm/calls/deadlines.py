"""Runs that go on at the called end: when each must have ended, with clocks that stand still while
the run is held."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Final

from petrobot.services.comm.protocol.messages import Call

NEVER: Final = float("inf")
DEADLINE: Final = "deadline"
ORPHAN: Final = "orphan"


@dataclass(slots=True)
class Run:
    """A run that goes on; times in seconds on the node's clock. `stopping` once it was ordered to
    stop, `reason` says why."""

    call: Call
    peer: str
    began: float
    device: str
    orphan_time: float | None
    limit: float = NEVER
    """When its deadline is over."""
    held: float | None = None
    """Since when an operator holds it."""
    stopping: bool = False
    reason: str = ""


class GoingRuns(dict[str, Run]):
    """Runs that go on, by call id, with the times at which they are worth a look."""

    def __init__(self) -> None:
        super().__init__()
        self._timers: list[tuple[float, str, str]] = []

    def limit(self, id_: str, due: float) -> None:
        """The run must have ended by then."""
        self[id_].limit = due
        heapq.heappush(self._timers, (due, DEADLINE, id_))

    def watch_orphan(self, id_: str, due: float) -> None:
        """Then the run's caller may have been away for too long."""
        heapq.heappush(self._timers, (due, ORPHAN, id_))

    def hold_all(self, now: float, devices: Collection[str]) -> None:
        """Deadlines of the runs of these devices ("" for runs without one) stand still."""
        for run in self.values():
            if run.device in devices and run.held is None:
                run.held = now

    def release_all(self, now: float, devices: Collection[str] | None) -> None:
        """Deadlines of the held runs of these devices (None: of all) go on, later by the pause."""
        for id_, run in self.items():
            if run.held is None or (devices is not None and run.device not in devices):
                continue
            pause, run.held = now - run.held, None
            if run.limit < NEVER:
                self.limit(id_, run.limit + pause)

    def over(self, now: float) -> Iterator[tuple[float, str, str, Run]]:
        """What is due: time, DEADLINE or ORPHAN, id and run. A deadline that stands still or has
        moved is not."""
        while self._timers and self._timers[0][0] <= now:
            due, kind, id_ = heapq.heappop(self._timers)
            run = self.get(id_)
            if run is not None and (kind == ORPHAN or (run.held is None and due >= run.limit)):
                yield due, kind, id_, run

    def due(self) -> float:
        """When `over` has something to give next (s)."""
        while self._timers and self._timers[0][2] not in self:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else NEVER
