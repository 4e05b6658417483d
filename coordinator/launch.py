"""The composition root: puts coordinator, nodes and laboratory together. The rooms are loaded by
import path."""

from __future__ import annotations

import importlib
import secrets
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import compress
from pathlib import Path
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine import Engine, Point
from petrobot.coordinator.run.executor import Executor
from petrobot.coordinator.run.folder import NODE_LOGS
from petrobot.coordinator.run.interfaces import (
    FirstAlternative,
    Forgetful,
    Observer,
    Selector,
    Store,
)
from petrobot.coordinator.run.journal import Journal, JournalWriter
from petrobot.coordinator.run.lockstep import NAME, CoordinatorParty
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.recording import (
    EPOCH,
    JournalStore,
    as_recorded,
    last_epoch,
    origin_of,
    replay,
    stages,
)
from petrobot.coordinator.run.supervisor import Program, Supervisor, is_local
from petrobot.coordinator.task import Scope, Task
from petrobot.coordinator.task.wording import nearest
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.location_file import Directory, NodeEntry, module_name
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from petrobot.services.comm.lockstep.mesh import Member, cell_key
from petrobot.services.comm.lockstep.party import Party
from petrobot.services.comm.protocol.messages import Hello
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION
from petrobot.services.host.toml_text import InputError, key_lines, line_of

NODE_PARTY = "petrobot.services.node.lockstep:LockstepNode"
SCRIPTED = "petrobot.services.scripted:load"

Substitutes = Mapping[str, Callable[..., Any]]


class Setting(Struct, frozen=True):
    """What a mission run is given: the task with its parameters, runs and seed, and who selects
    actions."""

    task: Task
    parameters: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    seed: int = 1
    selector: Selector = field(default_factory=FirstAlternative)
    point: Point | None = None
    """Where a simulated run sets out, if not at the task's beginning."""


class RequestError(InputError, ValueError):
    """A run cannot be made as it was asked for: which part of the request, and what to do."""


def load_object(path: str) -> Any:
    """The object at an import path "module:name". Raises ImportError, AttributeError."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module_name(module)), name)


def scripted_actions(
    mock: Path | None, directory: Directory, task: Task | None = None
) -> Substitutes | None:
    """The actions of a script (`--mock`), None without one. Raises RequestError for a file that
    cannot be used, that names an action that the cell does not have, or that raises an event that
    the `task` does not expect from its action."""
    if mock is None:
        return None
    try:
        scripted: Mapping[str, Any] = load_object(SCRIPTED)(mock)
    except OSError as fault:
        raise RequestError(f"{mock}: {fault.strerror}; give a file of scripted actions") from fault
    except Exception as fault:
        raise RequestError(str(fault)) from fault
    for name, script in scripted.items():
        what = ""
        if name not in directory.actions:
            what = f"{directory.source} has no such action{nearest(name, directory.actions)}"
            what += "; name one of its actions, or remove it here"
        elif task is not None:
            what = "; ".join(filter(None, (_not_its_own(task, name, e) for e in script.events)))
        if what:
            key = f"actions.{name}"
            line = line_of(key, key_lines(mock.read_text(encoding="utf-8")))
            raise RequestError(f"{mock}:{line}: {key}: {what}")
    return scripted


def _not_its_own(task: Task, action: str, name: str) -> str:
    """Return why an event of the task would be ignored if a run of the action raised it."""
    event = task.flat.events.get(name)
    users = [p.name for p in task.primitive_tasks.values() if action in p.alternatives]
    if event is None or not users or event.by in users:
        return ""
    if event.scope is Scope.EXTERNAL:
        remedy = "let a driver or a timer raise it, or `petrobot raise`; remove it here"
        return f"{name!r} is an external event of {task.name}, which no action raises; {remedy}"
    return f"{name!r} is an event of {event.by}, which does not have this action; remove it here"


def with_runs(task: Task, runs: int | None) -> tuple[Task, int]:
    """The task with `runs` tokens in its runs place (None: as the file says); gives that
    number too. A recorded expansion gets them as well."""
    place = task.places.get(task.runs_place) if task.runs_place else None
    if place is None:
        return task, 1
    runs = place.tokens if runs is None else runs
    capacity = None if place.capacity is None else max(place.capacity, runs)
    return replace(
        task,
        places={**task.places, place.name: replace(place, tokens=runs, capacity=capacity)},
        expansion=task.expansion and with_runs(task.expansion, runs)[0],
    ), runs


def make_mission(
    directory: Directory,
    setting: Setting,
    mission: str,
    boot: str,
    store: Store | None = None,
    name: str = NAME,
) -> Mission:
    """A mission run with a caller for each node of the directory; `name` is how its coordinator is
    known to them."""
    task, runs = with_runs(setting.task, setting.runs)
    callers = make_callers(directory, boot, 1, name)
    devices = {a.name: a.device for a in directory.actions.values() if a.device}
    engine = Engine(task, devices)
    executor = Executor(
        task,
        engine,
        directory,
        callers,
        mission,
        setting.seed,
        setting.selector,
        store or Forgetful(),
    )
    if isinstance(setting.selector, Observer):
        executor.observers.append(setting.selector)
    made = Mission(executor, {**task.parameters, **setting.parameters}, runs)
    made.point = setting.point
    return made


def make_callers(
    directory: Directory, boot: str, epoch: int, name: str = NAME
) -> dict[str, Caller]:
    """A caller for each node, all introduced as the coordinator of this name in this epoch."""
    hello = Hello(OLDEST_VERSION, NEWEST_VERSION, "coordinator", name, boot, epoch, directory.hash)
    return {node: Caller(node, hello) for node in directory.nodes}


# --- lock step --------------------------------------------------------------------------------


def lockstep_id(setting: Setting) -> str:
    """The id of a mission run in lock step: it depends on task and seed alone, so that the same
    seed gives the same run."""
    return f"{setting.task.name}/{setting.seed}"


def lockstep_mission(directory: Directory, setting: Setting, store: Store | None = None) -> Mission:
    """A mission run in lock step."""
    return make_mission(directory, setting, lockstep_id(setting), "lock step", store)


def lockstep_party(
    directory: Directory, node: NodeEntry, substitutes: Substitutes | None = None
) -> Party:
    """The party of a node: a laboratory's own, or a node with its drivers and actions inline.
    Raises RequestError for a laboratory that cannot be made."""
    if node.sim:
        try:
            party: Party = load_object(node.sim)(directory, node.name)
        except (ValueError, OSError) as fault:
            raise RequestError(f"{directory.source}: nodes.{node.name}: {fault}") from fault
        return party
    return load_object(NODE_PARTY)(directory, node.name, substitutes=substitutes)  # type: ignore[no-any-return]


def lockstep_cell(
    directory: Directory,
    setting: Setting,
    substitutes: Substitutes | None = None,
    store: Store | None = None,
) -> tuple[LockStepCell, CoordinatorParty]:
    """The whole cell in this process."""
    coordinator = CoordinatorParty(directory, lockstep_mission(directory, setting, store))
    parties = [lockstep_party(directory, node, substitutes) for node in directory.nodes.values()]
    return LockStepCell([coordinator, *parties], Delays(directory.delays())), coordinator


def lockstep_member(
    directory: Directory,
    mission: Mission,
    begin: Callable[[float], None] | None = None,
) -> tuple[Member, CoordinatorParty]:
    """The coordinator's process of a cell in which each node has a process of its own.

    With `begin` it joins an active cell in place of a coordinator that died; `begin` is called
    first.
    """
    coordinator = CoordinatorParty(directory, mission, begin)
    member = Member(
        NAME,
        [coordinator],
        directory.members(),
        delays=Delays(directory.delays()),
        directory=directory.hash,
        key=cell_key(directory),
        rejoins=begin is not None,
    )
    return member, coordinator


# --- real time --------------------------------------------------------------------------------


def mission_id(task: Task) -> str:
    """An id of its own for a mission run: nodes never take its calls for those of an earlier
    one."""
    return f"{task.name}-{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"


def realtime_mission(
    directory: Directory, setting: Setting, mission: str, store: Store | None = None
) -> Mission:
    """A mission run on the wall clock. Its coordinator goes by the mission's own id: so its epochs
    count resumes of this run alone, what nodes keep for it is never taken for another's, and a
    second coordinator is another holder of leases."""
    return make_mission(directory, setting, mission, secrets.token_hex(8), store, name=mission)


def resumed_mission(
    directory: Directory,
    task: Task,
    engine: Engine,
    journal: Journal,
    observers: Sequence[Observer],
    now: float,
    selector: Selector | None = None,
    see: Callable[[float], Sequence[Observer]] = lambda origin: (),
) -> tuple[Mission, Callable[[float], None]]:
    """Return a mission run as its journal left it, and the function that continues it once the
    nodes are connected.

    A selector that learns has to be among the observers too: the recorded steps bring it to where
    it was. `see` makes further observers from the origin of the journal's clock. Raises ReplayError
    when the engine does not derive what the journal says.
    """
    header = journal.header
    engine = as_recorded(engine, header)
    writer = JournalWriter(journal.path)
    journal = writer.found  # as it is now that no other process can write it
    epoch = last_epoch(journal) + 1
    try:
        steps = list(replay(journal, engine))
        origin = origin_of(header, now, steps[-1].time if steps else 0.0)
        writer.append(EPOCH, {"t": round(now - origin, 6), "epoch": epoch})
        writer.sync()
    except BaseException:
        writer.close()
        raise
    name = NAME if header["mode"] == "lockstep" else header["mission"]
    callers = make_callers(directory, secrets.token_hex(8), epoch, name)
    store, chosen = (
        JournalStore(writer, origin, durable=header.get("durable", False)),
        selector or FirstAlternative(),
    )
    executor = Executor(
        task, engine, directory, callers, header["mission"], header["seed"], chosen, store
    )
    mission = Mission(executor, header["parameters"], header["runs"])
    executor.observers.extend([*observers, *see(origin)])
    for step in steps:
        mission.replay(origin + step.time, step)
    return mission, lambda now: mission.resume(now, stages(journal))


def local_programs(
    directory: Directory,
    *,
    lockstep: bool = False,
    mock: Path | None = None,
    awaited: float = 0.0,
    log_level: str = "info",
) -> list[Program]:
    """The command lines of the nodes whose address is this host's, the laboratory first.

    In lock step they wait `awaited` seconds (wall time) for a coordinator that died.
    """
    nodes = sorted(directory.nodes.values(), key=lambda node: not node.sim)
    with ThreadPoolExecutor(32) as lookups:  # all at once: a name server may not answer
        here = lookups.map(is_local, [node.host for node in nodes])
        local = list(compress(nodes, here))
    options = ["--services", str(directory.source), *(["--lockstep"] if lockstep else [])]
    options += ["--await-coordinator", str(awaited)] if lockstep and awaited else []
    options += ["--log-level", log_level, *(["--dry-run"] if directory.dry_run else [])]
    own = ["--mock", str(mock)] if mock else []
    return [
        Program(node.name, [sys.executable, "-m", "petrobot.sim", *options], first=True)
        if node.sim
        else Program(
            node.name, [sys.executable, "-m", "petrobot.services", node.name, *options, *own]
        )
        for node in local
    ]


def local_nodes(
    directory: Directory,
    logs: Path = NODE_LOGS,
    *,
    lockstep: bool = False,
    mock: Path | None,
    respawn: bool = True,
) -> Supervisor:
    """Launch the nodes of this host while the context lasts; each writes to its log in `logs`."""
    programs = local_programs(directory, lockstep=lockstep, mock=mock)
    return Supervisor(programs, logs, respawn=respawn)
