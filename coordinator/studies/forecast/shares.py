"""Tests of shares: the predictive distribution of a share of new trials, and Holm's adjustment.

A share that is worth `weight` trials is compared with a share of new trials as the hypergeometric
test compares two samples (A. R. Thatcher, J. Royal Statistical Society B 26 (1964) 176-192): each
limit is a beta-binomial quantile, and the interval holds at least its level for every true share.
So a share of 1 that was forecast from n trials still allows a miss in another n.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import betabinom

from petrobot.coordinator.learning.statistics import clopper_pearson


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


def _counts(value: float, weight: float) -> tuple[float, float]:
    """Return for how many trials it happened, and for how many not. Rounded: a shape parameter of
    1e-300 instead of 0 makes the beta-binomial distribution fail."""
    return round(value * weight, 6), round((1.0 - value) * weight, 6)


def confidence_interval(value: float, weight: float) -> list[float]:
    """Return the interval of the true share; it holds at least its level."""
    yes, no = _counts(value, weight)
    return [round(bound, 6) for bound in clopper_pearson(yes, yes + no)]


def predictive_interval(value: float, weight: float, n: int) -> list[float]:
    """Return the interval in which a share of n new trials is expected."""
    (yes, no), tail = _counts(value, weight), 0.025
    low = float(betabinom.ppf(tail, n, yes, no + 1)) if yes > 0 else 0.0
    high = float(betabinom.ppf(1 - tail, n, yes + 1, no)) if no > 0 else float(n)
    return [round(low / n, 6), round(high / n, 6)]


def share_p_value(value: float, weight: float, count: int, n: int) -> float:
    """Return the two-sided p-value of `count` successes among n new trials; it is at most 5 % where
    the count lies outside the 95 % predictive interval."""
    yes, no = _counts(value, weight)
    below = float(betabinom.cdf(count, n, yes, no + 1)) if yes > 0 else 1.0
    above = float(betabinom.sf(count - 1, n, yes + 1, no)) if no > 0 else 1.0
    return min(1.0, 2.0 * min(below, above))
