"""Figures of further trials straight from the training trials: no model of the net, so branches
with a common cause, loops and hidden conditions need no assumption but that trials are independent
and alike.

A forecast of other choices weights each trial by how much more often those choices would have led
to it (importance weights: Horvitz and Thompson, J. Am. Stat. Assoc. 47 (1952) 663-685).

- Trials of one mission run may be alike: their number is divided by the design effect.
- Shares: exact binomial intervals and predictive ones; both hold at least their level.
- Mean: bootstrap-t (P. Hall, The Bootstrap and Edgeworth Expansion, Springer 1992), because it
  corrects the skewness of long-tailed times.
- Quantile: fractional order statistics (A. D. Hutson, Statistics and Probability Letters 42 (1999)
  331-338), whose levels depend on no distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, betabinom, f, norm, t as student

from petrobot.coordinator.learning.statistics import clopper_pearson
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.history import Codes, Training, Values

LEVEL = 0.95
PIVOTS = 2000
"""Bootstrap samples of the mean."""
AT_ONCE = 2_000_000
"""Largest number of drawn times that are kept at the same time."""
LARGEST = 5.0
"""Largest standardised difference of means. It is exceeded where one very long trial makes up most
of the spread: samples without it have almost none. By simulation, the limit costs no coverage and
saves a tenth of the mean width (lognormal times with sigma 1.5, 300 trials)."""
FEW = 4
"""Number of training trials from which the bootstrap says how a mean varies. All samples of two
trials that vary have the same mean, so their interval was a point; that of three held in 76 to 81 %
of cases, Student's in 86 to 92 % (uniform, exponential and lognormal times)."""
MANY = 4000
"""Number of new trials beyond which their mean is drawn from the normal distribution."""
SCORES: Values = np.array([-3.0, -2.6, -2.2, norm.ppf(0.025), -1.6, -1.2, -0.8, -0.4, 0.0])
SCORES = np.concatenate([SCORES, -SCORES[-2::-1]])
"""Normal scores at which predictive distributions of times are stored."""
FEWEST = 10
"""Least number of mission runs whose likeness can be seen."""
ALIKE = 0.05
"""Significance level at which trials of one mission run are alike."""
LEAST = 50
"""Least number of training trials, weighted, for a forecast of other choices."""

Choices = Mapping[str, Mapping[str, float]]


def trial_weights(training: Training, choices: Choices) -> Values:
    """Return how much more often each training trial would occur with other choices: the product of
    (probability now / share in the training) over its runs."""
    known = choices_of(training)
    ratio = {
        name: {a: choices[name].get(a, 0.0) / share for a, share in shares.items()}
        for name, shares in known.items()
        if name in choices and dict(choices[name]) != shares
    }
    weights = np.ones(len(training.trials))
    if ratio:
        primitive = training.task.primitive_task_of
        for i, trial in enumerate(training.trials):
            for run in trial.runs:
                weights[i] *= ratio.get(primitive(run.place).name, {}).get(run.action, 1.0)
    return weights


def missions(training: Training) -> Codes:
    """Return the number of the mission run of each trial: their own numbers begin again in each."""
    k = np.array([trial.k for trial in training.trials])
    return np.concatenate([[0], np.cumsum(np.diff(k) <= 0)])


def design_effect(values: Values, weights: Values, mission: Codes) -> float:
    """Return by how much the variance of a mean is larger because trials of one mission run are
    alike; 1 unless a test says so (one-way analysis of variance, 5 %).

    The variance with whole missions as units, over the one with trials as units (L. Kish, Survey
    Sampling, Wiley 1965).
    """
    _, unit = np.unique(mission, return_inverse=True)
    count = int(unit.max()) + 1
    if count < FEWEST or count == len(values):
        return 1.0
    off = weights * (values - np.average(values, weights=weights))
    sums, whole = np.bincount(unit, off), float(off @ off)
    if whole <= 0.0:
        return 1.0
    means = sums / np.bincount(unit)
    between = float(means**2 @ np.bincount(unit)) / (count - 1)
    within = float(np.sum((off - means[unit]) ** 2)) / (len(values) - count)
    alike = f.sf(between / within, count - 1, len(values) - count) if within > 0.0 else 0.0
    return max(1.0, float(sums @ sums) / whole) if alike < ALIKE else 1.0


def effective(weights: Values) -> float:
    """Return the number of equally weighted trials that would be worth as much (Kish)."""
    whole = float(weights.sum())
    return whole * whole / float(weights @ weights) if whole > 0 else 0.0


# --- means ---


def mean_figure(
    times: Values, weights: Values, runs: int, random: np.random.Generator, likeness: float = 1.0
) -> dict[str, Any]:
    """Forecast the mean of the times of `runs` further trials; `likeness`: their design effect.

    The bootstrap repeats both what was measured (trials drawn again) and what will be (new trials),
    and keeps the difference of their means in units of its own standard error.
    """
    n, equal = len(times), bool((weights == weights[0]).all())
    bounds = np.cumsum(weights) / weights.sum()
    mean, error, spread = _moments(times[None], weights[None])
    of_truth, of_new = [], []
    centre = float(mean[0])
    for begin in range(0, PIVOTS, each := max(1, AT_ONCE // max(n, min(runs, MANY)))):
        count = min(each, PIVOTS - begin)
        index = random.integers(n, size=(count, n))
        m, e, s = _moments(times[index], weights[index])
        if runs > MANY:
            new = centre + float(spread[0]) / np.sqrt(runs) * random.standard_normal(count)
        else:
            at = (
                random.integers(n, size=(count, runs))
                if equal
                else np.searchsorted(bounds[:-1], random.random((count, runs)), side="right")
            )
            new = times[at].mean(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_truth.append((centre - m) / e)
            of_new.append((new - m) / np.hypot(e, s / np.sqrt(runs)))
    truth, fresh = (np.concatenate(x) for x in (of_truth, of_new))
    wider = np.sqrt(likeness)
    alone = wider * float(error[0])
    both = wider * float(np.hypot(error[0], spread[0] / np.sqrt(runs)))
    levels = norm.cdf(SCORES)
    if 1 < n < FEW:
        few = student(n - 1)
        return time_figure(centre, centre + both * few.ppf(levels), centre + alone * few.ppf(_BOTH))
    return time_figure(
        centre, centre + both * _quantiles(fresh, levels), centre + alone * _quantiles(truth, _BOTH)
    )


def _moments(times: Values, weights: Values) -> tuple[Values, Values, Values]:
    """Return weighted mean, its standard error, and the standard deviation, for each row."""
    n, whole = times.shape[1], weights.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (weights * times).sum(axis=1) / whole
        off = (times - mean[:, None]) ** 2
        correct = n / (n - 1) if n > 1 else np.inf
        error = np.sqrt(correct * (weights**2 * off).sum(axis=1)) / whole
        spread = np.sqrt(correct * (weights * off).sum(axis=1) / whole)
    return mean, error, spread


def _quantiles(pivots: Values, levels: Values) -> Values:
    known = pivots[np.isfinite(pivots)]  # a sample of equal times has no standard error
    if not len(known):
        return np.zeros(len(levels))
    return np.asarray(np.clip(np.quantile(known, levels), -LARGEST, LARGEST))


# --- quantiles ---


def quantile_figure(
    times: Values, weights: Values, runs: float, q: float, likeness: float = 1.0
) -> dict[str, Any]:
    """Forecast a quantile of the times of `runs` further trials; `likeness`: design effect of being
    below it."""
    runs = max(1.0, runs / likeness)
    order = np.argsort(times)
    n = effective(weights) / likeness
    law = _Law(times[order], weights[order], n)
    rank = q * (runs - 1) + 1  # of the order statistic that numpy.quantile returns
    new = beta(rank, runs - rank + 1)

    middle = q * (n + 1)
    # Ranks that reach seven standard errors to both sides, so that every score lies between them.
    reach = 7.0 * np.sqrt(q * (1 - q) * (n + 1) * (1.0 + n / runs)) + 3.0
    ranks = np.linspace(max(1e-3, middle - reach), min(n + 1 - 1e-3, middle + reach), 80)
    # P(true quantile, or quantile of the new trials, <= order statistic of this rank)
    known = beta.sf(q, ranks, n + 1 - ranks)
    own = beta.ppf((np.arange(100)[:, None] + 0.5) / 100, ranks, n + 1 - ranks)
    below = new.cdf(own).mean(axis=0)
    return time_figure(
        float(law.at(np.array([(q * (n - 1) + 1) / (n + 1)]))[0]),
        law.at(_inverse(ranks, below, SCORES) / (n + 1)),
        law.at(_inverse(ranks, known, norm.ppf(_BOTH)) / (n + 1)),
    )


def _inverse(ranks: Values, probability: Values, scores: Values) -> Values:
    """Return the ranks at which an increasing probability has these normal scores."""
    own = norm.ppf(np.clip(probability, 1e-12, 1 - 1e-12))
    kept = np.concatenate([[True], np.diff(own) > 0])
    return np.asarray(np.interp(scores, own[kept], ranks[kept]))


class _Law:
    """Weighted order statistics, interpolated; beyond the longest time an exponential tail with the
    mean excess of the upper half."""

    def __init__(self, times: Values, weights: Values, n: float) -> None:
        # plotting positions i / (n + 1) for equal weights
        self._position = np.cumsum(weights) / weights.sum() * n / (n + 1)
        self._times = times
        middle = float(np.quantile(times, 0.5))
        upper = times[times > middle]
        self._excess = float(upper.mean() - middle) if len(upper) else 0.0

    def at(self, position: Values) -> Values:
        """Return the times at positions in (0, 1)."""
        inside = np.interp(position, self._position, self._times)
        last = self._position[-1]
        beyond = np.log((1.0 - last) / np.minimum(1.0 - last, 1.0 - position))
        return np.asarray(inside + self._excess * beyond)


_BOTH = np.array([(1 - LEVEL) / 2, (1 + LEVEL) / 2])


def time_figure(value: float, curve: Values, confidence: Values) -> dict[str, Any]:
    """Return a forecast time: `curve` is its predictive distribution at `SCORES`. No time is below
    0, but the curve of few trials may be: its slope is what a comparison needs."""
    interval = np.interp(norm.ppf(_BOTH), SCORES, curve)
    return {
        "value": round(value, 6),
        "interval": [round(max(0.0, float(x)), 6) for x in interval],
        "confidence": [round(max(0.0, float(x)), 6) for x in confidence],
        "curve": [round(float(x), 9) for x in curve],
    }


# --- shares ---
# Tests of shares: the predictive distribution of a share of new trials, and Holm's adjustment.
#
# A share that is worth `weight` trials is compared with a share of new trials as the
# hypergeometric test compares two samples (A. R. Thatcher, J. Royal Statistical Society B 26
# (1964) 176-192): each limit is a beta-binomial quantile, and the interval holds at least its
# level for every true share. So a share of 1 that was forecast from n trials still allows a miss
# in another n.


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
