"""The ordinary view with boolean variables kept: complementary places `v=true`, `v=false` (and
`v=none` while not yet written).

A variable may change whenever a place whose runs write it is marked; a transition whose condition
reads boolean variables alone has one case for each assignment that makes it true, with test arcs
from these places. So every executed sequence is still one of this net (it allows a few more: a run
writes at its end only), and safety carries over; with the conditions kept, fewer markings are
reachable than in the plain ordinary net. Conditions that read anything else are dropped, as there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from petrobot.coordinator.task import Task, Transition, Variable, VariableType
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.net import Net

VARIABLES = 8
"""Boolean variables that one condition may read: each doubles its cases."""
VALUES: tuple[bool | None, ...] = (True, False, None)

Weights = dict[str, int]


@dataclass(frozen=True)
class BooleanView:
    """The refined net: its first places are those of the ordinary net; `origin` names the
    transition of each case."""

    net: Net
    origin: Mapping[str, str]


def boolean_view(task: Task) -> BooleanView:
    """The ordinary net of a task with its boolean variables. Raises ValueError if a condition reads
    too many of them."""
    flat, net = task.flat, task.net
    read = set().union(*(t.when.names for t in flat.transitions.values() if t.when is not None))
    kept = {
        v.name: v for v in flat.variables.values() if v.type is VariableType.BOOL and v.name in read
    }
    places = dict(zip(net.places, net.initial, strict=True))
    for v in kept.values():
        places |= {_place(v.name, value): int(value is v.initial) for value in _values(v)}
    arcs: dict[str, tuple[Weights, Weights]] = {}
    inhibit: dict[str, Weights] = {}
    origin: dict[str, str] = {}
    for i, t in enumerate(flat.transitions.values()):
        need = {net.places[p]: w for p, w in net.consume[i]}
        give = {net.places[p]: w for p, w in net.produce[i]}
        for label, looks in _cases(t, kept):
            name = t.name + label
            arcs[name], origin[name] = (need | looks, give | looks), t.name
            inhibit[name] = {net.places[p]: k for p, k in net.inhibit[i]}
    arcs |= dict(_writes(task, kept))
    capacity = {p: c for p, c in zip(net.places, net.capacity, strict=True) if c is not None}
    return BooleanView(Net.build(places, arcs, inhibitors=inhibit, capacity=capacity), origin)


def _place(variable: str, value: bool | None) -> str:
    return f"{variable}={'none' if value is None else str(value).lower()}"


def _values(variable: Variable) -> tuple[bool | None, ...]:
    return VALUES if variable.initial is None else VALUES[:2]


def _cases(t: Transition, kept: Mapping[str, Variable]) -> Iterator[tuple[str, Weights]]:
    """(label, test arcs) of each assignment that makes the condition true; one bare case without
    such a condition."""
    names = sorted(t.when.names) if t.when is not None else []
    if t.when is None or not set(names) <= set(kept):
        yield "", {}
        return
    if len(names) > VARIABLES:
        raise ValueError(
            f"transitions.{t.name}.when: {len(names)} boolean variables; at most {VARIABLES} "
            "are unfolded"
        )
    for values in product(*(_values(kept[name]) for name in names)):
        try:
            true = t.when.holds(dict(zip(names, values, strict=True)))
        except ConditionFault:
            # a variable that was never written gives the condition no truth value: it counts as
            # false
            continue
        if true:
            said = [_place(name, value) for name, value in zip(names, values, strict=True)]
            yield f" [{', '.join(said)}]", dict.fromkeys(said, 1)


def _writes(
    task: Task, kept: Mapping[str, Variable]
) -> Iterator[tuple[str, tuple[Weights, Weights]]]:
    """Changes of a variable while a place whose runs write it is marked."""
    for place in task.flat.places.values():
        for variable in dict.fromkeys(place.out.values()):
            if variable not in kept:
                continue
            for before, after in product(_values(kept[variable]), VALUES[:2]):
                if before is not after:
                    was, now = _place(variable, before), _place(variable, after)
                    yield (
                        f"{place.name} writes {now} over {was}",
                        ({place.name: 1, was: 1}, {place.name: 1, now: 1}),
                    )
