"""Two coordinators want one device: the lease decides which one gets it; the second is refused with
a clear message and moves nothing."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from msgspec.structs import replace

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.engine import RunRecorded
from petrobot.coordinator.launch import Setting, local_programs, mission_id, realtime_mission
from petrobot.coordinator.run import realtime
from petrobot.coordinator.run.mission import Mission, MissionError
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.location_file import Directory, load
from tests.chaos.shuttle_cell import ROOT, TASK, moves, shuttle_services
from tests.ports import free_ports
from tests.waiting import beat, until

pytestmark = pytest.mark.processes
LIMIT = 120.0


def mission_on(directory: Directory, runs: int) -> Mission:
    """Return a mission run that has not begun. Its deadlines are long: on a busy host a move may be
    late."""
    task = load_task(str(TASK))
    patient = {name: replace(one, deadline=LIMIT) for name, one in task.primitive_tasks.items()}
    task = replace(task, primitive_tasks=patient)
    return realtime_mission(directory, Setting(task, runs=runs), mission_id(task))


async def led(
    directory: Directory, mission: Mission, meanwhile: asyncio.Event | None = None
) -> None:
    """Connect, set `meanwhile`, run to the end, and disconnect properly."""
    shell = RealtimeMission(mission, directory)
    try:
        await shell.connect(60.0)
        if meanwhile is not None:
            meanwhile.set()
        await asyncio.wait_for(shell.run(), LIMIT)
    finally:
        await shell.close()


async def until_moving(folder: Path) -> None:
    """Wait until a move has begun."""
    async with asyncio.timeout(LIMIT):
        while not moves(folder, "begin"):
            await beat(0.005)


def judged(mission: Mission) -> tuple[list[RunRecorded], list[RunRecorded]]:
    """Return the runs of a mission run with a status, and those without one. On a busy host the
    bell may preempt a run before its node has answered the call; such a run has not begun
    (docs/semantics.md, records). And a node may be silent for so long that its runs are lost."""
    runs = [r for r in mission.tally.runs if not (r.cause == "lost" and "silent for" in r.text)]
    return [r for r in runs if r.status is not None], [r for r in runs if r.status is None]


async def test_the_second_coordinator_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    """No device is shared, no run of the first one is affected, and the next coordinator gets the
    hands at once."""
    directory = load(shuttle_services(tmp_path, fetch=0.8, carry=0.8, orphan=LIMIT))
    first, second, third = (mission_on(directory, runs) for runs in (20, 2, 2))
    async with Supervisor(local_programs(directory), tmp_path / "logs"):
        leading = asyncio.create_task(led(directory, first))
        await until_moving(tmp_path)
        await led(directory, second)
        assert first.executor.finished is None, "the first one still goes on"
        await leading
        await led(directory, third)
    refused, not_begun = judged(second)
    assert {(r.status, r.cause, r.executed) for r in refused} == {
        (Status.ERROR, "device_leased", Executed.NO)
    }
    assert all(first.executor.mission in r.text for r in refused), "the text says who has it"
    assert {r.executed for r in not_begun} <= {Executed.NO}, not_begun
    for mission in (first, third):
        done, _ = judged(mission)
        assert done and all(r.status is Status.SUCCESS for r in done), done
    begun = moves(tmp_path, "begin")
    assert set(begun.values()) == {1} and not moves(tmp_path, "overlap")
    assert not any(call.startswith(second.executor.mission) for call in begun)


async def test_of_coordinators_that_take_their_devices_at_once_one_gets_all(tmp_path: Path) -> None:
    """The others are refused before anything starts, also by a node that was restarted since."""
    directory = load(shuttle_services(tmp_path))
    shells = [RealtimeMission(mission_on(directory, 2), directory) for _ in range(6)]
    async with Supervisor(local_programs(directory), tmp_path / "logs") as nodes:
        try:
            await asyncio.gather(*(shell.connect(60.0) for shell in shells[:5]))
            taken = await asyncio.gather(
                *(shell.lease(directory.devices) for shell in shells[:5]), return_exceptions=True
            )
            assert Counter(map(type, taken)) == {type(None): 1, MissionError: 4}, taken
            first = shells.pop(taken.index(None))
            await asyncio.gather(*(shell.close() for shell in shells[:4]))
            caller = first.clients["right"].caller
            before = caller.boot
            os.kill(nodes.process_ids()["right"], signal.SIGKILL)
            async with asyncio.timeout(LIMIT):
                while not caller.up or caller.boot == before:
                    await beat(0.01)
            await shells[4].connect(60.0)
            with pytest.raises(MissionError, match="right_hand accepts orders from"):
                await shells[4].lease({"right_hand"})
            waiting = asyncio.create_task(shells[4].lease({"right_hand"}))
            await beat(0.3)
            await first.close()  # a killed one says no BYE; its devices are free some time later
            await waiting
        finally:
            await asyncio.gather(*(shell.close() for shell in (first, *shells)))


async def test_a_restarted_node_is_not_asked_for_what_the_run_only_waits_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a run would have the second device while it waits for the first one: of two such runs
    none would get both, and a run that moves could lose its device to one that never begins."""
    monkeypatch.setattr(realtime, "LEAVE", LIMIT)
    directory = load(shuttle_services(tmp_path))
    first, waiting, other = shells = [
        RealtimeMission(mission_on(directory, 2), directory) for _ in range(3)
    ]
    async with Supervisor(local_programs(directory), tmp_path / "logs") as nodes:
        try:
            await asyncio.gather(*(shell.connect(60.0) for shell in shells))
            await first.lease({"left_hand"})
            asking = asyncio.create_task(waiting.lease({"left_hand", "right_hand"}))
            callers = [shell.clients["right"].caller for shell in shells]
            before = callers[0].boot
            os.kill(nodes.process_ids()["right"], signal.SIGKILL)
            await until(
                lambda: all(c.up and c.boot != before for c in callers), "the restarted node"
            )
            async with asyncio.timeout(LIMIT / 2):
                await other.lease({"right_hand"})
            assert not asking.done()
            await asyncio.gather(first.close(), other.close())
            await asking
        finally:
            monkeypatch.undo()  # two of them have left already, and their links are lost
            await asyncio.gather(*(shell.close() for shell in shells))


async def test_an_answer_that_comes_after_ctrl_c_leaves_the_link(tmp_path: Path) -> None:
    """Over a broken link no BYE is sent: the node would keep the device for two seconds."""
    directory = load(shuttle_services(tmp_path))
    shell = RealtimeMission(mission_on(directory, 2), directory)
    async with Supervisor(local_programs(directory), tmp_path / "logs"):
        try:
            await shell.connect(60.0)
            asking = asyncio.create_task(shell.lease({"left_hand"}))
            await asyncio.sleep(0)
            asking.cancel()
            async with asyncio.timeout(LIMIT):
                await shell.lease({"left_hand"})
        finally:
            await shell.close()


async def test_a_goodbye_is_sent_over_a_new_link_if_the_first_breaks(tmp_path: Path) -> None:
    """The link breaks just as the first one ends: it connects again to say goodbye, and the next
    coordinator gets the hands at once."""
    directory = load(shuttle_services(tmp_path))
    first, second = mission_on(directory, 2), mission_on(directory, 2)
    async with Supervisor(local_programs(directory), tmp_path / "logs"):
        shell = RealtimeMission(first, directory)
        await shell.connect(60.0)
        await asyncio.wait_for(shell.run(), LIMIT)
        for client in shell.clients.values():
            assert client._link is not None
            client._link.cut("somebody stumbled over it")
        async with asyncio.timeout(LIMIT):
            while any(client.caller.up for client in shell.clients.values()):
                await beat(0.001)
        await shell.close()
        await led(directory, second)
    done, _ = judged(second)
    assert done and all(r.status is Status.SUCCESS for r in done), done


def test_a_coordinator_imports_nothing_more_while_a_run_is_active(tmp_path: Path) -> None:
    """An import blocks its loop for 0.3 s, on a busy host for so long that its nodes lose it."""
    services = str(shuttle_services(tmp_path))
    given = ["run", str(TASK), "--up", "--services", services, "--journal", str(tmp_path / "runs")]
    given += ["--quiet", "--page-port", str(free_ports(1)[0]), "--log-level", "info"]
    command = [sys.executable, "-X", "importtime", "-m", "petrobot.coordinator", *given]
    ran = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT, check=True
    )
    _, started, during = ran.stderr.partition(": started (realtime")
    active, finished, _ = during.partition(": finished, success")
    assert started and finished, ran.stderr[-2_000:]
    imported = [line for line in active.splitlines() if "import time:" in line]
    assert not imported
