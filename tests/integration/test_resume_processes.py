"""kill -9 of the coordinator with real processes: `petrobot resume` continues the run, and no
action is executed twice."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import RunRecorded
from petrobot.coordinator.task import Executed, Status
from tests.chaos.shuttle_cell import ROOT, TASK, moves, shuttle_services

pytestmark = pytest.mark.processes
RUNS = 24
MANY = 180
"""In lock step, where they pass quickly. Most of both are left when the coordinator is killed: on a
busy host the kill may be seconds late."""
PATIENCE = 120.0
QUIET = ("--quiet", "--no-page")


def petrobot(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start a command of petrobot; its output goes to a file."""
    with (folder / f"{arguments[0]}.txt").open("ab") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "petrobot.coordinator", *arguments],
            cwd=ROOT,
            stdout=out,
            stderr=out,
        )


def until(ready: Callable[[], Any], process: subprocess.Popen[bytes] | None = None) -> None:
    """Wait for a condition."""
    deadline, pause = time.monotonic() + PATIENCE, threading.Event()
    while not ready():
        assert process is None or process.poll() is None, (
            f"it ended: {process and process.returncode}"
        )
        assert time.monotonic() < deadline, "it takes too long"
        pause.wait(0.002)


def nodes(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    """Start `petrobot up`, and wait until it is ready."""
    services = str(folder / "services.toml")
    up = petrobot(folder, "up", "--services", services, "--logs", str(folder / "logs"), *options)
    until(lambda: b"Ctrl-C" in (folder / "up.txt").read_bytes(), up)
    return up


def killed_and_resumed(
    folder: Path, count: int, kills: list[int], first: list[str]
) -> dict[str, Any]:
    """Start `count` runs, kill the coordinator whenever so many moves have begun, and resume it
    each time. Return the result."""
    runs = folder / "runs"
    process = petrobot(
        folder, "run", str(TASK), "--runs", str(count), "--journal", str(runs), *first
    )
    for begun in kills:
        until(lambda begun=begun: len(moves(folder, "begin")) >= begun, process)  # type: ignore[misc]
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        [run] = runs.iterdir()
        process = petrobot(folder, "resume", str(run), "--json", str(folder / "out.json"), *QUIET)
    said = (folder / "resume.txt").read_text
    assert process.wait(PATIENCE) == 0, said()
    replay = petrobot(folder, "replay", str(run), "--json", str(folder / "replay.json"))
    assert replay.wait(PATIENCE) == 0, (folder / "replay.txt").read_text()
    result: dict[str, Any] = json.loads((folder / "out.json").read_text())
    return result


NEVER_BEGUN = {(Status.ERROR, Executed.NO), (Status.ERROR, Executed.UNKNOWN), (None, Executed.NO)}
"""Status and `executed` of runs that may have made no move; the last one is preempted before its
first step."""


def ends_of(folder: Path) -> dict[str, RunRecorded]:
    """Return how each fetch and carry ended in the journal, by run."""
    [run] = (folder / "runs").iterdir()
    told = (i for step in recorded(str(run)).steps() for i in step.instructions)
    return {i.run: i for i in told if isinstance(i, RunRecorded) and i.primitive_task != "tidy"}


def test_a_real_time_run_killed_twice_continues(tmp_path: Path) -> None:
    """Active runs are rejoined, and results that came meanwhile are fetched: every move is made
    once and none is lost."""
    shuttle_services(tmp_path, fetch=0.4, carry=0.5, orphan=60.0)
    up = nodes(tmp_path)
    try:
        first = ["--services", str(tmp_path / "services.toml"), *QUIET]
        result = killed_and_resumed(tmp_path, RUNS, [2, 6], first)
    finally:
        up.terminate()
        assert up.wait(PATIENCE) == 0
    assert (result["status"], result["mode"], result["runs"]) == ("success", "realtime", RUNS)
    begun, ended = moves(tmp_path, "begin"), moves(tmp_path, "end")
    assert (
        set(begun.values()) == {1} and set(ended) <= set(begun) and not moves(tmp_path, "overlap")
    )
    ends = ends_of(tmp_path)
    assert len(ends) == RUNS, "no token lost or doubled"
    made = {call.rpartition("/")[2] for call in begun}
    for run, end in ends.items():
        # effects of the kill (a call not sent yet, a device still leased) are reported, never
        # ignored
        assert run in made or (end.status, end.executed) in NEVER_BEGUN, end
    journal = (tmp_path / "resume.txt").read_text()
    assert "Traceback" not in journal


def test_a_lock_step_run_whose_nodes_wait_continues(tmp_path: Path) -> None:
    """One process per node: the nodes, and with them simulated time, wait for the resumed
    coordinator."""
    shuttle_services(tmp_path, fetch=0.4, carry=0.5)
    up = nodes(tmp_path, "--lockstep")
    first = [
        "--services",
        str(tmp_path / "services.toml"),
        "--mode",
        "lockstep",
        "--processes",
        "0",
        "--join",
        *QUIET,
    ]
    try:
        result = killed_and_resumed(tmp_path, MANY, [3, 40], first)
        assert up.wait(PATIENCE) == 0, "members end with their cell"
    finally:
        up.terminate()
        up.wait(PATIENCE)
    assert (result["status"], result["mode"], result["runs"]) == ("success", "lockstep", MANY)
    begun = moves(tmp_path, "begin")
    assert (
        set(begun.values()) == {1} and len([call for call in begun if "tidy" not in call]) == MANY
    )
