"""A run of a campaign's table as the estimates and learners take it."""

from __future__ import annotations

from coordinator.campaign.throws import RunEntry
from coordinator.learning.estimate import Observation
from coordinator.task import Executed, Status, Task


def observation(task: Task, run: RunEntry) -> Observation:
    """A run that was preempted and counts none, or had not ended, is censored. CPU time is what services.toml declares."""
    measure = task.primitive_task_of(run.place).cost
    return Observation(
        Status(run.status) if run.status else None,
        run.seconds,
        run.cause,
        Executed(run.executed),
        run.cost if measure == "cpu" else None,
        run.values,
        run.taken if run.cancelled else None,
    )
