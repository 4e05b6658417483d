"""Deadlocks without the full state space: siphons and traps, and a search by stubborn sets.

*Siphons and traps.* A siphon is a set of places that stays empty once it is empty, because every
transition that puts a token into it also takes one out. A trap is a set that stays marked once it
is marked. If every siphon of an ordinary net contains an initially marked trap, no marking is dead
(Commoner's condition; T. Murata, Proc. IEEE 77, 1989, section VI). Arc weights, inhibitors,
capacities and priorities are not considered.

*Stubborn sets.* At each marking the search follows only a stubborn set of transitions. It reaches
every dead marking of the net, usually through far fewer markings. Source: A. Valmari, Stubborn sets
for reduced state space generation, Advances in Petri Nets 1990, LNCS 483 (1991). Whether one
transition can disable another is decided by their arcs alone: it takes tokens that the other needs,
or adds tokens where the other has an inhibitor or a capacity.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from msgspec import Struct

from petrobot.coordinator.analysis.limits import OutOfTime, keep_time, overtime
from petrobot.coordinator.task.net import Arcs, Marking, Net

SIPHON_EFFORT = 5_000
"""Branches after which the enumeration of siphons or traps gives up."""


class PlaceSets(Struct, frozen=True):
    """Minimal sets of places, by place number; all of them if `complete`."""

    sets: tuple[frozenset[int], ...]
    complete: bool


def minimal_siphons(net: Net, effort: int = SIPHON_EFFORT) -> PlaceSets:
    """Return the minimal non-empty siphons found within `effort` branches."""
    return _closed_sets(net, _masks(net, "consume"), _masks(net, "produce"), effort)


def minimal_traps(net: Net) -> PlaceSets:
    """Return the minimal non-empty traps: the siphons of the net with all arcs reversed."""
    return _closed_sets(net, _masks(net, "produce"), _masks(net, "consume"), SIPHON_EFFORT)


def largest_trap(net: Net, within: frozenset[int]) -> frozenset[int]:
    """Return the largest trap inside a set of places (may be empty)."""
    return _largest_closed(within, net.consume, net.produce)


def empty_siphon(net: Net, marking: Marking) -> frozenset[int]:
    """Return the largest siphon without a token in the marking (may be empty).

    Its places can never be marked again.
    """
    unmarked = (p for p, n in enumerate(marking) if not n)
    return _largest_closed(unmarked, net.produce, net.consume)


def _largest_closed(
    places: Iterable[int], arcs: Sequence[Arcs], others: Sequence[Arcs]
) -> frozenset[int]:
    """Return the largest subset of the places in which each transition with one of its `arcs` there
    also has one of its `others` there.

    A trap for (consume, produce), a siphon for (produce, consume).
    """
    inside = set(places)
    while True:
        open_places = {
            p
            for own, back in zip(arcs, others, strict=True)
            if not any(q in inside for q, _ in back)
            for p, _ in own
            if p in inside
        }
        if not open_places:
            return frozenset(inside)
        inside -= open_places


def controlled_siphons(net: Net, found: PlaceSets | None = None) -> bool | None:
    """Return whether every minimal siphon contains an initially marked trap (Commoner's condition).

    None if the search for siphons was cut short. `found` passes minimal siphons that are already
    known. In a net with arc weights of 1 and without inhibitors, capacities and priorities, True
    rules out dead markings.
    """
    found = found or minimal_siphons(net)
    if any(not any(net.initial[p] for p in largest_trap(net, siphon)) for siphon in found.sets):
        return False
    return True if found.complete else None


def _masks(net: Net, arcs: str) -> list[int]:
    return [sum(1 << p for p, _ in of_one) for of_one in getattr(net, arcs)]


def _closed_sets(net: Net, consume: list[int], produce: list[int], effort: int) -> PlaceSets:
    """Return the minimal sets S such that every transition producing into S consumes from S.

    Branch and bound on bit masks: bit p stands for place p. A set grows from its smallest member.
    As long as a transition produces into S without consuming from it, one of its input places must
    be added; each choice is a branch. Inputs tried in earlier branches are banned in later ones, so
    each minimal set is found exactly once, along the branch that adds only its own members.
    """
    found: list[int] = []
    left = effort
    transitions = range(len(consume))
    for start in range(len(net.places)):
        stack = [(1 << start, (1 << start) - 1)]
        while stack:
            inside, banned = stack.pop()
            if any(inside & known == known for known in found):
                continue  # contains a set already found, so it cannot be minimal
            left -= 1
            if left < 0 or overtime():
                return PlaceSets(_minimal(found), False)
            open_ = [t for t in transitions if produce[t] & inside and not consume[t] & inside]
            if not open_:
                found.append(inside)
                continue
            # The transition with the fewest choices first keeps the tree narrow.
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
    kept: list[int] = []
    for one in sorted(found, key=int.bit_count):  # a set can only contain smaller ones
        if not any(one & other == other for other in kept):
            kept.append(one)
    return tuple(frozenset(bit.bit_length() - 1 for bit in _bits(s)) for s in sorted(set(kept)))


HUNT_EFFORT = 100_000
"""Markings after which the search by stubborn sets gives up."""


class Hunt(Struct, frozen=True):
    """Result of a search for a deadlock.

    `firings` lead to a dead marking. If they are None and `complete` is True,
    there is no such marking.
    """

    firings: tuple[str, ...] | None
    states: int
    complete: bool


class _Relations(Struct, frozen=True):
    conflicts: tuple[tuple[int, ...], ...]
    """By transition: the transitions that it can disable or that can disable it."""
    raising: tuple[tuple[int, ...], ...]
    """By place: the transitions that add tokens to it."""
    lowering: tuple[tuple[int, ...], ...]
    """By place: the transitions that remove tokens from it."""
    limits: tuple[dict[int, int], ...]

    @classmethod
    def of(cls, net: Net) -> _Relations:
        count = len(net.transitions)
        limits = tuple(dict(bars) for bars in net.compiled.bars)
        raising: list[list[int]] = [[] for _ in net.places]
        lowering: list[list[int]] = [[] for _ in net.places]
        for t, changes in enumerate(net.compiled.changes):
            for p, change in changes:
                (raising if change > 0 else lowering)[p].append(t)
        conflicts: list[set[int]] = [set() for _ in range(count)]
        for t in range(count):
            keep_time("deadlocks")
            harmful = [lowering[p] for p, _ in net.consume[t]] + [raising[p] for p in limits[t]]
            for u in set().union(*harmful) - {t}:
                conflicts[t].add(u)
                conflicts[u].add(t)
        return cls(
            tuple(tuple(sorted(c)) for c in conflicts),
            tuple(map(tuple, raising)),
            tuple(map(tuple, lowering)),
            limits,
        )


def hunt_deadlock(net: Net, *, effort: int = HUNT_EFFORT) -> Hunt:
    """Search for a dead marking, depth first along stubborn sets.

    In nets with priorities a transition depends on all transitions above it, so no stubborn set
    would be small: these nets are searched in full.
    """
    try:
        relations = _Relations.of(net) if len(set(net.priority)) <= 1 else None
    except OutOfTime:
        return Hunt(None, 0, False)
    seen = {net.initial}
    came: dict[Marking, tuple[Marking, int]] = {}
    stack = [net.initial]
    while stack:
        if overtime():
            return Hunt(None, len(seen), False)
        marking = stack.pop()
        enabled = net.enabled(marking)
        if not enabled:
            return Hunt(_way(net, came, marking), len(seen), True)
        for t in _stubborn(net, relations, marking, enabled) if relations else enabled:
            after = net.fire(marking, t)
            if after not in seen:
                if len(seen) >= effort:
                    return Hunt(None, len(seen), False)
                seen.add(after)
                came[after] = (marking, t)
                stack.append(after)
    return Hunt(None, len(seen), True)


def _way(net: Net, came: dict[Marking, tuple[Marking, int]], marking: Marking) -> tuple[str, ...]:
    names = []
    while marking in came:
        marking, t = came[marking]
        names.append(net.transitions[t])
    return tuple(reversed(names))


def _stubborn(net: Net, relations: _Relations, marking: Marking, enabled: list[int]) -> list[int]:
    """Return the enabled transitions of the smallest stubborn set that contains one of them."""
    best, able = enabled, frozenset(enabled)
    for seed in enabled:
        closed = _closure(net, relations, marking, able, seed, len(best))
        if closed is not None and len(closed) < len(best):
            best = closed
            if len(best) == 1 or overtime():
                break
    return best


def _closure(
    net: Net, relations: _Relations, marking: Marking, able: frozenset[int], seed: int, worst: int
) -> list[int] | None:
    """Return the enabled members of a stubborn set around the seed.

    Two rules close the set: with an enabled transition, all transitions in conflict with it; with a
    disabled one, all transitions of which at least one must fire before it can be enabled. None as
    soon as `worst` enabled members are in it, because a smaller set is already known.
    """
    inside, waiting, members = {seed}, [seed], []
    while waiting:
        t = waiting.pop()
        if t in able:
            members.append(t)
            if len(members) >= worst:
                return None
            needed: tuple[int, ...] = relations.conflicts[t]
        else:
            needed = _reason(net, relations, marking, t, inside)
        for u in needed:
            if u not in inside:
                inside.add(u)
                waiting.append(u)
    return members


def _reason(
    net: Net, relations: _Relations, marking: Marking, t: int, inside: set[int]
) -> tuple[int, ...]:
    """Return transitions of which one must fire before t can be enabled.

    Every unmet requirement of t gives such a set; the one that adds the fewest members is taken.
    """
    choices = [relations.raising[p] for p, w in net.consume[t] if marking[p] < w]
    choices += [relations.lowering[p] for p, k in relations.limits[t].items() if marking[p] >= k]
    return min(choices, key=lambda some: sum(u not in inside for u in some))
