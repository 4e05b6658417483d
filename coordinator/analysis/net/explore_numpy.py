"""Exploration with numpy: blocks of markings, and a vectorised hash table.

A block of markings is tested against every transition at once. Its successors are written behind
the known markings, looked up in a hash table, and only the new ones are kept.

The table maps a slot to the number of a marking. Keys are compared in full, so the search is exact.
Before its bits are mixed, the hash is linear in the words: h(M + d) = h(M) + h(d). The hash of a
successor therefore costs one addition.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.explore import Explored, Labels, Numbers, widened_layout
from petrobot.coordinator.analysis.net.pack import Layout, Rules, Words

SUCCESSORS = 1 << 17
"""Successors aimed at in a block: enough to hide the interpreter, few enough for the cache."""
TESTS = 1 << 22
"""The most pairs of marking and transition that a block tests."""
EMPTY = -1
MULTIPLIERS = (
    np.random.Generator(np.random.PCG64(0x9E3779B97F4A7C15)).integers(1, 1 << 63, 4096, np.uint64)
    * 2
    + 1
)
MIX = np.uint64(0x9E3779B97F4A7C15)


class NumpyEngine:
    """Markings as rows of 64-bit words, expanded in blocks."""

    def __init__(self, begun: Explored) -> None:
        """Continue a search that any engine began."""
        self._net, self._keep = begun.net, begun.keep_edges
        self._states, self._expanded = len(begun.words), len(begun.row) - 1
        self._rows = [begun.row]
        self._targets: list[Numbers] = [begun.target]
        self._labels: list[Labels] = [begun.label]
        self._edges = int(begun.row[-1])
        self._held = 0
        self._degree = max(1.0, self._edges / max(1, self._expanded))
        self._use(begun.layout, begun.words)

    def _use(self, layout: Layout, words: Words) -> None:
        """Rebuild everything that depends on the layout."""
        self._layout = layout
        self._rules = Rules.compiled(self._net, layout)
        self._factors = MULTIPLIERS[: layout.words].copy()
        self._delta_hash = _hash(self._rules.word_delta, self._factors)
        self._keys = np.empty((max(1024, 2 * len(words)), layout.words), dtype=np.uint64)
        self._keys[: len(words)] = words
        self._table = np.full(0, EMPTY, dtype=np.int32)
        self._grow(len(words))

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
        """Expand a block of markings; return False when none is left."""
        if self._expanded == self._states or (cap is not None and self._states >= cap):
            return self._expanded < self._states
        block = max(
            1, min(int(SUCCESSORS / self._degree), TESTS // max(1, len(self._net.transitions)))
        )
        if cap is not None:
            block = max(1, min(block, 2 * (cap - self._states)))
        stop = min(self._states, self._expanded + block)
        source, label = self._enabled(self._keys[self._expanded : stop])
        self._reserve(len(source))
        overflown = self._fire(source, label)
        if overflown:
            words = self._keys[: self._states].copy()
            wider = widened_layout(self._layout, overflown)
            self._use(wider, self._layout.repack(words, wider))
            return True
        target = self._intern(source, label)
        self._commit(stop, source, label, target, cap)
        return self._expanded < self._states

    def _enabled(self, words: Words) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the enabled pairs (marking in the block, transition), sorted in that order."""
        guarded = np.ascontiguousarray((words | self._layout.guard_words).T)
        able = np.zeros((len(self._net.transitions), len(words)), dtype=np.bool_)
        for t in self._rules.able:
            able[t] = True
            for word, sub, guard, want in self._rules.word_tests[t]:
                able[t] &= ((guarded[word] - sub) & guard) == want
        self._keep_highest(able)
        source, label = np.nonzero(np.ascontiguousarray(able.T))
        return source, label

    def _keep_highest(self, able: NDArray[np.bool_]) -> None:
        """Disable transitions in markings where one of a higher priority is enabled."""
        if len(self._rules.higher) < 2:
            return
        beaten = np.zeros(able.shape[1], dtype=np.bool_)
        for group in self._rules.higher:
            some = able[list(group)].any(axis=0)
            for t in group:
                able[t] &= ~beaten
            beaten |= some

    def _fire(self, source: NDArray[np.int64], label: NDArray[np.int64]) -> list[int]:
        """Write the successors behind the known markings; return the places that overflowed."""
        n, m, delta = self._states, len(source), self._rules.word_delta
        fresh = self._keys[n : n + m]
        np.take(self._keys[self._expanded :], source, axis=0, out=fresh, mode="clip")
        for w in range(self._layout.words):
            fresh[:, w] += delta[:, w].take(label)
        spilt = (
            np.bitwise_or.reduce(fresh, axis=0) & self._layout.guard_words
            if m
            else np.zeros(1, np.uint64)
        )
        return (
            self._layout.overflown(self._layout.join_many(spilt[None, :])[0]) if spilt.any() else []
        )

    def _intern(self, source: NDArray[np.int64], label: NDArray[np.int64]) -> Numbers:
        """Return the numbers of the successors that were written behind the known markings.

        New markings are numbered in the order in which they were found, and moved up to follow the
        known ones without a gap.
        """
        n, m = self._states, len(source)
        base = _hash(
            self._keys[self._expanded : self._expanded + (int(source[-1]) + 1 if m else 0)],
            self._factors,
        )
        number, new, slot = self._probe(
            self._slot(base.take(source) + self._delta_hash.take(label))
        )
        order = np.argsort(new)
        rank = np.zeros(m, dtype=np.int32)
        rank[new[order]] = np.arange(n, n + len(new), dtype=np.int32)
        self._table[slot] = rank[new]
        self._keys[n : n + len(new)] = self._keys[n + new[order]]
        fresh = np.flatnonzero(number >= n)
        number[fresh] = rank[number[fresh] - n]
        self._states = n + len(new)
        return number

    def _probe(
        self, slot: NDArray[np.int64]
    ) -> tuple[Numbers, NDArray[np.int64], NDArray[np.int64]]:
        """Find or claim a table slot for each successor.

        Return (number of each successor, which successors are new, their slots). Linear probing in
        rounds: every successor that is still waiting looks at its next slot. Successor k counts as
        marking n + k until it is known to be new. If several want the same empty slot, the first
        one gets it (assignment in reversed order, since numpy keeps the last). Equal successors
        probe the same slots in the same rounds, so the first of them becomes the new marking.
        """
        number = self._table.take(slot)
        new, taken = [], []
        own = np.arange(self._states, self._states + len(slot))
        waiting, found, wanted = own - self._states, number, own
        while len(waiting):
            empty = np.flatnonzero(found < 0)
            if len(empty):
                self._table[slot[empty[::-1]]] = wanted[empty[::-1]]
                found[empty] = self._table.take(slot[empty])
                won = empty[found[empty] == wanted[empty]]
                new.append(waiting[won])
                taken.append(slot[won])
            if found is not number:
                number[waiting] = found
            lost = np.flatnonzero(self._differ(found, wanted))
            waiting, wanted = waiting[lost], wanted[lost]
            slot = (slot[lost] + 1) & (len(self._table) - 1)
            found = self._table.take(slot)
        none = np.zeros(0, dtype=np.int64)
        return number, np.concatenate([none, *new]), np.concatenate([none, *taken])

    def _differ(self, one: Numbers, other: NDArray[np.int64]) -> NDArray[np.bool_]:
        first, second = self._keys.take(one, axis=0), self._keys.take(other, axis=0)
        differ: NDArray[np.bool_] = first[:, 0] != second[:, 0]
        for w in range(1, self._layout.words):
            differ |= first[:, w] != second[:, w]
        return differ

    def _commit(
        self,
        stop: int,
        source: NDArray[np.int64],
        label: NDArray[np.int64],
        target: Numbers,
        cap: int | None,
    ) -> None:
        """Append the block to the result, up to the marking whose successors reach the cap."""
        if cap is not None and self._states >= cap and len(target):
            over = int(np.argmax(target >= cap - 1))
            last = int(source[over])
            stop = self._expanded + last + 1
            cut = int(np.searchsorted(source, last, side="right"))
            source, label, target = source[:cut], label[:cut], target[:cut]
            self._states = int(target.max()) + 1
            self._grow(self._states)
        counts = np.bincount(source, minlength=stop - self._expanded)
        row = self._edges + np.cumsum(counts, dtype=np.int64)
        if self._keep:
            self._targets.append(target)
            self._labels.append(label.astype(self._labels[0].dtype))
        self._rows.append(row)
        self._held += row.nbytes + (6 * len(target) if self._keep else 0)
        self._edges += len(source)
        self._degree = max(
            1.0, 0.5 * self._degree + 0.5 * len(source) / max(1, stop - self._expanded)
        )
        self._expanded = stop

    def _slot(self, hashed: Words) -> NDArray[np.int64]:
        mixed = (hashed ^ (hashed >> np.uint64(32))) * MIX
        return (mixed >> np.uint64(64 - (len(self._table).bit_length() - 1))).astype(np.int64)

    def _reserve(self, more: int) -> None:
        """Make room for `more` further rows and keep the table at most half full."""
        wanted = self._states + more
        if wanted > len(self._keys):
            keys = np.empty(
                (max(wanted, int(1.5 * len(self._keys))), self._layout.words), dtype=np.uint64
            )
            keys[: self._states] = self._keys[: self._states]
            self._keys = keys
        if 2 * wanted > len(self._table):
            self._grow(wanted)

    def _grow(self, wanted: int) -> None:
        """Build a table for at least that many markings and insert all known ones."""
        self._table = np.full(
            1 << max(12, (4 * wanted - 1).bit_length() - 1), EMPTY, dtype=np.int32
        )
        mask = len(self._table) - 1
        for start in range(0, self._states, SUCCESSORS):
            waiting = np.arange(start, min(start + SUCCESSORS, self._states), dtype=np.int32)
            slot = self._slot(_hash(self._keys[start : start + len(waiting)], self._factors))
            while len(waiting):
                empty = self._table.take(slot) < 0
                self._table[slot[empty]] = waiting[empty]
                lost = self._table.take(slot) != waiting
                waiting, slot = waiting[lost], (slot[lost] + 1) & mask

    def explored(self) -> Explored:
        """Return the search so far."""
        row = np.concatenate(self._rows)
        edges = int(row[-1]) if self._keep else 0
        target, label = joined(self._targets, edges), joined(self._labels, edges)
        words = self._keys[: self._states].copy()
        return Explored(self._net, self._layout, self._keep, words, row, target, label)


def joined(parts: list[NDArray[Any]], length: int) -> NDArray[Any]:
    """Return the parts one after the other, cut to a length.

    Each part is released as soon as it is copied, so the peak memory is about one copy.
    """
    whole = np.empty(length, dtype=parts[0].dtype)
    at = 0
    parts.reverse()
    while parts:
        part = parts.pop()
        kept = part[: length - at]
        whole[at : at + len(kept)] = kept
        at += len(kept)
    parts.append(whole)
    return whole


def _hash(words: Words, factors: Words) -> Words:
    hashed: Words = words[:, 0] * factors[0]
    for w in range(1, words.shape[1]):
        hashed += words[:, w] * factors[w]
    return hashed
