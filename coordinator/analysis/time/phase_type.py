"""Duration distributions made of exponential phases, fitted to a mean and a variance.

A Markov chain knows only exponential durations, so other durations are built from several phases.
With cv the coefficient of variation (standard deviation / mean):

- cv^2 <= 1: a mixture of Erlang distributions of k - 1 and k stages with the same rate. It meets
  both moments exactly for 1 / k <= cv^2 <= 1 / (k - 1).
- cv^2 > 1: two exponential branches with balanced means (hyper-exponential).

Source: H. C. Tijms, A First Course in Stochastic Models, Wiley 2003, appendix B (pages 445 to 447).
If cv^2 asks for more stages than allowed, the mean is kept and the variance is too large; the error
of the 90 % quantile says by how much.
"""

from __future__ import annotations

from math import ceil, exp, sqrt

from msgspec import Struct

STAGES = 64
"""Default limit of the stages of one duration."""


class ErlangBranch(Struct, frozen=True):
    """Taken with `probability`: `stages` exponential phases of `rate` (1/s) in a row."""

    probability: float
    stages: int
    rate: float


class PhaseType(Struct, frozen=True):
    """A duration distribution: `shift` (s), then one of the branches.

    A Markov chain can represent it only if the shift is 0.
    """

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
        """Return P(T <= time), with time in s."""
        if time <= self.shift:
            return 0.0
        return sum(
            b.probability * _erlang_cdf(b.stages, b.rate * (time - self.shift))
            for b in self.branches
        )

    def quantile(self, q: float) -> float:
        """Return the time (s) within which a share q of the durations ends, 0 < q < 1."""
        if not 0 < q < 1:
            raise ValueError(f"quantile: expected 0 < q < 1, got {q}")
        low, high = self.shift, self.shift + max(b.stages / b.rate for b in self.branches)
        while self.cdf(high) < q:
            low, high = high, 2 * high
        while high - low > 1e-12 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.cdf(middle) < q else (low, middle)
        return 0.5 * (low + high)

    def error_at_90(self, quantile: float) -> float:
        """Return the relative error of the 90 % quantile against the given true one (s)."""
        return self.quantile(0.9) / quantile - 1.0


def _erlang_cdf(stages: int, x: float) -> float:
    """Return P(Erlang(stages, rate 1) <= x) = P(a Poisson variable of mean x is >= stages)."""
    if x <= 0:
        return 0.0
    # Below 600 the first Poisson term exp(-x) is far from underflow (at about 745), so the direct
    # sum is accurate and scipy is not needed.
    if x < 600:
        term, total = exp(-x), 0.0
        for k in range(stages):
            total += term
            term *= x / (k + 1)
        return max(0.0, 1.0 - total)
    from scipy.special import gammainc

    return float(gammainc(stages, x))


def fit(mean: float, variance: float, *, stages: int = STAGES, shift: float = 0.0) -> PhaseType:
    """Return the distribution with this mean (s) and variance (s^2), shift (s) included.

    It has at most `stages` phases in a row. A variance of 0 stands for a fixed duration and gets as
    many stages as allowed. Raises ValueError unless mean > shift >= 0 and variance >= 0.
    """
    rest = mean - shift
    if not rest > 0 or variance < 0 or shift < 0:
        raise ValueError(
            "expected mean > shift >= 0 and variance >= 0, got "
            f"mean {mean} s, variance {variance} s^2, shift {shift} s"
        )
    cv2 = variance / rest**2
    if cv2 > 1:
        p = 0.5 * (1 + sqrt((cv2 - 1) / (cv2 + 1)))
        return PhaseType(
            (ErlangBranch(p, 1, 2 * p / rest), ErlangBranch(1 - p, 1, 2 * (1 - p) / rest)), shift
        )
    # The 1e-9 keep rounding errors from adding a stage when cv^2 is exactly 1 / k.
    wanted = ceil(1 / cv2 - 1e-9) if cv2 * stages >= 1 else stages
    if cv2 * stages < 1 or abs(cv2 * wanted - 1) < 1e-9:
        return PhaseType((ErlangBranch(1.0, wanted, wanted / rest),), shift)
    p = (wanted * cv2 - sqrt(wanted * (1 + cv2) - wanted**2 * cv2)) / (1 + cv2)
    rate = (wanted - p) / rest
    return PhaseType((ErlangBranch(p, wanted - 1, rate), ErlangBranch(1 - p, wanted, rate)), shift)


def gamma_quantile(mean: float, variance: float) -> float:
    """Return the 90 % quantile (s) of the gamma distribution with this mean (s) and variance (s^2).

    Declared estimates give only mean and cv; the gamma distribution is their reference.
    """
    if variance == 0:
        return mean
    from scipy.special import gammaincinv

    shape = mean**2 / variance
    return float(gammaincinv(shape, 0.9)) * variance / mean
