"""What a caller keeps about its calls to one peer (sans-I/O): pending calls, the lost connection,
finished calls."""

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
    """For a lost connection to come back, before its calls end."""
    again: float = 0.1
    """Between two calls that fail at once because the peer is not there; calls in between wait."""
    accept: float = 1.0
    """For ACCEPT."""
    stop: float = 5.0
    """For RESULT after the deadline or a CANCEL: the node's stop routine and kill take time."""
    answer: float = 2.0
    """For the answer to a command."""
    acknowledge: float = 0.05
    """How long an acknowledgement waits for others, to be sent in one message with them."""


class Waiter(Protocol):
    """Receives the result of one call, for example an asyncio future."""

    def done(self) -> bool:
        """Return whether it no longer wants the result."""

    def set_result(self, outcome: Outcome, /) -> None:
        """Receive the result."""


@dataclass(slots=True)
class PendingCall:
    """A call without a result. `made` and the due times are on the caller's clock (s)."""

    call: Call
    any_boot: bool
    """While unsent, the call may go to any boot of the peer; False if its owner names one."""
    made: float
    waiter: Waiter | None = None
    """Receives the result instead of a notice; the result is then acknowledged."""
    sent: bool = False
    accepted: bool = False
    cancel: str | None = None
    accept_due: float = NEVER
    result_due: float = NEVER
    held: float | None = None
    """Since when an operator holds its run (s)."""

    @property
    def if_unsent(self) -> Executed:
        """Return `executed` if the call ends unsent: unknown if its owner may have sent it before a
        restart."""
        return Executed.NO if self.any_boot and not self.call.again else Executed.UNKNOWN


class PendingCalls(dict[str, PendingCall]):
    """Pending calls by id, with their timeouts.

    All calls wait equally long for ACCEPT, so these timeouts are a queue; those for RESULT are a
    heap. Entries are not removed early: one that is due is compared with the call as it is now.
    """

    def __init__(self) -> None:
        super().__init__()
        self._accepts: deque[tuple[float, str]] = deque()
        self._most = _SPARE
        """Length of the ACCEPT queue above which entries of finished calls are removed from it."""
        self._results: list[tuple[float, str]] = []

    def watch_new(self, due: float, id_: str) -> None:
        """Expect ACCEPT until `due` for a call that was sent when it was made (its `accept_due` is
        set)."""
        accepts = self._accepts
        accepts.append((due, id_))
        if len(accepts) > self._most:
            # Most of these calls are finished long before they are due. Without this a second of
            # quick calls would leave a hundred thousand entries.
            self._drop_past()

    def watch_accept(self, pending: PendingCall, due: float) -> None:
        """Expect ACCEPT until `due` (s)."""
        pending.accept_due = due
        self.watch_new(due, pending.call.id)

    def watch_result(self, pending: PendingCall, due: float) -> None:
        """Expect RESULT until `due` (s), or until an earlier time that is already set."""
        if due < pending.result_due:
            pending.result_due = due
            heapq.heappush(self._results, (due, pending.call.id))

    def hold(self, now: float, id_: str) -> None:
        """Stop the clock of this call's wait for RESULT."""
        pending = self.get(id_)
        if pending is not None and pending.held is None:
            pending.held = now

    def release(self, now: float, id_: str) -> None:
        """Restart the clock, later by the duration of the pause."""
        pending = self.get(id_)
        if pending is None or pending.held is None:
            return
        pause, pending.held = now - pending.held, None
        if pending.result_due < NEVER:
            pending.result_due += pause
            heapq.heappush(self._results, (pending.result_due, id_))

    def not_accepted(self, now: float) -> Iterator[str]:
        """Yield ids that have waited too long for ACCEPT."""
        while self._accepts and self._accepts[0][0] <= now:
            due, id_ = self._accepts.popleft()
            pending = self.get(id_)
            if pending is not None and not pending.accepted and pending.accept_due <= due:
                yield id_

    def not_answered(self, now: float) -> Iterator[str]:
        """Yield ids that have waited too long for RESULT."""
        while self._results and self._results[0][0] <= now:
            due, id_ = heapq.heappop(self._results)
            pending = self.get(id_)
            if pending is not None and pending.held is None and due >= pending.result_due:
                yield id_

    def due(self) -> float:
        """Return when the next timeout is due (s)."""
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


# A lost connection: which calls wait for it, and how the others end.

LOST: Final = "lost"
UNREACHABLE: Final = "unreachable"
REFUSED: Final = "refused"


class CallEnd(NamedTuple):
    """Why a call ends: cause and text of its ERROR outcome."""

    cause: str
    text: str


class PeerAbsence:
    """The time during which there is no connection to one peer."""

    def __init__(self, peer: str, patience: Patience) -> None:
        self._peer = peer
        self._patience = patience
        self._refusal = ""
        self._trouble = ""
        """Why there is no connection, as far as is known."""
        self._why = ""
        self._again_from = 0.0
        self.until = NEVER
        """Calls wait until then (s); NEVER: they do not wait."""

    def over(self) -> None:
        """The peer is connected."""
        self._refusal, self._trouble, self.until = "", "", NEVER

    def wait(self, now: float) -> None:
        """A connection is being tried, for the first time or again: calls wait for it."""
        self._wait_until(
            now + self._patience.reconnect,
            f"{self._peer} did not come back within {self._patience.reconnect:g} s",
        )

    def fail(self, trouble: str) -> None:
        """An attempt to connect has failed; waiting calls still wait."""
        self._trouble = trouble

    def give_up(self) -> CallEnd:
        """The peer's process is gone. Return how all calls end."""
        self.until = NEVER
        return CallEnd(LOST, f"{self._peer} is gone: nothing listens at its address any more")

    def refuse(self, code: str, text: str) -> CallEnd:
        """The peer refuses us until further notice. Return how all calls end."""
        self._refusal, self.until = f"{self._peer} refuses the connection: {code}: {text}", NEVER
        return CallEnd(REFUSED, self._refusal)

    def new_call(self, now: float) -> CallEnd | None:
        """Return how a new call ends at once; None if it waits.

        A call that follows a failed one too soon waits a little: a task that repeats a failed call
        at once must not loop as fast as the machine can.
        """
        if now < self.until < NEVER:
            return None
        text = self._refusal or self._with_trouble(f"{self._peer} is not connected")
        away = CallEnd(REFUSED if self._refusal else UNREACHABLE, text)
        if now < self._again_from:
            self._wait_until(self._again_from, away.text)
            return None
        self._again_from = now + self._patience.again
        return away

    def advance(self, now: float) -> CallEnd | None:
        """Return how the waiting calls end now; None if they still wait."""
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


# What a caller remembers of finished calls: stored results, calls given up, acknowledgements to send.

REMEMBERED: Final = 10_000
"""How many ids of finished calls are remembered at least."""
ACKS_AT_ONCE: Final = 64
"""So many acknowledgements are sent without waiting for more."""
IN_ONE: Final = 200
"""Most acknowledgements in one message: as many of the longest ids fit its size limit."""


class FinishedCalls:
    """Finished calls of one caller. An acknowledgement waits up to `delay` seconds to be sent with
    others."""

    def __init__(self, delay: float) -> None:
        self._delay = delay
        self._safe: dict[str, bool] = {}
        self._given_up: OrderedDict[str, None] = OrderedDict()
        self._acks: list[str] = []
        self.due = NEVER
        """When the waiting acknowledgements must be sent (s)."""

    def end(self, id_: str, safe: bool) -> None:
        """The peer's result of this call has arrived; `safe`: it is stored already."""
        self._safe[id_] = safe

    def _prune(self) -> None:
        """Forget the oldest in bulk, so that no single call pays for it. Results that are not
        stored yet stay."""
        for old in list(self._safe)[:REMEMBERED]:
            if self._safe[old]:
                del self._safe[old]

    def is_safe(self, id_: str) -> bool | None:
        """Return whether the peer's result of this call is stored; None if none has arrived."""
        return self._safe.get(id_)

    def give_up(self, id_: str) -> None:
        """This call ended here without the peer's result."""
        self._given_up[id_] = None
        if len(self._given_up) > REMEMBERED:
            del self._given_up[next(iter(self._given_up))]

    def was_given_up(self, id_: str) -> bool:
        """Return whether this call ended here and the peer's own result has not arrived since."""
        return id_ in self._given_up

    def turn_up(self, id_: str) -> None:
        """The peer's own result of a call that had ended here has arrived late; it is only
        recorded."""
        self._given_up.pop(id_, None)
        self.end(id_, True)

    def acknowledge(self, now: float, *ids: str) -> None:
        """Tell the peer soon that these results are stored."""
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
        """Take out all waiting acknowledgements. Call it once they are `due`."""
        acks, self._acks, self.due = self._acks, [], NEVER
        return [
            ResultAck(acks[n], tuple(acks[n + 1 : n + IN_ONE])) for n in range(0, len(acks), IN_ONE)
        ]

    def link_lost(self) -> None:
        """Drop waiting acknowledgements: the peer lists the results that it keeps when it is
        back."""
        self._acks.clear()
        self.due = NEVER

    def peer_is_new(self) -> None:
        """The peer is a new process: results of calls given up cannot arrive any more."""
        self._given_up.clear()
