"""A task made ready for execution: places and transitions by index, and who has to be looked at
when what has changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from petrobot.coordinator.task import (
    Counts,
    Early,
    End,
    Event,
    Input,
    Kind,
    PrimitiveTask,
    Scope,
    Task,
    Transition,
)
from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.instant_firings import endless
from petrobot.coordinator.task.net import Arcs, Net
from petrobot.coordinator.task.validation import faults, is_pulse

FIRINGS_OF_A_FINITE_NET: Final = 1_000_000
"""Firings without a stimulus of a net that must come to an end by itself: no laboratory has so many
tokens; half a minute."""


@dataclass(frozen=True, slots=True)
class ActionArc:
    """An arc out of an action place."""

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


@dataclass(frozen=True, slots=True)
class Exit:
    """A transition with everything that decides whether and how it fires."""

    index: int
    name: str
    plain: Arcs
    """Inputs from resource and control places."""
    actions: tuple[ActionArc, ...]
    takes: Arcs
    """All inputs: what the ordinary net consumes."""
    inhibit: Arcs
    produce: tuple[tuple[int, int, bool], ...]
    """(place, weight, is action place)."""
    room: tuple[tuple[int, int, int], ...]
    """(place, tokens gained, capacity) of the bounded output places that gain tokens."""
    pulse: str
    flags: tuple[str, ...]
    when: Expression | None
    judges_runs: bool
    """Whether its condition reads status or reason of a run that it takes."""
    after: float | None
    priority: int
    preempts: bool
    weight: float | None
    never: bool
    """It waits for an internal event that none of its inputs can raise (`check` refuses this)."""


@dataclass(frozen=True)
class Compiled:
    """The immutable compiled form of a task."""

    task: Task
    """Flat."""
    net: Net
    exits: tuple[Exit, ...]
    """The transitions, in net order."""
    action_places: Mapping[str, int]
    primitives: Mapping[str, PrimitiveTask]
    """By action place."""
    touching: tuple[tuple[int, ...], ...]
    """By place: transitions that its tokens, runs or room can enable or disable."""
    timed: tuple[tuple[int, ...], ...]
    """By place: those of `touching` with an `after` timer."""
    reading: Mapping[str, tuple[int, ...]]
    """By variable: transitions whose condition reads it."""
    waiting: Mapping[str, tuple[int, ...]]
    """By event: transitions that wait for it."""
    kept: frozenset[str]
    """Latched events that are kept when nothing waits for them."""
    devices: Mapping[str, str]
    """By action: the device that it uses."""
    firing_limit: int
    """Firings without a stimulus after which the engine gives up (docs/semantics.md, section 6)."""


def compile_task(task: Task, devices: Mapping[str, str]) -> Compiled:
    """The compiled form. Raises ValueError with all faults when the description is inconsistent."""
    found = faults(task)
    if found:
        raise ValueError(
            f"task {task.name!r} cannot be executed:\n" + "\n".join(f"  {f}" for f in found)
        )
    flat, net = task.flat, task.net
    exits = tuple(_exit(flat, net, t) for t in flat.transitions.values())
    touching = tuple(
        tuple(x.index for x in exits if _touches(x, p)) for p in range(len(net.places))
    )
    return Compiled(
        task=flat,
        net=net,
        exits=exits,
        action_places={
            p.name: net.place_index[p.name] for p in flat.places.values() if p.kind is Kind.ACTION
        },
        primitives={
            p.name: flat.primitive_tasks[p.task]
            for p in flat.places.values()
            if p.kind is Kind.ACTION
        },
        touching=touching,
        timed=tuple(tuple(t for t in ts if exits[t].after is not None) for ts in touching),
        reading=_index((x.index, sorted(x.when.names)) for x in exits if x.when is not None),
        waiting=_index((net.transition_index[t.name], t.events) for t in flat.transitions.values()),
        kept=frozenset(e.name for e in flat.events.values() if e.early is Early.KEEP),
        devices=dict(devices),
        firing_limit=_firing_limit(flat, net),
    )


def _firing_limit(flat: Task, net: Net) -> int:
    """A net whose firings must come to an end may take its time; one that might go on for ever gets
    what each of its transitions could do once with every token that it has at the beginning, or
    that one firing makes."""
    if not endless(flat):
        return FIRINGS_OF_A_FINITE_NET
    tokens = sum(net.initial) + sum(weight for arcs in net.produce for _, weight in arcs)
    return min(1_000 + len(net.transitions) * tokens, FIRINGS_OF_A_FINITE_NET)


def _index(pairs: Iterable[tuple[int, Iterable[str]]]) -> dict[str, tuple[int, ...]]:
    table: dict[str, tuple[int, ...]] = {}
    for number, names in pairs:
        for name in names:
            table[name] = (*table.get(name, ()), number)
    return table


def _touches(x: Exit, place: int) -> bool:
    arcs = (*x.plain, *x.inhibit)
    return (
        any(p == place for p, _ in arcs)
        or any(a.place == place for a in x.actions)
        or any(p == place for p, _, _ in x.room)
    )


def _exit(task: Task, net: Net, t: Transition) -> Exit:
    index = net.transition_index[t.name]
    events = [task.events[e] for e in t.events]
    actions = tuple(
        _action_arc(task, net, t, a, a.end, events) for a in t.inputs if a.end is not None
    )
    heard = {e for a in actions for e in a.raised}
    plain = tuple((net.place_index[a.place], a.weight) for a in t.inputs if a.end is None)
    consumed = dict(net.consume[index])
    produced = {net.place_index[o.place]: o.weight for o in t.outputs}
    places = tuple(task.places.values())
    gains = {p: w - consumed.get(p, 0) for p, w in net.produce[index]}
    limits = net.capacity
    taken = {a.name for a in actions}
    return Exit(
        index=index,
        name=t.name,
        plain=plain,
        actions=actions,
        takes=net.consume[index],
        inhibit=net.inhibit[index],
        produce=tuple((p, w, places[p].kind is Kind.ACTION) for p, w in sorted(produced.items())),
        room=tuple(
            (p, g, limit) for p, g in gains.items() if g > 0 and (limit := limits[p]) is not None
        ),
        pulse=next((e.name for e in events if is_pulse(e)), ""),
        flags=tuple(e.name for e in events if e.scope is Scope.EXTERNAL and not is_pulse(e)),
        when=t.when,
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
    rivals = [
        u
        for u in task.transitions.values()
        if any(a.place == arc.place and a.end is End.NORMAL for a in u.inputs)
    ]
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
