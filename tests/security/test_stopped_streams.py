"""Set points do not move a device that is in emergency stop, and those of a run from before the
stop do not move it afterwards."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.run.node_status import ask_all
from petrobot.services.comm.location_file import Directory
from tests.node.test_processes import Nodes, operator_of, pids
from tests.processes import kill
from tests.waiting import Limit, beat

pytestmark = pytest.mark.processes
CELL = """\
schema = 1
nodes.left = {{ host = "127.0.0.1", port = {left} }}
nodes.right = {{ host = "127.0.0.1", port = {right} }}
devices.cart = {{ node = "left", driver = "cart:Cart" }}
streams.speed = {{ to = "cart", period = 0.05 }}
actions.drive = {{ run = "cart:drive", task = "drive", node = "right" }}
"""
CART = """\
from petrobot import Driver

class Cart(Driver):  # as docs/drivers.md shows it
    period = 0.01
    speed = at = 0.0

    def step(self, now):
        wish = self.ports.stream("speed").values
        self.speed = 0.0 if wish is None else wish[0]
        self.at += self.speed * self.period

    def stop(self, now):
        self.speed = 0.0

    def stopped(self):
        return self.speed == 0.0

    def state(self):
        return {"at": self.at}

async def drive(ctx):
    while True:
        ctx.publish("speed", [1.0])
        await ctx.sleep(0.02)
"""


async def position(directory: Directory) -> float:
    """Where the cart is, as soon as the process of its driver is ready."""
    limit = Limit("the state of the cart")
    while limit.left():
        told = (await ask_all(directory, 5.0))["left"].get("status") or {"devices": {"cart": {}}}
        if state := told["devices"]["cart"].get("state"):  # none while the process starts
            return float(state["at"])
        await beat(0.05)
    raise AssertionError


async def moves(directory: Directory) -> bool:
    """Whether the cart moves, within several periods of its stream."""
    before = await position(directory)
    await beat(0.3)
    return await position(directory) != before


async def until_it_moves(directory: Directory) -> None:
    limit = Limit("a cart that moves")
    while not await moves(directory) and limit.left():
        pass


async def test_a_cart_that_follows_set_points_stands_still_until_a_new_run(tmp_path: Path) -> None:
    """The run that sends them is on a node without devices, which the stop does not reach, and its
    coordinator may be frozen."""
    (tmp_path / "cart.py").write_text(CART)
    nodes = Nodes(tmp_path, "left", "right", text=CELL)
    estop = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        async with operator_of(nodes.directory, "right") as operator:
            driving = asyncio.create_task(operator.call("drive"))
            await until_it_moves(nodes.directory)
            assert await asyncio.to_thread(main, estop) == 0
            assert not await moves(nodes.directory), "in emergency stop"
            assert await asyncio.to_thread(main, [*estop, "--clear"]) == 0
            assert not await moves(nodes.directory), "by a run from before the stop"
            assert not driving.done()
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)
        async with operator_of(nodes.directory, "right") as operator:
            driving = asyncio.create_task(operator.call("drive"))
            await until_it_moves(nodes.directory)
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)
    finally:
        nodes.stop()


@pytest.mark.parametrize("what", ["the driver's process", "its node"])
async def test_a_process_that_starts_after_a_stop_was_cleared_bars_the_runs_from_before(
    tmp_path: Path, what: str
) -> None:
    """What the former process had seen must not be forgotten with it."""
    (tmp_path / "cart.py").write_text(CART)
    nodes = Nodes(tmp_path, "left", "right", text=CELL)
    estop = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        async with operator_of(nodes.directory, "left", "right") as operator:
            driving = asyncio.create_task(operator.call("drive"))
            await until_it_moves(nodes.directory)
            assert await asyncio.to_thread(main, estop) == 0
            assert await asyncio.to_thread(main, [*estop, "--clear"]) == 0
            if what == "its node":
                nodes.restart("left")
            else:
                former = (await pids(operator, "left", "cart"))["driver"]
                kill([former])
                limit = Limit("a new process")
                while (await pids(operator, "left", "cart")).get("driver") in (None, former):
                    limit.left()
                    await beat(0.05)
            for _ in range(3):  # the sender asks for the new address every 0.25 s
                assert not await moves(nodes.directory), "by a run from before the stop"
            assert not driving.done()
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)
            driving = asyncio.create_task(operator.call("drive"))
            await until_it_moves(nodes.directory)
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)
    finally:
        nodes.stop()
