"""From actions to primitive tasks to the task: measured estimates into the stochastic view, and R,
C and J back out of it.

The net decides how numbers compose: branches, loops, races and recoveries are the stochastic view's
(docs/analysis.md). Where the net is a mere series, all must come to the conjunctive product R = R_1
R_2 ..., C = C_1 + C_2 + ..., which is kept as a cross-check.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from math import log, nan, prod, sqrt
from typing import Any

import numpy as np

from petrobot.coordinator.analysis.net.graph import sum_by
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time.stochastic import Measured, is_cause, stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import Forecast, forecast
from petrobot.coordinator.learning.batch import Array
from petrobot.coordinator.learning.estimate import CENSORED, Tally, merge
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import cost_weight, objective
from petrobot.coordinator.task import Estimate, Kind, Status, Task

# Competing risks: how runs end and when, where some were cut off (O. O. Aalen and S. Johansen, Scand. J. Statistics 5 (1978)).


@dataclass(frozen=True)
class Incidence:
    """One cause: at `times` (s, increasing) its cumulative incidence has grown to `reached`."""

    times: Array
    reached: Array

    @property
    def share(self) -> float:
        """Probability of ending by this cause."""
        return float(self.reached[-1]) if len(self.reached) else 0.0

    @property
    def mean(self) -> float:
        """Mean time to the end, given this cause (s)."""
        return float(self.times @ self._mass())

    @property
    def cv(self) -> float:
        """Standard deviation over mean, given this cause."""
        mean = self.mean
        return sqrt(max(0.0, float(self.times**2 @ self._mass()) - mean**2)) / mean if mean else 0.0

    def _mass(self) -> Array:
        return np.diff(self.reached, prepend=0.0) / self.share


def incidences(times: Sequence[float], causes: Sequence[str | None]) -> dict[str, Incidence]:
    """Cumulative incidence of each cause; None: cut off. `times` in s.

    What is left of S behind the last time (it was cut off) goes to the causes in proportion to what
    they have: more is not known of it.
    """
    at = np.sort(np.asarray(times, dtype=float))
    of = [cause for _, cause in sorted(zip(times, causes, strict=True), key=lambda pair: pair[0])]
    moments, first = np.unique(at, return_index=True)
    going = len(at) - first
    known = sorted({c for c in of if c is not None})
    ended = {c: np.zeros(len(moments)) for c in known}
    for i, cause in zip(np.searchsorted(moments, at).tolist(), of, strict=True):
        if cause is not None:
            ended[cause][i] += 1
    hazard: Array = np.add.reduce([np.zeros(len(moments)), *ended.values()]) / going
    before = np.concatenate([[1.0], np.cumprod(1.0 - hazard)[:-1]]) if len(moments) else np.zeros(0)
    curves = {c: np.cumsum(before * d / going) for c, d in ended.items()}
    whole = sum(float(curve[-1]) for curve in curves.values())
    return {c: Incidence(moments, curve / whole) for c, curve in curves.items()}


Choice = Mapping[str, Mapping[str, float]]
SHORTEST = 1e-3
"""Seconds that an end takes at least in the stochastic view, which knows no duration 0."""


# --- in ---------------------------------------------------------------------------------------


def measured_from(
    task: Task, estimates: Estimates, context: str | None = None, choice: Choice | None = None
) -> Measured:
    """What the stochastic view needs, from estimates of one context (None: of all together).

    `choice` are the selector's probabilities by primitive task; None: the alternatives were chosen
    as often as they ran. Runs of a preempted place are competing risks of their own ends and the
    events or timers that preempt them. What preempts as soon as the marking allows it (another run
    has ended) is no such risk but a mere cut-off, as an abort is: the net says when.
    """
    runs: dict[tuple[str, str], dict[Status, Estimate]] = {}
    preempted: dict[tuple[str, str], dict[str, Estimate]] = {}
    often: dict[str, dict[str, float]] = {}
    for place in task.flat.places.values():
        if place.kind is not Kind.ACTION:
            continue
        takers = _preempting(task, place.name)
        for action, by_context in estimates.of(place.task, context).items():
            tally = reduce(merge, by_context.values(), Tally())
            started = tally.runs + tally.censored + sum(tally.not_executed.values())
            if not tally.runs and not tally.censored:
                continue
            often.setdefault(place.task, {})[action] = float(started)
            key = (place.name, action)
            runs[key], preempted[key] = _ends(tally, takers)
            if not takers:
                del preempted[key]
    return Measured(
        runs,
        _shares(often) if choice is None else choice,
        _waits(task, estimates, context),
        _switches(task, estimates, context),
        preempted,
    )


def _preempting(task: Task, place: str) -> set[str]:
    """Transitions by which a run in a place may end at a time of their own."""
    return {
        t.name
        for t in task.flat.transitions.values()
        if is_cause(t) and any(a.place == place and a.end is not None for a in t.inputs)
    }


def _ends(tally: Tally, takers: set[str]) -> tuple[dict[Status, Estimate], dict[str, Estimate]]:
    """Laws of a run's own ends by status, and of its preemptions by transition."""
    causes = {exit_: _cause(exit_, takers) for exit_ in tally.durations}
    extra = tally.waited.mean if tally.waited.n else 0.0
    laws = _exact(tally, causes) if None not in causes.values() else _incident(tally, causes)
    own = {
        Status(c): Estimate(
            law.share,
            max(law.mean + extra, SHORTEST),
            law.cv * law.mean / max(law.mean + extra, SHORTEST),
        )
        for c, law in laws.items()
        if not c.startswith("by:")
    }
    by = {
        c.removeprefix("by:"): Estimate(law.share, max(law.mean, SHORTEST), law.cv)
        for c, law in laws.items()
        if c.startswith("by:")
    }
    return _with_missing(own, by, tally, extra)


def _cause(exit_: str, takers: set[str]) -> str | None:
    """By what a run ended: a status, `by:` a transition; None: it was cut off, and would have ended
    otherwise."""
    status, _, transition = exit_.partition(":")
    if not transition:
        return None if status == CENSORED else status
    return f"by:{transition}" if transition in takers else None


@dataclass(frozen=True, slots=True)
class _Law:
    share: float
    mean: float
    cv: float


def _exact(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, _Law | Incidence]:
    """Nothing was cut off: relative frequencies and the moments as they were summed."""
    whole = sum(m.n for m in tally.durations.values())
    out: dict[str, Any] = {}
    for cause in sorted({c for c in causes.values() if c is not None}):
        parts = [tally.durations[e] for e, c in causes.items() if c == cause]
        moments = reduce(lambda a, b: a.merged(b), parts)
        out[cause] = _Law(moments.n / whole, moments.mean, moments.cv)
    return out


def _incident(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, _Law | Incidence]:
    """Some runs were cut off: Aalen-Johansen over the kept sample, at a constant rate beyond its
    longest run."""
    kept = tally.sample.kept
    times, ends = [k.seconds for k in kept], [causes.get(k.exit) for k in kept]
    left, longest = unended(times, ends)
    found = incidences(times, ends)
    if not 0.0 < left < 1.0 or longest <= 0.0:
        return dict(found)
    return {c: _with_tail(law, left, longest, longest / -log(left)) for c, law in found.items()}


def unended(times: Sequence[float], causes: Sequence[str | None]) -> tuple[float, float]:
    """Probability that a run has not ended by the longest time seen (Kaplan and Meier's estimate),
    and that time (s)."""
    left, going = 1.0, len(times)
    for _, cause in sorted(
        zip(times, causes, strict=True), key=lambda pair: (pair[0], pair[1] is None)
    ):
        left *= 1.0 if cause is None else 1.0 - 1.0 / going
        going -= 1
    return left, max(times, default=0.0)


def _with_tail(law: Incidence, left: float, longest: float, mean: float) -> _Law:
    """A law whose part `left` ends after `longest` s, by an exponential time of this mean (s)
    later."""
    first = (1 - left) * law.mean + left * (longest + mean)
    own = (law.cv**2 + 1) * law.mean**2
    second = (1 - left) * own + left * (longest**2 + 2 * longest * mean + 2 * mean**2)
    return _Law(law.share, first, sqrt(max(0.0, second - first**2)) / first)


def _with_missing(
    own: dict[Status, Estimate], by: dict[str, Estimate], tally: Tally, extra: float
) -> tuple[dict[Status, Estimate], dict[str, Estimate]]:
    """Runs that never began take the error branch, though they do not count in R."""
    available = tally.availability
    if available == 1.0:
        return own, by
    own = {s: Estimate(e.share * available, e.mean, e.cv) for s, e in own.items()}
    by = {t: Estimate(e.share * available, e.mean, e.cv) for t, e in by.items()}
    missing, known = 1.0 - available, own.get(Status.ERROR)
    at_once = max(extra, SHORTEST)
    if known is None:
        own[Status.ERROR] = Estimate(missing, at_once)
    else:
        share = known.share + missing
        mean = (known.share * known.mean + missing * at_once) / share
        own[Status.ERROR] = Estimate(share, mean, 1.0)
    return own, by


def _shares(often: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    return {
        task: {a: n / sum(runs.values()) for a, n in runs.items()} for task, runs in often.items()
    }


def _waits(task: Task, estimates: Estimates, context: str | None) -> dict[str, float]:
    """Mean wait (s) for each event of a transition that only waits: waited seconds over
    occurrences."""
    waited: dict[str, list[float]] = {}
    for key, flow in estimates.flows.items():
        if (
            key.task == task.name
            and context in (None, key.context)
            and flow.waits.n
            and key.transition in task.flat.transitions
        ):
            for event in task.flat.transitions[key.transition].events:
                total = waited.setdefault(event, [0.0, 0.0])
                total[0] += flow.waits.total
                total[1] += flow.waits.n
    return {event: max(seconds / n, SHORTEST) for event, (seconds, n) in waited.items()}


def _switches(task: Task, estimates: Estimates, context: str | None) -> dict[str, float]:
    """How often each transition with a condition fired: relative frequencies among those that
    compete."""
    fired: dict[str, float] = {}
    for key, flow in estimates.flows.items():
        transition = task.flat.transitions.get(key.transition)
        known = key.task == task.name and context in (None, key.context)
        if known and transition is not None and transition.when is not None:
            fired[key.transition] = fired.get(key.transition, 0.0) + flow.fired
    return fired


# --- out --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Part:
    """A primitive task, its alternatives mixed as they are chosen: R, mean C, J, and expected runs
    in one mission run."""

    primitive_task: str
    reliability: float
    cost: float
    j: float
    runs: float


@dataclass(frozen=True)
class Propagated:
    """R and C of the task. R_conj, R_goal and P_complete are three numbers, not one
    (docs/analysis.md)."""

    parts: Mapping[str, Part]
    forecast: Forecast
    cost: float
    """Expected cost of a mission run: it adds over runs, parallel branches included. Time is the
    forecast's, not this."""
    product: float
    """The conjunctive product over the primitive tasks that a mission run always has: equal to
    R_conj in a mere series."""

    @property
    def conjunctive(self) -> float:
        """R_conj: completed, and every run a SUCCESS."""
        return self.forecast.conjunctive_reliability

    @property
    def goal(self) -> float | None:
        """R_goal."""
        return self.forecast.goal_reliability

    @property
    def complete(self) -> float:
        """P_complete."""
        return self.forecast.completion_probability


def propagate(
    task: Task,
    estimates: Estimates,
    context: str | None = None,
    choice: Choice | None = None,
    *,
    measure: str | None = None,
    limits: SearchLimits | None = None,
) -> Propagated:
    """R, C and J of primitive tasks and of the whole task, from actions' estimates through the net.

    `measure` is the cost to add up (None: what each primitive task declares, so its unit may differ
    by part and the task's sum is only meaningful if it does not). Raises NoEstimate and ValueError
    as the stochastic view does.
    """
    measured = measured_from(task, estimates, context, choice)
    solved = forecast(stochastic_view(task, measured), limits=limits)
    visits = _visits(solved)
    parts: dict[str, Part] = {}
    for name, primitive in task.primitive_tasks.items():
        places = [p.name for p in task.flat.places.values() if p.task == name]
        runs = sum(n for (place, _), n in visits.items() if place in places)
        by_context = estimates.of(name, context)
        tallies = {a: reduce(merge, by_context[a].values(), Tally()) for a in by_context}
        part = _part(name, tallies, measured.choice.get(name, {}), measure or primitive.cost, runs)
        if part is not None:
            parts[name] = part
    whole = sum(p.runs * p.cost for p in parts.values() if p.runs > 0)
    product = prod(p.reliability for p in parts.values() if p.runs > 0)
    return Propagated(parts, solved, whole, product)


def _part(
    name: str, tallies: Mapping[str, Tally], shares: Mapping[str, float], measure: str, runs: float
) -> Part | None:
    """The alternatives of a primitive task mixed; None where none that is chosen was measured."""
    used = [a for a, share in shares.items() if share > 0 and a in tallies and tallies[a].runs]
    if not used:
        return None
    costs = {a: tally.cost(measure).mean for a, tally in tallies.items() if tally.cost(measure).n}
    costed = [a for a in used if a in costs]
    r = _mixed(shares, {a: tallies[a].availability * tallies[a].reliability for a in used})
    c = _mixed(shares, {a: costs[a] for a in costed}) if costed else nan
    return Part(name, r, c, objective(r, c, cost_weight(costs.values())), runs)


def _mixed(shares: Mapping[str, float], values: Mapping[str, float]) -> float:
    weight = sum(shares[a] for a in values)
    return sum(shares[a] * value for a, value in values.items()) / weight


def _visits(solved: Forecast) -> dict[tuple[str, str], float]:
    """Expected runs of each (place, action) in one mission run."""
    net = solved.chain.gspn.net
    count = sum_by(solved.chain.label, solved.flow, len(net.transitions))
    actions = {(p, a) for p, a, _ in solved.view.statuses.values()}
    actions |= {
        (place.name, a)
        for place in solved.view.task.places.values()
        if place.kind is Kind.ACTION
        for a in solved.view.task.primitive_task_of(place.name).alternatives
    }
    return {
        key: float(count[net.transition_index[f"{key[0]}.{key[1]}"]])
        for key in actions
        if f"{key[0]}.{key[1]}" in net.transition_index
    }
