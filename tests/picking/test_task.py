"""The shipped task with both arms: no findings of check, a whole run in lock step and its
repetition, and verdicts on failures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.check import check
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import load as load_directory
from petrobot.sim.picking.laboratory import make_laboratory
from tests.sim.picking.bench import FILES

PATH = FILES.parents[1] / "coordinator" / "tasks" / "pick_and_place.toml"
LONGEST = 120.0
TICK = 0.004
ARMS = ["so101", "ur"]


@pytest.fixture(scope="module")
def task() -> Task:
    """The shipped task."""
    return load(PATH)


def run(task: Task, arm: str, seed: int, **use: str) -> dict[str, Any]:
    """Return the result of a run with one part, without its wall-clock time."""
    directory = load_directory(FILES / f"{arm}.services.toml")
    setting = Setting(task, {"regime": "plain", "parts": 1}, 1, seed, FirstAlternative(use))
    cell, party = lockstep_cell(directory, setting)
    cell.run(lambda: party.over, round(LONGEST / TICK))
    ends = [(r.place, str(r.status), r.cause) for r in party.mission.tally.runs]
    return {**party.mission.result("lockstep", 0.0), "ends": ends}


@pytest.mark.parametrize("arm", ARMS)
def test_check_finds_nothing_with_either_arm(task: Task, arm: str) -> None:
    directory = load_directory(FILES / f"{arm}.services.toml")
    report = check(task, {name: entry.node for name, entry in directory.actions.items()})
    assert report.ok and [f for f in report.findings if f.severity != "note"] == []
    wanted = {a: p for p, primitive in task.primitive_tasks.items() for a in primitive.alternatives}
    assert {a.name: a.task for a in directory.actions.values()} == wanted


@pytest.mark.parametrize("arm", ARMS)
def test_parts_are_put_into_their_trays_and_the_same_seed_repeats_it(task: Task, arm: str) -> None:
    use = {"locate_part": "locate_templates"}
    first = run(task, arm, 2, **use)
    assert first["status"] == "success" and first["parts"] == 1
    assert first["in_tray"] == 1 and first["grips"] >= 1
    assert first["ends"][-1] == ("place_part", "success", "")
    assert run(task, arm, 2, **use) == first


@pytest.mark.parametrize(
    ("arm", "keys"),
    [
        ("so101", {"source": ("sim", "capture:0"), "port": ("pty:/tmp/petrobot-so101", "/dev/a")}),
        ("ur", {"source": ("sim", "capture:0"), "host": ("unix:/tmp/petrobot-ur5e", "10.0.0.2")}),
    ],
)
def test_on_the_robot_two_keys_differ_and_the_laboratory_judges_nothing(
    arm: str, keys: dict[str, tuple[str, str]], tmp_path: Path
) -> None:
    for path in FILES.glob("*.toml"):
        (tmp_path / path.name).write_text(path.read_text())
    path = tmp_path / f"{arm}.services.toml"
    text = path.read_text()
    for key, (simulated, real) in keys.items():
        old = f'{key} = "{simulated}"'
        assert text.count(old) == 1
        text = text.replace(old, f'{key} = "{real}"')
    cycle = {"n": 1, "begun_ago": 9.0, "ended_ago": 0.0, "runs": []}
    simulated_cell = make_laboratory(load_directory(path), "laboratory")
    assert simulated_cell.score({"cycles": [cycle]})["parts"] == 5
    path.write_text(text)
    assert make_laboratory(load_directory(path), "laboratory").score({"cycles": [cycle]}) == {}
