"""Durations as phases: Erlang mixtures and hyper-exponential laws fitted to a mean and a variance.

cv^2 <= 1: a mixture of Erlang laws of k - 1 and k stages with one rate, which meets both moments
exactly for any 1 / k <= cv^2 <= 1 / (k - 1). cv^2 > 1: two exponentials with balanced means.
Source: H. C. Tijms, Stochastic Models: An Algorithmic Approach, Wiley 1994, section A.4. Where the
wanted stages exceed a limit, the mean is kept and the variance is too large; the error at the 90 %
quantile says what that costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, exp, sqrt

import numpy as np

STAGES = 64
"""Stages allowed for one duration unless told otherwise."""


@dataclass(frozen=True, slots=True)
class ErlangBranch:
    """With `probability`, `stages` exponential phases of `rate` (1/s) one after the other."""

    probability: float
    stages: int
    rate: float


@dataclass(frozen=True, slots=True)
class PhaseType:
    """A duration: `shift` (s) and then one of the branches. A Markov chain can only hold laws with
    shift 0."""

    branches: tuple[ErlangBranch, ...]
    shift: float = 0.0

    @property
    def mean(self) -> float:
        """Mean (s)."""
        return self.shift + sum(b.probability * b.stages / b.rate for b in self.branches)

    @property
    def variance(self) -> float:
        """Variance (s^2)."""
        second = sum(b.probability * b.stages * (b.stages + 1) / b.rate**2 for b in self.branches)
        return second - (self.mean - self.shift) ** 2

    def cdf(self, time: float) -> float:
        """P(T <= time)."""
        if time <= self.shift:
            return 0.0
        return sum(
            b.probability * _erlang_cdf(b.stages, b.rate * (time - self.shift))
            for b in self.branches
        )

    def quantile(self, q: float) -> float:
        """The time (s) by which a share q of the durations is over, 0 < q < 1."""
        if not 0 < q < 1:
            raise ValueError(f"a quantile needs 0 < q < 1, not {q}")
        low, high = self.shift, self.shift + max(b.stages / b.rate for b in self.branches)
        while self.cdf(high) < q:
            low, high = high, 2 * high
        while high - low > 1e-12 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.cdf(middle) < q else (low, middle)
        return 0.5 * (low + high)

    def error_at_90(self, quantile: float) -> float:
        """Relative error of the 90 % quantile against the true one (s)."""
        return self.quantile(0.9) / quantile - 1.0


def _erlang_cdf(stages: int, x: float) -> float:
    """P(a Poisson variable of mean x is at least `stages`), summed from the side of the smaller
    terms."""
    if x <= 0:
        return 0.0
    if x < 600:
        term, total = exp(-x), 0.0
        for k in range(stages):
            total += term
            term *= x / (k + 1)
        return max(0.0, 1.0 - total)
    from scipy.special import gammainc

    return float(gammainc(stages, x))


def fit(mean: float, variance: float, *, stages: int = STAGES, shift: float = 0.0) -> PhaseType:
    """The law with this mean (s) and variance (s^2), at most `stages` phases in a row behind a
    fixed `shift` (s).

    A variance of 0 asks for a fixed duration: as many stages as allowed, or the shift alone if it
    is the whole mean.
    """
    rest = mean - shift
    if not rest > 0 or variance < 0 or shift < 0:
        raise ValueError(
            f"no law has the mean {mean} s, variance {variance} s^2 and shift {shift} s"
        )
    cv2 = variance / rest**2
    if cv2 > 1:
        p = 0.5 * (1 + sqrt((cv2 - 1) / (cv2 + 1)))
        return PhaseType(
            (ErlangBranch(p, 1, 2 * p / rest), ErlangBranch(1 - p, 1, 2 * (1 - p) / rest)), shift
        )
    wanted = ceil(1 / cv2 - 1e-9) if cv2 * stages >= 1 else stages
    if cv2 * stages < 1 or abs(cv2 * wanted - 1) < 1e-9:
        return PhaseType((ErlangBranch(1.0, wanted, wanted / rest),), shift)
    p = (wanted * cv2 - sqrt(wanted * (1 + cv2) - wanted**2 * cv2)) / (1 + cv2)
    rate = (wanted - p) / rest
    return PhaseType((ErlangBranch(p, wanted - 1, rate), ErlangBranch(1 - p, wanted, rate)), shift)


def fit_samples(
    durations: Sequence[float], *, stages: int = STAGES, shifted: bool = False
) -> tuple[PhaseType, float]:
    """The law fitted to measured durations (s) by mean and variance, and its relative error at the
    90 % quantile.

    With `shifted` the shortest duration is taken as a fixed shift, less one mean gap so that it is
    not hit exactly.
    """
    sample = np.asarray(durations, dtype=float)
    if len(sample) < 2 or sample.min() <= 0:
        raise ValueError("at least two positive durations are needed to fit a law")
    mean, variance = float(sample.mean()), float(sample.var(ddof=1))
    gap = (mean - float(sample.min())) / len(sample)
    shift = max(0.0, float(sample.min()) - gap) if shifted else 0.0
    law = fit(mean, variance, stages=stages, shift=min(shift, mean * (1 - 1e-9)))
    return law, law.error_at_90(float(np.quantile(sample, 0.9)))


def gamma_quantile(mean: float, variance: float, q: float = 0.9) -> float:
    """The quantile (s) of the gamma law with this mean and variance: what a declared mean and cv
    are compared with."""
    if variance == 0:
        return mean
    from scipy.special import gammaincinv

    shape = mean**2 / variance
    return float(gammaincinv(shape, q)) * variance / mean
