"""One mission run, from the request to its result. The command line and the page both start and
control their runs with it.

    prepare, prepare_from or resume  ->  connect  ->  operate  ->  lead  ->  result

`prepare` opens the estimates and the journal of the run; `connect` reaches the nodes (real time);
`operate` lets operators see and control it; `lead` runs it to its end, saves what was learned and
closes the journal. A run that cannot be led after `prepare` is given up with `abandon`.
docs/decisions/one-session.md says what this replaced.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final

from petrobot.coordinator.engine import Mode, Override, SetBreakpoints, Stimulus
from petrobot.coordinator.launch import (
    RequestError,
    Setting,
    local_nodes,
    lockstep_cell,
    lockstep_id,
    lockstep_member,
    lockstep_mission,
    mission_id,
    realtime_mission,
    resumed_mission,
    scripted_actions,
    with_runs,
)
from petrobot.coordinator.learning.session import (
    LearningSession,
    LearningSetting,
    fixed_by_user,
    plant_of,
    session_of,
)
from petrobot.coordinator.operator.commands import Operation
from petrobot.coordinator.operator.controls import Controls
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.run_address import RunAddress, published
from petrobot.coordinator.operator.start_from import (
    AGAIN,
    Recorded,
    departed,
    departing,
    departure,
)
from petrobot.coordinator.run.folder import DEFAULT, JOURNAL, RESULT, header
from petrobot.coordinator.run.interfaces import FirstAlternative, Observer
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.mission import Mission, Stage
from petrobot.coordinator.run.realtime import RealtimeMission, credentials_of
from petrobot.coordinator.run.recording import JournalStore, RetracingStore, clock_reading
from petrobot.coordinator.run.timeline import Timeline
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import dumps
from petrobot.services.comm.location_file import (
    FIRST_PHYSICS,
    Directory,
    physics_of,
    same_physics,
)
from petrobot.services.comm.lockstep.cell import LockStepCell
from petrobot.services.comm.lockstep.mesh import Member
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import make_folder, write_whole

REALTIME, LOCKSTEP = "realtime", "lockstep"
MODES: Final = (REALTIME, LOCKSTEP)
SEED: Final = 1
ONE_PROCESS, LAUNCHED, JOINED = "one process", "launched", "joined"
"""Where the nodes of a lock-step cell run: in this process, in processes that the session launches
and ends, or in processes that are already waiting (`petrobot up --lockstep`)."""
SLICE: Final = 0.008
"""Longest wall time for which a lock-step cell ticks before the event loop serves others (s)."""
TELL: Final = 0.1
"""Wall time between two reports of the simulated time and of the progress (s)."""
AHEAD: Final = 0.01
"""Wall time by which a paced lock-step run may be ahead before it waits (s)."""

Watch = Callable[[Mission, float], None]
"""Called regularly with the mission and its clock (s), to show progress."""

_log = logging.getLogger(__package__)


@dataclass(frozen=True)
class RecordedPoint:
    """A point of a recorded run from which a simulated run starts."""

    run: str
    record: int
    going: Mapping[str, str] | str = AGAIN
    """What happens to the runs that were active then: one word for all, or words by place."""


@dataclass(frozen=True)
class RunRequest:
    """Request for a mission run, from the options of `petrobot run` or from the page."""

    mode: str = REALTIME
    runs: int | None = None
    """Number of runs; None: the number in the task file."""
    seed: int | None = SEED
    """Seed; None with `start`: that of the recorded run."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    chosen: Mapping[str, str] = field(default_factory=dict)
    """Actions that the user fixed, by primitive task."""
    learning: LearningSetting | None = None
    """The session fills in `chosen` and the declared compute times of lock step."""
    pace: float = 1.0
    """In lock step: highest number of simulated seconds per second; 0: as fast as possible."""
    start: RecordedPoint | None = None
    """Recorded point at which a simulated run starts; None: the task's beginning."""
    folder: Path | None = DEFAULT
    """The run gets its own folder in this one; None: nothing is stored (lock step only)."""
    durable: bool = False
    """Sync the journal before every start, also of actions that move no hardware."""
    mock: Path | None = None
    """File of scripted actions."""
    nodes: str = ONE_PROCESS
    """Kind of lock-step cell: ONE_PROCESS, LAUNCHED or JOINED."""


def prepare(request: RunRequest, task: Task, text: str, directory: Directory) -> RunSession:
    """Make a new run of a task; `text` is the task file's. In real time, call it in the event loop
    that leads the run; in lock step it may take seconds (it loads the simulated cell).

    Raises EstimatesError or RequestError for what it cannot learn or replace, JournalError or
    OSError when its journal cannot be written, KeyFileError. No folder is left behind then.
    """
    _refuse_too_many(request.runs, task)
    seed = SEED if request.seed is None else request.seed
    learning = None
    physics = _physics(directory)
    if request.learning is not None:
        declared = {a.name: a.compute_time for a in directory.actions.values()}
        lockstep = request.mode == LOCKSTEP
        setting = replace(
            request.learning,
            chosen=request.chosen,
            declared=declared if lockstep else None,
            physics=physics,
            plant=plant_of(directory, scripted=request.mock is not None, lockstep=lockstep),
        )
        try:
            learning = LearningSession(task, setting, seed)
        except ValueError as fault:
            raise RequestError(str(fault)) from fault
    selector = FirstAlternative(request.chosen) if learning is None else learning.selector
    more = {} if learning is None else {"learning": learning.beginning()}
    return _new(
        request,
        directory,
        Setting(task, request.parameters, request.runs, seed, selector),
        (text, directory.text),
        {"chosen": dict(request.chosen), **more},
        learning,
    )


def _refuse_too_many(runs: int | None, task: Task) -> None:
    """Raise RequestError if the place of the runs does not hold so many tokens."""
    place = task.places.get(task.runs_place)
    most = None if place is None else place.capacity
    if runs is not None and most is not None and runs > most:
        raise RequestError(
            f"runs: expected at most {most}, the capacity of {task.runs_place!r}, found {runs}; "
            f"ask for fewer, or raise places.{task.runs_place}.capacity in the task file"
        )


def prepare_from(request: RunRequest, found: Recorded) -> RunSession:
    """Make a lock-step run of a recorded run's task that starts at `request.start`.

    Raises DepartureError (a ValueError) for a point that does not exist, and what `prepare` raises.
    """
    assert request.start is not None
    journal, then = found.journal, found.journal.header
    _refuse_other_physics(found)
    point = departure(
        journal, found.engine, request.start.run, request.start.record, request.start.going
    )
    try:
        setting = departing(
            journal, found.task, found.engine, point, request.seed, request.parameters
        )
    except ValueError as fault:
        raise RequestError(str(fault)) from fault
    mock = request.mock or (Path(then["mock"]) if then.get("mock") else None)
    made = _new(
        replace(request, mode=LOCKSTEP, mock=mock, nodes=ONE_PROCESS),
        found.directory,
        setting,
        (then["task"], then["services"]),
        {"chosen": dict(then.get("chosen", {})), "from": point.plain()},
        None,
    )
    made.origin = {"run": point.run, "record": point.record, "going": dict(point.going)}
    return made


def resume(found: Recorded) -> RunSession:
    """Continue a run whose coordinator was killed. A lock-step cell that ended with its coordinator
    is built again from its seed; nodes that wait for their coordinator are joined.

    Raises EstimatesError, RequestError, JournalError, ReplayError, KeyFileError.
    """
    then, folder = found.journal.header, found.journal.path.parent
    _refuse_other_physics(found)
    try:
        learning = session_of(found.task, then)
    except ValueError as fault:
        raise RequestError(str(fault)) from fault
    selector = FirstAlternative(fixed_by_user(then)) if learning is None else learning.selector
    if then["mode"] == LOCKSTEP and then["cell"] != JOINED:
        setting = Setting(
            found.task, then["parameters"], then["runs"], then["seed"], selector, departed(then)
        )
        mock = Path(then["mock"]) if then.get("mock") else None
        script = scripted_actions(mock, found.directory)
        store = RetracingStore(JournalWriter(found.journal.path), found.journal)
        cell, party = lockstep_cell(found.directory, setting, script, None, store)
        return LockstepSession(party, selector, learning, folder, cell=cell, pace=0.0)
    timeline = Timeline()
    observers: list[Observer] = [timeline]
    if learning is not None:
        observers.append(learning.selector)
    lockstep = then["mode"] == LOCKSTEP
    now = 0.0 if lockstep else asyncio.get_running_loop().time()
    mission, begin = resumed_mission(
        found.directory, found.task, found.engine, found.journal, observers, now, selector
    )
    if lockstep:
        member, party = lockstep_member(found.directory, mission, None, begin)
        return LockstepSession(party, selector, learning, folder, member=member, timeline=timeline)
    return RealtimeSession(found.directory, mission, selector, learning, folder, begin, timeline)


def _physics(directory: Directory) -> str:
    """Return `physics_of` a location file. Raises RequestError."""
    try:
        return physics_of(directory)
    except ValueError as fault:
        raise RequestError(str(fault)) from fault


def _refuse_other_physics(found: Recorded) -> None:
    """Raise RequestError if a recorded run would continue in a laboratory with another physics."""
    then, now = found.journal.header.get("physics", ""), _physics(found.directory)
    if now and not same_physics(then, now):
        raise RequestError(
            f"{found.journal.path}: recorded with the physics {then or FIRST_PHYSICS!r}, but this "
            f"computer's laboratory has {now!r}: the run would continue differently; write the "
            "same `physics` in services.toml ([nodes.NAME] of the simulated node), or resume it "
            "where that physics is installed"
        )


def _new(
    request: RunRequest,
    directory: Directory,
    setting: Setting,
    texts: tuple[str, str],
    more: Mapping[str, Any],
    learning: LearningSession | None,
) -> RunSession:
    """Make a new run; `texts` are those of the task file and of services.toml."""
    lockstep = request.mode == LOCKSTEP
    script = scripted_actions(request.mock, directory)  # Refused before a folder is made.
    physics = _physics(directory)
    identity = mission_id(setting.task)
    folder = None if request.folder is None else request.folder / identity
    name = lockstep_id(setting) if lockstep else identity
    origin = 0.0 if lockstep else asyncio.get_running_loop().time()
    store = None
    if folder is not None:
        task, runs = with_runs(setting.task, setting.runs)
        given = {
            "expanded": dumps(task.flat),
            "services_path": str(directory.source.resolve()),
            "seed": setting.seed,
            "runs": runs,
            "parameters": {**setting.task.parameters, **setting.parameters},
            "clock": clock_reading(origin),
            "durable": request.durable,
            "mock": str(request.mock.resolve()) if request.mock else "",
            **({"physics": physics} if physics else {}),
            **({"cell": JOINED if request.nodes == JOINED else LAUNCHED} if lockstep else {}),
            **more,
        }
        writer = JournalWriter(folder / JOURNAL, header(name, *texts, request.mode, given))
        store = JournalStore(writer, origin, durable=request.durable)
    selector = setting.selector
    assert isinstance(selector, FirstAlternative)
    try:
        if not lockstep:
            mission = realtime_mission(directory, setting, identity, store)
            return RealtimeSession(directory, mission, selector, learning, folder)
        if request.nodes == ONE_PROCESS:
            cell, party = lockstep_cell(directory, setting, script, None, store)
            return LockstepSession(party, selector, learning, folder, cell=cell, pace=request.pace)
        member, party = lockstep_member(directory, lockstep_mission(directory, setting, store))
        launched = directory if request.nodes == LAUNCHED else None
        return LockstepSession(
            party, selector, learning, folder, member=member, launched=launched, mock=request.mock
        )
    except BaseException:
        if store is not None and folder is not None:
            store.writer.close()
            shutil.rmtree(folder)
        raise


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
        timeline: Timeline | None,
        *,
        resumed: bool = False,
    ) -> None:
        """`timeline` already holds the recorded steps of a resumed run."""
        self.mission = mission
        self.selector = selector
        self.folder = folder
        self.identity = folder.name if folder is not None else mission.executor.mission
        self.timeline = timeline or Timeline()
        if timeline is None:
            mission.executor.observers.append(self.timeline)
        self.operation: Operation | None = None
        self.address: RunAddress | None = None
        """Where the run can be controlled; the address is in the run's folder while the run is
        active."""
        self.origin: Mapping[str, Any] = {}
        """The point of a recorded run at which this one started."""
        self._learning = learning
        self._learned: Mapping[str, Any] = {}
        self._resumed = resumed
        self._led = False
        self._first: tuple[Stimulus, ...] = ()
        self._begun = time.perf_counter()
        self._seconds = 0.0

    @abstractmethod
    def operate(
        self,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> Operation:
        """Let operators see and control it. `feed`, `controls` and `starts` as for `Operation`;
        `stops` are breakpoints, `choices` the alternatives that the operator fixed by primitive
        task, both from the start."""

    def _operated(
        self, operation: Operation, stops: Collection[str], choices: Mapping[str, str] | None
    ) -> Operation:
        fixed = (Override(primitive, action) for primitive, action in (choices or {}).items())
        self._first = (*((SetBreakpoints(tuple(sorted(stops))),) if stops else ()), *fixed)
        self.operation = operation
        return operation

    @abstractmethod
    async def connect(self) -> None:
        """Connect to every node. Raises UnreachableError (only in real time: in lock step the cell
        forms when it is led)."""

    async def lead(self, watch: Watch | None = None) -> None:
        """Run it to its end; even if it fails, what was learned is saved and the journal is closed.

        Raises MissionError, JournalError, ReplayError, CellError, LaunchError, EstimatesError.
        """
        self._led = True
        _log.info("run %s: started (%s, task %s)", self.identity, self.mode, self._task.name)
        try:
            address = self.folder is not None and self.address is not None
            with published(self.folder, self.address) if address else nullcontext():  # type: ignore[arg-type]
                await self._lead(watch)
        except BaseException as fault:
            _log.info("run %s: stopped by %s: %s", self.identity, type(fault).__name__, fault)
            raise
        finally:
            if self.operation is not None:
                await self.operation.close()
            await self._leave()
            self._close_journal()
            if self._learning is not None:
                self._learned = self._saved(self._learning)
            self._seconds = time.perf_counter() - self._begun
        _log.info("run %s: finished, %s", self.identity, self.result()["status"])

    async def abandon(self) -> None:
        """Give up a run that was not led: a new one leaves no folder, a resumed one stays as it
        was. Does nothing after `lead`."""
        if self._led:
            return
        self._led = True
        if self.operation is not None:
            await self.operation.close()
        await self._leave()
        self._close_journal()
        if self.folder is not None and not self._resumed:
            shutil.rmtree(self.folder, ignore_errors=True)

    def result(self) -> dict[str, Any]:
        """Return the result after `lead`; also of a run that failed."""
        origin = {"from": dict(self.origin)} if self.origin else {}
        return {**self.mission.result(self.mode, self._seconds), **self._learned, **origin}

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

    def _close_journal(self) -> None:
        store = self.mission.executor.store
        if isinstance(store, JournalStore):
            store.writer.close()

    def _saved(self, session: LearningSession) -> dict[str, Any]:
        """Save what it learned, also after an interruption; return the part of the result about
        it."""
        make_folder(session.setting.path.parent)
        counted = session.save(interrupted=self.mission.stage is not Stage.OVER)
        learning, values = session.learning, session.selector.context
        for name, action, measure in learning.uncosted():
            _log.warning(
                "%s: no run of %s reported %s, so its cost was taken as 0; correct `cost` in the "
                "task file or the name in the action's result", name, action, measure,
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
        begin: Callable[[float], None] | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        """`begin` makes a resumed mission continue."""
        super().__init__(mission, selector, learning, folder, timeline, resumed=begin is not None)
        self.shell = RealtimeMission(mission, directory, credentials_of(directory))
        self._begin = begin or mission.start

    def operate(
        self,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> Operation:
        """Let operators see and control it."""
        operation = Operation(self.shell, self.selector, feed, controls, starts=starts)
        return self._operated(operation, stops, choices)

    async def connect(self) -> None:
        """Connect to every node. Raises UnreachableError."""
        await self.shell.connect()

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


class LockstepSession(RunSession):
    """A run in lock step: its cell is in this process (`cell`), or this process is a `member`."""

    mode = LOCKSTEP

    def __init__(
        self,
        party: CoordinatorParty,
        selector: FirstAlternative,
        learning: LearningSession | None,
        folder: Path | None,
        *,
        cell: LockStepCell | None = None,
        pace: float = 0.0,
        member: Member | None = None,
        launched: Directory | None = None,
        mock: Path | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        """`launched`: the cell whose other members are to be launched, None if they wait."""
        resumed = timeline is not None or isinstance(party.mission.executor.store, RetracingStore)
        super().__init__(party.mission, selector, learning, folder, timeline, resumed=resumed)
        self.shell = None if cell is None else SlicedCell(cell, party, pace)
        self._party = party
        self._member = member
        self._launched = launched
        self._mock = mock

    def operate(
        self,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        stops: Collection[str] = (),
        choices: Mapping[str, str] | None = None,
    ) -> Operation:
        """Let operators see and control it, which is possible only for a cell in this process."""
        assert self.shell is not None
        operation = Operation(
            self.shell, self.selector, feed, controls, starts=starts, mode=LOCKSTEP
        )
        return self._operated(operation, stops, choices)

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
        """Do nothing: the cell forms when it is led."""

    async def _leave(self) -> None:
        """Do nothing: the cell has ended with the run."""

    async def _lead_cell(self, shell: SlicedCell) -> None:
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


class SlicedCell:
    """A lock-step cell in this process that ticks in slices of the event loop, at a pace, so that
    operators see and control the run as in real time.

    Nothing in lock step depends on the slices, the pace or the clients. While the net is paused and
    every node has answered, simulated time does not advance. Implements `commands.Shell`.
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
