"""The loop of the compiled engine: plain enough for numba, and the same, only slow, without it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.pack import Rules, Words
from petrobot.services.comm.compiled import kernel

DONE, FULL, CROWDED, OVERFLOWN, CAPPED = 0, 1, 2, 3, 4
"""Why the loop came back: block expanded, edge buffer full, keys or table crowded, a field
overflowed, cap reached."""


class Kernel(NamedTuple):
    """The compiled rules as plain arrays: the tests of transition t are first[t] <= k < first[t +
    1]."""

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
        """The arrays of the compiled rules."""
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
    """Write the enabled transitions of a packed marking to `out`; gives their number."""
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
    """Enter the first `states` keys, all different, in an empty table."""
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
    """Expand markings up to number `stop`; gives (why it came back, expanded, states, edges
    written).

    `row[i]` gets the number of edges of the i-th marking of the block. After OVERFLOWN row `states`
    is what did not fit.
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
            # Found or added here and not by a helper: a compiled call would count references of its
            # arrays each time.
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
