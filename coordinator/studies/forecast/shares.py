"""Tests of shares: the predictive distribution of a share of new trials, and Holm's adjustment.

The distribution is beta-binomial around the forecast. Its weight is the number of trials that would
give the forecast's own uncertainty, with the Jeffreys prior: a share of 1 that was forecast from n
trials still allows a miss in another n.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import betabinom


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values by Holm's method: each one can then be compared with the significance level
    for all of them together."""
    order = np.argsort(p_values, kind="stable")
    out, largest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        out[i] = largest
    return out


def share_weight(value: float, sd: float, runs: int, training: int) -> float:
    """Return how many trials a forecast share is worth: from its predictive variance minus the
    sampling variance of `runs` new trials.

    At most the number of training trials; exactly that number if the bootstrap saw no variation.
    """
    # variance of a new share = value (1 - value) / runs + own variance of the forecast;
    # a share of weight w has the own variance value (1 - value) / w
    noise = value * (1.0 - value)
    own = sd * sd - noise / runs
    return float(training) if noise <= 0.0 or own <= noise / training else max(2.0, noise / own)


def _beta(value: float, weight: float) -> tuple[float, float]:
    return value * weight + 0.5, (1.0 - value) * weight + 0.5


def predictive_interval(value: float, weight: float, n: int, level: float = 0.95) -> list[float]:
    """Return the interval in which a share of n new trials is expected."""
    a, b = _beta(value, weight)
    low, high = betabinom.ppf([(1 - level) / 2, (1 + level) / 2], n, a, b)
    return [round(float(low) / n, 6), round(float(high) / n, 6)]


def share_p_value(value: float, weight: float, count: int, n: int) -> float:
    """Return the two-sided p-value of `count` successes among n new trials."""
    a, b = _beta(value, weight)
    below, above = float(betabinom.cdf(count, n, a, b)), float(betabinom.sf(count - 1, n, a, b))
    return min(1.0, 2.0 * min(below, above))
