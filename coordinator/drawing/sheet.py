"""Which part of a task is drawn: the whole with its macro places closed, or the inside of one of
them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from petrobot.coordinator.net import Marking
from petrobot.coordinator.task import Kind, Place, Task, Transition
from petrobot.coordinator.task.macros import macros_around


@dataclass(frozen=True, slots=True)
class Sheet:
    """One level of a task. `task` is the net that it is part of: the task itself, or one with a
    subnet's net."""

    task: Task
    places: Mapping[str, Place]
    transitions: Mapping[str, Transition]
    border: frozenset[str]
    """Transitions around the opened macro place: drawn to show where tokens come from and go to."""
    folded: frozenset[str]
    """Elements of the net that are not drawn because only error branches reach them."""
    shown: Mapping[str, str]
    """What each place of the net is drawn as, here: itself or the macro place around it."""
    tokens: Mapping[str, int]
    prefix: str = ""
    """What stands before the net's names in the flat task."""


def sheet_of(task: Task, inside: str, error_branches: bool, marking: Marking | None) -> Sheet:
    """The sheet of a macro place, named as in the flat task (`fetch.grasp`), or of the whole for
    "". Raises ValueError."""
    net, prefix, group = _opened(task, inside)
    shown = dict(_shown(net, group))
    folded = frozenset() if error_branches else _folded(net)
    inner = {t for t in net.transitions.values() if t.macro == group}
    border = {
        t
        for t in net.transitions.values()
        if t not in inner and not set(_joined(t)).isdisjoint(shown)
    }
    outside = frozenset(
        t.name for t in border if group and group not in macros_around(t.macro, net.places)
    )
    return Sheet(
        task=net,
        places={n: net.places[n] for n in dict.fromkeys(shown.values()) if n not in folded},
        transitions={
            n: t
            for n, t in net.transitions.items()
            if (t in inner or n in outside) and n not in folded
        },
        border=outside,
        folded=folded,
        shown=shown,
        tokens=_tokens(task, marking, prefix, shown),
        prefix=prefix,
    )


def _opened(task: Task, inside: str) -> tuple[Task, str, str]:
    """The net that a macro place opens, the prefix of its names in the flat task, and the group in
    it ("" for all of it)."""
    net, prefix, group = task, "", ""
    for part in inside.split(".") if inside else ():
        place = net.places.get(part)
        if place is None or place.kind is not Kind.MACRO or group:
            known = ", ".join(n for n, p in net.places.items() if p.kind is Kind.MACRO)
            raise ValueError(f"{task.name} has no macro place {inside!r}: {known or 'none'} there")
        if place.subnet:
            subnet = task.subnets[place.subnet]
            net, prefix = (
                replace(task, places=subnet.places, transitions=subnet.transitions),
                f"{prefix}{part}.",
            )
        else:
            group = part
    return net, prefix, group


def _shown(net: Task, group: str) -> Iterator[tuple[str, str]]:
    """What each place within the group is drawn as on the group's sheet."""
    for place in net.places.values():
        around = [place.name, *macros_around(place.macro, net.places)]
        if not group:
            yield place.name, around[-1]
        elif group in around[1:]:
            yield place.name, around[around.index(group) - 1]


def _joined(t: Transition) -> Iterable[str]:
    return (
        *(a.place for a in t.inputs),
        *(a.place for a in t.outputs),
        *(a.place for a in t.inhibitors),
    )


def _folded(net: Task) -> frozenset[str]:
    """Error branches, the places that nothing else touches, and the macro places that hold nothing
    else."""
    hidden = set(net.error_elements)
    touched: dict[str, list[bool]] = {}
    for t in net.transitions.values():
        for name in _joined(t):
            touched.setdefault(name, []).append(t.name in hidden)
    hidden |= {place for place, by in touched.items() if all(by)}
    held: dict[str, list[bool]] = {}
    elements: list[Place | Transition] = [*net.places.values(), *net.transitions.values()]
    for element in elements:
        if not (isinstance(element, Place) and element.kind is Kind.MACRO):
            for macro in macros_around(element.macro, net.places):
                held.setdefault(macro, []).append(element.name in hidden)
    return frozenset(hidden | {macro for macro, inside in held.items() if all(inside)})


def _tokens(
    task: Task, marking: Marking | None, prefix: str, shown: Mapping[str, str]
) -> dict[str, int]:
    """Tokens by drawn place; a macro place shows those of all places inside it."""
    tokens: dict[str, int] = {}
    for name, n in zip(task.net.places, marking or task.net.initial, strict=True):
        here = (
            shown.get(name.removeprefix(prefix).partition(".")[0])
            if name.startswith(prefix)
            else None
        )
        if here is not None:
            tokens[here] = tokens.get(here, 0) + n
    return tokens
