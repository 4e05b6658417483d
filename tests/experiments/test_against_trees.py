"""The experiment with a behaviour tree: its three programs do the task, and its referee and its
counts are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("py_trees")

from experiments.against_trees import plant
from experiments.against_trees.costs import code_lines, reactions
from experiments.against_trees.faults import FAULTS
from experiments.against_trees.forecasts import CHANGES, figures
from experiments.against_trees.judge import Report, violations
from experiments.against_trees.learned import best, chance, regret
from experiments.against_trees.missions import Mission, net_mission, program_mission
from experiments.against_trees.plant import Entry
from experiments.against_trees.results import CELL, PLANT, PROGRAMS, TASK, Results
from experiments.against_trees.verified import first_symptom, make_of, runner, source_of
from petrobot.coordinator.task.file import load as load_task
from petrobot.services.comm.location_file import load


def played(program: str, cell: Path, balls: int, seed: int) -> Mission:
    directory = load(cell)
    if program == "net":
        task = load_task(TASK)
        return net_mission(directory, task, balls, seed)
    return program_mission(directory, make_of(program, None), balls, seed)


@pytest.mark.parametrize("program", PROGRAMS)
def test_each_program_catches_a_ball_in_the_laboratory(program: str) -> None:
    mission = played(program, CELL, 1, 1)
    assert mission.report == Report(1, False)
    assert mission.score["caught"] == mission.score["thrown"] == 1


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_referee_finds_nothing_against_the_correct_programs(program: str) -> None:
    assert first_symptom(runner(program, None), 40) == (None, "")


def test_each_fault_is_another_program() -> None:
    assert len(FAULTS) == 30
    for program in PROGRAMS:
        right = source_of(program, None)
        wrong = [source_of(program, n) for n in range(30)]
        said = [text for text in wrong if text is not None]
        assert right not in said and len(set(said)) == len(said)


GOOD = (
    (0.0, "camera", "locate_mog2", "success", 0.1),
    (0.1, "camera", "predict_kalman", "success", 0.2),
    (0.1, "arm", "intercept_tilted", "success", 0.1),
    (0.21, "arm", "follow_and_wait", "cut", 0.09),
    (0.31, "arm", "empty_and_home", "success", 0.1),
)


def entries(*runs: tuple[float, str, str, str, float], caught: bool = True) -> list[Entry]:
    log: list[Entry] = []
    for n, (begin, device, action, what, seconds) in enumerate(runs):
        log.append(Entry(begin, device, action, str(n), "begin", 1))
        if caught and action.startswith("follow"):
            log.append(Entry(begin + seconds - 0.01, device, action, str(n), "caught", 1))
        log.append(Entry(begin + seconds, device, action, str(n), what, 1))
    return sorted(log, key=lambda entry: (entry.t, entry.what == "begin"))


@pytest.mark.parametrize(
    ("log", "report", "balls", "says"),
    [
        (entries(*GOOD), Report(1, False), 1, ""),
        (entries(*GOOD), Report(0, False), 1, "reports 0 caught of 1"),
        (entries(*GOOD), Report(1, True), 1, "reports that the arm is lost"),
        (entries(*GOOD), Report(1, False), 2, "another number of balls"),
        (entries(*GOOD), Report(1, False, "KeyError"), 1, "KeyError"),
        (entries(*GOOD[:4]), Report(1, False), 1, "after follow (the catch) the arm did nothing"),
        (entries(*GOOD, caught=False), Report(0, False), 1, "follow was cut short"),
        (entries(GOOD[0], *GOOD[2:]), Report(1, False), 1, "was not tracked"),
        (entries(*GOOD[:2]), Report(0, False), 1, "the arm did not move"),
    ],
)
def test_the_referee_names_what_is_wrong(
    log: list[Entry], report: Report, balls: int, says: str
) -> None:
    found = violations(log, report, balls)
    assert (not found) if not says else any(says in line for line in found)


def test_symptoms_of_a_fault_are_found() -> None:
    names = [fault.name for fault in FAULTS]
    swapped = names.index("results of locating swapped")
    for program in PROGRAMS:
        assert first_symptom(runner(program, swapped), 10)[0] == 10
    assert plant.ENTRIES


def test_a_result_is_measured_once(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.add("part", "b", {"value": 2})
    results.add("part", "a", {"value": 1})
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"part": "part", "key": "c", "val')  # killed while it wrote
    again = Results(tmp_path)
    assert [line["value"] for line in again.of("part")] == [1, 2]
    again.add("part", "c", {"value": 3})
    assert len(Results(tmp_path).of("part")) == 3


def test_the_plant_is_offered_whole() -> None:
    assert {a.args["action"] for a in load(PLANT).actions.values()} == set(plant.ACTIONS)


CODE = '''"""A text
of the module."""

import os  # counted


def two(a: int,
        b: int) -> str:
    """Not counted."""
    # neither is this
    return """a string
that counts"""
'''


def test_lines_of_code_are_counted(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(CODE, encoding="utf-8")
    assert code_lines(tmp_path / "one.py") == 5
    task = '# no\n\n[places.a]\nkind = "action" # yes\nx = 1\ny = 2\nlabel = "no"\ntext = "no"\n'
    (tmp_path / "one.toml").write_text(task, encoding="utf-8")
    assert code_lines(tmp_path / "one.toml") == 2


def test_the_chance_of_a_combination_is_the_plants() -> None:
    usual = ("locate_background", "predict_least_squares", "intercept_tilted")
    runs = [played("machine", PLANT, 50, seed).report.caught for seed in range(4)]
    assert abs(sum(runs) / 200 - chance(usual, {})) < 0.11  # four standard errors


def test_regret_is_the_difference_to_the_best_choice() -> None:
    _, first = best({})
    assert regret([5, 0]) == pytest.approx([5 * first - 5, 10 * first - 5])


def test_figures_of_a_forecast_and_its_changes() -> None:
    goal, times = np.array([1.0, 0.0, 1.0, 1.0]), np.array([1.0, np.nan, 3.0, 2.0])
    assert figures(goal, times) == pytest.approx((0.75, 2.0, 2.8))
    assert len(CHANGES) == 20 and len({change.name for change in CHANGES}) == 20


def test_a_reaction_is_from_located_to_moving() -> None:
    assert reactions(entries(*GOOD)) == pytest.approx([0.0])
