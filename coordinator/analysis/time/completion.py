"""Time until a task is complete, and its probability: moments, distribution, quantiles.

Let T be the time to completion, h the probability of completing, y = E[T; complete] and
z = E[T^2; complete], each by marking. A holds the jump probabilities among the markings that can
still complete, s the mean sojourn times (s). Each of the three satisfies x = b + A x:

    h with b = probability of jumping into the goal
    y with b = s h
    z with b = 2 s^2 h + 2 s A y

These are first-step equations of absorbing chains (J. G. Kemeny, J. L. Snell, Finite Markov Chains,
1960, chapter 3). The distribution of T given completion comes from uniformisation.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from petrobot.coordinator.analysis.limits import keep_time
from petrobot.coordinator.analysis.net.graph import Mask, sum_by
from petrobot.coordinator.analysis.time.gspn import Chain, Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve
from petrobot.coordinator.analysis.time.markov import Generator, poisson_weights, visits_before


class Completion(Struct, frozen=True):
    """Completion from the initial marking. Times in seconds, given that the task completes."""

    chain: Chain
    goal: Mask
    h: Values
    """Probability of completing, from each marking."""
    y: Values
    """E[T; complete] from each marking (s)."""
    z: Values
    """E[T^2; complete] from each marking (s^2)."""
    residual: float
    """Largest error of the three equations, relative to their largest values."""

    @property
    def probability(self) -> float:
        """Probability of completing."""
        return float(self.h[0])

    @property
    def mean(self) -> float:
        """Mean time to completion (s), given completion; nan if the task cannot complete."""
        return float(self.y[0] / self.h[0]) if self.h[0] else float("nan")

    @property
    def variance(self) -> float:
        """Variance of the time to completion (s^2), given completion; nan if it is impossible."""
        return max(0.0, float(self.z[0] / self.h[0]) - self.mean**2) if self.h[0] else float("nan")


def completion(chain: Chain, goal: Mask) -> Completion:
    """Return time and probability of first reaching a marking of `goal` (mask of shape (n,))."""
    inside = chain.graph.backward(goal) & ~goal
    plan = SolveOrder.of(chain.graph, inside)
    open_ = inside[chain.source]
    value = np.where(open_ & inside[chain.target], chain.probability, 0.0)
    direct = open_ & goal[chain.target]
    arrive = sum_by(chain.source[direct], chain.probability[direct], chain.n)
    s = np.where(inside, chain.sojourn, 0.0)
    h = solve(plan, value, np.where(inside, arrive, 0.0))
    y = solve(plan, value, s * h)
    z = solve(plan, value, 2 * s * s * h + 2 * s * _apply(chain, value, y))
    residual = max(
        _error(chain, value, x, b)
        for x, b in ((h, arrive), (y, s * h), (z, 2 * s * s * h + 2 * s * _apply(chain, value, y)))
    )
    h[goal] = 1.0
    return Completion(chain, goal, h, y, z, residual)


def _apply(chain: Chain, value: Values, x: Values) -> Values:
    return sum_by(chain.source, value * x[chain.target], chain.n)


def _error(chain: Chain, value: Values, x: Values, b: Values) -> float:
    largest = float(np.max(np.abs(x), initial=0.0))
    return (
        float(np.max(np.abs(b + _apply(chain, value, x) - x), initial=0.0)) / largest
        if largest
        else 0.0
    )


LOOK = 16
"""Jumps between two checks of how much probability is still to come."""


class CompletionTime(Struct, frozen=True):
    """Distribution of the time to completion, by uniformisation.

    Jumps occur as a Poisson process of `rate` (1/s); absorbed[k] is the probability that the goal
    is reached within k jumps. Source: W. K. Grassmann, Transient solutions in Markovian queueing
    systems, Comput. Oper. Res. 4 (1977).
    """

    rate: float
    absorbed: Values
    probability: float

    def cdf(self, time: float) -> float:
        """Return P(T <= time | complete), with time in s."""
        low, weight = poisson_weights(self.rate * time)
        k = np.minimum(np.arange(low, low + len(weight)), len(self.absorbed) - 1)
        return min(1.0, float(weight @ self.absorbed[k]) / self.probability)

    def quantile(self, q: float) -> float:
        """Return the least time t (s) with P(T <= t | complete) >= q, 0 < q < 1."""
        if not 0 < q < 1:
            raise ValueError(f"quantile: expected 0 < q < 1, got {q}")
        if self.absorbed[0] >= q * self.probability:
            return 0.0
        low, high = 0.0, 1.0 / self.rate
        while self.cdf(high) < q:
            low, high = high, 2 * high
        for _ in range(100):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.cdf(middle) < q else (low, middle)
            if high - low <= 1e-12 * high:
                break
        return 0.5 * (low + high)


def completion_time(
    chain: Chain, goal: Mask, *, left: float = 1e-12, steps: int = 2_000_000
) -> CompletionTime:
    """Return the distribution of the time to completion.

    The computation stops when a share of at most `left` of the completing runs is still active.
    Raises ArithmeticError if that takes more than `steps` jumps.
    """
    whole = completion(chain, goal)
    ends = Chain(
        chain.gspn, chain.space, *_open_edges(chain, whole), chain.vanishing & ~goal & (whole.h > 0)
    )
    made = Generator.of(ends)
    reached = goal[made.tangible]
    p, absorbed = made.start, [float(made.start[reached].sum())]
    # What is still to come is summed directly. As the difference 1 - absorbed it would never become
    # smaller than rounding errors.
    ahead = np.where(reached, 0.0, whole.h[made.tangible])
    while (len(absorbed) - 1) % LOOK or float(np.sum(p * ahead)) > left * whole.probability:
        keep_time("distribution of the completion time")
        if len(absorbed) > steps:
            raise ArithmeticError(
                f"the distribution of the completion time needs more than {steps} jumps; "
                "simulate instead"
            )
        p = made.matrix @ p
        absorbed.append(float(p[reached].sum()))
    return CompletionTime(made.rate, np.array(absorbed), whole.probability)


def _open_edges(
    chain: Chain, whole: Completion
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Values]:
    """Return the edges of the chain that leave markings which can still complete."""
    going = (~whole.goal & (whole.h > 0))[chain.source]
    return chain.source[going], chain.target[going], chain.label[going], chain.amount[going]


# --- sensitivity ---
# Exact derivatives of completion with respect to each rate and weight.
#
# Let a_e = r_e / q be the probability of edge e from marking i to j, where r_e is its amount and q
# the sum of amounts of its marking. A change d(log theta) of a transition's rate or weight scales
# the amounts of its edges. For x = b + A x this gives
#
#     dx_0 / d(log theta) = sum over the edges of the transition of v_i a_e (x_j - x_i)
#
# with v the expected visits before the end: one adjoint solve serves all parameters. The change of
# the sojourn time needs no term of its own, because x_i contains it. Source: X.-R. Cao, Stochastic
# Learning and Optimization, Springer 2007.


class Slope(Struct, frozen=True):
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
