"""The whole cell in lock step: the same result in one and in several processes, and for every
placement."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.engine import Instruction, Report
from petrobot.coordinator.launch import Setting, lockstep_mission, lockstep_party
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import Correction, RunEnd
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.task import Status
from petrobot.services.comm.location_file import load
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from tests.integration.cell_files import ROOT, services_file

pytestmark = pytest.mark.processes

DESK = """
[nodes.desk]
host = "127.0.0.1"
port = 7305
"""


def run(services: Path, *arguments: str, process: bool = False, seed: int = 5) -> dict[str, Any]:
    """Run one throw, in a new process or in this one; return the result without its wall-clock
    time."""
    path = services.parent / "out.json"
    given = f"--mode lockstep --runs 1 --seed {seed} --regime B --quiet".split()
    command = ["run", "catch_ball", "--services", str(services), "--json", str(path), *given]
    command += arguments
    if process:
        python = [sys.executable, "-m", "petrobot.coordinator"]
        done = subprocess.run(
            [*python, *command], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    else:
        assert main(command) == 0
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    del result["wall_s"]
    return result


@pytest.fixture(scope="module")
def usual(shared: Callable[..., Path]) -> dict[str, Any]:
    """Return the result of the shipped placement in one process."""

    def make(folder: Path) -> None:
        result = run(services_file(folder), process=True)
        (folder / "usual.json").write_text(json.dumps(result), "utf-8")

    folder = shared("lockstep-cell", make)
    result: dict[str, Any] = json.loads((folder / "usual.json").read_text("utf-8"))
    assert result["status"] == "success"
    assert result["caught"] == 1
    return result


def test_the_result_has_the_keys_that_scripts_rely_on(usual: dict[str, Any]) -> None:
    """And `wall_s`, which `run` has taken out."""
    keys = {"task", "mode", "seed", "regime", "runs", "caught", "throws", "sim_s", "firings"}
    assert keys <= set(usual) and usual["runs"] == 1
    (throw,) = usual["throws"]
    assert {"n", "speed", "caught", "miss_mm", "status"} <= set(throw)


@pytest.mark.processes
def test_a_process_per_node_and_a_third_node_change_nothing(
    usual: dict[str, Any], tmp_path: Path
) -> None:
    """Coordinator, laboratory, vision, motion, and a third node with global memory and the sampling
    timer, in five processes."""
    edits = {
        '[timers.image_tick]\nnode = "vision"': '[timers.image_tick]\nnode = "desk"',
        '[services.memory]\nnode = "vision"': '[services.memory]\nnode = "desk"',
    }
    services = services_file(tmp_path, edits=edits, more=DESK)
    assert run(services, "--processes", "0", process=True) == usual


def test_moving_the_camera_and_its_actions_changes_nothing(
    usual: dict[str, Any], tmp_path: Path
) -> None:
    """One line of services.toml puts the camera, and so seven actions, on the arm's computer: the
    same catches."""
    edits = {'[devices.camera]\nnode = "vision"': '[devices.camera]\nnode = "motion"'}
    assert run(services_file(tmp_path, edits=edits)) == usual


def test_another_seed_gives_other_throws(usual: dict[str, Any], tmp_path: Path) -> None:
    """Only the seed decides the throws."""
    other = run(services_file(tmp_path), seed=6)
    assert other["throws"][0]["speed"] != usual["throws"][0]["speed"]


@pytest.mark.parametrize(
    ("place", "asked", "cause"),
    [
        ("", {}, ""),
        ("locate_ball", {"within": 1e-6}, "inaccurate"),
        ("locate_ball", {"min_ahead": 1.49}, "late"),
        ("track_ball", {"place_within": 1e-6}, "off"),
        ("track_ball", {"time_within": 1e-6}, "off"),
        ("track_ball", {"lead": 3.0}, "late"),
    ],
)
def test_the_task_files_numbers_decide_success(
    place: str, asked: dict[str, float], cause: str
) -> None:
    """For a caught ball, each action meets its specification, unless the task file asks for
    more. No action gives a verdict on a run whose end is final."""
    notes: list[str] = []

    class Watched(LearningSelector):
        def instruction(self, now: float, instruction: Instruction) -> None:
            super().instruction(now, instruction)
            if isinstance(instruction, Report):
                notes.append(instruction.key)

    task, directory = load_task("catch_ball"), load(ROOT / "services.toml")
    if place:
        stricter = replace(task.places[place], args={**task.places[place].args, **asked})
        task = replace(task, places={**task.places, place: stricter})
    selector = Watched(Learning(task, "fixed"))
    setting = Setting(task, {"regime": "B"}, 1, 5, selector)
    party = CoordinatorParty(directory, lockstep_mission(directory, setting))
    nodes = [lockstep_party(directory, node) for node in directory.nodes.values()]
    LockStepCell([party, *nodes], Delays(directory.delays())).run(lambda: party.over, 5_000)
    judged = dict.fromkeys(("locate_ball", "track_ball", "move_to_point"), Status.SUCCESS)
    ends = {}
    for record in selector.records:
        if isinstance(record, RunEnd) and record.primitive_task in judged:
            ends[record.primitive_task] = (record.outcome.status, record.outcome.cause)
        elif isinstance(record, Correction):
            ends[record.primitive_task] = (record.status, record.cause)
    assert ends == dict.fromkeys(judged, (Status.SUCCESS, "")) | (
        {place: (Status.FAILURE, cause)} if place else {}
    )
    assert "no_verdict_due" not in notes
