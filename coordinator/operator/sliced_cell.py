"""A lock-step cell in this process that operators can see and control as a run in real time."""

from __future__ import annotations

import asyncio
import time
from typing import Final

from petrobot.coordinator.engine import Mode
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.services.comm.lockstep.cell import LockStepCell

SLICE: Final = 0.008
"""Longest wall time for which a lock-step cell ticks before the event loop serves others (s)."""
TELL: Final = 0.1
"""Wall time between two reports of the simulated time and of the progress (s)."""
AHEAD: Final = 0.01
"""Wall time by which a paced lock-step run may be ahead before it waits (s)."""


class SlicedCell:
    """A lock-step cell in this process that ticks in slices of the event loop, at a pace, so that
    operators see and control the run as in real time.

    Nothing in lock step depends on the slices, the pace or the clients. While the net is paused and
    every node has answered, simulated time does not advance. Implements `observation.Shell`.
    """

    def __init__(self, cell: LockStepCell, party: CoordinatorParty, pace: float) -> None:
        self.mission = party.mission
        self._cell = cell
        self._party = party
        self._pace = pace
        self._wake = asyncio.Event()
        self._fault: Exception | None = None

    def now(self) -> float:
        """Return the simulated time (s)."""
        return self._cell.now

    def settle(self) -> None:
        """Continue after a command was handled."""
        self._wake.set()

    def flush(self, node: str) -> None:
        """Do nothing: messages to a node leave with the next tick."""

    def fail(self, fault: Exception) -> None:
        """Make `run` raise this fault."""
        self._fault = fault
        self._wake.set()

    @property
    def still(self) -> bool:
        """Return whether time does not advance: the net is paused and every node has answered."""
        state = self.mission.executor.state
        return (
            state.mode is Mode.PAUSED
            and not state.stopping
            and not self.mission.executor.dispatch.asked
        )

    async def run(self, feed: Feed | None) -> None:
        """Tick until the mission run is finished; report its time on the feed. Raises MissionError,
        JournalError, CellError."""
        told = begun = time.perf_counter()
        paused = 0.0  # wall time that the pace ignores
        while not self._party.over:
            if self._fault is not None:
                raise self._fault
            if self.still:
                paused -= time.perf_counter()
                self._wake.clear()
                self._tell(feed)
                await self._wake.wait()
                paused += time.perf_counter()
            until = time.perf_counter() + SLICE
            while not self._party.over and not self.still and time.perf_counter() < until:
                if (
                    self._pace
                    and self.now() / self._pace > time.perf_counter() - begun - paused + AHEAD
                ):
                    break
                self._cell.step()
            if time.perf_counter() - told >= TELL:
                told = time.perf_counter()
                self._tell(feed)
            await asyncio.sleep(self._rest(begun + paused))

    def _tell(self, feed: Feed | None) -> None:
        if feed is not None:
            feed.emit("mission", time=self.now(), mission={})

    def _rest(self, begun: float) -> float:
        """Return how long to leave the event loop to others (s)."""
        if not self._pace or self._party.over:
            return 0.0
        return max(0.0, self.now() / self._pace - (time.perf_counter() - begun))
