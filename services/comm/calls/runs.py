"""Runs that go on at the called end: when each must have ended, with clocks that stand still while
the run is held."""

from __future__ import annotations

import heapq
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from types import NoneType
from typing import Any, Final

from petrobot.services.comm.protocol.messages import Call, Outcome

NEVER: Final = float("inf")
DEADLINE: Final = "deadline"
ORPHAN: Final = "orphan"


@dataclass(slots=True)
class ActiveRun:
    """A run that goes on; times in seconds on the node's clock. `stopping` once it was ordered to
    stop, `reason` says why."""

    call: Call
    peer: str
    began: float
    device: str
    orphan_time: float | None
    limit: float = NEVER
    """When its deadline is over."""
    held: float | None = None
    """Since when an operator holds it."""
    stopping: bool = False
    reason: str = ""


class ActiveRuns(dict[str, ActiveRun]):
    """Runs that go on, by call id, with the times at which they are worth a look."""

    def __init__(self) -> None:
        super().__init__()
        self._timers: list[tuple[float, str, str]] = []

    def limit(self, id_: str, due: float) -> None:
        """The run must have ended by then."""
        self[id_].limit = due
        heapq.heappush(self._timers, (due, DEADLINE, id_))

    def watch_orphan(self, id_: str, due: float) -> None:
        """Then the run's caller may have been away for too long."""
        heapq.heappush(self._timers, (due, ORPHAN, id_))

    def hold_all(self, now: float, devices: Collection[str]) -> None:
        """Deadlines of the runs of these devices ("" for runs without one) stand still."""
        for run in self.values():
            if run.device in devices and run.held is None:
                run.held = now

    def release_all(self, now: float, devices: Collection[str] | None) -> None:
        """Deadlines of the held runs of these devices (None: of all) go on, later by the pause."""
        for id_, run in self.items():
            if run.held is None or (devices is not None and run.device not in devices):
                continue
            pause, run.held = now - run.held, None
            if run.limit < NEVER:
                self.limit(id_, run.limit + pause)

    def over(self, now: float) -> Iterator[tuple[float, str, str, ActiveRun]]:
        """What is due: time, DEADLINE or ORPHAN, id and run. A deadline that stands still or has
        moved is not."""
        while self._timers and self._timers[0][0] <= now:
            due, kind, id_ = heapq.heappop(self._timers)
            run = self.get(id_)
            if run is not None and (kind == ORPHAN or (run.held is None and due >= run.limit)):
                yield due, kind, id_, run

    def due(self) -> float:
        """When `over` has something to give next (s)."""
        while self._timers and self._timers[0][2] not in self:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else NEVER


# What a node remembers of calls that have ended: results until they are acknowledged, ids for
# longer.


@dataclass(frozen=True, slots=True)
class Retention:
    """How long the node remembers."""

    results: float = 600.0
    """Seconds that an unacknowledged result is kept,"""
    result_count: int = 1_000
    """and how many of them,"""
    result_bytes: int = 64 << 20
    """and how much they may weigh together (bytes, about as on the wire); the newest is kept
    whatever it weighs."""
    id_groups: int = 100_000
    """Groups of ids that are remembered once their results are gone (`FinishedIds`); there is no
    limit of time."""
    lease: float = 2.0
    """Seconds after which the lease of a device is free when its holder is away and none of its
    runs goes on."""


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


_DIGITS = "0123456789"
_GROUP = 4_096
"""Numbers in one group: 512 bytes when all of them are used."""


class FinishedIds:
    """Ids of calls whose results are gone, grouped so that they need never be forgotten in ordinary
    use.

    Callers count their calls (docs/protocol.md, `id`), so an id is split into its text and its
    trailing number, and the numbers of one text are kept as bits. At most `limit` groups of 4,096
    numbers are kept, the oldest is forgotten first.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._groups: OrderedDict[tuple[str, int], int] = OrderedDict()
        self.complete = True
        """Whether no id was ever forgotten: then an unknown id has never been here."""

    def __contains__(self, id_: str) -> bool:
        text, number = _split(id_)
        return self._groups.get((text, number // _GROUP), 0) >> number % _GROUP & 1 == 1

    def add(self, id_: str) -> None:
        """Remember an id."""
        text, number = _split(id_)
        groups, group = self._groups, (text, number // _GROUP)
        groups[group] = groups.get(group, 0) | 1 << number % _GROUP
        if len(groups) > self._limit:
            groups.popitem(last=False)
            self.complete = False


def _split(id_: str) -> tuple[str, int]:
    """An id as its text and its trailing number; no two ids give the same, since leading zeros stay
    with the text."""
    text = id_.rstrip(_DIGITS)
    digits = id_[len(text) :]
    if digits[:1] == "0":
        digits = digits.lstrip("0")
        text = id_[: len(id_) - len(digits)]
    return text, int(digits) if digits else 0


class ResultStore:
    """Results by call id. `forgotten` is told each id whose result goes."""

    def __init__(self, keeping: Retention, forgotten: Callable[[str], None]) -> None:
        self._keeping = keeping
        self._forgotten = forgotten
        # A plain dict is slow to find its first entry once many were deleted before it.
        self._results: OrderedDict[str, tuple[Outcome, str, float, int]] = OrderedDict()
        self._weight = 0
        self.kept: Collection[str] = self._results.keys()
        """Ids whose result is kept,"""
        self.gone = FinishedIds(keeping.id_groups)
        """and those whose result is gone; both for quick looks, see `in`."""

    def __contains__(self, id_: str) -> bool:
        return id_ in self._results or id_ in self.gone

    def add(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """Keep a result for its caller. `weight` is its length on the wire (bytes) where that is
        known, else it is estimated."""
        if weight is None:
            weight = weight_of(outcome.values) if outcome.values else 0
        results, id_ = self._results, outcome.id
        older = results.get(id_)
        self._weight += weight if older is None else weight - older[3]
        results[id_] = (outcome, peer, now, weight)
        while len(results) > self._keeping.result_count or (
            self._weight > self._keeping.result_bytes and len(results) > 1
        ):
            self._forget(next(iter(results)))

    def get(self, id_: str) -> Outcome | None:
        """The result of this call, None if it is not kept (any more)."""
        stored = self._results.get(id_)
        return None if stored is None else stored[0]

    def owner(self, id_: str) -> str:
        """Whose result it is; empty if it is not kept."""
        stored = self._results.get(id_)
        return "" if stored is None else stored[1]

    def acknowledge(self, peer: str, ids: Iterable[str]) -> None:
        """The caller has these results safe; of others' ids nothing is forgotten."""
        get = self._results.get
        for id_ in ids:
            stored = get(id_)
            if stored is not None and stored[1] == peer:
                self._forget(id_)

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
            self._forget(next(iter(self._results)))

    def _forget(self, id_: str) -> None:
        self._weight -= self._results.pop(id_)[3]
        self.gone.add(id_)
        self._forgotten(id_)
