"""Boundedness, liveness, deadlocks, reversibility and home markings of a net.

All verdicts come from one pass over its reachability graph. Liveness levels after T. Murata, Proc.
IEEE 77 (1989), section IV: a transition is L0 (dead) if it never fires, L1 if it can fire, L2 if
for every k some sequence fires it k times, L3 if some infinite sequence fires it infinitely often,
L4 (live) if from every reachable marking some sequence fires it. In a finite graph L2 and L3 are
the same: the transition labels an edge on a cycle.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.coverability import Coverability, coverability, find_pump
from petrobot.coordinator.analysis.net.deadlocks import (
    Hunt,
    controlled_siphons,
    empty_siphon,
    hunt_deadlock,
)
from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.analysis.net.structure import place_bounds
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.task.net import Net

SAFETY = ""
"""No assumption: every marking of the executed task is one of the ordinary net, so what never
happens in the net never happens in execution."""
FAIR = "every awaited event comes at some time, and a run may always end in each of its ways"
"""What liveness and progress of the executed task need of the world."""
HUNT = 10_000
"""Markings that the search for deadlocks may visit if the space is not complete."""
GROUPS = 100
"""The most groups of deadlocks that are reported one by one."""


class Deadlock(Struct, frozen=True):
    """Dead markings with the same marked places: how many, and a shortest path to the nearest."""

    marked: tuple[str, ...]
    count: int
    witness: Witness
    emptied: tuple[str, ...]
    """Places of the largest empty siphon: no firing can ever mark them again."""


class Qualitative(Struct, frozen=True):
    """All verdicts on one net. If the space is not complete, levels, bounds and counts are those
    of the part that was found."""

    space: Space
    bounds: tuple[int | None, ...]
    """Proven upper bounds by place; if the space is complete, they are reached."""
    most: int | None
    """The most tokens that any place ever holds; None if unknown or unbounded."""
    bounded: PropertyVerdict
    safe: PropertyVerdict
    deadlock_free: PropertyVerdict
    deadlocks: tuple[Deadlock, ...]
    dead_markings: int
    """Number of dead markings among those found."""
    quasi_live: PropertyVerdict
    live: PropertyVerdict
    levels: tuple[int | None, ...]
    """Liveness level 0, 1, 3 or 4 of each transition (2 equals 3, see above); None if unknown."""
    reversible: PropertyVerdict
    home_states: int | None
    """Number of markings that can be reached from every reachable marking; None if unknown."""


def examine(
    space: Space, *, cover: Coverability | None = None, in_haste: bool = False
) -> Qualitative:
    """Return all verdicts on the net of a space.

    `cover` passes a coverability result that is already known; otherwise it is computed if the
    space is not complete. `in_haste` leaves out everything that takes long: what a look at each
    marking and edge tells is judged, all else is unknown.
    """
    graph = Graph(len(space), space.source, space.target, space.row, rooted=True)
    if in_haste and cover is None:
        cover = Coverability(None, (None,) * len(space.net.places), space.reason, False)
    bounds, bounded, safe, cover = boundedness(space, cover)
    dead = space.dead
    settled = space.complete or len(dead) or in_haste
    hunt = None if settled else hunt_deadlock(space.net, effort=HUNT)
    levels = _levels(space, None if in_haste else graph, cover)
    return Qualitative(
        space,
        bounds,
        _most(space, bounds),
        bounded,
        safe,
        _deadlock_free(space, dead, hunt),
        _grouped(space, dead) + _hunted(space.net, hunt),
        len(dead),
        _quasi_live(space, levels, cover),
        _live(space, None if in_haste else graph, levels, hunt),
        levels,
        _reversible(space, None if in_haste else graph, hunt),
        None if in_haste else _home_states(space, graph),
    )


def _most(space: Space, bounds: tuple[int | None, ...]) -> int | None:
    """Return the most tokens in any place, if known.

    Known if the space is complete, or if a marking found reaches the highest of the proven bounds.
    """
    if None in bounds:
        return None
    highest = max((b for b in bounds if b is not None), default=0)
    return highest if space.complete or highest == max(space.bounds, default=0) else None


def witness(space: Space, i: int) -> Witness:
    """Return a shortest firing sequence to marking i as a witness."""
    marked = {p: n for p, n in zip(space.net.places, space.marking(i), strict=True) if n}
    return Witness(tuple(space.path(i)), marked)


def _unknown(space: Space, question: str = "") -> PropertyVerdict:
    what = "analysis" if space.complete else "search"
    text = f"unknown: the {what} stopped early ({space.reason})"
    return PropertyVerdict(None, f"{text}; {question}" if question else text, complete=False)


def boundedness(
    space: Space, cover: Coverability | None
) -> tuple[tuple[int | None, ...], PropertyVerdict, PropertyVerdict, Coverability | None]:
    """Return (bounds, bounded, safe, the coverability result that was used, if any).

    The cheapest proof first: the complete space, then invariants and capacities, then the
    coverability tree, then a pump among the markings found.
    """
    if space.complete:
        bounds: tuple[int | None, ...] = space.bounds
        most = max(space.bounds, default=0)
        bounded = PropertyVerdict(
            True,
            f"no place ever holds more than {most} token{'s' * (most != 1)}",
            assumption=SAFETY,
        )
        return bounds, bounded, _safe(space, True), None
    proven = place_bounds(space.net)
    if all(b is not None for b in proven):
        bounded = PropertyVerdict(
            True,
            "bounded by invariants and capacities, although the search stopped early "
            f"({space.reason})",
            assumption=SAFETY,
        )
        return (
            tuple(proven),
            bounded,
            _safe(space, max((b or 0 for b in proven), default=0) <= 1),
            cover,
        )
    cover = cover or coverability(space.net, bounds=proven)
    pump = (cover.prefix, cover.pump, cover.grows) if cover.bounded is False else find_pump(space)
    known = tuple(lower(b, c) for b, c in zip(proven, cover.bounds, strict=True))
    if pump is not None:
        prefix, again, grows = pump
        shown = Witness(prefix, _marked(space.net, prefix), again)
        reason = (
            f"{', '.join(grows)} can grow without bound: {' '.join(again)} can be repeated for ever"
        )
        settled = known if cover.complete else tuple(proven)
        return (
            settled,
            PropertyVerdict(False, reason, shown),
            PropertyVerdict(False, reason, shown),
            cover,
        )
    if cover.bounded:
        bounded = PropertyVerdict(
            True,
            f"bounded by the coverability tree, although the search stopped early ({space.reason})",
            assumption=SAFETY,
        )
        return known, bounded, _safe(space, max((b or 0 for b in known), default=0) <= 1), cover
    return known, _unknown(space, cover.reason), _safe(space, False), cover


def lower(one: int | None, other: int | None) -> int | None:
    """Return the lower of two bounds; None means no bound."""
    return other if one is None else one if other is None else min(one, other)


def _marked(net: Net, firings: tuple[str, ...]) -> dict[str, int]:
    *_, last = net.replay(firings)
    return {p: n for p, n in zip(net.places, last, strict=True) if n}


def _safe(space: Space, proven: bool) -> PropertyVerdict:
    for p, most in enumerate(space.bounds):
        if most > 1:
            tokens = space.tokens(p)
            first = int(np.argmax(tokens > 1))
            reason = f"{space.net.places[p]} can hold {tokens[first]} tokens"
            return PropertyVerdict(False, reason, witness(space, first), complete=space.complete)
    if proven:
        return PropertyVerdict(
            True,
            "no place ever holds more than one token",
            assumption=SAFETY,
            complete=space.complete,
        )
    return _unknown(space)


def _hunted(net: Net, hunt: Hunt | None) -> tuple[Deadlock, ...]:
    """Return the deadlock that the search by stubborn sets found, if any."""
    if hunt is None or hunt.firings is None:
        return ()
    marked = _marked(net, hunt.firings)
    *_, last = net.replay(hunt.firings)
    emptied = tuple(net.places[p] for p in sorted(empty_siphon(net, last)))
    return (Deadlock(tuple(marked), 1, Witness(hunt.firings, marked), emptied),)


def _deadlock_free(space: Space, dead: NDArray[np.int64], hunt: Hunt | None) -> PropertyVerdict:
    if len(dead):
        first = int(dead[0])
        reason = f"nothing can happen any more in {space.net.describe(space.marking(first))}"
        return PropertyVerdict(False, reason, witness(space, first), complete=space.complete)
    for found in _hunted(space.net, hunt):
        reason = (
            f"nothing can happen any more with {', '.join(found.marked) or 'nothing'} "
            "marked (found by stubborn sets)"
        )
        return PropertyVerdict(False, reason, found.witness, complete=False)
    always = _never_barred(space.net)
    if not space.complete and always is not None:
        return PropertyVerdict(
            True,
            f"{always} needs no token and nothing disables it: it can always fire",
            assumption=FAIR,
        )
    if hunt is not None and not hunt.complete and _siphons_suffice(space.net):
        reason = (
            "every siphon contains an initially marked trap, so some transition is always enabled"
        )
        return PropertyVerdict(True, reason, assumption=FAIR)
    if hunt is not None and hunt.complete:
        reason = f"no reachable marking is dead (checked {hunt.states} markings by stubborn sets)"
        return PropertyVerdict(True, reason, assumption=FAIR)
    if not space.complete:
        return _unknown(space, f"no dead marking among the {space.expanded} examined")
    return PropertyVerdict(True, "no reachable marking is dead", assumption=FAIR)


def _never_barred(net: Net) -> str | None:
    """Return a transition that is enabled in every marking unless one of higher priority is."""
    free = (t for t in range(len(net.transitions)) if not net.compiled.tested(t))
    return next((net.transitions[t] for t in free), None)


def _siphons_suffice(net: Net) -> bool:
    """Return whether Commoner's condition rules out dead markings.

    It does so only if all input weights are 1 and there are no inhibitors, capacities or
    priorities.
    """
    plain = (
        not any(net.inhibit)
        and len(set(net.priority)) <= 1
        and all(c is None for c in net.capacity)
    )
    single = all(w == 1 for arcs in net.consume for _, w in arcs)
    return plain and single and bool(net.transitions) and controlled_siphons(net) is True


def _grouped(space: Space, dead: NDArray[np.int64]) -> tuple[Deadlock, ...]:
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, marking in zip(
        dead.tolist(), space.layout.unpack_many(space.words[dead]).tolist(), strict=True
    ):
        groups.setdefault(tuple(n > 0 for n in marking), []).append(i)
    out = []
    for support, members in list(groups.items())[:GROUPS]:
        marking = space.marking(members[0])
        emptied = tuple(space.net.places[p] for p in sorted(empty_siphon(space.net, marking)))
        marked = tuple(p for p, some in zip(space.net.places, support, strict=True) if some)
        out.append(Deadlock(marked, len(members), witness(space, members[0]), emptied))
    return tuple(out)


def _levels(
    space: Space, graph: Graph | None, cover: Coverability | None
) -> tuple[int | None, ...]:
    count = len(space.net.transitions)
    if not space.complete or graph is None:
        never = set(cover.never if cover is not None else ())
        if space.complete:
            never = {space.net.transitions[t] for t in np.flatnonzero(~space.fired)}
        return tuple(0 if name in never else None for name in space.net.transitions)
    if graph.strong:
        return tuple(4 if fired else 0 for fired in space.fired.tolist())
    fired = space.fired
    cyclic = np.bincount(space.label[graph.inner], minlength=count) > 0
    everywhere = np.ones(count, dtype=np.bool_)
    ours = graph.components[space.source]
    for component in np.flatnonzero(graph.bottom).tolist():
        everywhere &= np.bincount(space.label[ours == component], minlength=count) > 0
    return tuple(
        4 if always else 3 if again else 1 if once else 0
        for once, again, always in zip(
            fired.tolist(), cyclic.tolist(), everywhere.tolist(), strict=True
        )
    )


def _quasi_live(
    space: Space, levels: tuple[int | None, ...], cover: Coverability | None
) -> PropertyVerdict:
    fired = space.fired
    if fired.all():
        return PropertyVerdict(
            True, "every transition can fire", assumption=FAIR, complete=space.complete
        )
    idle = [space.net.transitions[t] for t in np.flatnonzero(~fired)]
    dead = [name for name, level in zip(space.net.transitions, levels, strict=True) if level == 0]
    if not space.complete and dead:
        return PropertyVerdict(
            False, f"can never fire: {', '.join(dead)} (by the coverability tree)", complete=False
        )
    if not space.complete and cover is not None and cover.exact:
        return PropertyVerdict(
            True,
            "every transition can fire (by the coverability tree)",
            assumption=FAIR,
            complete=False,
        )
    if not space.complete:
        return _unknown(space, f"not fired so far: {', '.join(idle)}")
    return PropertyVerdict(False, f"can never fire: {', '.join(idle)}")


def _live(
    space: Space, graph: Graph | None, levels: tuple[int | None, ...], hunt: Hunt | None
) -> PropertyVerdict:
    names = space.net.transitions
    for found in _hunted(space.net, hunt):
        return PropertyVerdict(
            False,
            "a dead marking is reachable (found by stubborn sets)",
            found.witness,
            complete=False,
        )
    if len(space.dead) and names:
        first = int(space.dead[0])
        reason = f"nothing can fire any more in {space.net.describe(space.marking(first))}"
        return PropertyVerdict(False, reason, witness(space, first), complete=space.complete)
    useless = [name for name, level in zip(names, levels, strict=True) if level == 0]
    if useless and (not space.complete or graph is None):
        by = "" if space.complete else " (by the coverability tree)"
        return PropertyVerdict(
            False, f"can never fire: {', '.join(useless)}{by}", complete=space.complete
        )
    if not space.complete or graph is None:
        return _unknown(space)
    lost = [t for t, level in enumerate(levels) if level != 4]
    if not lost:
        return PropertyVerdict(
            True, "from every marking every transition can fire again", assumption=FAIR
        )
    ours = graph.components[space.source]
    for component in np.flatnonzero(graph.bottom).tolist():
        fired = np.bincount(space.label[ours == component], minlength=len(names)) > 0
        never = [names[t] for t in lost if not fired[t]]
        if never:
            first = int(np.argmax(graph.components == component))
            reason = (
                f"after {space.net.describe(space.marking(first))} these never fire again: "
                f"{', '.join(never)}"
            )
            return PropertyVerdict(False, reason, witness(space, first))
    raise AssertionError("a transition that is not live is missing in some bottom component")


def _reversible(space: Space, graph: Graph | None, hunt: Hunt | None) -> PropertyVerdict:
    if not space.complete or graph is None:
        for found in _hunted(space.net, hunt):
            if found.witness.firings:
                return PropertyVerdict(
                    False,
                    "a dead marking never returns to the start",
                    found.witness,
                    complete=False,
                )
        stuck = space.dead[space.dead > 0]
        if len(stuck):
            first = int(stuck[0])
            return PropertyVerdict(
                False,
                "a dead marking never returns to the start",
                witness(space, first),
                complete=False,
            )
        return _unknown(space)
    away = np.flatnonzero(~graph.returning)
    if not len(away):
        return PropertyVerdict(
            True, "the initial marking can be reached again from everywhere", assumption=FAIR
        )
    first = int(away[0])
    reason = (
        f"from {space.net.describe(space.marking(first))} the initial marking is never "
        "reached again"
    )
    return PropertyVerdict(False, reason, witness(space, first))


def _home_states(space: Space, graph: Graph) -> int | None:
    if not space.complete:
        return None
    bottoms = np.flatnonzero(graph.bottom)
    return int((graph.components == bottoms[0]).sum()) if len(bottoms) == 1 else 0
