"""Nodes as real processes: calls, hanging and dying actions, cyclic drivers, streams, memory, and
shutdown."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.lockstep.mesh import Member
from petrobot.services.comm.protocol.messages import (
    Accept,
    Answer,
    Call,
    Command,
    Event,
    Hello,
    Outcome,
)
from tests.node.conftest import OUTSIDE
from tests.node.test_lockstep import (
    CALLS,
    CELL as LOCKSTEP,
    Bench as LockstepBench,
    Coordinator,
    World,
    trace_of,
)
from tests.ports import free_ports
from tests.processes import alive, children
from tests.waiting import Limit

pytestmark = pytest.mark.processes
ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
"""Limit (s) of each wait for a condition, for slow machines; a wait reaches it only if something is
broken."""

CELL = """\
schema = 1
[nodes.left]
host = "127.0.0.1"
port = {left}
worker_memory_mb = 900
[nodes.right]
host = "127.0.0.1"
port = {right}
[devices.slide]
node = "left"
driver = "toy_cell.drivers:Slide"
period = 0.02
speed = 4.0
[devices.eye]
node = "right"
driver = "toy_cell.drivers:Eye"
[streams.points]
to = "slide"
period = 0.02
[timers.beat]
node = "right"
period = 0.02
[services.memory]
node = "right"
[services.sum_service]
node = "right"
run = "toy_cell.actions:add"
[services.slow_service]
node = "right"
run = "toy_cell.actions:slow_service"
[actions]
go = {{ run = "toy_cell.actions:go", task = "move", device = "slide" }}
follow = {{ run = "toy_cell.actions:follow", task = "move", device = "slide" }}
loop = {{ run = "toy_cell.actions:loop", task = "move", device = "slide" }}
hang_moving.run = "toy_cell.actions:hang_moving"
hang_moving.task = "move"
hang_moving.device = "slide"
hang_moving.deadline = 0.3
crash_arm = {{ run = "toy_cell.actions:segfault", task = "move", device = "slide" }}
lead = {{ run = "toy_cell.actions:lead", task = "see", device = "eye" }}
eye_pid = {{ run = "toy_cell.actions:pid", task = "see", device = "eye" }}
hang_eye = {{ run = "toy_cell.actions:hang", task = "see", device = "eye", deadline = 1.0 }}
add = {{ run = "toy_cell.actions:add", task = "sum", node = "left" }}
nap = {{ run = "toy_cell.actions:nap", task = "sum", node = "left" }}
doze = {{ run = "toy_cell.actions:nap", task = "sum", node = "left", orphan_time = 0.2 }}
relay = {{ run = "toy_cell.actions:relay", task = "sum", node = "left" }}
swap_left = {{ run = "toy_cell.actions:swap", task = "sum", node = "left" }}
swap_right = {{ run = "toy_cell.actions:swap", task = "sum", node = "right" }}
hang = {{ run = "toy_cell.actions:hang", task = "sum", node = "left", deadline = 1.0 }}
segfault = {{ run = "toy_cell.actions:segfault", task = "sum", node = "left" }}
leave = {{ run = "toy_cell.actions:leave", task = "sum", node = "left" }}
eat = {{ run = "toy_cell.actions:eat", task = "sum", node = "left" }}
pid = {{ run = "toy_cell.actions:pid", task = "sum", node = "left" }}
tell = {{ run = "toy_cell.actions:tell", task = "sum", node = "left" }}
"""


PATIENT = LinkTiming(silence=10.0)
"""Of connections in tests about something else than a node that is silent, as any node may be on a
busy host."""


class Operator:
    """Clients of all nodes, with the role of a coordinator."""

    def __init__(self, directory: Directory, timing: LinkTiming = PATIENT) -> None:
        self.directory = directory
        self.timing = timing
        self.clients: dict[str, Client] = {}
        self.notices: list[Notice] = []
        self.changed = asyncio.Event()
        self.numbers = 0
        self.boot = os.urandom(8).hex()

    async def connect(self, *nodes: str) -> None:
        for node in nodes:
            hello = Hello(
                2, 2, "coordinator", "operator", f"{self.boot} {node}", 1, self.directory.hash
            )
            caller = Caller(node, hello, auto_ack=True)
            host, port = self.directory.address(node)
            self.clients[node] = Client(
                host, port, caller, on_notices=self._take, timing=self.timing
            )
            self.clients[node].start()
            assert await self.clients[node].connected(PATIENCE)

    def _take(self, now: float, notices: list[Notice]) -> None:
        self.notices += notices
        self.changed.set()

    async def call(
        self, service: str, deadline: float | None = None, /, **arguments: Any
    ) -> Outcome:
        client = self.clients[self.directory.where(service)]
        return await asyncio.wait_for(
            client.call(service, arguments, deadline=deadline, seed=3), PATIENCE
        )

    async def heard(self, kind: type[Any], fits: Callable[[Any], bool] = lambda _: True) -> Any:
        async with asyncio.timeout(PATIENCE):
            while True:
                for notice in self.notices:
                    if isinstance(notice, kind) and fits(notice):
                        return notice
                self.changed.clear()
                await self.changed.wait()

    async def command(self, node: str, verb: str, target: str = "") -> Answer:
        self.numbers += 1
        client, identity = self.clients[node], f"{verb} {self.numbers}"
        client.caller.command(client.now(), Command(identity, verb, target))
        client.flush()
        answered = await self.heard(Answer, lambda notice: notice.id == identity)
        answer: Answer = answered
        return answer

    async def until(self, holds: Callable[[], Awaitable[bool]], timeout: float = PATIENCE) -> None:
        async with asyncio.timeout(timeout):
            while not await holds():
                await asyncio.to_thread(select_nothing)

    async def close(self) -> None:
        for client in self.clients.values():
            await client.close()


def select_nothing() -> None:
    """Let some milliseconds pass without blocking the event loop."""
    import select

    select.select([], [], [], 0.01)


def start_node(name: str, file: Path, *options: str) -> subprocess.Popen[str]:
    """Launch a node as a process; its log is NAME.log beside the file."""
    with (file.parent / f"{name}.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "petrobot.services", name, "--services", str(file), *options],
            env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )


class Nodes:
    """The node processes of a cell."""

    def __init__(self, folder: Path, *names: str, text: str = CELL, mock: str = "") -> None:
        self.file = folder / "services.toml"
        left, right = free_ports(2)
        self.file.write_text(text.format(left=left, right=right))
        self.directory = parse(self.file.read_text(), self.file)
        self.processes = {name: self._start(name, mock) for name in names}
        for name in names:
            self._await(name)

    def _await(self, name: str) -> None:
        process = self.processes[name]
        assert process.stdout is not None
        line = process.stdout.readline()
        why = "" if line else process.communicate(timeout=PATIENCE)[1]
        assert "ready" in line, f"{name}: {line!r} {why}"

    def restart(self, name: str) -> None:
        """Kill a node and start it again."""
        self.processes[name].kill()
        self.processes[name].communicate(timeout=PATIENCE)
        self.processes[name] = self._start(name, "")
        self._await(name)

    def _start(self, name: str, mock: str) -> subprocess.Popen[str]:
        return start_node(name, self.file, *(["--mock", mock] if mock else []))

    def stop(self) -> dict[str, int]:
        codes = {}
        for process in self.processes.values():
            if process.poll() is None:
                process.terminate()
        for name, process in self.processes.items():
            process.communicate(timeout=PATIENCE)
            codes[name] = process.returncode
        return codes


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    """Both nodes, shared by the tests that leave them unchanged."""
    running = Nodes(tmp_path_factory.mktemp("cell"), "left", "right")
    yield running
    assert running.stop() == {"left": 0, "right": 0}


@asynccontextmanager
async def operator_of(
    directory: Directory, *names: str, timing: LinkTiming = PATIENT
) -> AsyncIterator[Operator]:
    operator = Operator(directory, timing)
    await operator.connect(*names)
    try:
        yield operator
    finally:
        await operator.close()


@pytest.fixture
async def operator(nodes: Nodes) -> AsyncIterator[Operator]:
    """An operator's clients, connected to both nodes."""
    async with operator_of(nodes.directory, "left", "right") as one:
        yield one


async def pids(operator: Operator, node: str, device: str) -> dict[str, int]:
    answer = await operator.command(node, "status", device)
    found: dict[str, int] = answer.data["devices"][device or node]["pids"]
    return found


async def begun(
    operator: Operator, service: str, deadline: float | None = None, /, **arguments: Any
) -> Outcome:
    """Call until its process begins the run before its deadline: on a busy host it may be late."""
    tries = Limit("a run that begins before its deadline")
    while (end := await operator.call(service, deadline, **arguments)).executed == "no":
        assert end.cause == "deadline" and tries.left(), end
    return end


async def follows(operator: Operator) -> None:
    """Wait until the device of the left node follows set points from the right one. On a busy host
    one of the two runs may end before the other begins."""
    limit = Limit("a device that follows")
    while limit.left():
        following = asyncio.create_task(operator.call("follow", seconds=1.0))
        leading, end = await operator.call("lead", seconds=0.8), await following
        assert (leading.status, end.status) == ("success", "success"), (leading, end)
        if end.values["count"] >= 3 and end.values["position"] > 0.0:
            return


async def cycles(operator: Operator) -> int:
    """Return how often the slide's driver has been stepped."""
    status = await operator.command("left", "status", "slide")
    return int(status.data["devices"]["slide"]["state"]["cycles"])


async def test_actions_services_and_memory_across_nodes(operator: Operator) -> None:
    assert (await operator.call("add", a=2, b=3)).values == {"sum": 5}
    end = await operator.call("relay", a=4)
    assert end.values["sum"] == 6 and end.values["version"] == 1
    assert end.values["pid"] == (await operator.call("pid")).values["pid"], "the worker is not warm"
    assert (await operator.call("slow_service", seconds=0.05)).seconds >= 0.05
    bad = await operator.call("add", c=1)
    assert (bad.cause, bad.executed) == ("bad_arguments", "no")


async def test_two_nodes_share_a_variable_without_losing_an_update(operator: Operator) -> None:
    ends = await asyncio.gather(
        operator.call("swap_left", times=20), operator.call("swap_right", times=20)
    )
    assert [(end.status, end.text) for end in ends] == [("success", "")] * 2
    assert (await operator.call("memory.get", name="count")).values["value"] == 40


async def test_events_progress_and_pulses(operator: Operator) -> None:
    right = operator.clients["right"]
    right.caller.subscribe(right.now(), ["beat", "memory:sum"])
    right.flush()
    await operator.call("relay", a=1)
    await operator.heard(Event, lambda notice: notice.data.get("value") == 3)
    await operator.heard(Event, lambda notice: notice.name == "beat")
    call = Call(f"told {operator.boot}", "tell", {"name": "hello"}, seed=3)
    left = operator.clients["left"]
    left.caller.call(left.now(), call)
    left.flush()
    event = await operator.heard(Event, lambda notice: notice.name == "hello")
    assert event.run == call.id and event.number >= 1


async def test_a_cyclic_device_moves_and_is_paced(operator: Operator) -> None:
    assert (await operator.call("go", to=0.0, timeout=PATIENCE)).status == "success"
    end = await operator.call("go", to=0.8, timeout=PATIENCE)
    assert end.status == "success" and end.values["position"] == pytest.approx(0.8)
    # ten periods at 4 m/s; the first has begun already, and a late one is followed by a short one
    assert end.seconds >= 0.15, "4 m/s is the slide's limit"
    limit, paced = Limit("a driver that is not stepped more often than its period says"), False
    while not paced and limit.left():  # a node that was late may have told an older count at first
        began, first = time.monotonic(), await cycles(operator)
        await operator.until(partial(_stepped, operator, first + 25))
        last, took = await cycles(operator), time.monotonic() - began
        paced = last - first <= took / 0.02 + 2
    refused = await operator.call("go", to=1e6)
    assert refused.cause == "refused" and "beyond the rail" in refused.text


async def test_set_points_from_node_to_node(operator: Operator) -> None:
    await follows(operator)


async def test_a_hanging_action_is_ended_at_its_deadline_while_the_node_answers(
    operator: Operator,
) -> None:
    before, answered, limit = await pids(operator, "left", ""), 0, Limit("two answers meanwhile")
    while answered < 2 and limit.left():
        answered, hanging = 0, asyncio.create_task(begun(operator, "hang"))
        await operator.heard(Accept)
        while not hanging.done() and limit.left():
            status = await operator.command("left", "status", "slide")
            assert status.ok
            answered += 1
        end = await hanging
        assert (end.status, end.cause, end.executed) == ("error", "deadline", "yes")
        assert "killed" in end.text or "deadline" in end.text
    assert (await operator.call("add", a=1)).values == {"sum": 2}
    after = await pids(operator, "left", "")
    gone = {*before.values()} - {*after.values()}  # any of the node's workers may have run it
    assert gone and not any(map(alive, gone))


async def test_a_hanging_action_that_moves_has_its_device_stopped_first(operator: Operator) -> None:
    assert (await operator.call("go", to=0.0, timeout=PATIENCE)).status == "success"
    drivers = await pids(operator, "left", "slide")
    end = await begun(operator, "hang_moving")
    assert (end.cause, end.executed) == ("deadline", "yes")
    status = await operator.command("left", "status", "slide")
    state = status.data["devices"]["slide"]["state"]
    assert state["stops"] >= 1 and state["position"] < 20.0, "the slide ran on"
    again = await operator.call("go", to=state["position"])
    assert (again.status, again.text) == ("success", "")
    now = await pids(operator, "left", "slide")
    assert now["driver"] == drivers["driver"] and now["actions"] != drivers["actions"]


@pytest.mark.parametrize(
    ("service", "code", "says"),
    [
        ("segfault", {}, "SIGSEGV"),
        # 90 and 91 once meant something to the node
        *(("leave", {"code": code}, f"exited with code {code}") for code in (0, 7, 90, 91, 92)),
    ],
)
async def test_a_dying_worker_is_reported_and_started_again(
    operator: Operator, service: str, code: dict[str, int], says: str
) -> None:
    end = await operator.call(service, **code)
    assert (end.status, end.cause, end.executed) == ("error", "worker_died", "unknown")
    assert says in end.text
    assert (await operator.call("add", a=1)).values == {"sum": 2}


async def test_kill_9_of_a_worker_during_a_run(operator: Operator) -> None:
    assert (await operator.call("go", to=0.0, timeout=PATIENCE)).status == "success"
    running = asyncio.create_task(operator.call("go", to=90.0, timeout=PATIENCE))
    await operator.until(lambda: _moving(operator))
    found = await pids(operator, "left", "slide")
    os.kill(found["actions"], signal.SIGKILL)
    end = await running
    assert (end.cause, end.executed) == ("worker_died", "unknown") and "SIGKILL" in end.text
    first = await operator.command("left", "status", "slide")
    began = first.data["devices"]["slide"]["state"]["cycles"]
    await operator.until(lambda: _stepped(operator, began + 10))
    second = await operator.command("left", "status", "slide")
    states = [a.data["devices"]["slide"]["state"] for a in (first, second)]
    assert states[0]["position"] == states[1]["position"], "the slide did not stop"
    assert states[1]["cycles"] > states[0]["cycles"], "the driver's process stopped too"


async def _stepped(operator: Operator, count: int) -> bool:
    return await cycles(operator) >= count


async def _moving(operator: Operator) -> bool:
    status = await operator.command("left", "status", "slide")
    return float(status.data["devices"]["slide"]["state"]["position"]) > 0.5


async def test_kill_9_of_a_driver(operator: Operator) -> None:
    assert (await operator.call("go", to=0.0, timeout=PATIENCE)).status == "success"
    running = asyncio.create_task(operator.call("go", to=90.0, timeout=PATIENCE))
    await operator.until(lambda: _moving(operator))
    found = await pids(operator, "left", "slide")
    os.kill(found["driver"], signal.SIGKILL)
    end = await running
    assert (end.status, end.cause, end.executed) == ("error", "device_died", "unknown"), end.text
    assert (await operator.call("go", to=0.0, timeout=PATIENCE)).status == "success"
    now = await pids(operator, "left", "slide")
    assert now["driver"] != found["driver"] and not alive(found["actions"])


async def test_memory_has_a_limit(operator: Operator) -> None:
    end = await operator.call("eat", megabytes=4000)
    assert end.status == "error" and "MemoryError" in end.text
    assert (await operator.call("eat", megabytes=10)).values == {"bytes": 10 << 20}


async def test_a_device_without_cycle_has_one_process(operator: Operator) -> None:
    found = await pids(operator, "right", "eye")
    assert found == {"actions": (await operator.call("eye_pid")).values["pid"]}
    end = await begun(operator, "hang_eye")
    assert (end.cause, end.executed) == ("deadline", "yes")
    assert (await operator.call("eye_pid")).values["pid"] != found["actions"]


async def test_cancel_hold_and_release(operator: Operator) -> None:
    left = operator.clients["left"]
    running = asyncio.create_task(operator.call("go", to=91.0, timeout=PATIENCE))
    await operator.heard(Accept)
    assert (await operator.command("left", "hold", "slide")).data["answers"] == {"slide": "held"}
    first = await operator.command("left", "status", "slide")
    await operator.call("nap", seconds=0.1)
    second = await operator.command("left", "status", "slide")
    positions = [a.data["devices"]["slide"]["state"]["position"] for a in (first, second)]
    assert positions[0] == positions[1]
    await operator.command("left", "release", "slide")
    await operator.until(lambda: _beyond(operator, positions[1]))
    busy = await operator.call("go", to=0.0)
    assert (busy.cause, busy.executed) == ("busy", "no")
    left.caller.cancel(left.now(), next(iter(left.caller.pending)), "enough")
    left.flush()
    end = await running
    assert (end.cause, end.executed) == ("cancelled", "yes")
    eye = await operator.command("right", "hold", "eye")
    assert not eye.ok and eye.data["answers"] == {"eye": "cannot hold"}


async def _beyond(operator: Operator, position: float) -> bool:
    status = await operator.command("left", "status", "slide")
    return float(status.data["devices"]["slide"]["state"]["position"]) > position


async def test_an_orphaned_run_is_stopped(nodes: Nodes, operator: Operator) -> None:
    other = Operator(nodes.directory)
    hello = Hello(2, 2, "coordinator", "leaver", "boot", 1, nodes.directory.hash)
    client = Client(
        *nodes.directory.address("left"),
        Caller("left", hello, auto_ack=True),
        on_notices=other._take,
    )
    client.start()
    assert await client.connected(PATIENCE)
    client.caller.call(client.now(), Call("orphan", "doze", {"seconds": 60.0}))
    client.flush()
    await other.heard(Accept)
    await client.close()

    async def gone() -> bool:
        status = await operator.command("left", "status")
        return "orphan" not in status.data["devices"]["left"]["runs"]

    await operator.until(gone)


async def test_sigterm_ends_a_node_and_all_its_processes(tmp_path: Path) -> None:
    running = Nodes(tmp_path, "left")
    async with operator_of(running.directory, "left") as operator:
        children = {
            **await pids(operator, "left", "slide"),
            "general": (await pids(operator, "left", ""))["actions"],
        }
        call = Call("last", "go", {"to": 80.0})
        left = operator.clients["left"]
        left.caller.call(left.now(), call)
        left.flush()
        await operator.heard(Accept)
        assert await asyncio.to_thread(running.stop) == {"left": 0}
    assert not [name for name, pid in children.items() if alive(pid)]


async def test_kill_9_of_a_node_ends_its_processes(tmp_path: Path) -> None:
    running = Nodes(tmp_path, "left")
    async with operator_of(running.directory, "left") as operator:
        children = {
            **await pids(operator, "left", "slide"),
            "general": (await pids(operator, "left", ""))["actions"],
        }
        hanging = asyncio.create_task(operator.call("hang", 30.0))
        await operator.heard(Accept)
        running.processes["left"].kill()
        assert (await hanging).executed == "unknown"

        async def gone() -> bool:
            return not any(map(alive, children.values()))

        await operator.until(gone)
    assert running.stop() == {"left": -9}


def test_lock_step_in_four_processes_equals_that_in_one(tmp_path: Path) -> None:
    ports = dict(zip(("left", "right", "world", "coordinator"), free_ports(4), strict=True))
    text = LOCKSTEP.replace("NODE", "right").replace(
        "schema = 1\n", f"schema = 1\n[coordinator]\nport = {ports['coordinator']}\n"
    )
    for name, old in (("left", 7401), ("right", 7402), ("world", 7400)):
        text = text.replace(f"port = {old}", f"port = {ports[name]}")
    file = tmp_path / "services.toml"
    file.write_text(text)
    places = parse(text, file)
    script: list[tuple[int, str, dict[str, Any]]] = [
        (5 + 10 * n, service, arguments) for n, (service, arguments) in enumerate(CALLS)
    ]
    alone = LockstepBench(places, script)
    alone.run(1.2)
    nodes = [start_node(name, file, "--lockstep") for name in ("left", "right")]
    coordinator, world = Coordinator(places, script), World(places)
    parties: list[Any] = [coordinator, world]
    members = [
        Member(p.name, [p], places.members(), directory=places.hash, patience=PATIENCE)
        for p in parties
    ]
    threads = [threading.Thread(target=run_member, args=(member, 300)) for member in members]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(2 * PATIENCE)
    assert [process.wait(PATIENCE) for process in nodes] == [0, 0]
    for process in nodes:
        process.communicate()
    assert trace_of(coordinator) == trace_of(alone.coordinator)


def run_member(member: Member, ticks: int) -> None:
    """Take part in a lock-step cell for so many ticks."""
    member.open()
    member.run(max_ticks=ticks)


async def test_scripted_actions(tmp_path: Path) -> None:
    script = tmp_path / "script.toml"
    script.write_text(
        "schema = 1\n[[actions.add]]\nvalues = { sum = 7 }\n[[actions.add]]\nstatus = "
        '"error"\ncause = "tired"\n'
    )
    running = Nodes(tmp_path, "left", mock=str(script))
    async with operator_of(running.directory, "left") as operator:
        first, second, third = [await operator.call("add", anything=1) for _ in range(3)]
        assert first.values == third.values == {"sum": 7} and (second.status, second.cause) == (
            "error",
            "tired",
        )
    assert running.stop() == {"left": 0}


BAD = [
    ("port = {left}\n", "", "nodes.left.port: is missing"),
    (
        "toy_cell.drivers:Slide",
        "toy_cell.drivers:Slid",
        "has no callable 'Slid'; did you mean 'Slide'?",
    ),
    (
        "period = 0.02\nspeed",
        "pace = 1\nspeed",
        "devices.slide: toy_cell.drivers:Slide refuses it: is missing 'period'",
    ),
    ('host = "127.0.0.1"\nport = {left}', 'host = "0.0.0.0"\nport = {left}', "petrobot keys"),
]


@pytest.mark.parametrize(("old", "new", "says"), BAD)
def test_a_bad_file_ends_the_node_with_one_clear_text(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    assert old in CELL
    file = tmp_path / "services.toml"
    left, right = free_ports(2)
    file.write_text(CELL.replace(old, new, 1).format(left=left, right=right))
    ended = subprocess.run(
        [sys.executable, "-m", "petrobot.services", "left", "--services", str(file)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert ended.returncode == 2 and says in ended.stderr and "Traceback" not in ended.stderr


def test_an_idle_node_uses_almost_no_processor_time(nodes: Nodes) -> None:
    """An idle node and its processes use almost no processor time."""
    limit, idle = (
        Limit("an idle second: does something poll although nothing is to be done?"),
        False,
    )
    while not idle and limit.left():  # processes may still start again after the test before
        before, began = _cpu(nodes), time.monotonic()
        while time.monotonic() < began + 1.0:
            select_nothing()
        idle = _cpu(nodes) - before < 0.5 * (time.monotonic() - began)


def _cpu(nodes: Nodes) -> float:
    total = 0.0
    for process in nodes.processes.values():
        for pid in {process.pid, *children(process.pid)}:
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


SLOW_TO_START = """
import time
from pathlib import Path
from petrobot import Driver

class Slow(Driver):
    period = 0.01

    def __init__(self, config, ports):
        super().__init__(config, ports)
        with Path(__file__).with_name("made").open("a") as made:
            made.write("made\\n")
        time.sleep(0.5)

    def step(self, now):
        pass

    def stopped(self):
        return True
"""


@pytest.mark.processes
def test_of_two_processes_of_a_node_started_together_one_touches_its_device(
    tmp_path: Path,
) -> None:
    """As two people do who both run `petrobot up`. The first listens only once its device is ready;
    the second must not disturb it before that either."""
    (tmp_path / "slow.py").write_text(SLOW_TO_START)
    file = tmp_path / "services.toml"
    file.write_text(
        f'schema = 1\nnodes.left = {{ host = "127.0.0.1", port = {free_ports(1)[0]} }}\n'
        'devices.slow = { node = "left", driver = "slow:Slow" }\n'
    )
    nodes = [start_node("left", file) for _ in range(2)]
    try:
        said = sorted("ready" in node.stdout.readline() for node in nodes if node.stdout)
        assert said == [False, True]
        assert (tmp_path / "made").read_text() == "made\n"
        assert "is in use on 127.0.0.1" in (tmp_path / "left.log").read_text()
    finally:
        for node in nodes:
            node.terminate()
            node.communicate(timeout=PATIENCE)


SLOW_TO_STOP = """
import os, time
from pathlib import Path
from petrobot import Driver

class Slow(Driver):
    period = 0.01
    asked = None

    def note(self, what):
        with Path(__file__).with_name("notes").open("a") as notes:
            notes.write(f"{what} {os.getpid()}\\n")

    def __init__(self, config, ports):
        super().__init__(config, ports)
        self.note("made")

    def step(self, now):
        self.note("step")

    def stop(self, now):
        self.asked = self.asked or time.monotonic()

    def stopped(self):
        return self.asked is not None and time.monotonic() > self.asked + 30
"""


@pytest.mark.processes
def test_the_successor_of_a_killed_node_waits_until_the_driver_has_ended(tmp_path: Path) -> None:
    """A killed node's driver has up to 3 s for the stop routine of its device."""
    (tmp_path / "slow.py").write_text(SLOW_TO_STOP)
    file = tmp_path / "services.toml"
    file.write_text(
        f'schema = 1\nnodes.left = {{ host = "127.0.0.1", port = {free_ports(1)[0]} }}\n'
        'devices.slow = { node = "left", driver = "slow:Slow" }\n'
    )
    for _ in range(2):
        node = start_node("left", file)
        try:
            assert node.stdout is not None and "ready" in node.stdout.readline()
            node.stdout.close()  # not `communicate`: the driver keeps it open, too
        finally:
            node.kill()
            node.wait(timeout=PATIENCE)
    drivers = [line.split()[1] for line in (tmp_path / "notes").read_text().splitlines()]
    first = drivers[0]
    assert len(set(drivers)) == 2
    assert first not in drivers[drivers.index(drivers[-1]) :], "two drivers moved one device"
