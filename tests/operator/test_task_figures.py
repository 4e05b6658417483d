"""R, C and J of the whole task while it runs."""

from __future__ import annotations

from pathlib import Path

from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.operator.observation import task_text
from petrobot.coordinator.studies.campaign.summary import Summary
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.task.file import load

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
