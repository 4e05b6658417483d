"""Fixed combinations of actions side by side: what each came to over the throws in which it was
chosen, with one rho for all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from petrobot.coordinator.campaign.rows import Row
from petrobot.coordinator.report.comparing import Weighting, objectives
from petrobot.coordinator.task import Task

Combination = tuple[tuple[str, str], ...]
"""(primitive task, action) of each primitive task with alternatives, in the order of the task
file."""


@dataclass(frozen=True)
class Judged:
    """One combination. J is the mean over the primitive tasks with alternatives; `task_objective`
    that of the whole task."""

    combination: Combination
    throws: int
    goal: float
    objective: float
    task_objective: float
    time: float
    """Mean of the completed throws (s)."""

    def to_plain(self) -> dict[str, Any]:
        """Plain data."""
        return {
            **dict(self.combination),
            "runs": self.throws,
            "R_goal": round(self.goal, 6),
            "J": round(self.objective, 6),
            "J of the task": round(self.task_objective, 6),
            "mean time (s)": round(self.time, 6),
        }


def combination_of(task: Task, row: Row, names: Sequence[str]) -> dict[str, str]:
    """The actions of a throw's first runs."""
    out: dict[str, str] = {}
    for run in row.throw.runs if row.throw is not None else ():
        name = task.primitive_task_of(run.place).name
        if name in names:
            out.setdefault(name, run.action)
    return out


def by_combination(
    task: Task,
    rows: Iterable[Row],
    planned: Sequence[dict[str, str]] | None = None,
    weighting: Weighting | None = None,
) -> list[Judged]:
    """Every combination in these rows, the lowest J first.

    `planned`: the combination meant for each row; a throw that ended before all of its runs still
    counts for it. Without it, only throws in which every primitive task ran can be told apart.
    """
    kept = [row for row in rows if row.throw is not None]
    names = [p.name for p in task.primitive_tasks.values() if len(p.alternatives) > 1]
    weighting = weighting or Weighting.of(task, kept)
    groups: dict[Combination, list[Row]] = {}
    for i, row in enumerate(kept):
        chosen = planned[i] if planned is not None else combination_of(task, row, names)
        if all(name in chosen for name in names):
            groups.setdefault(tuple((name, chosen[name]) for name in names), []).append(row)
    return sorted(
        (_judged(task, c, own, weighting) for c, own in groups.items()),
        key=lambda j: (j.objective, j.combination),
    )


def _judged(
    task: Task, combination: Combination, rows: Sequence[Row], weighting: Weighting
) -> Judged:
    found = objectives(task, rows, weighting)
    times = [row.throw.time for row in rows if row.throw is not None and row.throw.time is not None]
    goal = float(np.mean([row.throw is not None and row.throw.goals > 0 for row in rows]))
    mean = float(np.mean(times)) if times else float("nan")
    known = [value for name, value in found.items() if name != "task" and not np.isnan(value)]
    return Judged(
        combination,
        len(rows),
        goal,
        float(np.mean(known)) if known else float("nan"),
        found["task"],
        mean,
    )
