"""A fast hunt for deadlocks: at each marking only a stubborn set of transitions is followed.

Every dead marking of the net is also reached through stubborn sets, mostly along far fewer
markings. Source: A. Valmari, Stubborn sets for reduced state space generation (1991). Whether one
transition can disable another is judged by arcs alone: it takes what the other needs, or gives what
the other's inhibitor or capacity forbids.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from petrobot.coordinator.task.net import Marking, Net

EFFORT = 100_000
"""Markings looked at before giving up."""


@dataclass(frozen=True, slots=True)
class Hunt:
    """`firings` lead to a dead marking that is not final; None with `complete` proves that there is
    none."""

    firings: tuple[str, ...] | None
    states: int
    complete: bool


@dataclass(frozen=True)
class _Relations:
    conflicts: tuple[tuple[int, ...], ...]
    """By transition: those that it can disable or that can disable it."""
    raising: tuple[tuple[int, ...], ...]
    """By place: transitions that add tokens."""
    lowering: tuple[tuple[int, ...], ...]
    limits: tuple[dict[int, int], ...]

    @classmethod
    def of(cls, net: Net) -> _Relations:
        count, places = len(net.transitions), range(len(net.places))
        change = [dict(changes) for changes in net.compiled.changes]
        limits = tuple(dict(bars) for bars in net.compiled.bars)
        raising = tuple(tuple(t for t in range(count) if change[t].get(p, 0) > 0) for p in places)
        lowering = tuple(tuple(t for t in range(count) if change[t].get(p, 0) < 0) for p in places)
        conflicts: list[set[int]] = [set() for _ in range(count)]
        for t in range(count):
            harmful = [lowering[p] for p, _ in net.consume[t]] + [raising[p] for p in limits[t]]
            for u in set().union(*harmful) - {t}:
                conflicts[t].add(u)
                conflicts[u].add(t)
        return cls(tuple(tuple(sorted(c)) for c in conflicts), raising, lowering, limits)


def hunt_deadlock(
    net: Net, *, final: Callable[[Marking], bool] | None = None, effort: int = EFFORT
) -> Hunt:
    """Look for a dead marking that is not final, depth first through stubborn sets.

    Nets with priorities are searched in full, since there a lower transition depends on every
    higher one.
    """
    relations = _Relations.of(net) if len(set(net.priority)) <= 1 else None
    seen = {net.initial}
    came: dict[Marking, tuple[Marking, int]] = {}
    stack = [net.initial]
    while stack:
        marking = stack.pop()
        enabled = net.enabled(marking)
        if not enabled and not (final and final(marking)):
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
    """The enabled transitions of the smallest stubborn set grown from any one of them."""
    best, able = enabled, frozenset(enabled)
    for seed in enabled:
        closed = _closure(net, relations, marking, able, seed, len(best))
        if closed is not None and len(closed) < len(best):
            best = closed
            if len(best) == 1:
                break
    return best


def _closure(
    net: Net, relations: _Relations, marking: Marking, able: frozenset[int], seed: int, worst: int
) -> list[int] | None:
    """Enabled members of a stubborn set that holds the seed; None as soon as there are `worst` of
    them."""
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
    """Transitions of which one must fire before t can be enabled; the choice that adds fewest."""
    choices = [relations.raising[p] for p, w in net.consume[t] if marking[p] < w]
    choices += [relations.lowering[p] for p, k in relations.limits[t].items() if marking[p] >= k]
    return min(choices, key=lambda some: sum(u not in inside for u in some))
