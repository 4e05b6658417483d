"""A laboratory in wall-clock time for tests: free ports, callers, `python -m petrobot.sim` as a
process, a party that reads its score."""

from __future__ import annotations

import asyncio
import itertools
import os
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import Directory, load
from petrobot.services.comm.lockstep.cell import Delays
from petrobot.services.comm.lockstep.mesh import Member
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.protocol.messages import Call, Hello, Outcome
from petrobot.sim.realtime import LaboratoryShell
from tests.ports import free_ports

REPOSITORY = Path(__file__).parents[2]
NUMBERS = itertools.count(1)
PATIENCE = 60.0
"""Longest wait (s of wall time) on a busy machine."""


def laboratory_file(folder: Path, sim: str, parameters: str) -> Path:
    """Write a location file with free ports: a laboratory, and the node of a robot with a device on
    the laboratory's bus and one on its camera."""
    node, bus, camera, coordinator = free_ports(4)
    file = folder / "services.toml"
    file.write_text(f"""\
schema = 1
[nodes.laboratory]
host = "127.0.0.1"
port = {node}
sim = "{sim}"
[nodes.robot]
host = "127.0.0.1"
port = {coordinator}
[devices.drives]
node = "robot"
driver = "nowhere:Drives"
interface = "petrobot_stream"
channel = "tcp://127.0.0.1:{bus}"
[devices.eye]
node = "robot"
driver = "nowhere:Eye"
source = "sim"
address = "127.0.0.1:{camera}"
[services.laboratory_prepare]
node = "laboratory"
[services.laboratory_score]
node = "laboratory"
[services.laboratory_fault]
node = "laboratory"
[parameters]
{parameters}
""")
    return file


async def until(holds: Callable[[], bool]) -> None:
    """Check the condition every 2 ms."""
    pause = threading.Event()
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.to_thread(pause.wait, 0.002)


@asynccontextmanager
async def running(file: Path) -> AsyncIterator[LaboratoryShell]:
    """The laboratory of a location file in this process."""
    shell = LaboratoryShell(load(file), "laboratory")
    await shell.start()
    yield shell
    await shell.close()


async def call(address: tuple[str, int], service: str, **arguments: Any) -> Outcome:
    """Call a service under a new caller name, because the calls of each name and boot count from
    1."""
    caller = Caller("laboratory", Hello(2, 99, "client", f"test {next(NUMBERS)}", "boot"))
    client = Client(*address, caller, on_notices=lambda now, notices: None)
    client.start()
    try:
        async with asyncio.timeout(PATIENCE):
            return await client.call(service, arguments, deadline=PATIENCE)
    finally:
        await client.close()


def program(*arguments: str) -> subprocess.Popen[str]:
    """`python -m petrobot.sim` with these arguments."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "petrobot.sim", *arguments]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=REPOSITORY,
    )


class Looker:
    """A party that makes some calls, ends the cell when all are answered, and keeps the answer of
    the last one, the score."""

    name = "coordinator"

    def __init__(self, calls: Sequence[Call]) -> None:
        self.score: dict[str, Any] = {}
        self._last = calls[-1].id
        self._out: list[Any] = [Hello(2, 99, "coordinator", self.name, "boot"), *calls]

    def receive(self, now: float, envelope: Envelope) -> None:
        """Keep the score."""
        if isinstance(envelope.body, Outcome) and envelope.body.id == self._last:
            self.score = dict(envelope.body.values)

    def advance(self, now: float) -> None:
        """Nothing is due."""

    def drain(self) -> list[Envelope]:
        """The calls, once."""
        out, self._out = self._out, []
        return [Envelope("laboratory", self.name, "laboratory", "call", body) for body in out]


def score_as_member(directory: Directory, calls: Sequence[Call]) -> dict[str, Any]:
    """Act as coordinator of a lock-step cell whose laboratory is a process; return the answer to
    the last call."""
    looker = Looker(calls)
    member = Member(
        "coordinator",
        [looker],
        directory.members(),
        delays=Delays({}),
        directory=directory.hash,
        patience=PATIENCE,
    )
    member.open()
    member.run(lambda: bool(looker.score), 1000)
    return looker.score
