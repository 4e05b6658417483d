"""What is known of a task's actions and events in numbers: measured in runs, or declared in the
task file.

The stochastic view and the chain of the execution graph take all their numbers from here, so they
assume the same, and say it in the same words.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import lru_cache
from math import sqrt
from typing import NamedTuple, TypeVar

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.analysis.net.structure import exclusive_places, place_semiflows
from petrobot.coordinator.task import (
    End,
    Estimate,
    Executed,
    Kind,
    Place,
    Scope,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.net import Net

K = TypeVar("K", bound=Hashable)
Ending = tuple[str, str]
"""Why a run ended: its cause, and whether it was executed (`yes`, `no`, `unknown`)."""
FIELDS = ("reason", "executed")
"""What conditions call the two: `PLACE.reason`, `PLACE.executed`."""
EMERGENCY = "emergency_stop"
"""Cause of a run that an emergency stop ended."""
DECLARED, MEASURED = "declared in the task file", "measured"
"""Where the numbers of an action come from."""


class Measured(Struct, frozen=True):
    """Numbers measured in runs. Missing ones are replaced by the estimates in the task file.

    - `runs[(place or primitive task, action)]`: share, mean (s) and cv by status.
    - `choice[primitive task][action]`: current probability of each alternative.
    - `waits[event]`: mean time (s) that a transition waits for the event: for an internal one, once
      it has everything else.
    - `switches[transition]`: how often its condition is true, relative to the transitions that
      compete with it.
    - `causes[(place or primitive task, action)]`: by status, how often its own ends with that
      status came by each cause, executed or not.
    - `preempted[(place, action)]`: share, mean (s) and cv of the runs that each transition
      preempted. If all actions of a place have it, the preempting event is one of the causes by
      which a run ends (the shares here and in `runs` sum to 1), not an independent race.
    """

    runs: Mapping[tuple[str, str], Mapping[Status, Estimate]] = field(default_factory=dict)
    choice: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    waits: Mapping[str, float] = field(default_factory=dict)
    switches: Mapping[str, float] = field(default_factory=dict)
    preempted: Mapping[tuple[str, str], Mapping[str, Estimate]] = field(default_factory=dict)
    sources: Mapping[tuple[str, str], str] = field(default_factory=dict)
    """Where the numbers in `runs` and `preempted` come from, in words, by the same keys."""
    causes: Mapping[tuple[str, str], Mapping[Status, Mapping[Ending, float]]] = field(
        default_factory=dict
    )
    expected: frozenset[tuple[str, str]] = frozenset()
    """Keys of `runs` with a declared estimate that was changed, which no run was measured for."""
    late: Mapping[tuple[str, str], Estimate] = field(default_factory=dict)
    """By keys of `runs`: the share of the ends with ERROR that came at the deadline, and when (s).
    """
    mixed: frozenset[tuple[str, str]] = frozenset()
    """Keys of `causes` where each cause was given the same share of runs that are not known to have
    been executed, because only their number over all causes was measured."""
    waits_of: Mapping[str, float] = field(default_factory=dict)
    """By transition: the mean wait (s) for its event in this place alone."""


class OwnEnd(NamedTuple):
    """How a run ends by itself: its status, and whether its deadline ends it."""

    status: Status
    late: bool = False

    def __str__(self) -> str:
        return f"{self.status}{' late' if self.late else ''}"


SHORTEST = 1e-3
"""Shortest duration (s) in the stochastic view, which does not allow a duration of 0."""
NEVER = 1e-6
"""Share of runs below which none is taken to reach its deadline: two moments say nothing about the
tail of a distribution so far out."""
LATE: Ending = ("deadline", str(Executed.YES))
"""Why a run ends that takes longer than its deadline."""
AT_DEADLINE = OwnEnd(Status.ERROR, True)


def cut(
    estimates: Mapping[Status, Estimate], deadline: float
) -> tuple[Mapping[Status, Estimate], float]:
    """Return the estimates of runs that end in ERROR at a deadline (s), and the share of the runs
    that do.

    `estimates` are those without a deadline; their durations have gamma distributions of the given
    means and cv (fixed with cv = 0). What is left of each is the part up to the deadline; the rest
    of the probability goes to ERROR. Mean and variance are exact.
    """
    moments = {s: _up_to(e, deadline) for s, e in estimates.items() if e.share > 0}
    late = sum(estimates[s].share * outside for s, (_, outside, *_) in moments.items())
    if late < NEVER:
        return estimates, 0.0
    found = dict[Status, Estimate]()
    for status in Status:
        # probability, mean and second moment, each times the share
        parts = [(late, late * deadline, late * deadline**2)] * (status is Status.ERROR)
        if status in moments:
            (p, _, *more), share = moments[status], estimates[status].share
            parts.append((share * p, share * more[0], share * more[1]))
        whole, first, second = (
            (sum(column) for column in zip(*parts, strict=True)) if parts else (0.0,) * 3
        )
        if whole > 0:
            mean = first / whole
            found[status] = Estimate(whole, mean, sqrt(max(second / whole - mean**2, 0.0)) / mean)
    return found, late


def _apart(pooled: Estimate, late: Estimate) -> Estimate | None:
    """Return what is left of ends with ERROR without those at the deadline, so that both together
    keep mean and variance; None if that is impossible, as measured times hardly ever are."""
    share = pooled.share - late.share
    second = pooled.share * pooled.mean**2 * (1 + pooled.cv**2) - late.share * late.mean**2
    mean = (pooled.share * pooled.mean - late.share * late.mean) / share
    if not 0 < mean < late.mean:
        return None
    return Estimate(share, mean, sqrt(max(second / share - mean**2, 0.0)) / mean)


def _up_to(estimate: Estimate, deadline: float) -> tuple[float, float, float, float]:
    """Return P(T <= deadline), P(T > deadline), E[T; T <= deadline] and E[T^2; T <= deadline]."""
    mean, square = estimate.mean, estimate.cv**2
    if not square:
        inside = float(mean <= deadline)
        return inside, 1 - inside, inside * mean, inside * mean**2
    from scipy.special import gammainc, gammaincc

    shape, at = 1 / square, deadline / (mean * square)
    return (
        float(gammainc(shape, at)),
        float(gammaincc(shape, at)),
        float(mean * gammainc(shape + 1, at)),
        float(mean**2 * (1 + square) * gammainc(shape + 2, at)),
    )


def is_cause(task: Task, transition: Transition) -> bool:
    """Return whether a preemption by this transition of a flat task is a cause of its own by which
    a run ends.

    It is one if an event or a timer takes exactly one run, and whatever else it takes is there as
    long as the run: then it has its own distribution of the time since the run began. A transition
    that fires as soon as its arcs allow it (another run has finished, a token has arrived) only
    cuts the run short: the net determines when. So it does where the event waits for a token, and
    where one external event may end runs of several places: their ends then depend on each other.
    """
    runs = [a for a in transition.inputs if a.end is not None]
    waits = bool(transition.events) or transition.after is not None
    if not waits or len(runs) != 1 or runs[0].end is not End.PREEMPT:
        return False
    net, run = task.net, task.net.place_index[runs[0].place]
    if any(
        tuple(sorted((run, net.place_index[a.place]))) not in _never_together(net)
        for u in task.transitions.values()
        for a in u.inputs
        if a.end is End.PREEMPT and a.place != runs[0].place
        if any(task.events[e].scope is Scope.EXTERNAL for e in {*u.events} & {*transition.events})
    ):
        return False
    changes = [dict(move) for move in net.compiled.changes]
    return all(
        net.initial[q] >= a.weight * net.initial[run]
        and all(c.get(q, 0) >= a.weight * c.get(run, 0) for c in changes)
        for a in transition.inputs
        if a is not runs[0]
        for q in (net.place_index[a.place],)
    )


@lru_cache(maxsize=4)
def _never_together(net: Net) -> set[tuple[int, int]]:
    return exclusive_places(net, place_semiflows(net))


def branching_places(task: Task, transition: Transition) -> set[tuple[str, End | None]]:
    """Return from where a transition takes the tokens whose way its condition decides: transitions
    with one in common are alternatives. Who merely wants the same resource is none."""
    return {
        (a.place, a.end)
        for a in transition.inputs
        if a.end is not End.GOING and task.places[a.place].kind is not Kind.RESOURCE
    }


class NoEstimate(ValueError):  # noqa: N818 - names what is missing
    """A number that the stochastic view needs was neither measured nor declared."""


class Numbers(Struct, frozen=True):
    """What is measured or declared of a task, measured first."""

    task: Task
    measured: Measured
    assumptions: list[str] = field(default_factory=list)
    """What was assumed in the answers so far."""
    apart: bool = True
    """Whether runs that end at their deadline have its fixed time. Few phases cannot say that: then
    one distribution has the mean and variance of all ends with ERROR."""

    def alternatives(self, place: Place) -> dict[str, float]:
        """Return the probability of each alternative of a place."""
        primitive = self.task.primitive_task_of(place.name)
        known = self.measured.choice.get(primitive.name)
        if known is None:
            if len(primitive.alternatives) > 1:
                self.assumptions.append(
                    f"{primitive.name}: its alternatives are equally likely (no selector "
                    "state given)"
                )
            return {action: 1.0 / len(primitive.alternatives) for action in primitive.alternatives}
        return {
            action: known[action] for action in primitive.alternatives if known.get(action, 0.0) > 0
        }

    def estimates(self, place: Place, action: str) -> Mapping[Status, Estimate]:
        """Return share, mean (s) and cv by status. Raises NoEstimate."""
        return self._estimates(place, action)[0]

    def ends(self, place: Place, action: str) -> dict[OwnEnd, Estimate]:
        """Return share, mean (s) and cv by how a run ends by itself. Raises NoEstimate."""
        known, late = self._estimates(place, action)
        found = {OwnEnd(s): e for s, e in known.items() if e.share > 0}
        if late is None or not late.share:
            return found
        error = known[Status.ERROR]
        if error.share - late.share < NEVER * error.share:
            found[AT_DEADLINE] = found.pop(OwnEnd(Status.ERROR))
        elif self.apart and (own := _apart(error, late)) is not None:
            found |= {OwnEnd(Status.ERROR): own, AT_DEADLINE: late}
        else:
            self.assumptions.append(
                f"{place.name}: {100 * late.share / error.share:.0f} % of its ends with ERROR come "
                "at its deadline; with few phases, one distribution has them and all others"
            )
        return found

    def _estimates(
        self, place: Place, action: str
    ) -> tuple[Mapping[Status, Estimate], Estimate | None]:
        """Return them, and which of the runs end at their deadline; None if the estimates were
        measured, and the part of these runs was not."""
        primitive = self.task.primitive_task_of(place.name)
        for key in ((place.name, action), (primitive.name, action)):
            if key in self.measured.runs:
                known = self.measured.runs[key]
                if key in self.measured.expected:
                    return self._cut(place, known)
                late, error = self.measured.late.get(key), known.get(Status.ERROR)
                if late is None or error is None:
                    return known, None
                return known, replace(late, share=late.share * error.share)
        if not primitive.estimates:
            raise NoEstimate(
                f"primitive_tasks.{primitive.name}: the duration of {action} is unknown: it was "
                "neither measured nor declared; "
                f"add [primitive_tasks.{primitive.name}.estimates] or give measurements"
            )
        self.assumptions.append(
            f"{primitive.name}: estimates declared in the task file, not measured"
        )
        return self._cut(place, primitive.estimates)

    def _cut(
        self, place: Place, estimates: Mapping[Status, Estimate]
    ) -> tuple[Mapping[Status, Estimate], Estimate]:
        deadline = self.task.longest_run(place.name)
        if any(e.share > 0 and not e.mean > 0 for e in estimates.values()):
            return estimates, Estimate(0.0, deadline)  # another message names the missing mean
        found, late = cut(estimates, deadline)
        if late:
            self.assumptions.append(
                f"{place.name}: {late:.3g} of its runs end in ERROR after {deadline:g} s (cause "
                "`deadline`), by gamma distributions of the declared durations"
            )
        return found, Estimate(late, deadline, 0.0)

    def causes(self, place: Place, action: str) -> Mapping[Status, Mapping[Ending, float]]:
        """Return how often its runs ended by each cause, by status; empty if not measured."""
        return self.measured.causes.get(self._key(place, action), {})

    def _key(self, place: Place, action: str) -> tuple[str, str]:
        own = (place.name, action)
        return own if own in self.measured.causes else (place.task, action)

    def by_switches(self, place: Place) -> bool:
        """Return whether conditions on the causes of a place have measured frequencies, and the
        causes themselves were not measured."""
        if any(self.causes(place, action) for action in self.alternatives(place)):
            return False
        names = {f"{place.name}.{field}" for field in FIELDS}
        return any(
            t.when is not None and t.name in self.measured.switches and names & t.when.names
            for t in self.task.transitions.values()
        )

    def endings(
        self,
        place: Place,
        action: str,
        end: OwnEnd,
        examples: Sequence[Ending],
        region: Callable[[Ending], K],
    ) -> dict[K, float]:
        """Return how probable each kind of end is among the runs that end in a way of `ends`.

        `region` gives the kind: conditions do not tell ends of one kind apart. `examples` has one
        end of each kind. Where no cause was measured, a run is taken to have been executed, and not
        to have been ended by an emergency stop: declared estimates are those of the action itself.
        """
        kinds = list(dict.fromkeys(map(region, examples)))
        if len(kinds) == 1:
            return {kinds[0]: 1.0}
        apart = AT_DEADLINE in self.ends(place, action)
        known = {
            e: n
            for e, n in self.causes(place, action).get(end.status, {}).items()
            if n > 0 and (not apart or (e[0] == LATE[0]) == end.late)
        }
        if known and {region(e) for e in known} <= set(kinds):
            if self._key(place, action) in self.measured.mixed:
                self._mixed(place.name, {e: region(e) for e in known})
            total, found = sum(known.values()), dict[K, float]()
            for ending, n in known.items():
                found[region(ending)] = found.get(region(ending), 0.0) + n / total
            return found
        if end.late and region(LATE) in kinds:
            return {region(LATE): 1.0}
        estimates, late = self._estimates(place, action)
        from_outside = (EMERGENCY,) if late is None else (EMERGENCY, LATE[0])
        own = {region((c, str(Executed.YES))) for c, _ in examples if c not in from_outside}
        equal = [kind for kind in kinds if kind in own] or kinds
        text = f"{place.name}: why its runs end in {end.status.name} was not measured"
        if len(equal) < len(kinds):
            text += "; they were executed, and not ended by an emergency stop"
        text += "; causes that lead to different firings are equally likely" * (len(equal) > 1)
        self.assumptions.append(text)
        found = dict.fromkeys(equal, 1.0 / len(equal))
        if end == OwnEnd(Status.ERROR) and late and not apart and region(LATE) in kinds:
            share = late.share / estimates[Status.ERROR].share
            found = {kind: n * (1 - share) for kind, n in found.items()}
            found[region(LATE)] = found.get(region(LATE), 0.0) + share
        return found

    def _mixed(self, place: str, kinds: Mapping[Ending, Hashable]) -> None:
        """Note it if the kinds of ends depend on the cause, and for one cause on whether the run
        was executed: then they need both numbers of the same runs."""
        by_cause, by_both = {c: k for (c, _), k in kinds.items()}, set(kinds.values())
        split = any(k != by_cause[c] for (c, _), k in kinds.items())
        if split and len(by_both) > len({x for _, x in kinds}):
            self.assumptions.append(
                f"{place}: it was not measured which causes of ERROR came with executed = unknown; "
                "each did as often"
            )

    def wait(self, event: str, transition: str = "") -> float:
        """Return the mean time (s) until an event comes for which this transition waits: a person
        who presses one button answers sooner in one place than in another. Raises NoEstimate."""
        mean = self.measured.waits_of.get(
            transition, self.measured.waits.get(event, self.task.events[event].mean_wait)
        )
        if mean is None and self._from_ready(event):
            self.assumptions.append(
                f"{event}: when a run raises it was neither measured nor declared; taken to be "
                "before all else that its transitions need (add mean_wait, or measure again)"
            )
            return SHORTEST
        if mean is None:
            raise NoEstimate(
                f"events.{event}: its mean wait is unknown: neither measured nor declared; add "
                "mean_wait = SECONDS"
            )
        if event not in self.measured.waits:
            self.assumptions.append(f"{event}: mean wait declared in the task file, not measured")
        return mean

    def waits_ready(self, x: CompiledTransition) -> bool:
        """Return whether the wait of a transition for its internal event is known from when it has
        all else, as measured waits are. A declared one is known from the begin of the run."""
        asked = [a for a in x.actions if a.raised]
        preempts = all(a.end is End.PREEMPT and not a.takes_done for a in asked)
        t = self.task.transitions[x.name]
        return bool(asked) and len(t.events) == 1 and preempts and self._from_ready(t.events[0])

    def _from_ready(self, event: str) -> bool:
        if event in self.measured.waits:
            return True
        undeclared = self.task.events[event].mean_wait is None
        moves = [t for t in self.task.transitions.values() if event in t.events]
        return (
            undeclared
            and bool(self.measured.runs)
            and self.task.events[event].scope is Scope.INTERNAL
            and all(any(a.end is End.PREEMPT for a in t.inputs) for t in moves)
            and not any(is_cause(self.task, t) for t in moves)
        )
