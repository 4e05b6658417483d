"""An ordinary Petri net with weighted arcs, inhibitor arcs, capacities and priorities."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from petrobot.coordinator.task.compiled import Arcs as Arcs
from petrobot.coordinator.task.compiled import CompiledNet
from petrobot.coordinator.task.compiled import Marking as Marking


class NotEnabled(Exception):  # noqa: N818 - a fact about a marking that callers may ask for
    """A transition was to fire in a marking that does not enable it."""


EMPTY = "(empty)"
"""A marking without tokens, in words."""


@dataclass(frozen=True, slots=True)
class Net:
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
    counters: frozenset[str] = field(default=frozenset(), compare=False)
    """Places that a short form adds to count (`grip.left`): a text shows them only while their
    tokens differ from the initial ones."""
    compiled: CompiledNet = field(init=False, repr=False, compare=False)
    place_index: Mapping[str, int] = field(init=False, repr=False, compare=False)
    transition_index: Mapping[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Compile the firing rule. Raises ValueError for a malformed net."""
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
        compiled = CompiledNet.of(
            self.consume, self.produce, self.inhibit, self.capacity, self.priority
        )
        object.__setattr__(self, "compiled", compiled)
        object.__setattr__(self, "place_index", {p: i for i, p in enumerate(self.places)})
        object.__setattr__(self, "transition_index", {t: i for i, t in enumerate(self.transitions)})

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
