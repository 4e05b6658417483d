"""Confidence intervals of a probability that is estimated by a relative frequency."""

from __future__ import annotations

from math import sqrt

from scipy.special import betaincinv, ndtri


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
