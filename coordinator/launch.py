"""The composition root: puts coordinator, nodes and laboratory together. The rooms are loaded by import path."""

from __future__ import annotations

import importlib
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from coordinator.engine import Engine
from coordinator.executor import Executor, FirstAlternative, Selector
from coordinator.lockstep_party import NAME, CoordinatorParty
from coordinator.mission import Mission
from coordinator.supervisor import Program, is_local, laboratory_program, node_program
from coordinator.task import Task
from services.comm.caller import Caller
from services.comm.cell import Cell, Delays
from services.comm.directory import Directory, NodeEntry
from services.comm.lockstep import Member
from services.comm.messages import Hello
from services.comm.party import Party
from services.comm.wire import NEWEST_VERSION, OLDEST_VERSION

NODE_PARTY = "services.lockstep_node:LockstepNode"
SCRIPTED = "services.scripted:load"

Substitutes = Mapping[str, Callable[..., Any]]


@dataclass(frozen=True)
class Setting:
    """What a mission run is given: the task with its parameters, runs and seed, and who selects actions."""

    task: Task
    parameters: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    seed: int = 1
    selector: Selector = field(default_factory=FirstAlternative)


def load_object(path: str) -> Any:
    """The object at an import path "module:name"."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def prepared_task(setting: Setting) -> tuple[Task, int]:
    """The task with its number of runs put into the runs place; gives that number too."""
    task = setting.task
    place = task.places.get(task.runs_place) if task.runs_place else None
    if place is None:
        return task, 1
    runs = place.tokens if setting.runs is None else setting.runs
    capacity = None if place.capacity is None else max(place.capacity, runs)
    return replace(task, places={**task.places, place.name: replace(place, tokens=runs, capacity=capacity)}), runs


def make_mission(directory: Directory, setting: Setting, mission: str, boot: str) -> Mission:
    """A mission run with a caller for each node of the directory."""
    task, runs = prepared_task(setting)
    hello = Hello(OLDEST_VERSION, NEWEST_VERSION, "coordinator", NAME, boot, 1, directory.hash)
    callers = {node: Caller(node, hello) for node in directory.nodes}
    devices = {a.name: a.device for a in directory.actions.values() if a.device}
    engine = Engine(task, devices)
    executor = Executor(task, engine, directory, callers, mission, setting.seed, setting.selector)
    return Mission(executor, {**task.parameters, **setting.parameters}, runs)


# --- lock step ---------------------------------------------------------------------------------------------------------


def lockstep_mission(directory: Directory, setting: Setting) -> Mission:
    """A mission run whose ids depend on task and seed alone, so that the same seed gives the same run."""
    return make_mission(directory, setting, f"{setting.task.name}/{setting.seed}", "lock step")


def lockstep_party(directory: Directory, node: NodeEntry, substitutes: Substitutes | None = None) -> Party:
    """The party of a node: a laboratory's own, or a node with its drivers and actions inline."""
    if node.sim:
        party: Party = load_object(node.sim)(directory, node.name)
        return party
    return load_object(NODE_PARTY)(directory, node.name, substitutes=substitutes)  # type: ignore[no-any-return]


def lockstep_cell(
    directory: Directory,
    setting: Setting,
    substitutes: Substitutes | None = None,
    watch: Callable[[Mission, float], None] | None = None,
) -> tuple[Cell, CoordinatorParty]:
    """The whole cell in this process."""
    mission = lockstep_mission(directory, setting)
    watching = None if watch is None else lambda now: watch(mission, now)
    coordinator = CoordinatorParty(directory, mission, watching)
    parties = [lockstep_party(directory, node, substitutes) for node in directory.nodes.values()]
    return Cell([coordinator, *parties], Delays(directory.delays())), coordinator


def lockstep_member(
    directory: Directory, setting: Setting, watch: Callable[[Mission, float], None] | None = None
) -> tuple[Member, CoordinatorParty]:
    """The coordinator's process of a cell in which each node has a process of its own."""
    mission = lockstep_mission(directory, setting)
    watching = None if watch is None else lambda now: watch(mission, now)
    coordinator = CoordinatorParty(directory, mission, watching)
    listener = socket.create_server(("127.0.0.1", 0))
    addresses = {node: directory.address(node) for node in directory.nodes} | {NAME: listener.getsockname()[:2]}
    delays = Delays(directory.delays())
    return Member(NAME, [coordinator], addresses, delays=delays, directory=directory.hash, listener=listener), coordinator


# --- real time ---------------------------------------------------------------------------------------------------------


def realtime_mission(directory: Directory, setting: Setting) -> Mission:
    """A mission run with an id of its own: nodes never take its calls for those of an earlier one."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return make_mission(directory, setting, f"{setting.task.name}-{stamp}-{secrets.token_hex(3)}", secrets.token_hex(8))


def local_programs(directory: Directory, *, lockstep: bool = False, source: Path | None = None) -> list[Program]:
    """The command lines of the nodes whose address is this host's, the laboratory first."""
    services = source or directory.source
    local = sorted((n for n in directory.nodes.values() if is_local(n.host)), key=lambda node: not node.sim)
    launch: Mapping[bool, Callable[..., Program]] = {True: laboratory_program, False: node_program}
    return [launch[bool(node.sim)](node.name, services, lockstep=lockstep) for node in local]
