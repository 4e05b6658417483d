"""Exact derivatives of completion and throughput with respect to each rate and weight.

Let a_e = r_e / q be the probability of edge e from marking i to j, where r_e is its amount and q
the sum of amounts of its marking. A change d(log theta) of a transition's rate or weight scales the
amounts of its edges. For x = b + A x this gives

    dx_0 / d(log theta) = sum over the edges of the transition of v_i a_e (x_j - x_i)

with v the expected visits before the end: one adjoint solve serves all parameters. The change of
the sojourn time needs no term of its own, because x_i contains it. In the long run, flows take the
role of visits, and the bias g of the Poisson equation g = (f - R) s + A (g + gain) that of x.
Source: X.-R. Cao, Stochastic Learning and Optimization, Springer 2007.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from petrobot.coordinator.analysis.net.graph import Index, sum_by
from petrobot.coordinator.analysis.time.completion import Completion
from petrobot.coordinator.analysis.time.gspn import Chain, Values
from petrobot.coordinator.analysis.time.linear import (
    DENSE,
    SWEEPS,
    Coarse,
    NotConverged,
    triangular,
)
from petrobot.coordinator.analysis.time.markov import LongRun, visits_before


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


def reward_slopes(
    run: LongRun, state: Values | None = None, impulse: Mapping[str, float] | None = None
) -> dict[str, Slope]:
    """Return the derivatives of a mean reward per second (see `LongRun.reward`), by transition.

    Raises ValueError if several bottom components can be reached: their probabilities would change
    as well, which is not computed here.
    """
    chain = run.chain
    components = np.unique(chain.graph.components[np.flatnonzero(run.probability > 0)])
    if len(components) != 1:
        raise ValueError(
            "the long run may end in one of several bottom components; derivatives need a net "
            "with one"
        )
    members = np.flatnonzero(chain.graph.components == components[0])
    gain = np.zeros(len(chain.gspn.net.transitions))
    for name, amount in (impulse or {}).items():
        gain[chain.gspn.net.transition_index[name]] = amount
    reward = run.reward(state, impulse)
    bias = _bias(chain, members, reward, state, gain)
    by_edge = run.flow * (gain[chain.label] + bias[chain.target] - bias[chain.source])
    return slopes_of(chain, by_edge, reward)


def _bias(
    chain: Chain, members: Index, reward: float, state: Values | None, gain: Values
) -> Values:
    """Solve g = (f - R) s + A (g + gain) on one bottom component, with g = 0 at its first
    member."""
    if not chain.total[members].any():
        return np.zeros(chain.n)  # an absorbing marking has no rate to change
    number = np.full(chain.n, -1, dtype=np.int64)
    number[members] = np.arange(len(members))
    edges = np.flatnonzero(number[chain.source] >= 0)
    rows, columns = number[chain.source[edges]], number[chain.target[edges]]
    value = chain.probability[edges]
    rate = (state[members] if state is not None else 0.0) - reward
    right = rate * chain.sojourn[members]
    right = right + sum_by(rows, value * gain[chain.label[edges]], len(members))
    bias = np.zeros(chain.n)
    bias[members] = _singular(len(members), rows, columns, value, right)
    return bias


def _singular(n: int, rows: Index, columns: Index, value: Values, right: Values) -> Values:
    """Return the solution of x = right + A x with x_0 = 0, for a stochastic matrix A.

    I - A is singular: solutions differ by a constant, which x_0 = 0 fixes.
    """
    if n <= DENSE:
        matrix = np.eye(n)
        np.subtract.at(matrix, (rows, columns), value)
        x = np.zeros(n)
        x[1:] = np.linalg.solve(matrix[1:, 1:], right[1:])
        return x
    factor, lower = triangular(n, rows, columns, value)
    coarse, x = Coarse(n, rows, columns), np.zeros(n)
    inverse: Values | None = None
    for k in range(SWEEPS):
        before = x
        x = factor.solve(right + lower @ x)
        x = x - x[0]
        if np.max(np.abs(x - before)) <= 1e-12 * max(1e-300, float(np.max(np.abs(x)))):
            return np.asarray(x)
        if coarse.is_due(k):
            inverse = coarse.inverse(value, pinned=True) if inverse is None else inverse
            x = x + coarse.correction(inverse, right + sum_by(rows, value * x[columns], n) - x)
    raise NotConverged(
        f"the bias still moved by {np.max(np.abs(x - before)):.2e} after {SWEEPS} sweeps"
    )
