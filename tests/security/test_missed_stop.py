"""A coordinator that was frozen while an emergency stop was given and cleared, with real processes:
whenever it was frozen, nothing moves until an operator starts something."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.launch import local_programs
from petrobot.coordinator.operator.run_address import ADDRESS_FILE
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.location_file import load
from tests.chaos.shuttle_cell import moves, shuttle_services
from tests.security.test_estop import finished, petrobot
from tests.waiting import beat, until

pytestmark = pytest.mark.processes
TASK = """\
schema = 1
[task]
name = "turns"
runs_place = "turns"
final = "turns == 0 and free == 1"
[primitive_tasks.fetch]
goal = "fetched"
alternatives = ["left_fetch"]
deadline = 3.0
[primitive_tasks.carry]
goal = "carried"
alternatives = ["right_carry"]
deadline = 3.0
[places.turns]
kind = "control"
tokens = 1
[places.free]
kind = "resource"
tokens = 1
capacity = 1
[places.fetch]
kind = "action"
task = "fetch"
[places.laid]
kind = "control"
capacity = 1
[places.carry]
kind = "action"
task = "carry"
[transitions.begin]
in = ["turns", "free"]
out = ["fetch"]
after = {pause}
[transitions.fetched]
in = ["fetch:normal"]
out = ["laid"]
[transitions.go_on]
in = ["laid"]
out = ["carry"]
after = 0.02
[transitions.carried]
in = ["carry:normal"]
out = ["free"]
[transitions.not_fetched]
in = ["fetch:error"]
out = ["free"]
[transitions.not_carried]
in = ["carry:error"]
out = ["free"]
"""


class Turns:
    """The nodes of two hands, and coordinators that move them in turn."""

    def __init__(self, folder: Path, supervisor: Supervisor) -> None:
        self.folder = folder
        self.supervisor = supervisor
        self._services = ["--services", str(folder / "services.toml")]
        self._journal = ["--journal", str(folder / "runs")]

    def start(self, pause: float) -> subprocess.Popen[str]:
        """Start a run with this pause before each turn (s)."""
        task = self.folder / "turns.toml"
        task.write_text(TASK.format(pause=pause), encoding="utf-8")
        options = ["--runs", "100000", "--no-page", "--quiet"]
        return petrobot("run", str(task), *options, *self._services, *self._journal)

    def begun(self) -> int:
        """Count the runs that have moved a hand."""
        return sum(moves(self.folder, "begin").values())

    async def moving(self) -> None:
        """Wait until two more runs have moved a hand."""
        enough = self.begun() + 2
        await until(lambda: self.begun() >= enough, "hands that move")

    async def estop(self, *options: str) -> None:
        """Give `petrobot estop`, whose devices all obey."""
        command = ["estop", *options, *self._services, *self._journal]
        assert await asyncio.to_thread(main, command) == 0

    async def restart_nodes(self) -> None:
        """Kill both nodes, and wait until they are ready again."""
        starts = {name: self.supervisor.starts(name) for name in ("left", "right")}
        for pid in self.supervisor.process_ids().values():
            os.kill(pid, signal.SIGKILL)
        logs = [self.folder / "logs" / f"{name}.log" for name in starts]
        ready = [log.read_text().count("ready on") for log in logs]
        await until(
            lambda: [log.read_text().count("ready on") for log in logs] > ready,
            "both nodes to be ready again",
        )

    async def connected(self, coordinator: subprocess.Popen[str]) -> Path:
        """Wait until a coordinator is connected to the nodes, and return the folder of its run."""
        found = list[Path]()

        def published() -> bool:
            assert coordinator.poll() is None, coordinator.communicate()
            for file in (self.folder / "runs").glob(f"*/{ADDRESS_FILE}"):
                if json.loads(file.read_text())["process"] == coordinator.pid:
                    found.append(file.parent)
            return bool(found)

        await until(published, "a coordinator that is connected")
        return found[0]


@pytest.fixture
async def turns(tmp_path: Path) -> AsyncIterator[Turns]:
    directory = load(shuttle_services(tmp_path, fetch=0.03, carry=0.03))
    programs = local_programs(directory)
    async with Supervisor(programs, tmp_path / "logs", respawn=True) as supervisor:
        yield Turns(tmp_path, supervisor)


@pytest.mark.parametrize("restarts", [False, True], ids=["nodes stay", "nodes restart"])
async def test_what_was_frozen_before_a_stop_moves_nothing_after_it_is_cleared(
    turns: Turns, restarts: bool
) -> None:
    """The coordinator is frozen at a random moment: before its first run, in a run, or between two.
    Then the stop is given and cleared. When the coordinator continues, its run is aborted."""
    moments = random.Random(7)
    for number in range(3 if restarts else 8):
        before = turns.begun()
        first = number == 0
        coordinator = turns.start(1.5 if first else 0.02)
        try:
            await turns.connected(coordinator)
            if not first:
                await turns.moving()
            await beat(moments.uniform(0.0, 0.2))
            coordinator.send_signal(signal.SIGSTOP)
            await turns.estop()
            if restarts:
                await turns.restart_nodes()
            await turns.estop("--clear")
            then = turns.begun()
            assert not first or then == before, "it was not frozen before its first run"
            coordinator.send_signal(signal.SIGCONT)
            code, out, err = await finished(coordinator)
            assert (code, turns.begun()) == (1, then), f"{number}: {out}{err}"
        finally:
            coordinator.kill()
            coordinator.communicate()


async def test_a_run_that_is_resumed_after_the_stop_moves(turns: Turns) -> None:
    """Its coordinator was killed between two runs. To resume it is a decision of the operator."""
    coordinator = turns.start(1.5)
    try:
        run = await turns.connected(coordinator)
        coordinator.kill()
        coordinator.communicate()
        await turns.estop()
        await turns.estop("--clear")
        assert turns.begun() == 0
        coordinator = petrobot("resume", str(run), "--no-page", "--quiet")
        await turns.moving()
    finally:
        coordinator.kill()
        coordinator.communicate()
