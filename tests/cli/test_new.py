"""`petrobot new`: the files that it writes run unchanged."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from tests.ports import free_ports

ROOT = Path(__file__).parents[2]


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module of Python in a folder, as a user who has installed petrobot does."""
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=200,
    )


def on_free_port(folder: Path) -> None:
    """Replace the port in the location file by one that is free on this host."""
    (port,) = free_ports(1)
    cell = folder / "services.toml"
    cell.write_text(cell.read_text(encoding="utf-8").replace("7501", str(port)), encoding="utf-8")


@pytest.mark.processes
def test_a_new_robot_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder it may run, its own tests pass, and it runs in real time. Seeds give
    different runs, and it needs no file from elsewhere."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "robot", "carrier"]) == 0
    folder = tmp_path / "carrier"
    assert {path.name for path in folder.iterdir()} == {
        "carrier.py",
        "carrier.toml",
        "services.toml",
        "test_carrier.py",
        "pyproject.toml",
    }
    on_free_port(folder)
    tested = python(folder, "pytest", "-q", "-p", "no:cacheprovider")
    assert tested.returncode == 0 and "5 passed" in tested.stdout, tested.stdout + tested.stderr
    run = ("petrobot.coordinator", "run", "carrier.toml", "--quiet", "--no-page")
    lasted = []
    for seed in ("3", "4"):
        ran = python(folder, *run, "--mode", "lockstep", "--seed", seed, "--json", "-")
        assert ran.returncode == 0, ran.stderr
        lasted.append(json.loads(ran.stdout)["sim_s"])
    assert lasted[0] != lasted[1]
    ran = python(folder, *run, "--up", "--runs", "1")
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.processes
def test_a_new_driver_can_be_placed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It replaces the robot's own driver, with the table that the command prints."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "robot", "carrier"]) == 0
    monkeypatch.chdir(tmp_path / "carrier")
    capsys.readouterr()
    assert main(["new", "driver", "slow_axis"]) == 0
    placed = 'under [devices]:\n  slow_axis = { node = "...", driver = "slow_axis:SlowAxis" }\n'
    assert placed in capsys.readouterr().out
    cell = Path("services.toml")
    text = cell.read_text(encoding="utf-8")
    cell.write_text(text.replace("carrier:Axis", "slow_axis:SlowAxis"), encoding="utf-8")
    for command in (
        ("pytest", "-q", "-p", "no:cacheprovider", "test_slow_axis.py"),
        ("petrobot.coordinator", "check", "carrier.toml"),
        ("petrobot.coordinator", "run", "carrier.toml", "--mode", "lockstep", "--quiet"),
    ):
        ran = python(Path.cwd(), *command)
        assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["robot", "json"], "a Python module named 'json' is there already"),
        (["robot", "Arm"], "use small letters, digits and _, a letter first"),
        (["driver", "select"], "a Python module named 'select' is there already"),
        (["action", "numpy"], "a Python module named 'numpy' is there already"),
        (["action", "grip", "--folder", "email"], "a Python module named 'email' is there already"),
        (["action", "grip", "--folder", "my-lab"], "'my-lab' cannot be the name of a package"),
        (["driver", "class"], "'class' is a keyword of Python"),
        (["robot", "kept"], "exists already; choose another name or --folder"),
    ],
)
def test_a_robot_that_cannot_be_made_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    given: list[str],
    says: str,
) -> None:
    """Nothing is written in these cases."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "kept.toml").write_text("mine")
    assert main(["new", *given]) == 2
    assert says in capsys.readouterr().err
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["kept.toml"]


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "examples").iterdir()))
def test_an_example_is_copied_whole(name: str, tmp_path: Path) -> None:
    """Who has only the wheel and the pages can follow them."""
    assert main(["new", "example", name, "--folder", str(tmp_path)]) == 0
    theirs = sorted(path for path in (ROOT / "examples" / name).iterdir() if path.is_file())
    shipped = str(ROOT / "services.toml").encode()
    assert [(p.name, p.read_bytes().replace(b"../../services.toml", shipped)) for p in theirs] == [
        (p.name, p.read_bytes()) for p in sorted((tmp_path / name).iterdir())
    ]
    assert main(["new", "example", name, "--folder", str(tmp_path)]) == 2, "nothing is overwritten"


@pytest.mark.processes
def test_the_copied_figure_of_the_paper_names_the_cell_that_it_runs_in(tmp_path: Path) -> None:
    assert main(["new", "example", "paper", "--folder", str(tmp_path)]) == 0
    ran = python(tmp_path, "petrobot.coordinator", "check", "paper/figure1.toml")
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_an_example_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "example", "crane"]) == 2
    assert "no example 'crane'; there are: opcua, paper, pictures" in capsys.readouterr().err


@pytest.mark.processes
def test_a_new_task_passes_check_with_the_lines_of_its_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "task", "fetch"]) == 0
    lines = re.findall(r"^  (\w+ = \{ .*)$", capsys.readouterr().out, re.MULTILINE)
    cell = 'schema = 1\n[nodes.pc]\nhost = "127.0.0.1"\nport = 7301\n[actions]\n'
    (tmp_path / "services.toml").write_text(cell + "\n".join(lines).replace("...", "pc"))
    assert main(["check", "fetch.toml"]) == 0, capsys.readouterr()
    assert "no node offers" not in capsys.readouterr().out
