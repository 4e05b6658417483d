"""The command line: help with an example for each command, exit codes, one clear line for each
fault."""

from __future__ import annotations

import ast
import json
import os
import re
import resource
import runpy
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

import petrobot as petrobot_package
from petrobot.coordinator.analysis import commands, may_run
from petrobot.coordinator.analysis.formats import read_net
from petrobot.coordinator.analysis.net.space import explore
from petrobot.coordinator.cli import COMMANDS, Subcommand, analyse as cli_analyse, loading, main
from petrobot.coordinator.cli.options import page_line
from tests.ports import free_ports

ROOT = Path(__file__).parents[2]


def petrobot(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    command = [sys.executable, "-m", "petrobot", *arguments]
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", [command.name for command in COMMANDS])
def test_every_command_helps_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """--help says what it does, shows an example and the exit codes."""
    assert main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"petrobot {name}" in shown.partition("example:")[2]
    assert "exit codes" in shown


def test_overview_and_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a command all are listed; a wrong one is bad input."""
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {command.name} " in shown for command in COMMANDS)
    assert main(["fly"]) == 2
    assert "unknown command 'fly'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("function", "arguments", "said"),
    [
        ("graph_command", ["show", "catch_ball", "--graph"], "up; use a smaller net"),
        ("gspn_of", ["show", "catch_ball", "--view", "gspn"], "up; use a smaller net"),
        ("open_model", ["simulate", "catch_ball"], "fewer --replicas, or a smaller net"),
        ("open_model", ["convert", "catch_ball", "out.drn"], "too large for .drn"),
    ],
)
def test_commands_on_nets_bound_their_memory(
    function: str,
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A net that is too large ends in one line, and the limit is taken back."""
    before, limits = resource.getrlimit(resource.RLIMIT_DATA), list[int]()

    def full(*_: object, **__: object) -> None:
        limits.append(resource.getrlimit(resource.RLIMIT_DATA)[0])
        raise MemoryError

    monkeypatch.setattr(commands, function, full)
    assert main(arguments) == 2
    assert said in capsys.readouterr().err
    assert limits[0] != resource.RLIM_INFINITY
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_a_command_ends_with_no_other_code_than_its_help_lists(
    command: Subcommand, capsys: pytest.CaptureFixture[str]
) -> None:
    """The codes of its errors stand in its module, as numbers."""
    main([command.name, "--help"])
    listed = {int(code) for code in re.findall(r"^ +(\d+)  ", capsys.readouterr().out, re.M)}
    module = (command.home or command.name).partition(":")[0]
    tree = ast.parse((ROOT / "coordinator" / "cli" / f"{module}.py").read_text())
    raised = {
        part.value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "CommandError"
        for part in ast.walk(call.args[0])
        if isinstance(part, ast.Constant) and isinstance(part.value, int)
    }
    assert raised <= listed


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["show", "catch_ball", "--heat"], 2, "the search stopped: time limit"),
        (["show", "catch_ball", "--graph"], 0, ""),
        (["simulate", "catch_ball"], 1, "0 firings (stopped early)"),
        (["convert", "catch_ball", "out.drn"], 2, "the search stopped: time limit"),
    ],
)
def test_commands_on_nets_bound_their_time(
    arguments: list[str],
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What needs longer ends in one line, or shows the part that was found."""
    monkeypatch.setattr(cli_analyse, "SECONDS", -1.0)
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == code
    assert said in "".join(capsys.readouterr())


LOCKSTEP = ["run", "catch_ball", "--mode", "lockstep"]
COMPARE = ["forecast", "--compare", "forecast.json", "campaigns/new"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "no_such_task"], "no task 'no_such_task'"),
        (["run", "catch_ball", "--set", "speed=3"], "no parameter 'speed'"),
        (["run", "catch_ball", "--use", "track_ball=teleport"], "choose from"),
        (["run", "catch_ball", "--mode", "lockstep", "--regime", "Z9", "--quiet"], "Z9"),
        (["run", "catch_ball", "--services", "nowhere.toml"], "nowhere.toml"),
        (["check", "services.toml"], "services.toml"),
        (["replay", "no_such_run"], "no run 'no_such_run'"),
        (["new", "action", "2fast"], "2fast"),
        (["calibrate", "--views", "nowhere"], "nowhere"),
        (
            ["simulate", "catch_ball", "--replicas", "0"],
            "--replicas: 0 is not a whole number of at least 1",
        ),
        (
            ["simulate", "catch_ball", "--replicas", "ten"],
            "ten is not a whole number of at least 1",
        ),
        (
            ["simulate", "catch_ball", "--horizon", "-1"],
            "--horizon: -1 is not a number of more than 0",
        ),
        (
            ["simulate", "catch_ball", "--seed", "-1"],
            "--seed: -1 is not a whole number of at least 0",
        ),
        (
            ["analyse", "catch_ball", "--states", "0"],
            "--states: 0 is not a whole number of at least 1",
        ),
        (
            ["analyse", "catch_ball", "--seconds", "-1"],
            "--seconds: -1 is not a number of at least 0",
        ),
        (
            ["analyse", "catch_ball", "--seconds", "nan"],
            "--seconds: nan is not a number of at least 0",
        ),
        (
            ["analyse", "catch_ball", "--memory", "0"],
            "--memory: 0 is not a whole number of at least 1",
        ),
        (
            ["campaign", "catch_ball", "--runs", "abc"],
            "--runs: abc is not a whole number of at least 1",
        ),
        (
            ["campaign", "catch_ball", "--workers", "1000000000"],
            "--workers: 1000000000 is more than the largest number, 1024",
        ),
        (
            ["campaign", "catch_ball", "--target", "2"],
            "--target: 2 is not a number of more than 0 and at most 1",
        ),
        (
            ["learned", "show", "x.db", "--target", "7"],
            "--target: 7 is not a number of more than 0 and at most 1",
        ),
        (["learned", "show", "x.db", "--rho", "-1"], "--rho: -1 is not a number of at least 0"),
        (["token", "runs", "two"], "such as +1 or -1, got two"),
        (["run", "catch_ball", "--runs", "abc"], "--runs: abc is not a whole number of at least 1"),
        (["run", "catch_ball", "--keep", "0"], "--keep: 0 is not a whole number of at least 1"),
        (
            ["run", "catch_ball", "--target", "0"],
            "--target: 0 is not a number of more than 0 and at most 1",
        ),
        (
            ["forecast", "catch_ball", "--replicates", "5"],
            "--replicates: 5 is not a whole number of at least 20",
        ),
        (["nodes", "--timeout", "-1"], "--timeout: -1 is not a number of more than 0"),
        (["nodes", "--timeout", "0"], "--timeout: 0 is not a number of more than 0"),
        (["nodes", "--timeout", "inf"], "--timeout: inf is not a number of more than 0"),
        (
            ["up", "--lockstep", "--await-coordinator", "-1"],
            "--await-coordinator: -1 is not a number of at least 0",
        ),
        (
            ["up", "--lockstep", "--await-coordinator", "soon"],
            "--await-coordinator: soon is not a number of at least 0",
        ),
        # options without effect
        ([*LOCKSTEP, "--up"], "--up: a run in lock step starts its own nodes"),
        ([*LOCKSTEP, "--keep", "3"], "--keep: needs --journal FOLDER"),
        ([*LOCKSTEP, "--durable"], "--durable: needs --journal FOLDER"),
        (["run", "catch_ball", "--processes", "0"], "--processes: only for --mode lockstep"),
        (["run", "--from", "last", "--keep", "3"], "--keep: needs --journal FOLDER"),
        (["up", "--await-coordinator", "3"], "--await-coordinator: needs --lockstep"),
        (["up", "--print-unit", "--no-respawn"], "--no-respawn: not written into the unit"),
        (["up", "--print-unit", "--mock", "m.py"], "--mock: not written into the unit"),
        ([*COMPARE, "--runs", "7"], "--runs: a registered forecast is compared as it is"),
        ([*COMPARE, "--seed", "2"], "--seed: a registered forecast is compared as it is"),
        ([*COMPARE, "--doubtful"], "--doubtful: a registered forecast is compared as it is"),
        (["forecast", "catch_ball", *COMPARE[1:]], "TASK: a registered forecast is compared"),
        (
            ["forecast", "catch_ball", "--estimates", "e", "--doubtful"],
            "--doubtful: nothing is registered without --out FILE",
        ),
        (["serve", "tidy"], "expected no task, got 'tidy': choose it on the page"),
        ([*LOCKSTEP, "--page-port", "8000"], "--page-port: a run in lock step serves no page"),
        (["show", "catch_ball", "--graph", "--errors"], "--errors: the reachability graph has"),
        (
            ["show", "catch_ball", "--graph", "--services", "s"],
            "--services: the reachability",
        ),
        (["learned", "freeze", "x.db", "--json", "-"], "--json: learned freeze makes no use of it"),
        (["learned", "reset", "x.db", "--rho", "1"], "--rho: learned reset makes no use of it"),
        (["learned", "show", "x.db", "--selectors"], "--selectors: learned show makes no use"),
        (["report", "runs", "--json", "-"], "--json: it is of a comparison; add --against"),
        (["keys", "--tls", "k", "--file", "f"], "--file: it is for the shared key"),
        (["film", "last", "--out", "x.gif", "--quality", "9"], "--quality: only a .webp film"),
        (
            ["campaign", "catch_ball", "--cluster", "tcp://127.0.0.1:1", "--workers", "7"],
            "--workers: the workers are those of --cluster",
        ),
        (
            ["convert", "catch_ball", "x.pnml", "--services", "s.toml"],
            "--services: its devices are of the stochastic view, and the ordinary net is written",
        ),
        (
            ["analyse", "x.net", "--view", "ordinary", "--rates", "unit"],
            "--rates: the ordinary view has no times",
        ),
        (
            ["forecast", "catch_ball", "--estimates", "e", "--markdown", "m"],
            "--markdown: a forecast has no table; give it beside --compare",
        ),
    ],
)
def test_bad_input_is_exit_code_2_and_names_the_fault(
    arguments: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One clear line that names what was wrong."""
    monkeypatch.chdir(ROOT)
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("command", [["analyse"], ["simulate"], ["convert", "other.pnml"]])
def test_a_net_file_has_no_location_file(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "queue.net"
    path.write_text("net queue\ntr serve waiting -> free\n", encoding="utf-8")
    assert main([command[0], str(path), *command[1:], "--services", "services.toml"]) == 2
    assert "queue.net: a net file has no actions" in capsys.readouterr().err


def test_unreachable_nodes_are_exit_code_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`run` and `nodes` say which node does not answer."""
    services = tmp_path / "services.toml"
    text = (
        (ROOT / "services.toml")
        .read_text(encoding="utf-8")
        .replace("services/cell.toml", str(ROOT / "services/cell.toml"))
    )
    for port in ("7300", "7301", "7302"):
        text = text.replace(
            f"port = {port}", f"port = {int(port) - 6300}"
        )  # nothing listens on ports this low
    services.write_text(text, encoding="utf-8")
    assert main(["nodes", "--services", str(services), "--timeout", "0.3"]) == 3
    assert "away" in capsys.readouterr().out


@pytest.mark.processes
def test_a_node_ends_with_its_command(tmp_path: Path) -> None:
    """`petrobot node` is the node itself, not its parent: after a signal that ends the command, no
    process occupies the port."""
    [port] = free_ports(1)
    services = tmp_path / "services.toml"
    services.write_text(
        f'schema = 1\n[nodes.n]\nhost = "127.0.0.1"\nport = {port}\n[services.memory]\nnode = "n"\n'
    )
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "node",
        "n",
        "--services",
        str(services),
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    ) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == f"node n ready on 127.0.0.1:{port}, process {node.pid}\n"
        node.terminate()
        assert node.wait(60.0) == 0
    with socket.socket() as again:
        assert again.connect_ex(("127.0.0.1", port)) != 0


@pytest.mark.parametrize(
    "command", [("run", "catch_ball", "--mode", "lockstep"), ("serve",), ("resume", "last")]
)
@pytest.mark.parametrize("port", ["99999", "-1", "web"])
def test_an_invalid_port_is_refused(
    command: tuple[str, ...], port: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is not read as another number."""
    assert main([*command, "--page-port", port]) == 2
    said = capsys.readouterr().err
    assert "--page-port" in said and "from 1 to 65535" in said


def test_a_port_in_use_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line with the remedy."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert (
            main(
                [
                    "serve",
                    "--page-port",
                    str(port),
                    "--tasks",
                    str(tmp_path),
                    "--journal",
                    str(tmp_path),
                ]
            )
            == 2
        )
    assert (
        f"port {port}: Address already in use; choose another with --page-port"
        in capsys.readouterr().err
    )


@pytest.mark.processes
def test_check_gives_its_findings_as_json(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shipped task may run on the shipped nodes."""
    monkeypatch.chdir(ROOT)
    assert main(["check", "catch_ball", "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ok"] is True
    assert answer["task"] == "catch_ball"


@pytest.mark.processes
def test_a_task_without_error_branch_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`check` and `run` both refuse it, naming place and remedy."""
    from petrobot.coordinator.cli.new import skeleton

    path = tmp_path / "broken.toml"
    broken = skeleton("task.toml", "broken").replace(
        '[transitions.failed]\nin = ["work:error"]\nout = ["recover"]\n', ""
    )
    path.write_text(broken, encoding="utf-8")
    assert main(["check", str(path)]) == 2
    said = capsys.readouterr()
    assert "work" in said.out + said.err
    assert "error" in said.out + said.err


@pytest.mark.processes
def test_a_task_that_can_deadlock_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without its `final_error` the skeleton can reach a dead marking: the file has no fault, but
    the state space shows it."""
    from petrobot.coordinator.cli.new import skeleton

    path = tmp_path / "stuck.toml"
    text = skeleton("task.toml", "stuck")
    path.write_text(text, encoding="utf-8")
    assert (
        main(["check", str(path)]) == 2
    )  # its actions are on no node of the shipped services.toml
    services = tmp_path / "services.toml"
    action = (
        '[actions.{0}]\nrun = "petrobot.services.scripted:nothing"\ntask = "{0}"\nnode = "robot"\n'
    )
    node = 'schema = 1\n[nodes.robot]\nhost = "127.0.0.1"\nport = 7399\n'
    services.write_text(node + action.format("work") + action.format("recover"), encoding="utf-8")
    assert main(["check", str(path), "--services", str(services)]) == 0
    path.write_text(text.replace('final_error = "out_of_order == 1"\n', ""), encoding="utf-8")
    capsys.readouterr()
    assert main(["check", str(path), "--services", str(services)]) == 2
    assert "error   deadlock free: stuck with " in capsys.readouterr().out
    assert main(["analyse", str(path)]) == 1
    assert "failed" in capsys.readouterr().out
    script = tmp_path / "script.toml"
    failing = '[actions.{}]\nstatus = "error"\ncause = "provoked"\n'
    script.write_text("schema = 1\n" + failing.format("work") + failing.format("recover"), "utf-8")
    run = ["run", str(path), "--services", str(services), "--mode", "lockstep"]
    assert main([*run, "--mock", str(script)]) == 1
    assert "warning: stuck: deadlock free: " in capsys.readouterr().err


def test_analyse_and_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The shipped task is sound; as PNML it is the same net, and the command says which one."""
    assert main(["analyse", "catch_ball", "--json", "-"]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert (whole["bounded"], whole["deadlock"], whole["complete"]) == (True, False, True)
    target = tmp_path / "net.pnml"
    assert main(["convert", "catch_ball", str(target), "--exact"]) == 0
    assert "the ends net" in capsys.readouterr().out
    main(["analyse", str(target), "--json", "-"])
    foreign = json.loads(capsys.readouterr().out)
    assert (foreign["states"], foreign["edges"]) == (whole["states"], whole["edges"])


SHARED = """
schema = 1

[task]
name = "shared"
final = "done == 2"

[primitive_tasks.look]
goal = "done"
deadline = 1000.0
alternatives = ["look"]
[primitive_tasks.look.estimates]
success = { share = 1.0, mean = 2.0, cv = 1.0 }

[primitive_tasks.point]
goal = "done"
deadline = 1000.0
alternatives = ["point"]
[primitive_tasks.point.estimates]
success = { share = 1.0, mean = 3.0, cv = 1.0 }

[places]
idle = { tokens = 1 }
look = { kind = "action", task = "look" }
point = { kind = "action", task = "point" }
done = {}

[transitions]
begin = { in = ["idle"], out = ["look", "point"] }
seen = { in = ["look:normal"], out = ["done"] }
shown = { in = ["point:normal"], out = ["done"] }
lost = { in = ["look:error"], out = ["done"] }
missed = { in = ["point:error"], out = ["done"] }
"""
CELL = """
schema = 1
[nodes.head]
host = "127.0.0.1"
port = 7000
[devices.camera]
node = "head"
driver = "here:Camera"
[actions.look]
run = "here:look"
device = "camera"
deadline = 1000.0
[actions.point]
run = "here:point"
device = "camera"
deadline = 1000.0
"""


def test_every_view_uses_the_devices_of_the_location_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two runs on one device take 2 + 3 s. Without a location file both views name their
    assumption: the runs are parallel, and the longer of two exponential times is 2 + 3 - 1 / (1/2 +
    1/3) s."""
    monkeypatch.chdir(tmp_path)
    Path("shared.toml").write_text(SHARED, encoding="utf-8")
    found = []
    for cell in ("", CELL):
        if cell:
            Path("services.toml").write_text(cell, encoding="utf-8")
        word = "the devices are those of services.toml" if cell else "no location file"
        assert main(["analyse", "shared.toml", "--view", "gspn", "--json", "-"]) == 0
        data = json.loads(capsys.readouterr().out)
        assert any(word in note for note in data["notes"])
        found.append((data["execution"]["states"], data["forecast"]["mean"]))
        assert main(["show", "shared.toml", "--view", "gspn"]) == 0
        drawn = capsys.readouterr().out
        assert word in drawn and ("device camera" in drawn) == bool(cell)
    assert found[0][1] == pytest.approx(3.8) and found[1][1] == pytest.approx(5.0)
    assert found[1][0] != found[0][0]
    assert main(["show", "shared.toml", "--services", "services.toml"]) == 2
    assert "--services is for --heat and --view gspn" in capsys.readouterr().err


@pytest.mark.processes
def test_check_says_what_takes_long(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A search of seconds is announced in a terminal, and nowhere else."""
    monkeypatch.setattr(loading, "SLOW", 0.0)
    assert main(["check", "catch_ball"]) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main(["check", "catch_ball"]) == 0
    assert "searching the states of the task" in capsys.readouterr().err


def test_show_draws_png(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file .png is a picture of the same shape, for a paper or a mail."""
    out = tmp_path / "net.png"
    assert main(["show", "catch_ball"]) == 0
    size = re.search(r'viewBox="[\d.-]+ [\d.-]+ ([\d.]+) ([\d.]+)"', capsys.readouterr().out)
    assert main(["show", "catch_ball", "--out", str(out)]) == 0
    data = out.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and size is not None
    width, height = struct.unpack(">II", data[16:24])
    assert width / height == pytest.approx(float(size[1]) / float(size[2]), rel=0.01)


def test_show_draws_svg(capsys: pytest.CaptureFixture[str]) -> None:
    """Error branches only when asked for."""
    assert main(["show", "catch_ball"]) == 0
    plain = capsys.readouterr().out
    assert main(["show", "catch_ball", "--errors"]) == 0
    whole = capsys.readouterr().out
    assert plain.startswith(("<svg", "<?xml"))
    assert len(whole) > len(plain)
    assert "recover_arm" in whole
    sorter = str(ROOT / "examples" / "sorter" / "sort.toml")
    assert main(["show", sorter, "--errors", "--expanded"]) == 0
    assert "grip.left" in capsys.readouterr().out
    assert main(["show", sorter, "--expanded", "--inside", "x"]) == 2
    assert "the expanded net has none" in capsys.readouterr().err


def test_show_draws_the_stochastic_view(capsys: pytest.CaptureFixture[str]) -> None:
    """Timed transitions are boxes with their rates; each number has its source."""
    assert main(["show", "catch_ball", "--view", "gspn"]) == 0
    drawn = capsys.readouterr().out
    assert "transition timed" in drawn and "transition immediate" in drawn
    assert "declared in the task file" in drawn and "/s" in drawn
    assert "declared: after 10 s" in drawn and "assumed equally likely" in drawn
    for wrong in (["--view", "gspn", "--errors"], ["--estimates", "learned.db"]):
        assert main(["show", "catch_ball", *wrong]) == 2
    assert "leave out --view gspn" in capsys.readouterr().err


def test_convert_writes_the_stochastic_view(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The GreatSPN project, PNML and Storm's chain describe the same GSPN."""
    found = []
    for ending, more in ((".pnpro", []), (".pnml", ["--view", "gspn"])):
        target = tmp_path / f"catch{ending}"
        assert main(["convert", "catch_ball", str(target), *more]) == 0
        said = capsys.readouterr().out
        assert "assumed: catch_ball: estimates declared" in said
        gspn = read_net(target).gspn
        assert gspn is not None
        found.append((sorted(filter(None, gspn.rate)), len(explore(gspn.net))))
    assert found[0] == found[1]
    assert main(["convert", "catch_ball", str(tmp_path / "catch.drn")]) == 0
    assert main(["convert", str(tmp_path / "catch.pnml"), str(tmp_path / "x.net")]) == 0
    assert "not kept: rates and weights" in capsys.readouterr().out


def test_analyse_reports_measures_of_the_user(capsys: pytest.CaptureFixture[str]) -> None:
    measures = ["--measure", "p95=time(0.95)", "--measure", "late(20)"]
    main(["analyse", "catch_ball", "--view", "gspn", *measures, "--json", "-"])
    told = json.loads(capsys.readouterr().out)["measures"]
    assert 15 < told["p95"] < 30 and 0 < told["late(20)"] < 1
    assert main(["analyse", "catch_ball", *measures]) == 2
    assert "give --view gspn" in capsys.readouterr().err


@pytest.mark.processes
def test_the_skeletons_of_new_work(tmp_path: Path) -> None:
    """The skeletons' own tests pass as they are written."""
    for what, name in (("action", "beckon"), ("task", "greet")):
        assert petrobot("new", what, name, cwd=tmp_path).returncode == 0
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-c",
        os.devnull,
        str(tmp_path),
    ]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout
    assert petrobot("new", "task", "greet", cwd=tmp_path).returncode == 2


PRESSING = """\
from petrobot.services.action import error, success

async def work(ctx, *, force=1.0):
    return success() if force < 5.0 else error("too_strong")

async def recover(ctx):
    return error("no_power", "the robot has no power")
"""


def test_a_given_up_run_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an argument of a wrong type, the terminal and the JSON have its action, node and text,
    and how to record more."""
    from petrobot.coordinator.cli.new import skeleton

    monkeypatch.chdir(tmp_path)
    broken = skeleton("task.toml", "broken").replace(
        'work = { kind = "action" }', 'work = { kind = "action", args = { force = "x" } }'
    )
    Path("pressing.py").write_text(PRESSING, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    Path("broken.toml").write_text(broken, encoding="utf-8")
    node = 'schema = 1\n[nodes.robot]\nhost = "127.0.0.1"\nport = 7399\n'
    action = '[actions.{0}]\nrun = "pressing:{0}"\ntask = "{0}"\nnode = "robot"\n'
    Path("services.toml").write_text(
        node + action.format("work") + action.format("recover"), encoding="utf-8"
    )
    assert main(["run", "broken.toml", "--mode", "lockstep", "--json", "out.json"]) == 1
    said = capsys.readouterr()
    work, recover = json.loads(Path("out.json").read_text(encoding="utf-8"))["last_errors"]
    assert (work["run"], work["node"], recover["run"], recover["primitive_task"]) == (
        ("work#1", "robot", "recover#1", "recover")
    )
    shown = "".join(said.out.split())
    assert "TypeError" in work["text"] and recover["cause"] == "no_power"
    for error in (work, recover):
        assert "".join(f"{error['run']}, {error['action']} on robot".split()) in shown
        assert "".join(error["text"].split()) in shown
    assert "--journal" in said.err


def test_the_users_task_comes_before_a_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the page saved under `tasks` is found by its bare name."""
    from petrobot.coordinator.cli.loading import SHIPPED, task_path

    monkeypatch.chdir(tmp_path)
    assert task_path("catch_ball") == SHIPPED / "catch_ball.toml"
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "catch_ball.toml").write_text("schema = 1\n", encoding="utf-8")
    assert task_path("catch_ball") == Path("tasks/catch_ball.toml")


@pytest.mark.processes
def test_a_task_may_name_its_own_location_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`services` of the task file is found from any folder, and --services overrides it; it is kept
    when the task is written and read."""
    from petrobot.coordinator.cli.loading import SHIPPED, cell_path
    from petrobot.coordinator.task.file import dumps, load, loads

    monkeypatch.chdir(tmp_path)
    task = load(SHIPPED / "follow_track.toml")
    assert loads(dumps(task)).services == task.services != ""
    assert (
        cell_path(None, "follow_track", task).resolve()
        == ROOT / "services" / "mobile" / "track.services.toml"
    )
    assert cell_path(Path("mine.toml"), "follow_track", task) == Path("mine.toml")
    assert (
        cell_path(None, "catch_ball", load(SHIPPED / "catch_ball.toml")) == ROOT / "services.toml"
    )
    # Not every state is searched: what `check` finds there does not depend on the folder.
    monkeypatch.setattr(may_run, "BUDGET", may_run.Budget(markings=50, steps=100))
    assert main(["check", "follow_track"]) == 0


def test_a_task_may_draw_its_own_pictures() -> None:
    """`pictures` of the task file names a function that draws a result for the report. A function
    that does not exist is an error."""
    from msgspec.structs import replace

    from petrobot.coordinator.cli import CommandError
    from petrobot.coordinator.cli.loading import SHIPPED, pictures_of
    from petrobot.coordinator.task.file import load

    task = load(SHIPPED / "follow_track.toml")
    assert pictures_of(task, {"task": "follow_track"}) == {}, "nothing was scored"
    assert pictures_of(load(SHIPPED / "catch_ball.toml"), {}) == {}
    assert list(pictures_of(replace(task, pictures="builtins:dict"), {"plan": "<svg/>"})) == [
        "plan"
    ]
    for wrong in ("nowhere:draw", "coordinator:nothing"):
        with pytest.raises(CommandError, match="name a function"):
            pictures_of(replace(task, pictures=wrong), {})


@pytest.mark.processes
@pytest.mark.parametrize(
    "deed",
    [
        "sys.stdout.close()",
        "sys.stdout = io.StringIO()",
        "sys.stdout.close(); sys.stderr.close()",
        "sys.stdout.detach()",
        "sys.stdout = io.StringIO(); sys.stdout.close()",
        "import threading; threading.Thread(target=threading.Event().wait).start()",
        "import os; os.chdir('/')",
    ],
)
def test_the_result_is_given_although_an_action_takes_output_or_folder_away(
    tmp_path: Path, deed: str
) -> None:
    """In lock step the action runs in the process of the command. Later actions print, too. A
    thread that it has left running does not keep the command from ending."""
    assert petrobot("new", "robot", "bot", cwd=tmp_path).returncode == 0
    code = tmp_path / "bot" / "bot.py"
    head, move, body = code.read_text(encoding="utf-8").partition("async def move(")
    signature, end, rest = body.partition("-> Result:\n")
    deed = f"    import io, sys; print('moves'); print('moves', file=sys.stderr); {deed}\n"
    code.write_text(head + move + signature + end + deed + rest, encoding="utf-8")
    words = ["run", "bot/bot.toml", "--mode", "lockstep", "--journal", "runs"]
    done = petrobot(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "status" in done.stdout and "success" in done.stdout
    assert len([*(tmp_path / "runs").glob("*/result.json")]) == 1


@pytest.mark.processes
def test_what_code_of_users_prints_is_not_in_the_json(tmp_path: Path) -> None:
    """In lock step it runs in the process of the command."""
    assert petrobot("new", "robot", "bot", cwd=tmp_path).returncode == 0
    code = tmp_path / "bot" / "bot.py"
    said = '    import os; print("moves"); os.system("echo runs")\n'
    head, move, body = code.read_text(encoding="utf-8").partition("async def move(")
    signature, end, rest = body.partition("-> Result:\n")
    text = head + move + signature + end + said + rest
    code.write_text(text.replace("\nclass ", '\nprint("read")\n\n\nclass ', 1), encoding="utf-8")
    done = petrobot("run", "bot/bot.toml", "--mode", "lockstep", "--json", "-", cwd=tmp_path)
    assert json.loads(done.stdout)["status"] == "success", done
    assert all(word in done.stderr for word in ("moves", "runs", "read"))


@pytest.mark.processes
def test_a_run_without_its_score_has_its_result_and_a_resume_asks_again(tmp_path: Path) -> None:
    """The node that scores may have died: of such a run, only one line was left."""
    assert petrobot("new", "robot", "bot", cwd=tmp_path).returncode == 0
    bot = tmp_path / "bot"
    task = (bot / "bot.toml").read_text(encoding="utf-8")
    (bot / "bot.toml").write_text(task.replace("[task]", '[task]\nscore = "tally"', 1), "utf-8")
    services = (bot / "services.toml").read_text(encoding="utf-8")
    tally = '[services]\ntally = { node = "pc", run = "bot:tally" }\n[actions]\n'
    (bot / "services.toml").write_text(services.replace("[actions]\n", tally, 1), "utf-8")
    code = (bot / "bot.py").read_text(encoding="utf-8")
    score = """

def tally(ctx: Context, *, cycles: list) -> Result:
    from pathlib import Path
    if not Path("counted").exists():
        raise OSError("nobody counts")
    return success(counted=len(cycles))
"""
    (bot / "bot.py").write_text(code + score, encoding="utf-8")
    words = ["--quiet", "--json", "out.json"]
    run = ["run", "bot/bot.toml", "--mode", "lockstep", "--journal", "runs", *words]
    done = petrobot(*run, cwd=tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    first = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert first["status"] == "success" and "goals" in first and "counted" not in first
    assert "nobody counts" in first["unscored"] and "petrobot resume " in first["unscored"]
    assert "unscored" in done.stdout
    (tmp_path / "counted").touch()
    done = petrobot("resume", "last", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    again = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert again["counted"] > 0 and "unscored" not in again
    assert again["goals"] == first["goals"]


@pytest.mark.parametrize(
    ("connection", "tunnel"),
    [
        ("192.0.2.9 50312 192.0.2.7 22", "`ssh -L 8377:127.0.0.1:8377 eva@192.0.2.7`"),
        ("2001:db8::9 5 2001:db8::7 2222", "`ssh -p 2222 -L 8377:127.0.0.1:8377 eva@2001:db8::7`"),
        ("", ""),
    ],
)
def test_over_ssh_the_page_comes_with_the_command_for_its_tunnel(
    connection: str, tunnel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSH_CONNECTION", connection)
    monkeypatch.setenv("LOGNAME", "eva")
    page, *more = page_line("http://127.0.0.1:8377/?token=x").splitlines()
    assert page == "page: http://127.0.0.1:8377/?token=x"
    assert tunnel in "".join(more) and bool(more) is bool(tunnel)


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_another_operating_system_is_named(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wheel installs everywhere; the first missing module said nothing to its user."""
    assert petrobot_package.__file__ is not None
    monkeypatch.setattr(sys, "platform", system)
    with pytest.raises(ImportError, match=r"^petrobot needs Linux, "):
        runpy.run_path(petrobot_package.__file__)
