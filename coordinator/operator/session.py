"""The session of one mission run, up to its result. The command line and the page both start and
control their runs with it; `coordinator/operator/prepare.py` makes it from a request.

    prepare, prepare_from or resume  ->  connect  ->  operate  ->  lead  ->  result

`prepare` opens the estimates and the journal of the run; `connect` reaches the nodes (real time);
`operate` lets operators see and control it; `lead` runs it to its end, saves what was learned and
closes the journal. `abandon` ends a run that cannot start after `prepare`.
docs/decisions/one-session.md says what this replaced.
"""

from __future__ import annotations

import asyncio
import importlib
import logging
import math
import os
import shutil
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

from petrobot.coordinator.engine import Mode, Override, SetBreakpoints, Stimulus
from petrobot.coordinator.launch import local_nodes
from petrobot.coordinator.learning.estimates_file import EstimatesError
from petrobot.coordinator.learning.session import LearningSession
from petrobot.coordinator.operator.commands import Operation, Shown
from petrobot.coordinator.operator.observation import Shell
from petrobot.coordinator.operator.port import Controls, Feed
from petrobot.coordinator.operator.run_address import RunAddress, published
from petrobot.coordinator.run.folder import RESULT
from petrobot.coordinator.run.interfaces import FirstAlternative, Observer
from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.mission import UNSCORED, Mission, MissionError, Stage
from petrobot.coordinator.run.realtime import RealtimeMission, credentials_of, on_disk
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.cell import LockStepCell
from petrobot.services.comm.lockstep.mesh import Member
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import make_folder, write_whole

REALTIME, LOCKSTEP = "realtime", "lockstep"
MODES: Final = (REALTIME, LOCKSTEP)

Watch = Callable[[Mission, float], None]
"""Called regularly with the mission and its clock (s), to show progress."""

SLICE: Final = 0.008
"""Longest wall time for which a lock-step cell ticks before the event loop serves others (s)."""
TELL: Final = 0.1
"""Wall time between two reports of the simulated time and of the progress (s)."""
AHEAD: Final = 0.01
"""Wall time by which a paced lock-step run may be ahead before it waits (s)."""

_log = logging.getLogger(__package__)


class RunSession(ABC):
    """One mission run: connect, operate, lead, result. Make it with `prepare`, `prepare_from` or
    `resume`."""

    mode: ClassVar[str]

    def __init__(
        self,
        mission: Mission,
        selector: FirstAlternative,
        learning: LearningSession | None,
        folder: Path | None,
        observers: Sequence[Observer],
        *,
        resumed: bool = False,
    ) -> None:
        self.mission = mission
        self.selector = selector
        self.folder = folder
        self.identity = folder.name if folder is not None else mission.executor.mission
        mission.executor.observers.extend(observers)
        self.operation: Operation | None = None
        self.address: RunAddress | None = None
        """Where the run can be controlled; the address is in the run's folder while the run is
        active."""
        self.plant = ""
        """Where it takes place (`Directory.plant`)."""
        self.origin: Mapping[str, Any] = {}
        """The point of a recorded run at which this one started."""
        self._learning = learning
        self._learned: Mapping[str, Any] = {}
        self._resumed = resumed
        self._led = False
        self._first: tuple[Stimulus, ...] = ()
        self._shown: Shown | None = None
        self._begun = time.perf_counter()
        self._seconds = 0.0

    @property
    def estimates(self) -> Path | None:
        """The estimates file from which it learns; None if it does not learn."""
        return None if self._learning is None else self._learning.setting.path

    def operate(
        self,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> Operation:
        """Let operators see and control it; in lock step only a cell in this process. `feed`,
        `controls` and `starts` as for `Operation`; `stops` are breakpoints, `choices` the
        alternatives that the operator fixed by primitive task, both from the start."""
        fixed = (Override(primitive, action) for primitive, action in (choices or {}).items())
        self._first = (*((SetBreakpoints(tuple(sorted(stops))),) if stops else ()), *fixed)
        self.operation = Operation(
            self._attended(),
            self.selector,
            feed,
            controls,
            starts=starts,
            mode=self.mode,
            shown=self._shown,
        )
        self.operation.feed.emit("mission", mission={"plant": self.plant})
        return self.operation

    @abstractmethod
    def _attended(self) -> Shell:
        """Return the driver of the run, which operators control from now on."""

    @abstractmethod
    async def connect(self) -> None:
        """Connect to every node. Raises UnreachableError, and MissionError if another run has a
        device of the task or if this was ordered before an emergency stop (only in real time: in
        lock step the cell forms in `lead`)."""

    async def lead(self, watch: Watch | None = None) -> None:
        """Run it to its end; even if it fails, what was learned is saved and the journal is closed.

        Raises MissionError, JournalError, ReplayError, CellError, LaunchError, EstimatesError.
        """
        self._led = True
        _log.info("run %s: started (%s, task %s)", self.identity, self.mode, self._task.name)
        stopped_by: BaseException | None = None
        try:
            with ExitStack() as until_ended:
                if self.folder is not None and self.address is not None:
                    known = published(self.folder, self.address)
                    await on_disk(partial(until_ended.enter_context, known))
                try:
                    await self._lead(watch)
                except MissionError as fault:
                    if self.mission.stage is not Stage.SCORING:
                        raise
                    self._go_unscored(fault)
        except BaseException as fault:
            stopped_by = fault
            _log.info("run %s: stopped by %s: %s", self.identity, type(fault).__name__, fault)
            raise
        finally:
            if self.operation is not None:
                await self.operation.close()
            await self._leave()
            await self._close_journal()
            self._seconds = time.perf_counter() - self._begun
            if self._learning is not None:
                try:
                    self._learned = await on_disk(partial(self._saved, self._learning))
                except (EstimatesError, JournalError, OSError) as fault:
                    if stopped_by is None:
                        raise
                    # What stopped the run is what the caller must hear: a full disk is both.
                    _log.error("run %s: what it learned is not saved: %s", self.identity, fault)
        _log.info("run %s: finished, %s", self.identity, self.result()["status"])

    async def abandon(self) -> None:
        """Give up a run before `lead`: a new one leaves no folder, a resumed one stays as it was.
        Does nothing after `lead`."""
        if self._led:
            return
        self._led = True
        if self.operation is not None:
            await self.operation.close()
        await self._leave()
        await self._close_journal()
        if self.folder is not None and not self._resumed:
            shutil.rmtree(self.folder, ignore_errors=True)

    def result(self) -> dict[str, Any]:
        """Return the result after `lead`; also of a run that failed."""
        origin = {"from": dict(self.origin)} if self.origin else {}
        # In lock step a resumed run is derived again from its beginning: it is the undisturbed one.
        later = self._resumed and self.mode == REALTIME
        resumed = {"resumed": "wall_s counts from the last resume"} if later else {}
        return {
            "task": self._task.name,
            "mode": self.mode,
            "plant": self.plant,
            **self.mission.result(self.mode, self._seconds),
            **resumed,
            **self._learned,
            **origin,
        }

    def _go_unscored(self, fault: MissionError) -> None:
        """Note that the run has finished without its score. The journal has all the rest."""
        again = f"; `petrobot resume {self.folder}` asks for it again" if self.folder else ""
        self.mission.remarks[UNSCORED] = f"{fault}{again}"
        _log.error("run %s: no score: %s", self.identity, fault)

    def keep_result(self) -> None:
        """Write the result next to the journal. Raises OSError."""
        if self.folder is not None:
            text = json_text(self.result(), indent=2, ensure_ascii=False) + "\n"
            write_whole(self.folder / RESULT, text)

    @property
    def _task(self) -> Task:
        return self.mission.executor.task

    @abstractmethod
    async def _lead(self, watch: Watch | None) -> None:
        """Run it to its end, with `_first` before anything else."""

    @abstractmethod
    async def _leave(self) -> None:
        """Close the connections to the nodes."""

    async def _close_journal(self) -> None:
        store = self.mission.executor.store
        if isinstance(store, JournalStore):
            await on_disk(store.writer.close)

    def _saved(self, session: LearningSession) -> dict[str, Any]:
        """Save what it learned, also after an interruption; return the part of the result about
        it."""
        make_folder(session.setting.path.parent)
        counted = session.save()
        learning, values = session.learning, session.selector.context
        for name, action, measure in learning.uncosted():
            declared = learning.question(name).declared_cost(action)
            _log.warning(
                "%s: no run of %s reported %s, so its cost was taken as %s; correct `cost` in the "
                "task file or the name in the action's result", name, action, measure,
                "0" if math.isnan(declared) else f"{declared:g}, as the task file declares",
            )  # fmt: skip
        probabilities = {
            name: {action: round(p, 4) for action, p in selector.learned(values).items()}
            for name, selector in learning.selectors.items()
        }
        told = {
            "file": str(session.setting.path),
            "selector": session.setting.selector,
            "context": values,
            "runs_counted": counted,
            "probabilities": probabilities,
        }
        return {"learned": told}


def import_for_runs() -> None:
    """Import what draws and counts would import at the first use: the coordinator would not answer
    its nodes in the middle of the run, nor, on a busy host, its page's clients at a start."""
    for module in ("numpy", "scipy.special"):
        importlib.import_module(module)


class RealtimeSession(RunSession):
    """A run with the nodes of the cell in wall-clock time."""

    mode = REALTIME

    def __init__(
        self,
        directory: Directory,
        mission: Mission,
        selector: FirstAlternative,
        learning: LearningSession | None,
        folder: Path | None,
        observers: Sequence[Observer] = (),
        *,
        begin: Callable[[float], None] | None = None,
        shown: Shown | None = None,
        ordered: float = math.inf,
    ) -> None:
        """`begin` makes a resumed mission continue, `shown` is what operators see of its recorded
        steps; `ordered` as for `RunRequest`."""
        super().__init__(mission, selector, learning, folder, observers, resumed=begin is not None)
        import_for_runs()
        self.shell = RealtimeMission(mission, directory, credentials_of(directory), ordered)
        self._begin, self._shown = begin or mission.start, shown

    def _attended(self) -> Shell:
        return self.shell

    async def connect(self) -> None:
        await self.shell.connect()
        await self.shell.refuse_others(self.plant)
        directory = self.mission.executor.directory
        tasks = self._task.primitive_tasks.values()
        actions = (directory.actions.get(name) for task in tasks for name in task.alternatives)
        devices = {action.device for action in actions if action is not None}
        await self.shell.lease(devices)

    async def _lead(self, watch: Watch | None) -> None:
        running = asyncio.ensure_future(self.shell.run(self._start))
        try:
            while watch is not None and not running.done():
                watch(self.mission, self.shell.now())
                await asyncio.wait({running}, timeout=TELL)
            await running
        finally:
            running.cancel()

    def _start(self, now: float) -> None:
        if self._first:
            self.mission.executor.stimulate(now, *self._first)
        self._begin(now)

    async def _leave(self) -> None:
        await self.shell.close()


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
        length = TELL if feed is None else SLICE  # without a page no client waits for the loop
        while not self._party.over:
            if self._fault is not None:
                raise self._fault
            if self.still:
                paused -= time.perf_counter()
                self._wake.clear()
                self._tell(feed)
                await self._wake.wait()
                paused += time.perf_counter()
            until = time.perf_counter() + length
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


class LockstepSession(RunSession):
    """A run in lock step: its cell is in this process (`cell`), or this process is a `member`."""

    mode = LOCKSTEP

    def __init__(
        self,
        party: CoordinatorParty,
        selector: FirstAlternative,
        learning: LearningSession | None,
        folder: Path | None,
        observers: Sequence[Observer] = (),
        *,
        cell: LockStepCell | None = None,
        pace: float = 0.0,
        member: Member | None = None,
        launched: Directory | None = None,
        mock: Path | None = None,
        resumed: bool = False,
    ) -> None:
        """`launched`: the cell whose other members are to be launched, None if they wait."""
        super().__init__(party.mission, selector, learning, folder, observers, resumed=resumed)
        self.shell = None if cell is None else SlicedCell(cell, party, pace)
        self._party = party
        self._member = member
        self._launched = launched
        self._mock = mock

    def _attended(self) -> Shell:
        assert self.shell is not None
        self._party.attended = True
        return self.shell

    async def _lead(self, watch: Watch | None) -> None:
        if watch is not None:
            self._party.watch = lambda now: watch(self.mission, now)
        if self.shell is not None:
            await self._lead_cell(self.shell)
        elif self._launched is None:
            with interruptible():
                self._lead_member()
        else:
            nodes = local_nodes(self._launched, lockstep=True, mock=self._mock, respawn=False)
            async with nodes:
                await asyncio.to_thread(self._lead_member)

    async def connect(self) -> None:
        """Do nothing: the cell forms in `lead`."""

    async def _leave(self) -> None:
        """Do nothing: the cell has ended with the run."""

    async def _lead_cell(self, shell: SlicedCell) -> None:
        with _kept_folder():
            await self._run_cell(shell)

    async def _run_cell(self, shell: SlicedCell) -> None:
        if self.operation is None:
            await shell.run(None)
            return
        feed = self.operation.feed
        origin = {key: self.origin[key] for key in ("run", "record") if self.origin}
        told = {"from": origin} if origin else {}
        feed.emit("mission", mission={"id": self.identity, **told})
        if self._first:
            self.mission.executor.stimulate(0.0, *self._first)
        await shell.run(feed)

    def _lead_member(self) -> None:
        assert self._member is not None
        self._member.open()
        self._member.run(lambda: self._party.over)


@contextmanager
def _kept_folder() -> Iterator[None]:
    """Return to the working folder that an action has left: in lock step actions run in this
    process, and what is written after the run has relative paths."""
    folder = os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield
    finally:
        os.fchdir(folder)
        os.close(folder)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt in code that blocks the event loop: the handler of
    `asyncio.run` would only cancel the task when it returns to the loop."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives signals
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
