"""From actions to primitive tasks to the task: put measured estimates into the stochastic view, and
read R, C and J of the task from its solution.

The net decides how numbers compose: branches, loops, races and recoveries are handled by the
stochastic view (docs/analysis.md). If the net is a mere series, the results must equal the
conjunctive product R = R_1 R_2 ..., C = C_1 + C_2 + ..., which is computed as a cross-check.
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
from petrobot.coordinator.learning.estimate import CENSORED, Tally, merge_tallies
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import cost_weight, objective
from petrobot.coordinator.task import Estimate, Kind, Status, Task

# --- competing risks ---

# How runs end and when, although some were cut off: O. O. Aalen and S. Johansen, Scandinavian
# Journal of Statistics 5 (1978) 141-150.


@dataclass(frozen=True)
class Incidence:
    """Cumulative incidence of one cause: by time `times[i]` (s, increasing) the probability of
    having ended by this cause has reached `reached[i]`."""

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
        """Standard deviation over mean of that time."""
        mean = self.mean
        return sqrt(max(0.0, float(self.times**2 @ self._mass()) - mean**2)) / mean if mean else 0.0

    def _mass(self) -> Array:
        return np.diff(self.reached, prepend=0.0) / self.share


def incidences(times: Sequence[float], causes: Sequence[str | None]) -> dict[str, Incidence]:
    """Estimate the cumulative incidence of each cause by the method of Aalen and Johansen. `times`
    in s; cause None: the run was cut off (censored).

    If the longest runs were cut off, some probability is left after the last end. It is given to
    the causes in proportion to what they have: nothing more is known about it.
    """
    at = np.sort(np.asarray(times, dtype=float))
    of = [cause for _, cause in sorted(zip(times, causes, strict=True), key=lambda pair: pair[0])]
    moments, first = np.unique(at, return_index=True)
    active = len(at) - first
    known = sorted({c for c in of if c is not None})
    ended = {c: np.zeros(len(moments)) for c in known}
    for i, cause in zip(np.searchsorted(moments, at).tolist(), of, strict=True):
        if cause is not None:
            ended[cause][i] += 1
    # Hazard of ending at each time by any cause, and the probability of still running before it
    # (Kaplan-Meier); a cause gains that probability times its own hazard.
    hazard: Array = np.add.reduce([np.zeros(len(moments)), *ended.values()]) / active
    before = np.concatenate([[1.0], np.cumprod(1.0 - hazard)[:-1]]) if len(moments) else np.zeros(0)
    curves = {c: np.cumsum(before * d / active) for c, d in ended.items()}
    whole = sum(float(curve[-1]) for curve in curves.values())
    return {c: Incidence(moments, curve / whole) for c, curve in curves.items()}


ChoiceShares = Mapping[str, Mapping[str, float]]
SHORTEST = 1e-3
"""Shortest duration (s) in the stochastic view, which does not allow a duration of 0."""


# --- estimates into the stochastic view ---


def measured_from(
    task: Task, estimates: Estimates, context: str | None = None, choice: ChoiceShares | None = None
) -> Measured:
    """Return the input of the stochastic view from estimates of one context (None: of all contexts
    together).

    `choice`: the selector's probabilities by primitive task; None: each alternative is chosen as
    often as it ran. For a place whose runs can be preempted, the ends of its runs and the events or
    timers that preempt them are competing risks. A transition that preempts as soon as the marking
    allows it (another run ended) is not a risk; it only cuts the run off, as an abort does, and the
    net says when.
    """
    runs: dict[tuple[str, str], dict[Status, Estimate]] = {}
    preempted: dict[tuple[str, str], dict[str, Estimate]] = {}
    often: dict[str, dict[str, float]] = {}
    for place in task.flat.places.values():
        if place.kind is not Kind.ACTION:
            continue
        takers = _preempting(task, place.name)
        for action, by_context in estimates.of(place.task, context).items():
            tally = reduce(merge_tallies, by_context.values(), Tally())
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
    """Return the transitions that can end a run in a place at a time of their own."""
    return {
        t.name
        for t in task.flat.transitions.values()
        if is_cause(t) and any(a.place == place and a.end is not None for a in t.inputs)
    }


def _ends(tally: Tally, takers: set[str]) -> tuple[dict[Status, Estimate], dict[str, Estimate]]:
    """Return the duration distributions of a run's own ends by status, and of its preemptions by
    transition."""
    causes = {exit_: _cause(exit_, takers) for exit_ in tally.durations}
    extra = tally.waited.mean if tally.waited.n else 0.0
    ends = _exact(tally, causes) if None not in causes.values() else _incident(tally, causes)
    own = {
        Status(c): Estimate(
            end.share,
            max(end.mean + extra, SHORTEST),
            end.cv * end.mean / max(end.mean + extra, SHORTEST),
        )
        for c, end in ends.items()
        if not c.startswith("by:")
    }
    by = {
        c.removeprefix("by:"): Estimate(end.share, max(end.mean, SHORTEST), end.cv)
        for c, end in ends.items()
        if c.startswith("by:")
    }
    return _with_missing(own, by, tally, extra)


def _cause(exit_: str, takers: set[str]) -> str | None:
    """Return what ended a run: a status, or `by:` and a transition; None if it was cut off and
    would have ended otherwise."""
    status, _, transition = exit_.partition(":")
    if not transition:
        return None if status == CENSORED else status
    return f"by:{transition}" if transition in takers else None


@dataclass(frozen=True, slots=True)
class _EndShare:
    share: float
    mean: float
    cv: float


def _exact(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, _EndShare | Incidence]:
    """Estimate from relative frequencies and exact moments: no run was cut off."""
    whole = sum(m.n for m in tally.durations.values())
    out: dict[str, Any] = {}
    for cause in sorted({c for c in causes.values() if c is not None}):
        parts = [tally.durations[e] for e, c in causes.items() if c == cause]
        moments = reduce(lambda a, b: a.merged(b), parts)
        out[cause] = _EndShare(moments.n / whole, moments.mean, moments.cv)
    return out


def _incident(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, _EndShare | Incidence]:
    """Estimate by Aalen-Johansen over the sampled runs, with a constant rate beyond the longest
    one: some runs were cut off."""
    kept = tally.sample.kept
    times, ends = [k.seconds for k in kept], [causes.get(k.exit) for k in kept]
    left, longest = unended(times, ends)
    found = incidences(times, ends)
    # -log(left) / longest is the mean hazard up to the longest run; it continues beyond it
    # (B. W. Brown, M. Hollander and R. M. Korwar, in Reliability and Biometry, SIAM 1974).
    if not 0.0 < left < 1.0 or longest <= 0.0:
        return dict(found)
    return {c: _with_tail(end, left, longest, longest / -log(left)) for c, end in found.items()}


def unended(times: Sequence[float], causes: Sequence[str | None]) -> tuple[float, float]:
    """Return the probability that a run has not ended by the longest observed time (Kaplan-Meier
    estimate), and that time (s)."""
    left, active = 1.0, len(times)
    for _, cause in sorted(
        zip(times, causes, strict=True), key=lambda pair: (pair[0], pair[1] is None)
    ):
        left *= 1.0 if cause is None else 1.0 - 1.0 / active
        active -= 1
    return left, max(times, default=0.0)


def _with_tail(end: Incidence, left: float, longest: float, mean: float) -> _EndShare:
    """Return a distribution of which the part `left` ends after `longest` s, by an exponential time
    of this mean (s) later."""
    first = (1 - left) * end.mean + left * (longest + mean)
    own = (end.cv**2 + 1) * end.mean**2
    second = (1 - left) * own + left * (longest**2 + 2 * longest * mean + 2 * mean**2)
    return _EndShare(end.share, first, sqrt(max(0.0, second - first**2)) / first)


def _with_missing(
    own: dict[Status, Estimate], by: dict[str, Estimate], tally: Tally, extra: float
) -> tuple[dict[Status, Estimate], dict[str, Estimate]]:
    """Send runs that never began to the error branch, although they do not count in R."""
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
    """Return the mean wait (s) for each event of a transition that only waits: waited seconds over
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
    """Return how often each transition with a condition fired: relative frequencies among those
    that compete."""
    fired: dict[str, float] = {}
    for key, flow in estimates.flows.items():
        transition = task.flat.transitions.get(key.transition)
        known = key.task == task.name and context in (None, key.context)
        if known and transition is not None and transition.when is not None:
            fired[key.transition] = fired.get(key.transition, 0.0) + flow.fired
    return fired


# --- figures of the task out of it ---


@dataclass(frozen=True, slots=True)
class PrimitiveFigures:
    """Figures of a primitive task, with its alternatives mixed as they are chosen: R, mean C, J,
    and the expected number of runs in one mission run."""

    primitive_task: str
    reliability: float
    cost: float
    j: float
    runs: float


@dataclass(frozen=True)
class Propagated:
    """R and C of the task. R_conj, R_goal and P_complete are three different numbers
    (docs/analysis.md)."""

    parts: Mapping[str, PrimitiveFigures]
    forecast: Forecast
    cost: float
    """Expected cost of a mission run: the sum over its runs, including those of parallel branches.
    The expected time is in `forecast`."""
    product: float
    """Product of R over the primitive tasks that every mission run contains; equal to R_conj if the
    net is a mere series."""

    @property
    def conjunctive(self) -> float:
        """R_conj: the task completed and every run was a SUCCESS."""
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
    choice: ChoiceShares | None = None,
    *,
    measure: str | None = None,
    limits: SearchLimits | None = None,
) -> Propagated:
    """Compute R, C and J of the primitive tasks and of the whole task from estimates of actions,
    through the net.

    `measure`: the cost to add up; None: what each primitive task declares, so units may differ
    between primitive tasks, and the sum over the task means something only if they do not. Raises
    NoEstimate and ValueError as the stochastic view does.
    """
    measured = measured_from(task, estimates, context, choice)
    solved = forecast(stochastic_view(task, measured), limits=limits)
    visits = _visits(solved)
    parts: dict[str, PrimitiveFigures] = {}
    for name, primitive in task.primitive_tasks.items():
        places = [p.name for p in task.flat.places.values() if p.task == name]
        runs = sum(n for (place, _), n in visits.items() if place in places)
        by_context = estimates.of(name, context)
        tallies = {a: reduce(merge_tallies, by_context[a].values(), Tally()) for a in by_context}
        part = _part(name, tallies, measured.choice.get(name, {}), measure or primitive.cost, runs)
        if part is not None:
            parts[name] = part
    whole = sum(p.runs * p.cost for p in parts.values() if p.runs > 0)
    product = prod(p.reliability for p in parts.values() if p.runs > 0)
    return Propagated(parts, solved, whole, product)


def _part(
    name: str, tallies: Mapping[str, Tally], shares: Mapping[str, float], measure: str, runs: float
) -> PrimitiveFigures | None:
    """Return the figures of a primitive task; None if no alternative that is chosen was
    measured."""
    used = [a for a, share in shares.items() if share > 0 and a in tallies and tallies[a].runs]
    if not used:
        return None
    costs = {a: tally.cost(measure).mean for a, tally in tallies.items() if tally.cost(measure).n}
    costed = [a for a in used if a in costs]
    r = _mixed(shares, {a: tallies[a].availability * tallies[a].reliability for a in used})
    c = _mixed(shares, {a: costs[a] for a in costed}) if costed else nan
    return PrimitiveFigures(name, r, c, objective(r, c, cost_weight(costs.values())), runs)


def _mixed(shares: Mapping[str, float], values: Mapping[str, float]) -> float:
    weight = sum(shares[a] for a in values)
    return sum(shares[a] * value for a, value in values.items()) / weight


def _visits(solved: Forecast) -> dict[tuple[str, str], float]:
    """Return the expected number of runs of each (place, action) in one mission run."""
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
