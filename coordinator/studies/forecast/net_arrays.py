"""A task's net as arrays for playing it: arcs, kinds of transitions, conditions on the statuses of
the runs that they take."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from petrobot.coordinator.analysis.time.stochastic import is_cause
from petrobot.coordinator.studies.forecast.history import STATUSES, Vocabulary, reads_variables
from petrobot.coordinator.task import Counts, End, Kind, Status, Task, Transition
from petrobot.coordinator.task.conditions import ConditionFault


@dataclass(frozen=True)
class Move:
    """A transition. Places are indices of the net, runs are numbers of action places."""

    name: str
    number: int
    take: tuple[tuple[int, int], ...]
    """Tokens taken: (place, weight), action places among them."""
    give: tuple[tuple[int, int], ...]
    inhibit: tuple[tuple[int, int], ...]
    normal: tuple[int, ...]
    error: tuple[int, ...]
    going: tuple[int, ...]
    preempt: tuple[tuple[int, Counts], ...]
    cause: bool
    """Its preemption is a cause by which a run ends, drawn with the run; else it preempts as soon
    as it can fire."""
    takes_done: bool
    """It also takes a run that has ended but whose token is still there (its priority is
    higher)."""
    starts: tuple[int, ...]
    """Action places in which it starts a run."""
    waits: bool
    """For an event or a timer."""
    after: float | None
    mean_wait: float | None
    allowed: np.ndarray | None
    """Which statuses of the runs it takes (axes: normal, then error) its condition admits; None:
    any."""
    priority: int
    weight: float
    yields: bool
    """Of equal priority, another one fires first: a run's end goes before its preemption."""
    is_goal: bool
    takes_run: bool
    """It takes a token out of the runs place."""


@dataclass(frozen=True)
class Structure:
    """A flat task."""

    task: Task
    vocabulary: Vocabulary
    moves: tuple[Move, ...]
    initial: np.ndarray
    action_places: tuple[int, ...]
    """Index in the net of each action place."""
    assumptions: tuple[str, ...]

    @classmethod
    def of(cls, task: Task) -> Structure:
        """Raises ValueError for what cannot be played, with the remedy."""
        flat = task.flat
        vocabulary = Vocabulary.of(flat)
        for place in flat.places.values():
            if place.kind is Kind.ACTION and (place.servers or 1) > 1:
                raise ValueError(
                    f"places.{place.name}: forecasts know one run at a time; give it servers = 1"
                )
        for t in flat.transitions.values():
            _refuse_unknown_preemption(t)
        assumptions: list[str] = []
        moves = tuple(
            _move(flat, vocabulary, t, i, assumptions)
            for i, t in enumerate(flat.transitions.values())
        )
        initial = np.array(flat.net.initial, np.int64)
        if flat.runs_place:
            initial[flat.net.place_index[flat.runs_place]] = 1
        indices = tuple(flat.net.place_index[name] for name in vocabulary.places)
        return cls(flat, vocabulary, moves, initial, indices, tuple(assumptions))


def _move(
    flat: Task, vocabulary: Vocabulary, t: Transition, number: int, assumptions: list[str]
) -> Move:
    net = flat.net
    number_of = {name: q for q, name in enumerate(vocabulary.places)}
    by_end = {
        end: tuple(number_of[a.place] for a in t.inputs if a.end is end)
        for end in (End.NORMAL, End.ERROR, End.GOING)
    }
    preempt = tuple(
        (number_of[a.place], a.counts or Counts.NONE) for a in t.inputs if a.end is End.PREEMPT
    )
    if reads_variables(t):
        assumptions.append(
            f"{t.name}: how often its condition holds is taken from the runs that it took"
        )
    waits_known = [flat.events[e].mean_wait for e in t.events]
    means = [mean for mean in waits_known if mean is not None]
    return Move(
        t.name,
        number,
        net.consume[net.transition_index[t.name]],
        net.produce[net.transition_index[t.name]],
        net.inhibit[net.transition_index[t.name]],
        by_end[End.NORMAL],
        by_end[End.ERROR],
        by_end[End.GOING],
        preempt,
        is_cause(t),
        _takes_done(flat, t),
        tuple(number_of[o.place] for o in t.outputs if o.place in number_of),
        bool(t.events) or t.after is not None,
        t.after,
        max(means) if means and len(means) == len(waits_known) else None,
        _allowed(t, [vocabulary.places[q] for q in by_end[End.NORMAL] + by_end[End.ERROR]]),
        t.priority,
        t.weight if t.weight is not None else 1.0,
        bool(preempt) and t.weight is None,
        t.name in flat.goal_transitions,
        any(a.place == flat.runs_place for a in t.inputs),
    )


def _refuse_unknown_preemption(t: Transition) -> None:
    """What preempts must follow from the marking, or be measured: an event's time from the begin of
    the one run that it takes."""
    runs = [a for a in t.inputs if a.end is not None]
    if is_cause(t) or not any(a.end is End.PREEMPT for a in runs):
        return
    if reads_variables(t) and not any(a.end in (End.NORMAL, End.ERROR) for a in runs):
        raise ValueError(
            f"transitions.{t.name}: when it preempts is decided by variables alone, and "
            "forecasts know no variables; let it take "
            "the ended run that sets them, too, or raise an event instead"
        )
    if t.events:
        places = ", ".join(a.place for a in runs)
        raise ValueError(
            f"transitions.{t.name}: forecasts know an event that preempts one run, this one "
            f"looks at several ({places}); let "
            "the event preempt one of them and put a token into a control place, and let a "
            "transition without an event take "
            "that token and the others"
        )


def _takes_done(flat: Task, t: Transition) -> bool:
    """As the engine does: a preemption of declared higher priority also takes what has ended."""
    places = {a.place for a in t.inputs if a.end is End.PREEMPT}
    rivals = [
        u
        for u in flat.transitions.values()
        if any(a.place in places and a.end is End.NORMAL for a in u.inputs)
    ]
    return bool(places) and t.priority > max((u.priority for u in rivals), default=t.priority)


def _allowed(t: Transition, places: list[str]) -> np.ndarray | None:
    if t.when is None or reads_variables(t):
        return None
    out = np.zeros((len(STATUSES),) * len(places), np.bool_)
    for combination in product(range(len(STATUSES)), repeat=len(places)):
        values = {
            f"{place}.status": str(STATUSES[s])
            for place, s in zip(places, combination, strict=True)
        }
        try:
            out[combination] = t.when.holds(values)
        except ConditionFault:
            out[combination] = False
    return out


SUCCESS, FAILURE, ERROR = (
    STATUSES.index(s) for s in (Status.SUCCESS, Status.FAILURE, Status.ERROR)
)
