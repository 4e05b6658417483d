"""The ordinary net of a task with its boolean variables kept as complementary places.

A variable v becomes the places `v=true`, `v=false`, and `v=none` while it is not yet written;
exactly one of them holds a token. Its value may change whenever a place whose runs write it is
marked. A transition whose condition reads only boolean variables gets one case for each assignment
that makes the condition true, with test arcs from these places. Conditions that read anything else
are dropped, as in the plain ordinary net.

Every executed firing sequence is one of this net, so safety properties carry over to execution. The
net allows some more sequences (a real run writes only when it ends), but fewer than the ordinary
net without conditions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from petrobot.coordinator.task import Task, Transition, Variable, VariableType
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.net import Net

VARIABLES = 8
"""The most boolean variables that one condition may read: each of them doubles its cases."""
VALUES: tuple[bool | None, ...] = (True, False, None)

Weights = dict[str, int]


@dataclass(frozen=True)
class BooleanView:
    """The refined net. Its first places are those of the ordinary net, in the same order; `origin`
    maps each case to the transition of the task."""

    net: Net
    origin: Mapping[str, str]


def boolean_view(task: Task) -> BooleanView:
    """Return the ordinary net of a task with its boolean variables as places.

    Raises ValueError if a condition reads more than VARIABLES of them.
    """
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
    """Yield (label, test arcs) for each assignment that makes the condition true.

    Without a condition on boolean variables alone there is one case without test arcs.
    """
    names = sorted(t.when.names) if t.when is not None else []
    if t.when is None or not set(names) <= set(kept):
        yield "", {}
        return
    if len(names) > VARIABLES:
        raise ValueError(
            f"transitions.{t.name}.when: expected at most {VARIABLES} boolean variables, "
            f"got {len(names)}; split the condition"
        )
    for values in product(*(_values(kept[name]) for name in names)):
        try:
            true = t.when.holds(dict(zip(names, values, strict=True)))
        except ConditionFault:
            # A variable that was never written leaves the condition without a truth value. The
            # engine treats that as false, and so does this net.
            continue
        if true:
            said = [_place(name, value) for name, value in zip(names, values, strict=True)]
            yield f" [{', '.join(said)}]", dict.fromkeys(said, 1)


def _writes(
    task: Task, kept: Mapping[str, Variable]
) -> Iterator[tuple[str, tuple[Weights, Weights]]]:
    """Yield one transition for each change of a variable, enabled while a writing place is
    marked."""
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
