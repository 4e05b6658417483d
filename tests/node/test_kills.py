"""Processes of a cyclic device are killed, frozen or made to hang at random moments, in the proofs
under load: each time the device starts again and accepts runs."""

from __future__ import annotations

import asyncio
import json
import os
import random
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec import Struct, field

from petrobot.coordinator.cli import main
from petrobot.services.node.worker_host import HUNG
from tests import processes
from tests.node.test_processes import ROOT, Nodes, Operator, operator_of, pids
from tests.processes import alive
from tests.waiting import Limit

pytestmark = pytest.mark.processes
RECOVERY = 60.0
"""Seconds within which the device must be up again on a busy host."""
KILLS = ("SIGKILL", "SIGSEGV", "SIGSTOP, then SIGKILL")
HANGS = ("SIGSTOP", "SIGSTOP with their keepers", "a loop in step")
VICTIMS = (("driver",), ("actions",), ("driver", "actions"))
DEADLINE = 4.0
"""Deadline of a run whose own process may be frozen (s): nothing else ends it."""
ENDS = {(cause, "unknown") for cause in ("device_died", "worker_died", "deadline")}
ENDS |= {("deadline", "yes"), ("deadline", "no")}  # no: its process was being started
"""Causes with which a run may end whose device was killed, with what it says about execution."""
LOOP = HANGS[-1]
LINK = ("lost", "unreachable", "not_accepted")
CALLS = 10
"""Calls that must succeed after each kill."""
WRONG_HASTE = 0.3
"""Share of kills that come while the processes are restarting after the previous kill."""


@contextmanager
def load() -> Iterator[None]:
    """Keep both cores busy."""
    burn = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100000))"
    burners = [subprocess.Popen([sys.executable, "-c", burn]) for _ in range(2)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


class Tally(Struct):
    """Counts of kills and calls, and their results."""

    kills: dict[str, int] = field(default_factory=dict)
    ends: set[tuple[str, str]] = field(default_factory=set)
    """Cause and executed of the runs that did not succeed because of a kill."""
    told: set[str] = field(default_factory=set)
    """Their texts, if their driver died."""
    calls: int = 0
    links: int = 0
    """Calls during which the link to the node was lost, because the host was so busy that this
    process did not run for a second."""
    wedged: list[str] = field(default_factory=list)


async def up(operator: Operator, former: set[int]) -> bool:
    """Return whether the node reports the device as up, with processes that were not killed."""
    answer = await operator.command("left", "status", "slide")
    found = answer.data.get("devices", {}).get("slide", {}).get("pids", {})
    return answer.data.get("answers") == {"slide": "up"} and former.isdisjoint(found.values())


async def kill(
    operator: Operator,
    node: int,
    chance: random.Random,
    tally: Tally,
    how: str,
    chosen: tuple[str, ...],
) -> set[int]:
    """Kill, freeze or hang the chosen processes of the device; return which."""
    status = await operator.command("left", "status", "slide")
    found = status.data.get("devices", {}).get("slide", {}).get("pids", {})
    victims = {found[name] for name in chosen if name in found}
    signals, _, keepers = how.partition(" with their ")
    if keepers:  # not the node: until a worker has reported its id, that of its keeper stands there
        above = set(map(processes.parent, victims)) - {node}
        processes.kill(above, signal.SIGSTOP)
    for name in signals.split(", then ") if how != LOOP else ():
        processes.kill(victims, getattr(signal, name))
        if name == "SIGSTOP":
            await passing(chance.uniform(0.0, 0.3))
    label = f"{how} of {' and '.join(chosen)}"
    tally.kills[label] = tally.kills.get(label, 0) + bool(victims)
    return victims


async def passing(seconds: float) -> None:
    """Let time pass."""
    await asyncio.to_thread(select.select, [], [], [], seconds)


async def storm(folder: Path, seed: int, kills: int, hows: tuple[str, ...] = KILLS) -> Tally:
    """Kill so many times. After each kill, except those during a restart, all calls must
    succeed."""
    chance, tally = random.Random(seed), Tally()
    running = Nodes(folder, "left")
    node = running.processes["left"].pid
    try:
        async with operator_of(running.directory, "left") as operator:
            killed: set[int] = set()
            number = -1
            while sum(tally.kills.values()) < kills:
                number += 1
                chosen, how = chance.choice(VICTIMS), chance.choice(hows)
                chosen = ("driver",) if how == LOOP else chosen
                moment = chance.uniform(0.0, 0.4)
                limit = DEADLINE if how in HANGS and "actions" in chosen else None
                to = chance.uniform(-2.0, 2.0)
                moving = asyncio.create_task(
                    operator.call("loop", after=moment)
                    if how == LOOP
                    else operator.call("go", limit, to=to, timeout=30.0)
                )
                await passing(moment)
                killed |= await kill(operator, node, chance, tally, how, chosen)
                end = await moving
                if end.status != "success" and end.cause not in LINK:
                    tally.ends.add((end.cause, end.executed))
                    tally.told |= {end.text} if end.cause == "device_died" else set()
                if chance.random() < WRONG_HASTE and sum(tally.kills.values()) < kills:
                    continue
                try:
                    await operator.until(partial(up, operator, killed), RECOVERY)
                except TimeoutError:
                    tally.wedged.append(
                        f"kill {number}: {(await operator.command('left', 'status')).data}"
                    )
                    break
                done = 0
                while done < CALLS and len(tally.wedged) + tally.links < CALLS:
                    end = await operator.call("go", to=0.1 * (done % 2), timeout=30.0)
                    if end.cause in LINK:
                        tally.links += 1
                        continue
                    done += 1
                    if end.status != "success":
                        tally.wedged.append(f"kill {number}, call {done}: {end.cause}: {end.text}")
                tally.calls += done
    finally:
        running.stop()
    return tally


async def test_a_device_survives_kills_of_its_processes(tmp_path: Path) -> None:
    tally = await storm(tmp_path, 5, 10)
    assert not tally.wedged and tally.links < CALLS and tally.calls >= 5 * CALLS, tally


async def test_a_device_survives_hangs_of_its_processes(tmp_path: Path) -> None:
    await hang(tmp_path, 7, 4)


@pytest.mark.proof
async def test_a_device_survives_sixty_hangs_of_its_processes(tmp_path: Path) -> None:
    with load():
        await hang(tmp_path, 13, 60)


async def hang(folder: Path, seed: int, times: int) -> None:
    tally = await storm(folder, seed, times, HANGS)
    print(tally)
    assert not tally.wedged and tally.links < CALLS and tally.ends <= ENDS, tally
    says = f"it did not answer for {HUNG:g} s, and was killed"
    assert tally.told and all(says in text for text in tally.told), tally
    assert f"of slide: {says}" in (folder / "left.log").read_text()


@pytest.mark.proof
async def test_a_device_survives_two_hundred_kills_of_its_processes(tmp_path: Path) -> None:
    with load():
        tally = await storm(tmp_path, 11, 200)
    print(tally)
    assert not tally.wedged and tally.links < CALLS, tally


async def test_petrobot_nodes_says_up_only_if_a_call_would_be_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver is frozen meanwhile: its node kills it and starts it again."""
    running = Nodes(tmp_path, "left")
    try:
        async with operator_of(running.directory, "left") as operator:
            assert (await asyncio.to_thread(nodes_command, running.file))["left"]["up"]
            seen = set()

            async def up_again() -> bool:
                left = (await operator.command("left", "status", "slide")).data
                said, about = left["answers"]["slide"], left["devices"].get("slide", {})
                seen.add(f"{said}: {about.get('text', '')}")
                return said == "up" and bool(about["pids"]["driver"] != driver)

            why = (
                f"the process of its driver died: it did not answer for {HUNG:g} s, and was killed"
            )
            dead = {f"restarting: {why}", f"not ready: {why}"}
            times, limit = 0, Limit("an answer while the driver starts again")
            while not seen & dead and limit.left():  # on a busy host it may be up before that
                driver = (await pids(operator, "left", "slide"))["driver"]
                os.kill(driver, signal.SIGSTOP)
                await operator.until(up_again, RECOVERY)
                assert (await operator.call("go", to=0.0)).status == "success"
                times += 1
            assert "no answer: " in seen
            # Its pipe closes a moment before the node has collected the process.
            ending = "restarting: one of its processes is ending"
            assert seen <= {"no answer: ", ending, "up: ", *dead}, seen
            monkeypatch.setenv("COLUMNS", "400")
            services = ["--services", str(running.file)]
            assert await asyncio.to_thread(main, ["nodes", *services]) == 3
            shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
            assert f"started again {times} times, last because {why}" in shown, shown
    finally:
        running.stop()


def nodes_command(file: Path) -> dict[str, Any]:
    """Return the output of `petrobot nodes`."""
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "nodes",
        "--services",
        str(file),
        "--json",
        "-",
    ]
    said = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=RECOVERY)
    answers: dict[str, Any] = json.loads(said.stdout)
    assert said.returncode == (0 if all(answer["up"] for answer in answers.values()) else 3), (
        said.stderr
    )
    return {name: answer for name, answer in answers.items() if name == "left"}


@pytest.mark.parametrize("how", ["SIGKILL", "SIGSTOP"])
async def test_a_killed_or_frozen_keeper_costs_only_its_worker(tmp_path: Path, how: str) -> None:
    """The keepers are directly below the node, and beside them only the fork server, so a tool that
    kills the node's children kills these."""
    running = Nodes(tmp_path, "left")
    try:
        async with operator_of(running.directory, "left") as operator:
            node = running.processes["left"].pid
            workers = {
                *(await pids(operator, "left", "slide")).values(),
                *(await pids(operator, "left", "")).values(),
            }
            keepers = processes.children(node)
            assert len(keepers) == len(workers) + 1 == 4 and workers.isdisjoint(keepers)
            assert set(map(processes.parent, workers)) < keepers
            processes.kill(keepers, getattr(signal, how))
            if how == "SIGSTOP":
                hanging = [operator.call("hang", 1.0), operator.call("hang_moving", 1.0)]
                assert [end.cause for end in await asyncio.gather(*hanging)] == ["deadline"] * 2
                processes.kill(workers)
            await operator.until(partial(up, operator, workers), RECOVERY)
            assert (await operator.call("go", to=0.0)).status == "success"
            assert (await operator.call("add", a=1)).values == {"sum": 2}

            async def gone() -> bool:
                return not any(map(alive, [*workers, *keepers]))

            await operator.until(gone)
    finally:
        running.stop()
