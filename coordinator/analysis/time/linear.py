"""Linear systems of Markov chains: x = b + A x, and stationary vectors nu = nu A.

A is given by the edges of a graph: x_i = b_i + sum over the edges e of i of a_e x_(target of e).

Most robot tasks use up their runs, so their graphs are long sequences of small strong components.
The components are solved in that order, successors first: small ones by dense elimination, large
ones by Gauss-Seidel.

Stationary vectors of up to DENSE vertices come from Grassmann-Taksar-Heyman (GTH) elimination. It
contains no subtraction, so no digits cancel (W. K. Grassmann, M. I. Taksar, D. P. Heyman,
Regenerative analysis and steady state distributions for Markov chains, Oper. Res. 33, 1985). Larger
ones come from Gauss-Seidel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import inf
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.coordinator.analysis.limits import keep_time
from petrobot.coordinator.analysis.net.graph import Graph, Index, Mask, ranges, sum_by
from petrobot.coordinator.analysis.time.gspn import Values

DENSE = 600
"""Vertices up to which a component is solved by dense elimination."""
DIRECT = 10_000
"""Vertices up to which a component on which coarse steps fail is solved by sparse elimination."""
COMPILED_FROM = 200_000
"""Vertices from which sweeps are compiled where numba is installed: loading it takes .4 s."""
SWEEPS = 20_000
"""The most sweeps of Gauss-Seidel."""
TOLERANCE = 1e-14
"""Largest change in a sweep, relative to the largest entry, at which the iteration stops."""


Sweep = Callable[[Values, Values], Values]
"""From (right, x) to the next x."""


class NotConverged(ArithmeticError):  # noqa: N818 - a fact about an iteration
    """An iteration did not reach its tolerance; the message says how far it came."""


class SolveOrder(Struct, frozen=True):
    """The order in which the strong components of a graph are solved: successors first.

    Built once and used for many right-hand sides.
    """

    graph: Graph
    waves: tuple[tuple[Index, tuple[Index, ...]], ...]
    """Waves of vertices that do not depend on each other: (single vertices, larger components).

    A wave depends only on earlier waves, so its single vertices are solved in one numpy operation.
    """

    @classmethod
    def of(cls, graph: Graph, inside: Mask | None) -> SolveOrder:
        """Return the order for the vertices in `inside` (by default all); the others count as 0."""
        keep = np.ones(graph.n, dtype=np.bool_) if inside is None else inside
        component = graph.components
        ours, theirs = component[graph.source], component[graph.target]
        crossing = (ours != theirs) & keep[graph.source] & keep[graph.target]
        outer = Graph(int(component.max()) + 1, *_sorted_edges(ours[crossing], theirs[crossing]))
        loops = np.zeros(outer.n, dtype=np.bool_)
        loops[ours[(ours == theirs) & keep[graph.source]]] = True
        wave = _waves(outer)
        members = np.flatnonzero(keep)
        members = members[np.lexsort((component[members], wave[component[members]]))]
        return cls(graph, tuple(_split(members, component, wave, loops)))


def _sorted_edges(source: Any, target: Any) -> tuple[Any, Any]:
    order = np.argsort(source, kind="stable")
    return source[order], target[order]


def _waves(outer: Graph) -> Index:
    """Return the length of the longest path from each vertex of an acyclic graph."""
    left = np.diff(outer.row)
    first, order = outer.into
    wave = np.zeros(outer.n, dtype=np.int64)
    front, depth = np.flatnonzero(left == 0), 0
    while len(front):
        keep_time("linear system")
        wave[front] = depth
        edges = order[ranges(first[front], first[front + 1])]
        before = outer.source[edges]
        np.subtract.at(left, before, 1)
        front, depth = np.unique(before[left[before] == 0]), depth + 1
    return wave


def _split(
    members: Index, component: Any, wave: Index, loops: Mask
) -> list[tuple[Index, tuple[Index, ...]]]:
    """Split the vertices, sorted by wave and component, into waves."""
    waves = []
    for part in np.split(members, np.flatnonzero(np.diff(wave[component[members]])) + 1):
        if not len(part):
            continue
        looping = loops[component[part]]
        larger = part[looping]
        groups = (
            np.split(larger, np.flatnonzero(np.diff(component[larger])) + 1) if len(larger) else []
        )
        waves.append((part[~looping], tuple(groups)))
    return waves


@np.errstate(over="raise", invalid="raise", divide="raise")
def solve(plan: SolveOrder, value: Values, b: Values) -> Values:
    """Solve x = b + A x, with A given by `value` on the edges.

    Raises ArithmeticError if the iteration does not converge, or a number overflows.
    """
    graph = plan.graph
    x = np.zeros_like(b, dtype=np.float64)
    for single, groups in plan.waves:
        keep_time("linear system")
        if len(single):
            x[single] = b[single] + _gather(graph, value, x, single)
        for group in groups:
            _solve_group(graph, value, x, b, group)
    return x


def _gather(graph: Graph, value: Values, x: Values, vertices: Index) -> Values:
    """Return the sum of value * x over the edges of each vertex."""
    first, last = graph.row[vertices], graph.row[vertices + 1]
    edges = ranges(first, last)
    owner = np.repeat(np.arange(len(vertices)), last - first)
    return sum_by(owner, value[edges] * x[graph.target[edges]], len(vertices))


def _solve_group(graph: Graph, value: Values, x: Values, b: Values, group: Index) -> None:
    """Solve one component in place; everything that it leads to is known already."""
    x[group] = 0.0  # so that _gather adds only what comes from other components
    right = b[group] + _gather(graph, value, x, group)
    edges = ranges(graph.row[group], graph.row[group + 1])
    number = np.full(graph.n, -1, dtype=np.int64)
    number[group] = np.arange(len(group))
    edges = edges[number[graph.target[edges]] >= 0]
    rows, columns = number[graph.source[edges]], number[graph.target[edges]]
    if len(group) <= DENSE:
        matrix = np.eye(len(group))
        np.subtract.at(matrix, (rows, columns), value[edges])
        x[group] = np.linalg.solve(matrix, right)
    else:
        x[group] = _sweep(len(group), rows, columns, value[edges], right)


def sweeps(n: int, rows: Index, columns: Index, value: Values) -> Sweep:
    """Return a sweep of backward Gauss-Seidel for x = right + A x."""
    from scipy.sparse import csc_array, csr_array, eye_array
    from scipy.sparse.linalg import splu

    if n >= COMPILED_FROM and (compiled := _compiled()) is not None:
        matrix = csr_array((value, (rows, columns)), shape=(n, n))
        held = matrix.indptr, matrix.indices, matrix.data
        return lambda right, x: compiled(*held, right, x.copy())
    # The upper part is triangular already. scipy's LU without reordering and pivoting turns it into
    # a compiled triangular solver.
    early = columns >= rows
    upper = csc_array((value[early], (rows[early], columns[early])), shape=(n, n))
    lower = csr_array((value[~early], (rows[~early], columns[~early])), shape=(n, n))
    factor = splu(
        csc_array(eye_array(n, format="csc") - upper), permc_spec="NATURAL", diag_pivot_thresh=0.0
    )
    return lambda right, x: np.asarray(factor.solve(right + lower @ x))


@cache
def _compiled() -> Callable[..., Values] | None:
    """Return `sweep_in_place`, compiled; None without numba."""
    from petrobot.services.host import numba_kernels

    return numba_kernels.kernel(sweep_in_place) if numba_kernels.COMPILED else None


def sweep_in_place(first: Index, column: Index, value: Values, right: Values, x: Values) -> Values:
    """Replace x by the next one and return it. The entries of row i of A, one per column, are those
    with first[i] <= k < first[i + 1]."""
    for i in range(len(x) - 1, -1, -1):
        total, own = right[i], 0.0
        for k in range(first[i], first[i + 1]):
            if column[k] == i:
                own = value[k]
            else:
                total += value[k] * x[column[k]]
        x[i] = total / (1.0 - own)
    return x


def _sweep(n: int, rows: Index, columns: Index, value: Values, right: Values) -> Values:
    """Solve x = right + A x by backward Gauss-Seidel.

    Backward, because successors mostly have higher numbers (breadth-first), so one sweep carries a
    change through the whole component. Where that converges slowly, a coarse step (see Coarse)
    removes the part of the error that is nearly constant over blocks of neighbours.
    """
    from scipy.sparse import csc_array, eye_array
    from scipy.sparse.linalg import splu

    sweep, coarse = sweeps(n, rows, columns, value), Coarse(n, rows, columns)
    x = sweep(right, np.zeros(n))
    inverse: Values | None = None
    helps, last = True, inf
    for k in range(SWEEPS):
        keep_time("linear system")
        before = x
        x = sweep(right, x)
        moved = float(np.max(np.abs(x - before)))
        if moved <= TOLERANCE * max(1e-300, float(np.max(np.abs(x)))):
            return x
        if not coarse.is_due(k):
            continue
        # The error may differ too much within the blocks: then coarse steps enlarge it, without a
        # bound. Sweeps alone always converge (I - A is an M-matrix), but slowly.
        helps, last = helps and moved < last, moved
        if not helps and n <= DIRECT:
            matrix = eye_array(n, format="csc") - csc_array((value, (rows, columns)), shape=(n, n))
            try:
                return np.asarray(splu(csc_array(matrix)).solve(right))
            except RuntimeError as fault:  # it is singular
                raise NotConverged(f"no direct solution either: {fault}") from fault
        if helps:
            inverse = coarse.inverse(value) if inverse is None else inverse
            x = x + coarse.correction(inverse, right + sum_by(rows, value * x[columns], n) - x)
    raise NotConverged(f"Gauss-Seidel still moved by {moved:.2e} after {SWEEPS} sweeps")


@np.errstate(over="raise", invalid="raise", divide="raise")
def stationary(n: int, rows: Index, columns: Index, value: Values) -> Values:
    """Return the probability vector nu = nu P of an irreducible stochastic matrix P.

    P is given by its entries. Small ones by GTH elimination, others by Gauss-Seidel with
    aggregation over blocks of neighbours where it is slow (J. R. Koury, D. F. McAllister, W. J.
    Stewart, Iterative methods for computing stationary distributions of nearly completely
    decomposable Markov chains, SIAM J. Alg. Disc. Meth. 5, 1984). Raises ArithmeticError,
    as `solve`.
    """
    if n == 1:
        return np.ones(1)
    if n <= DENSE:
        matrix = np.zeros((n, n))
        np.add.at(matrix, (rows, columns), value)
        return gth(matrix)
    # nu = nu P is a system with the transposed matrix. Reversing the numbers as well makes the
    # backward sweep run forward along the edges.
    sweep, zero = sweeps(n, n - 1 - columns, n - 1 - rows, value), np.zeros(n)
    coarse, x = Coarse(n, n - 1 - rows, n - 1 - columns), np.full(n, 1.0 / n)
    mixing = Mixing()
    helps, last, moved = True, inf, inf
    for k in range(SWEEPS):
        keep_time("stationary distribution")
        swept = sweep(zero, x)
        swept /= swept.sum()
        change = swept - x
        moved = max(float(change.max()), -float(change.min()))
        if moved <= TOLERANCE * float(swept.max()):
            return swept[::-1].copy()
        if helps and coarse.is_due(k):
            # Where x differs much within the blocks, a coarse step undoes what the sweeps gained.
            helps, last = moved < HELPS * last, moved
        if helps and coarse.is_due(k):
            x = swept * coarse.scale(value, swept)
            x /= x.sum()
            mixing = Mixing()
            continue
        mixed = mixing.next(swept, change)
        # A mixture may have negative entries, of which aggregation and sums make no sense.
        x = mixed if float(mixed.min()) > 0 else swept
    raise NotConverged(f"the stationary vector still moved by {moved:.2e} after {SWEEPS} sweeps")


HELPS = 0.9
"""What is left of the change from one coarse step to the next, at most: where more is left, it
hardly converges, and sweeps alone are better."""


class Mixing:
    """Anderson's acceleration of a fixed-point iteration x = g(x), here of the sweeps.

    The next x is the combination of the last DEPTH + 1 results whose changes g(x) - x nearly cancel
    (least squares). For linear g that is about as good as GMRES: Kanban-4 takes 91 sweeps instead
    of 231. Source: D. G. Anderson, Iterative procedures for nonlinear integral equations, J. ACM 12
    (1965).
    """

    DEPTH = 4

    def __init__(self) -> None:
        """Begin without any results."""
        self.last: tuple[Values, Values] | None = None
        self.results: list[Values] = []
        self.changes: list[Values] = []
        self.gram = np.zeros((0, 0))

    def next(self, result: Values, change: Values) -> Values:
        """Return the next x from g(x) and g(x) - x."""
        if self.last is not None:
            self.results = [*self.results, result - self.last[0]][-self.DEPTH :]
            self.changes = [*self.changes, change - self.last[1]][-self.DEPTH :]
            kept = self.gram[-(self.DEPTH - 1) :, -(self.DEPTH - 1) :]
            new = [_dot(a, self.changes[-1]) for a in self.changes]
            self.gram = np.zeros((len(new), len(new)))
            self.gram[:-1, :-1] = kept
            self.gram[-1, :] = self.gram[:, -1] = new
        self.last = result, change
        if not self.changes:
            return result
        right = np.array([_dot(a, change) for a in self.changes])
        weight = np.linalg.lstsq(self.gram, right, rcond=1e-14)[0]
        out = result.copy()
        for w, step in zip(weight.tolist(), self.results, strict=True):
            out -= w * step
        return out


def _dot(a: Values, b: Values) -> float:
    """Return the scalar product, on one core: the threads of BLAS wait for each other longer than
    they compute."""
    return float(np.einsum("i,i->", a, b))


class Coarse:
    """Aggregation for systems on which Gauss-Seidel converges slowly.

    Vertices are grouped into blocks of consecutive numbers, which are neighbours in breadth-first
    order. A small system over the blocks finds the error that is constant within each block; this
    is the part that sweeps remove slowest (as in multigrid methods).
    """

    PATIENCE, EVERY, BLOCKS = 60, 5, 128
    """Sweeps before the first coarse step, sweeps between two of them, number of blocks."""

    def __init__(self, n: int, rows: Index, columns: Index) -> None:
        """Assign n vertices to blocks of equal size; the entries of the matrix are (rows,
        columns)."""
        self.count = min(self.BLOCKS, n)
        self.block = np.arange(n) * self.count // n
        self.rows, self.pair = rows, self.block[rows] * self.count + self.block[columns]

    def is_due(self, sweep: int) -> bool:
        """Return whether a coarse step follows this sweep."""
        return sweep >= self.PATIENCE and sweep % self.EVERY == 0

    def _matrix(self, weights: Values) -> Values:
        return sum_by(self.pair, weights, self.count**2).reshape(self.count, self.count)

    def scale(self, value: Values, x: Values) -> Values:
        """Return the factor that corrects the block of each vertex, for a stationary vector x.

        The chain of blocks has the transition probabilities flow(I, J) / sum of x over I. Its
        stationary vector divided by these sums is the stationary vector of the flow matrix itself,
        so GTH runs on the flows directly. The factors are correct up to a common factor.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = gth(self._matrix(value * x[self.rows]))
        # A block whose probability underflows has no flow: then continue with sweeps alone.
        return (
            np.asarray(factor[self.block])
            if np.isfinite(factor).all() and factor.min() > 0
            else np.ones(len(x))
        )

    def inverse(self, value: Values) -> Values:
        """Return the inverse of I - A aggregated over the blocks, for `correction`."""
        size = np.bincount(self.block, minlength=self.count)
        return np.asarray(np.linalg.inv(np.diag(size.astype(float)) - self._matrix(value)))

    def correction(self, inverse: Values, left: Values) -> Values:
        """Return what to add to x, constant over each block, if x = right + A x has the residual
        `left`."""
        return np.asarray((inverse @ sum_by(self.block, left, self.count))[self.block])


def gth(matrix: Values) -> Values:
    """Return the stationary vector of an irreducible stochastic matrix or generator.

    GTH elimination. The last state is removed and its flow is passed on to the others, in
    proportion to where it goes; then the probabilities are computed from the first state upwards.
    The diagonal, which would need subtractions, is never used.
    """
    work = matrix.copy()
    n = len(work)
    for k in range(n - 1, 0, -1):
        work[:k, k] /= work[k, :k].sum()
        work[:k, :k] += np.outer(work[:k, k], work[k, :k])
    x = np.ones(n)
    for k in range(1, n):
        x[k] = x[:k] @ work[:k, k]
    out: Values = x / x.sum()
    return out
