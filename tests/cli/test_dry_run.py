"""`speed`, `workspace` and dry runs: drivers that obey them, drivers that are refused, and what is
sent to the device."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.services.comm.calls.peers import Peers
from petrobot.services.comm.location_file import dry, load, parse, resolve
from petrobot.services.comm.protocol.messages import Hello, Refuse
from petrobot.services.device import LIMITS, can_move, keys_of
from tests.ports import free_ports

ROBOT = '''
from pathlib import Path
from petrobot import Context, Driver, Remote, success

class Deaf(Driver):
    period = 0.01

class Axis(Deaf):
    obeys = ("speed", "workspace", "dry_run")
    def command(self, now, body):
        if outside := self.workspace.outside((body["to"], 0.0, 0.0)):
            raise ValueError(outside)
        Path("moved").write_text(str(not self.dry_run))

class Sensor(Driver):
    """It cannot move: a dry run is nothing to it."""

async def go(ctx: Context[Remote], *, to: float):
    await ctx.command({"to": to})
    return success()
'''
CELL = """schema = 1
[nodes.pc]
host = "127.0.0.1"
port = {port}
[devices.axis]
node = "pc"
driver = "dry_robot:{driver}"
{keys}
[devices.sensor]
node = "pc"
driver = "dry_robot:Sensor"
[actions.go]
run = "dry_robot:go"
device = "axis"
"""
TASK = """schema = 1
[task]
name = "go"
runs_place = "todo"
final = "todo == 0"
final_error = "broken > 0"
[primitive_tasks.go]
goal = "there"
alternatives = ["go"]
deadline = 5.0
[errors]
to = "broken"
[places]
todo = { kind = "control", tokens = 1 }
broken = {}
going = { kind = "action", task = "go", args = { to = 0.5 } }
[transitions]
begin = { in = ["todo"], out = ["going"] }
done = { in = ["going:normal"] }
"""


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a task, a robot and its location file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dry_robot.py").write_text(ROBOT)
    (tmp_path / "go.toml").write_text(TASK)
    place(tmp_path)
    return tmp_path


def place(folder: Path, driver: str = "Axis", keys: str = "") -> Path:
    """Write the location file."""
    file = folder / "services.toml"
    file.write_text(CELL.format(driver=driver, keys=keys, port=free_ports(1)[0]))
    return file


@pytest.mark.processes
@pytest.mark.parametrize(
    ("driver", "keys", "says"),
    [
        ("Axis", "speed = 0.25\nworkspace = { x = [0.0, 1.0] }\ndry_run = true", ""),
        ("Deaf", "speed = 0.25", "devices.axis.speed: speed: Deaf does not obey it"),
        ("Deaf", "workspace = { x = [0, 1] }", "workspace: Deaf does not obey it"),
        ("Deaf", "dry_run = true", "dry_run: Deaf does not obey it"),
        ("Axis", "speed = 0", "expected a number above 0 and at most 1, the share"),
        ("Axis", "speed = 1.5", "found 1.5"),
        ("Axis", "speed = true", "found True"),
        ("Axis", "dry_run = 1", "dry_run: expected true or false, found 1"),
        ("Axis", "workspace = { x = [1, 0] }", "workspace: expected a table such as"),
        ("Axis", "workspace = { a = [0, 1] }", "of x, y or z, found {'a': [0, 1]}"),
        ("Axis", "workspace = 3", "found 3"),
        ("Axis", "workspace = { x = [0, nan] }", "workspace: expected a table"),
    ],
)
def test_check_refuses_what_a_driver_does_not_obey(
    cell: Path, driver: str, keys: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    place(cell, driver, keys)
    code = main(["check", "go.toml"])
    told = capsys.readouterr()
    assert code == (2 if says else 0), told
    assert says in told.err


@pytest.mark.processes
@pytest.mark.parametrize("command", [["run", "go.toml", "--mode", "lockstep"], ["up"], ["serve"]])
def test_a_dry_run_is_refused_where_a_driver_cannot(
    cell: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    place(cell, "Deaf")
    assert main([*command, "--dry-run"]) == 2
    told = capsys.readouterr().err
    assert "devices.axis.dry_run: dry_run: Deaf does not obey it" in told
    assert "Sensor" not in told


@pytest.mark.parametrize(
    ("driver", "limits"),
    [
        ("motion.arm:Arm", LIMITS),
        ("mobile.rover:Rover", LIMITS),
        ("adapters.so101.arm:Arm", LIMITS),
        ("adapters.ur.arm:Arm", LIMITS),
        ("adapters.ros2.bridge:Bridge", LIMITS),
        ("adapters.ros2.topics:TopicDriver", LIMITS),
        ("adapters.opcua.session:OpcUaSession", ("dry_run",)),
    ],
)
def test_every_shipped_driver_of_what_moves_obeys(driver: str, limits: tuple[str, ...]) -> None:
    """So no cell of them refuses a dry run."""
    found = resolve(f"petrobot.services.{driver}")
    assert can_move(found) and set(found.obeys) == set(limits)
    assert "speed" not in keys_of(found)  # as a key of its own it would mean something else


@pytest.mark.parametrize("mode", [["--mode", "lockstep"], ["--up"]])
@pytest.mark.processes
def test_the_whole_task_runs_dry(
    cell: Path, mode: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for dry_run in ([], ["--dry-run"]):
        run = ["run", "go.toml", *mode, "--json", "out.json", "--quiet", *dry_run]
        assert main([*run, "--no-page"]) == 0, capsys.readouterr()
        assert json.loads((cell / "out.json").read_text())["status"] == "success"
        assert (cell / "moved").read_text() == str(not dry_run)


@pytest.mark.processes
def test_a_command_outside_the_workspace_ends_its_run(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place(cell, keys="workspace = { x = [0.0, 0.4] }")
    main(["run", "go.toml", "--mode", "lockstep", "--json", "out.json", "--quiet"])
    told = (cell / "out.json").read_text() + capsys.readouterr().err
    assert "x = 0.500, y = 0.000, z = 0.000 m lies outside the workspace x = [0, 0.4] m" in told


def test_dry_run_and_normal_programs_refuse_each_other(cell: Path) -> None:
    usual, dried = load("services.toml"), load("services.toml", dry_run=True)
    assert dried.dry_run and not usual.dry_run and dried.hash != usual.hash
    again = parse(dried.text, dried.source)
    assert again.hash == dried.hash and parse(dry(usual.text), usual.source).hash == dried.hash
    for mine, its in ((usual, dried), (dried, usual)):
        peers = Peers("pc", mine.hash, False, 1.0)
        refused = peers.refusal("c", Hello(2, 2, "coordinator", "c", "boot", 1, its.hash))
        assert isinstance(refused, Refuse) and "give --dry-run to both" in refused.text
        asks = Hello(2, 2, "client", "c", "boot", 0, its.hash)  # `petrobot nodes`: who only asks
        assert Peers("pc", mine.hash, False, 1.0).refusal("c", asks) is None
    other = Hello(2, 2, "client", "c", "boot", 0, "another file")
    assert Peers("pc", dried.hash, False, 1.0).refusal("c", other) is not None
