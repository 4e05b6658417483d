"""Where the nodes stand: given positions are kept, missing ones come from layers along the flow of tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Point = tuple[float, float]
Edge = tuple[str, str]

COLUMN = 120.0
ROW = 105.0
MARGIN = 80.0
_SWEEPS = 8


def lay_out(wanted: Mapping[str, Point | None], edges: Sequence[Edge], sources: Sequence[str]) -> dict[str, Point]:
    """A position for every node. `sources` are the nodes from which the flow begins (the marked places)."""
    given = {name: at for name, at in wanted.items() if at is not None}
    if len(given) == len(wanted):
        return given
    if 2 * len(given) >= len(wanted):
        return _fill_in(list(wanted), given, edges)
    return _layers(list(wanted), edges, sources)


def _fill_in(names: Sequence[str], given: Mapping[str, Point], edges: Sequence[Edge]) -> dict[str, Point]:
    """The missing nodes near their neighbours, each at the next free spot."""
    at = dict(given)
    for name in names:
        if name not in at:
            near = [at[b if a == name else a] for a, b in edges if name in (a, b) and (b if a == name else a) in at]
            centre = _mean(near) if near else (MARGIN, max((y for _, y in at.values()), default=0.0) + ROW)
            at[name] = _free_spot(centre, list(at.values()))
    return at


def _free_spot(centre: Point, taken: Sequence[Point]) -> Point:
    """The nearest spot around the centre that keeps its distance from all others."""
    ring = 0
    while True:
        spots = [
            (centre[0] + dx * COLUMN / 2, centre[1] + dy * ROW / 2)
            for dx in range(-ring, ring + 1)
            for dy in range(-ring, ring + 1)
            if max(abs(dx), abs(dy)) == ring
        ]
        free = [s for s in spots if all(abs(s[0] - x) >= COLUMN * 0.7 or abs(s[1] - y) >= ROW * 0.7 for x, y in taken)]
        if free:
            return min(free, key=lambda s: (s[0] - centre[0]) ** 2 + (s[1] - centre[1]) ** 2)
        ring += 1


def _layers(names: Sequence[str], edges: Sequence[Edge], sources: Sequence[str]) -> dict[str, Point]:
    """Columns by the longest way from the sources once circles are cut; rows ordered by neighbours (barycentre sweeps)."""
    forward = _without_circles(names, edges, sources)
    layer = _longest_ways(names, forward)
    columns: list[list[str]] = [[] for _ in range(max(layer.values(), default=0) + 1)]
    for name in names:
        columns[layer[name]].append(name)
    neighbours: dict[str, list[str]] = {n: [] for n in names}
    for a, b in edges:
        neighbours[a].append(b)
        neighbours[b].append(a)
    for sweep in range(_SWEEPS):
        _sweep(columns if sweep % 2 == 0 else columns[::-1], neighbours)
    tallest = max((len(c) for c in columns), default=0)
    return {
        name: (MARGIN + i * COLUMN, MARGIN + (j + (tallest - len(column)) / 2) * ROW)
        for i, column in enumerate(columns)
        for j, name in enumerate(column)
    }


def _without_circles(names: Sequence[str], edges: Sequence[Edge], sources: Sequence[str]) -> list[Edge]:
    """The edges without those that lead back to a node on the way (depth first, without recursion)."""
    following: dict[str, list[str]] = {n: [] for n in names}
    for a, b in edges:
        following[a].append(b)
    kept: list[Edge] = []
    state: dict[str, int] = {}
    for root in [*sources, *names]:
        if root in state:
            continue
        state[root] = 1
        stack = [(root, iter(following[root]))]
        while stack:
            node, rest = stack[-1]
            child = next(rest, None)
            if child is None:
                state[node] = 2
                stack.pop()
            elif state.get(child) != 1:
                kept.append((node, child))
                if child not in state:
                    state[child] = 1
                    stack.append((child, iter(following[child])))
    return kept


def _longest_ways(names: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    layer = dict.fromkeys(names, 0)
    incoming = dict.fromkeys(names, 0)
    following: dict[str, list[str]] = {n: [] for n in names}
    for a, b in edges:
        incoming[b] += 1
        following[a].append(b)
    ready = [n for n in names if not incoming[n]]
    while ready:
        node = ready.pop()
        for child in following[node]:
            layer[child] = max(layer[child], layer[node] + 1)
            incoming[child] -= 1
            if not incoming[child]:
                ready.append(child)
    return layer


def _sweep(columns: Sequence[list[str]], neighbours: Mapping[str, Sequence[str]]) -> None:
    """Sort each column by the mean row of its neighbours, as placed so far."""
    row = {name: float(j) - len(column) / 2 for column in columns for j, name in enumerate(column)}
    for column in columns:
        column.sort(key=lambda n: sum(row[m] for m in neighbours[n]) / len(neighbours[n]) if neighbours[n] else row[n])
        row |= {name: float(j) - len(column) / 2 for j, name in enumerate(column)}


def _mean(points: Sequence[Point]) -> Point:
    return sum(x for x, _ in points) / len(points), sum(y for _, y in points) / len(points)
