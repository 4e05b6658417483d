"""One mission run in lock step under a station: the whole cell in this process, in slices of the loop, so that operators see it
and step in as in real time.

Nothing of the lock step depends on the slices, the pace or who watches: a run that nobody touches is the same as on the command
line. While the net is paused and every node has answered, simulated time stands still.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from typing import Any

from coordinator.controls import Answer, Controls
from coordinator.departure import Departure
from coordinator.door_file import Door, door_open
from coordinator.engine import Mode, Override, SetBreakpoints, Stimulus
from coordinator.hmi.feed import Feed
from coordinator.launch import Setting, Substitutes, lockstep_cell
from coordinator.learning_session import LearningSession
from coordinator.lockstep_party import CoordinatorParty
from coordinator.mission import MissionError
from coordinator.operation import Operation
from coordinator.partners import FirstAlternative
from coordinator.recording import JournalStore
from coordinator.runfolder import RESULT
from coordinator.start_order import learned_of
from services.comm.cell import Cell
from services.comm.directory import Directory

SLICE = 0.008
"""Seconds of wall time that ticks may take before others have their turn."""
TELL = 0.1
"""Seconds of wall time between two tellings of the simulated time."""
AHEAD = 0.01
"""Seconds of wall time by which a paced run may be ahead before it waits."""


class SimulatedShell:
    """Ticks of a cell at a pace; what `coordinator.operation.Operation` drives in place of a mission in real time."""

    def __init__(self, cell: Cell, party: CoordinatorParty, pace: float) -> None:
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
        return state.mode is Mode.PAUSED and not state.stopping and not self.mission.executor.dispatch.asked

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
                if self._pace and self.now() / self._pace > time.perf_counter() - begun - behind + AHEAD:
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


class SimulatedRun:
    """Prepare, lead, finish. Fits `coordinator.station.Run`."""

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
        self.folder = store.writer.path.parent
        self.identity = self.folder.name
        self._setting = setting
        self._store = store
        self._pace = pace
        self._learning = learning
        try:
            self._cell, self._party = lockstep_cell(directory, setting, substitutes, None, store)
        except BaseException:
            store.writer.close()
            shutil.rmtree(self.folder)
            raise
        self._told = {} if departs is None else {"from": {"run": departs.run, "record": departs.record}}
        self._operation: Operation | None = None
        self._door: Door | None = None

    def lead(
        self,
        feed: Feed,
        controls: Controls,
        door: Callable[[str], Door] | None,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> None:
        """Tell it on a feed and let the holder of the controls steer it; `stops` and `choices` hold from the beginning."""
        shell = SimulatedShell(self._cell, self._party, self._pace)
        selector = self._setting.selector
        assert isinstance(selector, FirstAlternative)
        self._operation = Operation(shell, selector, feed, controls, starts=True, mode="lockstep")
        self._door = door(self.identity) if door is not None else None
        first: list[Stimulus] = [SetBreakpoints(tuple(sorted(stops)))] if stops else []
        first += [Override(primitive, action) for primitive, action in (choices or {}).items()]
        feed.emit("mission", mission={"id": self.identity, **self._told})
        if first:
            shell.mission.executor.stimulate(0.0, *first)

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out an operator's command."""
        assert self._operation is not None
        return await self._operation.command(who, verb, data)

    def abort(self, reason: str) -> None:
        """Give it up, whoever holds the controls."""
        assert self._operation is not None
        self._operation.abort(reason)

    async def finish(self) -> None:
        """Run it to its end; its result is left beside its journal and told, and what was learned is saved."""
        assert self._operation is not None
        shell, feed, begun = self._operation.shell, self._operation.feed, time.perf_counter()
        assert isinstance(shell, SimulatedShell)
        whole = False
        try:
            with door_open(self.folder, self._door) if self._door is not None else nullcontext():
                await shell.run(feed)
            whole = True
        except MissionError as fault:
            feed.emit("mission", mission={"state": "error", "reason": str(fault)})
            feed.emit("notice", notice={"level": "error", "text": str(fault), "at": feed.state["time"]})
        finally:
            await self._operation.close()
            self._store.writer.close()
            learned = {} if self._learning is None else learned_of(self._learning, interrupted=not whole)
        result = {**shell.mission.result("lockstep", time.perf_counter() - begun), **learned}
        text = json.dumps(result, indent=2, ensure_ascii=False) + "\n"
        await asyncio.to_thread((self.folder / RESULT).write_text, text, encoding="utf-8")
        feed.emit("result", result=result)
