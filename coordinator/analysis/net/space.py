"""The reachability graph of a net: markings in breadth-first order, edges in compact arrays.

Two engines explore it and give identical results, down to the numbers of the markings and the
order of the edges: marking i is expanded before marking i + 1, its transitions are tried in order,
and a new marking gets the next number. So one engine can continue where another one stopped. `auto`
starts with plain integers, which need no preparation, and hands over to numpy when the net turns
out to be large.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Literal

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from petrobot.coordinator.analysis.limits import OUT_OF_MEMORY, memory_limit, overtime
from petrobot.coordinator.analysis.net.explore import (
    ExplorationEngine,
    Explored,
    IntegerEngine,
    Labels,
    Numbers,
)
from petrobot.coordinator.analysis.net.graph import WIDE
from petrobot.coordinator.analysis.net.pack import Layout, Tokens, TooManyTokens, Words
from petrobot.coordinator.analysis.net.structure import (
    implied_places,
    place_bounds,
    place_semiflows,
)
from petrobot.coordinator.task.net import Marking, Net

EngineName = Literal["auto", "integers", "numpy"]

HANDOVER = 10_000
"""Markings after which `auto` changes from plain integers to numpy, if enough of them wait to be
expanded together."""
NARROW = 8
"""Value bits that plain integers reserve for a place without a known bound (width costs them
little)."""


BLOCK = 1 << 17
"""Markings or edges that are looked at together, so that they stay in the cache."""
JUDGED = 6
"""Peak memory of a search and all verdicts on its space, relative to what the engine held at its
end (5.2 for Kanban-5: the strong components, reversed edges and columns of tokens)."""

SHARED = "of which searches get a part"
"""Why a search ends before the whole limit is used up."""


class SearchLimits(Struct, frozen=True):
    """Limits of a search in markings, seconds and bytes; None means no limit.

    `memory` is for the search and the verdicts on what it finds, so the engine itself may hold one
    part in JUDGED of it. `seconds` needs a `clock` (s), because nothing in this package reads a
    clock of its own; they begin with each search, unless `due` says when the last one must end on
    that clock. `progress` is called after each block of markings with (markings found, markings
    expanded).
    """

    states: int | None = None
    seconds: float | None = None
    memory: int | None = None
    clock: Callable[[], float] | None = None
    progress: Callable[[int, int], None] | None = None
    due: float | None = None

    def __post_init__(self) -> None:
        """Refuse a time limit without a clock to measure it."""
        if self.seconds is not None and self.clock is None:
            raise ValueError("a limit in seconds needs a clock; pass clock=time.monotonic")


class Space(Struct, frozen=True, dict=True):
    """The reachable markings found, in breadth-first order (0 is the initial one), and their edges.

    Edge e of marking i, with `row[i] <= e < row[i + 1]`, fires transition `label[e]` and leads to
    marking `target[e]`. The edges of a marking are in transition order. If edges are not kept,
    `row` still counts them. If the search stopped early, only the first `expanded` markings have
    their edges, `complete` is False and `reason` says why.
    """

    net: Net
    layout: Layout
    words: Words
    """Packed markings, shape (states, layout.words)."""
    row: NDArray[np.int64]
    target: Numbers
    label: Labels
    expanded: int
    complete: bool
    reason: str
    engine: str
    _columns: dict[int, Tokens] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.words)

    @property
    def edges(self) -> int:
        """Number of edges found, even if the edges themselves were not kept."""
        return int(self.row[-1])

    def marking(self, i: int) -> Marking:
        """Return marking number i."""
        return self.layout.unpack(self.layout.join_many(self.words[i : i + 1])[0])

    def markings(self, block: int = 1 << 16) -> Iterator[tuple[int, Tokens]]:
        """Yield all markings in blocks: (number of the first one, array of shape (n, places))."""
        for start in range(0, len(self), block):
            yield start, self.layout.unpack_many(self.words[start : start + block])

    def tokens(self, place: int) -> Tokens:
        """Return the tokens of one place in every marking, shape (states,)."""
        if place not in self._columns:
            self._columns[place] = self.layout.tokens(self.words, place)
        return self._columns[place]

    def where(self, predicate: Callable[[Marking], bool]) -> NDArray[np.bool_]:
        """Return in which markings the predicate holds, shape (states,)."""
        found = [predicate(tuple(m)) for _, block in self.markings() for m in block.tolist()]
        return np.array(found, dtype=np.bool_)

    @cached_property
    def source(self) -> NDArray[np.int32]:
        """The marking that each edge leaves, shape (edges,)."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.row))

    @cached_property
    def bounds(self) -> tuple[int, ...]:
        """The most tokens seen in each place."""
        layout, most = self.layout, [0] * len(self.net.places)
        for start in range(0, len(self), BLOCK):
            words = np.ascontiguousarray(self.words[start : start + BLOCK].T)
            for p, (w, at, bits) in enumerate(
                zip(layout.word, layout.shift, layout.width, strict=True)
            ):
                field = np.uint64(((1 << bits) - 1) << at)
                most[p] = max(most[p], int((words[w] & field).max()) >> at)
        return tuple(most)

    @cached_property
    def fired(self) -> NDArray[np.bool_]:
        """Which transitions label an edge, shape (transitions,)."""
        fired = np.zeros(len(self.net.transitions), dtype=np.bool_)
        for start in range(0, len(self.label), BLOCK):
            fired[self.label[start : start + BLOCK]] = True
            if fired.all():
                break
        return fired

    @cached_property
    def most_tokens(self) -> int:
        """The most tokens seen in one marking."""
        return max(int(block.sum(axis=1).max()) for _, block in self.markings())

    @cached_property
    def dead(self) -> NDArray[np.int64]:
        """Numbers of the expanded markings that enable nothing."""
        return np.flatnonzero(np.diff(self.row[: self.expanded + 1]) == 0)

    def path(self, goal: int) -> list[str]:
        """Return a shortest firing sequence from the initial marking to marking number `goal`."""
        sequence = []
        while goal:
            edge = int(self.parent_edge[goal])
            sequence.append(self.net.transitions[self.label[edge]])
            goal = int(np.searchsorted(self.row, edge, side="right")) - 1
        return sequence[::-1]

    @cached_property
    def parent_edge(self) -> NDArray[np.int64]:
        """The first edge that leads to each marking, -1 for the initial one; shape (states,).

        Breadth-first numbering makes it the last edge of a shortest path.
        """
        # Each marking gets the next number when it is found, so the edges that found one are those
        # that lead to a higher number than all before.
        found, highest = [np.full(min(1, len(self)), -1, dtype=np.int64)], 0
        for start in range(0, len(self.target), BLOCK):
            target = self.target[start : start + BLOCK]
            before = np.maximum.accumulate(np.concatenate(([highest], target[:-1])))
            found.append(start + np.flatnonzero(target > before))
            highest = max(int(before[-1]), int(target[-1]))
        return np.concatenate(found)


LOOK = 10_000
"""Markings after which boundedness is checked, before the search continues to its limits."""


def explore(
    net: Net, *, engine: EngineName = "auto", limits: SearchLimits | None = None, edges: bool = True
) -> Space:
    """Return the markings that are reachable from the initial one.

    With `edges=False` the edges are counted but not kept. Ctrl-C, a limit, or a place with more
    tokens than 63 bits can count ends the search; the space found so far is returned, marked as
    incomplete. Raises TooManyTokens if the initial marking has such a place.
    """
    limits = limits or SearchLimits(memory=memory_limit())
    started = limits.clock() if limits.clock else 0.0
    found: ExplorationEngine
    if engine in ("auto", "integers"):
        layout = Layout.for_net(net, least=NARROW)
        name, found = "integers", IntegerEngine(Explored.start(net, layout, edges))
        budget = HANDOVER if engine == "auto" else None
    else:
        layout = Layout.for_net(net, least=2)
        name, found, budget = engine, _word_engine(Explored.start(net, layout, edges)), None
    try:
        reason = _run(found, limits, started, budget)
        while budget and reason == _HAND_OVER and found.states - found.expanded < WIDE:
            budget *= 2
            reason = _run(found, limits, started, budget)
        if reason == _HAND_OVER:
            name, found = "numpy", _word_engine(found.explored())
            reason = _run(found, limits, started, None)
    except KeyboardInterrupt:
        reason = INTERRUPTED
    return _space(found.explored(), reason, name)


INTERRUPTED = "interrupted"
"""`Space.reason` of a search that was ended by Ctrl-C."""


_HAND_OVER = "hand over"


def _word_engine(begun: Explored) -> ExplorationEngine:
    """Return the engine of machine words that continues a search, in the narrowest safe layout.

    A place gets the bits of its proven bound, or else room for twice the tokens seen so far: few
    words per marking matter more than avoiding an overflow, after which the layout is widened.
    """
    seen = begun.layout.unpack_many(begun.words).max(axis=0).tolist()
    flows = place_semiflows(begun.net, 2 * len(seen))
    known = place_bounds(begun.net, flows)
    guess = [max(top, 2 * top + 1 if b is None else b) for b, top in zip(known, seen, strict=True)]
    implied = implied_places(flows, known)
    begun = begun.relaid(Layout.for_net(begun.net, guess, implied=implied))
    from petrobot.coordinator.analysis.net.explore_numpy import NumpyEngine

    return NumpyEngine(begun)


def _run(
    engine: ExplorationEngine, limits: SearchLimits, started: float, budget: int | None
) -> str:
    """Expand until the search is complete or a limit is reached.

    Return the reason for stopping early, or an empty string. KeyboardInterrupt passes through.
    """
    cap = min((n for n in (limits.states, budget) if n is not None), default=None)
    try:
        while engine.expand(cap):
            if limits.progress:
                limits.progress(engine.states, engine.expanded)
            if cap is not None and engine.states >= cap:
                break
            if limits.memory is not None and engine.nbytes * JUDGED > limits.memory:
                return f"memory limit of {limits.memory / 2**20:.4g} MiB, {SHARED}"
            if late := _late(limits, started):
                return late
    except TooManyTokens as grown:
        return str(grown)
    except OUT_OF_MEMORY:
        return "out of memory"
    if engine.expanded == engine.states:
        return ""
    if limits.states is not None and engine.states >= limits.states:
        return f"limit of {limits.states} states"
    return _late(limits, started) or _HAND_OVER


def _late(limits: SearchLimits, started: float) -> str:
    """Return the reason for stopping if the time is used up, else an empty string."""
    if limits.seconds is None or limits.clock is None:
        return "time limit" if overtime() else ""
    told = f"time limit of {limits.seconds:g} s"
    if limits.due is None:
        return told if limits.clock() > started + limits.seconds else ""
    return f"{told}, {SHARED}" if limits.clock() > limits.due else ""


def _space(found: Explored, reason: str, engine: str) -> Space:
    row = np.full(len(found.words) + 1, found.row[-1], dtype=np.int64)
    row[: len(found.row)] = found.row
    states = len(found.words)
    if reason and found.keep_edges:
        # An interruption may have left markings to which no kept edge leads yet.
        states = int(found.target.max(initial=0)) + 1
    return Space(
        found.net,
        found.layout,
        found.words[:states],
        row[: states + 1],
        found.target,
        found.label,
        len(found.row) - 1,
        not reason,
        reason,
        engine,
    )
