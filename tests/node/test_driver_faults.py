"""Faults of drivers are reported: exceptions, refusals and late cycles appear in the run's error,
in `petrobot nodes` and in the node's log."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.events import KEPT
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.protocol.messages import Call, Feedback, Hello
from petrobot.services.node.worker_host import START_LIMIT
from tests.node.conftest import OUTSIDE
from tests.node.test_processes import PATIENCE, ROOT, Operator, operator_of
from tests.ports import free_ports
from tests.waiting import Limit, beat, wait_for

pytestmark = pytest.mark.processes
FAULTS = {
    "step": "LookupError: nothing is right in step",
    "state": "LookupError: nothing is right in state",
    "leaves": "SystemExit: the vendor's library gave up in step (drivers.py:",
    "stopped": "LookupError: nothing is right in stopped",
    "not_plain": "state.arm.pose: a object is not plain data",
    "surrogate": "surrogates not allowed",
    "huge": "do not fit into one datagram",
    "event": "expected at most 255 characters, found 300",
}
"""Faults of a driver once an action has moved it, and the words that the user must find."""
DEVICE = """\
[devices.the_{name}]
node = "only"
driver = "toy_cell.drivers:Broken"
{period}
breaks = "{name}"
[actions.{name}]
run = "toy_cell.actions:{action}"
task = "work"
device = "the_{name}"
deadline = 20.0
"""
NODE = """\
schema = 1
[nodes.only]
host = "127.0.0.1"
port = {port}
[actions.add]
run = "toy_cell.actions:add"
task = "sum"
node = "only"
"""


class OneNode:
    """A node in a process, its standard error in a file."""

    def __init__(self, folder: Path, text: str) -> None:
        self.file, self.log = folder / "services.toml", folder / "node.log"
        self.file.write_text(text)
        self.directory: Directory = parse(text, self.file)
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "petrobot.services", "only", "--services", str(self.file)],
                env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )

    def until_ready(self) -> None:
        assert self.process.stdout is not None
        assert "ready" in self.process.stdout.readline(), self.log.read_text()

    def stop(self) -> None:
        self.process.terminate()
        self.process.communicate(timeout=PATIENCE)


def device(name: str, action: str = "order", period: str = "period = 0.02") -> str:
    return DEVICE.format(name=name, action=action, period=period)


def cell(*devices: str) -> str:
    return NODE.format(port=free_ports(1)[0]) + "".join(devices)


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OneNode]:
    """A node with a device for each fault, and devices on which a command of the node itself
    fails."""
    names = [*FAULTS, "stop", "hold", "picture", "command"]
    good = device("good", period="period = 0.004")
    direct = device("plain_stop", "order_directly", "").replace(
        'breaks = "plain_stop"', 'breaks = "stop"'
    )
    one = OneNode(tmp_path_factory.mktemp("heard"), cell(*map(device, names), good, direct))
    one.until_ready()
    yield one
    one.stop()


@pytest.fixture
async def operator(node: OneNode) -> AsyncIterator[Operator]:
    async with operator_of(node.directory, "only") as one:
        yield one


async def works(operator: Operator, name: str) -> None:
    """Check that the device accepts runs again as soon as its driver has returned."""
    limit = Limit("the device to accept runs")
    end = await operator.call(name, None, send=[], seconds=0.01)
    while end.cause == "fenced" and limit.left():
        await beat(0.1)
        end = await operator.call(name, None, send=[], seconds=0.01)
    assert (end.status, end.text) == ("success", "")


@pytest.mark.parametrize("name", FAULTS)
async def test_an_exception_of_a_driver_is_the_runs_error(
    node: OneNode, operator: Operator, name: str
) -> None:
    """The run ends at once with the driver's message, the log has it with a line of the driver,
    another run continues, and the device works again."""
    innocent = asyncio.create_task(operator.call("good", None, send=[{"go": True}], seconds=0.5))
    end = await operator.call(name, None, send=[{"go": True}, {"break": True}], seconds=15.0)
    assert (end.status, end.cause, end.executed) == ("error", "device_died", "unknown"), end
    assert FAULTS[name] in end.text and end.seconds < 14.0
    assert (await innocent).status == "success"
    log = node.log.read_text()
    assert FAULTS[name] in log and (", line " in log or "(drivers.py:" in log)
    await works(operator, name)


async def test_a_stop_routine_that_raises(node: OneNode, operator: Operator) -> None:
    end = await operator.call(
        "stop", None, send=[{"go": True}, {"break": True}], seconds=0.1, ends="raise"
    )
    assert end.status == "error" and "nothing is right in stop" in end.text, end
    await works(operator, "stop")


async def test_a_stop_routine_that_raises_beside_its_action(
    node: OneNode, operator: Operator
) -> None:
    client = operator.clients["only"]
    call = Call(
        f"beside {operator.boot}",
        "plain_stop",
        {"send": [{"break": True}, {"go": True}], "seconds": 15.0},
    )
    running = asyncio.create_task(client.call("plain_stop", call.arguments))
    await operator.heard(Feedback)
    await operator.command("only", "stop", "the_plain_stop")
    end = await asyncio.wait_for(running, PATIENCE)
    assert (end.status, end.cause) == (
        "error",
        "device_died",
    ) and "nothing is right in stop" in end.text, end
    await works(operator, "plain_stop")


async def test_a_hold_that_raises_ends_the_run(node: OneNode, operator: Operator) -> None:
    running = asyncio.create_task(
        operator.call("hold", None, send=[{"go": True}, {"break": True}], seconds=15.0, report=True)
    )
    await operator.heard(Feedback)
    await operator.command("only", "hold", "the_hold")
    end = await running
    assert (end.status, end.cause) == (
        "error",
        "device_died",
    ) and "nothing is right in hold" in end.text, end
    await works(operator, "hold")


async def test_a_picture_that_raises_stops_nothing(node: OneNode, operator: Operator) -> None:
    running = asyncio.create_task(
        operator.call("picture", None, send=[{"break": True}], seconds=1.0, report=True)
    )
    await operator.heard(Feedback)
    answer = await operator.command("only", "picture", "the_picture")
    assert answer.data["devices"]["the_picture"].get("mime") is None
    assert (await running).status == "success"
    assert "nothing is right in picture" in node.log.read_text()


@pytest.mark.parametrize(
    ("send", "says"),
    [
        ([{"odd": 3}], "the base takes no odd numbers: 3"),
        ([{"odd": 3}, {"go": True}], "the base takes no odd numbers: 3"),
        ([{"need": True}], "KeyError: 'what is not there'"),
        ([{"break": True}, {"go": True}], "LookupError: nothing is right in command"),
    ],
    ids=["refused", "refused, then another", "KeyError", "any exception"],
)
@pytest.mark.parametrize("seconds", [0.0, 0.1], ids=["returns at once", "waits"])
async def test_a_refusal_that_the_action_does_not_check(
    node: OneNode, operator: Operator, send: list[dict[str, Any]], says: str, seconds: float
) -> None:
    name = "command" if "break" in send[0] else "good"
    limit = Limit("a driver that runs in time to refuse it")
    while True:
        end = await operator.call(name, None, send=send, seconds=seconds)
        if end.cause != "command_not_taken" or not limit.left():
            break
    assert (end.status, end.cause, end.executed) == ("error", "command_refused", "yes"), end
    assert says in end.text
    assert says in node.log.read_text()


async def test_an_action_that_checks_the_refusal_decides_itself(operator: Operator) -> None:
    end = await operator.call("good", None, send=[{"odd": 5}], seconds=0.1, look=True)
    assert end.status == "success" and end.values == {"refused": "the base takes no odd numbers: 5"}
    own = await operator.call("good", None, send=[{"odd": 7}], seconds=0.1, ends="error")
    assert own.cause == "own" and "the base takes no odd numbers: 7" in own.text
    again = await operator.call("good", None, send=[{"go": True}], seconds=0.1)
    assert again.status == "success", "what an earlier run was refused is not this one's"


async def test_nodes_shows_refusals_and_missed_cycles(
    node: OneNode,
    operator: Operator,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # no line of the table is wrapped, however large the counts
    monkeypatch.setenv("COLUMNS", "400")
    for number in range(3):
        await operator.call("good", None, send=[{"odd": number}], seconds=0.05, look=True)
    slow = await operator.call("good", None, send=[{"block": 1.3}], seconds=2.0)
    assert slow.status == "success"
    status = (await operator.command("only", "status", "the_good")).data["devices"]["the_good"]
    assert status["refused"] >= 3 and status["overruns"] >= 200 and status["late_ms"] >= 1000
    code = await asyncio.to_thread(main, ["nodes", "--services", str(node.file), "--json", "-"])
    said = json.loads(capsys.readouterr().out)
    assert (
        code == 0 and said["only"]["status"]["devices"]["the_good"]["refused"] == status["refused"]
    )
    code = await asyncio.to_thread(main, ["nodes", "--services", str(node.file)])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert code == 0 and f"{status['refused']} refused" in shown and "cycles missed" in shown, shown
    assert "cycles were left out" in node.log.read_text()


async def test_events_that_a_subscriber_never_stores_are_dropped_and_shown(
    node: OneNode,
    operator: Operator,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    hello = Hello(2, 2, "client", "deaf", "deaf", 0, node.directory.hash)
    deaf = Caller("only", hello)  # it stores nothing, so it acknowledges nothing
    host, port = node.directory.address("only")
    client = Client(host, port, deaf, on_notices=lambda now, notices: None)
    client.start()
    try:
        assert await client.connected(PATIENCE)
        deaf.subscribe(client.now(), ["noise"])
        client.flush()
        # The same connection has carried the subscription before this call.
        added = await asyncio.wait_for(client.call("add", {"a": 1, "b": 2}), PATIENCE)
        assert added.values == {"sum": 3}
        end = await operator.call("good", None, send=[{"raise": KEPT + 7}], seconds=0.05)
        assert end.status == "success"
        dropped, limit = 0, Limit("the node to count what it dropped")
        while dropped < 7 and limit.left():
            answer = await operator.command("only", "status", "the_good")
            dropped = answer.data["events_dropped"].get("the_good", 0)
        assert dropped == 7
        assert await asyncio.to_thread(main, ["nodes", "--services", str(node.file)]) == 0
        shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert f"{dropped} events dropped" in shown, shown
        assert "the_good raises events faster than they are stored" in node.log.read_text()
    finally:
        await client.close()


async def test_a_driver_that_blocks_is_named_at_the_deadline(operator: Operator) -> None:
    said, limit = "", Limit("the node to say that the driver does not answer")
    while said != "no answer":  # on a busy host the run may end before the test asks
        running = asyncio.create_task(
            operator.call("good", 2.5, send=[{"block": 4.0}], seconds=60.0)
        )
        while said != "no answer" and not running.done() and limit.left():
            answer = await operator.command("only", "status", "the_good")
            said = answer.data["answers"]["the_good"]
        end = await running
        await works(operator, "good")
    assert end.cause == "deadline" and "the driver has published nothing for" in end.text, end


async def test_a_driver_that_takes_no_commands(operator: Operator) -> None:
    """The action returns at once, before the driver could refuse its last command."""
    end = await operator.call("good", None, send=[{"block": 3.5}, {"go": True}])
    assert (end.status, end.cause) == ("error", "command_not_taken"), end
    await works(operator, "good")


@pytest.mark.parametrize("breaks", ["constructor", "not_plain", "state", "step"])
def test_a_driver_that_is_broken_from_the_beginning(tmp_path: Path, breaks: str) -> None:
    """The node says so at once, without waiting for its devices to start."""
    text = cell(device(breaks).replace("\nbreaks", "\nat_once = true\nbreaks"))
    one = OneNode(tmp_path, text)
    out, _ = one.process.communicate(timeout=PATIENCE)
    log = one.log.read_text()
    assert one.process.returncode == 2 and "ready" not in out
    assert FAULTS.get(breaks, f"nothing is right in {breaks}") in log.splitlines()[-1], log
    assert ", line " in log or "(drivers.py:" in log  # the user's own line
    logged = next(line for line in log.splitlines() if " ERROR " in line)[:23]
    broke = datetime.strptime(logged, "%Y-%m-%d %H:%M:%S,%f").timestamp()
    assert one.log.stat().st_mtime - broke < START_LIMIT / 2


def hanging(folder: Path) -> tuple[Path, Path]:
    """The location file of a node with a driver that hangs while it is made, beside others; and the
    file that is there as soon as it hangs."""
    file, hung = folder / "services.toml", folder / "hung"
    hangs = device("hangs").replace("\nbreaks", f'\nfile = "{hung}"\nbreaks')
    file.write_text(cell(device("good"), hangs))
    return file, hung


@pytest.mark.parametrize("command", ["services only", "coordinator up", "coordinator serve --up"])
def test_a_node_of_which_a_driver_hangs_at_the_start_ends_when_it_is_told_to(
    tmp_path: Path, command: str
) -> None:
    file, hung = hanging(tmp_path)
    if "serve" in command:
        command += f" --page-port {free_ports(1)[0]}"
    module, *words = command.split()
    process = subprocess.Popen(
        [sys.executable, "-m", f"petrobot.{module}", *words, "--services", str(file)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
        cwd=tmp_path,
    )
    wait_for(hung.exists, awaited="the driver that hangs")
    process.terminate()
    assert process.wait(PATIENCE) == 0  # not by the limit for its start


def test_of_devices_that_start_the_one_that_hangs_is_named(tmp_path: Path) -> None:
    file, _ = hanging(tmp_path)
    short = "from petrobot.services.node import realtime; realtime.START_LIMIT = 5.0; "
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            f"{short}from petrobot.services.__main__ import main; main()",
            *("only", "--services", str(file)),
        ],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    *log, last = ended.stderr.splitlines()
    late, _, why = last.partition(" not up within 5 s: a driver hangs")
    ready = {line.split()[-3] for line in log if line.endswith(" is ready")}
    assert why and "the_hangs" in late and not ready & set(late.replace(",", "").split()), last
