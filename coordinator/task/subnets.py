"""Macro places: a net with every macro place replaced by its subnet, names prefixed with the macro
place's.

A macro place without a subnet only shows what is drawn within it (`macro`): that stays as it is,
the place is dropped. In the flat task `macro` of every place and transition is the full name of the
innermost macro place around it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from petrobot.coordinator.conditions import rename
from petrobot.coordinator.task.elements import End, Input, Kind, Output, Place, Subnet, Transition


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
