"""A cell in one process: a node with an arm that arrives when the test lets it, over real sockets,
and a task with most features."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.services.action import Context, Result, success
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.device import Driver, Ports
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import Node
from tests.in_loop import NodeInLoop
from tests.ports import free_ports

SERVICES = """\
schema = 1
[nodes.robot]
host = "127.0.0.1"
port = {port}
[devices.arm]
node = "robot"
driver = "tests.cli.cell:Arm"
[streams.way]
to = "arm"
period = 0.02
[actions.reach]
run = "tests.cli.cell:reach"
task = "work"
device = "arm"
[actions.reach_slowly]
run = "tests.cli.cell:reach"
task = "work"
device = "arm"
[actions.recover]
run = "tests.cli.cell:recover"
task = "recover"
device = "arm"
"""

TASK = """\
schema = 1
[task]
name = "reaching"
goal = "the arm has reached as often as asked"
final = "jobs == 0 and arm_free == 1"
final_error = "out_of_order == 1"
runs_place = "jobs"
[primitive_tasks]
work = { goal = "the arm has reached", alternatives = ["reach", "reach_slowly"], deadline = 60.0 }
recover = { goal = "the arm is ready again", alternatives = ["recover"], deadline = 60.0 }
[events.part_there]
scope = "external"
memory = "latched"
[places]
jobs = { kind = "control", tokens = 2, capacity = 5 }
arm_free = { kind = "resource", tokens = 1, capacity = 1 }
work = { kind = "action" }
recover = { kind = "action" }
out_of_order = { kind = "control", capacity = 1 }
[transitions]
start = { in = ["jobs", "arm_free"], out = ["work"], event = "part_there" }
nothing_comes = { in = ["jobs", "arm_free"], out = ["arm_free"], after = 600.0 }
done = { in = ["work:normal"], out = ["arm_free"] }
failed = { in = ["work:error"], out = ["recover"] }
recovered = { in = ["recover:normal"], out = ["arm_free"] }
given_up = { in = ["recover:error"], out = ["out_of_order"] }
"""


class Arm(Driver):
    """A driver that reaches on an action's command, when the test lets it."""

    newest: Arm

    def __init__(self, config: Mapping[str, Any], ports: Ports | None) -> None:
        self.period: float | None = 0.004
        self.holdable = True
        self.moving = self.held = False
        self.reaches = 0
        self.quick_stops: list[float] = []
        self.sees = b""
        self.setpoint_age: float | None = None

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Begin to reach."""
        self.moving = True

    def arrive(self) -> None:
        """Let the arm arrive (called by the test)."""
        self.moving = False
        self.reaches += 1

    def step(self, now: float) -> None:
        """Do nothing: the test moves the arm."""

    def state(self) -> Mapping[str, Any]:
        """Return how often it has reached."""
        state = {"reaches": self.reaches, "moving": self.moving, "held": self.held, "q": [0.0, 1.5]}
        return state if self.setpoint_age is None else {**state, "setpoint_age": self.setpoint_age}

    def picture(self) -> Mapping[str, Any]:
        """Return the picture that the test has set."""
        return (
            {"mime": "image/png", "data": self.sees, "width": 2, "height": 1, "age": 0.5}
            if self.sees
            else {}
        )

    def stop(self, now: float) -> None:
        """Stop."""
        self.moving = False

    def quick_stop(self, now: float) -> None:
        """Stop at once."""
        self.moving = False
        self.quick_stops.append(now)

    def stopped(self) -> bool:
        """Return whether it stands still."""
        return not self.moving

    def hold(self, now: float) -> str:
        """Hold, if the test lets it."""
        self.held = self.holdable
        return "held" if self.holdable else "cannot hold"

    def release(self, now: float) -> None:
        """Continue."""
        self.held = False

    def close(self) -> None:
        """Release nothing."""


async def reach(ctx: Context) -> Result:
    """Reach once."""
    number = ctx.device.send({"reach": True})
    before = ctx.device.state["reaches"]
    await ctx.wait(lambda: ctx.device.handled >= number and ctx.device.state["reaches"] > before)
    return success()


async def recover(ctx: Context) -> Result:
    """Return at once."""
    return success()


class RobotNode(NodeInLoop):
    """The node, in this event loop."""

    def __init__(self, directory: Directory) -> None:
        self.directory = directory
        self.arm = Arm({}, None)
        clock = asyncio.get_running_loop().time
        place = InlineHost(directory.actions, clock=clock, driver=self.arm)
        node = Node(directory, "robot", boot="b1", clock=clock, places={"arm": place})
        super().__init__(node, directory.address("robot"))


def directory_in(folder: Path) -> Directory:
    """Return the cell's location file with a free port."""
    path = folder / "services.toml"
    path.write_text(SERVICES.format(port=free_ports(1)[0]), encoding="utf-8")
    return parse(path.read_text(encoding="utf-8"), path)
