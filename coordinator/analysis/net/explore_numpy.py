"""Exploration with numpy: blocks of markings, and a vectorised hash table.

A block of markings is tested against every transition at once. Its successors are written behind
the known markings, looked up in a hash table, and only the new ones are kept.

The table maps a slot to the number of a marking. Keys are compared in full, so the search is exact;
words that follow from the others by invariants (`Layout.telling`) are computed for new markings
only. What costs here is not computing but waiting for the memory: successors that equal another
one of their block are found before the large table is asked, the table holds nothing but numbers of
32 bits, so that it stays in the cache for long, and the growing arrays of keys are moved by pages,
not copied.

The successors of a block stand last one first. Of several that claim one slot, numpy's assignment
then keeps the one that was found first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.explore import Explored, Numbers, widened_layout
from petrobot.coordinator.analysis.net.pack import Layout, Rules, Words

SUCCESSORS = 1 << 17
"""Successors aimed at in a block: many of them are equal, but their arrays should stay in the
cache. Arrays of twice this size (2 MiB each) are given back to the system after each block, and
the page faults of the next block cost more than fewer blocks save."""
TESTS = 1 << 22
"""The most pairs of marking and transition that a block tests."""
EMPTY = -1
"""What the table holds in a free slot."""
NEAR = 1 << 19
"""Slots of the table of the successors of one block."""
MULTIPLIERS = (
    np.random.Generator(np.random.PCG64(0x9E3779B97F4A7C15)).integers(1, 1 << 63, 4096, np.uint64)
    * 2
    + 1
)
MIX = np.uint64(0x9E3779B97F4A7C15)


def _at(values: NDArray[Any], index: NDArray[Any]) -> NDArray[Any]:
    """Return the values at these indices, which are in range. numpy, left to itself, checks that in
    a pass of its own, which takes as long as the rest."""
    return values.take(index, mode="clip")


class NumpyEngine:
    """Markings as rows of 64-bit words, expanded in blocks."""

    def __init__(self, begun: Explored) -> None:
        """Continue a search that any engine began."""
        self._net, self._keep = begun.net, begun.keep_edges
        self._shift = max(0, len(self._net.transitions) - 1).bit_length()
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
        self._keys = [Column(words[:, w]) for w in range(layout.words)]
        self._telling = self._keys[: layout.telling]
        self._table = np.full(0, EMPTY, dtype=np.int32)
        self._near = np.zeros(NEAR, dtype=np.int32)
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
        transitions = len(self._net.transitions)
        block = max(1, min(int(SUCCESSORS / self._degree), TESTS // max(1, transitions)))
        if cap is not None:
            block = max(1, min(block, 2 * (cap - self._states)))
        stop = min(self._states, self._expanded + block)
        able = self._enabled(stop)
        degree = able.view(np.uint8).sum(axis=0, dtype=np.int64)
        flat = np.flatnonzero(able.T.ravel())[::-1]
        source = (flat >> self._shift) + self._expanded
        label = flat & ((1 << self._shift) - 1)
        self._reserve(len(label))
        new, telling = label[:0], self._layout.telling
        overflown = self._fire(range(telling), source, label)
        if not overflown:
            target, new = self._intern(len(label))
            overflown = self._fire(
                range(telling, len(self._keys)), _at(source, new), _at(label, new)
            )
        if overflown:
            words = self._words()
            wider = widened_layout(self._layout, overflown)
            self._use(wider, self._layout.repack(words, wider))
            return True
        self._states += len(new)
        self._commit(degree, label[::-1], target[::-1], cap)
        return self._expanded < self._states

    def _words(self) -> Words:
        return np.stack([key.values[: self._states] for key in self._keys], axis=1)

    def _enabled(self, stop: int) -> NDArray[np.bool_]:
        """Return which transitions the markings of the block enable, shape (transitions, filled up
        to a power of two; block)."""
        guarded = [
            key.values[self._expanded : stop] | guard
            for key, guard in zip(self._keys, self._layout.guard_words, strict=True)
        ]
        able = np.zeros((1 << self._shift, stop - self._expanded), dtype=np.bool_)
        for t in self._rules.able:
            able[t] = True
            for word, sub, guard, want in self._rules.word_tests[t]:
                able[t] &= ((guarded[word] - sub) & guard) == want
        self._keep_highest(able)
        return able

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

    def _fire(self, words: range, source: NDArray[np.int64], label: NDArray[np.int64]) -> list[int]:
        """Write some words of the successors behind the known markings; return the places that
        overflowed."""
        n, spilt = self._states, np.zeros(self._layout.words, dtype=np.uint64)
        for w in words:
            key = self._keys[w].values
            fresh = _at(key, source)
            fresh += _at(self._rules.word_delta[:, w], label)
            key[n : n + len(label)] = fresh
            spilt[w] = np.bitwise_or.reduce(fresh, initial=0) & self._layout.guard_words[w]
        if not spilt.any():
            return []
        return self._layout.overflown(self._layout.join_many(spilt[None, :])[0])

    def _intern(self, m: int) -> tuple[Numbers, NDArray[np.int64]]:
        """Return the numbers of the m successors that were written behind the known markings, and
        which of them are new.

        New markings are numbered in the order in which they were found, and moved up to follow the
        known ones without a gap.
        """
        n, every = self._states, np.arange(m, dtype=np.int32)
        slot = self._slots(n, n + m)
        # More than half of the successors equal an earlier one of their block. A table that stays
        # in the cache finds most of these: it holds the first successor that hashes to a slot.
        near = slot & (NEAR - 1)
        self._near[near] = every
        first = _at(self._near, near)
        own = [key.values[n : n + m] for key in self._telling]
        differ = np.zeros(m, dtype=np.bool_)
        for key in own:
            differ |= _at(key, first) != key
        single = np.flatnonzero(differ | (first == every))
        number, new, taken = self._probe(single, _at(slot, single))
        # A few sorted runs, one of each round, which a stable sort merges fast.
        order = np.argsort(new, kind="stable")[::-1]
        new = _at(new, order)
        rank = np.empty(m, dtype=np.int32)
        rank[new] = np.arange(n, n + len(new), dtype=np.int32)
        self._table[_at(taken, order)] = _at(rank, new)
        for key in own:
            key[: len(new)] = _at(key, new)
        fresh = np.flatnonzero(number >= n)
        number[fresh] = _at(rank, _at(number, fresh) - n)
        rank[single] = number
        target = _at(rank, first)
        target[single] = number
        return target, new

    def _probe(
        self, waiting: NDArray[np.int64], slot: NDArray[np.int64]
    ) -> tuple[Numbers, NDArray[np.int64], NDArray[np.int64]]:
        """Find or claim a table slot for each of these successors.

        Return (number of each one, which successors are new, their slots). Probing in rounds: every
        successor that is still waiting looks one slot further on, then two, three, and so on.
        Successor k counts as marking n + k until it is known to be new. If several want the same
        empty slot, the one that was found first gets it. Equal successors probe the same slots in
        the same rounds, so the first of them becomes the new marking.
        """
        n, table, mask = self._states, self._table, len(self._table) - 1
        number, at = np.empty(len(waiting), dtype=np.int32), np.arange(len(waiting))
        own = [_at(key.values[n:], waiting) for key in self._telling]
        new, taken, step = [waiting[:0]], [slot[:0]], 0
        while len(waiting):
            step += 1
            found = _at(table, slot)
            empty = np.flatnonzero(found < 0)
            if len(empty):
                free, wanted = _at(slot, empty), (n + _at(waiting, empty)).astype(np.int32)
                table[free] = wanted
                got = _at(table, free)
                found[empty] = got
                won = np.flatnonzero(got == wanted)
                new.append(_at(waiting, _at(empty, won)))
                taken.append(_at(free, won))
            number[at] = found
            differ = np.zeros(len(found), dtype=np.bool_)
            for key, mine in zip(self._telling, own, strict=True):
                differ |= _at(key.values, found) != mine
            lost = np.flatnonzero(differ)
            at, waiting, slot = _at(at, lost), _at(waiting, lost), (_at(slot, lost) + step) & mask
            own = [_at(key, lost) for key in own]
        return number, np.concatenate(new), np.concatenate(taken)

    def _commit(
        self, degree: NDArray[np.int64], label: NDArray[np.int64], target: Numbers, cap: int | None
    ) -> None:
        """Append the block to the result, up to the marking whose successors reach the cap."""
        if cap is not None and self._states >= cap and len(target):
            over = int(np.argmax(target >= cap - 1))
            last = int(np.searchsorted(np.cumsum(degree), over, side="right"))
            degree = degree[: last + 1]
            cut = int(degree.sum())
            target, label = target[:cut], label[:cut]
            self._states = int(target.max()) + 1
        if self._keep:
            self._target.append(target)
            self._label.append(label)
        self._row.append(self._edges + np.cumsum(degree))  # last: it says how many edges count
        self._edges += len(target)
        self._degree = max(1.0, 0.5 * self._degree + 0.5 * len(target) / max(1, len(degree)))
        self._expanded += len(degree)

    def _slots(self, start: int, stop: int) -> NDArray[np.int64]:
        """Return the slots at which the table looks first for the keys of these numbers."""
        hashed = np.zeros(stop - start, dtype=np.uint64)
        for key, factor in zip(self._telling, MULTIPLIERS, strict=False):
            hashed += key.values[start:stop] * factor
        hashed ^= hashed >> np.uint64(32)
        hashed *= MIX
        hashed >>= np.uint64(64 - (len(self._table).bit_length() - 1))
        return hashed.view(np.int64)

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
            slot, step = self._slots(start, stop), 0
            while len(waiting):
                step += 1
                empty = np.flatnonzero(_at(self._table, slot) < 0)
                self._table[_at(slot, empty)] = _at(waiting, empty)
                lost = np.flatnonzero(_at(self._table, slot) != waiting)
                waiting, slot = _at(waiting, lost), (_at(slot, lost) + step) & mask

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
    """A growing array. Growing moves pages, not values, where the system can (mremap), so it grows
    by little: numpy fills the new room with zeros, which costs more than moving."""

    def __init__(self, values: NDArray[Any]) -> None:
        """Begin with a copy of these values."""
        self.values = np.array(values)
        self.length = len(values)

    def reserve(self, wanted: int) -> None:
        """Make room for that many values. No view of the old ones may be in use."""
        if wanted > len(self.values):
            if not self.values.flags.owndata:
                self.values = self.values.copy()
            self.values.resize(max(wanted, len(self.values) * 9 // 8, 1024), refcheck=False)

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
