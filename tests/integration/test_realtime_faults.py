"""The cell in real time with real processes: nodes are killed during the task, which continues
through its error branches."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.engine import Fired, Instruction, RunRecorded, StartRun, State, Stimulus
from petrobot.coordinator.launch import Setting, local_programs, mission_id, realtime_mission
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.location_file import load
from petrobot.services.comm.protocol.messages import Command, Feedback
from tests.integration.cell_files import services_file

pytestmark = pytest.mark.processes
LIMIT = 120.0
PERIODS = 3
"""Periods of the stream without a set point after which the arm must hold."""


class When:
    """An observer that calls a function once, when an action place is entered for the first time,
    and keeps all firings."""

    def __init__(self, place: str, do: Callable[[], None]) -> None:
        self._place, self._do = place, do
        self.done = False
        self.firings: list[Fired] = []

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Call the function if this starts the place's first run."""
        if isinstance(instruction, Fired):
            self.firings.append(instruction)
        if isinstance(instruction, StartRun) and instruction.place == self._place and not self.done:
            self.done = True
            self._do()

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to do."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to do."""

    def settled(self, now: float, state: State) -> None:
        """Nothing to do."""


async def arm_state(shell: RealtimeMission) -> dict[str, Any]:
    """Return the present state of the arm's driver."""
    told: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()

    def hear(data: Mapping[str, Any]) -> None:
        if "arm" in data["devices"] and not told.done():
            told.set_result(data["devices"]["arm"]["state"])

    shell.mission.executor.on_status = hear
    assert await shell.clients["motion"].connected(60.0)
    now = asyncio.get_running_loop().time()
    shell.mission.callers["motion"].command(now, Command("test/status", "status"))
    shell.clients["motion"].flush(now)
    return await asyncio.wait_for(told, 60.0)


async def run_and_kill(
    folder: Path, place: str, node: str
) -> tuple[Mission, list[RunRecorded], Supervisor, dict[str, Any]]:
    """Lead two runs over launched nodes; kill a node (kill -9) when the place is first entered.
    Return the results, and the arm's state last. Its firings are a sequence of the ordinary net."""
    directory, task = load(services_file(folder)), load_task("catch_ball")
    mission = realtime_mission(directory, Setting(task, runs=2, seed=3), mission_id(task))
    async with Supervisor(local_programs(directory), folder / "logs") as supervisor:
        shell = RealtimeMission(mission, directory)
        killer = When(place, lambda: os.kill(supervisor.process_ids()[node], signal.SIGKILL))
        mission.executor.observers.append(killer)
        try:
            await shell.connect(60.0)
            await asyncio.wait_for(shell.run(), LIMIT)
            arm = await arm_state(shell)
        finally:
            await shell.close()
    assert killer.done
    markings = list(
        mission.executor.task.net.replay(
            [f.transition for f in killer.firings], killer.firings[0].before
        )
    )
    assert markings[-1] == mission.executor.state.marking
    assert mission.score["over"] + sum(c.status is Status.ERROR for c in mission.tally.cycles) >= 1
    return mission, mission.tally.runs, supervisor, arm


@pytest.mark.parametrize(("place", "node"), [("track_ball", "vision"), ("catch_ball", "motion")])
async def test_a_node_killed_during_a_catch_is_an_error_and_the_task_continues(
    tmp_path: Path, place: str, node: str
) -> None:
    """kill -9: its run ends in ERROR with executed = unknown and a reason, the node is restarted,
    and `final` is reached. Whatever happens to the sender, no set point older than three periods is
    executed."""
    mission, runs, supervisor, arm = await run_and_kill(tmp_path, place, node)
    finished = mission.executor.finished
    assert finished is not None
    killed = next(r for r in runs if r.place == place)
    assert (killed.status, killed.executed) == (Status.ERROR, Executed.UNKNOWN)
    assert killed.cause in ("lost", "rebooted")
    assert killed.text
    assert supervisor.starts(node) == 2
    assert len(mission.tally.cycles) == 2 or finished.status is Status.ERROR
    assert all(r.cause for r in runs if r.status is Status.ERROR)
    stream = mission.executor.directory.streams["catch_point"]
    assert arm["stale_executed"] == 0
    assert arm["oldest_executed"] <= PERIODS * stream.period
    moved = [r for r in runs if r.place == "catch_ball" and r.status is Status.SUCCESS]
    assert arm["setpoint_count"] > 0 or node == "motion" or not moved, (
        "a motion node that was killed counts anew; on a busy host no ball may come that far"
    )
