"""Exploration by the compiled kernel (numba is an extra, never required): for spaces of many
millions of markings."""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.analysis.explore import Explored, Labels, Numbers, widened_layout
from petrobot.coordinator.analysis.explore_kernel import (
    CAPPED,
    CROWDED,
    OVERFLOWN,
    Kernel,
    enter_all,
    expand_block,
)
from petrobot.coordinator.analysis.explore_numpy import EMPTY, MULTIPLIERS, joined
from petrobot.coordinator.analysis.pack import Layout, Rules, Words

BLOCK = 1 << 16
"""Markings expanded between two looks at the limits."""
BUFFER = 1 << 20
"""Edges that the kernel writes before it hands them over."""


class NumbaEngine:
    """Markings as rows of 64-bit words in an open hash table, expanded one by one by compiled
    code."""

    def __init__(self, begun: Explored) -> None:
        """Go on from a search begun in any engine."""
        self._net, self._keep = begun.net, begun.keep_edges
        self._states, self._expanded, self._edges = (
            len(begun.words),
            len(begun.row) - 1,
            int(begun.row[-1]),
        )
        self._rows = [begun.row]
        self._targets: list[Numbers] = [begun.target]
        self._labels: list[Labels] = [begun.label]
        self._held = 0
        room = BUFFER + 2 * len(begun.net.transitions)
        self._target = np.empty(room, dtype=np.int32)
        self._label = np.empty(room, dtype=begun.label.dtype)
        self._use(begun.layout, begun.words)

    def _use(self, layout: Layout, words: Words) -> None:
        """(Re)build everything that depends on the layout."""
        self._layout = layout
        self._kernel = Kernel.of(Rules.compiled(self._net, layout))
        self._factors = MULTIPLIERS[: layout.words + 1].copy()
        self._keys = words
        self._grow(2 * len(words) + 1024)

    def _grow(self, wanted: int) -> None:
        """Room for that many markings, and for those that one firing of each transition adds."""
        wanted += len(self._net.transitions) + 1
        keys = np.empty((wanted, self._layout.words), dtype=np.uint64)
        keys[: self._states] = self._keys[: self._states]
        self._keys = keys
        self._table = np.full(1 << max(12, (2 * wanted).bit_length()), EMPTY, dtype=np.int32)
        with np.errstate(over="ignore"):
            enter_all(self._keys, self._states, self._table, self._factors)

    @property
    def states(self) -> int:
        """Markings found."""
        return self._states

    @property
    def expanded(self) -> int:
        """Markings expanded."""
        return self._expanded

    @property
    def nbytes(self) -> int:
        """Bytes held, roughly."""
        return self._keys.nbytes + self._table.nbytes + self._held

    def expand(self, cap: int | None) -> bool:
        """Expand a block of markings; False when none is left."""
        stop = min(self._states, self._expanded + BLOCK)
        row = np.zeros(stop - self._expanded, dtype=np.int64)
        with np.errstate(over="ignore"):
            why, expanded, states, edges = expand_block(
                self._keys, self._table, self._factors, self._kernel, self._expanded, self._states, stop,
                cap if cap is not None else 1 << 62, row, self._target, self._label,
            )  # fmt: skip
        offending = self._keys[states].copy() if why == OVERFLOWN else None
        row = self._edges + np.cumsum(row[: expanded - self._expanded])
        if self._keep:
            self._targets.append(self._target[:edges].copy())
            self._labels.append(self._label[:edges].copy())
        self._rows.append(row)
        self._held += row.nbytes + 6 * edges
        self._edges += edges
        self._expanded, self._states = expanded, states
        if offending is not None:
            self._widen(offending)
        elif why == CROWDED:
            self._grow(2 * self._states + 1024)
        return self._expanded < self._states and why != CAPPED

    def _widen(self, offending: Words) -> None:
        words, old = self._keys[: self._states].copy(), self._layout
        wider = widened_layout(old, old.overflown(old.join_many(offending[None, :])[0]))
        self._use(wider, old.repack(words, wider))

    def explored(self) -> Explored:
        """The search so far."""
        row = np.concatenate(self._rows)
        edges = int(row[-1]) if self._keep else 0
        target, label = joined(self._targets, edges), joined(self._labels, edges)
        words = self._keys[: self._states].copy()
        return Explored(self._net, self._layout, self._keep, words, row, target, label)
