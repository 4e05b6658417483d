"""A bounded uniform sample of runs that merges: the entries with the smallest priorities are kept
(bottom-k sampling).

Priorities are hashes of a name that is given to each run once, so the sample of a merge is the
merge of the samples, in any order and however often. Source: E. Cohen and H. Kaplan, "Summarizing
data using bottom-k sketches", PODC 2007.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, NamedTuple

SIZE = 512
"""Runs kept of each action and context: a 90 % quantile is then known to about +-1.3 points of
probability."""


class Kept(NamedTuple):
    """One run in the sample."""

    priority: int
    seconds: float
    cpu_seconds: float
    """-1 where it was not measured."""
    exit: str
    """How it ended; see `coordinator.learning.estimate`."""


@dataclass(frozen=True, slots=True)
class Sample:
    """At most `SIZE` runs, in order of their priorities."""

    kept: tuple[Kept, ...] = ()

    def adding(self, name: str, seconds: float, cpu_seconds: float | None, exit_: str) -> Sample:
        """With one more run. `name` must not have been used before."""
        entry = Kept(_priority(name), seconds, -1.0 if cpu_seconds is None else cpu_seconds, exit_)
        if len(self.kept) == SIZE and entry >= self.kept[-1]:
            return self
        grown = list(self.kept)
        insort(grown, entry)
        return Sample(tuple(grown[:SIZE]))

    def merged(self, other: Sample) -> Sample:
        """Of both together; a run that is in both is kept once."""
        return Sample(tuple(sorted({*self.kept, *other.kept})[:SIZE]))

    def corrected(self, seconds: float, was: str, now: str) -> Sample:
        """With the exit of one run of that length changed, if the sample holds it."""
        for i, entry in enumerate(self.kept):
            if entry.exit == was and entry.seconds == seconds:
                return Sample((*self.kept[:i], entry._replace(exit=now), *self.kept[i + 1 :]))
        return self

    def seconds(self, exits: Iterable[str] | None = None) -> list[float]:
        """Durations (s) of the kept runs that ended so (None: of all)."""
        wanted = None if exits is None else set(exits)
        return [k.seconds for k in self.kept if wanted is None or k.exit in wanted]

    def cpu_seconds(self) -> list[float]:
        """CPU times (s) of the kept runs that have one."""
        return [k.cpu_seconds for k in self.kept if k.cpu_seconds >= 0]

    def to_plain(self) -> list[list[Any]]:
        """Plain data."""
        return [list(k) for k in self.kept]

    @classmethod
    def of_plain(cls, rows: Sequence[Sequence[Any]]) -> Sample:
        """What `to_plain` gave. Raises ValueError."""
        kept = []
        for row in rows:
            priority, seconds, cpu, exit_ = row
            kept.append(Kept(int(priority), float(seconds), float(cpu), str(exit_)))
        return cls(tuple(sorted(kept)[:SIZE]))


def _priority(name: str) -> int:
    """63 bits that look random and depend on the name alone (SQLite and JSON readers hold them
    exactly)."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big") >> 1


def quantile(numbers: Sequence[float], q: float) -> float:
    """The q-quantile by linear interpolation; nan of an empty sequence."""
    if not numbers:
        return float("nan")
    ordered = sorted(numbers)
    place = q * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])
