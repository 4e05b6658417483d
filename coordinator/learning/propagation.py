"""From actions to primitive tasks to the task: put measured estimates into the stochastic view, and
read R, C and J of the task from its solution.

The net decides how numbers compose: branches, loops, races and recoveries are handled by the
stochastic view (docs/analysis.md). If the primitive tasks run in series, the results must equal the
conjunctive product R = R_1 R_2 ..., C = C_1 + C_2 + ..., which is computed as a cross-check.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache, reduce
from math import inf, isnan, log, nan, prod, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.net.graph import sum_by
from petrobot.coordinator.analysis.net.ordinary import contended
from petrobot.coordinator.analysis.time.measured import (
    LATE,
    SHORTEST,
    Ending,
    Measured,
    branching_places,
    is_cause,
)
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import Forecast, forecast
from petrobot.coordinator.learning.batch import Array
from petrobot.coordinator.learning.estimate import CENSORED, Tally
from petrobot.coordinator.learning.estimates_file import EstimatesError, EstimatesFile, FileContents
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Comparison, Question, compare, objective
from petrobot.coordinator.learning.statistics import added, joined, objective_interval
from petrobot.coordinator.task import Estimate, Executed, Kind, PrimitiveTask, Status, Task
from petrobot.services.comm.location_file import DRY_RUN, MOCK

# --- competing risks ---

# How runs end and when, although some were cut off: O. O. Aalen and S. Johansen, Scandinavian
# Journal of Statistics 5 (1978) 141-150.


class Incidence(Struct, frozen=True):
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
    whole = added(float(curve[-1]) for curve in curves.values())
    return {c: Incidence(moments, curve / whole) for c, curve in curves.items()}


ChoiceShares = Mapping[str, Mapping[str, float]]
Visits = Mapping[tuple[str, str], float]
"""Expected runs of each (place, action) in a mission run."""


# --- estimates into the stochastic view ---


def newest_measured(
    estimates: str, task: Task, devices: Mapping[str, str] | None, plant: str = ""
) -> tuple[Measured, str]:
    """Return what was measured of a task, and where this is from in words; nothing and an empty
    text if nothing was. `estimates` is a folder of estimates files, or one of them.

    Measurements of `plant` come first, then those of a real cell, a simulated one, and one that is
    not known; of the same, those of the newest file. Those with scripted actions or without drives
    count only for their own plant. Files that cannot be read are left out."""
    given = Path(estimates)
    found: list[tuple[tuple[bool, int, int], Path, FileContents]] = []
    for file in (given.glob("*.db") if given.is_dir() else [given]) if estimates else []:
        with suppress(EstimatesError, OSError):
            stamp = _stamp(file)
            for name in _contents(file, stamp, None).plants:
                kept = _contents(file, stamp, name)
                if name == plant or name.partition(" ")[0] not in (MOCK, DRY_RUN):
                    found.append(((name != plant, kept.rank(name)[0], -max(stamp)[0]), file, kept))
    for _, file, kept in sorted(found, key=lambda entry: entry[0]):
        measured = measured_from(task, kept.estimates, kinds=kept.kinds, devices=devices)
        if measured.runs:
            of = f"plant {kept.plant or 'unknown'}"
            of += f", nothing of {plant}" if plant and kept.plant != plant else ""
            return measured, f"numbers as measured in {file} ({of}), else as declared"
    return Measured(), ""


def _stamp(file: Path) -> tuple[tuple[int, int], ...]:
    """Return (time, size) of an estimates file and of its log, to which SQLite writes first. Raises
    OSError."""
    of = [file.stat()]
    with suppress(FileNotFoundError):
        of.append(Path(f"{file}-wal").stat())
    return tuple((s.st_mtime_ns, s.st_size) for s in of if s.st_size)


@lru_cache(maxsize=64)
def _contents(file: Path, stamp: object, plant: str | None) -> FileContents:
    """Read a file again only when its `stamp` has changed. Raises EstimatesError."""
    return EstimatesFile(file).read(plant)


def measured_from(
    task: Task,
    estimates: Estimates,
    context: str | None = None,
    choice: ChoiceShares | None = None,
    kinds: Mapping[tuple[str, str], Mapping[str, int]] | None = None,
    devices: Mapping[str, str] | None = None,
    apart: Mapping[str, Mapping[str, Tally]] | None = None,
) -> Measured:
    """Return the input of the stochastic view from estimates of one context (None: of all contexts
    together).

    `choice`: the selector's probabilities by primitive task; None: each alternative is chosen as
    often as it ran. `kinds`: in which kind of runs each (primitive task, action) was measured, for
    the sources. For a place whose runs can be preempted, the ends of its runs and the events or
    timers that preempt them are competing risks. A transition that preempts as soon as the marking
    allows it (another run ended) is not a risk; it only cuts the run off, as an abort does, and the
    net says when. `devices`: the device of each action that has one, if the view knows them; where
    runs may have to wait for one, their measured wait is left out, since the view has it itself.
    `apart`: by place, the tally of each action in this place alone, where that is known and others
    of its primitive task end their runs after another time.
    """
    held = contended(task, devices or {})
    runs: dict[tuple[str, str], dict[Status, Estimate]] = {}
    sources: dict[tuple[str, str], str] = {}
    preempted: dict[tuple[str, str], dict[str, Estimate]] = {}
    often: dict[str, dict[str, float]] = {}
    causes: dict[tuple[str, str], dict[Status, dict[Ending, float]]] = {}
    mixed = set[tuple[str, str]]()
    late: dict[tuple[str, str], Estimate] = {}
    for place in task.flat.places.values():
        if place.kind is not Kind.ACTION:
            continue
        takers, own = _preempting(task, place.name), (apart or {}).get(place.name, {})
        for action, by_context in _alternatives(task, place.task, estimates, context).items():
            tally = reduce(Tally.merged, by_context.values(), Tally())
            started = tally.runs + tally.censored + sum(tally.not_executed.values())
            tally = own.get(action, tally)
            key = (place.name, action)
            causes[key], pooled = _causes(tally)
            if pooled:
                mixed.add(key)
            if not tally.runs and not tally.censored:
                continue
            often.setdefault(place.task, {})[action] = float(started)
            waits_in_view = (devices or {}).get(action, "") in held
            extra = 0.0 if waits_in_view or not tally.waited.n else tally.waited.mean
            runs[key], preempted[key] = _ends(tally, takers, extra)
            errors = causes[key][Status.ERROR]
            if at_deadline := added(n for (cause, _), n in errors.items() if cause == LATE[0]):
                share = at_deadline / added(errors.values())
                late[key] = Estimate(share, task.longest_run(place.name) + extra, 0.0)
            sources[key] = _source(tally, (kinds or {}).get((place.task, action), {}))
            if action not in own and len(limits := limits_of(task, place.task)) > 1:
                ends = " and ".join(f"{s:g} s" for s in sorted(limits))
                sources[key] += f", together at places that end runs after {ends}"
            if not takers:
                del preempted[key]
    waits, waits_of = _waits(task, estimates, context)
    return Measured(
        runs,
        _shares(often) if choice is None else choice,
        waits,
        _switches(task, estimates, context),
        preempted,
        sources,
        causes,
        late=late,
        mixed=frozenset(mixed),
        waits_of=waits_of,
    )


def _alternatives(
    task: Task, primitive: str, estimates: Estimates, context: str | None
) -> dict[str, Mapping[str, Tally]]:
    """Return the tallies of the actions that a primitive task has now; the file may know others,
    which were removed or renamed."""
    now, known = task.primitive_tasks[primitive].alternatives, estimates.of(primitive, context)
    return {action: by_context for action, by_context in known.items() if action in now}


def limits_of(task: Task, primitive: str) -> set[float]:
    """Return after how long runs of a primitive task are ended (s), at its different places. Their
    runs are counted together, so each place gets the mixture."""
    return {task.longest_run(p.name) for p in task.flat.places.values() if p.task == primitive}


def _causes(tally: Tally) -> tuple[dict[Status, dict[Ending, float]], bool]:
    """Return how often runs ended by themselves by each cause, executed or not, by status; and
    whether several causes share a number of runs that are not known to have been executed."""
    causes: dict[Status, dict[Ending, float]] = {s: {} for s in Status}
    # Older files count how many are not known to have been executed over all causes: these are
    # shared among the other runs with ERROR.
    errors = sum(n for (e, _), n in tally.unknown_ends.items() if e.startswith(Status.ERROR))
    rest = tally.unknown - sum(tally.unknown_ends.values())
    shared = min(1.0, rest / max(1, tally.count(Status.ERROR) - errors))
    for (word, cause), n in tally.counts.items():
        status = Status(word)
        # A preempted run that counts has the cause `cancelled`, and did not end by itself.
        cut = sum(m.n for e, m in tally.durations.items() if e.startswith(f"{status}:"))
        own = max(0, n - cut) if cause == "cancelled" else n
        unsure = float(tally.unknown_ends.get((word, cause), 0))
        if status is Status.ERROR:
            unsure += (own - unsure) * shared
        causes[status][cause, str(Executed.YES)] = own - unsure
        causes[status][cause, str(Executed.UNKNOWN)] = unsure
    for cause, n in tally.not_executed.items():
        causes[Status.ERROR][cause, str(Executed.NO)] = float(n)
    return causes, 0.0 < shared < 1.0


def _source(tally: Tally, kinds: Mapping[str, int]) -> str:
    """Return how an action was measured, in words: number of runs, and in which kind of runs."""
    ended, cut = tally.runs, tally.censored
    text = f"measured in {ended} run{'s' * (ended != 1)}" + (f" and {cut} cut off" if cut else "")
    parts = [f"{n} in {kind}" for kind, n in sorted(kinds.items()) if n]
    return f"{text} ({', '.join(parts)})" if parts else text


def _preempting(task: Task, place: str) -> set[str]:
    """Return the transitions that can end a run in a place at a time of their own."""
    return {
        t.name
        for t in task.flat.transitions.values()
        if is_cause(task.flat, t) and any(a.place == place and a.end is not None for a in t.inputs)
    }


def _ends(
    tally: Tally, takers: set[str], extra: float
) -> tuple[dict[Status, Estimate], dict[str, Estimate]]:
    """Return the duration distributions of a run's own ends by status, and of its preemptions by
    transition. Its own ends come `extra` s later."""
    causes = {exit_: _cause(exit_, takers) for exit_ in tally.durations}
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


def _exact(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, Estimate | Incidence]:
    """Estimate from relative frequencies and exact moments: no run was cut off."""
    whole = sum(m.n for m in tally.durations.values())
    out: dict[str, Any] = {}
    for cause in sorted({c for c in causes.values() if c is not None}):
        parts = [tally.durations[e] for e, c in causes.items() if c == cause]
        moments = reduce(lambda a, b: a.merged(b), parts)
        out[cause] = Estimate(moments.n / whole, moments.mean, moments.cv)
    return out


def _incident(tally: Tally, causes: Mapping[str, str | None]) -> dict[str, Estimate | Incidence]:
    """Estimate by Aalen-Johansen over the sampled runs, with a constant rate beyond the longest
    one: some runs were cut off."""
    kept = tally.sample.kept
    times, ends = [k.seconds for k in kept], [causes.get(k.exit) for k in kept]
    left, longest = unended(times, ends)
    found = incidences(times, ends)
    # -log(left) / longest is the mean hazard up to the longest run; nothing is known of later
    # times, so it continues there.
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


def _with_tail(end: Incidence, left: float, longest: float, mean: float) -> Estimate:
    """Return a distribution of which the part `left` ends after `longest` s, by an exponential time
    of this mean (s) later."""
    first = (1 - left) * end.mean + left * (longest + mean)
    own = (end.cv**2 + 1) * end.mean**2
    second = (1 - left) * own + left * (longest**2 + 2 * longest * mean + 2 * mean**2)
    return Estimate(end.share, first, sqrt(max(0.0, second - first**2)) / first)


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


def _waits(
    task: Task, estimates: Estimates, context: str | None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the mean wait (s) for each event for which transitions wait, and of each transition
    that waits for one event: the time in which it could have served them, over its occurrences."""
    events, transitions = dict[str, list[float]](), dict[str, list[float]]()
    for key, flow in estimates.flows.items():
        if (
            key.task == task.name
            and context in (None, key.context)
            and flow.occurrences
            and key.transition in task.flat.transitions
        ):
            awaited = task.flat.transitions[key.transition].events
            totals = [events.setdefault(event, [0.0, 0.0]) for event in awaited]
            # of several events, the wait does not tell when each came
            if len(awaited) == 1:
                totals.append(transitions.setdefault(key.transition, [0.0, 0.0]))
            for total in totals:
                total[0] += flow.exposure
                total[1] += flow.occurrences
    by_event, of_one = (
        {name: max(seconds / n, SHORTEST) for name, (seconds, n) in waited.items()}
        for waited in (events, transitions)
    )
    return by_event, of_one


def _switches(task: Task, estimates: Estimates, context: str | None) -> dict[str, float]:
    """Return how often each transition with a condition fired, and each that competes with one:
    relative frequencies."""
    flat = task.flat
    judged = {
        place
        for t in flat.transitions.values()
        if t.when is not None
        for place in branching_places(flat, t)
    }
    fired: dict[str, float] = {}
    for key, flow in estimates.flows.items():
        transition = flat.transitions.get(key.transition)
        known = key.task == task.name and context in (None, key.context)
        if known and transition is not None and judged & branching_places(flat, transition):
            fired[key.transition] = fired.get(key.transition, 0.0) + flow.fired
    return fired


# --- figures of the task out of it ---


class Uncertain(Struct, frozen=True):
    """A number and its confidence interval; all nan if it is unknown."""

    value: float
    lower: float
    upper: float

    @classmethod
    def combined(cls, value: float, parts: Iterable[tuple[float, float]]) -> Uncertain:
        """Return a number whose independent parts move it down and up by so much at most.

        The distances add up as squares, each side by itself, so that intervals which are wider on
        one side (shares near 0 or 1) stay so.
        """
        moves = list(parts)
        below, above = (sqrt(added(move[side] ** 2 for move in moves)) for side in (0, 1))
        return cls(value, value - below, value + above)

    def within(self, low: float, high: float) -> Uncertain:
        """Return the same with bounds inside a range."""
        return Uncertain(self.value, max(self.lower, low), min(self.upper, high))


UNKNOWN = Uncertain(nan, nan, nan)


class PrimitiveFigures(Struct, frozen=True):
    """Figures of a primitive task, with its alternatives mixed as they are chosen: A R, mean C, J,
    and the expected number of runs in one mission run.

    R and C of each alternative are those of `objective.compare`: over several scenarios, R in the
    hardest one and C in the hardest admitted one.
    """

    primitive_task: str
    measure: str
    reliability: Uncertain
    cost: Uncertain
    j: float
    j_bounds: tuple[float, float]
    runs: float
    largest_cost: float
    """C of the alternative that costs most; nan if none is known."""


class Propagated(Struct, frozen=True):
    """R, C and J of the task. R_conj, R_goal and P_complete are three different numbers
    (docs/analysis.md); J takes R_conj, as the paper's definition is conjunctive."""

    parts: Mapping[str, PrimitiveFigures]
    forecast: Forecast
    """In the scenario that is hardest for the task."""
    scenario: str | None
    """That scenario; None if the runs of all scenarios were taken together, because no two
    scenarios have runs of all primitive tasks."""
    reliability: Uncertain
    """R_conj: the task completed and every run was a SUCCESS."""
    cost: Uncertain
    """Expected cost of a mission run: the sum over its runs, including those of parallel branches.
    The expected time is in `forecast`. Unknown if the measures of the parts differ."""
    rho: float
    """Weight of the cost in J: the given one, else 1 / C with the alternatives that cost most."""
    j: Uncertain
    product: float
    """Product of R over the primitive tasks that every mission run contains; equal to R_conj if the
    they run in series."""
    uncosted: tuple[str, ...] = ()
    """Actions of unknown cost: without it C is unknown if they run, else its interval lacks it."""

    @property
    def conjunctive(self) -> float:
        """R_conj."""
        return self.reliability.value

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
    *,
    questions: Mapping[str, Question] | None = None,
    rho: float | None = None,
) -> Propagated:
    """Compute R, C and J of the primitive tasks and of the whole task from estimates of actions,
    through the net.

    `questions`: by what the actions of each primitive task are judged; by default the cost that it
    declares. `rho`: weight of the task's cost. Without a context, the task is judged as an action
    is: in the scenario in which its R is lowest. Raises NoEstimate and ValueError as the stochastic
    view does.
    """
    asked = {name: Question(p.cost) for name, p in task.primitive_tasks.items()}
    asked |= questions or {}
    for name, primitive in task.primitive_tasks.items():
        if asked[name].measure == primitive.cost:  # declared costs are in the unit of this measure
            asked[name] = replace(asked[name], declared=tuple(primitive.costs.items()))
    scenarios = [context] if context is not None else _scenarios(task, estimates)
    where: Sequence[str | None] = scenarios or [None]
    solved = [(_solve(task, measured_from(task, estimates, w)), w) for w in where]
    hardest = min(solved, key=lambda one: (one[0].solved.conjunctive_reliability, one[1] or ""))
    # The lowest of m: intervals at 1 - (1 - level) / m pay for the choice (Bonferroni).
    return _figures(task, estimates, *hardest, asked, context, rho, len(where))


def _scenarios(task: Task, estimates: Estimates) -> list[str]:
    """Return the contexts in which every measured primitive task has runs; none if it is one."""
    runs = [
        {
            where
            for by_context in _alternatives(task, name, estimates, None).values()
            for where, tally in by_context.items()
            if tally.judged
        }
        for name in task.primitive_tasks
    ]
    known = [contexts for contexts in runs if contexts]
    shared = sorted(set.intersection(*known)) if known else []
    return shared if len(shared) > 1 else []


class _Solved(Struct, frozen=True, dict=True):
    """A stochastic view and its solution."""

    measured: Measured
    solved: Forecast

    @cached_property
    def visits(self) -> dict[tuple[str, str], float]:
        return _visits(self.solved)


def _solve(task: Task, measured: Measured) -> _Solved:
    return _Solved(measured, forecast(stochastic_view(task, measured)))


def _figures(
    task: Task,
    estimates: Estimates,
    found: _Solved,
    scenario: str | None,
    asked: Mapping[str, Question],
    context: str | None,
    rho: float | None,
    scenarios: int,
) -> Propagated:
    parts: dict[str, PrimitiveFigures] = {}
    costs: dict[tuple[str, str], Uncertain] = {}
    for name in task.primitive_tasks:
        places = [p.name for p in task.flat.places.values() if p.task == name]
        runs = sum(n for (place, _), n in found.visits.items() if place in places)
        judged = compare(_alternatives(task, name, estimates, context), asked[name])
        shares = found.measured.choice.get(name, {})
        part = _part(name, judged, shares, asked[name], runs)
        if part is not None:
            parts[name] = part[0]
            costs |= {(place, a): c for place in places for a, c in part[1].items()}
    needed = [p for p in parts.values() if p.runs > 0]
    run = {task.primitive_task_of(place).name for (place, _), n in found.visits.items() if n > 0}
    alike = len({asked[name].measure for name in run}) == 1
    largest = added(p.runs * p.largest_cost for p in needed) if alike else nan
    for (place, action), n in found.visits.items():
        primitive = task.primitive_task_of(place)
        given = _declared_cost(primitive, action, asked[primitive.name])
        if (place, action) not in costs and not isnan(given):
            costs[place, action] = Uncertain(given, given, given)
            largest += n * given
    weight = rho if rho is not None else 1.0 / largest if largest > 0 else 0.0
    moves, ran = _moves(task, estimates, found, scenario, costs, asked, scenarios)
    r = found.solved.conjunctive_reliability
    c = _total(found.visits, costs) if alike else nan
    of_r = [(-min(m.low_r, m.high_r), max(m.low_r, m.high_r)) for m in moves.values()]
    of_c = [(-min(m.low_c, m.high_c), max(m.low_c, m.high_c)) for m in moves.values()]
    known = {
        key: (n * (cost.value - cost.lower), n * (cost.upper - cost.value))
        for key, n in found.visits.items()
        if n > 0 and (cost := costs.get(key)) is not None
    }
    least = 0.0 if all(cost.lower >= 0 for cost in costs.values()) else -inf
    return Propagated(
        parts,
        found.solved,
        scenario,
        Uncertain.combined(r, of_r).within(0.0, 1.0),
        Uncertain.combined(c, [*of_c, *known.values()]).within(least, inf) if c == c else UNKNOWN,
        weight,
        Uncertain.combined(objective(r, c, weight), _of_j(moves, known, weight))
        if c == c
        else UNKNOWN,
        prod(p.reliability.value for p in needed),
        tuple(sorted({action for _, action in ran - {*costs}})) if alike else (),
    )


def _declared_cost(primitive: PrimitiveTask, action: str, asked: Question) -> float:
    """Return what a run costs by the task file, where none was measured: its declared cost, or if
    the cost is its time, its declared duration; nan if neither is known."""
    cost = asked.declared_cost(action)
    if isnan(cost) and asked.measure == "wall" and primitive.estimates:
        return added(e.share * e.mean for e in primitive.estimates.values())
    return cost


def _of_j(
    moves: Mapping[tuple[str, str], _Move],
    costs: Mapping[tuple[str, str], tuple[float, float]],
    weight: float,
) -> list[tuple[float, float]]:
    """Return how far each action moves J of the task down and up: its R and its C together, with
    their correlation, because both come from the same runs."""
    out = []
    for key in sorted({*moves, *costs}):
        move = moves.get(key, STILL)
        low, high = costs.get(key, (0.0, 0.0))
        by_r = [weight * move.low_c - move.low_r, weight * move.high_c - move.high_r]
        below, above = _span(*by_r)
        # by_r falls as R grows, as a rule: then R and C that are high together cancel out in J
        k = move.correlation if by_r[1] > by_r[0] else -move.correlation
        spent = (weight * low, weight * high) if weight > 0 else (0.0, 0.0)
        out.append((joined(below, spent[0], k), joined(above, spent[1], k)))
    return out


def _span(one: float, other: float) -> tuple[float, float]:
    """Return how far two changes reach below and above zero."""
    return max(0.0, -one, -other), max(0.0, one, other)


def _total(visits: Visits, costs: Mapping[tuple[str, str], Uncertain]) -> float:
    """Return the expected cost of a mission run; nan if an action that it runs has none."""
    return added(n * costs.get(key, UNKNOWN).value for key, n in visits.items() if n > 0)


class _Move(Struct, frozen=True):
    """By how much R_conj and C of the task change when R of an action is at the lower and at the
    upper end of its interval, and the correlation of success and cost over the action's runs."""

    low_r: float = 0.0
    low_c: float = 0.0
    high_r: float = 0.0
    high_c: float = 0.0
    correlation: float = 0.0


STILL = _Move()
STEP = 0.01
"""Change of a share of SUCCESS by which the derivatives of the task's figures are measured."""


def _moves(
    task: Task,
    estimates: Estimates,
    found: _Solved,
    scenario: str | None,
    costs: Mapping[tuple[str, str], Uncertain],
    asked: Mapping[str, Question],
    scenarios: int,
) -> tuple[dict[tuple[str, str], _Move], set[tuple[str, str]]]:
    """Return the move of each (place, action), for the hardest of so many scenarios, and which of
    them run in any of the solutions.

    To first order: one more solution for each action, with its share of SUCCESS changed by STEP.
    What has no cost is left out.
    """
    out, run = {}, {key for key, n in found.visits.items() if n > 0}
    r, c = found.solved.conjunctive_reliability, _known_total(found.visits, costs)
    for (place, action), known in found.measured.runs.items():
        primitive = task.primitive_task_of(place).name
        tally = reduce(
            Tally.merged, estimates.of(primitive, scenario).get(action, {}).values(), Tally()
        )
        if not tally.judged or not known or found.visits.get((place, action), 0.0) <= 0:
            continue
        own = known[Status.SUCCESS].share if Status.SUCCESS in known else 0.0
        step = -STEP if own > 0.5 else STEP
        runs = {**found.measured.runs, (place, action): _shifted(known, step)}
        other = _solve(task, replace(found.measured, runs=runs))
        slope_r = (other.solved.conjunctive_reliability - r) / step
        slope_c = (_known_total(other.visits, costs) - c) / step
        run |= {key for key, n in other.visits.items() if n > 0}
        level = 1.0 - (1.0 - asked[primitive].level) / scenarios
        low, high = (bound - tally.reliability for bound in tally.interval(level))
        joint = tally.cost_correlation(asked[primitive].measure)
        out[place, action] = _Move(
            low * slope_r, low * slope_c, high * slope_r, high * slope_c, joint
        )
    return out, run


def _known_total(visits: Visits, costs: Mapping[tuple[str, str], Uncertain]) -> float:
    return _total({key: n for key, n in visits.items() if key in costs}, costs)


def _shifted(known: Mapping[Status, Estimate], step: float) -> dict[Status, Estimate]:
    """Return the estimates with another share of SUCCESS; the other statuses share the rest as
    before. A status that was never seen takes as long as the others."""
    example = next(iter(known.values()))
    success = known.get(Status.SUCCESS, replace(example, share=0.0))
    others = {s: e for s, e in known.items() if s is not Status.SUCCESS}
    rest = added(e.share for e in others.values())
    left: dict[Status, Estimate] = {
        s: replace(e, share=e.share * (rest - step) / rest) for s, e in others.items() if rest
    }
    if not rest:
        left = {Status.ERROR: replace(example, share=-step)}
    return {Status.SUCCESS: replace(success, share=success.share + step), **left}


def _part(
    name: str, judged: Comparison, shares: Mapping[str, float], question: Question, runs: float
) -> tuple[PrimitiveFigures, dict[str, Uncertain]] | None:
    """Return the figures of a primitive task and the cost of each alternative; None if no
    alternative that is chosen was measured."""
    figures = {f.action: f for f in judged.figures if f.runs}
    used = [a for a, share in shares.items() if share > 0 and a in figures]
    if not used:
        return None
    weight = {a: shares[a] / added(shares[b] for b in used) for a in used}
    costs = {
        a: Uncertain(f.cost, f.cost_lower, f.cost_upper)
        for a in used
        if not isnan((f := figures[a]).cost) and f.cost < inf
    }
    r = Uncertain.combined(
        added(w * figures[a].effective for a, w in weight.items()),
        [
            (w * f.availability * (f.reliability - f.lower),
             w * f.availability * (f.upper - f.reliability))
            for a, w in weight.items() if (f := figures[a])
        ],
    )  # fmt: skip
    costed = added(weight[a] for a in costs)
    c = (
        Uncertain.combined(
            added(weight[a] * cost.value for a, cost in costs.items()) / costed,
            [
                (weight[a] / costed * (cost.value - cost.lower),
                 weight[a] / costed * (cost.upper - cost.value))
                for a, cost in costs.items()
            ],
        )
        if costs
        else UNKNOWN
    )  # fmt: skip
    largest = max(
        (f.cost for f in judged.figures if not isnan(f.cost) and f.cost < inf), default=nan
    )
    j = objective(r.value, c.value, judged.rho)
    if all(f.j_lower <= f.j <= f.j_upper < inf for f in map(figures.__getitem__, used)):
        mixed = Uncertain.combined(
            j,
            [(w * (f.j - f.j_lower), w * (f.j_upper - f.j))
             for a, w in weight.items() if (f := figures[a])],
        )  # fmt: skip
        bounds = mixed.lower, mixed.upper
    else:  # an action without a J of its own: the widest interval
        bounds = objective_interval(
            (r.value, r.lower, r.upper), (c.value, c.lower, c.upper), judged.rho, -1.0
        )
    return PrimitiveFigures(name, question.measure, r, c, j, bounds, runs, largest), costs


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
