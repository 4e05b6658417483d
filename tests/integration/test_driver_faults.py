"""Faults of drivers and actions as the user of the coordinator sees them: exit code, journal and
log."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.node.conftest import OUTSIDE
from tests.ports import free_ports

pytestmark = pytest.mark.processes
ROOT = Path(__file__).parents[2]
TIMEOUT = 120.0
SERVICES = """\
schema = 1
[nodes.only]
host = "127.0.0.1"
port = {port}
[devices.base]
node = "only"
driver = "toy_cell.drivers:Broken"
period = 0.02
breaks = "step"
[actions.drive]
run = "toy_cell.actions:order"
task = "work"
device = "base"
args = {{ send = {send}, seconds = {seconds} }}
"""
GIVE = """\
schema = 1
[nodes.only]
host = "127.0.0.1"
port = {port}
[actions.drive]
run = "toy_cell.poison:give"
task = "work"
node = "only"
args = {{ kind = "{kind}" }}
"""
TASK = """\
schema = 1
[task]
name = "driving"
goal = "the base has moved"
final = "moved == 1"
final_error = "broken == 1"
[primitive_tasks.work]
goal = "the base moves"
alternatives = ["drive"]
deadline = 20.0
[places.jobs]
kind = "control"
tokens = 1
capacity = 1
[places.work]
kind = "action"
task = "work"
[places.moved]
kind = "control"
capacity = 1
[places.broken]
kind = "control"
capacity = 1
[transitions.start]
in = ["jobs"]
out = ["work"]
[transitions.done]
in = ["work:normal"]
out = ["moved"]
[transitions.failed]
in = ["work:error"]
out = ["broken"]
"""


def petrobot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; from petrobot.coordinator.cli import main; sys.exit(main(sys.argv[1:]))",
            *arguments,
        ],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}", "COLUMNS": "400"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )


@pytest.mark.parametrize(
    ("services", "cause", "words"),
    [
        (
            SERVICES.format(port="{port}", send="[{ odd = 3 }]", seconds=0.0),
            "command_refused",
            "no odd numbers: 3",
        ),
        (
            SERVICES.format(port="{port}", send="[{ need = true }]", seconds=0.1),
            "command_refused",
            "what is not there",
        ),
        (
            SERVICES.format(port="{port}", send="[{ break = true }]", seconds=9.0),
            "device_died",
            "nothing is right in step",
        ),
        (
            GIVE.format(port="{port}", kind="long cause"),
            "bad_result",
            "found 1,234: put long words into the text",
        ),
        (
            GIVE.format(port="{port}", kind="many containers"),
            "bad_result",
            "more than 20,000 lists and dicts",
        ),
        (GIVE.format(port="{port}", kind="65 MiB"), "bad_result", "above its limit"),
        (GIVE.format(port="{port}", kind="KeyboardInterrupt"), "exception", "KeyboardInterrupt"),
        (GIVE.format(port="{port}", kind="an event with a long name"), "exception", "found 256"),
    ],
    ids=[
        "refused",
        "KeyError",
        "step raises",
        "long cause",
        "containers",
        "65 MiB",
        "KeyboardInterrupt",
        "event",
    ],
)
def test_the_drivers_message_reaches_the_user(
    tmp_path: Path, services: str, cause: str, words: str
) -> None:
    (tmp_path / "services.toml").write_text(services.replace("{port}", str(free_ports(1)[0])))
    (tmp_path / "driving.toml").write_text(TASK)
    ran = petrobot(tmp_path, "run", "driving.toml", "--up")
    assert ran.returncode == 1, (ran.stdout, ran.stderr)
    log = petrobot(tmp_path, "log", "last")
    said = " ".join(log.stdout.split())
    assert log.returncode == 0 and cause in said and words in said, (
        log.stdout,
        ran.stdout,
        ran.stderr,
    )
