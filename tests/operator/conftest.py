"""A station with two nodes in this process whose actions follow a script."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

import pytest_asyncio

from petrobot.coordinator.operator.station import Station
from petrobot.coordinator.page.task_store import TaskStore
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import GENERAL, Node
from petrobot.services.scripted import load
from tests.in_loop import NodeInLoop
from tests.ports import free_ports
from tests.waiting import until

SERVICES = """\
schema = 1
[nodes.vision]
host = "127.0.0.1"
port = {0}
[nodes.arm]
host = "127.0.0.1"
port = {1}
[actions.look_at_table]
run = "tests.operator.toys:move"
task = "look"
node = "vision"
args = {{ patience = 2.0 }}
[actions.look_twice]
run = "tests.operator.toys:move"
task = "look"
node = "vision"
[actions.pick_part]
run = "tests.operator.toys:move"
task = "pick"
node = "arm"
[actions.put_part]
run = "tests.operator.toys:move"
task = "put"
node = "arm"
"""
SCRIPT = """\
schema = 1
[actions.look_at_table]
seconds = 0.05
[actions.look_twice]
seconds = 0.05
[[actions.pick_part]]
status = "error"
cause = "slipped"
text = "the part slipped out of the gripper"
seconds = 0.05
[[actions.pick_part]]
seconds = 0.05
[actions.put_part]
seconds = 0.05
"""
TASK = """\
schema = 1
[task]
name = "moving"
goal = "every part has been looked at and picked"
final = "jobs == 0 and arm_free == 1"
runs_place = "jobs"
[primitive_tasks.look]
goal = "seen"
alternatives = ["look_at_table", "look_twice"]
deadline = 5.0
[primitive_tasks.pick]
goal = "picked"
alternatives = ["pick_part"]
deadline = 5.0
[task.parameters]
speed = 0.5
[places.jobs]
kind = "control"
tokens = 2
capacity = 9
[places.arm_free]
kind = "resource"
tokens = 1
capacity = 1
[places.look]
kind = "action"
task = "look"
[places.pick]
kind = "action"
task = "pick"
[transitions.begin]
in = ["jobs", "arm_free"]
out = ["look"]
[transitions.seen]
in = ["look:normal"]
out = ["pick"]
[transitions.unseen]
in = ["look:error"]
out = ["arm_free"]
[transitions.picked]
in = ["pick:normal"]
out = ["arm_free"]
[transitions.slipped]
in = ["pick:error"]
out = ["arm_free"]
"""


def toy_node(
    directory: Directory, name: str, script: Mapping[str, Callable[..., Any]]
) -> NodeInLoop:
    """Run a node in this event loop."""
    clock = asyncio.get_running_loop().time
    place = InlineHost(directory.actions, clock=clock, substitutes=script)
    node = Node(directory, name, boot=f"{name} 1", clock=clock, places={GENERAL: place})
    return NodeInLoop(node, directory.address(name))


class Cell:
    """A station, its nodes and one operator."""

    def __init__(self, folder: Path, script: str = SCRIPT) -> None:
        path = folder / "services.toml"
        path.write_text(SERVICES.format(*free_ports(2)), encoding="utf-8")
        (folder / "script.toml").write_text(script, encoding="utf-8")
        scripted = load(folder / "script.toml")
        self.directory = parse(path.read_text(encoding="utf-8"), path)
        self.nodes = {
            name: toy_node(self.directory, name, scripted) for name in self.directory.nodes
        }
        self.tasks = TaskStore(folder / "tasks")
        self.tasks.save_text("moving", None, TASK)
        self.runs = folder / "runs"
        self.station = Station(self.directory, self.tasks, self.runs)

    @property
    def state(self) -> dict[str, Any]:
        """Return the state that clients see."""
        return self.station.feed.state

    async def say(self, verb: str, **data: Any) -> dict[str, Any]:
        """Give a command as the operator."""
        return await self.station.command("ana", verb, data)

    async def ended(self) -> Mapping[str, Any]:
        """Wait for the end of the run; return its result."""
        await until(lambda: self.state["result"] is not None)
        return self.state["result"]  # type: ignore[no-any-return]


@pytest_asyncio.fixture
async def cell(tmp_path: Path) -> AsyncIterator[Cell]:
    """A cell with active nodes and an operator who holds the controls."""
    made = Cell(tmp_path)
    for node in made.nodes.values():
        await node.start()
    await made.station.look()
    await made.say("take_controls")
    yield made
    await made.station.close()
    for node in made.nodes.values():
        await node.close()
