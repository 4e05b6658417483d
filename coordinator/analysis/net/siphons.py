"""Minimal siphons and traps by branch and bound on bit sets.

A siphon is a set of places that, once empty, stays empty: whatever puts a token in also takes one
out. A trap is a set that, once marked, stays marked. Arc weights, inhibitors, capacities and
priorities do not enter.
"""

from __future__ import annotations

from dataclasses import dataclass

from petrobot.coordinator.task.net import Marking, Net

EFFORT = 5_000
"""Branches looked at before the enumeration gives up."""


@dataclass(frozen=True, slots=True)
class PlaceSets:
    """Minimal sets of places; all of them if `complete`."""

    sets: tuple[frozenset[int], ...]
    complete: bool


def minimal_siphons(net: Net, effort: int = EFFORT) -> PlaceSets:
    """All minimal non-empty siphons, as far as the effort goes."""
    return _closed_sets(net, _masks(net, "consume"), _masks(net, "produce"), effort)


def minimal_traps(net: Net, effort: int = EFFORT) -> PlaceSets:
    """All minimal non-empty traps: siphons of the net with all arcs turned round."""
    return _closed_sets(net, _masks(net, "produce"), _masks(net, "consume"), effort)


def largest_trap(net: Net, within: frozenset[int]) -> frozenset[int]:
    """The largest trap inside a set of places (may be empty)."""
    inside = set(within)
    while True:
        leaks = {
            p
            for arcs, back in zip(net.consume, net.produce, strict=True)
            if not any(q in inside for q, _ in back)
            for p, _ in arcs
            if p in inside
        }
        if not leaks:
            return frozenset(inside)
        inside -= leaks


def empty_siphon(net: Net, marking: Marking) -> frozenset[int]:
    """The largest siphon without a token in the marking (may be empty): its places can never be
    marked again."""
    inside = {p for p, n in enumerate(marking) if not n}
    while True:
        fed = {
            p
            for arcs, source in zip(net.produce, net.consume, strict=True)
            if not any(q in inside for q, _ in source)
            for p, _ in arcs
            if p in inside
        }
        if not fed:
            return frozenset(inside)
        inside -= fed


def controlled_siphons(
    net: Net, effort: int = EFFORT, found: PlaceSets | None = None
) -> bool | None:
    """Whether every minimal siphon contains a trap marked initially (Commoner's condition); None if
    effort ran out.

    `found` are its minimal siphons if they are at hand. In a net with weight-1 arcs, without
    inhibitors, capacities and priorities, that rules out a dead marking.
    """
    found = found or minimal_siphons(net, effort)
    if any(not any(net.initial[p] for p in largest_trap(net, siphon)) for siphon in found.sets):
        return False
    return True if found.complete else None


def _masks(net: Net, arcs: str) -> list[int]:
    return [sum(1 << p for p, _ in of_one) for of_one in getattr(net, arcs)]


def _closed_sets(net: Net, consume: list[int], produce: list[int], effort: int) -> PlaceSets:
    """Sets S with: whatever produces into S consumes from S. Grown place by place from the smallest
    member on.

    A branch adds one of the inputs of a transition that still feeds S freely; inputs tried before
    stay out, so each minimal set is met once, along the branch that only adds its own members.
    """
    found: list[int] = []
    left = effort
    transitions = range(len(consume))
    for start in range(len(net.places)):
        stack = [(1 << start, (1 << start) - 1)]
        while stack:
            inside, banned = stack.pop()
            if any(inside & known == known for known in found):
                continue
            left -= 1
            if left < 0:
                return PlaceSets(_minimal(found), False)
            open_ = [t for t in transitions if produce[t] & inside and not consume[t] & inside]
            if not open_:
                found.append(inside)
                continue
            t = min(open_, key=lambda t: (consume[t] & ~banned).bit_count())
            for bit in _bits(consume[t] & ~banned):
                stack.append((inside | bit, banned))
                banned |= bit
    return PlaceSets(_minimal(found), True)


def _bits(mask: int) -> list[int]:
    bits = []
    while mask:
        bits.append(mask & -mask)
        mask &= mask - 1
    return bits


def _minimal(found: list[int]) -> tuple[frozenset[int], ...]:
    kept = [s for s in found if not any(other != s and s & other == other for other in found)]
    return tuple(frozenset(bit.bit_length() - 1 for bit in _bits(s)) for s in sorted(set(kept)))
