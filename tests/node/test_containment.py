"""Faults of user code end only its own run: processes that it leaves behind, blocking, crashes, and
too much memory."""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import time
from collections.abc import AsyncIterator, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.calls.caller import PeerLost
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.protocol.messages import Call, Feedback, Outcome
from petrobot.services.node.child import Child
from petrobot.services.worker.pipe import Item
from petrobot.services.worker.process import READY, Setup, Surroundings
from tests.node.conftest import OUTSIDE
from tests.node.test_kills import passing
from tests.node.test_processes import (
    CELL,
    PATIENCE,
    ROOT,
    Nodes,
    Operator,
    begun,
    operator_of,
    pids,
)
from tests.processes import alive, kill, parent
from tests.waiting import Limit, until

pytestmark = pytest.mark.processes
DEADLINE = 1.0
LATE = 20.0
"""Seconds after its deadline within which a run must have ended on a busy host: grace period, kill,
and a margin. Less than the action blocks."""
TEXT = (
    CELL.replace("worker_memory_mb = 900\n", "worker_memory_mb = 450\nworkers = 6\n")
    + """\
leave_behind = {{ run = "toy_cell.actions:leave_behind", task = "sum", node = "left" }}
leave_behind_eye = {{ run = "toy_cell.actions:leave_behind", task = "see", device = "eye" }}
leave_behind_slide = {{ run = "toy_cell.actions:leave_behind", task = "move", device = "slide" }}
keep_memory = {{ run = "toy_cell.actions:keep_memory", task = "sum", node = "left" }}
block = {{ run = "toy_cell.actions:block", task = "sum", node = "left" }}
chatter = {{ run = "toy_cell.actions:chatter", task = "sum", node = "left" }}
write_down = {{ run = "toy_cell.actions:write_down", task = "sum", node = "left" }}
change = {{ run = "toy_cell.actions:change", task = "sum", node = "left" }}
"""
)
WAYS = ("fork", "daemon", "program", "program with sockets")
OF_NO_USE = ("closed output", "closed files", "memory", "files", "priority")
"""Changes after which a process may be of no more use."""
PLACES = ("leave_behind", "leave_behind_eye", "leave_behind_slide")


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    """Both nodes, shared by the tests that must leave them in working order."""
    running = Nodes(tmp_path_factory.mktemp("cell"), "left", "right", text=TEXT)
    yield running
    assert running.stop() == {"left": 0, "right": 0}


@pytest.fixture
def own_nodes(tmp_path: Path) -> Iterator[Nodes]:
    """Both nodes, for one test that stops them or needs fresh workers."""
    running = Nodes(tmp_path, "left", "right", text=TEXT)
    try:
        yield running
    finally:
        running.stop()


@pytest.fixture
async def operator(nodes: Nodes) -> AsyncIterator[Operator]:
    """An operator's clients, connected to both nodes."""
    async with operator_of(nodes.directory, "left", "right") as one:
        yield one


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """A file that a test removes when runs that wait for that may end."""
    file = tmp_path / "gate"
    file.touch()
    return file


def napping(operator: Operator, count: int, gate: Path) -> list[asyncio.Task[Outcome]]:
    """Begin runs that end when the gate is removed."""
    call = partial(operator.call, "nap", PATIENCE, seconds=PATIENCE, gate=str(gate))
    return [asyncio.create_task(call()) for _ in range(count)]


async def gone(operator: Operator, process: int) -> None:
    """Wait until a process has ended."""

    async def ended() -> bool:
        return not alive(process)

    await operator.until(ended)


@pytest.mark.parametrize("how", WAYS)
async def test_a_deadline_holds_even_if_processes_were_left_behind(
    operator: Operator, tmp_path: Path, how: str
) -> None:
    for service in PLACES:
        mark = tmp_path / f"{service} {how}"
        tries = Limit("a process that leaves another one behind before the deadline")
        while not (mark.exists() and mark.read_text()) and tries.left():
            end = await operator.call(service, DEADLINE, how=how, mark=str(mark), then="block")
        assert (end.status, end.cause, end.executed) == ("error", "deadline", "yes"), end
        assert "blocked" in end.text and end.seconds < DEADLINE + LATE, end
        await gone(operator, int(mark.read_text()))
    assert (await operator.call("add", a=1)).values == {"sum": 2}
    assert (await operator.call("eye_pid")).status == "success"
    assert (await operator.call("go", to=0.0)).status == "success"


@pytest.mark.parametrize("how", WAYS)
async def test_processes_left_by_a_crashed_worker_end_with_it(
    operator: Operator, tmp_path: Path, how: str
) -> None:
    for service in PLACES:
        mark = tmp_path / f"{service} {how}"
        end = await operator.call(service, PATIENCE, how=how, mark=str(mark), then="crash")
        assert (end.cause, end.executed) == ("worker_died", "unknown") and "SIGSEGV" in end.text
        await gone(operator, int(mark.read_text()))


@pytest.mark.parametrize(
    "way", ["worker killed", "worker killed, keeper frozen", "node killed", "node stopped"]
)
async def test_what_an_action_leaves_running_lives_as_long_as_its_worker(
    own_nodes: Nodes, tmp_path: Path, way: str
) -> None:
    nodes = own_nodes
    async with operator_of(nodes.directory, "left", "right") as operator:
        left, workers = [], []
        for how in WAYS:
            for service in PLACES:
                mark = tmp_path / f"{service} {how}"
                end = await operator.call(service, PATIENCE, how=how, mark=str(mark))
                assert end.status == "success", end
                left.append(int(mark.read_text()))
                workers.append(end.values["pid"])
        assert all(map(alive, left)), "an action that ends well keeps what it has started"
        if way.startswith("worker killed"):
            if way.endswith("keeper frozen"):
                kill(map(parent, set(workers)), signal.SIGSTOP)
            kill(set(workers))
        elif way == "node stopped":
            assert await asyncio.to_thread(nodes.stop) == {"left": 0, "right": 0}
        else:
            for node in nodes.processes.values():
                node.kill()
        for process in (*left, *workers):
            await gone(operator, process)


async def test_an_action_that_closes_its_pipe_ends_only_its_run(
    operator: Operator, tmp_path: Path
) -> None:
    for then in ("block", "return"):
        for service in PLACES:
            innocent = asyncio.ensure_future(operator.call("nap", 20.0, seconds=0.5))
            mark = tmp_path / f"{service} {then}"
            end = await operator.call(service, 30.0, how="no pipe", mark=str(mark), then=then)
            assert (end.status, end.cause) == ("error", "worker_died"), end
            assert "closed" in end.text and "pipe" in end.text and "exited" not in end.text
            assert end.seconds < LATE
            assert (await innocent).status == "success"
            await gone(operator, int(mark.read_text()))
    assert (await operator.call("add", a=1)).values == {"sum": 2}
    assert (await operator.call("eye_pid")).status == "success"
    assert (await operator.call("go", to=0.0)).status == "success"


async def test_a_copy_that_returns_from_the_action_does_nothing_more(
    operator: Operator, tmp_path: Path
) -> None:
    for number, service in enumerate(PLACES):
        mark = tmp_path / f"{number}"
        end = await operator.call(service, 10.0, how="fork that returns", mark=str(mark))
        assert (end.status, end.values["pid"]) == ("success", int(mark.read_text()))
    assert (await operator.call("add", a=1)).values == {"sum": 2}
    assert (await operator.call("go", to=0.5)).status == "success", (
        "a copy has stopped the device, or taken its link"
    )


@pytest.mark.parametrize("deadline", [3.0, None], ids=["at its deadline", "without one"])
async def test_a_stopped_worker_is_killed(own_nodes: Nodes, deadline: float | None) -> None:
    """The nodes are fresh, so their only worker is the one that runs the action."""
    async with operator_of(own_nodes.directory, "left", "right") as operator:
        for service, arguments, node, device in (
            ("nap", {"seconds": 60.0}, "left", ""),
            ("go", {"to": 90.0, "timeout": 60.0}, "left", "slide"),
        ):
            operator.notices.clear()
            running = asyncio.create_task(operator.call(service, deadline, **arguments))
            await operator.heard(Feedback)  # its action runs
            found = await pids(operator, node, device)
            os.kill(found["actions"], signal.SIGSTOP)
            end = await running
            if deadline is None:
                assert (end.cause, end.executed) == ("worker_died", "unknown"), end
                assert "did not answer for 5 s" in end.text
            else:
                assert (end.cause, end.executed) == ("deadline", "yes"), end
                assert "answered nothing" in end.text
        assert (await operator.call("go", 60.0, to=0.0, timeout=50.0)).status == "success"


async def test_a_blocking_and_a_crashing_action_end_only_their_runs(operator: Operator) -> None:
    # The workers are started beforehand: their start on a busy host must not count.
    assert {
        run.status
        for run in await asyncio.gather(*(operator.call("nap", seconds=1.0) for _ in range(5)))
    } == {"success"}
    naps = [asyncio.create_task(operator.call("nap", 20.0, seconds=2.5)) for _ in range(3)]
    crashing = asyncio.create_task(operator.call("segfault", 20.0))
    end = await begun(operator, "block", DEADLINE, seconds=30.0)
    assert (end.cause, end.executed) == ("deadline", "yes") and "blocked" in end.text, end
    assert end.seconds < DEADLINE + LATE
    assert ((await crashing).cause, (await crashing).executed) == ("worker_died", "unknown")
    assert [(await nap).status for nap in naps] == ["success"] * 3


async def served(operator: Operator, service: str, limit: float, **arguments: Any) -> Outcome:
    """Call until a worker takes the call: on a busy host none may become free in time."""
    tries = Limit("a free worker")
    while (end := await operator.call(service, limit, **arguments)).cause == "busy":
        assert end.executed == "no" and tries.left()
    return end


async def test_many_calls_at_once_run_once_each_beside_blocking_and_crashing_ones(
    operator: Operator, tmp_path: Path
) -> None:
    """Many calls at once queue in few workers. None may be lost there, run twice, or end because of
    the one before it."""
    file = tmp_path / "lines"
    bad: dict[int, tuple[str, float, dict[str, Any]]] = {
        5: ("block", DEADLINE, {"seconds": 30.0}),
        20: ("segfault", 20.0, {}),
        30: ("nap", 20.0, {"seconds": 1.0}),
        40: ("segfault", 20.0, {}),
        50: ("block", 20.0, {"seconds": 0.05}),
    }
    for batch in range(3):
        calls = []
        for number in range(80):
            service, limit, arguments = bad.get(number, ("write_down", 20.0, {}))
            line = f"{batch} {number}"
            if service == "write_down":
                arguments = {"file": str(file), "line": line}
            calls.append(served(operator, service, limit, **arguments))
        ends = await asyncio.gather(*calls)
        good = [end for number, end in enumerate(ends) if number not in bad]
        assert not [end for end in good if end.status != "success"]
        assert [(ends[n].status, ends[n].cause) for n in bad] == [
            ("error", "deadline"),
            ("error", "worker_died"),
            ("success", ""),
            ("error", "worker_died"),
            ("success", ""),
        ]
    expected = [f"{batch} {n}" for batch in range(3) for n in range(80) if n not in bad]
    assert sorted(file.read_text().split("\n")[:-1]) == sorted(expected)


async def test_messages_sent_before_a_process_ended_are_read(
    own_nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node is busy while its process ends two runs and crashes; it notices this only when it
    sends another call to the process."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{OUTSIDE}")
    results: list[str] = []
    over = asyncio.Event()

    def hear(child: Child, items: list[Item]) -> None:
        results.extend(item.id for item in items if isinstance(item, Outcome))
        if isinstance(items[0], list) and items[0][0] == READY:
            for line in ("1", "2"):
                child.give(
                    Call(line, "write_down", {"file": str(tmp_path / "lines"), "line": line})
                )
            child.give(Call("3", "segfault", {}))
            limit = Limit("the end of the process")
            while child.code is None and limit.left():
                time.sleep(0.01)
            child.give(Call("4", "write_down", {}))
            assert child.closed and not results

    setup = Setup(str(own_nodes.file), own_nodes.file.read_text(), "left", "")
    child = Child(setup, hear, lambda child: over.set())
    async with asyncio.timeout(PATIENCE):
        await over.wait()
    assert results == ["1", "2"]
    assert child.code == -signal.SIGSEGV


@pytest.mark.parametrize(
    ("what", "ends"),
    [("progress", {"deadline"}), ("events", {"too_many_events", "deadline"})],
    ids=["progress", "events"],
)
async def test_a_run_that_reports_without_end_disturbs_no_other(
    nodes: Nodes, what: str, ends: set[str]
) -> None:
    """Events that are stored as fast as they come let it run to its deadline."""
    async with operator_of(nodes.directory, "left", timing=LinkTiming()) as operator:
        chatting = asyncio.create_task(operator.call("chatter", 2.0, what=what))
        others = []
        limit = Limit("the run to end at its deadline")
        while not chatting.done() and limit.left():
            others.append(await operator.call("nap", 20.0, seconds=0.05))
        assert (await chatting).cause in ends
        assert others and {run.status for run in others} == {"success"}
        assert not [notice for notice in operator.notices if isinstance(notice, PeerLost)]


async def test_a_run_beyond_the_limit_is_refused_with_the_reason(
    operator: Operator, gate: Path
) -> None:
    naps = napping(operator, 6, gate)

    async def full() -> bool:
        status = await operator.command("left", "status")
        return bool(status.data["answers"]["left"] == "busy")

    await operator.until(full)
    refused = await operator.call("add", a=1)
    assert (refused.status, refused.cause, refused.executed) == (
        "error",
        "busy",
        "no",
    ) and "workers" in refused.text
    gate.unlink()
    assert [(await nap).status for nap in naps] == ["success"] * 6
    assert (await operator.call("add", a=1)).values == {"sum": 2}
    status = await operator.command("left", "status")
    assert (
        status.data["answers"]["left"] == "up" and len(status.data["devices"]["left"]["pids"]) == 6
    )


async def test_too_much_memory_ends_only_its_run(own_nodes: Nodes) -> None:
    async with operator_of(own_nodes.directory, "left", "right") as operator:
        nap = asyncio.create_task(operator.call("nap", 20.0, seconds=4.0))
        other = await operator.call("nap", 20.0, seconds=0.1)
        assert other.status == "success"
        before = await pids(operator, "left", "")
        assert len(before) >= 2, "one for each nap"
        end = await operator.call("eat", 20.0, megabytes=4000)
        assert (end.status, end.cause, end.executed) == ("error", "out_of_memory", "yes"), end
        kept = await operator.call("keep_memory", 20.0)
        assert (kept.status, kept.cause) == ("error", "out_of_memory"), kept
        assert (await nap).status == "success"
        assert (await operator.call("eat", megabytes=300)).values == {"bytes": 300 << 20}, (
            "the memory of another run"
        )
        after = set((await pids(operator, "left", "")).values())
        assert not after.issuperset(before.values()), "a process that ran out of memory is replaced"


async def test_hold_and_stop_reach_all_runs_without_a_device(
    operator: Operator, gate: Path
) -> None:
    naps = napping(operator, 2, gate)
    await until(lambda: sum(isinstance(one, Feedback) for one in operator.notices) == 2)
    assert (await operator.command("left", "hold")).data["answers"]["left"] == "held"
    gate.unlink()
    late = asyncio.create_task(operator.call("nap", 20.0, seconds=0.1))
    await passing(2.0)
    assert not any(nap.done() for nap in [*naps, late]), "a held run has ended"
    assert (await operator.command("left", "release")).data["answers"]["left"] == "released"
    assert [(await nap).status for nap in [*naps, late]] == ["success"] * 3
    assert (await operator.command("left", "hold")).data["answers"]["left"] == "held"
    held = asyncio.create_task(operator.call("nap", 20.0, seconds=0.1))
    blocked = asyncio.create_task(operator.call("block", 60.0, seconds=30.0))
    await passing(0.5)
    assert (await operator.command("left", "stop")).ok
    assert [(await run).cause for run in (held, blocked)] == ["stopped"] * 2
    assert (await operator.call("add", a=1)).values == {"sum": 2}


async def test_a_hold_that_is_read_after_its_run_does_not_hold_the_next(
    operator: Operator, gate: Path
) -> None:
    """A process that computes reads nothing: the hold waits in its pipe, behind its run."""
    mark = gate.with_name("blocks")
    blocked = asyncio.create_task(
        operator.call("block", 60.0, seconds=PATIENCE, mark=str(mark), gate=str(gate))
    )
    await until(mark.exists, "a process that computes")
    hold = asyncio.create_task(operator.command("left", "hold"))
    await operator.command("left", "status")  # answered after the hold was read
    gate.unlink()
    assert (await blocked).status == "success"
    ends = [await operator.call("nap", 20.0, seconds=0.05) for _ in range(3)]
    assert [end.status for end in ends] == ["success"] * 3
    await hold
    assert (await operator.call("nap", 20.0, seconds=0.05)).status == "success"


def test_a_process_with_too_many_open_files_is_given_up() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    left = [os.dup(2)]
    most = left[0] + 400  # whatever else is open in this process
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, before[1]))
    try:
        surroundings = Surroundings()
        assert surroundings.restored() == ""
        left += [os.dup(2) for _ in range(250)]
        assert "files open" in surroundings.restored()
    finally:
        for each in left:
            os.close(each)
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.parametrize(
    "what",
    [
        *("folder", "mask", "depth", "timer", "clock", "no output", "closed output", "memory"),
        *("files", "closed files", "environment", "path", "children", "warnings", "sockets"),
        *("numbers", "hook", "precision", "temporary files", "built-in", "collector", "silence"),
        *("processor", "signals", "priority"),
    ],
)
async def test_what_a_run_changes_in_its_process_does_not_reach_the_next(
    operator: Operator, what: str
) -> None:
    # The first worker is up again: it is used before the others.
    limit, first = Limit("the first worker"), {"pid": 0, "found": 0}
    while first["pid"] != (await pids(operator, "left", "")).get("actions") and limit.left():
        first = dict((await operator.call("change")).values)
    before = first["found"]
    changed = await operator.call("change", what=what)
    assert changed.status == "success" or what == "memory"
    again, number, limit = 0, 0, Limit("another run in the same process")
    while number < 12 or not (again or what in OF_NO_USE):
        assert limit.left()
        number += 1
        end = await operator.call("change")
        assert end.status == "success", end
        assert end.values["found"] == before
        again += end.values["pid"] == changed.values.get("pid")
        await asyncio.sleep(0.05)
