"""A compiled task as the forecast plays it: its firing rule, and which statuses of the runs that a
transition takes its condition admits."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from msgspec import Struct

from petrobot.coordinator.analysis.time.measured import EMERGENCY, FIELDS, is_cause
from petrobot.coordinator.learning.waits import memory_of
from petrobot.coordinator.studies.forecast.history import (
    STATUSES,
    RunVocabulary,
    known_variables,
    reads_variables,
)
from petrobot.coordinator.task import (
    EarlyEvent,
    End,
    EventMemory,
    Executed,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.compiled_task import (
    ActionArc,
    CompiledTransition,
    compile_transitions,
)
from petrobot.coordinator.task.conditions import ConditionFault, Expression, Literal, walk
from petrobot.coordinator.task.conditions.language import Scalar
from petrobot.coordinator.task.net import CompiledNet


class Move(Struct, frozen=True):
    """A compiled transition with what playing it needs."""

    transition: CompiledTransition
    cause: bool
    """Its preemption is a cause by which a run ends, drawn with the run; else it preempts as soon
    as it can fire."""
    waits: bool
    """For an event or a timer."""
    memory: tuple[EventMemory, EarlyEvent] | None
    """How the one external event for which it waits is remembered."""
    mean_wait: float | None
    """Declared mean time until all of its events have come (s); None: not declared."""
    allowed: np.ndarray | None
    """Which statuses of the ended runs it takes (axes: its arcs) its condition admits; None:
    any."""
    known: Expression | None
    """Its condition, if it follows from what fired before."""
    open_: bool
    """Nothing but how often it fired tells whether its condition holds."""
    is_goal: bool
    takes_run: bool
    """It takes a token out of the runs place, and does not give it back at once."""

    @property
    def name(self) -> str:
        """Name of the transition."""
        return self.transition.name

    @property
    def number(self) -> int:
        """Index of the transition in the net."""
        return self.transition.index

    @property
    def ended(self) -> list[ActionArc]:
        """Its arcs that take runs that have ended."""
        return [arc for arc in self.transition.actions if arc.end in (End.NORMAL, End.ERROR)]

    @property
    def priority(self) -> int:
        """The engine's rank as one number: the highest fires first."""
        before, yields = self.transition.rank
        return -2 * before - yields


class Structure(Struct, frozen=True):
    """A flat task."""

    task: Task
    vocabulary: RunVocabulary
    moves: tuple[Move, ...]
    initial: np.ndarray
    rule: CompiledNet
    """The firing rule of the task's net."""
    codes: Mapping[int, int]
    """By index in the net of an action place: its code in the vocabulary."""
    assumptions: tuple[str, ...]
    first_values: Mapping[str, Scalar | None]
    """What known variables hold when the task begins."""

    @classmethod
    def of(cls, task: Task, whole: bool = True) -> Structure:
        """`whole`: by which transition each run left its place was measured. Raises ValueError for
        what cannot be played, with the remedy."""
        flat = task.flat
        vocabulary = RunVocabulary.of(flat)
        for t in flat.transitions.values():
            _refuse_unknown_preemption(flat, t)
        moves = tuple(
            _move(flat, t, compiled)
            for t, compiled in zip(
                flat.transitions.values(), compile_transitions(flat), strict=True
            )
        )
        initial = np.array(flat.net.initial, np.int64)
        if flat.runs_place:
            initial[flat.net.place_index[flat.runs_place]] = 1
        codes = {flat.net.place_index[name]: q for q, name in enumerate(vocabulary.places)}
        taken = (
            "how often its condition holds is taken from the runs that it took"
            if whole
            else "its condition is taken to hold as for runs that were executed, and that no "
            "emergency stop ended"
        )
        fired = "how often its condition holds is taken from how often it fired in the trials"
        assumptions = tuple(
            f"{m.name}: {fired if m.open_ else taken}"
            for t, m in zip(flat.transitions.values(), moves, strict=True)
            if reads_variables(flat, t) and (whole or m.allowed is not None)
        )
        values = flat.initial_variables()
        first = {name: values[name] for name in sorted(known_variables(flat))}
        return cls(flat, vocabulary, moves, initial, flat.net.compiled, codes, assumptions, first)


def _move(flat: Task, t: Transition, compiled: CompiledTransition) -> Move:
    waits_known = [flat.events[e].mean_wait for e in t.events]
    means = [mean for mean in waits_known if mean is not None]
    ends = [a.name for a in compiled.actions if a.end in (End.NORMAL, End.ERROR)]
    allowed = _allowed(t, ends)
    known = t.when is not None and allowed is None and t.when.names <= known_variables(flat)
    moved = {flat.net.places[p]: n for p, n in flat.net.compiled.changes[compiled.index]}
    return Move(
        compiled,
        is_cause(flat, t),
        bool(t.events) or t.after is not None,
        memory_of(flat, t),
        max(means) if means and len(means) == len(waits_known) else None,
        allowed,
        t.when if known else None,
        t.when is not None and allowed is None and not known and not ends,
        t.name in flat.goal_transitions,
        moved.get(flat.runs_place, 0) < 0,
    )


def _refuse_unknown_preemption(task: Task, t: Transition) -> None:
    """What preempts must follow from the marking, or be measured: an event's time from the begin of
    the one run that it takes."""
    runs = [a for a in t.inputs if a.end is not None]
    several = [a for a in runs if a.end is End.PREEMPT and task.places[a.place].most_active > 1]
    if is_cause(task, t) and several:
        place = task.places[several[0].place]
        raise ValueError(
            f"transitions.{t.name}: it preempts a run of {place.name}, which has servers = "
            f"{place.most_active}, but a forecast knows only how often the one run of a place is "
            "preempted; forecast a copy of the task with servers = 1 there, where further runs "
            "wait, or run a campaign of the task"
        )
    if is_cause(task, t) or not any(a.end is End.PREEMPT for a in runs):
        return
    if reads_variables(task, t) and not any(a.end in (End.NORMAL, End.ERROR) for a in runs):
        raise ValueError(
            f"transitions.{t.name}: when it preempts is decided by variables alone, and "
            "forecasts know no variables; let it take "
            "the ended run that sets them, too, or raise an event instead"
        )
    if t.events and len(runs) > 1:
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
