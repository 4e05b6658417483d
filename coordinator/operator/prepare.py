"""From the request for a mission run to its session: task, cell, journal and learning.

`prepare` makes a new run, `prepare_from` one that starts at a recorded point, `resume` one that
continues a run whose coordinator died. `coordinator/operator/session.py` leads what they make.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.launch import (
    RequestError,
    Setting,
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
    session_of,
)
from petrobot.coordinator.operator.commands import Shown
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.operator.session import (
    LOCKSTEP,
    REALTIME,
    LockstepSession,
    RealtimeSession,
    RunSession,
)
from petrobot.coordinator.operator.start_from import AGAIN, Recorded, departed, departing, departure
from petrobot.coordinator.run.folder import DEFAULT, JOURNAL, header
from petrobot.coordinator.run.interfaces import FirstAlternative, Observer
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.recording import JournalStore, RetracingStore, clock_reading
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import dumps
from petrobot.services.comm.location_file import FIRST_PHYSICS, Directory, physics_of, same_physics

SEED: Final = 1
ONE_PROCESS, LAUNCHED, JOINED = "one process", "launched", "joined"
"""Where the nodes of a lock-step cell run: in this process, in processes that the session launches
and ends, or in processes that are already waiting (`petrobot up --lockstep`)."""


class RecordedPoint(Struct, frozen=True):
    """A point of a recorded run from which a simulated run starts."""

    run: str
    record: int
    going: Mapping[str, str] | str = AGAIN
    """What happens to the runs that were active then: one word for all, or words by place."""


class RunRequest(Struct, frozen=True):
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
    ordered: float = math.inf
    """When the operator ordered it (`uptime`): in real time it does not start if an emergency stop
    was cleared since. Infinity: after everything."""


def prepare(
    request: RunRequest,
    task: Task,
    text: str,
    directory: Directory,
    observers: Sequence[Observer] = (),
) -> RunSession:
    """Make a new run of a task; `text` is the task file's. It may take seconds: it writes to the
    disk, and in lock step it loads the simulated cell.

    Raises EstimatesError or RequestError for what it cannot learn or replace, JournalError or
    OSError when its journal cannot be written, KeyFileError. No folder is left behind then.
    """
    _refuse_too_many(request.runs, task)
    seed = SEED if request.seed is None else request.seed
    learning = None
    physics, lockstep = _physics(directory), request.mode == LOCKSTEP
    plant = directory.plant(scripted=request.mock is not None, lockstep=lockstep)
    if request.learning is not None:
        declared = {a.name: a.compute_time for a in directory.actions.values()}
        setting = replace(
            request.learning,
            chosen=request.chosen,
            declared=declared if lockstep else None,
            physics=physics,
            plant=plant,
        )
        try:
            learning = LearningSession(task, setting, seed)
        except ValueError as fault:
            raise RequestError(str(fault)) from fault
    selector = FirstAlternative(request.chosen) if learning is None else learning.selector
    more = {} if learning is None else {"learning": learning.beginning()}
    made = _new(
        request,
        directory,
        Setting(task, request.parameters, request.runs, seed, selector),
        (text, directory.text),
        {"chosen": dict(request.chosen), **more},
        learning,
        observers,
    )
    made.plant = plant
    return made


def _refuse_too_many(runs: int | None, task: Task) -> None:
    """Raise RequestError if the place of the runs cannot hold that number of tokens, or the task
    has no such place."""
    place = task.places.get(task.runs_place)
    if place is None and (runs or 1) > 1:
        raise RequestError(
            f"runs: expected 1, found {runs}: {task.name} has no place that holds its runs; ask "
            "for one run, or name that place in task.runs_place of the task file"
        )
    most = None if place is None else place.capacity
    if runs is not None and most is not None and runs > most:
        raise RequestError(
            f"runs: expected at most {most}, the capacity of {task.runs_place!r}, found {runs}; "
            f"ask for fewer, or raise places.{task.runs_place}.capacity in the task file"
        )


def prepare_from(
    request: RunRequest, found: Recorded, observers: Sequence[Observer] = ()
) -> RunSession:
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
        observers,
    )
    made.plant = found.directory.plant(scripted=mock is not None, lockstep=True)
    made.origin = {"run": point.run, "record": point.record, "going": dict(point.going)}
    return made


def resume(found: Recorded, observers: Sequence[Observer], ordered: float) -> RunSession:
    """Continue a run whose coordinator was killed. A lock-step cell that ended with its coordinator
    is built again from its seed; nodes that wait for their coordinator are joined. `observers` see
    the recorded steps, too. `ordered` as for `RunRequest`.

    Raises EstimatesError, RequestError, JournalError, ReplayError, KeyFileError.
    """
    made = _resumed(found, observers, ordered)
    made.plant = found.plant
    return made


def _resumed(found: Recorded, observers: Sequence[Observer], ordered: float) -> RunSession:
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
        cell, party = lockstep_cell(found.directory, setting, script, store)
        return LockstepSession(
            party, selector, learning, folder, observers, cell=cell, resumed=True
        )
    replayed = [*observers, *([learning.selector] if learning is not None else [])]
    lockstep = then["mode"] == LOCKSTEP
    now = 0.0 if lockstep else time.monotonic()
    shown: list[Shown] = []

    def see(origin: float) -> Sequence[Observer]:
        shown.append(Shown(Feed(), found.task, found.directory, origin))
        shown[0].publisher.begin(then["mission"], REALTIME, starts=False)
        return shown[0].publisher, shown[0].trials

    mission, begin = resumed_mission(
        found.directory, found.task, found.engine, found.journal, replayed, now, selector, see
    )
    if lockstep:
        member, party = lockstep_member(found.directory, mission, begin)
        return LockstepSession(party, selector, learning, folder, member=member, resumed=True)
    return RealtimeSession(
        found.directory,
        mission,
        selector,
        learning,
        folder,
        begin=begin,
        shown=shown[0],
        ordered=ordered,
    )


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
    observers: Sequence[Observer],
) -> RunSession:
    """Make a new run; `texts` are those of the task file and of services.toml."""
    lockstep = request.mode == LOCKSTEP
    script = scripted_actions(request.mock, directory, setting.task)  # before a folder is made
    physics = _physics(directory)
    identity = mission_id(setting.task)
    folder = None if request.folder is None else request.folder / identity
    name = lockstep_id(setting) if lockstep else identity
    origin = 0.0 if lockstep else time.monotonic()
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
            return RealtimeSession(
                directory, mission, selector, learning, folder, observers, ordered=request.ordered
            )
        if request.nodes == ONE_PROCESS:
            cell, party = lockstep_cell(directory, setting, script, store)
            return LockstepSession(
                party, selector, learning, folder, observers, cell=cell, pace=request.pace
            )
        member, party = lockstep_member(directory, lockstep_mission(directory, setting, store))
        launched = directory if request.nodes == LAUNCHED else None
        return LockstepSession(
            party,
            selector,
            learning,
            folder,
            observers,
            member=member,
            launched=launched,
            mock=request.mock,
        )
    except BaseException:
        if store is not None and folder is not None:
            store.writer.close()
            shutil.rmtree(folder)
        raise
