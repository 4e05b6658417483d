"""A task compiled for execution: its transitions by index, and which of them to examine when
tokens, a variable or an event change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.task import EarlyEvent, Kind, Place, PrimitiveTask, Task
from petrobot.coordinator.task.compiled_task import CompiledTransition, compile_transitions, endless
from petrobot.coordinator.task.conditions import Domain
from petrobot.coordinator.task.net import Net
from petrobot.coordinator.task.validation import condition_domains, faults

FIRINGS_OF_A_FINITE_NET: Final = 1_000_000
"""Most firings without a stimulus of a net that must stop by itself. No laboratory has so many
tokens; they take half a minute."""


class Compiled(Struct, frozen=True):
    """The immutable compiled form of a task."""

    task: Task
    """Flat."""
    net: Net
    transitions: tuple[CompiledTransition, ...]
    """In net order."""
    action_places: Mapping[str, int]
    primitives: Mapping[str, PrimitiveTask]
    """By action place; with the place's `timeout` as deadline where that is shorter."""
    executed: frozenset[str]
    """Action places whose `executed` is read by a condition."""
    copies: Mapping[str, tuple[int, ...]]
    """By written transition: those that were made from it (`expansion`)."""
    setting: Mapping[str, tuple[int, ...]]
    """By variable: transitions that write it. Arguments that read one are taken when the token
    enters."""
    touching: tuple[tuple[int, ...], ...]
    """By place: transitions that its tokens, runs or free capacity can enable or disable."""
    timed: tuple[tuple[int, ...], ...]
    """By place: those of `touching` with an `after` timer."""
    reading: Mapping[str, tuple[int, ...]]
    """By variable: transitions whose condition reads it."""
    waiting: Mapping[str, tuple[int, ...]]
    """By event: transitions that wait for it."""
    kept: frozenset[str]
    """Latched events that are kept while no transition waits for them."""
    contested: Mapping[int, frozenset[int]]
    """By transition: resource, control and plain places from which others of the same rank take
    tokens, too, so that first come, first served may decide who gets one."""
    devices: Mapping[str, str]
    """By action: the device that it uses."""
    domains: Mapping[str, Domain]
    """The values that names in conditions can have."""
    free: frozenset[str]
    """Variables that no place or transition writes: only the global memory changes them."""
    advancing: frozenset[str]
    """Transitions that take or give a token outside listening branches; resources do not count,
    because such a branch may hold one."""
    firing_limit: int
    """Firings without a stimulus after which the engine gives up (docs/semantics.md, section 6)."""


def compile_task(task: Task, devices: Mapping[str, str]) -> Compiled:
    """Compile a task. Raises ValueError with all faults of an inconsistent one."""
    found = faults(task)
    if found:
        raise ValueError(
            f"task {task.name!r} cannot be executed:\n" + "\n".join(f"  {f}" for f in found)
        )
    flat, net = task.flat, task.net
    transitions = compile_transitions(flat)
    tested = [net.compiled.tested(x.index) for x in transitions]
    touching = tuple(
        tuple(t for t, places in enumerate(tested) if p in places) for p in range(len(net.places))
    )
    return Compiled(
        task=flat,
        net=net,
        transitions=transitions,
        action_places={
            p.name: net.place_index[p.name] for p in flat.places.values() if p.kind is Kind.ACTION
        },
        primitives={
            p.name: _primitive_of(flat, p) for p in flat.places.values() if p.kind is Kind.ACTION
        },
        executed=frozenset(
            p for p in flat.places if any(f"{p}.executed" in _names(t) for t in transitions)
        ),
        copies=_index(
            (net.transition_index[t.name], [t.copy_of])
            for t in flat.transitions.values()
            if t.copy_of != t.name
        ),
        setting=_index(
            (net.transition_index[t.name], dict(t.sets)) for t in flat.transitions.values()
        ),
        touching=touching,
        timed=tuple(tuple(t for t in ts if transitions[t].after is not None) for ts in touching),
        reading=_index((x.index, sorted(x.when.names)) for x in transitions if x.when is not None),
        waiting=_index((net.transition_index[t.name], t.events) for t in flat.transitions.values()),
        kept=frozenset(e.name for e in flat.events.values() if e.early is EarlyEvent.KEEP),
        contested=contested_places(transitions),
        devices=dict(devices),
        domains=condition_domains(flat),
        free=frozenset(flat.variables)
        - {v for p in flat.places.values() for v in p.out.values()}
        - {name for t in flat.transitions.values() for name, _ in t.sets},
        advancing=frozenset(
            t.name
            for t in flat.transitions.values()
            if any(_advances(flat.places[a.place]) for a in t.inputs)
            or any(_advances(flat.places[a.place]) for a in t.outputs)
        ),
        firing_limit=_firing_limit(flat, net),
    )


def _advances(place: Place) -> bool:
    return not place.listen and place.kind is not Kind.RESOURCE


def _primitive_of(flat: Task, place: Place) -> PrimitiveTask:
    primitive = flat.primitive_tasks[place.task]
    if place.timeout is None:
        return primitive
    return replace(primitive, deadline=min(primitive.deadline, place.timeout))


def _names(t: CompiledTransition) -> frozenset[str]:
    return t.when.names if t.when is not None else frozenset()


def _firing_limit(flat: Task, net: Net) -> int:
    """Return how many firings without a stimulus are still plausible. For a net that might fire for
    ever: each transition once with every token of the initial marking and every token that one
    firing makes."""
    if not endless(flat):
        return FIRINGS_OF_A_FINITE_NET
    tokens = sum(net.initial) + sum(weight for arcs in net.produce for _, weight in arcs)
    return min(1_000 + len(net.transitions) * tokens, FIRINGS_OF_A_FINITE_NET)


def contested_places(transitions: Sequence[CompiledTransition]) -> dict[int, frozenset[int]]:
    """Return, by transition, the places for whose tokens it competes with others of its rank, where
    no draw by weight decides."""
    takers: dict[int, list[CompiledTransition]] = {}
    for x in transitions:
        for p, _ in x.plain:
            takers.setdefault(p, []).append(x)

    def compete(x: CompiledTransition, y: CompiledTransition) -> bool:
        drawn = x.weight is not None and y.weight is not None
        return x is not y and not drawn and x.rank == y.rank

    found = {
        x.index: frozenset(p for p, _ in x.plain if any(compete(x, y) for y in takers[p]))
        for x in transitions
        # One that waits for a pulse or a time does not wait for a token.
        if not x.pulse and x.after is None and not x.never
    }
    return {t: places for t, places in found.items() if places}


def _index(pairs: Iterable[tuple[int, Iterable[str]]]) -> dict[str, tuple[int, ...]]:
    table: dict[str, tuple[int, ...]] = {}
    for number, names in pairs:
        for name in names:
            table[name] = (*table.get(name, ()), number)
    return table
