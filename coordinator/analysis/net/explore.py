"""The interface of the exploration engines, the state they share, and the engine of integers."""

from __future__ import annotations

from array import array
from typing import Any, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.pack import Layout, Rules, Test, TooManyTokens, Words
from petrobot.coordinator.task.net import Net

Numbers = NDArray[np.int32]
Labels = NDArray[Any]
"""Transition of each edge: int16, or int32 if the net has 32,768 transitions or more."""


class Explored(Struct, frozen=True):
    """State of a breadth-first search: the markings found, the first `len(row) - 1` expanded."""

    net: Net
    layout: Layout
    keep_edges: bool
    words: Words
    """Packed markings in order of discovery, shape (states, layout.words)."""
    row: NDArray[np.int64]
    """Number of edges before each expanded marking, shape (expanded + 1,)."""
    target: Numbers
    label: Labels

    @classmethod
    def start(cls, net: Net, layout: Layout, keep_edges: bool) -> Explored:
        """Return a search that has found only the initial marking."""
        words = layout.split_many([layout.pack(net.initial)])
        label = np.zeros(0, dtype=np.int16 if len(net.transitions) < 1 << 15 else np.int32)
        return cls(
            net, layout, keep_edges, words, np.zeros(1, np.int64), np.zeros(0, np.int32), label
        )

    def relaid(self, layout: Layout) -> Explored:
        """Return the same search with its markings packed in another layout."""
        words = self.layout.repack(self.words, layout)
        return Explored(self.net, layout, self.keep_edges, words, self.row, self.target, self.label)


class ExplorationEngine(Protocol):
    """Expands markings in order. `explored()` is consistent even after an interruption at any
    point."""

    @property
    def states(self) -> int:
        """Markings found."""

    @property
    def expanded(self) -> int:
        """Markings expanded."""

    @property
    def nbytes(self) -> int:
        """Bytes held, roughly."""

    def expand(self, cap: int | None) -> bool:
        """Expand some more markings; return False when none is left.

        Stop right after the marking whose successors bring the number of states to `cap` or more.
        """

    def explored(self) -> Explored:
        """Return the search so far."""


def widened_layout(layout: Layout, places: list[int]) -> Layout:
    """Return the layout with which to continue after these places overflowed.

    Raises TooManyTokens if a place would need more than 63 bits.
    """
    wider = layout.widened(places)
    if wider == layout:
        raise TooManyTokens(
            "a place holds more tokens than a 64-bit word can count: the net is almost "
            "certainly unbounded"
        )
    return wider


# Exploration with plain integers: no preparation, the fastest engine below about 10,000 markings.

BLOCK = 512
"""Markings expanded between two checks of the limits."""
STATE_BYTES = 250
"""Estimated bytes of one marking: integer, dictionary and list entries, enabled transitions."""


class IntegerEngine:
    """Markings as Python integers in a dictionary, in any number of bits.

    A new marking inherits the enabled transitions of the marking before it; only those that the
    firing touched are tested again.
    """

    def __init__(self, begun: Explored) -> None:
        """Continue a search that any engine began."""
        self._net, self._keep = begun.net, begun.keep_edges
        self._dependents = begun.net.compiled.dependents()
        self._touched = [frozenset(dependents) for dependents in self._dependents]
        self._prioritised = len(set(begun.net.priority)) > 1
        self._row = array("q", begun.row.tolist())
        self._target = array("i", begun.target.tolist())
        self._label = array("i", begun.label.tolist())
        self._label_type = begun.label.dtype
        self._committed = len(begun.words)
        self._use(begun.layout, begun.layout.join_many(begun.words))

    def _use(self, layout: Layout, order: list[int]) -> None:
        """Rebuild everything that depends on the layout."""
        self._layout, self._order = layout, order
        self._index = {packed: i for i, packed in enumerate(order)}
        self._rules = Rules.compiled(self._net, layout)
        self._able = frozenset(self._rules.able)
        self._concession: list[list[int] | None] = [None] * len(order)
        first = [tests[0] if tests else Test(0, 0, 0) for tests in self._rules.tests]
        self._sub = [test.sub for test in first]
        self._guard = [test.guard for test in first]
        self._want = [test.want for test in first]
        self._second = {t: tests[1] for t, tests in enumerate(self._rules.tests) if len(tests) > 1}

    @property
    def states(self) -> int:
        """Markings found."""
        return self._committed

    @property
    def expanded(self) -> int:
        """Markings expanded."""
        return len(self._row) - 1

    @property
    def nbytes(self) -> int:
        """Bytes held, roughly."""
        return STATE_BYTES * len(self._order) + 8 * len(self._target)

    def expand(self, cap: int | None) -> bool:
        """Expand up to BLOCK markings; return False when none is left."""
        for _ in range(BLOCK):
            if self.expanded == self._committed or (cap is not None and self._committed >= cap):
                break
            overflown = self._expand_one(self.expanded)
            if overflown:
                order = self._order[: self._committed]
                wider = widened_layout(self._layout, self._layout.overflown(overflown))
                self._use(wider, [wider.pack(self._layout.unpack(packed)) for packed in order])
        return self.expanded < self._committed

    def _expand_one(self, i: int) -> int:
        """Expand marking i and commit it. Return 0, or the successor in which a field
        overflowed."""
        order, index, guards, delta = (
            self._order,
            self._index,
            self._layout.guards,
            self._rules.delta,
        )
        packed, able = order[i], self._enabled(i)
        targets = []
        for t in self._net.compiled.highest(able) if self._prioritised else able:
            after = packed + delta[t]
            number = index.get(after)
            if number is None:
                if after & guards:
                    # A guard bit is set: a field overflowed. Drop the successors of this marking;
                    # it is expanded again after the layout is widened.
                    self._forget(self._committed)
                    return after
                number = index[after] = len(order)
                order.append(after)
                self._concession.append(self._inherit(able, t, after))
            targets.append((t, number))
        self._concession[i] = None
        self._commit(targets)
        return 0

    def _commit(self, targets: list[tuple[int, int]]) -> None:
        if self._keep:
            self._label.extend([t for t, _ in targets])
            self._target.extend([number for _, number in targets])
        self._committed = len(self._order)
        self._row.append(self._row[-1] + len(targets))

    def _forget(self, states: int) -> None:
        for packed in self._order[states:]:
            del self._index[packed]
        del self._order[states:], self._concession[states:]

    def _enabled(self, i: int) -> list[int]:
        known = self._concession[i]
        return known if known is not None else self._passing(self._rules.able, self._order[i])

    def _inherit(self, before: list[int], fired: int, packed: int) -> list[int]:
        """Return the enabled transitions after a firing; those that it did not touch stay as they
        were."""
        touched = self._touched[fired]
        kept = [t for t in before if t not in touched]
        able = self._able
        gained = self._passing([t for t in self._dependents[fired] if t in able], packed)
        # Sorted, because all engines must give the edges in transition order.
        return sorted(kept + gained) if kept and gained else kept or gained

    def _passing(self, candidates: list[int] | tuple[int, ...], packed: int) -> list[int]:
        """Return the candidates whose tests hold: one subtraction tests all places (see pack.py).

        Almost every transition needs a single test, so a second one is kept apart.
        """
        guarded = packed | self._layout.guards
        sub, guard, want = self._sub, self._guard, self._want
        passing = [t for t in candidates if (guarded - sub[t]) & guard[t] == want[t]]
        if self._second:
            return [
                t for t in passing if t not in self._second or _passes(self._second[t], guarded)
            ]
        return passing

    def explored(self) -> Explored:
        """Return the search so far."""
        edges = self._row[-1] if self._keep else 0
        return Explored(
            self._net,
            self._layout,
            self._keep,
            self._layout.split_many(self._order[: self._committed]),
            np.array(self._row, dtype=np.int64),
            np.array(self._target[:edges], dtype=np.int32),
            np.array(self._label[:edges], dtype=self._label_type),
        )


def _passes(test: Test, guarded: int) -> bool:
    return (guarded - test.sub) & test.guard == test.want
