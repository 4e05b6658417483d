"""One mission run in real time under a station: its journal, its connections to the nodes, its operators, its result."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from coordinator.controls import Answer, Controls
from coordinator.door_file import Door, door_open
from coordinator.engine import Override, SetBreakpoints, Stimulus
from coordinator.hmi.feed import Feed
from coordinator.journal import JournalWriter
from coordinator.launch import Setting, mission_id, realtime_mission, with_runs
from coordinator.mission import MissionError, Stage
from coordinator.operation import Operation
from coordinator.partners import FirstAlternative
from coordinator.realtime import RealtimeMission, credentials_of
from coordinator.recording import JournalStore, clock_reading
from coordinator.runfolder import JOURNAL, RESULT, header
from coordinator.start_order import StartOrder, learned_of
from coordinator.task import Task
from services.comm.directory import Directory


class MissionRun:
    """Connect, lead, finish; or discard when the nodes are not there."""

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
        self._learning = None if learn is None else learn.session(task, directory, order.mode, order.seed)
        selector = FirstAlternative() if self._learning is None else self._learning.selector
        self.identity = mission_id(task)
        self.folder = runs / self.identity
        self._selector = selector
        setting = Setting(task, order.parameters, order.runs, order.seed, selector)
        now = asyncio.get_running_loop().time()
        begun = {} if self._learning is None else {"learning": self._learning.beginning()}
        self._store = _store(directory, setting, text, self.folder, self.identity, now, mock, begun)
        mission = realtime_mission(directory, setting, self.identity, self._store)
        self._shell = RealtimeMission(mission, directory, credentials_of(directory))
        self._operation: Operation | None = None
        self._door: Door | None = None
        self._first: tuple[Stimulus, ...] = ()
        self._closing: asyncio.Task[None] | None = None

    async def connect(self) -> None:
        """Reach every node. Raises UnreachableError."""
        await self._shell.connect()

    def discard(self) -> None:
        """It never began: leave no trace."""
        self._closing = asyncio.get_running_loop().create_task(self._shell.close())
        self._store.writer.close()
        shutil.rmtree(self.folder)

    def lead(
        self,
        feed: Feed,
        controls: Controls,
        door: Callable[[str], Door] | None,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> None:
        """Tell it on a feed and let the holder of the controls steer it. `stops` are breakpoints, `choices` the alternatives
        that the operator has fixed by primitive task, both from the beginning."""
        self._operation = Operation(self._shell, self._selector, feed, controls, starts=True)
        self._door = door(self.identity) if door is not None else None
        first: list[Stimulus] = [SetBreakpoints(tuple(sorted(stops)))] if stops else []
        self._first = (*first, *(Override(primitive, action) for primitive, action in (choices or {}).items()))

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out an operator's command."""
        assert self._operation is not None
        return await self._operation.command(who, verb, data)

    def abort(self, reason: str) -> None:
        """Give it up, whoever holds the controls."""
        assert self._operation is not None
        self._operation.abort(reason)

    async def finish(self) -> None:
        """Run it to its end; its result is left beside its journal and told."""
        assert self._operation is not None
        feed, begun = self._operation.feed, time.perf_counter()
        try:
            with door_open(self.folder, self._door) if self._door is not None else nullcontext():
                await self._shell.run(self._begin)
        except MissionError as fault:
            feed.emit("mission", mission={"state": "error", "reason": str(fault)})
            feed.emit("notice", notice={"level": "error", "text": str(fault), "at": feed.state["time"]})
        finally:
            await self._operation.close()
            await self._shell.close()
            self._store.writer.close()
            whole = self._shell.mission.stage is Stage.OVER
            learned = {} if self._learning is None else learned_of(self._learning, interrupted=not whole)
        result = {**self._shell.mission.result("realtime", time.perf_counter() - begun), **learned}
        text = json.dumps(result, indent=2, ensure_ascii=False) + "\n"
        await asyncio.to_thread((self.folder / RESULT).write_text, text, encoding="utf-8")
        feed.emit("result", result=result)

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
    return JournalStore(JournalWriter(folder / JOURNAL, header(mission, text, services, "realtime", given)), origin)
