"""A compiled task as the forecast plays it: its firing rule, and which statuses of the runs that a
transition takes its condition admits."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from petrobot.coordinator.analysis.time.measured import EMERGENCY, FIELDS, is_cause
from petrobot.coordinator.learning.waits import memory_of
from petrobot.coordinator.studies.forecast.history import STATUSES, RunVocabulary, reads_variables
from petrobot.coordinator.task import (
    Counts,
    EarlyEvent,
    End,
    EventMemory,
    Executed,
    Kind,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.compiled_task import CompiledTransition, compile_transitions
from petrobot.coordinator.task.conditions import ConditionFault, Literal, walk
from petrobot.coordinator.task.net import CompiledNet


@dataclass(frozen=True)
class Move:
    """A compiled transition with what playing it needs. Runs are numbers of action places."""

    transition: CompiledTransition
    normal: tuple[int, ...]
    error: tuple[int, ...]
    going: tuple[int, ...]
    preempt: tuple[tuple[int, Counts, bool], ...]
    """(action place, how the run counts, whether a run that has ended is taken, too)."""
    cause: bool
    """Its preemption is a cause by which a run ends, drawn with the run; else it preempts as soon
    as it can fire."""
    starts: tuple[int, ...]
    """Action places in which it starts a run."""
    waits: bool
    """For an event or a timer."""
    memory: tuple[EventMemory, EarlyEvent] | None
    """How the one external event for which it waits is remembered."""
    mean_wait: float | None
    """Declared mean time until all of its events have come (s); None: not declared."""
    allowed: np.ndarray | None
    """Which statuses of the runs it takes (axes: normal, then error) its condition admits; None:
    any."""
    is_goal: bool
    takes_run: bool
    """It takes a token out of the runs place."""

    @property
    def name(self) -> str:
        """Name of the transition."""
        return self.transition.name

    @property
    def number(self) -> int:
        """Index of the transition in the net."""
        return self.transition.index

    @property
    def priority(self) -> int:
        """The engine's rank as one number: the highest fires first."""
        before, yields = self.transition.rank
        return -2 * before - yields


@dataclass(frozen=True)
class Structure:
    """A flat task."""

    task: Task
    vocabulary: RunVocabulary
    moves: tuple[Move, ...]
    initial: np.ndarray
    rule: CompiledNet
    """The firing rule of the task's net."""
    action_places: tuple[int, ...]
    """Index in the net of each action place."""
    assumptions: tuple[str, ...]

    @classmethod
    def of(cls, task: Task, whole: bool = True) -> Structure:
        """`whole`: by which transition each run left its place was measured. Raises ValueError for
        what cannot be played, with the remedy."""
        flat = task.flat
        vocabulary = RunVocabulary.of(flat)
        for place in flat.places.values():
            if place.kind is Kind.ACTION and place.most_active > 1:
                raise ValueError(
                    f"places.{place.name}: it has servers = {place.most_active}, but a forecast "
                    "plays one run of a place at a time; forecast a copy of the task with "
                    "servers = 1 there, where further runs wait, or run a campaign of the task"
                )
        for t in flat.transitions.values():
            _refuse_unknown_preemption(t)
        moves = tuple(
            _move(flat, vocabulary, t, compiled)
            for t, compiled in zip(
                flat.transitions.values(), compile_transitions(flat), strict=True
            )
        )
        initial = np.array(flat.net.initial, np.int64)
        if flat.runs_place:
            initial[flat.net.place_index[flat.runs_place]] = 1
        indices = tuple(flat.net.place_index[name] for name in vocabulary.places)
        source = (
            "how often its condition holds is taken from the runs that it took"
            if whole
            else "its condition is taken to hold as for runs that were executed, and that no "
            "emergency stop ended"
        )
        assumptions = tuple(
            f"{m.name}: {source}"
            for t, m in zip(flat.transitions.values(), moves, strict=True)
            if reads_variables(t) and (whole or m.allowed is not None)
        )
        return cls(flat, vocabulary, moves, initial, flat.net.compiled, indices, assumptions)


def _move(
    flat: Task,
    vocabulary: RunVocabulary,
    t: Transition,
    compiled: CompiledTransition,
) -> Move:
    net = flat.net
    number_of = {net.place_index[name]: q for q, name in enumerate(vocabulary.places)}
    by_end = {
        end: tuple(number_of[a.place] for a in compiled.actions if a.end is end)
        for end in (End.NORMAL, End.ERROR, End.GOING)
    }
    waits_known = [flat.events[e].mean_wait for e in t.events]
    means = [mean for mean in waits_known if mean is not None]
    return Move(
        compiled,
        by_end[End.NORMAL],
        by_end[End.ERROR],
        by_end[End.GOING],
        tuple(
            (number_of[a.place], a.counts, a.takes_done)
            for a in compiled.actions
            if a.end is End.PREEMPT
        ),
        is_cause(t),
        tuple(number_of[p] for p, _, is_action in compiled.produce if is_action),
        bool(t.events) or t.after is not None,
        memory_of(flat, t),
        max(means) if means and len(means) == len(waits_known) else None,
        _allowed(t, [vocabulary.places[q] for q in by_end[End.NORMAL] + by_end[End.ERROR]]),
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


def _allowed(t: Transition, places: list[str]) -> np.ndarray | None:
    """Return which statuses a condition admits. If it asks why a run ended, too, as that of a retry
    does: of runs that were executed, and that no emergency stop ended."""
    if t.when is None or _reads_unknown(t, places):
        return None
    out = np.zeros((len(STATUSES),) * len(places), np.bool_)
    for combination in product(range(len(STATUSES)), repeat=len(places)):
        values = {
            f"{place}.{field}": value
            for place, s in zip(places, combination, strict=True)
            for field, value in zip(
                ("status", *FIELDS), (str(STATUSES[s]), "", str(Executed.YES)), strict=True
            )
        }
        try:
            out[combination] = t.when.holds(values)
        except ConditionFault:
            out[combination] = False
    return out


def _reads_unknown(t: Transition, places: list[str]) -> bool:
    """Return whether a condition depends on a variable, or on a cause of the action's own."""
    assert t.when is not None
    known = {f"{place}.{field}" for place in places for field in ("status", *FIELDS)}
    literals = {node.value for node in walk(t.when.tree) if isinstance(node, Literal)}
    return not (t.when.names <= known and literals <= {*Status, *Executed, EMERGENCY})


SUCCESS, ERROR = STATUSES.index(Status.SUCCESS), STATUSES.index(Status.ERROR)
