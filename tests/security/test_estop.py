"""The emergency stop with real processes: coordinator or node is frozen during a move, and the
drives still stop, as the bus shows."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import estop, main
from petrobot.coordinator.cli.estop import HARDWARE
from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.launch import Setting, local_programs, realtime_mission
from petrobot.coordinator.operator.emergency_stop import order_all, still_stopped
from petrobot.coordinator.operator.run_address import RunAddress, find_address, published
from petrobot.coordinator.run.folder import NoRunError, header
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.canopen.cia402 import DriveState
from petrobot.services.comm.location_file import Directory, load
from petrobot.services.comm.protocol.security import new_key, write_key
from petrobot.services.device import Driver
from petrobot.services.host.emergency_latch import latch_of
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import Node
from tests.in_loop import NodeInLoop
from tests.node.test_processes import Nodes, operator_of, pids
from tests.ports import free_ports
from tests.security.arm_cell import DRIVES, ROOT, Ear, cell_in, ear_on
from tests.security.conftest import Command
from tests.waiting import Limit, beat, until

pytestmark = pytest.mark.processes
LIMIT = 60.0
RAMP = 1.0
"""Seconds after which a drive's quick stop and braking have ended."""


def petrobot(*arguments: str, **variables: str) -> subprocess.Popen[str]:
    """Start a command in a separate process, with these environment variables."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.Popen(
        [sys.executable, "-m", "petrobot.coordinator", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


async def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Return its exit code and output."""
    out, err = await asyncio.to_thread(process.communicate, None, LIMIT)
    return process.returncode, out, err


class Cell:
    """The launched nodes, a listener on the bus, and a coordinator that moves the arm."""

    def __init__(
        self, folder: Path, directory: Directory, supervisor: Supervisor, ear: Ear
    ) -> None:
        self.folder = folder
        self.directory = directory
        self.supervisor = supervisor
        self.ear = ear
        self.runs = folder / "runs"
        self._cell = ["--services", str(directory.source), "--journal", str(self.runs)]
        self.coordinator: subprocess.Popen[str] | None = None

    async def heard(self, holds: Callable[[Ear], bool]) -> None:
        """Wait until the data on the bus fulfil a condition."""
        await asyncio.to_thread(self.ear.until, holds, LIMIT)

    async def sweep(self) -> None:
        """Let a coordinator move the arm, and wait until it moves."""
        await self.heard(lambda ear: len(ear.positions) == len(DRIVES))
        self.ear.forget()
        self.coordinator = self.task()
        await self.heard(Ear.moving)

    def task(self, **variables: str) -> subprocess.Popen[str]:
        """Start a coordinator that would move the arm."""
        task = str(self.folder / "sweeping.toml")
        options = [*self._cell, "--no-page", "--quiet"]
        return petrobot("run", task, "--runs", "3", *options, **variables)

    async def estop(self, *options: str) -> tuple[int, Any]:
        """Give `petrobot estop`; return its exit code and answers. It is a process, as for the
        operator: here it would share the interpreter with the listener on the bus."""
        code, out, err = await finished(petrobot("estop", *self._cell, "--json", "-", *options))
        assert out, err
        return code, json.loads(out)

    async def clear(self) -> int:
        """Clear the stop, and return the exit code."""
        return await asyncio.to_thread(main, ["estop", "--clear", *self._cell])

    async def standing(self) -> None:
        """Wait until the joints have not moved during the time of a braking ramp."""
        limit = Limit("joints that stand")
        while True:
            limit.left()
            before = dict(self.ear.positions)
            await asyncio.to_thread(threading.Event().wait, RAMP / 4)
            if all(abs(self.ear.positions[n] - before[n]) < 200 for n in DRIVES):
                return


def without_power(ear: Ear) -> bool:
    """Return whether no drive has power: a drive whose master dies is in FAULT until it is
    reset."""
    return all(
        ear.states.get(n) in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT) for n in DRIVES
    )


@asynccontextmanager
async def cell_of(folder: Path, *, respawn: bool = False) -> AsyncIterator[Cell]:
    """Start laboratory and motion node as processes."""
    directory = cell_in(folder)
    async with Supervisor(
        local_programs(directory), folder / "logs", respawn=respawn
    ) as supervisor:
        with ear_on(directory) as ear:
            cell = Cell(folder, directory, supervisor, ear)
            try:
                yield cell
            finally:
                if cell.coordinator is not None:
                    cell.coordinator.kill()
                    cell.coordinator.communicate()
                for pid in supervisor.process_ids().values():
                    os.kill(pid, signal.SIGCONT)


async def test_estop_stops_the_drives_though_the_coordinator_is_frozen(tmp_path: Path) -> None:
    """SIGSTOP during a move: there is a quick stop on the bus, the drives brake, and nothing moves
    them before the stop is cleared. With `--bus` the bus itself is stopped without waiting for the
    node, and works again afterwards."""
    async with cell_of(tmp_path) as cell:
        limit = Limit("a node that answers before its bus is stopped, too")
        while True:
            await cell.sweep()
            assert cell.coordinator is not None and limit.left()
            cell.coordinator.send_signal(signal.SIGSTOP)
            code, told = await cell.estop()
            (node,) = told["nodes"]
            assert (code, node["node"], set(node["devices"])) == (0, "motion", {"arm"})
            assert told["coordinator"].endswith("the coordinator does not answer")
            if not node["bus"]:  # else, on a busy host, the drives say nothing more
                await cell.heard(without_power)
                if cell.ear.all_in(DriveState.SWITCH_ON_DISABLED):
                    break  # else the host was so busy that they missed their master before
            cell.coordinator.send_signal(signal.SIGCONT)
            assert (await finished(cell.coordinator))[0] == 1 and await cell.clear() == 0
        await cell.heard(lambda ear: ear.quick_stop_at is not None)
        await cell.standing()
        cell.coordinator.send_signal(signal.SIGCONT)
        code, _, _ = await finished(cell.coordinator)
        assert code == 1, "the task's own recovery must not have moved the arm"
        assert without_power(cell.ear)
        assert await cell.clear() == 0
        assert without_power(cell.ear), "clearing alone moves and enables nothing"
        await cell.sweep()  # through the task's error branch: an action resets the drives
        code, told = await cell.estop("--bus")
        (node,) = told["nodes"]
        assert code == 0 and node["bus"].endswith("all devices stopped by NMT") and node["devices"]
        await cell.heard(Ear.stopped_by_nmt)
        assert told["coordinator"].endswith(("aborted", "has ended"))
        assert (await finished(cell.coordinator))[0] == 1
        assert await cell.clear() == 0
        await cell.sweep()  # bus and drives are configured again


@pytest.mark.parametrize(
    "answers", [True, False], ids=["told itself", "frozen when it was to be told"]
)
async def test_a_stop_remains_after_its_node_is_killed(tmp_path: Path, answers: bool) -> None:
    """The node is killed (kill -9) and restarted: the drives stay without power, whatever a task
    tries, until the stop is cleared. If it is frozen and does not answer, it is reported missing,
    and all devices of its bus are stopped by NMT."""
    async with cell_of(tmp_path, respawn=True) as cell:
        await cell.sweep()
        assert cell.coordinator is not None
        if not answers:
            os.kill(cell.supervisor.process_ids()["motion"], signal.SIGSTOP)
        code, told = await cell.estop()
        (node,) = told["nodes"]
        if answers:
            assert code == 0
        else:
            assert code == 3 and node["seconds"] is None and node["latch"].startswith("latched")
            assert node["bus"].endswith("all devices stopped by NMT")
            await cell.heard(Ear.stopped_by_nmt)
        assert (await finished(cell.coordinator))[0] == 1
        os.kill(cell.supervisor.process_ids()["motion"], signal.SIGKILL)
        log = tmp_path / "logs" / "motion.log"
        await until(lambda: log.read_text().count("motion ready on") == 2)
        assert "petrobot estop --clear" in log.read_text(), (
            "whoever starts it sees why nothing moves"
        )
        await cell.heard(without_power)
        cell.ear.forget()
        if answers:  # where the latch comes from changes nothing for those who ask before they move
            code, _, err = await finished(cell.task())
            assert code == 2 and "petrobot estop --clear" in err, err
            code, _, err = await finished(cell.task(PETROBOT_STATE=str(tmp_path / "another host")))
            assert code == 2 and "arm: emergency stop: clear it" in err, err
        mission = realtime_mission(
            cell.directory, Setting(load_task(str(tmp_path / "sweeping.toml"))), "asks for no lease"
        )
        shell = RealtimeMission(mission, cell.directory)
        await shell.connect(LIMIT)
        await asyncio.wait_for(shell.run(), LIMIT)
        await shell.close()
        assert mission.executor.finished is not None
        assert mission.executor.finished.reason == "aborted: emergency stop, as motion reports"
        assert without_power(cell.ear) and cell.ear.energised == 0, "not even for a moment"
        assert await cell.clear() == 0
        await cell.sweep()


async def test_estop_names_a_device_whose_driver_hangs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its node answers, but nothing has stopped the device: exit code 3. The driver that replaces
    it is stopped from its start, and then the exit code is 0."""
    nodes = Nodes(tmp_path, "left", "right")
    command = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        assert await asyncio.to_thread(main, command) == 0
        capsys.readouterr()
        async with operator_of(nodes.directory, "left") as operator:
            os.kill((await pids(operator, "left", "slide"))["driver"], signal.SIGSTOP)
            assert await asyncio.to_thread(main, command) == 3
            out = capsys.readouterr().out
            assert "NOT KNOWN TO STAND STILL: slide; press the hardware's" in out, out
            assert "eye" in out and "eye;" not in out
            limit = Limit("its successor to be in emergency stop")
            while await asyncio.to_thread(main, command) and limit.left():
                await beat(0.1)
            assert "slide        stopped" in capsys.readouterr().out
            refused = await operator.call("go", to=1.0)
            assert (refused.cause, refused.executed) == ("emergency_stop", "no")
    finally:
        nodes.stop()


async def test_estop_says_that_a_stop_is_not_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The devices are stopped, but a restarted node would not know it: exit code 3."""
    monkeypatch.setenv("PETROBOT_STATE", "/proc/none")  # nothing can be written there
    nodes = Nodes(tmp_path, "left", "right")
    command = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path), "--json", "-"]
    try:
        assert await asyncio.to_thread(main, command) == 3
        (left,) = [n for n in json.loads(capsys.readouterr().out)["nodes"] if n["node"] == "left"]
        assert left["devices"] == {"slide": "stopped"} and "NOT STORED" in left["note"], left
        assert "could not be stored: /proc/none" in (tmp_path / "left.log").read_text()
    finally:
        nodes.stop()


async def test_estop_without_nodes_says_so(tmp_path: Path) -> None:
    """No node runs: exit code 3, and the message says that nothing was stopped."""
    directory = cell_in(tmp_path)
    services = ["--services", str(directory.source), "--journal", str(tmp_path)]
    code, out, _ = await finished(petrobot("estop", *services))
    assert code == 3 and "NO ANSWER" in out and "no CAN hub" in out
    with pytest.raises(NoRunError):
        find_address(folder=tmp_path)


async def test_names_that_nobody_resolves_keep_no_stop_from_other_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lookups blocked all threads of the loop, also those for the latch of a node of this host,
    and the answer came after the last of them."""
    answered, known = threading.Event(), socket.getaddrinfo

    def look_up(host: str, *rest: Any, **options: Any) -> list[Any]:
        if host.endswith(".example"):
            answered.wait(LIMIT)
            raise socket.gaierror(socket.EAI_AGAIN, "no answer")
        return known(host, *rest, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    absent = [f"a{n}" for n in range(40)]
    hosts = {**{name: f"{name}.example" for name in absent}, "here": "localhost"}
    ports = dict(zip(hosts, free_ports(len(hosts)), strict=True))
    lines = ["schema = 1", '[keys]\nfile = "cell.key"']
    for name, host in hosts.items():
        lines.append(f'[nodes.{name}]\nhost = "{host}"\nport = {ports[name]}')
        lines.append(f'[devices.arm_{name}]\nnode = "{name}"\ndriver = "m:Arm"')
    source = tmp_path / "services.toml"
    source.write_text("\n".join(lines))
    write_key(tmp_path / "cell.key", new_key())
    try:
        answers = {one.node: one for one in await order_all(load(source))}
        assert not answered.is_set()
    finally:
        answered.set()
    assert answers["here"].latch.startswith("latched")
    assert {answers[name].latch for name in absent} == {
        f"not latched: the lookup of {name}.example takes too long; run `petrobot estop` there "
        "before it is started again"
        for name in absent
    }


@pytest.mark.parametrize("keys", ['file = "cell.key"', 'certificates = "keys"'])
async def test_a_key_that_cannot_be_used_does_not_keep_a_stop_from_bus_and_latch(
    tmp_path: Path, keys: str, command: Command
) -> None:
    """A wrong copy of a key, in the middle of its replacement, must not disarm the stop."""
    source = cell_in(tmp_path).source
    source.write_text(f"{source.read_text()}\n[keys]\n{keys}\n")
    services = ["--services", str(source), "--journal", str(tmp_path)]
    code, out, err = await command("estop", *services)
    assert code == 3 and "NO ANSWER: " in out and "No such file" in out, err
    assert "no CAN hub" in out and "latched" in out
    code, out, _ = await command("estop", "--clear", *services)
    assert code == 0 and "No such file" in out and "; its stop is cleared on disk" in out


def not_toml(cell: Path) -> None:
    """A slip of the editor."""
    cell.write_text("schema = 1\n[nodes.pc")


def a_pipe(file: Path) -> None:
    """Whoever opens it hangs, as on a disk that does not answer."""
    file.unlink(missing_ok=True)
    file.parent.mkdir(exist_ok=True, parents=True)
    os.mkfifo(file)


@pytest.mark.parametrize("harm", [not_toml, a_pipe])
async def test_estop_that_knows_no_node_says_that_nothing_was_stopped(
    tmp_path: Path, harm: Callable[[Path], None]
) -> None:
    """Without a run there is no other record of the cell."""
    harm(source := cell_in(tmp_path).source)
    services = ["--services", str(source), "--journal", str(tmp_path)]
    code, _, said = await finished(petrobot("estop", *services))
    assert code == 2 and said.endswith(f"\nNOTHING WAS STOPPED: {HARDWARE}\n"), said


@pytest.mark.parametrize("file", ["runs/one/operator.json", ".petrobot/motion.stopped"])
async def test_a_disk_that_hangs_keeps_no_stop_from_the_bus(tmp_path: Path, file: str) -> None:
    """That of the runs or of the latch: the stop is stored elsewhere."""
    source = cell_in(tmp_path).source
    a_pipe(tmp_path / file)
    services = ["--services", str(source), "--journal", str(tmp_path / "runs")]
    home = str(tmp_path / "home")
    code, out, said = await finished(petrobot("estop", *services, XDG_STATE_HOME=home))
    assert code == 3 and "no CAN hub" in out and " latched: " in out, out + said
    # Only nodes of this user look into the folder of this user.
    assert (" as this user keeps its devices stopped" in out) is (".petrobot" in file), out
    code, *_ = await finished(petrobot("estop", "--clear", *services, XDG_STATE_HOME=home))
    assert code == 0


def test_a_busy_host_is_no_disk_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    """To read sixty nodes may take it longer than the wait for a disk."""
    monkeypatch.setattr(estop, "DISK_PATIENCE", 0.05)

    def reads() -> str:
        until_then = time.process_time() + 0.3
        while time.process_time() < until_then:
            pass
        return "found"

    never = threading.Event()
    assert estop._in_time(reads, lambda: "not found") == "found"
    assert estop._in_time(lambda: str(never.wait(60.0)), lambda: "not found") == "not found"
    never.set()


async def test_a_stop_is_cleared_while_its_node_does_not_run(
    tmp_path: Path, command: Command
) -> None:
    """If the nodes end with the run, the stop could not be cleared otherwise: exit code 0, and the
    file is removed."""
    directory = cell_in(tmp_path)
    services = ["--services", str(directory.source), "--journal", str(tmp_path)]
    code, out, _ = await command("estop", *services)
    assert code == 3 and "latched" in out and still_stopped(directory) == ["motion"]
    code, out, _ = await command("estop", "--clear", *services)
    assert code == 0 and "cleared on disk" in out and "NO ANSWER" not in out
    assert still_stopped(directory) == []
    code, *_ = await command("estop", "--clear", *services)
    assert code == 3, "nobody there, and nothing to clear"


ONE_NODE = """schema = 1
[nodes.pc]
host = "127.0.0.1"
port = {}
[devices.axis]
node = "pc"
driver = "petrobot:Driver"
"""


@asynccontextmanager
async def node_of(cell: Path) -> AsyncIterator[None]:
    """Run the node of a location file in this loop, with its latch on disk."""
    directory, clock = load(cell), asyncio.get_running_loop().time
    axis = InlineHost({}, clock=clock, driver=Driver({}, None))
    latch = latch_of(cell, "pc")
    node = Node(directory, "pc", boot="b1", clock=clock, places={"axis": axis}, latch=latch)
    running = NodeInLoop(node, directory.address("pc"))
    await running.start()
    try:
        yield
    finally:
        await running.close()


def renamed(cell: Path) -> None:
    """Give the only node another name and another port."""
    cell.write_text(ONE_NODE.replace("pc", "robot").format(*free_ports(1)))


@pytest.mark.parametrize(
    ("edit", "code"),
    [
        (lambda cell: cell.write_text("schema = 1\n[nodes.pc"), 0),
        (lambda cell: cell.unlink(), 0),
        (renamed, 3),
    ],
    ids=["not TOML", "removed", "renamed"],
)
@pytest.mark.parametrize("killed", [False, True])
async def test_a_file_that_was_edited_in_mid_run_does_not_keep_a_stop_from_its_nodes(
    tmp_path: Path, edit: Callable[[Path], Any], code: int, killed: bool, command: Command
) -> None:
    """A slip of the editor disarmed the stop, and a node that had another name meanwhile was not
    stopped, later only if the coordinator was `killed`. The stop is cleared where it was stored."""
    cell = tmp_path / "services.toml"
    cell.write_text(ONE_NODE.format(*free_ports(1)))
    async with node_of(cell):
        then = header("run", "", cell.read_text(), "realtime", {"services_path": str(cell)})
        JournalWriter(tmp_path / "runs" / "run" / "run.journal", then).close()
        edit(cell)
        address = RunAddress("run", "http://127.0.0.1:9", "token", os.getpid(), str(cell))
        journal = ["--journal", str(tmp_path / "runs")]
        services = ["--services", str(cell), *journal]
        if killed:
            found = await command("estop", *services)
        else:
            with published(tmp_path / "runs" / "run", address):
                found = await command("estop", *journal)
        assert found[0] == code and re.search("^pc +axis +stopped$", found[1], re.M), found
        found = await command("estop", "--clear", *services)
        assert found[0] == 0 and re.search("^pc +axis +cleared$", found[1], re.M), found


@asynccontextmanager
async def breaking(far: int, way: str, piece: int) -> AsyncIterator[int]:
    """Carry the bytes of connections to a port of this host. The first connection breaks before
    this piece (1, 2, ...) of what goes `up` to the node or `down` from it."""
    pairs: list[asyncio.Task[object]] = []

    async def carry(
        reader: asyncio.StreamReader, writer: asyncio.StreamWriter, breaks: bool
    ) -> None:
        pieces = 0
        while data := await reader.read(1 << 16):
            pieces += 1
            if breaks and pieces == piece:
                writer.transport.abort()
                return
            writer.write(data)
        writer.close()

    async def join(near: asyncio.StreamReader, to_near: asyncio.StreamWriter) -> None:
        first = not pairs
        far_end, to_far = await asyncio.open_connection("127.0.0.1", far)
        up = carry(near, to_far, first and way == "up")
        down = carry(far_end, to_near, first and way == "down")
        pairs.extend((asyncio.create_task(up), asyncio.create_task(down)))
        await asyncio.wait(pairs[-2:], return_when=asyncio.FIRST_COMPLETED)
        to_near.transport.abort()
        to_far.transport.abort()

    server = await asyncio.start_server(join, "127.0.0.1", 0)
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        server.close()
        await asyncio.gather(*pairs, return_exceptions=True)
    assert len(pairs) > 2, "it never broke"


@pytest.mark.parametrize("way", ["up", "down"])
@pytest.mark.parametrize("piece", [1, 2])
async def test_a_stop_is_given_again_when_its_connection_breaks(
    tmp_path: Path, way: str, piece: int
) -> None:
    """It broke after the node had accepted it, and the stop was not repeated: a node on another
    host was left as it was."""
    cell = tmp_path / "services.toml"
    cell.write_text(ONE_NODE.format(*free_ports(1)))
    async with node_of(cell), breaking(load(cell).nodes["pc"].port, way, piece) as port:
        there = tmp_path / "there.toml"
        there.write_text(ONE_NODE.format(port))
        (answer,) = await order_all(load(there))
        assert answer.answered and answer.done and answer.devices == {"axis": "stopped"}, answer


async def test_a_stop_that_was_kept_for_a_node_with_another_copy_of_its_file_is_cleared(
    tmp_path: Path, command: Command
) -> None:
    """The copy of the caller said for ever that the node was stopped, with a remedy that did
    nothing."""
    cell = ONE_NODE.format(*free_ports(1))
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "services.toml").write_text(cell)
    directory = load(tmp_path / "here" / "services.toml")
    services = ["--services", str(directory.source), "--journal", str(tmp_path)]
    code, out, _ = await command("estop", *services)
    assert code == 3 and "latched" in out and still_stopped(directory) == ["pc"]
    async with node_of(tmp_path / "there" / "services.toml"):
        code, out, err = await command("estop", "--clear", *services)
        assert code == 0 and "cleared" in out, (out, err)
        assert still_stopped(directory) == []


async def test_estop_says_that_a_stop_cannot_be_cleared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the clearing cannot be counted, the node answers, and its devices stay stopped."""
    monkeypatch.setenv("PETROBOT_STATE", str(tmp_path / "state"))
    (tmp_path / "state" / "left.cleared").mkdir(parents=True)
    nodes = Nodes(tmp_path, "left", "right")
    command = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        assert await asyncio.to_thread(main, command) == 0
        capsys.readouterr()
        assert await asyncio.to_thread(main, [*command, "--clear"]) == 3
        out = capsys.readouterr().out
        assert "NOT CLEARED: " in out and "its devices stay stopped" in out, out
        assert "NO ANSWER" not in out and "right        eye          cleared" in out, out
        async with operator_of(nodes.directory, "left") as operator:
            assert (await operator.call("go", to=1.0)).cause == "emergency_stop"
    finally:
        nodes.stop()


async def test_a_stop_of_a_frozen_node_is_cleared_for_its_driver_too(tmp_path: Path) -> None:
    """The process of its cyclic driver has seen the stop, the node has not: when it continues, the
    device accepts orders, as the command said."""
    nodes = Nodes(tmp_path, "left", "right")
    command = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        async with operator_of(nodes.directory, "left") as operator:
            await pids(operator, "left", "slide")
        node = nodes.processes["left"].pid
        os.kill(node, signal.SIGSTOP)
        assert await asyncio.to_thread(main, command) == 3
        log = tmp_path / "left.log"
        limit = Limit("the driver to see the stop")
        while "emergency" not in log.read_text() and limit.left():
            await beat(0.05)
        assert await asyncio.to_thread(main, [*command, "--clear"]) == 0
        os.kill(node, signal.SIGCONT)
        async with operator_of(nodes.directory, "left") as operator:
            limit = Limit("the driver to know of the clearing")
            while (moved := await operator.call("go", to=0.1)).cause and limit.left():
                await beat(0.05)
        assert moved.status == "success", moved
    finally:
        nodes.stop()


async def test_a_stop_of_a_frozen_driver_is_cleared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its node clears the stop, so nothing is left to do: exit code 0, and the device accepts
    orders as soon as its process continues."""
    nodes = Nodes(tmp_path, "left", "right")
    command = ["estop", "--services", str(nodes.file), "--journal", str(tmp_path)]
    try:
        async with operator_of(nodes.directory, "left") as operator:
            drivers = (await pids(operator, "left", "slide")).values()
        assert await asyncio.to_thread(main, command) == 0
        for pid in drivers:
            os.kill(pid, signal.SIGSTOP)
        capsys.readouterr()
        assert await asyncio.to_thread(main, [*command, "--clear"]) == 0
        assert "left         slide        cleared (no answer)" in capsys.readouterr().out
        for pid in drivers:
            os.kill(pid, signal.SIGCONT)
        async with operator_of(nodes.directory, "left") as operator:
            limit = Limit("the driver to know of the clearing")
            while (moved := await operator.call("go", to=0.1)).cause and limit.left():
                await beat(0.05)
        assert moved.status == "success", moved
    finally:
        nodes.stop()
