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
