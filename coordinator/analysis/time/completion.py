"""How long until a task is complete, and with what probability: moments, distribution and quantiles
from the initial marking.

With h the probability of ever completing, y = E[T; complete] and z = E[T^2; complete], each
satisfies x = b + A x over the markings that can still complete (A the jump probabilities, s the
mean sojourn): h from b = the jumps into the goal, y from b = s h, z from b = 2 s^2 h + 2 s A y. The
law of T given completion comes from uniformisation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from petrobot.coordinator.analysis.net.graph import Mask, sum_by
from petrobot.coordinator.analysis.time.gspn import Chain, Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve
from petrobot.coordinator.analysis.time.markov import Generator, poisson_weights


@dataclass(frozen=True)
class Completion:
    """Completion from the initial marking. Times are in seconds and conditional on completing."""

    chain: Chain
    goal: Mask
    plan: SolveOrder = field(repr=False)
    h: Values = field(repr=False)
    """Probability of completing, from each marking."""
    y: Values = field(repr=False)
    """E[T; complete] from each marking (s)."""
    z: Values = field(repr=False)
    """E[T^2; complete] from each marking (s^2)."""
    residual: float
    """Largest error of the three equations, relative to their largest value."""

    @property
    def probability(self) -> float:
        """Probability of completing."""
        return float(self.h[0])

    @property
    def mean(self) -> float:
        """Mean time to completion, given completion (s); nan if it is impossible."""
        return float(self.y[0] / self.h[0]) if self.h[0] else float("nan")

    @property
    def variance(self) -> float:
        """Variance of the time to completion, given completion (s^2)."""
        return max(0.0, float(self.z[0] / self.h[0]) - self.mean**2) if self.h[0] else float("nan")


def completion(chain: Chain, goal: Mask) -> Completion:
    """Time and probability of reaching a marking of `goal` (shape (n,)) for the first time."""
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
    return Completion(chain, goal, plan, h, y, z, residual)


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
"""Jumps between two looks at how much is still to come."""


@dataclass(frozen=True)
class CompletionTime:
    """The distribution of the time to completion: after k uniform jumps at `rate` the goal is
    reached with absorbed[k]."""

    rate: float
    absorbed: Values
    probability: float

    def cdf(self, time: float) -> float:
        """P(T <= time | complete)."""
        low, weight = poisson_weights(self.rate * time)
        k = np.minimum(np.arange(low, low + len(weight)), len(self.absorbed) - 1)
        return min(1.0, float(weight @ self.absorbed[k]) / self.probability)

    def quantile(self, q: float) -> float:
        """The time t (s) with P(T <= t | complete) = q, 0 < q < 1."""
        if not 0 < q < 1:
            raise ValueError(f"a quantile needs 0 < q < 1, not {q}")
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
    """The law of the time to completion. `left` is the share of completing runs still under way
    where it is cut off.

    Raises ArithmeticError if that takes more than `steps` jumps.
    """
    whole = completion(chain, goal)
    ends = Chain(
        chain.gspn, chain.space, *_open_edges(chain, whole), chain.vanishing & ~goal & (whole.h > 0)
    )
    made = Generator.of(ends)
    reached = goal[made.tangible]
    p, absorbed = made.start, [float(made.start[reached].sum())]
    # what is still to come is weighed by itself: as a difference of sums it would never fall below
    # their rounding
    ahead = np.where(reached, 0.0, whole.h[made.tangible])
    while (len(absorbed) - 1) % LOOK or float(np.sum(p * ahead)) > left * whole.probability:
        if len(absorbed) > steps:
            raise ArithmeticError(
                f"the law of completion needs more than {steps} jumps; simulate instead"
            )
        p = made.matrix @ p
        absorbed.append(float(p[reached].sum()))
    return CompletionTime(made.rate, np.array(absorbed), whole.probability)


def _open_edges(
    chain: Chain, whole: Completion
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Values]:
    """The chain's edges out of markings that are not yet complete but still can be."""
    going = (~whole.goal & (whole.h > 0))[chain.source]
    return chain.source[going], chain.target[going], chain.label[going], chain.amount[going]
