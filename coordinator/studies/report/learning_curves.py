"""How choices, reliabilities and J went over the trials of a campaign, derived again from its
table, or of a recorded run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

from petrobot.coordinator.learning.records import End, Record
from petrobot.coordinator.learning.selectors import cost_of
from petrobot.coordinator.studies.campaign.block import Bench
from petrobot.coordinator.studies.campaign.observed import regime_of
from petrobot.coordinator.studies.campaign.plan import Plan
from petrobot.coordinator.studies.campaign.policies import Learned, policy_of
from petrobot.coordinator.studies.campaign.rows import Row
from petrobot.coordinator.task import Status, Task

Curve = list[tuple[float, float]]
Curves = dict[str, Curve]
POINTS = 300
"""Points of a curve at most."""
WINDOW = 50
"""Trials over which shares of choices are averaged."""


@dataclass
class LearningCurves:
    """Curves of one primitive task in one regime, by action; x is the trial (runs of the primitive
    task in that regime)."""

    primitive_task: str
    regime: str
    context: str = ""
    """Of a single run: the context that `regime` was told from."""
    probability: Curves = field(default_factory=dict)
    """Learned p; of campaigns that do not learn, the share of choices over the last `WINDOW`
    trials."""
    objective: Curves = field(default_factory=dict)
    """J from the sums so far with the rho so far."""


def objective_curves(task: Task, rows: Sequence[Row]) -> list[LearningCurves]:
    """J and shares of choices of every primitive task with alternatives, by regime."""
    out = []
    for primitive in task.primitive_tasks.values():
        if len(primitive.alternatives) < 2:
            continue
        for regime in dict.fromkeys(row.regime for row in rows):
            runs = list(_runs(task, primitive.name, [row for row in rows if row.regime == regime]))
            if runs:
                made = LearningCurves(primitive.name, regime)
                _fill(made, runs, primitive.alternatives)
                out.append(made)
    return out


def recorded_curves(task: Task, records: Iterable[Record]) -> list[LearningCurves]:
    """The same of a single mission run, from what was observed of it."""
    runs: dict[tuple[str, str], list[tuple[str, bool, float | None]]] = {}
    for record in records:
        if isinstance(record, End) and record.outcome.status is not None:
            cost = cost_of(record.outcome, task.primitive_tasks[record.primitive_task].cost)
            seen = (
                record.action,
                record.outcome.status is Status.SUCCESS,
                None if math.isnan(cost) else cost,
            )
            runs.setdefault((record.primitive_task, record.context), []).append(seen)
    out = []
    for (name, context), seen_runs in runs.items():
        alternatives = task.primitive_tasks[name].alternatives
        if len(alternatives) > 1:
            made = LearningCurves(name, regime_of(context), context)
            _fill(made, seen_runs, alternatives)
            out.append(made)
    return out


def _runs(
    task: Task, primitive: str, rows: Sequence[Row]
) -> Iterator[tuple[str, bool, float | None]]:
    for row in rows:
        for run in row.trial.runs if row.trial is not None else ():
            if run.status and task.primitive_task_of(run.place).name == primitive:
                yield run.action, run.status == Status.SUCCESS.value, run.cost


def _fill(
    made: LearningCurves, runs: Sequence[tuple[str, bool, float | None]], actions: Sequence[str]
) -> None:
    sums = {action: [0, 0, 0.0, 0] for action in actions}
    step = max(1, len(runs) // POINTS)
    for i, (action, success, cost) in enumerate(runs, 1):
        own = sums.setdefault(action, [0, 0, 0.0, 0])
        own[0], own[1], own[2], own[3] = (
            own[0] + 1,
            own[1] + success,
            own[2] + (cost or 0.0),
            own[3] + (cost is not None),
        )
        if i % step and i != len(runs):
            continue
        recent = [a for a, *_ in runs[max(0, i - WINDOW) : i]]
        costs = {a: s[2] / s[3] if s[3] else 0.0 for a, s in sums.items()}
        rho = 1.0 / max(costs.values()) if max(costs.values()) > 0 else 0.0
        for a, s in sums.items():
            made.probability.setdefault(a, []).append((i, recent.count(a) / len(recent)))
            if s[0]:
                made.objective.setdefault(a, []).append((i, 1.0 - s[1] / s[0] + rho * costs[a]))


def learned_curves(plan: Plan, rows: Sequence[Row], trials: Sequence[LearningCurves]) -> None:
    """Replace shares of choices by the probabilities that the selectors had, batch after batch;
    nothing to do without a learner."""
    bench = Bench.of(plan)
    policy = policy_of(plan, bench.task, bench.directory)
    if not isinstance(policy, Learned):
        return
    for one in trials:
        one.probability = {}
    given = iter(rows)
    counts = {(t.primitive_task, t.regime): 0 for t in trials}
    for batch in plan.batches:
        taken = list(islice(given, sum(block.count for block in batch)))
        if len(taken) < sum(block.count for block in batch):
            return
        for block in batch:
            policy.weights(block)
        policy.update(taken)
        state = policy.state()
        for one in trials:
            key = (one.primitive_task, one.regime)
            counts[key] += sum(
                1 for _ in _runs(bench.task, key[0], [row for row in taken if row.regime == key[1]])
            )
            for action, p in (
                state.get(one.regime, {}).get(one.primitive_task, {}).get("p", {}).items()
            ):
                one.probability.setdefault(action, []).append((counts[key], p))
