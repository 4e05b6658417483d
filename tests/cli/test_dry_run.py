"""`speed`, `workspace` and dry runs: drivers that obey them, drivers that are refused, and what is
sent to the device."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from petrobot import check_driver, rehearse
from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.loading import load_directory
from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.operator.session import RealtimeSession
from petrobot.services.adapters.ros2.topics import TopicDriver
from petrobot.services.comm.calls.peers import Peers
from petrobot.services.comm.location_file import DirectoryError, dry, load, parse, resolve
from petrobot.services.comm.protocol.messages import Hello, Refuse
from petrobot.services.device import LIMITS, can_move, keys_of
from petrobot.services.node.drivers import make_driver
from petrobot.services.node.ports import ProcessPorts
from tests.ports import free_ports
from tests.waiting import Limit

ROOT = Path(__file__).parents[2]
ROBOT = '''
from pathlib import Path
from petrobot import Context, Driver, Remote, success

class Button(Driver):
    """It raises an event and moves nothing: a dry run is nothing to it."""
    period = 0.01
    def step(self, now):
        assert not self.dry_run

class Deaf(Button):
    def command(self, now, body):
        pass
    def stop(self, now):
        pass
    def stopped(self):
        return True

class Axis(Deaf):
    obeys = ("speed", "workspace", "dry_run")
    def step(self, now):
        pass
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
[devices.button]
node = "pc"
driver = "dry_robot:Button"
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
        ("Deaf", "speed = 0.25", "devices.axis.speed: Deaf does not obey it"),
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
    assert "devices.axis.dry_run: Deaf does not obey it" in told
    assert "Sensor" not in told and "Button" not in told


def test_a_device_that_receives_set_points_counts_as_moving(cell: Path) -> None:
    """Also if its driver forgot to override `stop`: a dry run must not move it."""
    file = place(cell)
    told = r"Button refuses it: Button follows set points, but has no stop, stopped: .*; dry_run"
    for stream, refused in (("", False), ('[streams.to]\nto = "button"\nperiod = 0.1\n', True)):
        file.write_text(file.read_text() + stream)
        directory = load(file, dry_run=True)
        button = directory.devices["button"]
        ports = ProcessPorts(directory, button, time.monotonic, {})
        with pytest.raises(DirectoryError, match=told) if refused else nullcontext():
            assert not make_driver(directory, button, ports).dry_run


SHIPPED: dict[tuple[str, str], tuple[str, ...]] = {
    ("", "petrobot.services.motion.arm:Arm"): LIMITS,
    ("services/mobile", "petrobot.services.mobile.rover:Rover"): LIMITS,
    ("services/picking", "petrobot.services.adapters.so101.arm:Arm"): LIMITS,
    ("services/picking", "petrobot.services.adapters.ur.arm:Arm"): LIMITS,
    ("examples/so101", "petrobot.services.adapters.so101.arm:Arm"): LIMITS,
    ("examples/ur", "petrobot.services.adapters.ur.arm:Arm"): LIMITS,
    ("examples/ros2", "petrobot.services.adapters.ros2.bridge:Bridge"): LIMITS,
    ("examples/opcua", "petrobot.services.adapters.opcua.session:OpcUaSession"): ("dry_run",),
    ("examples/sorter", "robot:Arm"): LIMITS,
    ("examples/porter", "porter:Base"): LIMITS,
    ("examples/porter", "porter:Gripper"): LIMITS,
}
"""What docs/first-motion.md promises: by folder of its location file, each driver that may move
something, and what it obeys."""


@pytest.mark.processes
def test_every_shipped_driver_of_what_moves_obeys(monkeypatch: pytest.MonkeyPatch) -> None:
    """So no shipped cell refuses a dry run, and none ignores one. The table names all of them."""
    found = dict[tuple[str, str], tuple[str, ...]]()
    monkeypatch.syspath_prepend(ROOT)  # and takes back what the files add
    cells = [f for top in ("services", "examples") for f in (ROOT / top).rglob("*services.toml")]
    for path in [ROOT / "services.toml", *cells]:
        directory = load_directory(path, dry_run=True)  # raises where a driver does not obey
        for device in directory.devices.values():
            driver = resolve(device.driver)
            if can_move(driver):
                folder = str(path.parent.relative_to(ROOT)).removeprefix(".")
                found[folder, device.driver] = tuple(n for n in LIMITS if n in driver.obeys)
                # as a key of its own it would mean something else
                assert not set(LIMITS) & set(keys_of(driver)), device.driver
    assert found == SHIPPED
    assert set(TopicDriver.obeys) == set(LIMITS)  # the base class of topics over DDS


@pytest.mark.processes
def test_a_new_driver_and_a_new_robot_obey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "driver", "dry_gripper"]) == main(["new", "robot", "dry_carrier"]) == 0
    monkeypatch.syspath_prepend(tmp_path)
    assert set(resolve("dry_gripper:DryGripper").obeys) == {*LIMITS, "pause"}
    monkeypatch.chdir("dry_carrier")
    run = ["run", "dry_carrier.toml", "--mode", "lockstep", "--quiet", "--no-page"]
    assert main([*run, "--dry-run", "--json", "out.json"]) == 0, capsys.readouterr()
    assert json.loads(Path("out.json").read_text())["status"] == "success"


@pytest.mark.parametrize(
    ("folder", "driver", "commands"),
    [
        ("sorter", "robot:Arm", [{"to": "right"}, {"to": "home"}]),
        ("porter", "porter:Base", [{"to": "shelf"}, {"to": "dock"}]),
        ("porter", "porter:Gripper", [{"to": "open"}, {"to": "closed"}]),
        ("porter", "porter:Button", []),
    ],
)
def test_the_drivers_of_the_examples_keep_the_rules(
    folder: str, driver: str, commands: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With those of speed, workspace and dry run; the other shipped drivers have such a test with
    their simulated devices."""
    monkeypatch.syspath_prepend(ROOT / "examples" / folder)
    found = check_driver(resolve(driver), commands, seconds=8.0, simulated=True)
    assert found.faults == []


def test_a_gripper_grips_nothing_in_a_dry_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "examples" / "porter")
    grasp, kind = resolve("porter:grasp"), resolve("porter:Gripper")
    for dry_run, ended in ((False, "success"), (True, "error")):
        device = kind({"slips": 0.0, "dry_run": dry_run}, None)
        assert rehearse(grasp, device=device).result.status == ended


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
        assert f"dry run of {usual.hash[:12]})" in refused.text
        assert f"({usual.hash[:12]})" in refused.text
        asks = Hello(2, 2, "client", "c", "boot", 0, its.hash)  # `petrobot nodes`: who only asks
        assert Peers("pc", mine.hash, False, 1.0).refusal("c", asks) is None
    other = Hello(2, 2, "client", "c", "boot", 0, "another file")
    assert Peers("pc", dried.hash, False, 1.0).refusal("c", other) is not None


SCRIPT = 'schema = 1\n[[actions.go]]\nstatus = "success"\nseconds = 0.1\n'


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize("plant", ["dry-run", "dry-run of one device", "mock"])
@pytest.mark.processes
def test_what_was_not_real_is_never_recorded_as_real(
    cell: Path, mode: str, plant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither by the estimates file, nor by result, text, log, history and report."""
    (cell / "script.toml").write_text(SCRIPT)
    more = {"dry-run": ["--dry-run"], "mock": ["--mock", "script.toml"]}.get(plant, [])
    if not more:
        place(cell, keys="dry_run = true")
    up = ["--up", "--no-page"] if mode == "realtime" else []
    run = ["run", "go.toml", "--mode", mode, *up, *more, "--quiet", "--journal", "runs"]
    told = ["--json", "out.json", "--report", "report", "--learn", "a.estimates"]
    assert main([*run, *told]) == 0, capsys.readouterr()
    plant = plant.split()[0]
    assert list(EstimatesFile(cell / "a.estimates").read().plants) == [plant]
    assert json.loads((cell / "out.json").read_text())["plant"] == plant
    assert plant in capsys.readouterr().out
    assert plant in (cell / "report" / "index.html").read_text()
    [journal] = (cell / "runs").glob("*/run.journal")
    assert opened(journal, "it")["plant"] == plant
    assert main(["log", str(journal)]) == 0
    assert plant in capsys.readouterr().out.splitlines()[0]
    real = ["run", "go.toml", "--mode", "lockstep", "--quiet", "--learn", "a.estimates"]
    place(cell)
    assert main([*real, "--prior", "10"]) == 2  # nor does it teach another plant
    assert "--prior needs runs of another plant" in capsys.readouterr().err


@pytest.mark.processes
def test_a_campaign_refuses_a_dry_run(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for keys, code in (("dry_run = true", 2), ("", 0)):
        place(cell, keys=keys)
        assert main(["campaign", "go.toml", "--runs", "2", "--out", "c", "--quiet"]) == code
    assert "dry_run: a campaign measures nothing while drives are off" in capsys.readouterr().err


@pytest.mark.processes
def test_a_scripted_run_is_resumed_with_its_script(
    cell: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`resume --up` must not let the rest of it move the device."""
    (cell / "script.toml").write_text(SCRIPT)
    run = ["run", "go.toml", "--up", "--no-page", "--quiet", "--mock", "script.toml"]

    async def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RealtimeSession, "_lead", interrupted)
        main([*run, "--learn", "a.estimates"])
    assert main(["resume", "last", "--up", "--no-page", "--quiet"]) == 0, capsys.readouterr()
    assert not (cell / "moved").exists()
    assert list(EstimatesFile(cell / "a.estimates").read().plants) == ["mock"]


@pytest.mark.parametrize("scripted", [False, True])
@pytest.mark.processes
def test_scripted_and_other_programs_refuse_each_other(
    cell: Path, scripted: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nodes that are up would move the robot of a scripted run, or teach a real one the script."""
    (cell / "script.toml").write_text(SCRIPT)
    node, run = (["--mock", "script.toml"], []) if scripted else ([], ["--mock", "script.toml"])
    command = ("petrobot.services", "pc", "--services", "services.toml", *node)
    with subprocess.Popen([sys.executable, "-m", *command]) as process:
        try:
            limit = Limit("the node answers")
            while main(["nodes"]) and limit.left():
                time.sleep(0.05)
            assert ("scripted" in capsys.readouterr().out) is scripted
            assert main(["run", "go.toml", "--no-page", "--quiet", *run]) == 2
            how = "with a script" if scripted else "without a script"
            assert f"node pc was started {how} (--mock)" in capsys.readouterr().err
            assert not (cell / "moved").exists() and not list((cell / "runs").glob("go*"))
            assert main(["run", "go.toml", "--no-page", "--quiet", *node]) == 0
            assert ("mock" if scripted else "real") in capsys.readouterr().out
        finally:
            process.terminate()
            process.wait(60.0)
