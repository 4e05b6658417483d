"""A task as the page draws it: places, transitions and arcs with their properties as plain data
(pure functions)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from msgspec.structs import replace

from petrobot.coordinator.task import (
    Event,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Task,
    Transition,
)
from petrobot.coordinator.task.expansion import net_inside, with_error_branches


def picture(task: Task) -> dict[str, Any]:
    """Return the snapshot's `task`: the flat net (with the names used in markings and firings) and
    its macro places.

    What short forms add is not drawn: elements with `made_from` (the element that they were made
    from) and arcs with `made`. Instead, `in_short` is written at the place. An exit that `[errors]`
    adds is drawn, as `petrobot show` does it. Conditions are those of the file, without what short
    forms add to them."""
    flat = task.flat
    errors = flat.error_elements
    nets = list(_nets(with_error_branches(task), ""))
    places = {prefix + p.name: (p, prefix) for prefix, net in nets for p in net.places.values()}
    written = {
        prefix + t.name: replace(t, expanded_from="")
        for prefix, net in nets
        for t in net.transitions.values()
    }
    originals = {
        name: written.get(name) or _made(t, written) for name, t in flat.transitions.items()
    }
    return {
        "name": task.name,
        "text": task.text,
        "goal": task.goal,
        "runs_place": task.runs_place,
        "parameters": dict(task.parameters),
        "primitive_tasks": {name: _primitive_task(p) for name, p in task.primitive_tasks.items()},
        "events": {name: _event(e) for name, e in task.events.items()},
        "places": [
            *(
                {
                    **_place(flat.places.get(name, p), task.in_short(p), name in errors),
                    "name": name,
                    "in_macro": prefix + p.macro if p.macro else prefix.removesuffix("."),
                }
                for name, (p, prefix) in places.items()
            ),
            *(_place(p, "", False) for name, p in flat.places.items() if name not in places),
        ],
        "transitions": [
            _transition(t, originals[t.name], flat, t.name in errors)
            for t in flat.transitions.values()
        ],
        "arcs": [arc for t in flat.transitions.values() for arc in _arcs(t, originals[t.name])],
    }


def _nets(net: Task, prefix: str) -> Iterator[tuple[str, Task]]:
    """Yield a net and those of its macro places, each with the prefix of its names."""
    yield prefix, net
    for place in net.places.values():
        if place.subnet:
            yield from _nets(net_inside(net, place), f"{prefix}{place.name}.")


def _made(t: Transition, written: Mapping[str, Transition]) -> Transition:
    """Return a transition that a short form adds; a copy (`seen.1`) was made from its original."""
    origin, _, _ = t.name.rpartition(".")
    return replace(t, expanded_from=origin) if origin in written else t


def _place(place: Place, in_short: str, error: bool) -> dict[str, Any]:
    return {
        "name": place.name,
        "kind": place.kind.value,
        "label": place.label,
        "in_macro": place.macro,
        "made_from": place.expanded_from,
        "x": place.x,
        "y": place.y,
        "tokens": place.tokens,
        "capacity": place.capacity,
        "servers": place.servers,
        "in_short": in_short,
        "primitive_task": place.task,
        "subnet": place.subnet,
        "args": {
            k: f"${v.variable}" if isinstance(v, Reference) else v for k, v in place.args.items()
        },
        "error": error,
    }


def _transition(
    transition: Transition, written: Transition, task: Task, error: bool
) -> dict[str, Any]:
    return {
        "name": transition.name,
        "label": transition.label,
        "in_macro": transition.macro,
        "made_from": written.expanded_from,
        "x": transition.x,
        "y": transition.y,
        "events": [_event_words(e, task) for e in transition.events],
        "when": str(written.when) if written.when is not None else "",
        "priority": transition.priority,
        "weight": transition.weight,
        "after": transition.after,
        "error": error,
    }


def _event_words(name: str, task: Task) -> dict[str, str]:
    event = task.events.get(name)
    return {"name": name, "scope": event.scope.value if event else Scope.EXTERNAL.value}


def _arcs(transition: Transition, written: Transition) -> Iterator[dict[str, Any]]:
    """Return the arcs: those of the file come first, then those that short forms add."""

    def arc(direction: str, place: str, weight: int, made: bool, **more: Any) -> dict[str, Any]:
        ends = {"place": place, "transition": transition.name}
        return {**ends, "direction": direction, "weight": weight, "made": made, **more}

    for i, one in enumerate(transition.inputs):
        made = i >= len(written.inputs)
        # an arc out of a macro place begins, unfolded, at a place of its subnet
        macro_end = None if made or one.end is not None else written.inputs[i].end
        yield arc(
            "in", one.place, one.weight, made, end=one.end, counts=one.counts, macro_end=macro_end
        )
    for i, out in enumerate(transition.outputs):
        yield arc("out", out.place, out.weight, i >= len(written.outputs))
    for i, stop in enumerate(transition.inhibitors):
        yield arc("inhibit", stop.place, stop.threshold, i >= len(written.inhibitors))


def _primitive_task(task: PrimitiveTask) -> dict[str, Any]:
    return {
        "goal": task.goal,
        "specification": task.specification,
        "alternatives": list(task.alternatives),
        "deadline": task.deadline,
        "target_reliability": task.target_reliability,
        "error_causes": dict(task.error_causes),
    }


def _event(event: Event) -> dict[str, Any]:
    return {
        "scope": event.scope.value,
        "memory": event.memory.value,
        "by": event.by,
        "text": event.text,
    }
