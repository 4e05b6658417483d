"""If a node is frozen, or its loop is blocked, the processes of its devices stop the devices
themselves."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.protocol.messages import Command, Ping
from petrobot.services.host.emergency_latch import ALL, Latch, latch_of
from petrobot.services.node.emergency_stops import AGAIN, GUARD_LOOK, SILENCE, Guard
from petrobot.services.worker.device_process import DeviceLoop
from petrobot.services.worker.pipe import Pipe
from petrobot.services.worker.remote import EMERGENCY_STOP, NODE_SILENT
from tests.node.test_device_process import Moving, Ports as NoPorts, Process, states
from tests.node.test_driver_faults import OneNode, cell
from tests.node.test_kills import LINK
from tests.node.test_processes import PATIENCE, Operator, operator_of
from tests.waiting import Limit

GONE = ("node_silent", "lost", "not_accepted")
"""How a call ends when its node stops: ACCEPT may be held back at that moment."""

SERVICES = """\
[services.block]
node = "only"
run = "toy_cell.actions:block"
[services.slow_disk]
node = "only"
run = "toy_cell.actions:slow_disk"
"""
DEVICE = """\
[devices.the_{name}]
node = "only"
driver = "toy_cell.drivers:Broken"
{period}
file = "{file}"
[actions.{name}]
run = "toy_cell.actions:{action}"
task = "work"
device = "the_{name}"
"""


class Moved:
    """A node with a cyclic device, and one whose driver is in the process of its action. Both
    record when they stop."""

    def __init__(self, folder: Path) -> None:
        self.files = {name: folder / f"{name}.log" for name in ("base", "tool")}
        base = DEVICE.format(
            name="base", period="period = 0.004", file=self.files["base"], action="order"
        )
        tool = DEVICE.format(
            name="tool", period="", file=self.files["tool"], action="order_directly"
        )
        self.node = OneNode(folder, cell(base, tool, SERVICES))
        self.node.until_ready()

    def lines(self, name: str) -> list[tuple[float, str]]:
        if not self.files[name].exists():
            return []
        rows = [line.split() for line in self.files[name].read_text().splitlines()]
        return [(float(row[0]), row[1]) for row in rows if len(row) == 2]

    def stopped(self, name: str) -> float:
        """Return when the device stopped after it had moved (s, monotonic)."""
        return float(
            wait(lambda: [at for at, said in self.lines(name)[1:] if said == "stopped"])[0]
        )

    def moves(self, name: str) -> bool:
        return [said for _, said in self.lines(name)[-1:]] == ["moving"]

    def send(self, number: int) -> None:
        os.kill(self.node.process.pid, number)


def wait(look: Callable[[], list[Any]], timeout: float = PATIENCE) -> list[Any]:
    """Return the first result of `look` that is not None."""
    until = time.monotonic() + timeout
    while not (found := look()):
        assert time.monotonic() < until, "it did not come"
        time.sleep(0.002)
    return found


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Moved]:
    one = Moved(tmp_path_factory.mktemp("frozen"))
    yield one
    one.send(signal.SIGCONT)
    one.node.stop()


@pytest.fixture
async def operator(moved: Moved) -> AsyncIterator[Operator]:
    for file in moved.files.values():
        file.unlink(missing_ok=True)
    async with operator_of(moved.node.directory, "only", timing=LinkTiming()) as one:
        yield one


async def moving(moved: Moved, operator: Operator, name: str) -> asyncio.Task[Any]:
    """Start a run that moves the device for longer than any test lasts."""
    until = time.monotonic() + PATIENCE
    while True:
        run = asyncio.create_task(operator.call(name, None, send=[{"go": True}], seconds=600.0))
        while not run.done() and not moved.moves(name):
            assert time.monotonic() < until, "it does not move"
            await asyncio.sleep(0.005)
        if not run.done():
            return run
        # the device may first need a sign of life from its node
        assert (
            time.monotonic() < until and "silent" in f"{run.result().cause} {run.result().text}"
        ), run.result()


@contextmanager
def frozen(moved: Moved) -> Iterator[float]:
    """Freeze the node meanwhile; yield the time of the freeze."""
    moved.send(signal.SIGSTOP)
    try:
        yield time.monotonic()
    finally:
        moved.send(signal.SIGCONT)


async def usable(operator: Operator, name: str) -> None:
    """Check that the device accepts commands again soon after its node continues; then stop it."""
    until = time.monotonic() + PATIENCE
    while (
        end := await operator.call(name, None, send=[{"go": True}], seconds=0.01)
    ).status != "success":
        assert time.monotonic() < until, end
        await asyncio.sleep(0.05)
    await operator.command("only", "stop", f"the_{name}")


@pytest.mark.processes
@pytest.mark.parametrize("name", ["base", "tool"])
async def test_the_device_of_a_frozen_node_stops(
    moved: Moved, operator: Operator, name: str
) -> None:
    run = await moving(moved, operator, name)
    with frozen(moved):
        await asyncio.to_thread(moved.stopped, name)
    end = await run
    assert end.status == "error" and end.cause in GONE, end
    await usable(operator, name)


@pytest.mark.processes
@pytest.mark.parametrize("name", ["base", "tool"])
async def test_a_service_that_blocks_the_node_stops_its_devices(
    moved: Moved, operator: Operator, name: str
) -> None:
    """The node's log says which line it was."""
    says = r"only: its code in block \(.*actions.py:\d+\) has not come back for 1 s"
    limit = Limit("the line in the log")
    while limit.left():  # on a busy host the node may see only a part of the time
        run = await moving(moved, operator, name)
        blocked = asyncio.create_task(operator.call("block", None, seconds=2.5))
        await asyncio.to_thread(moved.stopped, name)
        end = await run
        assert end.status == "error" and end.cause in GONE, end
        await blocked
        await usable(operator, name)
        if re.search(says, moved.node.log.read_text()):
            break
        for file in moved.files.values():
            file.unlink(missing_ok=True)


@pytest.mark.processes
async def test_the_emergency_stop_of_a_frozen_node(moved: Moved, operator: Operator) -> None:
    """The command stops both devices although their node is frozen, and they stay so until it is
    cleared."""
    runs = [await moving(moved, operator, name) for name in ("base", "tool")]
    services = ["--services", str(moved.node.file)]
    with frozen(moved):
        assert await asyncio.to_thread(main, ["estop", *services]) == 3
        for name in ("base", "tool"):
            await asyncio.to_thread(moved.stopped, name)
    for run in runs:
        assert (await run).status == "error"
    # The node may send the first calls after the freeze before it has read the latch: its device
    # refuses them itself.
    limit = Limit("an answer of the node")
    while await operator.clients["only"].connected(PATIENCE) and limit.left():
        end = await operator.call("base", None, send=[{"go": True}], seconds=0.05)
        if end.cause not in LINK:
            break
    assert end.status == "error" and "emergency" in f"{end.cause} {end.text}", end
    assert moved.lines("base")[-1][1] == "stopped"
    assert await asyncio.to_thread(main, ["estop", "--clear", *services]) == 0
    await usable(operator, "base")
    await usable(operator, "tool")


@pytest.mark.processes
async def test_the_emergency_stop_of_a_node_with_a_slow_disk(
    moved: Moved, operator: Operator
) -> None:
    """It stops its device at once, answers its callers while it writes, and acknowledges stop and
    clearing once they are stored."""
    run = await moving(moved, operator, "base")
    services, path = (
        ["--services", str(moved.node.file)],
        latch_of(moved.node.file, "only").paths[0],
    )
    await operator.call("slow_disk", None, seconds=1.5)  # longer than a connection may be silent
    try:
        assert await asyncio.to_thread(main, ["estop", *services]) == 0 and path.exists()
        stored = time.monotonic()
        assert moved.stopped("base") < stored - 0.5, "it has waited for the disk"
        assert (await run).cause == "emergency_stop"
        assert await asyncio.to_thread(main, ["estop", "--clear", *services]) == 0
        assert not path.exists()
    finally:
        await operator.call("slow_disk", None, seconds=0.0)
    await usable(operator, "base")


@pytest.mark.processes
@pytest.mark.parametrize("name", ["base", "tool"])
async def test_a_stop_that_was_cleared_while_the_node_was_frozen_ends_the_run(
    moved: Moved, operator: Operator, name: str
) -> None:
    """Also if the process of the device did not look in between. Only the run of that device."""
    latch = latch_of(moved.node.file, "only")
    other = "tool" if name == "base" else "base"
    limit = Limit("a freeze that is shorter than the node may be silent")
    while limit.left():
        stopped, innocent = [await moving(moved, operator, one) for one in (name, other)]
        with frozen(moved):
            await asyncio.to_thread(latch.stop, [f"the_{name}"])
            await asyncio.to_thread(latch.clear, [f"the_{name}"], ["the_base", "the_tool"])
        end = await stopped
        if end.cause not in GONE:
            break
        await usable(operator, name)
        await operator.command("only", "stop", f"the_{other}")
        await innocent
    assert (end.status, end.cause) == ("error", "emergency_stop"), end
    assert moved.lines(name)[-1][1] == "stopped"
    if innocent.done():  # on a busy host, the node was frozen for too long
        assert innocent.result().cause in GONE
    else:
        assert moved.moves(other)
        await operator.command("only", "stop", f"the_{other}")
        assert (await innocent).cause == "stopped"
    await usable(operator, name)


@pytest.mark.proof
@pytest.mark.processes
async def test_how_soon_devices_of_a_frozen_node_stop(moved: Moved, operator: Operator) -> None:
    """30 times each: within a second of the node's last message, and within 0.25 s of the latch."""
    latch = latch_of(moved.node.file, "only")
    for kind, limit in (("latch", 0.25), ("silence", 1.0)):
        took = {"base": list[float](), "tool": list[float]()}
        for _ in range(30):
            for name in took:
                for file in moved.files.values():
                    file.unlink(missing_ok=True)
                run = await moving(moved, operator, name)
                with frozen(moved) as since:
                    if kind == "latch":
                        since = time.monotonic()  # this includes the time to sync the latch to disk
                        await asyncio.to_thread(latch.stop, [ALL])
                    took[name].append(await asyncio.to_thread(moved.stopped, name) - since)
                print(f"{kind}, {name}: {took[name][-1]:.3f} s", flush=True)
                if kind == "latch":
                    latch.clear(["the_base", "the_tool"], ["the_base", "the_tool"])
                    await asyncio.to_thread(
                        main, ["estop", "--clear", "--services", str(moved.node.file)]
                    )
                await run
                await usable(operator, name)
        for name, seconds in took.items():
            ordered = sorted(seconds)
            print(
                f"{kind}, {name}: n {len(ordered)}, median {ordered[15]:.3f} s, most "
                f"{ordered[-1]:.3f} s, limit {limit} s"
            )
        assert max(max(took["base"]), max(took["tool"])) <= limit


# --- the guard itself -------------------------------------------------------------------------


@pytest.fixture
def latch(tmp_path: Path) -> Latch:
    return Latch("only", [tmp_path])


def test_a_node_that_never_sent_a_heartbeat_is_not_silent(latch: Latch) -> None:
    guard = Guard("base", latch)
    for look in range(1_000):
        guard.heard(look * GUARD_LOOK, False)
    assert guard.look(1_000.0) == ""


def test_silence_and_heartbeats(latch: Latch) -> None:
    guard, now = Guard("base", latch), 5.0
    guard.look(now)
    guard.heard(now, True)
    silent_from = now + SILENCE
    while now < silent_from - GUARD_LOOK:
        assert guard.look(now) == ""
        now += GUARD_LOOK
    now = silent_from + GUARD_LOOK
    assert guard.look(now) == NODE_SILENT
    guard.heard(now, False)
    assert guard.look(now) == ""


def test_a_process_that_was_frozen_itself_does_not_blame_its_node(latch: Latch) -> None:
    """Messages that the node sent meanwhile are still unread, so the node gets a little more time,
    once."""
    guard = Guard("base", latch)
    guard.look(0.0)
    guard.heard(0.0, True)
    assert guard.look(30.0) == ""
    now = 30.0
    while now < 30.0 + AGAIN - GUARD_LOOK / 2:
        assert guard.look(now) == ""
        now += GUARD_LOOK
    assert guard.look(30.0 + AGAIN + GUARD_LOOK) == NODE_SILENT


@pytest.mark.parametrize(("names", "stops"), [(["base"], True), ([ALL], True), (["tool"], False)])
def test_the_latch_works_without_the_node(latch: Latch, names: list[str], stops: bool) -> None:
    guard = Guard("base", latch)
    assert guard.look(0.0) == ""
    latch.stop(names)
    assert guard.look(1.0) == (EMERGENCY_STOP if stops else "")


class Watched(Process):
    """A device loop that watches the latch and the node, and a node that sends heartbeats."""

    def __init__(self, driver: Moving, latch: Latch) -> None:
        node, loop_end = socket.socketpair()
        self.descriptors, far = socket.socketpair()
        self.node, self._far, self._loop_end = Pipe(node), far, Pipe(loop_end)
        guard = Guard("base", latch)
        loop = DeviceLoop(driver, NoPorts(), self._loop_end, far, guard)  # type: ignore[arg-type]  # all that it uses
        self.thread = threading.Thread(target=loop.run)
        self.thread.start()

    def beat_until(self, link: Any, fits: Callable[[list[Any]], bool]) -> list[Any]:
        """Send heartbeats until a state fulfils the condition."""
        found: list[list[Any]] = []

        def look() -> list[Any]:
            self.node.post(Ping(1))
            state = link.newest()
            found.extend([state] if state is not None and fits(state) else [])
            time.sleep(GUARD_LOOK)
            return found

        return list(wait(look)[0])


def test_the_latch_stops_a_driver_while_its_node_sends_heartbeats(latch: Latch) -> None:
    """It accepts commands again when the node says so, not when the latch's file is removed."""
    driver = Moving()
    process = Watched(driver, latch)
    link = process.link()
    process.beat_until(link, lambda s: s[5] == "")
    latch.stop(["base"])
    process.beat_until(link, lambda s: s[5] == EMERGENCY_STOP)
    assert "stop" in driver.log
    link.send([1, "command", {"go": 1}])
    assert "emergency stop" in process.beat_until(link, lambda s: s[0] == 1)[1]
    latch.clear(["base"], ["base"])
    process.node.post(Command("c", "clear_emergency"))
    process.beat_until(link, lambda s: s[5] == "")
    link.close()
    process.end()


def test_a_driver_stops_when_its_node_is_frozen_before_its_first_beat(latch: Latch) -> None:
    """A worker was attached, so the device can move; from then on it watches for the node's
    heartbeats."""
    driver = Moving()
    process = Watched(driver, latch)
    link = process.link()
    link.send([1, "command", {"go": 1}])
    stopped = states(link, lambda s: s[5] == NODE_SILENT and s[2])
    assert stopped[0] == 1 and "stop" in driver.log
    link.close()
    process.end()


def test_a_driver_stops_when_its_node_is_silent_and_continues_when_it_is_not(latch: Latch) -> None:
    driver = Moving()
    process = Watched(driver, latch)
    link = process.link()
    process.beat_until(link, lambda s: s[5] == "")
    link.send([1, "command", {"go": 1}])
    process.beat_until(link, lambda s: s[0] == 1)
    stopped = states(link, lambda s: s[5] == NODE_SILENT and s[2])
    assert stopped[0] == 1 and "stop" in driver.log
    link.send([2, "command", {"go": 1}])
    assert "was silent" in states(link, lambda s: s[0] == 2)[1]
    process.beat_until(link, lambda s: s[5] == "")
    link.send([3, "command", {"go": 1}])
    assert process.beat_until(link, lambda s: s[0] == 3)[1] == ""
    link.close()
    process.end()
