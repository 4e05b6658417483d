"""Statistics of a stream of numbers that can be merged and corrected, and confidence intervals.

Updating and merging follow T. F. Chan, G. H. Golub and R. J. LeVeque, "Algorithms for computing the
sample variance", The American Statistician 37 (1983) 242-247: no catastrophic cancellation,
whatever the order of merges.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import reduce
from math import ceil, inf, isfinite, nan, sqrt
from operator import add
from typing import Any, Protocol, Self, TypeVar

from msgspec import Struct


class Moments(Struct, frozen=True):
    """Count, mean, extremes and `m2`, the sum of squared deviations from the mean. Immutable."""

    n: int = 0
    mean: float = 0.0
    m2: float = 0.0
    low: float = inf
    high: float = -inf

    @property
    def total(self) -> float:
        """Sum of all numbers."""
        return self.n * self.mean

    @property
    def variance(self) -> float:
        """Unbiased variance; 0 for fewer than two numbers."""
        return max(0.0, self.m2) / (self.n - 1) if self.n > 1 else 0.0

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        return sqrt(self.variance)

    @property
    def cv(self) -> float:
        """Coefficient of variation: standard deviation over mean; 0 if the mean is 0."""
        return self.deviation / self.mean if self.mean else 0.0

    def adding(self, x: float) -> Moments:
        """Return the moments with one more number."""
        n = self.n + 1
        delta = x - self.mean
        mean = self.mean + delta / n
        return Moments(n, mean, self.m2 + delta * (x - mean), min(self.low, x), max(self.high, x))

    def without(self, x: float) -> Moments:
        """Return the moments without one number that was added before; `low` and `high` stay."""
        if self.n <= 1:
            return Moments()
        n = self.n - 1
        mean = self.mean - (x - self.mean) / n
        return Moments(
            n, mean, max(0.0, self.m2 - (x - self.mean) * (x - mean)), self.low, self.high
        )

    def merged(self, other: Moments) -> Moments:
        """Return the moments of both streams together."""
        if not self.n or not other.n:
            return self if self.n else other
        n = self.n + other.n
        delta = other.mean - self.mean
        mean = self.mean + delta * other.n / n
        m2 = self.m2 + other.m2 + delta * delta * self.n * other.n / n
        return Moments(n, mean, m2, min(self.low, other.low), max(self.high, other.high))

    def to_plain(self) -> list[float]:
        """Return [n, mean, m2, low, high]; an empty list if there are no numbers."""
        return [self.n, self.mean, self.m2, self.low, self.high] if self.n else []

    @classmethod
    def of_plain(cls, data: list[float]) -> Moments:
        """Read what `to_plain` returned. Raises ValueError or TypeError."""
        if not data:
            return cls()
        n, (mean, m2, low, high) = whole(data[0], "numbers"), (float(x) for x in data[1:])
        slack = 1e-6 * max(abs(low), abs(high))  # a mean may be rounded past an extreme
        if n < 1 or not m2 >= 0 or not low - slack <= mean <= high + slack:
            raise ValueError(f"{data}: expected n >= 1, m2 >= 0 and low <= mean <= high")
        return cls(n, mean, m2, low, high)


EMPTY = Moments()


def added(values: Iterable[float]) -> float:
    """Return the sum, added one by one. From Python 3.12 on the builtin `sum` corrects rounding, so
    that its last digits, and choices that hang on them, would depend on the interpreter."""
    return reduce(add, values, 0.0)


def whole(n: Any, what: str, most: float = inf) -> int:
    """Check a count from plain data and return it. Raises ValueError unless it is a whole number
    from 0 to `most`."""
    if isinstance(n, bool) or not isinstance(n, int) or not 0 <= n <= most:
        raise ValueError(
            f"{n!r} {what}: expected a whole number from 0{'' if most == inf else f' to {most:g}'}"
        )
    return n


class Mergeable(Protocol):
    """Sums that can be merged with others of their kind."""

    def merged(self, other: Self) -> Self: ...


S = TypeVar("S", bound=Mergeable)


def merged(one: Mapping[Any, S], other: Mapping[Any, S]) -> dict[Any, S]:
    """Merge two families of sums by key; the keys of the result are sorted."""
    both = {key: sums.merged(other[key]) for key, sums in one.items() if key in other}
    return dict(sorted({**one, **other, **both}.items()))


# --- confidence intervals of a probability estimated by a relative frequency ---


def wilson(successes: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Score interval of a probability (E. B. Wilson, J. American Statistical Association 22 (1927)
    209-212). Short; its mean coverage is close to `level`. (0, 1) for n = 0."""
    if n <= 0:
        return 0.0, 1.0
    z = _z(level)
    share = successes / n
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return (0.0 if successes <= 0 else max(0.0, middle - half)), (
        1.0 if successes >= n else min(1.0, middle + half)
    )


def clopper_pearson(successes: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a probability (C. J. Clopper and E. S. Pearson, Biometrika 26 (1934)
    404-413). Covers every probability with at least `level`; (0, 1) for n = 0."""
    if n <= 0:
        return 0.0, 1.0
    from scipy.special import betaincinv  # here, because it takes 0.15 s: each coordinator pays

    tail = 0.5 * (1 - level)
    low = 0.0 if successes <= 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes >= n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return low, high


def lowest_share(counts: Iterable[tuple[int, int]], level: float = 0.95) -> tuple[float, float]:
    """Interval of the lowest of m probabilities, each given as (successes, n) with n > 0.

    Wilson's for m = 1. For more, the lowest of the exact lower bounds at `level` and the lowest of
    the exact upper bounds at 1 - (1 - level) / m (Bonferroni). The interval of the share that
    happens to be lowest would be too low, because the lowest of m shares is below the lowest
    probability on average. The lower side needs no correction: it errs only if the bound of the one
    lowest probability errs. Exact bounds, because Wilson's upper bound errs too often near 1.
    """
    several = list(counts)
    if len(several) == 1:
        return wilson(*several[0], level)
    strict = 1.0 - (1.0 - level) / len(several)
    return (
        min(clopper_pearson(s, n, level)[0] for s, n in several),
        min(clopper_pearson(s, n, strict)[1] for s, n in several),
    )


def runs_needed(share: float, target: float, level: float = 0.95) -> int | None:
    """Number of runs after which Wilson's lower bound reaches the target if the share of successes
    stays as it is; None if the share is not above the target.

    The bound is the target where share - target = z sqrt(target (1 - target) / n).
    """
    if not share > target:
        return 1 if share == target == 1.0 else None
    z = _z(level)
    return max(1, ceil(target * (1.0 - target) * (z / (share - target)) ** 2 - 1e-9))


def mean_interval(moments: Moments, level: float = 0.95) -> tuple[float, float]:
    """Student's interval of a mean. It does not reach below 0 if no number is below 0; it is
    unbounded above for fewer than two numbers."""
    if moments.n < 2:
        return (0.0 if moments.n and moments.low >= 0 else -inf), inf
    from scipy.special import stdtrit  # here, because it takes 0.15 s: each coordinator pays

    half = float(stdtrit(moments.n - 1, 0.5 * (1 + level))) * moments.deviation / sqrt(moments.n)
    low = moments.mean - half
    return (max(0.0, low) if moments.low >= 0 else low), moments.mean + half


def joined(one: float, other: float, correlation: float = 0.0) -> float:
    """Half-width of a sum from the half-widths of its two parts, with the correlation of their
    errors (G. Y. Zou and A. Donner, Statistics in Medicine 27 (2008) 1693-1702: each side by
    itself, so that intervals which are wider on one side stay so). An unknown half (nan) has no
    bound."""
    if not (isfinite(one) and isfinite(other)):
        return inf
    return sqrt(max(0.0, one**2 + other**2 + 2.0 * correlation * one * other))


def objective_interval(
    r: tuple[float, float, float],
    c: tuple[float, float, float],
    rho: float,
    correlation: float = 0.0,
) -> tuple[float, float]:
    """Interval of J = 1 - r + rho c for a given rho, from (value, lower, upper) of both.

    `correlation`: that of success and cost within a run. -1 gives the widest interval. nan where
    the cost is not bounded.
    """
    if rho == 0.0 or c[0] != c[0]:
        return 1.0 - r[2], 1.0 - r[1]
    j = 1.0 - r[0] + rho * c[0]
    low = j - joined(r[2] - r[0], rho * (c[0] - c[1]), -correlation)
    high = j + joined(r[0] - r[1], rho * (c[2] - c[0]), -correlation)
    return (low, high) if -inf < low and high < inf else (nan, nan)


# Quantiles of the normal distribution for the usual levels: wilson is called once per action and
# trial, and a look-up is faster than ndtri.
_QUANTILES: dict[float, float] = {
    0.95: 1.959963984540054,
    0.9: 1.6448536269514722,
    0.99: 2.5758293035489004,
}


def _z(level: float) -> float:
    if not 0 < level < 1:
        raise ValueError(f"confidence level: expected 0 < level < 1, got {level}")
    if (known := _QUANTILES.get(level)) is not None:
        return known
    from scipy.special import ndtri

    return float(ndtri(0.5 * (1 + level)))
