"""Fixtures of the forecast tests: randomly drawn trials of a small task with known
probabilities."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import numpy as np
import pytest

from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads


def with_transitions(text: str) -> str:
    """Return the text of a task file in which each line `name: a, b -> c; key = value` is a
    transition with its input and output arcs and other keys."""
    return re.sub(r"(?m)^(\w+): (.*?) ?->(.*?)(?:; (.*))?$", _transition, text)


def _transition(line: re.Match[str]) -> str:
    name, *arcs, keys = line.groups()
    inputs, outputs = (
        json.dumps([arc.strip() for arc in a.split(",") if arc.strip()]) for a in arcs
    )
    more = "".join(f"\n{key}" for key in (keys or "").split("; ") if key)
    return f"[transitions.{name}]\nin = {inputs}\nout = {outputs}{more}"


TASK = with_transitions("""
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
begin: jobs, free -> first; event = "tick"
on: first:normal -> second
off: first:error -> free
done: second:preempt=success -> free; event = "signal"
missed: second:normal -> free
lost: second:error -> free
""")

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
            wait = [Waited("begin", float(random.uniform(0, 0.2)), WaitEnd.FIRED)]
            out.append(Trial(k % 5 + 1, 0.0, round(time, 6), True, goals, worst, "", runs, wait))
        return out

    return make
