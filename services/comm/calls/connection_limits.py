"""Who may knock, and how fast one may speak: limits of a listening end as machines without
clock."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

KNOWN: Final = 1_024
"""Addresses whose failures are remembered; then the one that failed longest ago is forgotten."""


class Bucket:
    """A token bucket: on average `rate` a second, at once at most `burst`."""

    __slots__ = ("_at", "_burst", "_level", "_rate")

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self._rate, self._burst = rate, burst
        self._level, self._at = burst, now

    def level(self, now: float) -> float:
        """What is left; below 0 it is owed."""
        self._level = min(self._burst, self._level + (now - self._at) * self._rate)
        self._at = now
        return self._level

    def take(self, now: float, amount: float) -> float:
        """Take so much; gives the seconds after which it is no longer owed (0: it was there)."""
        self._level = self.level(now) - amount
        return max(0.0, -self._level / self._rate)


class Knocks:
    """Handshakes that failed, by address: a stranger who tries keys, or only connects, is not even
    listened to for a while.

    A good caller fails none, so it is never kept waiting by its own address; `rate` a second and
    `burst` at once are allowed.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._buckets: OrderedDict[str, Bucket] = OrderedDict()

    def admits(self, now: float, address: str) -> bool:
        """Whether this address may try a handshake."""
        bucket = self._buckets.get(address)
        return bucket is None or bucket.level(now) >= 1.0

    def failed(self, now: float, address: str) -> None:
        """A handshake of this address came to nothing."""
        bucket = self._buckets.pop(address, None) or Bucket(self._rate, self._burst, now)
        self._buckets[address] = bucket
        if bucket.level(now) >= 1.0:
            bucket.take(now, 1.0)
        if len(self._buckets) > KNOWN:
            self._buckets.popitem(last=False)
