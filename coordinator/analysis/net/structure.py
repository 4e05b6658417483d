"""Structural analysis: invariants, bounds, conservativeness and conflicts, as exact integers.

Everything here follows from the incidence matrix C = Post - Pre. Inhibitors, capacities and
priorities only remove behaviour, so what holds for every firing sequence here (bounds,
P-invariants, exclusion) also holds with them. T-invariants are those of the net without them.
Definitions: T. Murata, Petri nets: properties, analysis and applications, Proc. IEEE 77 (1989),
sections V to VII.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from math import gcd, lcm

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.limits import overtime
from petrobot.coordinator.task.net import Net

EFFORT = 2_000
"""The most rows that the enumeration of semiflows may hold at a time."""

SMALL_EFFORT = 300
"""Rows above which a linear program finds a Lyapunov function faster than an enumeration."""

Vector = dict[int, int]
"""A sparse integer vector: its non-zero entries by index."""


class Semiflows(Struct, frozen=True):
    """Non-negative integer solutions of minimal support; all of them if `complete`."""

    vectors: tuple[Vector, ...]
    complete: bool

    def covers(self, size: int) -> bool:
        """Return whether every index below `size` occurs in some vector."""
        return len(set().union(*self.vectors)) == size if self.vectors else size == 0


def incidence(net: Net) -> NDArray[np.int64]:
    """Return C = Post - Pre, shape (places, transitions)."""
    C = np.zeros((len(net.places), len(net.transitions)), dtype=np.int64)
    for t, changes in enumerate(net.compiled.changes):
        for p, change in changes:
            C[p, t] = change
    return C


def place_semiflows(net: Net, effort: int = EFFORT) -> Semiflows:
    """Return the minimal y >= 0 with y^T C = 0: weighted token sums that no firing changes."""
    rows: list[Vector] = [{} for _ in net.places]
    for t, changes in enumerate(net.compiled.changes):
        for p, change in changes:
            rows[p][t] = change
    return _semiflows(rows, effort)


def transition_semiflows(net: Net) -> Semiflows:
    """Return the minimal x >= 0 with C x = 0: firing counts that reproduce a marking."""
    return _semiflows([dict(changes) for changes in net.compiled.changes], EFFORT)


def _semiflows(rows: Sequence[Vector], effort: int) -> Semiflows:
    """Return the minimal-support non-negative combinations of the rows that give zero.

    Farkas' algorithm: eliminate one column after the other by combining each row that is positive
    there with each that is negative. The next column is the one that adds the fewest rows. Source:
    J. M. Colom, M. Silva, Convex geometry and semiflows in P/T nets, Advances in Petri Nets 1990,
    LNCS 483 (1991).
    """
    live = [({i: 1}, dict(row)) for i, row in enumerate(rows)]
    while not overtime():
        columns = _signs(live)
        if not columns:
            return Semiflows(tuple(y for y, _ in live), True)
        column = min(columns, key=lambda c: columns[c][0] * columns[c][1] - sum(columns[c]))
        if columns[column][0] * columns[column][1] > effort * 50:
            break
        fewer = _annul(live, column)
        if fewer is None:
            break
        live = fewer
        if len(live) > effort:
            break
    return Semiflows(tuple(y for y, rest in live if not rest), False)


def _signs(live: list[tuple[Vector, Vector]]) -> dict[int, list[int]]:
    """Return by column that is not yet zero: how many rows are positive and negative there."""
    signs: dict[int, list[int]] = {}
    for _, rest in live:
        for column, value in rest.items():
            signs.setdefault(column, [0, 0])[value < 0] += 1
    return signs


def _annul(live: list[tuple[Vector, Vector]], column: int) -> list[tuple[Vector, Vector]] | None:
    """Replace the rows that are not zero in a column by their combinations that are zero there.

    Of all rows only those of minimal support are kept. None if time ran out.
    """
    kept = [row for row in live if column not in row[1]]
    plus = [row for row in live if row[1].get(column, 0) > 0]
    minus = [row for row in live if row[1].get(column, 0) < 0]
    fresh = []
    for a in plus:
        if overtime():
            return None
        for b in minus:
            u, v = -b[1][column], a[1][column]
            y, rest = _combined(a[0], u, b[0], v), _combined(a[1], u, b[1], v)
            shared = gcd(*y.values(), *rest.values())
            fresh.append(
                ({i: n // shared for i, n in y.items()}, {i: n // shared for i, n in rest.items()})
            )
    return _minimal_supports(kept, fresh) if fresh else kept


def _combined(a: Vector, u: int, b: Vector, v: int) -> Vector:
    total = {i: u * n for i, n in a.items()}
    for i, n in b.items():
        total[i] = total.get(i, 0) + v * n
    return {i: n for i, n in total.items() if n}


def _minimal_supports(
    kept: list[tuple[Vector, Vector]], fresh: list[tuple[Vector, Vector]]
) -> list[tuple[Vector, Vector]] | None:
    """Return the rows whose support contains no other support (one row of equal supports stays).

    Supports are compared as bit masks, small ones first; `kept` is minimal in itself already. None
    if time ran out.
    """
    old = [(sum(1 << i for i in row[0]), row) for row in kept]
    new: list[tuple[int, tuple[Vector, Vector]]] = []
    smaller = _supports(mask for mask, _ in old)
    for mask, row in sorted(
        ((sum(1 << i for i in row[0]), row) for row in fresh), key=lambda one: one[0].bit_count()
    ):
        if overtime():
            return None
        if not _contains_one(row[0], mask, smaller):
            new.append((mask, row))
            smaller.setdefault(mask & -mask, []).append(mask)
    added = _supports(mask for mask, _ in new)
    return [row for mask, row in old if not _contains_one(row[0], mask, added)] + [
        row for _, row in new
    ]


def _supports(masks: Iterable[int]) -> dict[int, list[int]]:
    """Return the supports by their lowest bit: only those of its own bits can lie within another
    support, a small part of all where the supports are small."""
    found = dict[int, list[int]]()
    for mask in masks:
        found.setdefault(mask & -mask, []).append(mask)
    return found


def _contains_one(support: Iterable[int], mask: int, supports: dict[int, list[int]]) -> bool:
    for i in support:
        for other in supports.get(1 << i, ()):
            if mask & other == other:
                return True
    return False


def place_bounds(net: Net, flows: Semiflows | None = None) -> list[int | None]:
    """Return upper bounds of the tokens by place, from capacities, P-semiflows and, where these
    leave a place open, weighted sums that no firing increases; None if unknown.

    y^T M <= y^T M0 for every reachable M gives M(p) <= y^T M0 / y(p). Also valid with inhibitors
    and priorities.
    """
    bounds = [
        limit if limit is None else max(limit, n)
        for limit, n in zip(net.capacity, net.initial, strict=True)
    ]
    _lower(net, bounds, (flows or place_semiflows(net)).vectors)
    if None in bounds:
        falling = _falling(net)
        _lower(net, bounds, falling.vectors)
        if None in bounds and not falling.complete and (y := _programmed(net, conserved=False)):
            _lower(net, bounds, (y,))
    return bounds


def _lower(net: Net, bounds: list[int | None], vectors: Iterable[Vector]) -> None:
    """Lower the bounds of places to those of weighted sums that no firing increases."""
    for y in vectors:
        total = sum(weight * net.initial[p] for p, weight in y.items())
        for p, weight in y.items():
            known = bounds[p]
            bounds[p] = total // weight if known is None else min(known, total // weight)


def _falling(net: Net) -> Semiflows:
    """Return minimal y >= 0 with y^T C <= 0. Each transition has a slack row, which turns the
    inequality into an equation."""
    rows: list[Vector] = [{} for _ in net.places]
    for t, changes in enumerate(net.compiled.changes):
        for p, change in changes:
            rows[p][t] = change
    found = _semiflows(rows + [{t: 1} for t in range(len(net.transitions))], SMALL_EFFORT)
    size = len(net.places)
    of_places = ({p: n for p, n in y.items() if p < size} for y in found.vectors)
    return Semiflows(tuple(y for y in of_places if y), found.complete)


def implied_places(flows: Semiflows, bounds: Sequence[int | None]) -> frozenset[int]:
    """Return places whose tokens follow from those of the other places in every reachable marking:
    one place of each independent P-invariant, of those with the largest bounds."""
    pivots: list[tuple[int, Vector]] = []
    for y in flows.vectors:
        rest = y
        for place, pivot in pivots:
            if place in rest:
                rest = _combined(rest, pivot[place], pivot, -rest[place])
        if rest:
            shared = gcd(*rest.values())
            rest = {p: n // shared for p, n in rest.items()}
            pivots.append((max(rest, key=lambda p: bounds[p] or 0), rest))
    return frozenset(place for place, _ in pivots)


class Lyapunov(Struct, frozen=True):
    """What is known of a linear Lyapunov function y.M of a net: y > 0 and y^T C <= 0, so no firing
    increases y.M.

    All three answers were checked in integers, not in floating point.
    """

    weights: Vector | None
    """Such a y; None if none was found."""
    bounded: bool | None
    """Whether there is such a y: the net is bounded from every initial marking. None: unknown."""
    conservative: bool | None
    """Whether there is one with y^T C = 0. None: unknown."""


def lyapunov(net: Net) -> Lyapunov:
    """Return a positive integer y with y^T C <= 0, or whether it is known that there is none.

    Three ways, in this order: the sum of all P-semiflows if they cover the places; the sum of the
    minimal y >= 0 with y^T C <= 0 if their enumeration stays small; linear programs for y and for
    firing counts that exclude it, whose solutions are rounded to fractions and checked exactly.
    """
    flows = place_semiflows(net)
    if flows.covers(len(net.places)):
        total: Vector = {}
        for y in flows.vectors:
            total = _combined(total, 1, y, 1)
        return Lyapunov(total, True, True)
    falling = _falling(net)
    weights: Vector | None
    if falling.complete:
        weights = {p: sum(y.get(p, 0) for y in falling.vectors) for p in range(len(net.places))}
        bounded: bool | None = all(weights.values())
        weights = weights if bounded else None
    else:
        weights = _programmed(net, conserved=False)
        bounded = True if weights else False if _grows(net, 0.0) else None
    if bounded is False or flows.complete:
        return Lyapunov(weights, bounded, False)
    if kept := _programmed(net, conserved=True):
        return Lyapunov(kept, True, True)
    return Lyapunov(weights, bounded, False if _grows(net, -1.0) else None)


def _programmed(net: Net, *, conserved: bool) -> Vector | None:
    """Return a positive integer y with y^T C <= 0, or y^T C = 0, by a linear program; None if none
    was found."""
    from scipy.optimize import linprog

    if overtime():
        return None
    n, rows = len(net.places), incidence(net).astype(float).T
    zero = np.zeros(len(rows))
    part = {"A_eq": rows, "b_eq": zero} if conserved else {"A_ub": rows, "b_ub": zero}
    found = linprog(np.ones(n), **part, bounds=[(1, None)] * n, method="highs")
    for y in _rounded(found.x) if found.status == 0 else ():
        drift = [sum(y.get(p, 0) * c for p, c in changes) for changes in net.compiled.changes]
        if (
            len(y) == n
            and min(y.values()) > 0
            and max(drift) <= 0
            and not (conserved and any(drift))
        ):
            return y
    return None


def _grows(net: Net, least: float) -> bool:
    """Return whether firing counts x >= `least` were found with C x >= 0 and C x not 0.

    With x >= 0 there is no y > 0 with y^T C <= 0, and with x of any sign none with y^T C = 0:
    y^T (C x) would be positive. Without such an x there is such a y (lemmas of Farkas and Stiemke).
    """
    from scipy.optimize import linprog

    if overtime():
        return False
    C = incidence(net).astype(float)
    n = C.shape[1]
    found = linprog(
        -C.sum(axis=0), A_ub=-C, b_ub=np.zeros(len(C)), bounds=[(least, 1.0)] * n, method="highs"
    )
    for x in _rounded(found.x) if found.status == 0 else ():
        gain: Vector = {}
        for t, count in x.items():
            gain = _combined(gain, 1, dict(net.compiled.changes[t]), count)
        if gain and min(gain.values()) > 0 and (least < 0 or min(x.values()) > 0):
            return True
    return False


def _rounded(values: NDArray[np.float64]) -> Iterator[Vector]:
    """Yield integer vectors that are close to a multiple of the values: first those by fractions
    with small denominators, since the weights of real nets are small."""
    for largest in (1, 12, 1000, 10**6):
        near = [Fraction(float(v)).limit_denominator(largest) for v in values]
        scale = lcm(*(f.denominator for f in near))
        yield {i: int(f * scale) for i, f in enumerate(near) if f}


def is_strictly_conservative(net: Net) -> bool:
    """Return whether no firing changes the total number of tokens."""
    return all(sum(c for _, c in changes) == 0 for changes in net.compiled.changes)


def conflict_sets(net: Net) -> list[tuple[int, ...]]:
    """Return the groups of two or more transitions that share input places.

    The relation is closed transitively (union-find).
    """
    group = list(range(len(net.transitions)))

    def root(t: int) -> int:
        while group[t] != t:
            group[t] = group[group[t]]
            t = group[t]
        return t

    owner: dict[int, int] = {}
    for t in range(len(net.transitions)):
        for p, _ in net.consume[t]:
            group[root(t)] = root(owner.setdefault(p, t))
    sets: dict[int, list[int]] = {}
    for t in range(len(net.transitions)):
        sets.setdefault(root(t), []).append(t)
    return [tuple(members) for members in sets.values() if len(members) > 1]


def exclusive_places(net: Net, flows: Semiflows) -> set[tuple[int, int]]:
    """Return pairs of places that are never marked together: y(p) + y(q) > y^T M0 for some y."""
    pairs: set[tuple[int, int]] = set()
    for y in flows.vectors:
        total = sum(weight * net.initial[p] for p, weight in y.items())
        support = sorted(y)
        pairs.update(
            (p, q) for i, p in enumerate(support) for q in support[i + 1 :] if y[p] + y[q] > total
        )
    return pairs
