"""A mission run in the hands of a station's operators: told on a feed, steered, its door open while
it goes on, its result kept.

What drives it, in real time or in lock step, is for those who derive from it.
"""

from __future__ import annotations

import asyncio
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from petrobot.coordinator.engine import Override, SetBreakpoints, Stimulus
from petrobot.coordinator.launch import Setting, mission_id, realtime_mission, with_runs
from petrobot.coordinator.learning.session import LearningSession
from petrobot.coordinator.operator.commands import Operation, Shell
from petrobot.coordinator.operator.controls import Answer, Controls
from petrobot.coordinator.operator.door_file import Door, door_open
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.start_order import StartOrder, learned_of
from petrobot.coordinator.run.folder import JOURNAL, RESULT, header
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.mission import MissionError, Stage
from petrobot.coordinator.run.realtime import RealtimeMission, credentials_of
from petrobot.coordinator.run.recording import JournalStore, clock_reading
from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import Directory
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import write_whole


class LedRun(ABC):
    """Lead, finish. Fits `coordinator.operator.station.Run`."""

    mode: str
    """realtime or lockstep."""

    def __init__(
        self,
        folder: Path,
        shell: Shell,
        selector: FirstAlternative,
        store: JournalStore,
        learning: LearningSession | None,
    ) -> None:
        """`folder` is the run's own and has its name; the journal in it is `store`'s."""
        self.folder = folder
        self.identity = folder.name
        self._store = store
        self._led = shell
        self._selector = selector
        self._learning = learning
        self._operation: Operation | None = None
        self._door: Door | None = None
        self._first: tuple[Stimulus, ...] = ()

    def lead(
        self,
        feed: Feed,
        controls: Controls,
        door: Callable[[str], Door] | None,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> None:
        """Tell it on a feed and let the holder of the controls steer it. `stops` are breakpoints,
        `choices` the alternatives that the operator has fixed by primitive task, both from the
        beginning."""
        self._operation = Operation(
            self._led, self._selector, feed, controls, starts=True, mode=self.mode
        )
        self._door = door(self.identity) if door is not None else None
        first: list[Stimulus] = [SetBreakpoints(tuple(sorted(stops)))] if stops else []
        self._first = (
            *first,
            *(Override(primitive, action) for primitive, action in (choices or {}).items()),
        )

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out an operator's command."""
        assert self._operation is not None
        return await self._operation.command(who, verb, data)

    def abort(self, reason: str) -> None:
        """Give it up, whoever holds the controls."""
        assert self._operation is not None
        self._operation.abort(reason)

    async def finish(self) -> None:
        """Run it to its end; its result is left beside its journal and told, and what was learned
        is saved."""
        assert self._operation is not None
        mission, feed, begun = self._led.mission, self._operation.feed, time.perf_counter()
        try:
            with door_open(self.folder, self._door) if self._door is not None else nullcontext():
                await self._go(feed)
        except MissionError as fault:
            feed.emit("mission", mission={"state": "error", "reason": str(fault)})
            feed.emit(
                "notice", notice={"level": "error", "text": str(fault), "at": feed.state["time"]}
            )
        finally:
            await self._operation.close()
            await self._close()
            self._store.writer.close()
            whole = mission.stage is Stage.OVER
            learned = (
                {} if self._learning is None else learned_of(self._learning, interrupted=not whole)
            )
        result = {**mission.result(self.mode, time.perf_counter() - begun), **learned}
        text = json_text(result, indent=2, ensure_ascii=False) + "\n"
        await asyncio.to_thread(write_whole, self.folder / RESULT, text)
        feed.emit("result", result=result)

    @abstractmethod
    async def _go(self, feed: Feed) -> None:
        """Run it to its end, `_first` before all else. Raises MissionError, JournalError."""

    @abstractmethod
    async def _close(self) -> None:
        """Let go of what it reached."""


# One mission run in real time under a station: its journal, its connections to the nodes, its operators, its result.


class MissionRun(LedRun):
    """Connect, lead, finish; or discard when the nodes are not there."""

    mode = "realtime"

    def __init__(
        self,
        directory: Directory,
        task: Task,
        text: str,
        order: StartOrder,
        runs: Path,
        mock: Path | None = None,
    ) -> None:
        """`text` is the task file's, `runs` the folder in which the run gets a folder of its own.

        Raises EstimatesError and ValueError when it cannot learn as it is told to.
        """
        learn = order.learn
        learning = None if learn is None else learn.session(task, directory, order.mode, order.seed)
        selector = FirstAlternative() if learning is None else learning.selector
        identity = mission_id(task)
        folder = runs / identity
        setting = Setting(task, order.parameters, order.runs, order.seed, selector)
        now = asyncio.get_running_loop().time()
        begun = {} if learning is None else {"learning": learning.beginning()}
        store = _store(directory, setting, text, folder, identity, now, mock, begun)
        mission = realtime_mission(directory, setting, identity, store)
        self._shell = RealtimeMission(mission, directory, credentials_of(directory))
        self._closing: asyncio.Task[None] | None = None
        super().__init__(folder, self._shell, selector, store, learning)

    async def connect(self) -> None:
        """Reach every node. Raises UnreachableError."""
        await self._shell.connect()

    def discard(self) -> None:
        """It never began: leave no trace."""
        self._closing = asyncio.get_running_loop().create_task(self._shell.close())
        self._store.writer.close()
        shutil.rmtree(self.folder)

    async def _go(self, feed: Feed) -> None:
        await self._shell.run(self._begin)

    async def _close(self) -> None:
        await self._shell.close()

    def _begin(self, now: float) -> None:
        self._shell.mission.executor.stimulate(now, *self._first)
        self._shell.mission.start(now)


def _store(
    directory: Directory,
    setting: Setting,
    text: str,
    folder: Path,
    mission: str,
    origin: float,
    mock: Path | None,
    begun: Mapping[str, Any],
) -> JournalStore:
    given: dict[str, Any] = {
        "services_path": str(directory.source.resolve()),
        "seed": setting.seed,
        "runs": with_runs(setting.task, setting.runs)[1],
        "parameters": {**setting.task.parameters, **setting.parameters},
        "clock": clock_reading(origin),
        "durable": False,
        "mock": str(mock.resolve()) if mock else "",
        "chosen": {},
        **begun,
    }
    services = directory.source.read_text(encoding="utf-8")
    return JournalStore(
        JournalWriter(folder / JOURNAL, header(mission, text, services, "realtime", given)), origin
    )
