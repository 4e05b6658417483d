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
"""
ORDER = """\
[actions.{name}]
run = "toy_cell.actions:order"
device = "base"
args = {args}
"""
GIVE = """\
[actions.{name}]
run = "toy_cell.poison:give"
node = "only"
args = {args}
"""
CASES = {
    "refused": (ORDER, "{ send = [{ odd = 3 }] }", "command_refused", "no odd numbers: 3"),
    "key_error": (
        *(ORDER, "{ send = [{ need = true }], seconds = 0.1 }"),
        *("command_refused", "what is not there"),
    ),
    "step_raises": (
        *(ORDER, "{ send = [{ break = true }], seconds = 9.0 }"),
        *("device_died", "nothing is right in step"),
    ),
    "long_cause": (
        *(GIVE, '{ kind = "long cause" }'),
        *("bad_result", "found 1,234: put long words into the text"),
    ),
    "containers": (
        *(GIVE, '{ kind = "many containers" }'),
        *("bad_result", "more than 20,000 lists and dicts"),
    ),
    "large": (GIVE, '{ kind = "65 MiB" }', "bad_result", "above its limit"),
    "interrupt": (GIVE, '{ kind = "KeyboardInterrupt" }', "exception", "KeyboardInterrupt"),
    "event": (GIVE, '{ kind = "an event with a long name" }', "exception", "found 256"),
}
"""Actions by name: how each is declared, its arguments, and the cause and words of its error."""
TASK = """\
schema = 1
[task]
name = "driving"
goal = "every action has failed"
final = "moved == 1"
final_error = "broken == 1"
[places.jobs]
kind = "control"
tokens = 1
capacity = 1
[places.moved]
kind = "control"
capacity = 1
[places.broken]
kind = "control"
capacity = 1
[transitions.start]
in = ["jobs"]
out = ["{first}"]
"""
ACTION = """\
[primitive_tasks.{name}]
deadline = 60.0
[places.{name}]
kind = "action"
[transitions.{name}_done]
in = ["{name}:normal"]
out = ["moved"]
[transitions.{name}_failed]
in = ["{name}:error"]
out = ["{next}"]
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


def test_the_drivers_message_reaches_the_user(tmp_path: Path) -> None:
    """One run meets every fault, each in an action of its own: a cell for each would cost eight
    times as much."""
    services, task = SERVICES.format(port=free_ports(1)[0]), TASK.format(first=next(iter(CASES)))
    names = [*CASES, "broken"]
    for (name, (entry, args, _, _)), following in zip(CASES.items(), names[1:], strict=True):
        services += entry.format(name=name, args=args)
        task += ACTION.format(name=name, next=following)
    (tmp_path / "services.toml").write_text(services)
    (tmp_path / "driving.toml").write_text(task)
    ran = petrobot(tmp_path, "run", "driving.toml", "--up")
    assert ran.returncode == 1, (ran.stdout, ran.stderr)
    log = petrobot(tmp_path, "log", "last")
    assert log.returncode == 0, (log.stdout, log.stderr)
    said = [" ".join(line.split()) for line in log.stdout.splitlines()]
    for name, (_, _, cause, words) in CASES.items():
        (ended,) = (line for line in said if f"ended {name}#1 ERROR" in line)
        assert f"{cause}: " in ended and words in ended, (log.stdout, ran.stdout, ran.stderr)
