"""One mission run in real time under a station: its journal, its connections to the nodes, its
operators, its result."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.coordinator.hmi.feed import Feed
from petrobot.coordinator.launch import Setting, mission_id, realtime_mission, with_runs
from petrobot.coordinator.mission.partners import FirstAlternative
from petrobot.coordinator.mission.realtime import RealtimeMission, credentials_of
from petrobot.coordinator.operator.led_run import LedRun
from petrobot.coordinator.operator.start_order import StartOrder
from petrobot.coordinator.record.journal import JournalWriter
from petrobot.coordinator.record.recording import JournalStore, clock_reading
from petrobot.coordinator.record.runfolder import JOURNAL, header
from petrobot.coordinator.task import Task
from petrobot.services.comm.directory import Directory


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
