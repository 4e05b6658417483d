"""examples/ros2 in simulated time, and in real time before a server in a process of its own."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ports import free_ports

ROOT = Path(__file__).parents[4]
EXAMPLE = ROOT / "examples" / "ros2"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}


@pytest.fixture
def example(tmp_path: Path) -> Path:
    copy = shutil.copytree(EXAMPLE, tmp_path / "ros2")
    cell = copy / "services.toml"
    port = str(free_ports(1)[0])
    cell.write_text(re.sub(r"port = \d+", f"port = {port}", cell.read_text()))
    return copy


def petrobot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "petrobot.coordinator", *arguments],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_it_is_short() -> None:
    files = [EXAMPLE / "services.toml", EXAMPLE / "deliver.toml"]
    assert sum(len(path.read_text().splitlines()) for path in files) < 80


@pytest.mark.processes
def test_it_runs_in_simulated_time(example: Path) -> None:
    run = ("run", "deliver.toml", "--mode", "lockstep", "--quiet", "--no-page", "--json", "-")
    ran = [petrobot(example, *run) for _ in "12"]
    assert [each.returncode for each in ran] == [0, 0], ran[0].stdout + ran[0].stderr
    first, second = (json.loads(each.stdout) for each in ran)
    assert first["sim_s"] == second["sim_s"] > 9.0  # two drives of 2.24 m at 0.5 m/s


@pytest.mark.processes
def test_it_runs_before_a_server(example: Path) -> None:
    """As on the robot: the address is changed, nothing else."""
    (port,) = free_ports(1)
    cell, robot = example / "services.toml", example / "simulated.py"
    cell.write_text(cell.read_text().replace("simulated:Robot", f"ws://127.0.0.1:{port}"))
    robot.write_text(robot.read_text().replace("SPEED, PERIOD = 0.5", "SPEED, PERIOD = 5.0"))
    command = [sys.executable, "simulated.py", str(port)]
    serving = subprocess.Popen(command, cwd=example, stdout=subprocess.PIPE, text=True)
    assert serving.stdout is not None
    assert serving.stdout.readline().strip() == "serving"
    ran = petrobot(example, "run", "deliver.toml", "--up", "--quiet", "--no-page", "--json", "-")
    serving.kill()
    serving.wait()
    serving.stdout.close()
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert json.loads(ran.stdout)["firings"] == 4
