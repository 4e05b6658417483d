"""Calls under way at their caller, and how long each may wait."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

from petrobot.services.comm.protocol.messages import Call, Executed, Outcome

NEVER: Final = float("inf")
_SPARE: Final = 256


@dataclass(frozen=True, slots=True)
class Patience:
    """How long the caller waits (s)."""

    reconnect: float = 2.0
    """After a broken link, before its calls end."""
    again: float = 0.1
    """Between two calls that are told at once that the peer is not there; those in between wait."""
    accept: float = 1.0
    """For ACCEPT."""
    stop: float = 5.0
    """For RESULT after the deadline or a cancel: the node's stop routine and kill take time."""
    answer: float = 2.0
    """For the answer to a command."""
    acknowledge: float = 0.05
    """How long an acknowledgement waits for others to go with it."""


class Waiter(Protocol):
    """Whoever waits for one call's end; a future of asyncio is one."""

    def done(self) -> bool:
        """Whether it wants to know no more."""

    def set_result(self, outcome: Outcome, /) -> None:
        """The call has ended so."""


@dataclass(slots=True)
class Pending:
    """A call that has not ended. `made` and the dues are on the caller's clock (s)."""

    call: Call
    any_boot: bool
    """Until it is sent, it may go to whatever boot the peer is; False when its owner names one."""
    made: float
    waiter: Waiter | None = None
    """Told its end in place of a notice; the result is acknowledged then."""
    sent: bool = False
    accepted: bool = False
    cancel: str | None = None
    accept_due: float = NEVER
    result_due: float = NEVER
    held: float | None = None
    """Since when an operator holds its run."""

    @property
    def if_unsent(self) -> Executed:
        """What is known when it ends unsent: its owner may have sent it before the owner was
        restarted."""
        return Executed.NO if self.any_boot and not self.call.again else Executed.UNKNOWN


class UnderWay(dict[str, Pending]):
    """Calls under way by id, with their watches: for ACCEPT a queue (all wait equally long), for
    RESULT a heap."""

    def __init__(self) -> None:
        super().__init__()
        self._accepts: deque[tuple[float, str]] = deque()
        self._most = _SPARE
        """Watches for ACCEPT above which those of ended calls are looked for."""
        self._results: list[tuple[float, str]] = []

    def watch_new(self, due: float, id_: str) -> None:
        """A call that was sent as it was made, with this `accept_due`, waits for ACCEPT."""
        accepts = self._accepts
        accepts.append((due, id_))
        if len(accepts) > self._most:
            # Most of them have ended long before their time: a second of quick calls is a hundred
            # thousand of them.
            self._drop_past()

    def watch_accept(self, pending: Pending, due: float) -> None:
        """Wait for ACCEPT until `due`."""
        pending.accept_due = due
        self.watch_new(due, pending.call.id)

    def watch_result(self, pending: Pending, due: float) -> None:
        """Wait for RESULT until `due`, or until an earlier time set before."""
        if due < pending.result_due:
            pending.result_due = due
            heapq.heappush(self._results, (due, pending.call.id))

    def hold(self, now: float, id_: str) -> None:
        """The wait for this call's RESULT stands still."""
        pending = self.get(id_)
        if pending is not None and pending.held is None:
            pending.held = now

    def release(self, now: float, id_: str) -> None:
        """The wait goes on, later by the pause."""
        pending = self.get(id_)
        if pending is None or pending.held is None:
            return
        pause, pending.held = now - pending.held, None
        if pending.result_due < NEVER:
            pending.result_due += pause
            heapq.heappush(self._results, (pending.result_due, id_))

    def not_accepted(self, now: float) -> Iterator[str]:
        """Ids that have waited too long for ACCEPT."""
        while self._accepts and self._accepts[0][0] <= now:
            due, id_ = self._accepts.popleft()
            pending = self.get(id_)
            if pending is not None and not pending.accepted and pending.accept_due <= due:
                yield id_

    def not_answered(self, now: float) -> Iterator[str]:
        """Ids that have waited too long for RESULT."""
        while self._results and self._results[0][0] <= now:
            due, id_ = heapq.heappop(self._results)
            pending = self.get(id_)
            if pending is not None and pending.held is None and due >= pending.result_due:
                yield id_

    def due(self) -> float:
        """When the next watch is over (s)."""
        self._drop_past()
        while self._results and self._results[0][1] not in self:
            heapq.heappop(self._results)
        accept = self._accepts[0][0] if self._accepts else NEVER
        return min(accept, self._results[0][0]) if self._results else accept

    def _drop_past(self) -> None:
        accepts, find = self._accepts, self.get
        while accepts:
            pending = find(accepts[0][1])
            if pending is not None and not pending.accepted:
                break
            accepts.popleft()
        self._most = 2 * len(self) + _SPARE
