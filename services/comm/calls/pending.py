"""Calls under way at their caller, and how long each may wait."""

from __future__ import annotations

import heapq
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from petrobot.services.comm.protocol.messages import Call, Executed, Outcome, ResultAck

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
class PendingCall:
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


class PendingCalls(dict[str, PendingCall]):
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

    def watch_accept(self, pending: PendingCall, due: float) -> None:
        """Wait for ACCEPT until `due`."""
        pending.accept_due = due
        self.watch_new(due, pending.call.id)

    def watch_result(self, pending: PendingCall, due: float) -> None:
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


# A peer that is not there: which calls wait for it, and what those that do not are told.

LOST: Final = "lost"
UNREACHABLE: Final = "unreachable"
REFUSED: Final = "refused"


class CallEnd(NamedTuple):
    """Why a call ends."""

    cause: str
    text: str


class PeerAbsence:
    """Of one peer, while there is no link to it."""

    def __init__(self, peer: str, patience: Patience) -> None:
        self._peer = peer
        self._patience = patience
        self._refusal = ""
        self._trouble = ""
        """Why there is no link, as far as is known."""
        self._why = ""
        self._again_from = 0.0
        self.until = NEVER
        """Calls wait until then (s); NEVER: they do not wait."""

    def over(self) -> None:
        """The peer is there."""
        self._refusal, self._trouble, self.until = "", "", NEVER

    def wait(self, now: float) -> None:
        """A link is being tried for the first time or again: calls wait for it."""
        self._wait_until(
            now + self._patience.reconnect,
            f"{self._peer} did not come back in {self._patience.reconnect:g} s",
        )

    def fail(self, trouble: str) -> None:
        """An attempt to connect has failed; those that wait go on waiting."""
        self._trouble = trouble

    def give_up(self) -> CallEnd:
        """The peer's process is gone. What all calls are told."""
        self.until = NEVER
        return CallEnd(LOST, f"{self._peer} is gone: nothing listens at its address any more")

    def refuse(self, code: str, text: str) -> CallEnd:
        """The peer refuses us, until it is there. What all calls are told."""
        self._refusal, self.until = f"{self._peer} refuses the connection: {code}: {text}", NEVER
        return CallEnd(REFUSED, self._refusal)

    def new_call(self, now: float) -> CallEnd | None:
        """What a new call is told at once; None: it waits.

        One that follows another too soon waits a little: a task that tries again at once must not
        go round as fast as the machine can.
        """
        if now < self.until < NEVER:
            return None
        text = self._refusal or self._with_trouble(f"{self._peer} is not there")
        away = CallEnd(REFUSED if self._refusal else UNREACHABLE, text)
        if now < self._again_from:
            self._wait_until(self._again_from, away.text)
            return None
        self._again_from = now + self._patience.again
        return away

    def advance(self, now: float) -> CallEnd | None:
        """What those that have waited are told now, if anything."""
        if now < self.until:
            return None
        self.until = NEVER
        return CallEnd(
            REFUSED if self._refusal else LOST, self._refusal or self._with_trouble(self._why)
        )

    def _with_trouble(self, text: str) -> str:
        return f"{text} ({self._trouble})" if self._trouble and self._trouble not in text else text

    def _wait_until(self, until: float, why: str) -> None:
        self.until, self._why = until, why


# What a caller remembers of calls that have ended: which results are safe, what was given up, what
# is to be acknowledged.

REMEMBERED: Final = 10_000
"""Ids of ended calls that are remembered at least."""
ACKS_AT_ONCE: Final = 64
"""Acknowledgements that wait no longer for others."""
IN_ONE: Final = 200
"""Most of them in one message: so many of the longest ids keep to its limit."""


class FinishedCalls:
    """Ended calls of one caller. An acknowledgement waits up to `delay` seconds for others to go
    with it."""

    def __init__(self, delay: float) -> None:
        self._delay = delay
        self._safe: dict[str, bool] = {}
        self._given_up: OrderedDict[str, None] = OrderedDict()
        self._acks: list[str] = []
        self.due = NEVER
        """When the waiting acknowledgements are to go (s)."""

    def end(self, id_: str, safe: bool) -> None:
        """The peer's result of this call has come, and is safe already or not yet."""
        self._safe[id_] = safe

    def _prune(self) -> None:
        """Forget the oldest in bulk, so that a single call pays nothing for it; what is not safe
        yet stays."""
        for old in list(self._safe)[:REMEMBERED]:
            if self._safe[old]:
                del self._safe[old]

    def is_safe(self, id_: str) -> bool | None:
        """Whether the peer's result of this call is safe; None if none has come."""
        return self._safe.get(id_)

    def give_up(self, id_: str) -> None:
        """This call ended here without the peer's result."""
        self._given_up[id_] = None
        if len(self._given_up) > REMEMBERED:
            del self._given_up[next(iter(self._given_up))]

    def was_given_up(self, id_: str) -> bool:
        """Whether this call ended here and the peer's own result has not come since."""
        return id_ in self._given_up

    def turn_up(self, id_: str) -> None:
        """The peer's own result of a call that had ended here has come late; it is only
        recorded."""
        self._given_up.pop(id_, None)
        self.end(id_, True)

    def acknowledge(self, now: float, *ids: str) -> None:
        """Tell the peer soon that these results are safe."""
        safe, acks = self._safe, self._acks
        if not acks:
            self.due = now + self._delay
        for id_ in ids:
            safe[id_] = True
        acks += ids
        if len(safe) > 2 * REMEMBERED:
            self._prune()
        if len(acks) >= ACKS_AT_ONCE:
            self.due = now

    def take_acks(self) -> list[ResultAck]:
        """The acknowledgements of all that wait. To be asked for once they are `due`."""
        acks, self._acks, self.due = self._acks, [], NEVER
        return [
            ResultAck(acks[n], tuple(acks[n + 1 : n + IN_ONE])) for n in range(0, len(acks), IN_ONE)
        ]

    def link_lost(self) -> None:
        """What waits is not told any more: the peer lists what it keeps when it is back."""
        self._acks.clear()
        self.due = NEVER

    def peer_is_new(self) -> None:
        """The peer is another process: nothing given up can turn up any more."""
        self._given_up.clear()
