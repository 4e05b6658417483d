"""The robots in `examples/` are what the tutorial says, and run as it says."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ports import free_ports

ROOT = Path(__file__).parents[1]
SORTER = ROOT / "examples" / "sorter"
PORTER = ROOT / "examples" / "porter"
TUTORIAL = ROOT / "docs" / "tutorial.md"


def copied(robot: Path, folder: Path) -> Path:
    """Return a copy of a robot of two nodes, with ports that are free here."""
    copy = shutil.copytree(robot, folder / robot.name)
    cell = copy / "services.toml"
    text = cell.read_text(encoding="utf-8")
    for written, free in zip(re.findall(r"port = (\d+)", text), free_ports(2), strict=True):
        text = text.replace(written, str(free))
    cell.write_text(text, encoding="utf-8")
    return copy


@pytest.fixture
def sorter(tmp_path: Path) -> Path:
    """A copy of the tutorial's robot."""
    return copied(SORTER, tmp_path)


def petrobot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder as a user does."""
    return subprocess.run(
        [sys.executable, "-m", "petrobot.coordinator", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_the_tutorial_shows_the_files_as_they_are() -> None:
    """Each line of its code stands in the file that its section names, in this order."""
    page = TUTORIAL.read_text(encoding="utf-8")
    shown = 0
    for section in re.split(r"^## ", page, flags=re.MULTILINE):
        name = re.match(r"\d\. .*`(\S+)`\n", section)
        for block in re.findall(r"```(?:python|toml)\n(.*?)```", section, re.DOTALL):
            assert name is not None, section
            robot = SORTER if (SORTER / name[1]).exists() else PORTER
            lines = iter((robot / name[1]).read_text(encoding="utf-8").splitlines())
            for line in filter(None, block.splitlines()):
                assert line in lines, f"{name[1]}: {line}"
                shown += 1
    assert shown >= 30
    files = [p.read_text(encoding="utf-8").splitlines() for p in SORTER.iterdir() if p.is_file()]
    assert sum(1 for lines in files for line in lines if line.strip()) <= 130


@pytest.mark.processes
def test_it_runs_in_simulated_time(sorter: Path) -> None:
    """The same seed gives the same run; parts that slip are gripped again."""
    ran = [
        petrobot(
            sorter,
            *("run", "sort.toml", "--mode", "lockstep", "--seed", seed, "--quiet", "--no-page"),
            *("--json", f"{number}.json"),
        )
        for number, seed in enumerate("334")
    ]
    assert [each.returncode for each in ran] == [0, 0, 0], [each.stderr for each in ran]
    first, again, other = (
        json.loads((sorter / f"{n}.json").read_text(encoding="utf-8")) for n in range(3)
    )
    assert first["status"] == "success"
    assert first["sim_s"] == again["sim_s"] != other["sim_s"]
    assert re.fullmatch(
        r"\d+ runs; (\d+) errors?, all recovered \[grip: slipped( \(\1\))?\]", first["happened"]
    ), first["happened"]


@pytest.mark.processes
def test_it_runs_in_real_time(sorter: Path) -> None:
    one_part = (
        (sorter / "sort.toml").read_text(encoding="utf-8").replace("tokens = 5", "tokens = 1")
    )
    (sorter / "sort.toml").write_text(one_part, encoding="utf-8")
    ran = petrobot(sorter, "run", "sort.toml", "--up", "--quiet", "--no-page")
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.processes
def test_the_mean_of_more_pictures_is_more_reliable(tmp_path: Path) -> None:
    """The plot of docs/paper.md, with fewer runs: R(n) grows as in theory, and five pictures are
    the cheapest number for a reliability of 0.9."""
    ran = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "pictures" / "plot.py"), "1200"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert ran.returncode == 0, ran.stderr
    rows = re.findall(r"n +(\d+) .* R ([\d.]+) of 200 runs, in theory ([\d.]+)", ran.stdout)
    assert [int(n) for n, _, _ in rows] == [1, 2, 3, 5, 8, 13]
    for _, measured, theory in rows:  # five standard errors
        spread = (float(theory) * (1 - float(theory)) / 200) ** 0.5
        assert abs(float(measured) - float(theory)) < 5 * max(spread, 0.005)
    assert "cheapest n with R of at least 0.9: 5" in ran.stdout
    assert (tmp_path / "pictures.svg").read_text(encoding="utf-8").count("<circle") == 6


@pytest.mark.processes
def test_the_net_of_figure_1_catches_a_ball() -> None:
    """One: the next is thrown only when the cup is empty and the arm at home (docs/paper.md)."""
    figure = str(ROOT / "examples" / "paper" / "figure1.toml")
    given = ("run", figure, "--mode", "lockstep", "--runs", "1", "--quiet", "--json", "-")
    ran = petrobot(ROOT, *given)
    assert ran.returncode == 0, ran.stderr
    result = json.loads(ran.stdout[ran.stdout.index("{") :])
    assert result["caught"] == 1


@pytest.mark.processes
def test_the_porter_runs(tmp_path: Path) -> None:
    """Subnet, alternatives, recovery, shared arm, event, stream and memory, in at most 300 lines:
    it may run, ends well with each seed, and runs in real time on two nodes."""
    porter = copied(ROOT / "examples" / "porter", tmp_path)
    files = [p.read_text(encoding="utf-8").splitlines() for p in porter.iterdir() if p.is_file()]
    assert sum(1 for lines in files for line in lines if line.strip()) <= 300
    tested = subprocess.run(
        [sys.executable, "-m", "pytest", "-q"],
        cwd=porter,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert tested.returncode == 0 and "4 passed" in tested.stdout, tested.stdout
    checked = petrobot(porter, "check", "deliver.toml")
    assert checked.returncode == 0 and "warning" not in checked.stdout, checked.stdout
    run = ("run", "deliver.toml", "--quiet", "--no-page", "--json", "-")
    lasted = set()
    for seed in "12":
        ran = petrobot(porter, *run, "--mode", "lockstep", "--seed", seed)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        result = json.loads(ran.stdout)
        lasted.add((result["sim_s"], result["happened"]))
    assert len(lasted) == 2
    ran = petrobot(porter, *run, "--up", "--runs", "1")
    assert ran.returncode == 0, ran.stdout + ran.stderr
