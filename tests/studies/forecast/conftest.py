"""Fixtures of the forecast tests: randomly drawn trials of a small task with known
probabilities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads

TASK = """
schema = 1
[task]
name = "pair"
final = "jobs == 0 and free == 1"
goal_transitions = ["done"]
runs_place = "jobs"
[primitive_tasks.first]
goal = "prepared"
alternatives = ["first_a", "first_b"]
deadline = 9.0
[primitive_tasks.second]
goal = "done"
alternatives = ["second_a"]
deadline = 9.0
[events.signal]
scope = "external"
memory = "latched"
mean_wait = 1.0
[events.tick]
scope = "external"
memory = "pulse"
mean_wait = 0.1
[places.jobs]
kind = "control"
tokens = 4
[places.free]
kind = "resource"
tokens = 1
[places.first]
kind = "action"
task = "first"
[places.second]
kind = "action"
task = "second"
[transitions.begin]
in = ["jobs", "free"]
out = ["first"]
event = "tick"
[transitions.on]
in = ["first:normal"]
out = ["second"]
[transitions.off]
in = ["first:error"]
out = ["free"]
[transitions.done]
in = ["second:preempt=success"]
out = ["free"]
event = "signal"
[transitions.missed]
in = ["second:normal"]
out = ["free"]
[transitions.lost]
in = ["second:error"]
out = ["free"]
"""

Make = Callable[..., list[Trial]]


@pytest.fixture
def pair() -> Task:
    """A task of two runs, one after the other; an external signal ends the second one as a
    success."""
    return loads(TASK, "pair.toml")


@pytest.fixture
def make_trials() -> Make:
    """Return a function that draws trials in which a hidden difficulty (`dependence` 1) or chance
    (0) decides about both runs.

    First run: error in 5 %, otherwise failure if it was hard. Second run: the signal comes after
    2 - (duration of the first) s, or it is missed.
    """

    def make(
        n: int,
        random: np.random.Generator,
        dependence: float = 1.0,
        actions: tuple[str, ...] = ("first_a",),
    ) -> list[Trial]:
        out = []
        for k in range(n):
            hard = random.random() < 0.3
            action = actions[int(random.integers(len(actions)))]
            took = float(random.uniform(0.4, 1.2)) + (0.2 if action == "first_b" else 0.0)
            lost = random.random() < 0.05
            status = "error" if lost else "failure" if hard else "success"
            runs = [
                RunEntry(
                    "first", action, 0.0, took, status, taken="off" if lost else "on", seconds=took
                )
            ]
            time = took
            if not lost:
                again = hard if random.random() < dependence else random.random() < 0.3
                met = random.random() < (0.4 if again else 0.95)
                rest = 2.0 - took + float(random.uniform(0.0, 0.1)) if met else 2.5
                taken, counted = ("done", "success") if met else ("missed", "failure")
                runs.append(
                    RunEntry(
                        "second",
                        "second_a",
                        took,
                        rest,
                        counted,
                        taken=taken,
                        cancelled=met,
                        seconds=rest,
                    )
                )
                time += rest
            worst = (
                "error"
                if lost
                else max((r.status for r in runs), key=("success", "failure", "error").index)
            )
            goals = int(runs[-1].taken == "done")
            wait = [("begin", float(random.uniform(0, 0.2)))]
            out.append(Trial(k % 5 + 1, 0.0, round(time, 6), True, goals, worst, "", runs, wait))
        return out

    return make
