"""Exact derivatives of completion with respect to each rate and weight.

Let a_e = r_e / q be the probability of edge e from marking i to j, where r_e is its amount and q
the sum of amounts of its marking. A change d(log theta) of a transition's rate or weight scales the
amounts of its edges. For x = b + A x this gives

    dx_0 / d(log theta) = sum over the edges of the transition of v_i a_e (x_j - x_i)

with v the expected visits before the end: one adjoint solve serves all parameters. The change of
the sojourn time needs no term of its own, because x_i contains it.
Source: X.-R. Cao, Stochastic Learning and Optimization, Springer 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petrobot.coordinator.analysis.net.graph import sum_by
from petrobot.coordinator.analysis.time.completion import Completion
from petrobot.coordinator.analysis.time.gspn import Chain, Values
from petrobot.coordinator.analysis.time.markov import visits_before


@dataclass(frozen=True, slots=True)
class Slope:
    """How a number changes with one parameter.

    `derivative` is per unit of the parameter, `elasticity` in per cent per per cent. If the weights
    of immediate transitions are the probabilities of a random switch, moving probability from one
    branch to another changes the number by the difference of their derivatives.
    """

    value: float
    """The rate (1/s) or weight."""
    derivative: float
    elasticity: float


def slopes_of(chain: Chain, by_edge: Values, whole: float) -> dict[str, Slope]:
    """Return the derivatives by transition, from each edge's contribution to d / d(log theta)."""
    gspn = chain.gspn
    logs = sum_by(chain.label, by_edge, len(gspn.net.transitions))
    out = {}
    for t, name in enumerate(gspn.net.transitions):
        rate = gspn.rate[t]
        value = rate if rate is not None else gspn.weight[t]
        out[name] = Slope(value, float(logs[t] / value), float(logs[t] / whole) if whole else 0.0)
    return out


def reliability_slopes(done: Completion) -> dict[str, Slope]:
    """Return the derivatives of the probability of completing, by transition."""
    chain, h = done.chain, done.h
    by_edge = _flow(done) * (h[chain.target] - h[chain.source])
    return slopes_of(chain, by_edge, done.probability)


def time_slopes(done: Completion) -> dict[str, Slope]:
    """Return the derivatives of the mean time to completion (s), given completion; all 0 for what
    never completes."""
    chain, h, y = done.chain, done.h, done.y
    if not done.probability:
        return slopes_of(chain, np.zeros(len(chain.label)), 0.0)
    flow = _flow(done)
    transient = _transient(done)
    # y = s h + A y also changes through h, weighted with the time spent in each marking. A second
    # adjoint solve adds up that part; the quotient rule for y / h follows below.
    weighted = np.where(transient, _visits(done) * np.where(transient, chain.sojourn, 0.0), 0.0)
    second = visits_before(chain, transient, weighted)
    second_flow = second[chain.source] * chain.probability
    dh = h[chain.target] - h[chain.source]
    dy = y[chain.target] - y[chain.source]
    changed_y = flow * dy + second_flow * dh
    by_edge = changed_y / done.probability - done.mean / done.probability * flow * dh
    return slopes_of(chain, by_edge, done.mean)


def _transient(done: Completion) -> np.ndarray:
    out: np.ndarray = (done.h > 0) & ~done.goal
    return out


def _visits(done: Completion) -> Values:
    return visits_before(done.chain, _transient(done))


def _flow(done: Completion) -> Values:
    """Return the expected number of times each edge is taken while the run can still complete."""
    visits = np.where(_transient(done), _visits(done), 0.0)
    out: Values = visits[done.chain.source] * done.chain.probability
    return out
