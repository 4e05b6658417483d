"""R_conj, C and J of the whole task: what trials measured, and what the actions' estimates come to
through the net, by one definition."""

from __future__ import annotations

import numpy as np
import pytest

from petrobot.coordinator.cli.campaign import text_of
from petrobot.coordinator.cli.learned_show import task_line
from petrobot.coordinator.learning.objective import Question, compare, task_figures
from petrobot.coordinator.learning.propagation import propagate
from petrobot.coordinator.studies.campaign.summary import Summary
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.task.file import loads

TASK = loads(
    """
schema = 1
[task]
name = "two"
final = "jobs == 0 and free == 1"
runs_place = "jobs"
[primitive_tasks]
a = { goal = "a", alternatives = ["a_a"], deadline = 9.0 }
b = { goal = "b", alternatives = ["b_a"], deadline = 9.0 }
[places]
jobs = { kind = "control", tokens = 1 }
free = { kind = "resource", tokens = 1 }
a = { kind = "action" }
b = { kind = "action" }
[transitions]
begin = { in = ["jobs", "free"], out = ["a"] }
on = { in = ["a:normal"], out = ["b"] }
off = { in = ["a:error"], out = ["free"] }
done = { in = ["b:normal"], out = ["free"] }
lost = { in = ["b:error"], out = ["free"] }
""",
    "two.toml",
)
HARD = {"A": 0.05, "B": 0.3}


def rows(n: int, seed: int = 1) -> list[TrialRow]:
    """Trials in two regimes; a fails more often in B, and b takes longer after a failure."""
    random, out = np.random.default_rng(seed), []
    for k in range(n):
        regime = "AB"[k % 2]
        runs, begun = [], 0.0
        failed = False
        for place, taken in (("a", "on"), ("b", "done")):
            bad = bool(random.random() < HARD[regime])
            took = float(random.uniform(1.0, 2.0)) + (1.0 if failed else 0.0)
            status = "failure" if bad else "success"
            runs.append(
                RunEntry(
                    place, f"{place}_a", begun, took, status, seconds=took, cost=took, taken=taken
                )
            )
            begun, failed = begun + took, bad
        fired = {"begin": 1, "on": 1, "done": 1}
        trial = Trial(1, 0.0, begun, True, 0, "success", "", runs, [], fired)
        out.append(TrialRow(k, regime, k, 1, k, begun, trial))
    return out


def test_measured_and_composed_figures_have_one_definition() -> None:
    """Independent statuses: the trials' R_conj, C, rho and J are those of the estimates through the
    net, in the same regime."""
    made = Summary.of(TASK, rows(4000), options={"target": None})
    found = made.to_plain()["task_figures"]
    composed = propagate(TASK, made.estimates)
    assert found["regime"] == "B" and "B" in (composed.scenario or "")
    assert found["R_conj"] == pytest.approx(composed.conjunctive, abs=0.03)
    assert found["C"] == pytest.approx(composed.cost.value, rel=1e-6)
    assert found["rho"] == pytest.approx(composed.rho, rel=1e-6)
    assert found["J"] == pytest.approx(composed.j.value, abs=0.03)
    assert found["J"] == pytest.approx(1.0 - found["R_conj"] + found["rho"] * found["C"], abs=1e-5)
    for name in ("R_conj", "C", "J"):
        low, high = found[f"{name}_interval"]
        assert low < found[name] < high


@pytest.mark.once
def test_the_intervals_hold_in_repeated_campaigns() -> None:
    """C and J of the hardest regime, with rho = 0.2: failures are followed by long runs, so R and C
    depend on each other. At least 85 of 100."""
    c = 1.5 + 1.5 + 0.3
    truth = {"R_conj": 0.7**2, "C": c, "J": 1.0 - 0.7**2 + 0.2 * c}
    hits = dict.fromkeys(truth, 0)
    for seed in range(100):
        found = Summary.of(TASK, rows(160, seed), options={"rho": 0.2}).to_plain()["task_figures"]
        for name, value in truth.items():
            low, high = found[f"{name}_interval"]
            hits[name] += low <= value <= high
    assert min(hits.values()) >= 90, hits


def test_a_given_rho_is_used_and_unknown_costs_are_not_guessed() -> None:
    """One trial without a cost: no C and no J, but R_conj."""
    given = Summary.of(TASK, rows(100), options={"rho": 0.7}).to_plain()["task_figures"]
    assert given["rho"] == 0.7
    some = rows(100)
    assert some[1].trial is not None
    some[1].trial.runs[0].cost = None
    found = Summary.of(TASK, some).to_plain()["task_figures"]
    assert found["regime"] == "B" and found["R_conj"] is not None
    assert found["C"] is None and found["J"] is None and found["J_interval"] is None


def test_j_needs_a_cost_of_each_primitive_task() -> None:
    """After `learned reset` of one primitive task its cost is unknown, and so is 1 / C; it was
    taken as 0."""
    made = Summary.of(TASK, rows(100))
    trials, measures = (
        made.estimates.trials_of(TASK.name),
        dict.fromkeys(TASK.primitive_tasks, "wall"),
    )
    name = next(iter(TASK.primitive_tasks))
    compared = {**made.comparisons(), name: compare({}, Question())}
    found = task_figures(trials, measures, compared, None)
    given = task_figures(trials, measures, compared, 0.7)
    assert found is not None and given is not None
    assert found.cost == given.cost is not None
    assert (found.rho, found.j) == (None, None) and given.rho == 0.7 and given.j is not None
    assert "J needs a --rho" in task_line(found.to_plain())


def test_the_result_shows_them() -> None:
    """One line, with the regime in which the task is hardest."""
    plain = Summary.of(TASK, rows(100)).to_plain()
    about = {"task": "two", "begun": 100, "selector": "fixed", "seed": 1, "wall_s": 1.0}
    text = text_of({**plain, **about, "rows": "table.csv", "times_real_time_per_core": 1.0})
    (line,) = (line for line in text.splitlines() if line.strip().startswith("the task"))
    assert line.endswith("in B, where it is hardest") and "J " in line and "R_conj 0." in line
