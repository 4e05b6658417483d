"""Write a working skeleton with its test: of an action (a Python file), or of a task (a net of one
action with an error branch)."""

from __future__ import annotations

import argparse
import keyword
import re
from pathlib import Path

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.whole_file import make_folder, write_whole

EXAMPLE = "petrobot new action close_gripper --folder mylab"

ACTION = '''\
"""The primitive action {name}: say here what it is for."""

from petrobot import Context, Result, error, failure, success


async def {name}(ctx: Context, *, duration: float = 0.5, timeout: float = 2.0) -> Result:
    """Say here when its specification is met (SUCCESS), when it is not but the task can continue
    (FAILURE), and when the robot must recover (ERROR)."""
    if duration <= 0.0:
        return error("bad_duration", f"duration is {{duration}} s; give more than 0")
    begun = ctx.now
    ready = await ctx.wait(lambda: ctx.now - begun >= duration, timeout)
    if not ready:
        return failure("slow", f"not done after {{timeout}} s")
    return success(took=ctx.now - begun)
'''

ACTION_TEST = '''\
"""Tests of {name} on a simulated clock: seconds of the cell take a millisecond."""

from {module} import {name}
from petrobot import rehearse


def test_success():
    played = rehearse({name}, duration=0.5)
    assert played.result.status == "success" and 0.5 <= played.result.values["took"] < 0.6


def test_too_slow_is_a_failure():
    assert rehearse({name}, duration=5.0, timeout=1.0).result.cause == "slow"


def test_nonsense_is_an_error():
    assert rehearse({name}, duration=0.0).result.status == "error"
'''

TASK = """\
# {name}: say here what the task is for. Draw it with `petrobot show {name}.toml`.
schema = 1

[task]
name = "{name}"
goal = "say here when the task has met its goal"
final = "runs == 0 and robot_free == 1"
final_error = "out_of_order == 1"
runs_place = "runs"

[primitive_tasks.work]
goal = "say here what this step is for"
alternatives = ["work"]      # names of actions in services.toml; each start chooses one of them
deadline = 10.0              # s

[primitive_tasks.recover]
goal = "The robot is ready again"
alternatives = ["recover"]
deadline = 30.0

[places.runs]
kind = "control"             # the operator may put tokens in and take them out
tokens = 2

[places.robot_free]
kind = "resource"
tokens = 1
capacity = 1

[places.work]
kind = "action"              # a token in it is a run of one of its actions
task = "work"

[places.recover]
kind = "action"
task = "recover"

[places.out_of_order]
kind = "control"
capacity = 1

[transitions.start]
in = ["runs", "robot_free"]
out = ["work"]

[transitions.done]
in = ["work:normal"]         # success or failure
out = ["robot_free"]

[transitions.failed]
in = ["work:error"]
out = ["recover"]

[transitions.recovered]
in = ["recover:normal"]
out = ["robot_free"]

[transitions.given_up]
in = ["recover:error"]
out = ["out_of_order"]
"""

TASK_TEST = '''\
"""The task {name} with scripted actions: after an error the robot recovers, and the task ends."""

import json
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
SERVICES = """
schema = 1
[nodes.robot]
host = "127.0.0.1"
port = 7399
[actions.work]
run = "petrobot.services.action:success"
task = "work"
node = "robot"
[actions.recover]
run = "petrobot.services.action:success"
task = "recover"
node = "robot"
"""
SCRIPT = """
schema = 1
[[actions.work]]
status = "error"
cause = "provoked"
seconds = 0.1
[[actions.work]]
seconds = 0.5
[actions.recover]
seconds = 0.2
"""


def test_an_error_is_recovered(tmp_path):
    (tmp_path / "services.toml").write_text(SERVICES)
    (tmp_path / "script.toml").write_text(SCRIPT)
    command = [sys.executable, "-m", "petrobot.coordinator", "run", str(HERE / "{name}.toml")]
    command += ["--services", str(tmp_path / "services.toml")]
    command += ["--mock", str(tmp_path / "script.toml"), "--mode", "lockstep", "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["status"] == "success" and result["firings"] == 5
'''


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("what", choices=("action", "task"))
    parser.add_argument("name", help="its name, such as close_gripper")
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="folder to write to (default: this folder)"
    )


def run(options: argparse.Namespace) -> int:
    """Write the files. Existing files are never overwritten."""
    name = options.name
    if keyword.iskeyword(name):
        raise CommandError(2, f"{name!r} is a keyword of Python: choose another name")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise CommandError(
            2,
            f"{name!r} cannot be the name: use small letters, digits and _, a letter first",
        )
    folder: Path = options.folder
    if options.what == "action":
        module = f"{folder.name}.{name}" if folder.name else name
        files = {folder / f"{name}.py": ACTION, folder.parent / f"test_{name}.py": ACTION_TEST}
        if not folder.name:
            files = {Path(f"{name}.py"): ACTION, Path(f"test_{name}.py"): ACTION_TEST}
        hint = (
            f'place it in services.toml:\n  [actions.{name}]\n  run = "{module}:{name}"\n '
            ' task = "..."\n  node = "..."'
        )
    else:
        module = ""
        files = {folder / f"{name}.toml": TASK, folder / f"test_{name}.py": TASK_TEST}
        hint = f"draw it: petrobot show {folder / name}.toml --errors --out {name}.svg"
    _write(
        {
            path: text.format(name=name, module=module)
            if path.suffix == ".py" and "test" not in path.name
            else _filled(text, name, module)
            for path, text in files.items()
        }
    )
    print("\n".join([*(f"wrote {path}" for path in files), hint]))
    return 0


def _filled(text: str, name: str, module: str) -> str:
    return text.replace("{name}", name).replace("{module}", module)


def _write(files: dict[Path, str]) -> None:
    for path in files:
        if path.exists():
            raise CommandError(2, f"{path} exists already; choose another name or --folder")
    for path, text in files.items():
        try:
            make_folder(path.parent)
            write_whole(path, text)
        except OSError as fault:
            text = f"{path}: {fault.strerror or fault}; give --folder one that can be written"
            raise CommandError(2, text) from fault
