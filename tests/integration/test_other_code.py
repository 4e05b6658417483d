"""Nodes that were started with other code than the coordinator finds: from another folder with the
same services.toml, or before a module was changed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.integration.test_resume_processes import PATIENCE
from tests.node.test_processes import start_node
from tests.ports import free_ports

pytestmark = pytest.mark.processes
SERVICES = """\
schema = 1
[nodes.left]
host = "127.0.0.1"
port = {}
[actions.greet]
run = "parts.words.greeting:greet"
task = "greet"
node = "left"
"""
TASK = """\
schema = 1
[task]
name = "greeting"
final = "done == 1"
[primitive_tasks.greet]
alternatives = ["greet"]
deadline = 5.0
[places]
begin = { kind = "control", tokens = 1 }
greet = { kind = "action" }
done = { kind = "control" }
[transitions]
begun = { in = ["begin"], out = ["greet"] }
ended = { in = ["greet:normal"], out = ["done"] }
failed = { in = ["greet:error"], out = ["done"] }
"""
MODULE = "parts/words/greeting.py"
"""In packages without `__init__.py`."""
CODE = """\
from petrobot import Context, Result, success


def greet(ctx: Context) -> Result:
    return success(text="{}")
"""


def cell(folder: Path, port: int, word: str) -> Path:
    (folder / MODULE).parent.mkdir(parents=True)
    (folder / MODULE).write_text(CODE.format(word))
    (folder / "task.toml").write_text(TASK)
    (folder / "services.toml").write_text(SERVICES.format(port))
    return folder


def run(folder: Path) -> str:
    """Run the task in this folder, and return what the command said on standard error."""
    command = [sys.executable, "-P", "-m", "petrobot.coordinator", "run", "task.toml", "--quiet"]
    done = subprocess.run(
        [*command, "--no-page", "--journal", "runs"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_a_node_with_other_code_is_named(tmp_path: Path) -> None:
    [port] = free_ports(1)
    one, other = (cell(tmp_path / name, port, name) for name in ("one", "other"))
    node = start_node("left", one / "services.toml")
    try:
        assert node.stdout is not None and "ready" in node.stdout.readline()
        assert "was started with another" not in run(one)
        assert f"left was started with another parts.words.greeting than {other / MODULE}" in run(
            other
        )
        (other / MODULE).write_text(CODE.format("one"))
        assert "was started with another" not in run(other), "the same code in two places"
        (one / MODULE).write_text(CODE.format("changed"))
        assert f"left was started with another parts.words.greeting than {one / MODULE}" in run(one)
    finally:
        node.terminate()
        node.communicate(timeout=PATIENCE)
