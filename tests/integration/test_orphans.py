"""No process survives its parent: each parent is killed (kill -9) while its children hang with the
interpreter's lock held, and all children end."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import load
from petrobot.services.comm.protocol.messages import Call, Hello
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION
from tests.integration.test_resume_processes import nodes
from tests.ports import free_ports
from tests.processes import alive, below, children, kill
from tests.waiting import beat, until, wait_for

pytestmark = pytest.mark.processes
PATIENCE = 60.0
SERVICES = """
schema = 1
[nodes.motion]
host = "127.0.0.1"
port = {port}
[devices.servo]
node = "motion"
driver = "tests.integration.hanging:Stand"
period = 0.01
hangs = "{folder}/servo"
[devices.hand]
node = "motion"
driver = "tests.integration.hanging:Stand"
hangs = "{folder}/hand"
[services.quick]
node = "motion"
run = "tests.integration.hanging:hang_in_service"
[actions.with_servo]
run = "tests.integration.hanging:hang_in_action"
task = "hang"
device = "servo"
args = {{ mark = "{folder}/with_servo" }}
[actions.with_hand]
run = "tests.integration.hanging:hang_in_action"
task = "hang"
device = "hand"
args = {{ mark = "{folder}/with_hand" }}
[actions.alone]
run = "tests.integration.hanging:hang_in_action"
task = "hang"
node = "motion"
args = {{ mark = "{folder}/alone" }}
"""
ACTIONS = ("with_servo", "with_hand", "alone")


async def call(folder: Path, names: tuple[str, ...]) -> None:
    """Call these actions and services of the node, and wait until each reports that it hangs."""
    directory = load(folder / "services.toml")
    hello = Hello(
        OLDEST_VERSION, NEWEST_VERSION, "coordinator", "tester", "tester", 1, directory.hash
    )
    caller = Caller("motion", hello)
    client = Client(*directory.address("motion"), caller)
    client.start()
    assert await client.connected(PATIENCE)
    for name in names:
        arguments = (
            dict(directory.actions[name].args)
            if name in directory.actions
            else {"mark": str(folder / name)}
        )
        caller.call(client.now(), Call(f"tester/{name}", name, arguments, PATIENCE))
        client.flush()
        await until((folder / name).exists, f"the call of {name}")
    await client.close()
    await beat()


@contextmanager
def hanging_cell(folder: Path) -> Iterator[tuple[int, int]]:
    """Start `petrobot up` with a node whose servo process, device worker and other worker all hang;
    return both process ids."""
    (folder / "services.toml").write_text(
        SERVICES.format(port=free_ports(1)[0], folder=folder), encoding="utf-8"
    )
    launcher = nodes(folder)
    family = below(launcher.pid)
    try:
        [node] = children(launcher.pid)
        asyncio.run(call(folder, ACTIONS))
        (folder / "servo").touch()
        wait_for((folder / "servo.hung").exists, awaited="the hanging servo")
        yield launcher.pid, node
    finally:
        kill({launcher.pid, *family, *below(launcher.pid)})
        launcher.wait(PATIENCE)


def test_a_node_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    """Servo process, its worker, a worker with a device in it, and one without: all hang with the
    interpreter's lock held."""
    with hanging_cell(tmp_path) as (launcher, node):
        # stopped, so that it starts no other process and reaps none
        os.kill(launcher, signal.SIGSTOP)
        family = below(node)
        assert len(family) >= 2 * 4, "each of them has its keeper"
        os.kill(node, signal.SIGKILL)
        wait_for(lambda: not any(map(alive, family)), awaited=f"the end of {family}")


def test_a_launcher_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    """Its node hangs too, in a service in its event loop with the interpreter's lock held, so
    SIGTERM has no effect."""
    with hanging_cell(tmp_path) as (launcher, node):
        asyncio.run(call(tmp_path, ("quick",)))
        family = below(launcher)
        assert node in family and len(family) >= 1 + 2 * 4, "each worker has its keeper"
        os.kill(launcher, signal.SIGKILL)
        wait_for(lambda: not any(map(alive, family)), awaited=f"the end of {family}")


def test_a_lock_step_node_ends_with_its_launcher(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(
        SERVICES.format(port=free_ports(1)[0], folder=tmp_path), encoding="utf-8"
    )
    launcher = nodes(tmp_path, "--lockstep")
    family = below(launcher.pid)
    assert len(family) == 1
    os.kill(launcher.pid, signal.SIGKILL)
    launcher.wait(PATIENCE)
    wait_for(lambda: not any(map(alive, family)), awaited=f"the end of {family}")
