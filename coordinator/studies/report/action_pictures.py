"""Pictures of actions that reports of runs and of campaigns share: choices and J over trials, R and
C with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from petrobot.coordinator.learning.estimate import Key, Tally
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.studies.campaign.observed import regime_of
from petrobot.coordinator.studies.report import charts
from petrobot.coordinator.studies.report.learning_curves import Curves, LearningCurves
from petrobot.coordinator.task import Task

Pictures = dict[str, tuple[str, str]]
"""Heading and SVG by file name."""
TRIALS, ACTIONS = "Choices and J over trials", "Reliability and cost of each action"


def put(pictures: Pictures, name: str, heading: str, svg: str) -> None:
    """Add a picture under a name that is fit for a file."""
    pictures["".join(c if c.isalnum() else "_" for c in name)] = (heading, svg)


def trial_pictures(trials: Iterable[LearningCurves], word: str) -> Pictures:
    """`word`: what the curves of choices show."""
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
    """R and C of every action that ran, by primitive task."""
    out: Pictures = {}
    for primitive in task.primitive_tasks.values():
        known = [
            (k, t)
            for k, t in sorted(estimates.tallies.items())
            if k.primitive_task == primitive.name and t.runs
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
"""Numbers of results whose names begin so are drawn: seconds from an image to the set point that it
led to, and the like."""


def add_latencies(found: dict[str, list[float]], action: str, values: Mapping[str, Any]) -> None:
    """Collect the latencies (s) that a run reported, by action and name."""
    for name, value in values.items():
        if name.startswith(LATENCY) and isinstance(value, int | float):
            found.setdefault(f"{action}: {name}", []).append(float(value))


def latency_svg(found: Mapping[str, list[float]]) -> str:
    """How often which latency was reported."""
    return charts.histogram("Latencies that runs reported", "s", found)


Row = tuple[str, str, float, float, float]


def _reliability(key: Key, tally: Tally) -> Row:
    low, high = tally.interval()
    return key.action, regime_of(key.context), low, tally.reliability, high


def _cost(key: Key, tally: Tally, measure: str) -> Row:
    spent = tally.cost(measure)
    half = 1.96 * spent.deviation / spent.n**0.5
    return key.action, regime_of(key.context), spent.mean - half, spent.mean, spent.mean + half


def _unit(measure: str) -> str:
    return {"wall": "C (s)", "cpu": "C (s of computing)"}.get(
        measure, f"C ({measure.removeprefix('value:')})"
    )


def _settled(trials: LearningCurves) -> Curves:
    """J curves without the first few trials, where a single failure hides everything else."""
    last = max((points[-1][0] for points in trials.objective.values()), default=0.0)
    return {
        a: [p for p in points if p[0] > 0.02 * last] or points
        for a, points in trials.objective.items()
    }
