"""The judged cell, for tests in lock step and with processes: provisional picks, and the actions
that judge them."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

from petrobot.coordinator.engine import Corrected, Instruction, Report, State, Stimulus
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.protocol.messages import Feedback

FOLDER = Path(__file__).parent / "judged"
sys.path.append(str(FOLDER))
PARTS = 6
OK, FAIL = Status.SUCCESS, Status.FAILURE
TRULY = {
    "pick#1": (FAIL, "crooked"),
    "pick#2": (OK, ""),
    "pick#3": (FAIL, "fell"),
    "pick#4": (FAIL, "crooked"),
    "pick#5": (OK, ""),
    "pick#6": (OK, ""),
}
"""The final outcome of each pick. The last one is never judged: it keeps its own result, which does
not count in R, and no selector learns from it."""


def sorting() -> Task:
    """Return the task."""
    return load(FOLDER / "sort.toml")


def directory(*ports: int) -> Directory:
    """Return a directory of two nodes, `hand` and `eye`, at these ports if any are given."""
    text = (FOLDER / "services.toml").read_text(encoding="utf-8")
    for old, new in zip((7991, 7992), ports, strict=False):
        text = text.replace(str(old), str(new))
    return parse(text, FOLDER / "services.toml")


class Heard:
    """An observer that records corrections in order, and counts reports."""

    def __init__(self) -> None:
        self.corrected: list[Corrected] = []
        self.notes: Counter[str] = Counter()

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Keep it."""
        if isinstance(instruction, Corrected):
            self.corrected.append(instruction)
        elif isinstance(instruction, Report):
            self.notes[instruction.key] += 1

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to keep."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to keep."""

    def settled(self, now: float, state: State) -> None:
        """Nothing to keep."""


def learner(task: Task) -> LearningSelector:
    """Return a learner that chooses left and right in turn, so odd picks are left ones."""
    return LearningSelector(Learning(task, "round_robin"), seed=1)


def learned(selector: LearningSelector) -> dict[str, tuple[dict[Any, int], int, int]]:
    """Return by action how its runs counted, how many of them were corrected, and the selector's
    successes."""
    tallies = {
        key.action: tally
        for key, tally in selector.learning.estimates.tallies.items()
        if tally.runs
    }
    rule = selector.learning.selectors["pick"]
    successes = dict(zip(rule.actions, rule.learner("").successes[0].tolist(), strict=True))
    return {
        a: (dict(t.counts), t.corrected, int(successes[a]))
        for a, t in tallies.items()
        if a in successes
    }


LEARNED = {
    "pick_left": ({("failure", "crooked"): 1, ("failure", "fell"): 1, ("success", ""): 1}, 2, 1),
    "pick_right": ({("failure", "crooked"): 1, ("success", ""): 2}, 1, 1),
}


def told(mission: Mission) -> dict[str, tuple[Status | None, str]]:
    """Return status and cause of each pick in the mission's tally."""
    return {r.run: (r.status, r.cause) for r in mission.tally.runs if r.place == "pick"}
