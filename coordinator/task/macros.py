"""Macro places that only group: which part of a net is drawn within which, and what keeps a group
from being one place.

A macro place has places at its border and transitions at most inside, so that it can be drawn
wherever a place can: each transition within it has all its places within it (or within macro places
inside it).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from petrobot.coordinator.task.elements import Kind, Place, Transition
from petrobot.coordinator.task.wording import Fault, listed, nearest


def macros_around(macro: str, places: Mapping[str, Place]) -> Iterator[str]:
    """The macro places around something that names `macro`, innermost first; ends at a name that is
    unknown or came before."""
    seen: set[str] = set()
    while macro and macro not in seen:
        seen.add(macro)
        yield macro
        macro = places[macro].macro if macro in places else ""


def macro_faults(
    prefix: str, places: Mapping[str, Place], transitions: Mapping[str, Transition]
) -> Iterator[Fault]:
    """What is wrong with the groups of one net, whose keys begin with `prefix`."""
    groups = [p.name for p in places.values() if p.kind is Kind.MACRO and not p.subnet]
    wrong = False
    for kind, elements in (("places", places), ("transitions", transitions)):
        for element in elements.values():
            if element.macro and element.macro not in groups:
                wrong = True
                remedy = (
                    f"name a macro place without subnet{nearest(element.macro, groups)}, "
                    "or drop the key"
                )
                yield Fault(
                    f"{prefix}{kind}.{element.name}.macro",
                    f"{element.macro!r} groups nothing",
                    remedy,
                )
    for name in groups:
        if name in _above(places[name], places):
            wrong = True
            yield Fault(
                f"{prefix}places.{name}.macro", f"{name!r} lies within itself", "break the circle"
            )
    if not wrong:
        for transition in transitions.values():
            yield from _border(f"{prefix}transitions.{transition.name}", transition, places)


def _above(element: Place | Transition, places: Mapping[str, Place]) -> list[str]:
    return list(macros_around(element.macro, places))


def _border(key: str, t: Transition, places: Mapping[str, Place]) -> Iterator[Fault]:
    joined = [
        *(a.place for a in t.inputs),
        *(a.place for a in t.outputs),
        *(a.place for a in t.inhibitors),
    ]
    for name in joined:
        place = places.get(name)
        if place is not None and place.kind is Kind.MACRO and not place.subnet:
            yield Fault(
                key,
                f"an arc with the macro place {name!r}, which only shows what is in it",
                "name a place in it",
            )
    outside = [
        n for n in joined if n in places and t.macro and t.macro not in _above(places[n], places)
    ]
    if outside:
        what = (
            f"it stands in the macro place {t.macro!r}, but {listed(outside)} "
            f"{'do' if len(outside) > 1 else 'does'} not"
        )
        yield Fault(f"{key}.macro", what, "take it out of the macro place, or put them in too")
