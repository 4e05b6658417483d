"""Messages about unreachable nodes: those that do not run must be launched with the location file
in use; those that refuse our key must not."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from petrobot.coordinator.launch import Setting, realtime_mission
from petrobot.coordinator.run.realtime import RealtimeMission, UnreachableError, credentials_of
from petrobot.coordinator.task import Task
from petrobot.services.comm.calls.callee import Callee
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.location_file import parse
from tests.ports import free_ports

NAMES = ("left", "right")


async def unreachable(task: Task, folder: Path, *refusing: str) -> str:
    """Return the message when no node runs except those in `refusing`, which have another key."""
    key = folder / "cell.key"
    key.write_text(os.urandom(32).hex(), encoding="utf-8")
    key.chmod(0o600)
    ports = dict(zip(NAMES, free_ports(len(NAMES)), strict=True))
    text = "schema = 1\n" + "".join(
        f'[nodes.{n}]\nhost = "127.0.0.1"\nport = {p}\n' for n, p in ports.items()
    )
    directory = parse(text + '[keys]\nfile = "cell.key"\n', folder / "my services.toml")
    servers = [Server(Callee(name, "b1", {}), key=os.urandom(32)) for name in refusing]
    for server in servers:
        await server.start("127.0.0.1", ports[server.callee.name])
    shell = RealtimeMission(
        realtime_mission(directory, Setting(task), "m1"), directory, credentials_of(directory)
    )
    with pytest.raises(UnreachableError) as fault:
        await shell.connect(2.0)
    await asyncio.gather(shell.close(), *(server.close() for server in servers))
    assert set(fault.value.nodes) == set(NAMES)
    return str(fault.value)


async def test_nodes_that_do_not_run_must_be_launched_with_the_file_in_use(
    catch_ball: Task, tmp_path: Path
) -> None:
    """A run may use another location file than the one in this folder."""
    said = await unreachable(catch_ball, tmp_path)
    assert f"`petrobot up --services '{tmp_path / 'my services.toml'}'`" in said
    assert "key" not in said.replace(str(tmp_path), "")


async def test_a_node_with_another_key_must_not_be_launched(
    catch_ball: Task, tmp_path: Path
) -> None:
    """It runs, so its remedy is about the key; the others must still be launched, each by itself:
    `up` would find the port of the one that runs in use."""
    launch, _, refused = (await unreachable(catch_ball, tmp_path, "left")).partition(
        "; not let in by "
    )
    assert refused.startswith("left at ") and "wrong_key" in refused and "keys.file of" in refused
    assert "petrobot up" not in refused
    assert (
        launch.startswith("no answer from right at ")
        and "left at" not in launch
        and "launch with `petrobot node right --services" in launch
        and "petrobot up" not in launch
    )
    assert "petrobot up" not in await unreachable(catch_ball, tmp_path, *NAMES)
