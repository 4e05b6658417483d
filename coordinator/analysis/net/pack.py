"""Markings packed into machine words: one field and one guard bit a place, so that a firing rule is
a few mask tests.

A field of `width` value bits holds the tokens of a place; the guard bit just above it is 0 in every
stored marking. With all guards G set, `(M | G) - s` leaves the guard of place p set exactly when
M(p) >= s(p), and no field borrows from the next one. So one subtraction tests all consumed weights
(guards must stay) and all bars (guards must go) of a transition; `task/net.py` has turned
capacities into bars. A guard that is set after a firing is a token count that outgrew its field:
the caller widens the field and continues.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.graph import Mask
from petrobot.coordinator.task.net import CompiledNet, Marking, Net

WORD = 64
WIDEST = WORD - 1

Words = NDArray[np.uint64]
Tokens = NDArray[np.int64]


class TooManyTokens(ValueError):  # noqa: N818 - a fact about the net, named as such
    """A place holds more tokens than a machine word can count."""


class Layout(Struct, frozen=True, dict=True):
    """Where the field of each place lies: `width` value bits from bit `shift` of word `word` on,
    the guard bit above."""

    width: tuple[int, ...]
    word: tuple[int, ...]
    shift: tuple[int, ...]
    words: int
    implied: frozenset[int]
    """Places whose tokens follow from those of the others; their fields come last."""

    @classmethod
    def of_widths(cls, width: Sequence[int], implied: frozenset[int] = frozenset()) -> Layout:
        """Fields in place order, those of implied places last; one that does not fit in what is
        left of a word starts the next word."""
        word, shift, at, used = [0] * len(width), [0] * len(width), 0, 0
        for p in sorted(range(len(width)), key=lambda p: p in implied):
            bits = width[p]
            if bits > WIDEST:
                raise TooManyTokens(
                    f"a place needs {bits} bits for its tokens; at most {WIDEST} can be counted"
                )
            if used + bits + 1 > WORD:
                at, used = at + 1, 0
            word[p], shift[p] = at, used
            used += bits + 1
        return cls(tuple(width), tuple(word), tuple(shift), at + 1, implied)

    @classmethod
    def for_net(
        cls,
        net: Net,
        bounds: Sequence[int | None] | None = None,
        least: int = 1,
        implied: frozenset[int] = frozenset(),
    ) -> Layout:
        """A layout that holds the initial marking, the given bounds (None: unknown) and every
        single effect.

        `least` is the width given to a place without a bound. Bounds need not be right: an overflow
        is always noticed.
        """
        width = []
        for p, (start, effect) in enumerate(zip(net.initial, _largest_effect(net), strict=True)):
            bound = bounds[p] if bounds is not None else None
            wanted = max(1, bound.bit_length()) if bound is not None else least
            width.append(max(wanted, start.bit_length(), effect.bit_length()))
        return cls.of_widths(width, implied)

    def widened(self, places: Sequence[int]) -> Layout:
        """The layout with twice the value bits for each of the places."""
        grown = set(places)
        return Layout.of_widths(
            [min(2 * w, WIDEST) if p in grown else w for p, w in enumerate(self.width)],
            self.implied,
        )

    @cached_property
    def telling(self) -> int:
        """Number of the first words that suffice to distinguish any two reachable markings."""
        return 1 + max((w for p, w in enumerate(self.word) if p not in self.implied), default=0)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Bit position of each field in the marking read as one integer (word 0 lowest)."""
        return tuple(WORD * w + s for w, s in zip(self.word, self.shift, strict=True))

    @cached_property
    def guards(self) -> int:
        """All guard bits, as one integer."""
        return sum(
            1 << (offset + width) for offset, width in zip(self.offsets, self.width, strict=True)
        )

    @cached_property
    def guard_words(self) -> Words:
        """All guard bits, shape (words,)."""
        return self.split(self.guards)

    def pack(self, marking: Sequence[int]) -> int:
        """The marking as one integer. Every entry must fit its field."""
        return sum(n << offset for n, offset in zip(marking, self.offsets, strict=True) if n)

    def unpack(self, packed: int) -> Marking:
        """The marking behind one integer."""
        return tuple(
            (packed >> o) & ((1 << w) - 1) for o, w in zip(self.offsets, self.width, strict=True)
        )

    def split(self, packed: int) -> Words:
        """One integer (taken modulo 2**(64 * words)) as words, shape (words,), lowest first."""
        size = WORD // 8 * self.words
        return np.frombuffer(
            (packed % (1 << (8 * size))).to_bytes(size, "little"), dtype="<u8"
        ).astype(np.uint64)

    def split_many(self, packed: Sequence[int]) -> Words:
        """Integers as rows of words, shape (n, words)."""
        size = WORD // 8 * self.words
        raw = b"".join(one.to_bytes(size, "little") for one in packed)
        return np.frombuffer(raw, dtype="<u8").astype(np.uint64).reshape(len(packed), self.words)

    def join_many(self, words: Words) -> list[int]:
        """Rows of words, shape (n, words), as integers."""
        raw, size = np.ascontiguousarray(words, dtype="<u8").tobytes(), WORD // 8 * self.words
        return [int.from_bytes(raw[i : i + size], "little") for i in range(0, len(raw), size)]

    def tokens(self, words: Words, place: int) -> Tokens:
        """Tokens of one place in each marking; words has shape (n, words), the result (n,)."""
        mask = np.uint64((1 << self.width[place]) - 1)
        return ((words[:, self.word[place]] >> np.uint64(self.shift[place])) & mask).astype(
            np.int64
        )

    def unpack_many(self, words: Words) -> Tokens:
        """Markings of shape (n, places) behind rows of words of shape (n, words)."""
        out = np.empty((len(words), len(self.width)), dtype=np.int64)
        for p in range(len(self.width)):
            out[:, p] = self.tokens(words, p)
        return out

    def repack(self, words: Words, other: Layout) -> Words:
        """Rows of words of this layout in another one, whose fields must be wide enough."""
        out = np.zeros((len(words), other.words), dtype=np.uint64)
        for p in range(len(self.width)):
            out[:, other.word[p]] |= self.tokens(words, p).astype(np.uint64) << np.uint64(
                other.shift[p]
            )
        return out

    def overflown(self, packed: int) -> list[int]:
        """Places whose guard bit is set."""
        return [
            p
            for p, (o, w) in enumerate(zip(self.offsets, self.width, strict=True))
            if packed >> (o + w) & 1
        ]


class Test(Struct, frozen=True):
    """One mask test of a transition: it passes in M when `(M | G) - sub & guard == want`."""

    __test__ = False  # not a test class for pytest

    sub: int
    guard: int
    want: int


class Rules(Struct, frozen=True, dict=True):
    """The transitions of a net compiled for a layout; `able` are those that this layout's token
    counts can ever enable."""

    net: Net
    layout: Layout
    able: tuple[int, ...]
    tests: tuple[tuple[Test, ...], ...]
    """By transition; empty for one that is not in `able` or is always enabled."""
    delta: tuple[int, ...]
    """By transition: what a firing adds to the packed marking (may be negative)."""
    higher: tuple[tuple[int, ...], ...]
    """Transition groups by falling priority, only those in `able`."""

    @classmethod
    def compiled(cls, net: Net, layout: Layout) -> Rules:
        """Compile all transitions of the net for the layout."""
        compiled = [_compile(net, layout, t) for t in range(len(net.transitions))]
        able = tuple(t for t, tests in enumerate(compiled) if tests is not None)
        levels = sorted({net.priority[t] for t in able}, reverse=True)
        return cls(
            net,
            layout,
            able,
            tuple(tests if tests is not None else () for tests in compiled),
            tuple(
                sum(change << layout.offsets[p] for p, change in changes)
                for changes in net.compiled.changes
            ),
            tuple(tuple(t for t in able if net.priority[t] == level) for level in levels),
        )

    @cached_property
    def word_tests(self) -> list[list[tuple[int, np.uint64, np.uint64, np.uint64]]]:
        """By transition: (word, sub, guard, want) for each word that its tests look at."""
        return [
            [
                (w, sub[w], guard[w], want[w])
                for test in tests
                for sub, guard, want in [
                    tuple(map(self.layout.split, (test.sub, test.guard, test.want)))
                ]
                for w in range(self.layout.words)
                if guard[w]
            ]
            for tests in self.tests
        ]

    @cached_property
    def word_delta(self) -> Words:
        """What a firing adds modulo 2**64 to each word, shape (transitions, words).

        A field never borrows from the next in a firing that its tests allow, so words may be added
        one by one.
        """
        rows = [[0] * self.layout.words for _ in self.delta]
        for row, changes in zip(rows, self.net.compiled.changes, strict=True):
            for p, change in changes:
                row[self.layout.word[p]] += change << self.layout.shift[p]
        wrapped = [[amount % (1 << WORD) for amount in row] for row in rows]
        return np.array(wrapped, dtype=np.uint64).reshape(len(rows), self.layout.words)


def _largest_effect(net: Net) -> list[int]:
    largest = [0] * len(net.places)
    for changes in net.compiled.changes:
        for p, change in changes:
            largest[p] = max(largest[p], change)
    return largest


def _compile(net: Net, layout: Layout, t: int) -> tuple[Test, ...] | None:
    """The mask tests of a transition; None if no token count of the layout can enable it."""
    need, below = dict(net.compiled.needs[t]), dict(net.compiled.bars[t])
    below = {p: k for p, k in below.items() if k < 1 << layout.width[p]}
    if any(k <= 0 for k in below.values()) or any(
        w >= 1 << layout.width[p] for p, w in need.items()
    ):
        return None
    both = {p: below.pop(p) for p in need.keys() & below.keys()}
    tests = [_test(layout, need, below), _test(layout, {}, both)]
    return tuple(test for test in tests if test.guard)


def _test(layout: Layout, need: Mapping[int, int], below: Mapping[int, int]) -> Test:
    def guards(places: Mapping[int, int]) -> int:
        return sum(1 << (layout.offsets[p] + layout.width[p]) for p in places)

    sub = sum(k << layout.offsets[p] for p, k in (*need.items(), *below.items()))
    return Test(sub, guards(need) | guards(below), guards(need))


# --- many markings side by side ---
# The firing rule for many markings side by side: places are rows of an array, markings its
# columns.
#
# Used where trials are played in parallel (`time/simulate.py`, `studies/forecast/play.py`).


def concession(rule: CompiledNet, tokens: Tokens, t: int) -> Mask:
    """Return in which markings transition t has concession; `tokens` has shape (places, markings),
    the result (markings,)."""
    able = np.ones(tokens.shape[1], dtype=np.bool_)
    for p, w in rule.needs[t]:
        able &= tokens[p] >= w
    for p, k in rule.bars[t]:
        able &= tokens[p] < k
    return able
