"""The engine that numba compiles: one loop over markings and an open-addressed hash table.

Without numba the same code runs in Python: same results, but slow. Only space.py imports this file,
and only when the engine "numba" is requested, so that numba stays optional.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.explore import Explored, Labels, Numbers, widened_layout
from petrobot.coordinator.analysis.net.explore_numpy import EMPTY, MULTIPLIERS, joined
from petrobot.coordinator.analysis.net.pack import Layout, Rules, Words
from petrobot.services.host.numba_kernels import kernel

DONE, FULL, CROWDED, OVERFLOWN, CAPPED = 0, 1, 2, 3, 4
"""Why the loop returned: block expanded, edge buffer full, keys or table crowded, a field
overflowed, cap reached."""


class Kernel(NamedTuple):
    """The compiled firing rules as plain arrays.

    The tests of transition t are those with first[t] <= k < first[t + 1].
    """

    able: NDArray[np.int64]
    priority: NDArray[np.int64]
    first: NDArray[np.int64]
    word: NDArray[np.int64]
    sub: Words
    guard: Words
    want: Words
    delta: Words
    guards: Words

    @classmethod
    def of(cls, rules: Rules) -> Kernel:
        """Return the arrays of the compiled rules."""
        tests = rules.word_tests
        flat = [test for of_one in tests for test in of_one]
        return cls(
            np.array(rules.able, dtype=np.int64),
            np.array(rules.net.priority, dtype=np.int64),
            np.cumsum([0, *map(len, tests)], dtype=np.int64),
            np.array([word for word, _, _, _ in flat], dtype=np.int64),
            np.array([sub for _, sub, _, _ in flat], dtype=np.uint64),
            np.array([guard for _, _, guard, _ in flat], dtype=np.uint64),
            np.array([want for _, _, _, want in flat], dtype=np.uint64),
            rules.word_delta,
            rules.layout.guard_words,
        )


@kernel
def enabled_into(
    key: Words,
    able: NDArray[np.int64],
    priority: NDArray[np.int64],
    first: NDArray[np.int64],
    word: NDArray[np.int64],
    sub: Words,
    guard: Words,
    want: Words,
    guards: Words,
    out: NDArray[np.int64],
) -> int:
    """Write the enabled transitions of a packed marking to `out`; return how many there are."""
    count, top = 0, 0
    for t in able:
        if count and priority[t] < top:
            continue
        passes = True
        for k in range(first[t], first[t + 1]):
            w = word[k]
            if (((key[w] | guards[w]) - sub[k]) & guard[k]) != want[k]:
                passes = False
                break
        if passes:
            if count == 0 or priority[t] > top:
                count, top = 0, priority[t]
            out[count] = t
            count += 1
    return count


@kernel
def enter_all(keys: Words, states: int, table: NDArray[np.int32], factors: Words) -> None:
    """Insert the first `states` keys, which are all different, into an empty table.

    Multiply-and-shift hashing with linear probing; the table is at most half full. Each word is
    multiplied by an odd constant, and the high bits are folded into the low ones.
    """
    mask, words = np.uint64(len(table) - 1), keys.shape[1]
    for number in range(states):
        hashed = np.uint64(0)
        for w in range(words):
            hashed = hashed + keys[number, w] * factors[w]
            hashed = hashed ^ (hashed >> np.uint64(32))
        slot = np.int64((hashed * factors[words] >> np.uint64(20)) & mask)
        while table[slot] >= 0:
            slot = (slot + 1) & np.int64(mask)
        table[slot] = number


@kernel
def expand_block(
    keys: Words,
    table: NDArray[np.int32],
    factors: Words,
    kernel: Any,
    expanded: int,
    states: int,
    stop: int,
    cap: int,
    row: NDArray[np.int64],
    target: NDArray[np.int32],
    label: Any,
) -> tuple[int, int, int, int]:
    """Expand markings up to number `stop`.

    Return (why it returned, expanded, states, edges written). `row[i]` receives the number of edges
    of the i-th marking of the block. After OVERFLOWN, row `states` of `keys` holds the marking that
    did not fit.
    """
    able, priority, first, word, sub, guard, want, delta, guards = kernel
    out = np.empty(len(able) + 1, dtype=np.int64)
    begin, edges, room = expanded, 0, len(target) - len(able)
    most = min(len(keys) - 1, len(table) // 2) - len(able)
    mask, words = np.uint64(len(table) - 1), keys.shape[1]
    while expanded < stop:
        if states >= cap:
            return CAPPED, expanded, states, edges
        if edges > room or states > most:
            return FULL if edges > room else CROWDED, expanded, states, edges
        count = enabled_into(
            keys[expanded], able, priority, first, word, sub, guard, want, guards, out
        )
        before = states
        for j in range(count):
            t, spilt, hashed = out[j], np.uint64(0), np.uint64(0)
            for w in range(words):
                key = keys[expanded, w] + delta[t, w]
                keys[states, w] = key
                spilt |= key & guards[w]
                hashed = hashed + key * factors[w]
                hashed = hashed ^ (hashed >> np.uint64(32))
            if spilt != 0:
                keys[before] = keys[states]
                return OVERFLOWN, expanded, before, edges
            # The lookup stands here instead of in a helper: a compiled call would count the
            # references of its arrays every time.
            slot = np.int64((hashed * factors[words] >> np.uint64(20)) & mask)
            number = np.int64(table[slot])
            while number >= 0:
                w = 0
                while w < words and keys[number, w] == keys[states, w]:
                    w += 1
                if w == words:
                    break
                slot = (slot + 1) & np.int64(mask)
                number = np.int64(table[slot])
            if number < 0:
                number, table[slot] = np.int64(states), states
                states += 1
            target[edges + j] = number
            label[edges + j] = t
        row[expanded - begin] = count
        edges += count
        expanded += 1
    return DONE, expanded, states, edges


# The engine around the compiled loop (numba is an optional extra): for many millions of markings.

BLOCK = 1 << 16
"""Markings expanded between two checks of the limits."""
BUFFER = 1 << 20
"""Edges that the loop writes before it returns them."""


class NumbaEngine:
    """Markings as rows of 64-bit words in a hash table, expanded one by one by compiled code."""

    def __init__(self, begun: Explored) -> None:
        """Continue a search that any engine began."""
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
        """Make room for that many markings, plus those that one firing of each transition adds."""
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
        """Expand a block of markings; return False when none is left."""
        stop = min(self._states, self._expanded + BLOCK)
        row = np.zeros(stop - self._expanded, dtype=np.int64)
        with np.errstate(over="ignore"):
            why, expanded, states, edges = expand_block(
                self._keys,
                self._table,
                self._factors,
                self._kernel,
                self._expanded,
                self._states,
                stop,
                cap if cap is not None else 1 << 62,
                row,
                self._target,
                self._label,
            )
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
        """Return the search so far."""
        row = np.concatenate(self._rows)
        edges = int(row[-1]) if self._keep else 0
        target, label = joined(self._targets, edges), joined(self._labels, edges)
        words = self._keys[: self._states].copy()
        return Explored(self._net, self._layout, self._keep, words, row, target, label)
