"""Count, mean and spread of a stream of numbers, mergeable and correctable.

Updating and merging follow T. F. Chan, G. H. Golub and R. J. LeVeque, "Algorithms for computing the
sample variance", The American Statistician 37 (1983): no catastrophic cancellation, whatever the
order of merges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any

from scipy.special import betaincinv, ndtri


@dataclass(frozen=True, slots=True)
class Moments:
    """`m2` is the sum of squared deviations from the mean. Immutable."""

    n: int = 0
    mean: float = 0.0
    m2: float = 0.0
    low: float = inf
    high: float = -inf

    @property
    def total(self) -> float:
        """The sum of all numbers."""
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
        """Standard deviation over mean; 0 where the mean is 0."""
        return self.deviation / self.mean if self.mean else 0.0

    def adding(self, x: float) -> Moments:
        """With one more number."""
        n = self.n + 1
        delta = x - self.mean
        mean = self.mean + delta / n
        return Moments(n, mean, self.m2 + delta * (x - mean), min(self.low, x), max(self.high, x))

    def without(self, x: float) -> Moments:
        """Without one number that was added before; `low` and `high` stay."""
        if self.n <= 1:
            return Moments()
        n = self.n - 1
        mean = self.mean - (x - self.mean) / n
        return Moments(
            n, mean, max(0.0, self.m2 - (x - self.mean) * (x - mean)), self.low, self.high
        )

    def merged(self, other: Moments) -> Moments:
        """Of both streams together."""
        if not self.n or not other.n:
            return self if self.n else other
        n = self.n + other.n
        delta = other.mean - self.mean
        mean = self.mean + delta * other.n / n
        m2 = self.m2 + other.m2 + delta * delta * self.n * other.n / n
        return Moments(n, mean, m2, min(self.low, other.low), max(self.high, other.high))

    def to_plain(self) -> list[float]:
        """Plain data: [n, mean, m2, low, high]; empty for no numbers."""
        return [self.n, self.mean, self.m2, self.low, self.high] if self.n else []

    @classmethod
    def of_plain(cls, data: list[float]) -> Moments:
        """What `to_plain` gave. Raises ValueError or TypeError."""
        if not data:
            return cls()
        n, (mean, m2, low, high) = whole(data[0], "numbers"), (float(x) for x in data[1:])
        slack = 1e-6 * max(abs(low), abs(high))  # means are rounded
        if n < 1 or not m2 >= 0 or not low - slack <= mean <= high + slack:
            raise ValueError(
                f"{data} are no moments: n >= 1, m2 >= 0 and low <= mean <= high are needed"
            )
        return cls(n, mean, m2, low, high)


EMPTY = Moments()


def whole(n: Any, what: str, most: float = inf) -> int:
    """A count from plain data. Raises ValueError unless it is a whole number from 0 to `most`."""
    if isinstance(n, bool) or not isinstance(n, int) or not 0 <= n <= most:
        raise ValueError(
            f"{n!r} {what}: a whole number from 0{'' if most == inf else f' to {most:g}'} is needed"
        )
    return n


def merged(one: Mapping[Any, Moments], other: Mapping[Any, Moments]) -> dict[Any, Moments]:
    """Two families of moments merged by key, in sorted order of the keys."""
    keys = sorted({*one, *other})
    return {key: one.get(key, EMPTY).merged(other.get(key, EMPTY)) for key in keys}


# Confidence intervals of a probability that is estimated by a relative frequency.


def wilson(successes: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """The score interval of E. B. Wilson (1927): short, its mean coverage is close to `level`; (0,
    1) for n = 0."""
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
    """The exact interval of C. J. Clopper and E. S. Pearson (1934): covers with at least `level`
    for every probability."""
    if n <= 0:
        return 0.0, 1.0
    tail = 0.5 * (1 - level)
    low = 0.0 if successes <= 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes >= n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return low, high


_QUANTILES: dict[float, float] = {
    0.95: 1.959963984540054,
    0.9: 1.6448536269514722,
    0.99: 2.5758293035489004,
}


def _z(level: float) -> float:
    if not 0 < level < 1:
        raise ValueError(f"a confidence level needs 0 < level < 1, not {level}")
    known = _QUANTILES.get(level)
    return float(ndtri(0.5 * (1 + level))) if known is None else known
