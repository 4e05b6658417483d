"""Nets of other tools as the text of a task file, to go on drawing: names, marking, weights,
inhibitors and positions; pure."""

from __future__ import annotations

import re

import tomlkit

from petrobot.coordinator.analysis.netfile import NetFile
from petrobot.coordinator.task import Kind

_NOT_NAME = re.compile(r"\W+")


def as_task_file(model: NetFile) -> str:
    """Its places are control places, to be given their meaning by drawing on; `final` is never true
    until it is written."""
    names = usable_names(model)
    document = tomlkit.document()
    document.add("schema", tomlkit.item(1))
    document.add(
        "task", tomlkit.item({"name": _free(model.name or "imported", set()), "final": "false"})
    )
    places, transitions = tomlkit.table(is_super_table=True), tomlkit.table(is_super_table=True)
    net = model.net
    for place, tokens, capacity in zip(net.places, net.initial, net.capacity, strict=True):
        own = {"tokens": tokens} if tokens else {}
        most = {} if capacity is None else {"capacity": capacity}
        places.add(
            names[place],
            tomlkit.item({"kind": Kind.CONTROL.value, **own, **most, **_position(model, place)}),
        )
    for t, name in enumerate(net.transitions):
        takes = [_arc(names[net.places[p]], w) for p, w in net.consume[t]]
        takes += [f"!{_arc(names[net.places[p]], w)}" for p, w in net.inhibit[t]]
        gives = [_arc(names[net.places[p]], w) for p, w in net.produce[t]]
        first = {"priority": net.priority[t]} if net.priority[t] else {}
        fields = {"in": takes, "out": gives, **first, **_position(model, name)}
        transitions.add(names[name], tomlkit.item(fields))
    document.add("places", places)
    document.add("transitions", transitions)
    return tomlkit.dumps(document)


def usable_names(model: NetFile) -> dict[str, str]:
    """For each id of the file a name that a task file may hold: its label made usable, kept apart
    from all others."""
    taken: set[str] = set()
    return {
        i: _free(model.labels.get(i) or i, taken)
        for i in (*model.net.places, *model.net.transitions)
    }


def _arc(place: str, weight: int) -> str:
    return f"{place}*{weight}" if weight > 1 else place


def _position(model: NetFile, name: str) -> dict[str, int]:
    where = model.positions.get(name)
    return {} if where is None else {"x": round(where[0]), "y": round(where[1])}


def _free(label: str, taken: set[str]) -> str:
    stem = _NOT_NAME.sub("_", label.strip()).strip("_") or "element"
    if stem[0].isdigit():
        stem = f"n{stem}"
    name, n = stem, 2
    while name in taken:
        name, n = f"{stem}_{n}", n + 1
    taken.add(name)
    return name
