"""A task as the page draws it: places, transitions and arcs with their properties as plain data
(pure functions)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from petrobot.coordinator.task import (
    Event,
    Kind,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Task,
    Transition,
)
from petrobot.coordinator.task.expansion import with_error_branches


def picture(task: Task) -> dict[str, Any]:
    """Return the snapshot's `task`: the flat net (with the names used in markings and firings) and
    its macro places. `made_from` of an element names the short form that it was made from, which is
    drawn instead. An exit that `[errors]` adds has none: it is drawn, as `petrobot show` does it.
    Conditions are those of the file, without what short forms add to them."""
    flat = task.flat
    errors = flat.error_elements
    macros = dict(_macros(task, task.places, ""))
    written = dict(_written(task, ""))
    return {
        "name": task.name,
        "text": task.text,
        "goal": task.goal,
        "runs_place": task.runs_place,
        "parameters": dict(task.parameters),
        "primitive_tasks": {name: _primitive_task(p) for name, p in task.primitive_tasks.items()},
        "events": {name: _event(e) for name, e in task.events.items()},
        "places": [
            *(_place(p, p.name in errors) for p in flat.places.values()),
            *(
                {**_place(p, False), "name": name, "in_macro": around}
                for name, (p, around) in macros.items()
            ),
        ],
        "transitions": [
            _transition(t, written.get(t.name) or _made(t, written), flat, t.name in errors)
            for t in flat.transitions.values()
        ],
        "arcs": [arc for t in flat.transitions.values() for arc in _arcs(t)],
    }


def _macros(
    task: Task, places: Mapping[str, Place], prefix: str
) -> Iterator[tuple[str, tuple[Place, str]]]:
    """Return each macro place by its full name, with the full name of the one around it."""
    for place in places.values():
        if place.kind is Kind.MACRO:
            around = prefix + place.macro if place.macro else prefix.removesuffix(".")
            yield prefix + place.name, (place, around)
            if place.subnet:
                yield from _macros(
                    task, task.subnets[place.subnet].places, f"{prefix}{place.name}."
                )


def _written(net: Task, prefix: str) -> Iterator[tuple[str, Transition]]:
    """Return each transition of the file, and each exit that `[errors]` adds, by its full name."""
    net = with_error_branches(net)
    for t in net.transitions.values():
        yield prefix + t.name, replace(t, expanded_from="")
    for place in net.places.values():
        if place.subnet:
            subnet = net.subnets[place.subnet]
            inner = replace(
                net,
                places=subnet.places,
                transitions=subnet.transitions,
                errors_to=subnet.errors_lead_to,
            )
            yield from _written(inner, f"{prefix}{place.name}.")


def _made(t: Transition, written: Mapping[str, Transition]) -> Transition:
    """Return a transition that a short form adds; a copy (`seen.1`) was made from its original."""
    origin, _, _ = t.name.rpartition(".")
    return replace(t, expanded_from=origin) if origin in written else t


def _place(place: Place, error: bool) -> dict[str, Any]:
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


def _arcs(transition: Transition) -> Iterator[dict[str, Any]]:
    def arc(direction: str, place: str, weight: int, **more: Any) -> dict[str, Any]:
        ends = {"place": place, "transition": transition.name}
        return {**ends, "direction": direction, "weight": weight, **more}

    for one in transition.inputs:
        end, counts = one.end and one.end.value, one.counts and one.counts.value
        yield arc("in", one.place, one.weight, end=end, counts=counts)
    for out in transition.outputs:
        yield arc("out", out.place, out.weight)
    for stop in transition.inhibitors:
        yield arc("inhibit", stop.place, stop.threshold)


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
