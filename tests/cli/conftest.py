"""An active mission run over a node in this process, and the command line that steers it."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import pytest_asyncio

from petrobot.coordinator.cli import main
from petrobot.coordinator.engine import Mode
from petrobot.coordinator.launch import Setting, realtime_mission
from petrobot.coordinator.operator.commands import Operation
from petrobot.coordinator.operator.run_address import RunAddress, published
from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task.file import loads
from tests.cli.cell import TASK, Arm, RobotNode, directory_in
from tests.waiting import until

RUN = "reaching-1"


class Said(NamedTuple):
    """What a command gave."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Its answer, of `--json -`."""
        return json.loads(self.out)


class Terminal:
    """The commands of operators, in threads of their own; this loop serves them meanwhile."""

    def __init__(
        self,
        operation: Operation,
        shell: RealtimeMission,
        page: Page,
        robot: RobotNode,
        folder: Path,
        read: Callable[[], Any],
        running: asyncio.Task[None],
    ):
        self.operation = operation
        self.shell = shell
        self.page = page
        self.robot = robot
        self.folder = folder
        self.runs = folder / "runs"
        self._read = read
        self.running = running

    @property
    def mission(self) -> Mission:
        """The mission run."""
        return self.shell.mission

    @property
    def arm(self) -> Arm:
        """The robot's arm."""
        return self.robot.arm

    def tokens(self, place: str) -> int:
        """Tokens in a place now."""
        net = self.mission.executor.task.net
        return self.mission.executor.state.marking[net.place_index[place]]

    @property
    def acting(self) -> list[str]:
        """Actions of the runs that have a token."""
        return [run.action for run in self.mission.executor.state.runs()]

    async def __call__(self, *arguments: str) -> Said:
        """Run `petrobot ARGUMENTS --journal RUNS`."""
        self._read()
        code = await asyncio.to_thread(main, [*arguments, "--journal", str(self.runs)])
        said = self._read()
        return Said(code, said.out, said.err)

    async def working(self, *options: str) -> None:
        """Lead the run to where the arm reaches."""
        said = await self("raise", "part_there", *options)
        assert said.code == 0, said.err
        await until(lambda: self.arm.moving)


@asynccontextmanager
async def cell_of(folder: Path, read: Callable[[], Any]) -> AsyncIterator[Terminal]:
    """A mission run that has begun, which is in its journal, and waits for its first part."""
    directory = directory_in(folder)
    robot = RobotNode(directory)
    await robot.start()
    selector = FirstAlternative()
    journal = folder / "runs" / RUN / JOURNAL
    writer = JournalWriter(journal, {"mode": "realtime"})
    store = JournalStore(writer, asyncio.get_running_loop().time())
    mission = realtime_mission(
        directory, Setting(loads(TASK, "reaching.toml"), selector=selector), RUN, store
    )
    shell = RealtimeMission(mission, directory)
    await shell.connect()
    operation = Operation(shell, selector)
    page = await start_page(operation, tasks_folder=folder, page=False)
    running = asyncio.create_task(shell.run())
    await until(lambda: mission.executor.state.mode is Mode.RUNNING and store.safe)
    address = RunAddress(RUN, page.base, page.token, os.getpid(), str(directory.source))
    with published(journal.parent, address):
        yield Terminal(operation, shell, page, robot, folder, read, running)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    await page.close()
    await operation.close()
    await shell.close()
    await robot.close()
    writer.close()


@pytest_asyncio.fixture
async def petrobot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> AsyncIterator[Terminal]:
    """A mission run that can be steered."""
    async with cell_of(tmp_path, capsys.readouterr) as terminal:
        yield terminal
