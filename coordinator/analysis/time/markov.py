"""The long run of a GSPN (throughput, mean tokens, utilisation), and its uniformised chain.

In the long run the chain stays in one of the bottom components of its graph. Seen from the initial
marking, the long run is the mixture of their stationary vectors, weighted with the probabilities of
ending in each. The result carries the residual of its balance equations.
"""

from __future__ import annotations

from functools import cached_property
from math import ceil, exp, lgamma, log, sqrt
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.coordinator.analysis.net.graph import Graph, Index, sum_by
from petrobot.coordinator.analysis.time.gspn import Chain, Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve, stationary


class LongRun(Struct, frozen=True, dict=True):
    """Stationary behaviour from the initial marking.

    `probability[i]` is the share of time in marking i (0 if vanishing), `flow[e]` the frequency of
    edge e (1/s), `residual` the largest difference of flow into and out of a marking (1/s).
    """

    chain: Chain
    probability: Values
    flow: Values
    residual: float

    @cached_property
    def throughput(self) -> dict[str, float]:
        """Firings per second of each transition."""
        names = self.chain.gspn.net.transitions
        total = sum_by(self.chain.label, self.flow, len(names))
        return dict(zip(names, total.tolist(), strict=True))

    @cached_property
    def mean_tokens(self) -> dict[str, float]:
        """Time average of the tokens of each place."""
        space = self.chain.space
        return {
            name: float(self.probability @ space.tokens(p))
            for p, name in enumerate(space.net.places)
        }

    @cached_property
    def occupancy(self) -> dict[str, float]:
        """Share of time in which each place is marked.

        The utilisation of a resource is 1 minus the share of the place that holds it while free.
        """
        space = self.chain.space
        return {
            name: float(self.probability @ (space.tokens(p) > 0))
            for p, name in enumerate(space.net.places)
        }

    @cached_property
    def utilisation(self) -> dict[str, float]:
        """Mean number of busy servers of each timed transition (with one server: its load)."""
        rates = self.chain.gspn.rate
        return {
            name: self.throughput[name] / r
            for name, r in zip(self.throughput, rates, strict=True)
            if r is not None
        }


def long_run(chain: Chain) -> LongRun:
    """Return the stationary behaviour. The chain stays in an absorbing (dead) marking for ever."""
    graph = chain.graph
    visits = np.zeros(chain.n)
    time = np.zeros(chain.n)
    for component, share in _absorption(chain).items():
        members = np.flatnonzero(graph.components == component)
        if len(members) == 1 and not chain.total[members[0]]:
            time[members[0]] += share
            continue
        nu = _embedded(chain, members)
        length = float(nu @ chain.sojourn[members])
        visits[members] += share * nu / length
        time[members] += share * nu * chain.sojourn[members] / length
    flow = visits[chain.source] * chain.probability
    ins = sum_by(chain.target, flow, chain.n)
    residual = float(np.max(np.abs(ins - visits), initial=0.0))
    return LongRun(chain, time, flow, residual)


def _embedded(chain: Chain, members: Index) -> Values:
    """Return the stationary vector of the jump chain of one bottom component."""
    number = np.full(chain.n, -1, dtype=np.int64)
    number[members] = np.arange(len(members))
    edges = np.flatnonzero(number[chain.source] >= 0)
    return stationary(
        len(members),
        number[chain.source[edges]],
        number[chain.target[edges]],
        chain.probability[edges],
    )


def _absorption(chain: Chain) -> dict[int, float]:
    """Return the probability of ending in each bottom component that can be reached."""
    graph = chain.graph
    bottoms = np.flatnonzero(graph.bottom)
    if len(bottoms) == 1:
        return {int(bottoms[0]): 1.0}
    transient = ~graph.bottom[graph.components]
    if not transient[0]:
        return {int(graph.components[0]): 1.0}
    entries = visits_before(chain, transient)
    into = entries[chain.source] * chain.probability
    crossing = transient[chain.source] & ~transient[chain.target]
    share = sum_by(graph.components[chain.target[crossing]], into[crossing], len(graph.bottom))
    return {int(c): float(share[c]) for c in bottoms}


def visits_before(chain: Chain, transient: Any, start: Values | None = None) -> Values:
    """Return the expected visits to each transient marking: v = start + v A (adjoint solve).

    By default the chain starts in the initial marking.
    """
    order = np.argsort(chain.target, kind="stable")
    backward = Graph(chain.n, chain.target[order], chain.source[order])
    begin = np.zeros(chain.n)
    begin[0] = 1.0
    inside = transient[chain.source[order]] & transient[chain.target[order]]
    value = np.where(inside, chain.probability[order], 0.0)
    return solve(SolveOrder.of(backward, transient), value, begin if start is None else start)


class Generator(Struct, frozen=True):
    """The chain over tangible markings only, uniformised: P = I + Q / rate, Q its generator."""

    tangible: Index
    matrix: Any
    """P transposed (sparse), so that one step is matrix @ p."""
    rate: float
    start: Values

    @classmethod
    def of(cls, chain: Chain) -> Generator:
        """Eliminate the vanishing markings, since uniformisation needs a sojourn time above 0."""
        from scipy.sparse import csr_array, eye_array

        tangible = chain.tangible
        number = np.full(chain.n, -1, dtype=np.int64)
        number[tangible] = np.arange(len(tangible))
        jump = _jumps(chain)
        start = np.zeros(chain.n)
        start[0] = 1.0
        start = (jump.T @ start)[tangible] if chain.vanishing[0] else start[tangible]
        timed = np.flatnonzero(~chain.vanishing[chain.source])
        shape = (len(tangible), chain.n)
        rates = csr_array(
            (chain.amount[timed], (number[chain.source[timed]], chain.target[timed])), shape=shape
        )
        flows = rates[:, tangible] if not chain.vanishing.any() else (rates @ jump)[:, tangible]
        total = np.where(chain.vanishing, 0.0, chain.total)[tangible]
        fastest = float(total.max(initial=0.0)) or 1.0
        scaled = csr_array(flows / fastest)
        stay = eye_array(len(tangible), format="csr")
        stay.data = 1.0 - total / fastest
        return cls(tangible, csr_array((scaled + stay).T), fastest, start)


def _jumps(chain: Chain) -> Any:
    """Return the probability of each tangible marking to be the next one, from each marking.

    Sparse, shape (n, n); the identity for tangible markings. Probability is pushed through the
    vanishing markings step by step until none is left there. Cycles among them are removed first,
    so the number of steps is bounded by the longest path of vanishing markings.
    """
    from scipy.sparse import csr_array, eye_array

    eye = csr_array(eye_array(chain.n, format="csr"))
    if not chain.vanishing.any():
        return eye
    edges = np.flatnonzero(chain.vanishing[chain.source])
    step = csr_array(
        (chain.probability[edges], (chain.source[edges], chain.target[edges])),
        shape=(chain.n, chain.n),
    )
    step = _without_cycles(chain, step)
    keep = csr_array(
        (np.where(chain.vanishing, 0.0, 1.0), (np.arange(chain.n),) * 2), shape=(chain.n, chain.n)
    )
    keep.eliminate_zeros()
    out, front = (
        keep,
        csr_array(
            (chain.vanishing.astype(float), (np.arange(chain.n),) * 2), shape=(chain.n, chain.n)
        ),
    )
    front.eliminate_zeros()
    while front.nnz:
        front = front @ step
        front.eliminate_zeros()
        out = out + front @ keep
        front = front - front @ keep
        front.eliminate_zeros()
    return csr_array(out)


def _without_cycles(chain: Chain, step: Any) -> Any:
    """Return the steps out of vanishing markings, with every cycle replaced by what it leads to.

    For a strong component with the matrix W inside and R to the outside, the probabilities of
    leaving it are (I - W)^-1 R.
    """
    from scipy.sparse import csr_array

    inner = np.flatnonzero(chain.vanishing[chain.source] & chain.vanishing[chain.target])
    graph = Graph(chain.n, chain.source[inner], chain.target[inner])
    cyclic = np.unique(graph.components[graph.source[graph.inner]])
    if not len(cyclic):
        return step
    rows = step.tolil()
    for component in cyclic.tolist():
        members = np.flatnonzero(graph.components == component)
        block = step[members]
        within = block[:, members].toarray()
        outside = block.toarray()
        outside[:, members] = 0.0
        rows[members] = np.linalg.solve(np.eye(len(members)) - within, outside)
    cleaned = csr_array(rows)
    cleaned.eliminate_zeros()
    return cleaned


def poisson_weights(mean: float) -> tuple[int, Values]:
    """Return (first k, probabilities from there on) of a Poisson distribution.

    Less than 1e-13 is left out on both sides. Starting at the mode and multiplying outwards
    avoids overflow and underflow of mean^k / k!. Source: B. L. Fox, P. W. Glynn, Computing Poisson
    probabilities, Commun. ACM 31 (1988).
    """
    if mean == 0:
        return 0, np.ones(1)
    epsilon = 1e-13
    reach = ceil(sqrt(mean) * sqrt(-2 * log(epsilon)) + 10 - log(epsilon))
    low, high = max(0, int(mean) - reach), int(mean) + reach + 10
    k = np.arange(low, high + 1)
    mode = int(mean)
    weight = np.empty(len(k))
    weight[mode - low] = exp(mode * log(mean) - mean - lgamma(mode + 1))
    up = np.cumprod(mean / k[k > mode]) * weight[mode - low]
    down = np.cumprod(k[(k <= mode) & (k > low)][::-1] / mean) * weight[mode - low]
    weight[k > mode], weight[k < mode] = up, down[::-1]
    total: Values = weight / weight.sum()
    return low, total
