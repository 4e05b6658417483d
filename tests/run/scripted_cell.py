"""A cell of scripted actions for tests of the coordinator: one node, no devices, every action of a
task on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.scripted import Scripted, ScriptedRun

HEAD = """
schema = 1
[nodes.node]
host = "127.0.0.1"
port = 7999
[timers.image_tick]
node = "node"
period = 0.04
[services.memory]
node = "node"
"""


def directory_for(task: Task, extra: str = "", every: bool = False) -> Directory:
    """Return the directory of `services_text`."""
    return parse(services_text(task, every) + extra, Path("services.toml"))


def services_text(task: Task, every: bool = False) -> str:
    """Return a services.toml that places the first alternative of each primitive task on one node,
    or all alternatives."""
    return HEAD + "".join(
        f'[actions.{alternative}]\nrun = "scripted:nothing"\ntask = "{p.name}"\nnode = "node"\n'
        for p in task.primitive_tasks.values()
        for alternative in p.alternatives[: None if every else 1]
    )


def scripts(task: Task, lines: Mapping[str, list[ScriptedRun]]) -> dict[str, Callable[..., Any]]:
    """Return a scripted action for every alternative of each primitive task; by default, success
    after half a second."""
    usual = [ScriptedRun(seconds=(0.5, 0.5))]
    return {
        a: Scripted(lines.get(p.name, usual))
        for p in task.primitive_tasks.values()
        for a in p.alternatives
    }
