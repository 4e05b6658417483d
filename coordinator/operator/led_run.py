"""A mission run in the hands of a station's operators: told on a feed, steered, its door open while
it goes on, its result kept.

What drives it, in real time or in lock step, is for those who derive from it.
"""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from petrobot.coordinator.engine import Override, SetBreakpoints, Stimulus
from petrobot.coordinator.experience.learning_session import LearningSession
from petrobot.coordinator.hmi.feed import Feed
from petrobot.coordinator.mission.mission import MissionError, Stage
from petrobot.coordinator.mission.partners import FirstAlternative
from petrobot.coordinator.operator.controls import Answer, Controls
from petrobot.coordinator.operator.door_file import Door, door_open
from petrobot.coordinator.operator.operation import Operation, Shell
from petrobot.coordinator.operator.start_order import learned_of
from petrobot.coordinator.record.recording import JournalStore
from petrobot.coordinator.record.runfolder import RESULT
from petrobot.services.comm.json_text import json_text
from petrobot.services.comm.whole_file import write_whole


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
