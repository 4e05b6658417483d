"""The transitions of a task compiled: the firing rule of its net, and what a task adds to it.

A task's transition also asks how runs ended, for events, for a time and for a condition. The engine
fires by these tables and the forecast plays by them (docs/semantics.md, section 4).
"""

from __future__ import annotations

from collections.abc import Iterator

from msgspec import Struct

from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.elements import Counts, End, Event, Input, Kind, Scope, Transition
from petrobot.coordinator.task.model import Task
from petrobot.coordinator.task.net import Arcs, Changes, Net, Thresholds
from petrobot.coordinator.task.validation import is_pulse


class ActionArc(Struct, frozen=True):
    """An arc from an action place to a transition."""

    place: int
    name: str
    weight: int
    end: End
    counts: Counts
    takes_done: bool
    """A preempt arc of declared higher priority also takes a run that has ended but whose token is
    still there."""
    raised: tuple[str, ...]
    """Internal events that the run taken must have raised."""


class CompiledTransition(Struct, frozen=True):
    """A transition with everything that decides whether and how it fires."""

    index: int
    name: str
    needs: Arcs
    """Tokens that must be there, those of runs among them (`CompiledNet.needs`)."""
    bars: Thresholds
    """Places that must hold less: inhibitor arcs and capacities (`CompiledNet.bars`). A run that
    is still stopping counts as there."""
    changes: Changes
    """What a firing changes in the marking (`CompiledNet.changes`)."""
    plain: Arcs
    """Inputs from resource and control places."""
    actions: tuple[ActionArc, ...]
    produce: tuple[tuple[int, int, bool], ...]
    """(place, weight, is action place)."""
    pulse: str
    flags: tuple[str, ...]
    when: Expression | None
    sets: tuple[tuple[str, Expression], ...]
    """Variables that a firing writes, with their new values."""
    judges_runs: bool
    """Whether its condition reads status or reason of a run that it takes."""
    after: float | None
    priority: int
    preempts: bool
    weight: float | None
    never: bool
    """It waits for an internal event that none of its inputs can raise (`check` refuses this)."""

    @property
    def rank(self) -> tuple[int, bool]:
        """Smaller goes first in a conflict: declared priority, then a run's end before its
        preemption, unless weights are declared (docs/semantics.md, section 6)."""
        return -self.priority, self.preempts and self.weight is None


def compile_transitions(task: Task) -> tuple[CompiledTransition, ...]:
    """Compile the transitions of a flat, consistent task, in the order of its net."""
    return tuple(_compiled(task, task.net, t) for t in task.transitions.values())


def _compiled(task: Task, net: Net, t: Transition) -> CompiledTransition:
    index = net.transition_index[t.name]
    events = [task.events[e] for e in t.events]
    actions = tuple(
        _action_arc(task, net, t, a, a.end, events) for a in t.inputs if a.end is not None
    )
    heard = {e for a in actions for e in a.raised}
    plain = tuple((net.place_index[a.place], a.weight) for a in t.inputs if a.end is None)
    produced = {net.place_index[o.place]: o.weight for o in t.outputs}
    places = tuple(task.places.values())
    taken = {a.name for a in actions}
    return CompiledTransition(
        index=index,
        name=t.name,
        needs=net.compiled.needs[index],
        bars=net.compiled.bars[index],
        changes=net.compiled.changes[index],
        plain=plain,
        actions=actions,
        produce=tuple((p, w, places[p].kind is Kind.ACTION) for p, w in sorted(produced.items())),
        pulse=next((e.name for e in events if is_pulse(e)), ""),
        flags=tuple(e.name for e in events if e.scope is Scope.EXTERNAL and not is_pulse(e)),
        when=t.when,
        sets=t.sets,
        judges_runs=t.when is not None and any(n.rpartition(".")[0] in taken for n in t.when.names),
        after=t.after,
        priority=t.priority,
        preempts=any(a.end is End.PREEMPT for a in actions),
        weight=t.weight,
        never=any(e.scope is Scope.INTERNAL and e.name not in heard for e in events),
    )


def _action_arc(
    task: Task, net: Net, t: Transition, arc: Input, end: End, events: list[Event]
) -> ActionArc:
    primitive = task.places[arc.place].task
    rivals = task.exits.get((arc.place, End.NORMAL), ())
    return ActionArc(
        place=net.place_index[arc.place],
        name=arc.place,
        weight=arc.weight,
        end=end,
        counts=arc.counts or Counts.NONE,
        takes_done=end is End.PREEMPT
        and t.priority > max((u.priority for u in rivals), default=t.priority),
        raised=tuple(e.name for e in events if e.scope is Scope.INTERNAL and e.by == primitive),
    )


# --- firings that wait for nothing ---
# Firings that wait for nothing: whether a task can fire for ever without time passing.


def is_timeless(t: Transition) -> bool:
    """Whether the transition waits neither for an event nor for a time nor for the end of a run."""
    return (
        not t.events
        and t.after is None
        and not any(a.end in (End.NORMAL, End.ERROR) for a in t.inputs)
    )


def endless(task: Task) -> set[str]:
    """Return the transitions of a flat task that might fire for ever without time passing; if there
    are none, every such sequence ends.

    Of the transitions that wait for nothing, those are dropped again and again that drain a place
    which no other of them fills, or that fill a place which inhibits them and which no other of
    them drains: they can fire only finitely often. What none of them changes stays as it is, so
    they are judged once with those that need k tokens there, and once with those that k tokens
    inhibit; of two places whose sum no firing changes, such as `open` and `closed`, each says what
    the other holds. The others may fire for ever.
    """
    net = task.net
    changes = dict(zip(net.transitions, net.compiled.changes, strict=True))
    needs = dict(zip(net.transitions, map(dict, net.compiled.needs), strict=True))
    barred = dict(zip(net.transitions, map(dict, net.inhibit), strict=True))

    effects = {p.name: dict[str, int]() for p in task.places.values() if p.kind is not Kind.CONTROL}
    for t, changed in changes.items():
        for p, change in changed:
            if (name := net.places[p]) in effects:  # a control place is the operator's
                effects[name][t] = change

    def partners(p: int) -> Iterator[tuple[int, int]]:
        """Yield the places that hold what this one lacks of a sum, with that sum."""
        gone = {t: -change for t, change in effects.get(net.places[p], {}).items()}
        for q, name in enumerate(net.places) if gone else ():
            if effects.get(name) == gone:
                yield q, net.initial[p] + net.initial[q]

    def repeatable(loose: set[str]) -> set[str]:
        while True:
            filled = {p for t in loose for p, change in changes[t] if change > 0}
            drained = {p for t in loose for p, change in changes[t] if change < 0}
            finite = {
                t
                for t in loose
                for p, change in changes[t]
                if (change < 0 and p not in filled)
                or (change > 0 and p in barred[t] and p not in drained)
            }
            if not finite:
                return loose
            loose = loose - finite

    def split(loose: set[str]) -> set[str]:
        changed = {p for t in loose for p, _ in changes[t]}
        for place, k in sorted({limit for t in loose for limit in barred[t].items()}):
            if place not in changed:
                few = {t for t in loose if needs[t].get(place, 0) < k}
                many = {t for t in loose if barred[t].get(place, k + 1) > k}
                for other, total in partners(place):
                    few -= {t for t in few if barred[t].get(other, total + 1) <= total - k + 1}
                    many -= {t for t in many if needs[t].get(other, 0) > total - k}
                if (rest := repeatable(few) | repeatable(many)) < loose:
                    return rest
        return loose

    loose = repeatable({t.name for t in task.transitions.values() if is_timeless(t)})
    while (rest := split(loose)) < loose:
        loose = repeatable(rest)
    return loose
