"""R, C and J of the whole task while it runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.engine import Begin, Engine, RunEnded, StartRun, Stimulus
from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.operator import observation
from petrobot.coordinator.operator.observation import TASK_REPORT, TrialWatch, task_text
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.studies.campaign.block import costs
from petrobot.coordinator.studies.campaign.summary import Summary
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial, TrialLog
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.file import load, loads
from petrobot.services.comm.location_file import parse

TASK = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"


def test_the_text_has_goals_r_c_and_j_with_intervals() -> None:
    """Ten trials of one run each, of which one failed; the goal was met in eight."""
    rows = []
    for k in range(1, 11):
        status = "failure" if k == 10 else "success"
        run = RunEntry("locate_ball", "locate_mog2", 0.0, 1.0, status, cost=1.0 + 0.1 * (k % 2))
        trial = Trial(k, 0.0, 1.0, completed=True, goals=int(k < 9), runs=[run], status=status)
        rows.append(TrialRow(k, "", 0, k, 0, 0.0, trial))
    found = Summary.of(load(TASK), rows)
    low, high = wilson(8, 10)
    text = task_text(found)
    assert text.startswith(f"10 trials: goal met in 8 of 10 ({low:.3f} to {high:.3f}), R (every ")
    assert "success) 0.9 (" in text and ", C 1.05 (" in text
    figures = found.task_figures()
    assert f"J {figures['J']:.3g} ({figures['J_interval'][0]:.3g} to " in text
    assert text.endswith(f"rho {figures['rho']:.3g}")


def test_one_trial_has_a_reliability_but_no_cost_yet() -> None:
    run = RunEntry("locate_ball", "locate_mog2", 0.0, 1.0, "success", cost=1.0)
    trial = Trial(1, 0.0, 1.0, completed=True, goals=1, runs=[run])
    text = task_text(Summary.of(load(TASK), [TrialRow(1, "", 0, 1, 0, 0.0, trial)]))
    assert (
        text.startswith("1 trial: goal met in 1 of 1 (") and "R (every run a success) 1 (" in text
    )
    assert "C " not in text and "J " not in text


PARTS = """
schema = 1
[task]
name = "parts"
{runs}
final = "todo == 0"
[primitive_tasks.work]
deadline = 1.0
[places]
todo = {{ kind = "control", tokens = 300 }}
work = {{ kind = "action", servers = 1 }}
[transitions]
begin = {{ in = ["todo"], out = ["work"] }}
done = {{ in = ["work:normal"] }}
"""
CELL = """
schema = 1
[nodes.pc]
host = "127.0.0.1"
port = 1
[actions.work]
run = "module:work"
node = "pc"
"""


def watched(task: Task, cell: str) -> tuple[TrialWatch, TrialLog, Feed, int]:
    """Run a task; every tenth run is a failure. Return what watched it, and the most runs that the
    watch kept at a time."""
    directory, feed = parse(cell, Path("services.toml")), Feed()
    watch, log = TrialWatch(task, directory, feed), TrialLog(task, costs(task, directory))
    engine, now, most = Engine(task), 0.0, 0
    order: list[Stimulus] = [Begin()]
    state = engine.initial()
    while order:
        now += 0.5
        for one in (watch, log):
            one.stimulus(now, order[0])
        state, said = engine.handle(state, order.pop(0))
        for instruction in said:
            for one in (watch, log):
                one.instruction(now, instruction)
            if isinstance(instruction, StartRun):
                number = int(instruction.run.rpartition("#")[2])
                status = Status.FAILURE if number % 10 == 0 else Status.SUCCESS
                order.append(RunEnded(instruction.run, status, seconds=0.1 * (number % 3)))
        for one in (watch, log):
            one.settled(now, state)
        most = max(most, sum(len(trial.runs) for trial in watch.trials))
    return watch, log, feed, most


def test_what_is_kept_of_trials_does_not_grow_with_the_run() -> None:
    """All trials were kept and counted again each time: after a thousand, that stopped the
    coordinator for a second."""
    task = loads(PARTS.format(runs='runs_place = "todo"'))
    _, log, feed, most = watched(task, CELL)
    rows = [TrialRow(t.k, "", 0, t.k, 0, 0.0, t) for t in log.trials]
    assert len(rows) == 300 and most <= 300 // 50 + 2
    assert feed.state["reports"][TASK_REPORT]["text"] == task_text(Summary.of(task, rows))


def test_a_trial_without_an_end_is_not_counted_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observation, "RUNS_KEPT", 100)
    _, log, feed, most = watched(loads(PARTS.format(runs="")), CELL)
    assert len(log.trials) == 1 and most <= 101
    assert feed.state["reports"][TASK_REPORT]["text"].startswith("not counted any more: trials ")
