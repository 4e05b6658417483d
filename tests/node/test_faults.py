"""A device that follows a stream from another node stops when that node, or only its worker, is
killed or frozen."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.calls.caller import PeerLost
from petrobot.services.comm.calls.link import LinkTiming
from tests.node.test_processes import Nodes, Operator, operator_of, pids
from tests.processes import kill

pytestmark = pytest.mark.processes
PERIOD = 0.02
"""Period of the stream (s), as in the cell of test_processes."""


async def slide(operator: Operator) -> Mapping[str, Any]:
    """Return the state of the device that follows the stream."""
    answer = await operator.command("left", "status", "slide")
    state: Mapping[str, Any] = answer.data["devices"]["slide"]["state"]
    return state


@pytest.mark.parametrize(
    ("whom", "how"),
    [("worker", signal.SIGKILL), ("node", signal.SIGKILL), ("node", signal.SIGSTOP)],
    ids=["worker killed", "node killed", "node frozen"],
)
async def test_a_device_stops_when_the_sender_of_its_stream_is_lost(
    tmp_path: Path, whom: str, how: signal.Signals
) -> None:
    running = Nodes(tmp_path, "left", "right")
    try:
        async with operator_of(running.directory, "left", "right", timing=LinkTiming()) as operator:
            victims = [(await pids(operator, "right", "eye"))["actions"]]
            if whom == "node":
                victims.insert(0, running.processes["right"].pid)
            following = asyncio.create_task(operator.call("follow", seconds=60.0))
            # The set point moves faster than the device can follow, so the device stands still only
            # if it stopped.
            leading = asyncio.create_task(operator.call("lead", seconds=60.0, speed=1000.0))
            await operator.until(lambda: _counted(operator, 10))
            kill(victims, how)
            then = (await slide(operator))["cycles"]  # it has not read the last set point yet
            await operator.until(lambda: _older(operator, 4 * PERIOD, then + 4))
            stood = await slide(operator)
            await operator.until(lambda: _older(operator, 20 * PERIOD, then + 20))
            later = await slide(operator)
            assert later["position"] == stood["position"] and later["count"] == stood["count"]
            assert later["cycles"] > stood["cycles"], "its own process goes on, and holds"
            if whom == "node":
                await operator.heard(PeerLost)
                assert (await leading).executed == "unknown"
            leading.cancel()
            following.cancel()
            await asyncio.gather(leading, following, return_exceptions=True)
            if how is signal.SIGSTOP:
                kill(victims, signal.SIGCONT)
    finally:
        running.stop()


async def _counted(operator: Operator, least: int) -> bool:
    return bool((await slide(operator))["count"] >= least)


async def _older(operator: Operator, seconds: float, cycles: int) -> bool:
    state = await slide(operator)
    return bool(state["age"] >= seconds and state["cycles"] >= cycles)
