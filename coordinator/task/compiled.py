"""The firing rule of a net in integers: what each transition needs, what bars it, what it changes.

This is the only place where arcs, inhibitors and capacities become a rule. The engine, the state
space explorers, the simulators and the forecast read these tables; those that play many markings
at once turn them into masks (`analysis/net/pack.py`) or into columns of an array
(`analysis/net/columns.py`). What a task adds (the ends of runs, events, conditions) is in
`compiled_task.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Marking = tuple[int, ...]
"""Tokens by place, in place order."""

Arcs = tuple[tuple[int, int], ...]
"""Pairs (place index, weight), sorted by place, weights >= 1; for inhibitors the weight is the
threshold."""

Changes = tuple[tuple[int, int], ...]
"""Pairs (place index, tokens gained), sorted by place; negative for tokens lost, never 0."""

Thresholds = tuple[tuple[int, int], ...]
"""Pairs (place index, threshold), sorted by place: the place must hold fewer tokens than that."""


@dataclass(frozen=True, slots=True)
class CompiledNet:
    """The firing rule, by transition.

    Transition t has concession in M when M(p) >= w for every (p, w) in `needs[t]` and M(p) < k for
    every (p, k) in `bars[t]`. It is enabled when no transition of higher `priority` has concession
    too. Its firing adds c to M(p) for every (p, c) in `changes[t]`.

    A read arc, which takes a token and gives it back, is a need without a change.
    """

    needs: tuple[Arcs, ...]
    bars: tuple[Thresholds, ...]
    """Inhibitor arcs and capacities in one table. A capacity c bars a transition that gains g > 0
    tokens unless M(p) + g <= c, which is M(p) < c - g + 1. A threshold of 0 or less bars for
    ever."""
    changes: tuple[Changes, ...]
    priority: tuple[int, ...]

    @classmethod
    def of(
        cls,
        consume: Sequence[Arcs],
        produce: Sequence[Arcs],
        inhibit: Sequence[Arcs],
        capacity: Sequence[int | None],
        priority: Sequence[int],
    ) -> CompiledNet:
        """Compile the arcs of a net: one entry for each transition, capacities by place."""
        changes = tuple(map(_changes, consume, produce))
        bars = tuple(
            _bars(own, change, capacity) for own, change in zip(inhibit, changes, strict=True)
        )
        return cls(tuple(consume), bars, changes, tuple(priority))

    def has_concession(self, marking: Sequence[int], t: int) -> bool:
        """Whether tokens, inhibitors and capacities allow transition t; priorities are not
        considered."""
        return all(marking[p] >= w for p, w in self.needs[t]) and all(
            marking[p] < k for p, k in self.bars[t]
        )

    def is_enabled(self, marking: Sequence[int], t: int) -> bool:
        """Whether transition t may fire in the marking."""
        return self.has_concession(marking, t) and not any(
            own > self.priority[t] and self.has_concession(marking, u)
            for u, own in enumerate(self.priority)
        )

    def enabled(self, marking: Sequence[int]) -> list[int]:
        """All transitions that may fire in the marking, in transition order."""
        return self.highest([t for t in range(len(self.needs)) if self.has_concession(marking, t)])

    def highest(self, able: list[int]) -> list[int]:
        """Those of the transitions that have the highest priority among them."""
        top = max((self.priority[t] for t in able), default=0)
        return [t for t in able if self.priority[t] == top]

    def after(self, marking: Sequence[int], t: int) -> Marking:
        """The marking after transition t, which must be enabled."""
        tokens = list(marking)
        for p, change in self.changes[t]:
            tokens[p] += change
        return tuple(tokens)

    def tested(self, t: int) -> frozenset[int]:
        """Places whose tokens decide whether t has concession."""
        return frozenset(p for p, _ in (*self.needs[t], *self.bars[t]))

    def dependents(self) -> list[list[int]]:
        """For each transition, the transitions whose concession its firing can change, in
        transition order."""
        watchers: dict[int, set[int]] = {}
        for t in range(len(self.needs)):
            for p in self.tested(t):
                watchers.setdefault(p, set()).add(t)
        return [
            sorted(set().union(*(watchers.get(p, set()) for p, _ in changes)))
            for changes in self.changes
        ]


def _changes(consume: Arcs, produce: Arcs) -> Changes:
    change = dict(produce)
    for p, w in consume:
        change[p] = change.get(p, 0) - w
    return tuple(sorted((p, c) for p, c in change.items() if c))


def _bars(inhibit: Arcs, changes: Changes, capacity: Sequence[int | None]) -> Thresholds:
    below = dict(inhibit)
    for p, gain in changes:
        limit = capacity[p]
        if gain > 0 and limit is not None:
            below[p] = min(below.get(p, limit - gain + 1), limit - gain + 1)
    return tuple(sorted(below.items()))
