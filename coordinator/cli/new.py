"""Write a working skeleton with its test: of a whole robot (a folder that runs), of an action or a
driver (a Python file), or of a task (a net of one action with an error branch). Or copy one of the
examples of the pages."""

from __future__ import annotations

import argparse
import importlib.util
import keyword
import re
from pathlib import Path

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import SHIPPED_CELL
from petrobot.services.host.whole_file import make_folder, write_whole

EXAMPLE = "petrobot new robot carrier"
EXAMPLES = Path(__file__).parents[2] / "examples"
NAMED_CELL = '"../../services.toml"'
"""The robots of the pages, each a folder of its own."""

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
# {name}: say here what the task is for. Draw it: petrobot show {name}.toml --out {name}.svg
schema = 1

[task]
name = "{name}"
goal = "say here when the task has met its goal"
final = "runs == 0 and robot_free == 1"
final_error = "out_of_order == 1"
runs_place = "runs"

[primitive_tasks]            # each is done by the action of its name in services.toml
work = { deadline = 10.0, goal = "say here what this step is for" }
recover = { deadline = 30.0 }        # s; it may have several: alternatives = ["one", "other"]

[places]
runs = { kind = "control", tokens = 2 }      # the operator may put tokens in and take them out
robot_free = { kind = "resource", tokens = 1, capacity = 1 }
work = { kind = "action" }                   # a token in it is a run of its action
recover = { kind = "action" }
out_of_order = { kind = "control", capacity = 1 }

[transitions]
start = { in = ["runs", "robot_free"], out = ["work"] }
done = { in = ["work:normal"], out = ["robot_free"] }       # success or failure
failed = { in = ["work:error"], out = ["recover"] }
recovered = { in = ["recover:normal"], out = ["robot_free"] }
given_up = { in = ["recover:error"], out = ["out_of_order"] }
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
run = "petrobot.services.scripted:nothing"
task = "work"
node = "robot"
[actions.recover]
run = "petrobot.services.scripted:nothing"
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


DRIVER = '''\
"""The device {name}: say here what it is."""

from petrobot import Axis


class {Class}(Axis):
    """Moves along x; this one is simulated. A real one would open its port in `setup`. What is no
    axis is derived from `Driver`: docs/drivers.md."""

    period = 0.01  # s between two steps
    obeys = (*Axis.obeys, "dry_run")  # speed, workspace and pause, and a dry run
    ends = [0.0, 1.0]  # m

    def step(self, now: float) -> None:
        super().step(now)
        # A real one writes self.at to its motor here, unless self.dry_run, and calls self.stop(now)
        # where its axis leaves the workspace.
'''

DRIVER_TEST = '''\
"""Tests of {name} on a simulated clock."""

from {module} import {Class}
from petrobot import Context, Remote, Result, check_driver, rehearse, success


def test_it_keeps_the_rules_of_drivers():
    there_and_back = [{"to": 0.9}, {"to": 0.1}]
    assert check_driver({Class}, there_and_back, simulated=True).faults == []


async def drive(ctx: Context[Remote], *, to: float) -> Result:
    await ctx.command({"to": to}, until="arrived")
    return success()


def test_it_arrives():
    device = {Class}({"top_speed": 0.5}, None)
    assert 1.0 < rehearse(drive, device=device, to=0.5).seconds < 1.2 and device.at == 0.5


def test_it_refuses_what_is_out_of_reach():
    assert rehearse(drive, device={Class}({}, None), to=2.0).result.cause == "command_refused"
'''

ROBOT_ACTIONS = '''

async def move(ctx: Context[Remote], *, to: float) -> Result:
    """Move to a position (m)."""
    state = await ctx.command({"to": to}, until="arrived")
    return success(at=state["at"])


async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:
    """Close the gripper on a part; some slip out."""
    await ctx.sleep(0.3)
    if ctx.random("grip").random() < slips:
        return error("slipped", "the part slipped out")
    return success()
'''

ROBOT_TASK = """\
# {name}: carries parts from one end of its axis to the other.
# Draw it: petrobot show {name}.toml --out {name}.svg
schema = 1

[task]
name = "{name}"
goal = "Each part lies at the other end"
goal_transitions = ["delivered"]
runs_place = "parts"
final = "parts == 0"
final_error = "broken > 0"

[errors]
to = "broken"                # where every error goes that has no branch of its own

[primitive_tasks]            # each is done by the action of its name in services.toml
move = { deadline = 8.0 }             # s
grip = { deadline = 2.0, error_causes = { slipped = "the part slipped out" } }

[places]
parts = { kind = "control", tokens = 3 }     # the operator may change it
axis = { kind = "resource", tokens = 1 }
broken = {}
fetch = { kind = "action", task = "move", args = { to = 0.2 }, holds = "axis" }
grip = { kind = "action", tries = 3, holds = "axis" }
carry = { kind = "action", task = "move", args = { to = 0.8 }, holds = "axis" }

[transitions]
start = { in = ["parts", "!broken"], out = ["fetch"] }
there = { in = ["fetch:normal"], out = ["grip"] }
gripped = { in = ["grip:normal"], out = ["carry"] }
lost = { in = ["grip:error"] }               # this part is given up, the next one is fetched
delivered = { in = ["carry:normal"] }
"""

ROBOT_SERVICES = """\
schema = 1

[nodes]                      # each is a process on one computer
pc = { host = "127.0.0.1", port = 7501 }

[devices]                    # node, driver, and the keys of the driver
axis = { node = "pc", driver = "{name}:Slide", top_speed = 0.5 }

[actions]
move = { run = "{name}:move", device = "axis" }
grip = { run = "{name}:grip", device = "axis" }
"""

ROBOT_TEST = '''\
"""Tests of {name}: its actions on a simulated clock, and its task in lock step."""

from pathlib import Path

from {name} import Slide, grip, move
from petrobot import check_driver, rehearse, rehearse_task


def test_it_moves():
    axis = Slide({"top_speed": 0.5}, None)
    played = rehearse(move, device=axis, to=0.5)
    assert played.result.status == "success" and 1.0 < played.seconds < 1.2


def test_the_driver_keeps_the_rules_of_drivers():
    there_and_back = [{"to": 0.9}, {"to": 0.1}]
    assert check_driver(Slide, there_and_back, simulated=True).faults == []


def test_a_position_out_of_reach_is_refused():
    assert rehearse(move, device=Slide({}, None), to=9.0).result.cause == "command_refused"


def test_a_part_may_slip():
    assert rehearse(grip, device=Slide({}, None), slips=1.0).result.cause == "slipped"


def test_the_task_may_run_and_ends_well():
    result = rehearse_task(Path(__file__).with_name("{name}.toml"), "--seed", "1")
    assert result["status"] == "success"
'''

ROBOT_PYPROJECT = """\
[project]
name = "{name}"
version = "0.1.0"
requires-python = ">=3.11"
dependencies = ["petrobot"]

[tool.setuptools]
py-modules = ["{name}"]

[tool.pytest.ini_options]
pythonpath = ["."]
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("what", choices=("robot", "driver", "action", "task", "example"))
    parser.add_argument(
        "name",
        help="its name, such as close_gripper; an example of these pages is copied: "
        + ", ".join(_examples()),
    )
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="folder to write to (default: this folder)"
    )


def _examples() -> list[str]:
    return sorted(path.name for path in EXAMPLES.iterdir() if path.is_dir())


def run(options: argparse.Namespace) -> int:
    """Write the files. Existing files are never overwritten."""
    name, folder = options.name, options.folder
    if keyword.iskeyword(name):
        raise CommandError(2, f"{name!r} is a keyword of Python: choose another name")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise CommandError(
            2,
            f"{name!r} cannot be the name: use small letters, digits and _, a letter first",
        )
    makers = {
        "robot": _robot,
        "driver": _driver,
        "action": _action,
        "task": _task,
        "example": _example,
    }
    files, hint = makers[options.what](name, folder)
    _write(files)
    print("\n".join([*(f"wrote {path}" for path in files), hint]))
    return 0


def _robot(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    _refuse_hidden(name, folder / name / f"{name}.py")
    project = folder / name
    code = _filled(DRIVER + ROBOT_ACTIONS, name, device="slide")
    code = code.replace("The device slide: say here what it is.", f"The robot {name}.")
    code = code.replace(
        "import Axis\n", "import Axis, Context, Remote, Result, error, success\n", 1
    )
    texts = {
        "pyproject.toml": ROBOT_PYPROJECT,
        "services.toml": ROBOT_SERVICES,
        f"{name}.toml": ROBOT_TASK,
        f"test_{name}.py": ROBOT_TEST,
    }
    files = {project / file: _filled(text, name) for file, text in texts.items()}
    hint = (
        f"cd {project}, then:\n  petrobot check {name}.toml\n"
        f"  petrobot run {name}.toml --mode lockstep   # simulated time\n"
        f"  petrobot run {name}.toml --up              # real time\n"
        "  pytest                                # first: pip install pytest"
    )
    return {project / f"{name}.py": code, **files}, hint


def _driver(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    module, paths = _python(name, folder)
    texts = (_filled(DRIVER, name, module), _filled(DRIVER_TEST, name, module))
    hint = (
        "place it in services.toml, under [devices]:\n"
        f'  {name} = {{ node = "...", driver = "{module}:{_class(name)}" }}'
    )
    return dict(zip(paths, texts, strict=True)), hint


def _action(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    module, paths = _python(name, folder)
    texts = (ACTION.format(name=name), _filled(ACTION_TEST, name, module))
    hint = (
        "place it in services.toml, under [actions]:\n"
        f'  {name} = {{ run = "{module}:{name}", node = "..." }}'
    )
    return dict(zip(paths, texts, strict=True)), hint


def _task(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    files = {folder / f"{name}.toml": TASK, folder / f"test_{name}.py": TASK_TEST}
    stand_in = "petrobot.services.scripted:nothing"  # it does nothing, and succeeds
    lines = [f'  {a} = {{ run = "{stand_in}", node = "..." }}' for a in ("work", "recover")]
    hint = "\n".join(
        (
            f"draw it: petrobot show {folder / name}.toml --errors --out {name}.svg",
            "to check and run it, place its actions in services.toml, under [actions]; these do",
            "nothing until you write your own (petrobot new action):",
            *lines,
        )
    )
    return {path: _filled(text, name) for path, text in files.items()}, hint


def _example(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    if name not in _examples():
        raise CommandError(2, f"no example {name!r}; there are: {', '.join(_examples())}")
    paths = sorted(path for path in (EXAMPLES / name).iterdir() if path.is_file())
    # A task that names the cell of the catching task finds it from its new folder, too.
    there = f'"{SHIPPED_CELL}"'
    files = {
        folder / name / path.name: path.read_text(encoding="utf-8").replace(NAMED_CELL, there)
        for path in paths
    }
    tasks = [path.name for path in paths if path.suffix == ".toml" and path.stem != "services"]
    return files, f"next: cd {folder / name}; petrobot check {tasks[0]}"


def _python(name: str, folder: Path) -> tuple[str, tuple[Path, Path]]:
    """The import name of a new module in a package `folder`, its file and that of its test."""
    if not folder.name:
        _refuse_hidden(name, Path(f"{name}.py"))
        return name, (Path(f"{name}.py"), Path(f"test_{name}.py"))
    if not folder.name.isidentifier() or keyword.iskeyword(folder.name):
        text = f"--folder {folder}: {folder.name!r} cannot be the name of a package of Python"
        raise CommandError(2, f"{text}; use letters, digits and _")
    _refuse_hidden(folder.name, folder)
    return f"{folder.name}.{name}", (folder / f"{name}.py", folder.parent / f"test_{name}.py")


def _refuse_hidden(name: str, path: Path) -> None:
    """Refuse a module or package `path` if Python already has another one of this name."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        return
    known = [
        Path(one).resolve()
        for one in (spec.origin, *(spec.submodule_search_locations or ()))
        if one
    ]
    if path.resolve() not in known:
        text = f"a Python module named {name!r} is there already and would hide {path}"
        raise CommandError(2, f"{text}; choose another name")


def _class(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def _filled(text: str, name: str, module: str = "", device: str = "") -> str:
    filled = text.replace("{name}", device or name).replace("{module}", module)
    return filled.replace("{Class}", _class(device or name))


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
