"""examples/ros2 in simulated time, and in real time with a server in a separate process."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from tests.adapters.ros2.conftest import FakeProcess
from tests.ports import free_ports

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "ros2"
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}


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
        timeout=240,
    )


def test_it_is_short() -> None:
    files = [EXAMPLE / "services.toml", EXAMPLE / "deliver.toml"]
    assert sum(len(path.read_text().splitlines()) for path in files) < 80


@pytest.mark.processes
def test_it_runs_in_simulated_time(example: Path) -> None:
    run = ("run", "deliver.toml", "--mode", "lockstep", "--quiet", "--no-page", "--json", "-")
    ran = petrobot(example, *run)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert 9.5 < json.loads(ran.stdout)["sim_s"] < 10.5  # two drives of 2.24 m at 0.5 m/s


STREAMS = """
schema = 1
[nodes.pc]
host = "127.0.0.1"
port = {port}
[devices.base]
node = "pc"
driver = "petrobot.services.adapters.ros2.bridge:Bridge"
url = "{url}"
[devices.base.setpoints.speed]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
fields = ["linear.x", "angular.z"]
[streams.speed]
to = "base"
period = 0.02
[actions]
steer = {{ run = "steering:steer", node = "pc" }}
[actions.drive]
run = "petrobot.services.adapters.ros2.actions:drive"
device = "base"
args = {{ streams = ["speed"], seconds = 3.0 }}
[actions.connect]
run = "petrobot.services.adapters.ros2.actions:call"
device = "base"
args = {{ service = "/sum" }}
[actions.speeds]
run = "petrobot.services.adapters.ros2.actions:call"
device = "base"
args = {{ service = "/speeds", expect = {{ "speeds.0" = 0.5, "speeds.-1" = 0.0 }} }}
"""
STEERED = """
schema = 1
[task]
name = "steered"
final = "over == 1 and steered == 1"
final_error = "stuck > 0"
[errors]
to = "stuck"
[primitive_tasks]
connect = { goal = "The base answers", alternatives = ["connect"], deadline = 20.0 }
steer = { goal = "Set points were sent", alternatives = ["steer"], deadline = 20.0 }
drive = { goal = "The base followed them", alternatives = ["drive"], deadline = 20.0 }
speeds = { goal = "What it followed is known", alternatives = ["speeds"], deadline = 20.0 }
[places]
begin = { kind = "control", tokens = 1 }
connect = { kind = "action", task = "connect" }
steer = { kind = "action", task = "steer" }
drive = { kind = "action", task = "drive" }
speeds = { kind = "action", task = "speeds" }
steered = { kind = "control" }
over = { kind = "control" }
stuck = { kind = "control" }
[transitions]
start = { in = ["begin"], out = ["connect"] }
connected = { in = ["connect:normal"], out = ["steer", "drive"] }
sent = { in = ["steer:normal"], out = ["steered"] }
driven = { in = ["drive:normal"], out = ["speeds"] }
asked = { in = ["speeds:normal"], out = ["over"] }
"""
STEERING = """
from petrobot import success

async def steer(ctx):
    ctx.publish("speed", [0.5, 0.1])
    await ctx.sleep(1.5)  # longer than a busy host needs to begin `drive`, too
    return success()
"""


@pytest.mark.processes
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_set_points_reach_the_robot(tmp_path: Path, fake: FakeProcess, mode: str) -> None:
    """Through node, worker and driver: those of the stream, then those of rest."""
    fake_class = "tests.adapters.ros2.fake:Fake"
    url = fake_class if mode == "lockstep" else fake.url
    cell = STREAMS.format(port=free_ports(1)[0], url=url)
    (tmp_path / "services.toml").write_text(cell)
    (tmp_path / "steered.toml").write_text(STEERED)
    (tmp_path / "steering.py").write_text(STEERING)
    how = ("--mode", "lockstep") if mode == "lockstep" else ("--up",)
    more = ("--quiet", "--no-page", "--json", "-")
    ran = petrobot(tmp_path, "run", "steered.toml", *how, *more)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    result = json.loads(ran.stdout)
    assert result["happened"] == "4 runs", result  # nothing `unexpected`
    if mode == "realtime":
        speeds = [message["msg"]["linear"]["x"] for message in fake.log("publish")]
        assert set(speeds) == {0.5, 0.0} and speeds[-1] == 0.0 and len(speeds) > 3
        # On a busy host the stream may pause: then the set point of rest is sent once, too.
        assert (0.0, 0.0) not in pairwise(speeds)


@pytest.mark.processes
def test_it_runs_with_a_server(example: Path) -> None:
    """As with a robot: only the address is changed."""
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
