"""What a node remembers of calls that have ended: results until they are acknowledged, ids for longer."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from types import NoneType
from typing import Any

from services.comm.messages import Outcome


@dataclass(frozen=True, slots=True)
class Keeping:
    """How long the node remembers."""

    results: float = 600.0
    """Seconds that an unacknowledged result is kept,"""
    result_count: int = 1_000
    """and how many of them,"""
    result_bytes: int = 64 << 20
    """and how much they may weigh together (bytes, about as on the wire); the newest is kept whatever it weighs."""
    ids: float = 3_600.0
    """Seconds that an id whose result is gone is remembered,"""
    id_count: int = 200_000
    """and how many of them."""
    lease: float = 2.0
    """Seconds after which the lease of a device is free when its holder is away and none of its runs goes on."""


_SCALAR = 9
"""Bytes of a number on the wire."""
_NUMBERS = frozenset((float, int, bool, NoneType))


def weight_of(value: Any) -> int:
    """About how many bytes plain data takes on the wire."""
    kind = type(value)
    if kind is str or kind is bytes:
        return len(value) + _SCALAR
    if kind is dict:
        weight = _SCALAR
        for key, item in value.items():
            weight += len(key) + (_SCALAR if type(item) in _NUMBERS else weight_of(item))
        return weight
    if kind is list or kind is tuple:
        if _NUMBERS.issuperset(map(type, value)):
            return _SCALAR * (1 + len(value))
        return _SCALAR + sum(map(weight_of, value))
    return _SCALAR


class ResultStore:
    """Results by call id. `forgotten` is told each id whose result goes."""

    def __init__(self, keeping: Keeping, forgotten: Callable[[str], None]) -> None:
        self._keeping = keeping
        self._forgotten = forgotten
        # A plain dict is slow to find its first entry once many were deleted before it.
        self._results: OrderedDict[str, tuple[Outcome, str, float, int]] = OrderedDict()
        self._weight = 0
        self._ids: OrderedDict[str, float] = OrderedDict()
        self._ids_due = math.inf
        """Not later than when the oldest id has been remembered long enough (s)."""

        self.kept: Collection[str] = self._results.keys()
        """Ids whose result is kept,"""
        self.gone: Collection[str] = self._ids.keys()
        """and those whose result is gone; both for quick looks, see `in`."""

    def __contains__(self, id_: str) -> bool:
        return id_ in self._ids or id_ in self._results

    def add(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """Keep a result for its caller. `weight` is its length on the wire (bytes) where that is known, else it is estimated."""
        if weight is None:
            weight = weight_of(outcome.values) if outcome.values else 0
        results, id_ = self._results, outcome.id
        older = results.get(id_)
        self._weight += weight if older is None else weight - older[3]
        results[id_] = (outcome, peer, now, weight)
        while len(results) > self._keeping.result_count or (
            self._weight > self._keeping.result_bytes and len(results) > 1
        ):
            self._forget(now, next(iter(results)))

    def get(self, id_: str) -> Outcome | None:
        """The result of this call, None if it is not kept (any more)."""
        stored = self._results.get(id_)
        return None if stored is None else stored[0]

    def owner(self, id_: str) -> str:
        """Whose result it is; empty if it is not kept."""
        stored = self._results.get(id_)
        return "" if stored is None else stored[1]

    def acknowledge(self, now: float, peer: str, ids: Iterable[str]) -> None:
        """The caller has these results safe; of others' ids nothing is forgotten."""
        get = self._results.get
        for id_ in ids:
            stored = get(id_)
            if stored is not None and stored[1] == peer:
                self._forget(now, id_)

    def of(self, peer: str) -> list[str]:
        """Ids of the results kept for this caller."""
        return [id_ for id_, (_, owner, _, _) in self._results.items() if owner == peer]

    def due(self) -> float | None:
        """When the oldest result has been kept long enough (s)."""
        for _, _, at, _ in self._results.values():
            return at + self._keeping.results
        return None

    def advance(self, now: float) -> None:
        """Forget what has been kept long enough."""
        while (due := self.due()) is not None and due <= now:
            self._forget(now, next(iter(self._results)))

    def _forget(self, now: float, id_: str) -> None:
        self._weight -= self._results.pop(id_)[3]
        self._ids[id_] = now
        if now >= self._ids_due or len(self._ids) > self._keeping.id_count:
            self._forget_ids(now)
        elif len(self._ids) == 1:
            self._ids_due = now + self._keeping.ids
        self._forgotten(id_)

    def _forget_ids(self, now: float) -> None:
        self._ids_due = math.inf
        while self._ids:
            oldest = next(iter(self._ids))
            due = self._ids[oldest] + self._keeping.ids
            if len(self._ids) <= self._keeping.id_count and due > now:
                self._ids_due = due
                break
            del self._ids[oldest]
