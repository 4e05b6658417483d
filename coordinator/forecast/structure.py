"""A task's net as arrays for playing it: arcs, kinds of transitions, conditions on the statuses of the runs that they take."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from coordinator.conditions import ConditionFault
from coordinator.forecast.history import STATUSES, Vocabulary
from coordinator.task import Counts, End, Kind, Status, Task, Transition


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
    starts: tuple[int, ...]
    """Action places in which it starts a run."""
    waits: bool
    """For an event or a timer."""
    after: float | None
    mean_wait: float | None
    allowed: np.ndarray | None
    """Which statuses of the runs it takes (axes: normal, then error) its condition admits; None: any."""
    priority: int
    weight: float
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
                raise ValueError(f"places.{place.name}: forecasts know one run at a time; give it servers = 1")
        assumptions: list[str] = []
        moves = tuple(_move(flat, vocabulary, t, i, assumptions) for i, t in enumerate(flat.transitions.values()))
        initial = np.array(flat.net.initial, np.int64)
        if flat.runs_place:
            initial[flat.net.place_index[flat.runs_place]] = 1
        indices = tuple(flat.net.place_index[name] for name in vocabulary.places)
        return cls(flat, vocabulary, moves, initial, indices, tuple(assumptions))


def _move(flat: Task, vocabulary: Vocabulary, t: Transition, number: int, assumptions: list[str]) -> Move:
    net = flat.net
    number_of = {name: q for q, name in enumerate(vocabulary.places)}
    by_end = {
        end: tuple(number_of[a.place] for a in t.inputs if a.end is end) for end in (End.NORMAL, End.ERROR, End.GOING)
    }
    preempt = tuple((number_of[a.place], a.counts or Counts.NONE) for a in t.inputs if a.end is End.PREEMPT)
    if t.when is not None and not _judges_statuses(t):
        assumptions.append(f"{t.name}: how often its condition holds is taken from the runs that it took")
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
        tuple(number_of[o.place] for o in t.outputs if o.place in number_of),
        bool(t.events) or t.after is not None,
        t.after,
        max(means) if means and len(means) == len(waits_known) else None,
        _allowed(t, [vocabulary.places[q] for q in by_end[End.NORMAL] + by_end[End.ERROR]]),
        t.priority,
        t.weight if t.weight is not None else 1.0,
        t.name in flat.goal_transitions,
        any(a.place == flat.runs_place for a in t.inputs),
    )


def _judges_statuses(t: Transition) -> bool:
    taken = {f"{a.place}.status" for a in t.inputs if a.end is not None}
    return t.when is not None and t.when.names <= taken


def _allowed(t: Transition, places: list[str]) -> np.ndarray | None:
    if t.when is None or not _judges_statuses(t):
        return None
    out = np.zeros((len(STATUSES),) * len(places), np.bool_)
    for combination in product(range(len(STATUSES)), repeat=len(places)):
        values = {f"{place}.status": str(STATUSES[s]) for place, s in zip(places, combination, strict=True)}
        try:
            out[combination] = t.when.holds(values)
        except ConditionFault:
            out[combination] = False
    return out


SUCCESS, FAILURE, ERROR = (STATUSES.index(s) for s in (Status.SUCCESS, Status.FAILURE, Status.ERROR))
