"""The runs of a node: active ones with their deadlines, finished ones with their results
(sans-I/O)."""

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
    """An active run; times in seconds on the node's clock.

    `stopping` is set when it was ordered to stop; `reason` says why.
    """

    call: Call
    peer: str
    began: float
    device: str
    orphan_time: float | None
    limit: float = NEVER
    """When its deadline is over (s)."""
    held: float | None = None
    """Since when an operator holds it (s)."""
    stopping: bool = False
    reason: str = ""


class ActiveRuns(dict[str, ActiveRun]):
    """Active runs by call id, with a heap of the times at which one of them must be looked at.

    Entries of the heap are never removed early. One that is taken out is compared with the run as
    it is now: it may have finished, or its deadline may have moved.
    """

    def __init__(self) -> None:
        super().__init__()
        self._timers: list[tuple[float, str, str]] = []

    def limit(self, id_: str, due: float) -> None:
        """The run must have finished at `due` (s)."""
        self[id_].limit = due
        heapq.heappush(self._timers, (due, DEADLINE, id_))

    def watch_orphan(self, id_: str, due: float) -> None:
        """At `due` (s) the run's caller may have been away for too long."""
        heapq.heappush(self._timers, (due, ORPHAN, id_))

    def hold_all(self, now: float, devices: Collection[str]) -> None:
        """Stop the clocks of the deadlines of these devices' runs ("" for runs without a
        device)."""
        for run in self.values():
            if run.device in devices and run.held is None:
                run.held = now

    def release_all(self, now: float, devices: Collection[str] | None) -> None:
        """Restart the stopped deadlines of these devices' runs (None: of all), later by the
        duration of the pause."""
        for id_, run in self.items():
            if run.held is None or (devices is not None and run.device not in devices):
                continue
            pause, run.held = now - run.held, None
            if run.limit < NEVER:
                self.limit(id_, run.limit + pause)

    def over(self, now: float) -> Iterator[tuple[float, str, str, ActiveRun]]:
        """Yield what is due: time, DEADLINE or ORPHAN, id and run. A stopped or moved deadline is
        not due."""
        while self._timers and self._timers[0][0] <= now:
            due, kind, id_ = heapq.heappop(self._timers)
            run = self.get(id_)
            if run is not None and (kind == ORPHAN or (run.held is None and due >= run.limit)):
                yield due, kind, id_, run

    def due(self) -> float:
        """Return when `over` has something to yield next (s)."""
        while self._timers and self._timers[0][2] not in self:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else NEVER


# What a node remembers of finished calls: results until they are acknowledged, ids for longer.


@dataclass(frozen=True, slots=True)
class Retention:
    """How long the node remembers finished calls."""

    results: float = 600.0
    """How long an unacknowledged result is kept (s)."""
    result_count: int = 1_000
    """How many unacknowledged results are kept."""
    result_bytes: int = 64 << 20
    """How large the kept results may be together (bytes, about as on the wire). The newest is
    always kept."""
    id_groups: int = 100_000
    """How many groups of ids are remembered after their results are dropped (`FinishedIds`);
    without limit of time."""
    lease: float = 2.0
    """After this time (s) the lease of a device is free when its holder is away and none of its
    runs is active."""


_SCALAR = 9
"""Bytes of a number on the wire: one marker and eight bytes."""
_NUMBERS = frozenset((float, int, bool, NoneType))


def weight_of(value: Any) -> int:
    """Estimate how many bytes plain data takes on the wire."""
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
"""Numbers in one group: a bit set of 512 bytes when all of them are used."""


class FinishedIds:
    """Ids of calls whose results are dropped, stored so compactly that ordinary use never forgets
    one.

    Callers count their calls (docs/protocol.md, `id`). So an id is split into its text and its
    trailing number, and the numbers of one text are bits of a Python integer, 4,096 per group. A
    million calls of one caller need 245 groups, about 128 KB. At most `limit` groups are kept; then
    the oldest is dropped.

    Dropping a group means that an unknown id may have run before. `complete` says whether that can
    be; the callee then refuses repeated calls that it does not know (`Call.again`).
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._groups: OrderedDict[tuple[str, int], int] = OrderedDict()
        self.complete = True
        """Whether no id was ever forgotten: then an unknown id certainly never ran here."""

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
    """Split an id into its text and its trailing number. Leading zeros stay with the text, so no
    two ids give the same pair."""
    text = id_.rstrip(_DIGITS)
    digits = id_[len(text) :]
    if digits[:1] == "0":
        digits = digits.lstrip("0")
        text = id_[: len(id_) - len(digits)]
    return text, int(digits) if digits else 0


class ResultStore:
    """Results by call id. `forgotten` is called with each id whose result is dropped."""

    def __init__(self, keeping: Retention, forgotten: Callable[[str], None]) -> None:
        self._keeping = keeping
        self._forgotten = forgotten
        # An OrderedDict finds its first entry at once. A plain dict scans over all entries that were
        # deleted before it, and results are deleted at the front.
        self._results: OrderedDict[str, tuple[Outcome, str, float, int]] = OrderedDict()
        self._weight = 0
        self.kept: Collection[str] = self._results.keys()
        """Ids whose result is kept (for a quick look; see `in`)."""
        self.gone = FinishedIds(keeping.id_groups)
        """Ids whose result is dropped."""

    def __contains__(self, id_: str) -> bool:
        return id_ in self._results or id_ in self.gone

    def add(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """Keep a result for its caller. `weight` is its length on the wire (bytes); it is estimated
        when left out."""
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
        """Return the result of this call, None if it is not kept."""
        stored = self._results.get(id_)
        return None if stored is None else stored[0]

    def owner(self, id_: str) -> str:
        """Return the caller of this result; empty if it is not kept."""
        stored = self._results.get(id_)
        return "" if stored is None else stored[1]

    def acknowledge(self, peer: str, ids: Iterable[str]) -> None:
        """Drop the results that the caller has stored; ids of other callers are ignored."""
        get = self._results.get
        for id_ in ids:
            stored = get(id_)
            if stored is not None and stored[1] == peer:
                self._forget(id_)

    def of(self, peer: str) -> list[str]:
        """Return the ids of the results kept for this caller."""
        return [id_ for id_, (_, owner, _, _) in self._results.items() if owner == peer]

    def due(self) -> float | None:
        """Return when the oldest result has been kept long enough (s)."""
        for _, _, at, _ in self._results.values():
            return at + self._keeping.results
        return None

    def advance(self, now: float) -> None:
        """Drop the results that have been kept long enough."""
        while (due := self.due()) is not None and due <= now:
            self._forget(next(iter(self._results)))

    def _forget(self, id_: str) -> None:
        self._weight -= self._results.pop(id_)[3]
        self.gone.add(id_)
        self._forgotten(id_)
