"""A coordinator that was frozen while an emergency stop was given and cleared, or while another run
used its devices, with real processes: whenever it was frozen, it moves nothing afterwards."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from petrobot.coordinator.cli import main
from petrobot.coordinator.launch import local_programs
from petrobot.coordinator.operator.run_address import ADDRESS_FILE
from petrobot.coordinator.operator.station import ARREARS, STOOD_STILL
from petrobot.coordinator.run.mission import MissionError
from petrobot.coordinator.run.realtime import TRANSIT, RealtimeMission
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.location_file import load
from petrobot.services.host.emergency_latch import latch_of
from tests.chaos.shuttle_cell import moves, shuttle_services
from tests.integration.test_two_coordinators import mission_on
from tests.security.test_estop import finished, petrobot
from tests.waiting import Limit, beat, until

pytestmark = [pytest.mark.processes, pytest.mark.asyncio(loop_scope="module")]
PATIENCE = 60.0
TASK = """\
schema = 1
[task]
name = "turns"
runs_place = "turns"
final = "turns == 0 and free == 1"
{more}
[primitive_tasks]
fetch = {{ goal = "fetched", alternatives = ["left_fetch"], deadline = 3.0 }}
carry = {{ goal = "carried", alternatives = ["right_carry"], deadline = 3.0 }}
[places]
turns = {{ kind = "control", tokens = 1 }}
free = {{ kind = "resource", tokens = 1, capacity = 1 }}
fetch = {{ kind = "action" }}
laid = {{ kind = "control", capacity = 1 }}
carry = {{ kind = "action" }}
[transitions]
begin = {{ in = ["turns", "free"], out = ["fetch"], after = {pause} }}
fetched = {{ in = ["fetch:normal"], out = ["laid"] }}
go_on = {{ in = ["laid"], out = ["carry"], after = 0.02 }}
carried = {{ in = ["carry:normal"], out = ["free"] }}
not_fetched = {{ in = ["fetch:error"], out = ["free"] }}
not_carried = {{ in = ["carry:error"], out = ["free"] }}
"""
PREPARATION = """\
from pathlib import Path
from petrobot import success
HERE = Path(__file__).parent
async def arrange(ctx, *, seed, runs):
    (HERE / "arranging").touch()
    await ctx.wait((HERE / "arranged").exists, timeout=60.0)
    return success()
"""


class Turns:
    """The nodes of two hands, and coordinators that move them in turn."""

    def __init__(
        self, folder: Path, runs: Path, supervisor: Supervisor | None = None, more: str = ""
    ) -> None:
        """`folder` has the location file, `runs` is for the runs; `more`: a line of the task."""
        self.more = more
        self.folder = folder
        self.runs = runs
        self.supervisor = supervisor
        self._services = ["--services", str(folder / "services.toml")]
        self._journal = ["--journal", str(runs)]

    def task(self, pause: float) -> Path:
        """Write the task, with this pause before each turn (s)."""
        task = self.folder / "turns.toml"
        task.write_text(TASK.format(pause=pause, more=self.more), encoding="utf-8")
        return task

    def start(self, pause: float, *more: str) -> subprocess.Popen[str]:
        """Start a run with this pause before each turn (s)."""
        options = ["--runs", "100000", "--no-page", "--quiet", *more]
        return petrobot("run", str(self.task(pause)), *options, *self._services, *self._journal)

    def resume(self, run: Path, **variables: str) -> subprocess.Popen[str]:
        """Resume a run, with these environment variables."""
        return petrobot("resume", str(run), "--no-page", "--quiet", **variables)

    def serve(self) -> subprocess.Popen[str]:
        """Serve the page."""
        options = ["--tasks", str(self.folder), "--page-port", "0"]
        return petrobot("serve", *options, *self._services, *self._journal)

    def begun(self) -> int:
        """Count the runs that have moved a hand."""
        return sum(moves(self.folder, "begin").values())

    async def moving(self) -> None:
        """Wait until two more runs have moved a hand."""
        enough = self.begun() + 2
        await until(lambda: self.begun() >= enough, "hands that move")

    async def moved(self, coordinator: subprocess.Popen[str]) -> None:
        """Wait until a coordinator moves the hands, and kill it."""
        try:
            await self.moving()
        finally:
            coordinator.kill()
            coordinator.communicate()

    async def estop(self, *options: str) -> None:
        """Give `petrobot estop`, whose devices all obey."""
        assert await asyncio.to_thread(main, self.estop_command(*options)) == 0

    def estop_command(self, *options: str) -> list[str]:
        """The command line of `petrobot estop`."""
        return ["estop", *options, *self._services, *self._journal]

    async def restart_nodes(self) -> None:
        """Kill both nodes, and wait until they are ready again."""
        assert self.supervisor is not None
        starts = {name: self.supervisor.starts(name) for name in ("left", "right")}
        for pid in self.supervisor.process_ids().values():
            os.kill(pid, signal.SIGKILL)
        logs = [self.folder / "logs" / f"{name}.log" for name in starts]
        ready = [log.read_text().count("ready on") for log in logs]
        await until(
            lambda: all(
                log.read_text().count("ready on") > before
                for log, before in zip(logs, ready, strict=True)
            ),
            "both nodes to be ready again",
        )

    def run_of(self, coordinator: subprocess.Popen[str]) -> Path | None:
        """Return the folder of the run of a coordinator that is connected to the nodes."""
        assert coordinator.poll() is None, coordinator.communicate()
        for file in self.runs.glob(f"*/{ADDRESS_FILE}"):
            if json.loads(file.read_text())["process"] == coordinator.pid:
                return file.parent
        return None

    async def connected(self, coordinator: subprocess.Popen[str]) -> Path:
        """Wait until a coordinator is connected to the nodes, and return the folder of its run."""
        await until(lambda: self.run_of(coordinator), "a coordinator that is connected")
        run = self.run_of(coordinator)
        assert run is not None
        return run


def page_address(page: subprocess.Popen[str]) -> str:
    """Wait until the page is served, and return its address with the token."""
    assert page.stdout is not None
    return next(line.split()[1] for line in page.stdout if line.startswith("page: "))


async def give(address: str, verb: str, **data: object) -> dict[str, Any]:
    """Give a command to a page, as a script does."""
    base, _, token = address.partition("/?token=")
    request = urllib.request.Request(
        f"{base}/api/command",
        json.dumps({"name": "test", "verb": verb, "data": data}).encode(),
        {"Authorization": f"Bearer {token}", "Content-Type": "application/json"},
    )

    def ask() -> dict[str, Any]:
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return json.loads(answer.read())  # type: ignore[no-any-return]
        except urllib.error.HTTPError as refused:
            return json.loads(refused.read())  # type: ignore[no-any-return]

    return await asyncio.to_thread(ask)


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def nodes(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[tuple[Path, Supervisor]]:
    """Both nodes and their folder, for all tests that do not need nodes of their own."""
    folder = tmp_path_factory.mktemp("cell")
    programs = local_programs(load(shuttle_services(folder, fetch=0.03, carry=0.03)))
    async with Supervisor(programs, folder / "logs", respawn=True) as supervisor:
        yield folder, supervisor


@pytest_asyncio.fixture(loop_scope="module")
async def turns(nodes: tuple[Path, Supervisor], tmp_path: Path) -> AsyncIterator[Turns]:
    """Turns of both hands, which are not stopped, with runs of their own."""
    folder, supervisor = nodes
    turns = Turns(folder, tmp_path / "runs", supervisor)
    yield turns
    await turns.estop("--clear")


@pytest.mark.parametrize("restarts", [False, True], ids=["nodes stay", "nodes restart"])
async def test_what_was_frozen_before_a_stop_moves_nothing_after_it_is_cleared(
    turns: Turns, restarts: bool
) -> None:
    """The coordinator is frozen at a random moment: before its first run, in a run, or between two.
    Then the stop is given and cleared. When the coordinator continues, its run is aborted."""
    moments = random.Random(7)
    for number in range(2 if restarts else 4):
        before = turns.begun()
        first = number == 0
        coordinator = turns.start(PATIENCE if first else 0.02)
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


async def test_a_run_whose_devices_another_one_has_used_moves_nothing_more(turns: Turns) -> None:
    """It was frozen between two turns. `resume` continues it."""
    coordinator = turns.start(0.5)
    try:
        run = await turns.connected(coordinator)
        await turns.moving()
        coordinator.send_signal(signal.SIGSTOP)
        other = turns.start(0.02, "--runs", "3")
        code, out, err = await finished(other)
        assert code == 0, out + err
        then = turns.begun()
        coordinator.send_signal(signal.SIGCONT)
        code, out, err = await finished(coordinator)
        assert (code, turns.begun()) == (1, then) and "while" in err and "resume" in err, out + err
    finally:
        coordinator.kill()
        coordinator.communicate()
    await turns.moved(turns.resume(run))


@pytest.mark.parametrize("command", ["run", "resume"])
async def test_an_order_from_before_a_stop_moves_nothing_after_it_is_cleared(
    turns: Turns, command: str
) -> None:
    """The coordinator is frozen before it has reached any node, even before it is Python. The
    operator must order it again, and then it moves. So does a run from before the stop whose
    coordinator was killed: to resume it is a decision of the operator."""
    run, then = Path(), turns.begun()
    if command == "resume":
        coordinator = turns.start(4.0)
        run = await turns.connected(coordinator)
        coordinator.kill()
        coordinator.communicate()
        await turns.estop()
        await turns.estop("--clear")
        assert turns.begun() == then
        await turns.moved(turns.resume(run))

    def order() -> subprocess.Popen[str]:
        return turns.resume(run) if command == "resume" else turns.start(0.02)

    then = turns.begun()
    for moment in (0.0, 0.1, 0.3) if command == "run" else (0.1,):
        limit = Limit("a coordinator that is frozen before it has reached a node")
        while limit.left():
            coordinator = order()
            await beat(moment)
            coordinator.send_signal(signal.SIGSTOP)
            if turns.run_of(coordinator) is None:
                break  # else, on a busy host, the signal was late
            coordinator.kill()
            coordinator.communicate()
            await turns.estop()
            await turns.estop("--clear")
            then = turns.begun()
        try:
            await turns.estop()
            await beat(2 * TRANSIT)  # no person is quicker
            await turns.estop("--clear")
            coordinator.send_signal(signal.SIGCONT)
            code, out, err = await finished(coordinator)
            assert (code, turns.begun()) == (1, then), out + err
            assert "order it again" in err
        finally:
            coordinator.kill()
            coordinator.communicate()
    await turns.moved(order())


async def test_a_stop_and_another_run_refuse_a_resume_as_they_refuse_a_run(turns: Turns) -> None:
    """Exit code 2, and nothing moves, whether the host of the coordinator knows of the stop or only
    the node."""
    coordinator = turns.start(0.02)
    run = await turns.connected(coordinator)
    await turns.moved(coordinator)
    await turns.estop()
    then = turns.begun()
    another = {"PETROBOT_STATE": str(turns.runs / "another host")}
    for variables, says in (({}, "still holds the devices"), (another, "left_hand: emergency")):
        code, out, err = await finished(turns.resume(run, **variables))
        assert (code, turns.begun()) == (2, then) and says in err, out + err
        assert "petrobot estop --clear" in err, err
    await turns.estop("--clear")
    other = turns.start(0.5)
    try:
        await turns.connected(other)
        code, out, err = await finished(turns.resume(run))
        assert code == 2 and "in use: left_hand accepts orders from" in err, out + err
    finally:
        other.kill()
        other.communicate()


async def test_a_start_that_a_frozen_page_reads_after_a_stop_moves_nothing(turns: Turns) -> None:
    """It was pressed while the page's process was frozen, or just before."""
    turns.task(0.02)
    then = turns.begun()
    page = turns.serve()
    try:
        address = await asyncio.to_thread(page_address, page)
        assert (await give(address, "take_controls"))["ok"]
        page.send_signal(signal.SIGSTOP)
        pressed = asyncio.create_task(give(address, "start", task="turns"))
        await beat(2 * TRANSIT)
        await turns.estop()
        await beat(STOOD_STILL)
        await turns.estop("--clear")
        page.send_signal(signal.SIGCONT)
        answer = await pressed
        assert (answer["ok"], answer["code"], turns.begun()) == (False, "stopped", then), answer
        assert "order it again" in answer["text"]
        await beat(ARREARS)
        limit, answer = Limit("a page that has not stood still again"), {"ok": False}
        while not answer["ok"]:
            assert limit.left(), answer
            # On a busy host the test was silent for so long that the controls are free.
            assert (await give(address, "take_controls"))["ok"]
            answer = await give(address, "start", task="turns")
        await until(lambda: turns.begun() > then, "hands that move in the only turn")
    finally:
        page.kill()
        page.communicate()


async def test_nodes_that_start_after_a_stop_was_cleared_know_when(tmp_path: Path) -> None:
    """Here they did not run: the stop and its clearing are on disk."""
    turns = Turns(tmp_path, tmp_path / "runs")
    directory = load(shuttle_services(tmp_path, fetch=0.03, carry=0.03))
    coordinator = turns.start(0.02, "--up")
    try:
        coordinator.send_signal(signal.SIGSTOP)
        assert await asyncio.to_thread(main, turns.estop_command()) == 3
        await beat(2 * TRANSIT)
        await turns.estop("--clear")
        assert latch_of(directory.source, "left").cleared.number == 1
        coordinator.send_signal(signal.SIGCONT)
        code, out, err = await finished(coordinator)
        assert (code, turns.begun()) == (1, 0), out + err
    finally:
        coordinator.kill()
        coordinator.communicate()
    coordinator = turns.start(0.02, "--up")
    try:
        await turns.moving()
    finally:
        coordinator.terminate()
        coordinator.communicate()


async def test_a_stop_during_the_preparation_ends_the_run(tmp_path: Path) -> None:
    """It was not heard: the task began, and said only at its first movement that it must not move.
    A run that asks for a stopped device does not even prepare."""
    services = shuttle_services(tmp_path, fetch=0.03, carry=0.03)
    (tmp_path / "lab.py").write_text(PREPARATION, encoding="utf-8")
    table = '[services.arrange]\nrun = "lab:arrange"\nnode = "left"\n'
    services.write_text(services.read_text() + table, encoding="utf-8")
    directory = load(services)
    async with Supervisor(local_programs(directory), tmp_path / "logs"):
        turns = Turns(tmp_path, tmp_path / "runs", more='prepare = "arrange"')
        coordinator = turns.start(0.02)
        try:
            await until((tmp_path / "arranging").exists, "the preparation")
            await turns.estop()
            code, out, err = await finished(coordinator)
            assert code == 1 and "emergency stop, as" in err, out + err
            shell = RealtimeMission(mission_on(directory, 1), directory)
            await shell.connect(PATIENCE)
            with pytest.raises(MissionError, match="left_hand: emergency stop"):
                await shell.lease({"left_hand"})
            await shell.close()
            (tmp_path / "arranged").touch()
            await turns.estop("--clear")
            assert turns.begun() == 0
            coordinator = turns.start(0.02)
            await turns.moving()
        finally:
            coordinator.kill()
            coordinator.communicate()
