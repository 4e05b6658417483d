"""Macro places that only group: which part of a net is drawn within which, and what keeps a group
from being one place.

A macro place has places at its border and transitions at most inside, so that it can be drawn
wherever a place can: each transition within it has all its places within it (or within macro places
inside it).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from petrobot.coordinator.task.conditions import rename
from petrobot.coordinator.task.elements import End, Input, Kind, Output, Place, Subnet, Transition
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


# Macro places: a net with every macro place replaced by its subnet, names prefixed with the macro place's.


class CircleError(ValueError):
    """A subnet that contains itself; `key` is that of the place, in the task file, by which it
    does."""

    def __init__(self, inside: tuple[str, ...], place: Place) -> None:
        super().__init__(
            f"subnet {place.subnet!r} contains itself by {' > '.join((*inside, place.subnet))}"
        )
        self.key = f"subnets.{inside[-1]}.places.{place.name}.subnet"


@dataclass(frozen=True, slots=True)
class _Flat:
    """What has been unfolded so far, by full name."""

    subnets: Mapping[str, Subnet]
    places: dict[str, Place] = field(default_factory=dict)
    transitions: dict[str, Transition] = field(default_factory=dict)
    entered: dict[str, Subnet] = field(default_factory=dict)
    """The subnet of each macro place."""


def unfolded(
    places: Mapping[str, Place],
    transitions: Mapping[str, Transition],
    subnets: Mapping[str, Subnet],
) -> tuple[dict[str, Place], dict[str, Transition]]:
    """Places and transitions of the flat net.

    Raises CircleError on subnets that contain themselves; other faults are for
    `consistency.faults`.
    """
    flat = _Flat(subnets)
    _unfold(flat, "", places, transitions, ())
    return flat.places, {name: _rewire(t, flat.entered) for name, t in flat.transitions.items()}


def _unfold(
    flat: _Flat,
    prefix: str,
    places: Mapping[str, Place],
    transitions: Mapping[str, Transition],
    inside: tuple[str, ...],
) -> None:
    """Add the places and transitions under a prefix, and those of the macro places among them."""
    for place in places.values():
        name = prefix + place.name
        if place.kind is not Kind.MACRO:
            flat.places[name] = replace(place, name=name, macro=_around(prefix, place.macro))
        if place.kind is not Kind.MACRO or not place.subnet:
            continue
        if place.subnet in inside:
            raise CircleError(inside, place)
        flat.entered[name] = subnet = flat.subnets[place.subnet]
        _unfold(flat, f"{name}.", subnet.places, subnet.transitions, (*inside, place.subnet))
    for transition in transitions.values():
        flat.transitions[prefix + transition.name] = (
            _prefixed(transition, prefix, places) if prefix else transition
        )


def _around(prefix: str, macro: str) -> str:
    """The full name of the innermost macro place around something: the one it names, else the one
    whose subnet it is in."""
    return prefix + macro if macro else prefix.removesuffix(".")


def _prefixed(transition: Transition, prefix: str, siblings: Mapping[str, Place]) -> Transition:
    when = transition.when
    if when is not None:
        when = rename(when, {n: prefix + n for n in when.names if n.rpartition(".")[0] in siblings})
    return replace(
        transition,
        name=prefix + transition.name,
        macro=_around(prefix, transition.macro),
        when=when,
        inputs=tuple(replace(a, place=prefix + a.place) for a in transition.inputs),
        outputs=tuple(replace(a, place=prefix + a.place) for a in transition.outputs),
        inhibitors=tuple(replace(a, place=prefix + a.place) for a in transition.inhibitors),
    )


def _rewire(transition: Transition, entries: Mapping[str, Subnet]) -> Transition:
    """The transition with its arcs to and from macro places bent to the subnets' entry and exit
    places."""
    return replace(
        transition,
        inputs=tuple(_from(a, entries) for a in transition.inputs),
        outputs=tuple(_to(a, entries) for a in transition.outputs),
    )


def _to(arc: Output, entries: Mapping[str, Subnet]) -> Output:
    while arc.place in entries:
        arc = replace(arc, place=f"{arc.place}.{entries[arc.place].entry}")
    return arc


def _from(arc: Input, entries: Mapping[str, Subnet]) -> Input:
    if arc.place not in entries:
        return arc
    subnet = entries[arc.place]
    return replace(
        arc,
        place=f"{arc.place}.{subnet.error if arc.end is End.ERROR else subnet.normal}",
        end=None,
    )
