"""Asking nodes for their status: each answers, whether or not the others do."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from petrobot.coordinator.run.node_status import ask_all
from petrobot.services.comm.calls.callee import Callee
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.location_file import parse
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import GENERAL, Node
from tests.in_loop import NodeInLoop
from tests.ports import free_ports

PLACES = """\
schema = 1
[nodes.mute]
host = "127.0.0.1"
port = {0}
[nodes.well]
host = "127.0.0.1"
port = {1}
"""


@pytest.mark.parametrize("mute_is_up", [True, False])
async def test_a_node_that_does_not_answer_does_not_hide_the_others(
    tmp_path: Path, mute_is_up: bool
) -> None:
    directory = parse(PLACES.format(*free_ports(2)), tmp_path / "services.toml")
    clock = asyncio.get_running_loop().time
    place = InlineHost(directory.actions, clock=clock)
    node = Node(directory, "well", boot="well 1", clock=clock, places={GENERAL: place})
    well = NodeInLoop(node, directory.address("well"))
    mute = Server(Callee("mute", "mute 1", {}))  # accepts connections, and never answers a message
    await well.start()
    if mute_is_up:
        await mute.start(*directory.address("mute"))
    answers = await ask_all(directory, 1.0)
    await well.close()
    if mute_is_up:
        await mute.close()
    assert not answers["mute"]["up"]
    assert ("did not say how it is within 1 s" if mute_is_up else "connection refused") in answers[
        "mute"
    ]["why"]
    assert answers["well"]["up"] and answers["well"]["status"]
