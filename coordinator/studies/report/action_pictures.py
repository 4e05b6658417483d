"""Curves of choices, reliability and J over the trials, and pictures of them, for reports of
campaigns and of single runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.learning.estimate import Tally, TallyKey
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.records import Record, RunEnd
from petrobot.coordinator.learning.selectors import cost_of
from petrobot.coordinator.learning.statistics import mean_interval
from petrobot.coordinator.studies.campaign.block import LoadedPlan
from petrobot.coordinator.studies.campaign.observed import regime_of
from petrobot.coordinator.studies.campaign.plan import CampaignPlan
from petrobot.coordinator.studies.campaign.policies import LearnedActions, learns, policy_of
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.report import charts
from petrobot.coordinator.task import Status, Task

Curve = list[tuple[float, float]]
Curves = dict[str, Curve]
_Seen = tuple[int, str, bool, float | None]
"""A run: number of its trial, action, whether it succeeded, cost."""
POINTS = 300
"""Largest number of points of a curve."""
WINDOW = 50
"""Runs over which shares of choices are averaged."""


class LearningCurves(Struct):
    """Curves of one primitive task in one regime, by action; x is the number of the trial in that
    regime, in a single run that of the run of the primitive task."""

    primitive_task: str
    regime: str
    context: str = ""
    """For a single run: the context from which `regime` was derived."""
    probability: Curves = field(default_factory=dict)
    """Learned p; for campaigns that do not learn, the share of choices over the last `WINDOW`
    runs."""
    objective: Curves = field(default_factory=dict)
    """J computed from the sums so far, with the rho so far."""


def objective_curves(task: Task, rows: Sequence[TrialRow]) -> list[LearningCurves]:
    """Return J and shares of choices of every primitive task with alternatives, by regime."""
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
    """Return the same curves for a single mission run, from its records of learning."""
    runs: dict[tuple[str, str], list[_Seen]] = {}
    for record in records:
        if isinstance(record, RunEnd) and record.outcome.status is not None:
            cost = cost_of(record.outcome, task.primitive_tasks[record.primitive_task].cost)
            seen = runs.setdefault((record.primitive_task, record.context), [])
            success = record.outcome.status is Status.SUCCESS
            known = None if math.isnan(cost) else cost
            seen.append((len(seen) + 1, record.action, success, known))
    out = []
    for (name, context), seen_runs in runs.items():
        alternatives = task.primitive_tasks[name].alternatives
        if len(alternatives) > 1:
            made = LearningCurves(name, regime_of(context), context)
            _fill(made, seen_runs, alternatives)
            out.append(made)
    return out


def _runs(task: Task, primitive: str, rows: Sequence[TrialRow]) -> Iterator[_Seen]:
    for k, row in enumerate(rows, 1):
        for run in row.runs:
            if run.status and task.primitive_task_of(run.place).name == primitive:
                yield k, run.action, run.status == Status.SUCCESS.value, run.cost


def _fill(made: LearningCurves, runs: Sequence[_Seen], actions: Sequence[str]) -> None:
    sums = {action: [0, 0, 0.0, 0] for action in actions}
    step = max(1, len(runs) // POINTS)
    for i, (k, action, success, cost) in enumerate(runs, 1):
        own = sums.setdefault(action, [0, 0, 0.0, 0])
        own[0], own[1], own[2], own[3] = (
            own[0] + 1,
            own[1] + success,
            own[2] + (cost or 0.0),
            own[3] + (cost is not None),
        )
        if i > 1 and i % step and i != len(runs):
            continue
        recent = [a for _, a, *_ in runs[max(0, i - WINDOW) : i]]
        costs = {a: s[2] / s[3] if s[3] else 0.0 for a, s in sums.items()}
        rho = 1.0 / max(costs.values()) if max(costs.values()) > 0 else 0.0
        for a, s in sums.items():
            made.probability.setdefault(a, []).append((k, recent.count(a) / len(recent)))
            if s[0]:
                made.objective.setdefault(a, []).append((k, 1.0 - s[1] / s[0] + rho * costs[a]))


def learned_curves(
    plan: CampaignPlan, rows: Sequence[TrialRow], trials: Sequence[LearningCurves]
) -> None:
    """Replace shares of choices by the probabilities that the selectors had after each batch; does
    nothing for a campaign without learner."""
    if not learns(plan.selector):
        return
    bench = LoadedPlan.of(plan)
    policy = policy_of(plan, bench.task, bench.directory)
    if not isinstance(policy, LearnedActions):
        return
    counts = dict.fromkeys((one.regime for one in trials), 0)
    for one in trials:
        p = policy.state(counts)[one.regime][one.primitive_task]["p"]
        one.probability = {action: [(1, chance)] for action, chance in p.items()}
    given = iter(rows)
    for batch in plan.batches:
        taken = list(islice(given, sum(block.count for block in batch)))
        if len(taken) < sum(block.count for block in batch):
            return
        for block in batch:
            policy.weights(block)
            counts[block.regime] = counts.get(block.regime, 0) + block.count
        policy.update(taken)
        state = policy.state()
        for one in trials:
            p = state.get(one.regime, {}).get(one.primitive_task, {}).get("p", {})
            for action, chance in p.items():
                one.probability.setdefault(action, []).append((counts[one.regime], chance))


# --- pictures ---


Pictures = dict[str, tuple[str, str]]
"""Heading and SVG text by file name."""
TRIALS, ACTIONS = "Choices and J over trials", "Reliability and cost of each action"


def put(pictures: Pictures, name: str, heading: str, svg: str) -> None:
    """Add a picture under a name that is valid for a file."""
    pictures["".join(c if c.isalnum() else "_" for c in name)] = (heading, svg)


def trial_pictures(trials: Iterable[LearningCurves], word: str) -> Pictures:
    """Return the pictures of these curves. `word`: what the curves of choices show."""
    out: Pictures = {}
    for one in trials:
        where = f"{one.primitive_task}{', ' + one.regime if one.regime else ''}"
        if one.probability:
            svg = charts.lines(f"{where}: {word}", "trial", word, one.probability, unit=True)
            put(out, f"probability {where}", TRIALS, svg)
        if one.objective:
            svg = charts.lines(f"{where}: J = 1 - R + rho C", "trial", "J", _settled(one))
            put(out, f"objective {where}", TRIALS, svg)
    return out


def action_pictures(task: Task, estimates: Estimates) -> Pictures:
    """Return pictures of R and C of every action that ran, by primitive task."""
    out: Pictures = {}
    for primitive in task.primitive_tasks.values():
        known = [
            (k, t)
            for k, t in sorted(estimates.tallies.items())
            if k.primitive_task == primitive.name and t.judged
        ]
        reliability = [_reliability(key, tally) for key, tally in known]
        cost = [
            _cost(key, tally, primitive.cost)
            for key, tally in known
            if tally.cost(primitive.cost).n
        ]
        if reliability:
            title = f"{primitive.name}: R with 95 % interval"
            put(
                out,
                f"reliability {primitive.name}",
                ACTIONS,
                charts.intervals(title, "R", reliability, unit=True),
            )
        if cost:
            title = f"{primitive.name}: mean cost with 95 % interval"
            put(
                out,
                f"cost {primitive.name}",
                ACTIONS,
                charts.intervals(title, _unit(primitive.cost), cost),
            )
    return out


LATENCY = "latency"
"""Numbers of results whose names begin like this are drawn as latencies, for example the seconds
from an image to its set point."""


def add_latencies(found: dict[str, list[float]], action: str, values: Mapping[str, Any]) -> None:
    """Collect the latencies (s) that a run reported, by action and name."""
    for name, value in values.items():
        if name.startswith(LATENCY) and isinstance(value, int | float):
            found.setdefault(f"{action}: {name}", []).append(float(value))


def latency_svg(found: Mapping[str, list[float]]) -> str:
    """Return a histogram of the reported latencies."""
    return charts.histogram("Latencies that runs reported", "s", found)


IntervalRow = tuple[str, str, float, float, float]


def _reliability(key: TallyKey, tally: Tally) -> IntervalRow:
    low, high = tally.interval()
    return key.action, regime_of(key.context), low, tally.reliability, high


def _cost(key: TallyKey, tally: Tally, measure: str) -> IntervalRow:
    spent = tally.cost(measure)
    low, high = mean_interval(spent) if spent.n > 1 else (spent.mean, spent.mean)
    return key.action, regime_of(key.context), low, spent.mean, high


def _unit(measure: str) -> str:
    return {"wall": "C (s)", "cpu": "C (s of computing)"}.get(
        measure, f"C ({measure.removeprefix('value:')})"
    )


def _settled(trials: LearningCurves) -> Curves:
    """Return the curves of J without the first 2 % of the trials, where a single failure would
    dominate the axis."""
    last = max((points[-1][0] for points in trials.objective.values()), default=0.0)
    return {
        a: [p for p in points if p[0] > 0.02 * last] or points
        for a, points in trials.objective.items()
    }
