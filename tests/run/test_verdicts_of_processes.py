"""Deferred verdicts in real time: nodes are real processes, and both links are cut during an
inspection."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from petrobot.coordinator.engine import Instruction, State, Stimulus
from petrobot.coordinator.engine.stimuli import RunEnded
from petrobot.coordinator.launch import Setting, local_programs, realtime_mission
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.location_file import Directory, load
from petrobot.services.comm.protocol.messages import Feedback
from tests.ports import free_ports
from tests.run.judged_parts import (
    FOLDER,
    LEARNED,
    PARTS,
    TRULY,
    Heard,
    learned,
    learner,
    sorting,
    told,
)

pytestmark = pytest.mark.processes
LIMIT = 120.0


class AtEnd:
    """An observer that calls a function once, when this run has ended provisionally."""

    def __init__(self, run: str, do: Callable[[], None]) -> None:
        self._run, self._do = run, do

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Call the function if this is the run's end."""
        if isinstance(stimulus, RunEnded) and stimulus.run == self._run and stimulus.deferred:
            asyncio.get_running_loop().call_soon(self._do)

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Nothing to do."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to do."""

    def settled(self, now: float, state: State) -> None:
        """Nothing to do."""


def services(folder: Path) -> Directory:
    """Return the cell's directory with free ports."""
    text = (FOLDER / "services.toml").read_text(encoding="utf-8")
    for old, new in zip(("7991", "7992"), free_ports(2), strict=True):
        text = text.replace(old, str(new))
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return load(path)


async def led(mission: Mission, directory: Directory, cut: str) -> int:
    """Run to the end; when the run `cut` ends, cut both links. Return how many links were cut."""
    shell, cuts = RealtimeMission(mission, directory), []

    def cut_links() -> None:
        for name, client in shell.clients.items():
            if client._link is not None:
                cuts.append(name)
                client._link.cut("by the test")

    mission.executor.observers.append(AtEnd(cut, cut_links))
    try:
        await shell.connect(60.0)
        await asyncio.wait_for(shell.run(), LIMIT)
    finally:
        await shell.close()
    return len(cuts)


@pytest.mark.parametrize("cut", ["", "pick#1"], ids=["whole links", "links cut behind the result"])
async def test_verdicts_of_real_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut: str
) -> None:
    """One node picks, the other inspects and sends verdicts, the score sends the last ones: the
    results equal those in lock step, even if links break."""
    path = [str(FOLDER), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    directory, task, heard = services(tmp_path), sorting(), Heard()
    selector = learner(task)
    mission = realtime_mission(
        directory, Setting(task, runs=PARTS, seed=1, selector=selector), "sort-1"
    )
    mission.executor.observers.append(heard)
    async with Supervisor(local_programs(directory), tmp_path / "logs"):
        cuts = await led(mission, directory, cut)
    assert cuts == (2 if cut else 0)
    assert told(mission) == TRULY
    assert learned(selector) == LEARNED
    assert len(heard.corrected) == 5 and heard.notes["no_verdict_due"] == 2
    assert mission.score["hidden"] == ["sort-1/pick#3", "sort-1/pick#6"]
