"""Exploration with numpy: blocks of markings, and a vectorised hash table.

A block of markings is tested against every transition at once. Its successors are written behind
the known markings, looked up in a hash table, and only the new ones are kept.

The table maps a slot to the number of a marking. Keys are compared in full, so the search is exact.
Before its bits are mixed, the hash is linear in the words: h(M + d) = h(M) + h(d). What costs here
is not computing but waiting for the memory: the table holds nothing but numbers of 32 bits, so that
it stays in the cache for long, and the growing arrays are moved by pages, not copied.
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
"""What the table holds in a free slot."""
DENSE = 4
"""Pairs of marking and transition per enabled pair up to which all pairs are computed."""
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
        self._edges = int(begun.row[-1])
        self._row = Column(begun.row)
        self._target, self._label = Column(begun.target), Column(begun.label)
        self._degree = max(1.0, self._edges / max(1, self._expanded))
        self._use(begun.layout, begun.words)

    def _use(self, layout: Layout, words: Words) -> None:
        """Rebuild everything that depends on the layout."""
        self._layout = layout
        self._rules = Rules.compiled(self._net, layout)
        self._factors = MULTIPLIERS[: layout.words].copy()
        self._delta_hash = _hash(self._rules.word_delta, self._factors)
        self._keys = [Column(words[:, w].copy()) for w in range(layout.words)]
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
        columns = (*self._keys, self._row, self._target, self._label)
        return self._table.nbytes + sum(c.values.nbytes for c in columns)

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
        able = self._enabled(stop)
        pairs = Pairs(able)
        self._reserve(pairs.count)
        overflown = self._fire(stop, pairs)
        if overflown:
            words = self._words()
            wider = widened_layout(self._layout, overflown)
            self._use(wider, self._layout.repack(words, wider))
            return True
        target = self._intern(stop, pairs)
        self._commit(stop, able, pairs, target, cap)
        return self._expanded < self._states

    def _words(self) -> Words:
        return np.stack([key.values[: self._states] for key in self._keys], axis=1)

    def _enabled(self, stop: int) -> NDArray[np.bool_]:
        """Return which transitions the markings of the block enable, shape (block, transitions)."""
        guarded = [
            key.values[self._expanded : stop] | guard
            for key, guard in zip(self._keys, self._layout.guard_words, strict=True)
        ]
        able = np.zeros((len(self._net.transitions), stop - self._expanded), dtype=np.bool_)
        for t in self._rules.able:
            able[t] = True
            for word, sub, guard, want in self._rules.word_tests[t]:
                able[t] &= ((guarded[word] - sub) & guard) == want
        self._keep_highest(able)
        return np.ascontiguousarray(able.T)

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

    def _fire(self, stop: int, pairs: Pairs) -> list[int]:
        """Write the successors behind the known markings; return the places that overflowed."""
        n, delta = self._states, self._rules.word_delta
        spilt = np.zeros(self._layout.words, dtype=np.uint64)
        for w, key in enumerate(self._keys):
            fresh = pairs.sums(key.values[self._expanded : stop], delta[:, w])
            key.values[n : n + pairs.count] = fresh
            spilt[w] = np.bitwise_or.reduce(fresh, initial=0) & self._layout.guard_words[w]
        if not spilt.any():
            return []
        return self._layout.overflown(self._layout.join_many(spilt[None, :])[0])

    def _intern(self, stop: int, pairs: Pairs) -> Numbers:
        """Return the numbers of the successors that were written behind the known markings.

        New markings are numbered in the order in which they were found, and moved up to follow the
        known ones without a gap.
        """
        n, m = self._states, pairs.count
        if len(self._keys) == 1:
            hashed = self._keys[0].values[n : n + m] * self._factors[0]
        else:
            hashed = pairs.sums(self._hashes(self._expanded, stop), self._delta_hash)
        number, new, slot = self._probe(self._slot(hashed))
        order = np.argsort(new)
        rank = np.zeros(m, dtype=np.int32)
        rank[new[order]] = np.arange(n, n + len(new), dtype=np.int32)
        self._table[slot] = rank[new]
        moved = n + new[order]
        for key_column in self._keys:
            key_column.values[n : n + len(new)] = key_column.values[moved]
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
        n, table, mask = self._states, self._table, len(self._table) - 1
        number = table.take(slot)
        own = [key.values[n : n + len(slot)] for key in self._keys]
        new, taken = [], []
        # Most successors are known and stand where they are looked for first: the first round is
        # for all of them, without an index of who is waiting. -1 looks at a key that is no marking.
        waiting = np.flatnonzero(self._differ(number, own))
        found, slot = number[waiting], slot[waiting]
        own = [key[waiting] for key in own]
        while len(waiting):
            empty = np.flatnonzero(found < 0)
            if len(empty):
                wanted = (n + waiting[empty]).astype(np.int32)
                table[slot[empty[::-1]]] = wanted[::-1]
                found[empty] = table.take(slot[empty])
                won = empty[found[empty] == wanted]
                new.append(waiting[won])
                taken.append(slot[won])
            number[waiting] = found
            lost = np.flatnonzero(self._differ(found, own))
            waiting, slot = waiting[lost], (slot[lost] + 1) & mask
            own = [key[lost] for key in own]
            found = table.take(slot)
        none = np.zeros(0, dtype=np.int64)
        return number, np.concatenate([none, *new]), np.concatenate([none, *taken])

    def _differ(self, number: Numbers, own: list[Words]) -> NDArray[np.bool_]:
        """Return which keys are not those of the markings with these numbers (-1: of none)."""
        differ: NDArray[np.bool_] = number < 0
        for key, mine in zip(self._keys, own, strict=True):
            differ |= key.values.take(number, mode="clip") != mine
        return differ

    def _commit(
        self,
        stop: int,
        able: NDArray[np.bool_],
        pairs: Pairs,
        target: Numbers,
        cap: int | None,
    ) -> None:
        """Append the block to the result, up to the marking whose successors reach the cap."""
        degree = np.count_nonzero(able, axis=1)
        label = pairs.label
        if cap is not None and self._states >= cap and len(target):
            over = int(np.argmax(target >= cap - 1))
            last = int(np.searchsorted(np.cumsum(degree), over, side="right"))
            stop, degree = self._expanded + last + 1, degree[: last + 1]
            cut = int(degree.sum())
            target, label = target[:cut], label[:cut]
            self._states = int(target.max()) + 1
        if self._keep:
            self._target.append(target)
            self._label.append(label)
        self._row.append(self._edges + np.cumsum(degree))  # last: it says how many edges count
        self._edges += len(target)
        self._degree = max(
            1.0, 0.5 * self._degree + 0.5 * len(target) / max(1, stop - self._expanded)
        )
        self._expanded = stop

    def _slot(self, hashed: Words) -> NDArray[np.int64]:
        mixed = hashed ^ (hashed >> np.uint64(32))
        mixed *= MIX
        mixed >>= np.uint64(64 - (len(self._table).bit_length() - 1))
        return mixed.view(np.int64)

    def _hashes(self, start: int, stop: int) -> Words:
        return _hash(
            np.stack([key.values[start:stop] for key in self._keys], axis=1), self._factors
        )

    def _reserve(self, more: int) -> None:
        """Make room for `more` further markings and keep the table at most half full."""
        wanted = self._states + more
        for key in self._keys:
            key.reserve(wanted)
        if 2 * wanted > len(self._table):
            self._grow(wanted)

    def _grow(self, wanted: int) -> None:
        """Build a table for at least that many markings and insert all known ones."""
        self._table = np.full(
            1 << max(12, (4 * wanted - 1).bit_length() - 1), EMPTY, dtype=np.int32
        )
        mask = len(self._table) - 1
        for start in range(0, self._states, SUCCESSORS):
            stop = min(start + SUCCESSORS, self._states)
            waiting = np.arange(start, stop, dtype=np.int32)
            slot = self._slot(self._hashes(start, stop))
            while len(waiting):
                empty = self._table.take(slot) < 0
                self._table[slot[empty]] = waiting[empty]
                lost = self._table.take(slot) != waiting
                waiting, slot = waiting[lost], (slot[lost] + 1) & mask

    def explored(self) -> Explored:
        """Return the search so far."""
        row = self._row.taken()
        edges = int(row[-1]) if self._keep else 0
        words = self._words()
        return Explored(
            self._net,
            self._layout,
            self._keep,
            words,
            row,
            self._target.taken()[:edges],
            self._label.taken()[:edges],
        )


class Column:
    """A growing array. Growing moves pages, not values, where the system can (mremap)."""

    def __init__(self, values: NDArray[Any]) -> None:
        """Begin with a copy of these values."""
        self.values = np.array(values)
        self.length = len(values)

    def reserve(self, wanted: int) -> None:
        """Make room for that many values. No view of the old ones may be in use."""
        if wanted > len(self.values):
            if not self.values.flags.owndata:
                self.values = self.values.copy()
            self.values.resize(max(wanted, int(1.5 * len(self.values)), 1024), refcheck=False)

    def append(self, more: NDArray[Any]) -> None:
        """Add values at the end."""
        self.reserve(self.length + len(more))
        self.values[self.length : self.length + len(more)] = more
        self.length += len(more)

    def taken(self) -> NDArray[Any]:
        """Return the values and give back the room that is left. A column that grows afterwards
        grows a copy."""
        values = self.values
        if values.flags.owndata:
            values.resize(self.length, refcheck=False)
        self.values = values.view()
        return values[: self.length]


class Pairs:
    """The enabled pairs (marking of the block, transition), sorted in that order."""

    def __init__(self, able: NDArray[np.bool_]) -> None:
        """Find the pairs in the matrix `able`."""
        self.shape = able.shape
        self.flat = np.flatnonzero(able)
        self.count = len(self.flat)
        self.dense = able.size <= DENSE * self.count
        self.source = self.flat[:0] if self.dense else self.flat // max(1, able.shape[1])

    @property
    def label(self) -> Labels:
        """The transition of each pair."""
        if self.dense:
            every = np.broadcast_to(np.arange(self.shape[1], dtype=np.int32), self.shape)
            label: Labels = every.ravel().take(self.flat)
        else:
            label = self.flat - self.source * self.shape[1]
        return label

    def sums(self, rows: Words, columns: Words) -> Words:
        """Return rows[marking] + columns[transition] for each pair."""
        if self.dense:
            sums: Words = np.add.outer(rows, columns).ravel().take(self.flat)
            return sums
        parts: Words = rows.take(self.source) + columns.take(self.label)
        return parts


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
