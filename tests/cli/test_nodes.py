"""`petrobot nodes` and `estop` with a node that has a device and actions without one: what is
listed as a device, and its state."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from petrobot.coordinator.cli import main
from petrobot.services.comm.location_file import Directory
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import GENERAL, Node
from tests.cli.cell import Arm, directory_in
from tests.in_loop import NodeInLoop

STOPPED = "arm stopped"


@pytest_asyncio.fixture
async def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Directory]:
    """The location file of a node that runs in this event loop."""
    monkeypatch.setenv("COLUMNS", "200")
    directory = directory_in(tmp_path)
    clock = asyncio.get_running_loop().time
    arm = InlineHost(directory.actions, clock=clock, driver=Arm({}, None))
    places = {"arm": arm, GENERAL: InlineHost(directory.actions, clock=clock)}
    node = NodeInLoop(
        Node(directory, "robot", boot="b1", clock=clock, places=places), directory.address("robot")
    )
    await node.start()
    yield directory
    await node.close()


async def said(directory: Directory, capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """Run a command that must succeed; return its output."""
    capsys.readouterr()
    code = await asyncio.to_thread(main, [*command, "--services", str(directory.source)])
    assert code == 0, capsys.readouterr().err
    return capsys.readouterr().out


async def test_a_node_is_not_listed_as_a_device(
    directory: Directory, capsys: pytest.CaptureFixture[str]
) -> None:
    """Actions without a device are listed under the node's name; the table of devices leaves them
    out."""
    stopped = json.loads(await said(directory, capsys, "estop", "--json", "-"))
    assert stopped["nodes"][0]["devices"] == {"arm": "stopped"}
    status: dict[str, Any] = json.loads(await said(directory, capsys, "nodes", "--json", "-"))[
        "robot"
    ]["status"]
    assert set(status["devices"]) == set(status["answers"]) == {"arm"}
    assert status["general"]["runs"] == []


async def test_a_node_of_a_dry_run_says_so(
    directory: Directory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "dry run" not in await said(directory, capsys, "nodes")
    text = directory.source.read_text(encoding="utf-8")
    dried = tmp_path / "dry.toml"
    dried.write_text(f"dry_run = true\n{text}", encoding="utf-8")
    assert await asyncio.to_thread(main, ["nodes", "--services", str(dried)]) == 0
    assert "dry run" not in capsys.readouterr().out.replace("dry.toml", "")


async def test_stopped_devices_are_shown_until_they_are_cleared(
    directory: Directory, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the table with the remedy, and as data."""
    assert "stopped" not in await said(directory, capsys, "nodes")
    assert (
        "stopped" not in json.loads(await said(directory, capsys, "nodes", "--json", "-"))["robot"]
    )
    await said(directory, capsys, "estop")
    shown = await said(directory, capsys, "nodes")
    assert STOPPED in shown and shown.count("petrobot estop --clear") == 1
    assert json.loads(await said(directory, capsys, "nodes", "--json", "-"))["robot"][
        "stopped"
    ] == ["arm"]
    await said(directory, capsys, "estop", "--clear")
    assert "stopped" not in await said(directory, capsys, "nodes")


def test_the_stop_of_a_node_that_does_not_run_is_shown_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The latch's file on this host says so: the node would start with its devices stopped."""
    monkeypatch.setenv("COLUMNS", "200")
    services = str(directory_in(tmp_path).source)
    assert main(["estop", "--services", services]) == 3
    capsys.readouterr()
    assert main(["nodes", "--services", services, "--timeout", "0.2"]) == 3
    shown = capsys.readouterr().out
    assert "away" in shown and STOPPED in shown


@pytest.mark.parametrize(
    ("listens", "why"), [(True, "connected, but does not answer"), (False, "refused")]
)
def test_a_node_that_is_away_has_a_reason(
    listens: bool, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frozen process still accepts connections."""
    directory = directory_in(tmp_path)
    with socket.socket() as frozen:
        frozen.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        frozen.bind(directory.address("robot"))
        if listens:
            frozen.listen()
        command = ["nodes", "--services", str(directory.source), "--timeout", "0.3", "--json", "-"]
        assert main(command) == 3
        told = json.loads(capsys.readouterr().out)["robot"]
        assert why in told["why"] and not told["refuses"]


async def test_a_node_with_another_location_file_is_not_away(
    directory: Directory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.toml"
    text = directory.source.read_text(encoding="utf-8")
    other.write_text(text + "\n[parameters]\nlimits = 'limits.toml'\n", encoding="utf-8")
    capsys.readouterr()
    assert await asyncio.to_thread(main, ["nodes", "--services", str(other)]) == 3
    shown = capsys.readouterr().out
    assert "refuses us" in shown and "differs" in shown and "away" not in shown


def test_the_log_of_a_node_is_printed_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It comes from the folder of logs; without a file there the message says where to look."""
    services = str(directory_in(tmp_path).source)
    command = ["log", "robot", "--services", services, "--logs", str(tmp_path / "logs")]
    assert main(command) == 2
    assert "node robot has no log here" in capsys.readouterr().err
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "robot.log").write_text("12:00 INFO run r1 started\nits last word")
    assert main(command) == 0
    assert capsys.readouterr().out == "12:00 INFO run r1 started\nits last word\n"
    (tmp_path / "logs" / "robot.log.1").write_text("11:00 older\n")
    assert main(command) == 0
    assert capsys.readouterr().out.startswith("11:00 older\n12:00 INFO")
    assert main(["log", "robots", "--services", services]) == 2
    assert "no run 'robots'" in capsys.readouterr().err


def test_without_a_location_file_only_the_demo_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main(["nodes", "--timeout", "0.1"])
    assert "only the catching cell that comes with petrobot" in capsys.readouterr().err
