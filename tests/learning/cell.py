"""The sorting task in a cell of scripted actions: one node that offers every alternative."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from petrobot.coordinator.engine import Stimulus
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.run.interfaces import FirstAlternative, Store
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import load
from petrobot.services.action import Status
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.scripted import Scripted, ScriptedRun

TASK_FILE = Path(__file__).parent / "sorting.toml"
HEAD = """
schema = 1
[nodes.node]
host = "127.0.0.1"
port = 7998
[timers.go]
node = "node"
period = 0.04
[timers.jam]
node = "node"
period = 1.24
[services.memory]
node = "node"
"""
WEIGHT = {"weight": 1.5}
LINES = {
    "pick_fast": [
        ScriptedRun(Status.ERROR, (0.1, 0.1), cause="slipped"),
        ScriptedRun(seconds=(0.1, 0.1), values=WEIGHT),
        ScriptedRun(Status.FAILURE, (0.1, 0.1), WEIGHT, "crooked"),
    ],
    "pick_slow": [ScriptedRun(seconds=(0.3, 0.4), values=WEIGHT)],
    "pick_blind": [ScriptedRun(Status.ERROR, (0.2, 0.2), cause="missed")],
    "place_soft": [
        ScriptedRun(seconds=(0.2, 0.5), values={"tries": 2, "note": "soft", "sure": True})
    ],
    "place_hard": [ScriptedRun(seconds=(0.2, 0.3), values={"tries": 1})],
}


def sorting() -> Task:
    """The task."""
    return load(TASK_FILE)


def directory(task: Task) -> Directory:
    """A directory with every alternative on one node."""
    actions = "".join(
        f'[actions.{a}]\nrun = "scripted:nothing"\ntask = "{p.name}"\nnode = "node"\n'
        for p in task.primitive_tasks.values()
        for a in p.alternatives
    )
    return parse(HEAD + actions, Path("services.toml"))


def scripts() -> dict[str, Callable[..., Any]]:
    """Return what each action does."""
    return {name: Scripted(lines) for name, lines in LINES.items()}


def run(
    task: Task,
    selector: LearningSelector | None = None,
    *,
    runs: int = 3,
    seed: int = 1,
    parameters: Mapping[str, Any] | None = None,
    store: Store | None = None,
    first: Sequence[Stimulus] = (),
) -> Mission:
    """Run to the end, at most an hour of simulated time; `first` holds the operator's commands
    before the start."""
    setting = Setting(task, parameters or {}, runs, seed, selector or FirstAlternative())
    cell, party = lockstep_cell(directory(task), setting, scripts())
    if store is not None:
        party.mission.executor.store = store
    party.mission.executor.stimulate(0.0, *first)
    assert cell.run(lambda: party.over, 900_000)
    return party.mission
