"""One mission run in lock step under a station: the whole cell in this process, in slices of the
loop, so that operators see it and step in as in real time.

Nothing of the lock step depends on the slices, the pace or who watches: a run that nobody touches
is the same as on the command line. While the net is paused and every node has answered, simulated
time stands still.
"""

from __future__ import annotations

import asyncio
import shutil
import time

from petrobot.coordinator.engine import Mode
from petrobot.coordinator.launch import Setting, Substitutes, lockstep_cell
from petrobot.coordinator.learning.session import LearningSession
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.live_run import LedRun
from petrobot.coordinator.operator.start_from import Departure
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.recording import JournalStore
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.cell import LockStepCell

SLICE = 0.008
"""Seconds of wall time that ticks may take before others have their turn."""
TELL = 0.1
"""Seconds of wall time between two tellings of the simulated time."""
AHEAD = 0.01
"""Seconds of wall time by which a paced run may be ahead before it waits."""


class SimulatedShell:
    """Ticks of a cell at a pace; what `coordinator.operator.operation.Operation` drives in place of
    a mission in real time."""

    def __init__(self, cell: LockStepCell, party: CoordinatorParty, pace: float) -> None:
        self.mission = party.mission
        self._cell = cell
        self._party = party
        self._pace = pace
        self._wake = asyncio.Event()
        self._fault: Exception | None = None

    def now(self) -> float:
        """Simulated time (s)."""
        return self._cell.now

    def settle(self) -> None:
        """Something was said: time may go on."""
        self._wake.set()

    def flush(self, node: str) -> None:
        """What was said to a node leaves with the next tick."""

    def fail(self, fault: Exception) -> None:
        """`run` raises this fault at its next look."""
        self._fault = fault
        self._wake.set()

    @property
    def still(self) -> bool:
        """Whether time stands still: the net is paused and nobody is to answer any more."""
        state = self.mission.executor.state
        return (
            state.mode is Mode.PAUSED
            and not state.stopping
            and not self.mission.executor.dispatch.asked
        )

    async def run(self, feed: Feed) -> None:
        """Tick until the mission run is over. Raises MissionError, JournalError."""
        told = begun = time.perf_counter()
        behind = 0.0  # wall time that does not count for the pace
        while not self._party.over:
            if self._fault is not None:
                raise self._fault
            if self.still:
                behind -= time.perf_counter()
                self._wake.clear()
                feed.emit("mission", time=self.now(), mission={})
                await self._wake.wait()
                behind += time.perf_counter()
            until = time.perf_counter() + SLICE
            while not self._party.over and not self.still and time.perf_counter() < until:
                if (
                    self._pace
                    and self.now() / self._pace > time.perf_counter() - begun - behind + AHEAD
                ):
                    break
                self._cell.step()
            if time.perf_counter() - told >= TELL:
                told = time.perf_counter()
                feed.emit("mission", time=self.now(), mission={})
            await asyncio.sleep(self._rest(begun + behind))

    def _rest(self, begun: float) -> float:
        """How long to leave the loop to others (s)."""
        if not self._pace or self._party.over:
            return 0.0
        return max(0.0, self.now() / self._pace - (time.perf_counter() - begun))


class SimulatedRun(LedRun):
    """Prepare, lead, finish. Fits `coordinator.operator.station.Run`."""

    mode = "lockstep"

    def __init__(
        self,
        directory: Directory,
        setting: Setting,
        store: JournalStore,
        pace: float,
        learning: LearningSession | None = None,
        substitutes: Substitutes | None = None,
        departs: Departure | None = None,
    ) -> None:
        """Loads the laboratory: takes a while, and needs no loop. Raises what its rooms raise."""
        folder, selector = store.writer.path.parent, setting.selector
        assert isinstance(selector, FirstAlternative)
        try:
            cell, party = lockstep_cell(directory, setting, substitutes, None, store)
        except BaseException:
            store.writer.close()
            shutil.rmtree(folder)
            raise
        self._shell = SimulatedShell(cell, party, pace)
        self._told = (
            {} if departs is None else {"from": {"run": departs.run, "record": departs.record}}
        )
        super().__init__(folder, self._shell, selector, store, learning)

    async def _go(self, feed: Feed) -> None:
        feed.emit("mission", mission={"id": self.identity, **self._told})
        if self._first:
            self._shell.mission.executor.stimulate(0.0, *self._first)
        await self._shell.run(feed)

    async def _close(self) -> None:
        """A cell in this process holds no connection."""
