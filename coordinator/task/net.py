"""An ordinary Petri net with weighted arcs, inhibitor arcs, capacities and priorities, and its
firing rule in integers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property

from msgspec import Struct

# --- the firing rule ---
# What each transition needs, what bars it, what it changes.
#
# This is the only place where arcs, inhibitors and capacities become a rule. The engine, the state
# space explorers, the simulators and the forecast read these tables; those that play many markings
# at once turn them into masks or columns of an array (`analysis/net/pack.py`). What a task adds
# (the ends of runs, events, conditions) is in `compiled_task.py`.

Marking = tuple[int, ...]
"""Tokens by place, in place order."""

Arcs = tuple[tuple[int, int], ...]
"""Pairs (place index, weight), sorted by place, weights >= 1; for inhibitors the weight is the
threshold."""

Changes = tuple[tuple[int, int], ...]
"""Pairs (place index, tokens gained), sorted by place; negative for tokens lost, never 0."""

Thresholds = tuple[tuple[int, int], ...]
"""Pairs (place index, threshold), sorted by place: the place must hold fewer tokens than that."""


class CompiledNet(Struct, frozen=True):
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


# --- the net ---


class NotEnabled(Exception):  # noqa: N818 - a fact about a marking that callers may ask for
    """A transition was to fire in a marking that does not enable it."""


EMPTY = "(empty)"
"""A marking without tokens, in words."""


class Net(Struct, frozen=True, dict=True):
    """An immutable net (P, T, Pre, Post, Inhibit, M0, capacities, priorities).

    `consume[t]`, `produce[t]`, `inhibit[t]` are the arcs of transition t. A transition is enabled
    in M when M(p) >= w for every consumed (p, w), M(p) < k for every inhibitor (p, k), no place
    that gains tokens would exceed its capacity, and no transition of higher `priority` is enabled
    (ISO/IEC 15909-1 for the firing rule; priorities as in GSPN). `compiled` is that rule in tables.
    """

    places: tuple[str, ...]
    transitions: tuple[str, ...]
    consume: tuple[Arcs, ...]
    produce: tuple[Arcs, ...]
    inhibit: tuple[Arcs, ...]
    initial: Marking
    capacity: tuple[int | None, ...]
    priority: tuple[int, ...]
    counters: frozenset[str] = frozenset()
    """Places that a short form adds to count (`grip.left`): a text shows them only while their
    tokens differ from the initial ones."""

    def __post_init__(self) -> None:
        """Raises ValueError for a malformed net."""
        for what, names in (("place", self.places), ("transition", self.transitions)):
            if len(set(names)) != len(names):
                twice = sorted({n for n in names if names.count(n) > 1})
                raise ValueError(f"{what} named twice: {', '.join(twice)}")
        n, m = len(self.places), len(self.transitions)
        if not len(self.initial) == len(self.capacity) == n:
            raise ValueError("initial marking and capacities need one entry for each place")
        if (
            not len(self.consume)
            == len(self.produce)
            == len(self.inhibit)
            == len(self.priority)
            == m
        ):
            raise ValueError("arcs and priorities need one entry for each transition")
        for arcs in (*self.consume, *self.produce, *self.inhibit):
            if any(not 0 <= p < n or w < 1 for p, w in arcs) or len({p for p, _ in arcs}) != len(
                arcs
            ):
                raise ValueError(
                    "an arc names an unknown place, names it twice or has a weight below 1"
                )

    @cached_property
    def compiled(self) -> CompiledNet:
        """The firing rule."""
        return CompiledNet.of(
            self.consume, self.produce, self.inhibit, self.capacity, self.priority
        )

    @cached_property
    def place_index(self) -> Mapping[str, int]:
        """Index of each place."""
        return {p: i for i, p in enumerate(self.places)}

    @cached_property
    def transition_index(self) -> Mapping[str, int]:
        """Index of each transition."""
        return {t: i for i, t in enumerate(self.transitions)}

    @classmethod
    def build(
        cls,
        places: Mapping[str, int],
        transitions: Mapping[str, tuple[Mapping[str, int], Mapping[str, int]]],
        *,
        inhibitors: Mapping[str, Mapping[str, int]] | None = None,
        capacity: Mapping[str, int] | None = None,
        priority: Mapping[str, int] | None = None,
        counters: frozenset[str] = frozenset(),
    ) -> Net:
        """Return a net from names: initial tokens of each place, and for each transition the
        weights (consumed, produced) by place."""
        index = {p: i for i, p in enumerate(places)}
        inhibitors, capacity, priority = inhibitors or {}, capacity or {}, priority or {}

        def arcs(weights: Mapping[str, int]) -> Arcs:
            unknown = [p for p in weights if p not in index]
            if unknown:
                raise ValueError(f"an arc names the unknown place {unknown[0]!r}")
            return tuple(sorted((index[p], w) for p, w in weights.items()))

        return cls(
            tuple(places),
            tuple(transitions),
            tuple(arcs(pre) for pre, _ in transitions.values()),
            tuple(arcs(post) for _, post in transitions.values()),
            tuple(arcs(inhibitors.get(t, {})) for t in transitions),
            tuple(places.values()),
            tuple(capacity.get(p) for p in places),
            tuple(priority.get(t, 0) for t in transitions),
            counters,
        )

    def has_concession(self, marking: Marking, t: int) -> bool:
        """Whether tokens, inhibitors and capacities allow transition t; priorities are not
        considered."""
        return self.compiled.has_concession(marking, t)

    def is_enabled(self, marking: Marking, t: int) -> bool:
        """Whether transition t may fire in the marking."""
        return self.compiled.is_enabled(marking, t)

    def enabled(self, marking: Marking) -> list[int]:
        """Return the transitions that may fire in the marking, in transition order."""
        return self.compiled.enabled(marking)

    def fire(self, marking: Marking, t: int) -> Marking:
        """Return the marking after transition t. Raises NotEnabled."""
        if not self.is_enabled(marking, t):
            raise NotEnabled(f"{self.transitions[t]} is not enabled in {self.describe(marking)}")
        return self.compiled.after(marking, t)

    def replay(self, firings: Iterable[str], marking: Marking | None = None) -> Iterator[Marking]:
        """Yield the markings along a sequence of transition names, beginning with the given or the
        initial one."""
        current = self.initial if marking is None else marking
        yield current
        for name in firings:
            current = self.fire(current, self.transition_index[name])
            yield current

    def describe(self, marking: Marking, told: Mapping[str, str] | None = None) -> str:
        """Return the marking as text: the marked places with their tokens, and of counters those
        that have counted. `told` are the texts of places of which more is known."""
        words = dict(told or {})
        for p, n, initial in zip(self.places, marking, self.initial, strict=True):
            if (n != initial) if p in self.counters else n:
                words.setdefault(p, f"{p}:{n}" if n != 1 else p)
        return " ".join(words[p] for p in self.places if p in words) or EMPTY
