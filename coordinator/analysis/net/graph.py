"""Directed graphs in compact arrays: reachability, strong components, almost sure attraction.

The analysis uses them for reachability graphs, but nothing here knows about nets. Small graphs are
handled without scipy, because importing it takes longer than a quick check.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.limits import keep_time

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

SMALL = 20_000
"""Vertices plus edges up to which plain Python is faster than importing scipy."""
WIDE = 64
"""Vertices of a layer from which numpy is faster than plain Python. A task that counts many tokens
down has a graph of many thousand layers of a few vertices."""
SWEPT = 1 << 17
"""Edges of a block of a sweep."""


class Graph(Struct, frozen=True, dict=True):
    """Vertices 0 to n - 1. Edge e goes from source[e] to target[e]; edges are sorted by source."""

    n: int
    source: NDArray[np.int32]
    target: NDArray[np.int32]
    starts: Index | None = None
    """`row`, if it is known already."""
    rooted: bool = False
    """Whether it is known that every vertex can be reached from vertex 0."""

    @cached_property
    def row(self) -> Index:
        """Number of the first edge of each vertex, and the number of edges; shape (n + 1,)."""
        if self.starts is not None:
            return self.starts
        return np.searchsorted(self.source, np.arange(self.n + 1)).astype(np.int64)

    @cached_property
    def returning(self) -> Mask:
        """The vertices from which vertex 0 can be reached, shape (n,).

        Sweeps over blocks of vertices, down and up in turn, without the reversed edges, whose
        sorting would take longer. A sweep down follows edges to higher numbers as far as they go
        (in breadth-first order most lead there), a sweep up those to lower ones.
        """
        if len(self.target) + self.n <= SMALL:
            return self.backward([0])
        row, reached = self.row, np.zeros(self.n, dtype=np.bool_)
        reached[0] = True
        cuts = np.unique(np.searchsorted(row, np.arange(0, row[-1] + SWEPT, SWEPT)).clip(0, self.n))
        blocks = list(pairwise(sorted({0, *cuts.tolist(), self.n})))
        while True:
            left = []
            grown = 0
            for first, last in reversed(blocks):
                keep_time("verdicts")
                new, rest = self._sweep(reached, first, last)
                grown += new
                if rest:
                    left.append((first, last))
            if not grown or not left:
                return reached
            blocks = left  # in reversed order, so the next sweep runs the other way

    def _sweep(self, reached: Mask, first: int, last: int) -> tuple[int, int]:
        """Add the vertices first to last - 1 that have an edge to a reached one. Return how many
        were added and how many are left."""
        row = self.row
        todo = first + np.flatnonzero(~reached[first:last])
        if not len(todo):
            return 0, 0
        begin, end = row[todo], row[todo + 1]
        if 2 * int((end - begin).sum()) > int(row[last] - row[first]):
            targets = self.target[row[first] : row[last]]
            begin, end = begin - row[first], end - row[first]
        else:
            targets = self.target[ranges(begin, end)]
            end = np.cumsum(end - begin)
            begin = np.concatenate(([0], end[:-1]))
        # Counted up, since a sum for each vertex (reduceat) takes twice as long.
        hits = np.zeros(len(targets) + 1, dtype=np.int32)
        np.cumsum(reached.take(targets), out=hits[1:])
        new = todo[hits[end] > hits[begin]]
        reached[new] = True
        return len(new), len(todo) - len(new)

    @cached_property
    def into(self) -> tuple[Index, Index]:
        """Edges grouped by target: (position of each vertex' first edge, edge numbers)."""
        order = np.argsort(self.target, kind="stable")
        return np.searchsorted(self.target[order], np.arange(self.n + 1)).astype(np.int64), order

    def backward(self, seeds: Mask | Sequence[int], edges: Mask | None = None) -> Mask:
        """Return the vertices from which a seed can be reached, seeds included.

        `edges` restricts the search to some edges; by default all count.
        """
        # Breadth-first, one whole layer of vertices per numpy operation.
        row, order = self.into
        reached = np.zeros(self.n, dtype=np.bool_)
        reached[seeds] = True
        front = np.flatnonzero(reached)
        while len(front):
            keep_time("verdicts")
            if len(front) < WIDE:
                near = set[int]()
                for v in front.tolist():
                    for e in order[row[v] : row[v + 1]].tolist():
                        if (edges is None or edges[e]) and not reached[self.source[e]]:
                            near.add(int(self.source[e]))
                front = np.array(sorted(near), dtype=np.int64)
            else:
                at = order[ranges(row[front], row[front + 1])]
                if edges is not None:
                    at = at[edges[at]]
                before = self.source[at]
                front = np.unique(before[~reached[before]])
            reached[front] = True
        return reached

    def path(self, start: int, goals: Mask, edges: Mask | None = None) -> list[int] | None:
        """Return the edges of a shortest path from a vertex to any goal, or None if there is none.

        `edges` restricts the search to some edges; by default all count.
        """
        # came[v] is the edge by which the search reached v; -1 at the start, -2 not reached.
        came = np.full(self.n, -2, dtype=np.int64)
        came[start] = -1
        front = np.array([start])
        while len(front) and not goals[front].any():
            keep_time("verdicts")
            if len(front) < WIDE:
                near = set[int]()
                for v in front.tolist():
                    for e in range(self.row[v], self.row[v + 1]):
                        if (edges is None or edges[e]) and came[self.target[e]] == -2:
                            came[self.target[e]] = e
                            near.add(int(self.target[e]))
                front = np.array(sorted(near), dtype=np.int64)
                continue
            at = ranges(self.row[front], self.row[front + 1])
            at = at if edges is None else at[edges[at]]
            at = at[came[self.target[at]] == -2]
            # Several edges may enter the same vertex. numpy keeps the last assignment, so assigning
            # in reversed order keeps the first edge.
            came[self.target[at[::-1]]] = at[::-1]
            front = np.unique(self.target[at])
        hits = front[goals[front]]
        if not len(hits):
            return None
        path, vertex = [], int(hits[0])
        while came[vertex] >= 0:
            path.append(int(came[vertex]))
            vertex = int(self.source[came[vertex]])
        return path[::-1]

    @cached_property
    def components(self) -> NDArray[np.int32]:
        """Number of the strong component of each vertex, shape (n,).

        Numbers count from 0, in an unspecified order.
        """
        if len(self.target) + self.n <= SMALL:
            return _tarjan(self.n, self.row.tolist(), self.target.tolist())
        if self.rooted and self.returning.all():
            return np.zeros(self.n, dtype=np.int32)
        keep_time("verdicts")
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

        ones = np.ones(len(self.target), dtype=np.int8)
        matrix = csr_array((ones, self.target, self.row), shape=(self.n, self.n))
        labels: NDArray[np.int32] = connected_components(
            matrix, directed=True, connection="strong"
        )[1]
        return labels

    @cached_property
    def strong(self) -> bool:
        """Whether every vertex can be reached from every other one."""
        return self.n > 0 and not self.components.any()

    @cached_property
    def bottom(self) -> Mask:
        """Which strong components no edge leaves, shape (components,)."""
        if self.strong:
            return np.ones(1, dtype=np.bool_)
        ours, theirs = self.components[self.source], self.components[self.target]
        bottom = np.ones(int(self.components.max()) + 1, dtype=np.bool_)
        bottom[ours[ours != theirs]] = False
        return bottom

    @cached_property
    def inner(self) -> Mask:
        """Which edges stay inside a strong component, i.e. lie on a cycle; shape (edges,)."""
        if self.strong:
            return np.ones(len(self.target), dtype=np.bool_)
        inside: Mask = self.components[self.source] == self.components[self.target]
        return inside

    def almost_sure(self, goal: Mask, free: Mask, *, allowed: Mask | None = None) -> Mask:
        """Return the vertices from which some strategy reaches the goal with probability 1.

        The strategy may leave out any edge that is `free`; every other edge has a positive
        probability whenever its source is visited (fairness). Before the goal only `allowed`
        vertices may be visited.

        This is almost sure reachability in a Markov decision process (C. Baier, J.-P. Katoen,
        Principles of Model Checking, MIT Press 2008, section 10.6.1), computed as a greatest fixed
        point: start with all vertices, and remove those from which an edge that cannot be left out
        leaves the set, and those from which the goal cannot be reached inside the set.
        """
        winning = goal.copy() if allowed is None else goal | allowed
        if allowed is None:
            winning[:] = True
        forced = ~free
        while True:
            keep_time("verdicts")
            # First the vertices that the environment can push out of the set ...
            leaves = forced & winning[self.source] & ~goal[self.source] & ~winning[self.target]
            if leaves.any():
                winning[self.source[leaves]] = False
                continue
            # ... then those from which the goal is no longer reachable inside it.
            inside = winning[self.source] & winning[self.target]
            reaching = self.backward(goal & winning, inside)
            if np.array_equal(reaching & winning, winning):
                return winning
            winning &= reaching


def sum_by(index: NDArray[Any], values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Add up the values that share an index; shape (n,)."""
    return np.asarray(np.bincount(index, weights=values, minlength=n), dtype=np.float64)


def ranges(first: Index, last: Index) -> Index:
    """Return all numbers of the half-open ranges [first, last), one range after the other."""
    # Equivalent to concatenating np.arange for each pair, without a loop in Python.
    length = last - first
    total = int(length.sum())
    if not total:
        return np.zeros(0, dtype=np.int64)
    begin = np.repeat(first - np.concatenate(([0], np.cumsum(length)[:-1])), length)
    return begin + np.arange(total)


def _tarjan(n: int, row: list[int], target: list[int]) -> NDArray[np.int32]:
    """Return strong components by Tarjan's algorithm, without recursion.

    Source: R. E. Tarjan, Depth-first search and linear graph algorithms, SIAM J. Comput. 1 (1972).
    An explicit stack, because reachability graphs are deeper than Python's recursion limit.
    """
    found, low, label = [-1] * n, [0] * n, [-1] * n
    at, stack, count, components = row[:n], list[int](), 0, 0
    for root in range(n):
        if found[root] >= 0:
            continue
        path = [root]
        found[root] = low[root] = count
        count += 1
        stack.append(root)
        while path:
            v = path[-1]
            if at[v] < row[v + 1]:
                w = target[at[v]]
                at[v] += 1
                if found[w] < 0:
                    found[w] = low[w] = count
                    count += 1
                    stack.append(w)
                    path.append(w)
                elif label[w] < 0:
                    low[v] = min(low[v], found[w])
                continue
            path.pop()
            if path:
                low[path[-1]] = min(low[path[-1]], low[v])
            if low[v] == found[v]:
                while True:
                    w = stack.pop()
                    label[w] = components
                    if w == v:
                        break
                components += 1
    return np.array(label, dtype=np.int32)
