"""Client side of the node protocol for one peer (sans-I/O). Every call produces exactly one result.

It is used both in real time (`client.py` drives it) and in lock step (its messages travel in
envelopes). It guarantees:

- Every call ends with exactly one Outcome, whatever happens to the connection or the peer.
- A call is never repeated under another id. After a lost connection the same call is sent again
  under its id to the same boot of the peer, marked `again`: the peer either knows the id or says
  that it may have forgotten it, and so runs the call at most once. It is never sent to another
  boot.
- A result that the caller itself decides is ERROR with a cause (see the table in docs/protocol.md):
  executed = no if the call was never sent, otherwise unknown. It is also unknown if the owner named
  the boot that the call was meant for: the owner may have sent it before its own restart.
"""

from __future__ import annotations

import heapq
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple, Protocol

from msgspec import Struct
from msgspec.structs import replace

from petrobot.services.comm.calls.events import EventIntake
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import (
    Call,
    Executed,
    Outcome,
    ResultAck,
    boot_text,
    split_boot,
)
from petrobot.services.comm.protocol.plain import plain

NEVER: Final = float("inf")
_SPARE: Final = 256


class Patience(Struct, frozen=True):
    """How long the caller waits (s)."""

    reconnect: float = 2.0
    """For a lost connection to come back, before its calls end."""
    again: float = 2.0
    """Between two calls that fail at once because the peer is absent; calls in between wait.
    `petrobot up` takes about 2.5 s to start a dead node again: three tries reach it. An action of a
    node that stays away delays its task by this time."""
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


class PendingCall(Struct):
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

    def postpone(self, until: float) -> None:
        """Let no timeout be due before `until` (s)."""
        self._accepts = deque((max(due, until), id_) for due, id_ in self._accepts)
        self._results = [(max(due, until), id_) for due, id_ in self._results]
        for pending in self.values():
            pending.accept_due = max(pending.accept_due, until)
            pending.result_due = max(pending.result_due, until)

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

    def waits(self, now: float) -> bool:
        """Whether what is sent now waits for a connection."""
        return now < self.until < NEVER

    def new_call(self, now: float) -> CallEnd | None:
        """Return how a new call ends at once; None if it waits.

        A call that follows a failed one too soon waits: a task that repeats a failed call at once
        must not loop as fast as the machine can, nor use up all its tries before the peer is back.
        """
        if self.waits(now):
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


# What a caller remembers of finished calls: stored results, calls given up, acknowledgements to
# send.

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


class LateResult(Struct, frozen=True):
    """The peer's own result of a call that had already ended here (lost, given up). It is to be
    recorded and changes nothing."""

    outcome: Outcome


class PeerLost(Struct, frozen=True):
    """The connection is closed."""

    reason: str


Notice = m.Welcome | PeerLost | m.Accept | m.Feedback | m.Outcome | LateResult | m.Event | m.Answer
"""What a caller reports to its owner: messages of the peer, and what is known without one.

WELCOME: the connection is open; its `runs` are ids of this caller's calls that the peer still runs
or whose results it keeps. Outcome: the one result of a call, from the peer or decided here. Event:
each number of a source comes once. Answer: `ok` is False, with `cause` in the data, if the peer
gave none.
"""


ERROR: Final = "error"


class Caller:
    """Calls to one peer. `hello` introduces the caller; its epoch goes into each call that names
    none.

    With `auto_ack` results and events are acknowledged at once. Otherwise the owner calls
    `acknowledge` when it has stored them.
    """

    def __init__(
        self, peer: str, hello: m.Hello, *, auto_ack: bool = False, patience: Patience | None = None
    ) -> None:
        self.peer = peer
        self.hello = hello
        self.up = False
        self.boot = ""
        """Boot of the peer's process; empty before the first connection."""
        self.stops = 0
        """How many cleared emergency stops of the peer are known: those before the first
        connection, and those of which a result told."""
        self.offers: tuple[str, ...] = ()
        self.soonest = NEVER
        """A time that is never later than `due` (s). A shell whose timer is not set for later need
        not compute `due`, which is slower."""
        self._auto_ack = auto_ack
        self.patience = patience or Patience()
        self._absence = PeerAbsence(peer, self.patience)
        self._pending = PendingCalls()
        self.pending: Collection[str] = self._pending.keys()
        """Ids of the calls without a result."""
        self._commands: dict[str, tuple[float, m.Command]] = {}
        self._names: tuple[str, ...] | None = None
        self._events = EventIntake()
        self._settled = FinishedCalls(self.patience.acknowledge)
        self._messages: list[m.Message] = []
        self._notices: list[Notice] = []
        self._takers: Mapping[type, Callable[[float, Any], None]] = {
            m.Outcome: lambda now, outcome: self.take_outcomes(now, (outcome,)),
            m.Accept: self._take_accept,
            m.Feedback: self._take_feedback,
            m.Event: self._take_event,
            m.Answer: self._take_answer,
            m.Welcome: self.link_up,
            m.Refuse: self.link_refused,
            m.Bye: lambda now, bye: self.link_down(now, bye.text or "it left"),
            m.Ping: lambda now, ping: self._messages.append(m.Pong(ping.number)),
        }

    def open(self, now: float) -> None:
        """Send HELLO (lock step only; in real time the connection sends it)."""
        self._messages.append(self.hello)
        self.connecting(now)

    def connecting(self, now: float) -> None:
        """A first connection is being tried: calls made now wait for it as long as for a
        reconnection."""
        self._absence.wait(now)
        self.soonest = min(self.soonest, self._absence.until)

    def call(self, now: float, call: m.Call) -> None:
        """Make a call. Raises ValueError for an id that is already pending, NotPlainError for
        arguments that no message can carry."""
        self.begin(
            now,
            call.id,
            call.service,
            call.arguments,
            call.deadline,
            call.parent,
            call.seed,
            call.epoch,
            call.boot,
            again=call.again,
        )

    def begin(
        self,
        now: float,
        id: str,  # noqa: A002
        service: str,
        arguments: Mapping[str, Any],
        deadline: float | None = None,
        parent: str = "",
        seed: int = 0,
        epoch: int = 0,
        boot: str = "",
        waiter: Waiter | None = None,
        again: bool = False,
    ) -> int:
        """Make a call from the fields of a Call. Return how many messages wait to be sent.

        A `waiter` receives the result instead of a notice, and the result is then acknowledged.
        Raises as `call`.
        """
        if id in self._pending:
            raise ValueError(f"call {id}: a call with this id is already pending; use unique ids")
        if arguments:
            arguments = plain(arguments, "arguments")
        call = m.Call(
            id,
            service,
            arguments,
            deadline,
            epoch or self.hello.epoch,
            boot_text(boot or self.boot, self.stops),
            parent,
            seed,
            again,
        )
        if self.up:
            due = now + self.patience.accept
            self._pending[id] = PendingCall(call, not boot, now, waiter, True, False, None, due)
            self._pending.watch_new(due, id)
            self._messages.append(call)
            if due < self.soonest:
                self.soonest = due
        else:
            self._begin_unsent(now, PendingCall(call, not boot, now, waiter))
        return len(self._messages)

    def _begin_unsent(self, now: float, pending: PendingCall) -> None:
        self._pending[pending.call.id] = pending
        away = self._absence.new_call(now)
        self.soonest = min(self.soonest, self._absence.until)
        if away is not None:
            self._end(pending.call.id, *away, pending.if_unsent)

    def cancel(self, now: float, id: str, reason: str = "", within: float | None = None) -> None:  # noqa: A002
        """Ask the peer to stop a call's run. An id that is not pending is ignored.

        The call still ends with one Outcome: with cause `no_answer` if the peer does not
        confirm `within` seconds (None: `Patience.stop`).
        """
        pending = self._pending.get(id)
        if pending is None or pending.cancel is not None:
            return
        if not pending.sent and pending.if_unsent is m.Executed.NO:
            self._end(id, "cancelled", reason, m.Executed.NO)
            return
        pending.cancel = reason
        self._pending.release(now, id)
        self._watch(pending, now + (self.patience.stop if within is None else within))
        if self.up:
            self._messages.append(m.Cancel(id, reason))

    def hold(self, now: float, id: str) -> None:  # noqa: A002
        """The peer holds this call's run: the wait for its result stands still until `release`."""
        self._pending.hold(now, id)

    def release(self, now: float, id: str) -> None:  # noqa: A002
        """The run continues, and so does the wait for its result."""
        self._pending.release(now, id)
        self.soonest = min(self.soonest, self._pending.due())

    def cancel_children(self, now: float, parent: str, reason: str = "") -> None:
        """Cancel all calls made on behalf of this one."""
        for id_ in [id_ for id_, pending in self._pending.items() if pending.call.parent == parent]:
            self.cancel(now, id_, reason)

    def command(self, now: float, command: m.Command) -> None:
        """Send a command to the node; as a call, it waits for a connection that is being tried,
        and is sent again under its id after each reconnection until it is answered. Raises
        NotPlainError for data that no message can carry."""
        command = replace(command, data=plain(command.data, "data"))
        if not self.up and not self._absence.waits(now):
            self._no_answer(command.id, UNREACHABLE)
            return
        due = now + self.patience.answer
        self._commands[command.id] = due, command
        self.soonest = min(self.soonest, due)
        if self.up:
            self._messages.append(command)

    def subscribe(self, now: float, names: Iterable[str], *, fresh: bool = False) -> None:
        """Subscribe to these events, also after each reconnection; replaces an earlier
        subscription. With `fresh`, events of the time before are not wanted."""
        self._names = tuple(names)
        if self.up:
            self._messages.append(m.Subscribe(self._names, fresh))

    def acknowledge(self, now: float, id: str) -> None:  # noqa: A002
        """The owner has stored the result of this call, so the peer may forget it.

        After a restart of the owner this also works for calls of the time before. A call that was
        given up here has no result yet; it is ignored.
        """
        settled = self._settled
        if id not in self._pending and not settled.is_safe(id) and not settled.was_given_up(id):
            self._ack(now, id)

    def disown(self, now: float, id: str) -> None:  # noqa: A002
        """Stop a run that the peer still keeps (`Welcome.runs`) and the owner cannot use. Its
        result comes as `LateResult`."""
        if id not in self._pending and self.up:
            self._settled.give_up(id)
            self._messages.append(m.Cancel(id, "disowned"))

    def acknowledge_event(self, now: float, event: m.Event) -> None:
        """The owner has stored this event and all before it of the same source."""
        ack = self._events.acknowledge(event)
        if ack is not None and self.up:
            self._messages.append(ack)

    def link_up(self, now: float, welcome: m.Welcome) -> None:
        """The peer welcomed us: send pending calls again under their ids, or end them if it is
        another boot."""
        process, stops, _ = split_boot(welcome.boot)
        same = process == self.boot
        if not self.boot:
            self.stops = stops
        self.up = True
        self._absence.over()
        self.boot, self.offers = process, welcome.offers
        self._notices.append(welcome)
        if not same:
            self._forget_boot()
        if self._names is not None:
            self._messages.append(m.Subscribe(self._names))
        for pending in list(self._pending.values()):
            self._send(now, pending)
            if pending.cancel is not None:
                self._messages.append(m.Cancel(pending.call.id, pending.cancel))
        self._messages.extend(command for _, command in self._commands.values())
        self._settle_again(now, welcome.runs)

    def _forget_boot(self) -> None:
        """The peer is a new process: calls sent to the old one are lost, and its event numbers
        begin at 1 again."""
        self._events.clear()
        for id_, pending in list(self._pending.items()):
            if pending.sent:
                self._end(id_, "rebooted", f"{self.peer} was restarted", m.Executed.UNKNOWN)
        self._settled.peer_is_new()

    def _settle_again(self, now: float, runs: Iterable[str]) -> None:
        """Handle runs that the peer still keeps although they ended here: cancel those given up,
        acknowledge those whose acknowledgement was lost."""
        for id_ in runs:
            if self._settled.was_given_up(id_):
                self._messages.append(m.Cancel(id_, "given up"))
            elif self._settled.is_safe(id_):
                self._ack(now, id_)

    def link_down(self, now: float, reason: str, *, final: bool = False) -> None:
        """The connection broke. Calls wait for it to come back, unless `final`: the peer has
        already been silent for long."""
        self._absence.fail(reason)
        if not self.up:
            return
        self.up = False
        self._messages.clear()
        self._settled.link_lost()
        self._notices.append(PeerLost(reason))
        if final:
            self._end_all(LOST, reason)
        else:
            self.connecting(now)

    def unreached(self, now: float, trouble: str, *, gone: bool) -> None:
        """An attempt to connect failed. `gone`: nothing listens at the peer's address.

        In that case a process to which we were connected has ended, so its calls end at once. A
        peer to which we were never connected may still be starting.
        """
        self._absence.fail(trouble)
        if gone and self.boot and not self.up and self._absence.until < NEVER:
            self._end_all(*self._absence.give_up())

    def link_refused(self, now: float, refuse: m.Refuse) -> None:
        """The peer refuses us: end every call, including new ones, until it welcomes us."""
        was_up, self.up = self.up, False
        away = self._absence.refuse(refuse.code, refuse.text)
        self._messages.clear()
        if was_up or self._pending or self._commands:
            self._notices.append(PeerLost(away.text))
        self._end_all(*away)

    def receive(self, now: float, message: m.Message) -> None:
        """Handle a message of the peer. Kinds that only a server receives are ignored."""
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(now, message)

    def take_outcomes(self, now: float, outcomes: Iterable[m.Outcome]) -> None:
        """Handle several results at once, as `receive`."""
        safe: list[str] = []
        take = self._pending.pop
        for outcome in outcomes:
            id_ = outcome.id
            if outcome.cause == m.EMERGENCY_STOP:
                self._learn_of_stop(outcome)
            pending = take(id_, None)
            if pending is None:
                if id_ not in safe:
                    self._take_late(now, outcome)
                continue
            waiter = pending.waiter
            if waiter is not None:
                safe.append(id_)
                if not waiter.done():
                    waiter.set_result(outcome)
                continue
            if self._auto_ack:
                safe.append(id_)
            else:
                self._settled.end(id_, False)
            self._notices.append(outcome)
        if safe:
            self._ack(now, *safe)

    def _learn_of_stop(self, outcome: m.Outcome) -> None:
        stops = outcome.values.get(m.STOPS)
        if outcome.values.get(m.LATCHED) is True and type(stops) is int:
            self.stops = stops

    def _take_late(self, now: float, outcome: m.Outcome) -> None:
        id_ = outcome.id
        safe = self._settled.is_safe(id_)
        if safe is None:
            self._settled.turn_up(id_)
            if outcome.executed is not m.Executed.UNKNOWN:
                self._notices.append(LateResult(outcome))
        if safe is not False:
            self._ack(now, id_)

    def _take_accept(self, now: float, accept: m.Accept) -> None:
        pending = self._pending.get(accept.id)
        if pending is None or pending.accepted:
            return
        pending.accepted = True
        self._notices.append(accept)
        if pending.call.deadline is not None:
            self._watch(pending, pending.made + pending.call.deadline + self.patience.stop)

    def _take_feedback(self, now: float, feedback: m.Feedback) -> None:
        if feedback.id in self._pending:
            self._notices.append(feedback)

    def _take_event(self, now: float, event: m.Event) -> None:
        new, ack = self._events.take(event, self._auto_ack)
        if ack is not None:
            self._messages.append(ack)
        if new:
            self._notices.append(event)

    def _take_answer(self, now: float, answer: m.Answer) -> None:
        if self._commands.pop(answer.id, None) is not None:
            self._notices.append(answer)

    def stood_still(self, at: float) -> None:
        """This process did not listen until `at`. Wait from then on at least as long as for ACCEPT:
        the peer, perhaps on the same host, may have stood still, too."""
        until = at + self.patience.accept
        self._pending.postpone(until)
        self._commands = {id_: (max(due, until), c) for id_, (due, c) in self._commands.items()}

    def advance(self, now: float) -> None:
        """End the calls that have waited too long."""
        away = self._absence.advance(now)
        if away is not None:
            self._end_all(*away)
        for id_ in self._pending.not_accepted(now):
            if self.up:
                self._give_up(
                    id_,
                    "not_accepted",
                    f"{self.peer} did not accept the call within {self.patience.accept:g} s",
                )
        for id_ in self._pending.not_answered(now):
            self._give_up(id_, "no_answer", f"{self.peer} sent no result in time")
        for id_ in [id_ for id_, (due, _) in self._commands.items() if due <= now]:
            self._no_answer(id_, "no_answer")

    def due(self) -> float | None:
        """Return when `advance` must be called next (s), None if never."""
        waits = (self._pending.due(), self._settled.due, self._absence.until)
        self.soonest = soonest = min(*waits, *(due for due, _ in self._commands.values()))
        return soonest if soonest < NEVER else None

    @property
    def has_news(self) -> bool:
        """Return whether there are notices to take."""
        return bool(self._notices)

    def messages(self, now: float | None = None) -> list[m.Message]:
        """Take out the messages to send, in order; each is returned once.

        Acknowledgements wait for others until `now` reaches their time (None: do not wait).
        """
        if now is None or now >= self._settled.due:
            self._messages += self._settled.take_acks()
        messages, self._messages = self._messages, []
        return messages

    def notices(self) -> list[Notice]:
        """Take out the notices for the owner, in order; each is returned once."""
        notices, self._notices = self._notices, []
        return notices

    def _send(self, now: float, pending: PendingCall) -> None:
        call = pending.call
        if pending.any_boot and split_boot(call.boot)[0] != self.boot:
            call = pending.call = replace(call, boot=boot_text(self.boot, self.stops))
        if pending.sent and not call.again:
            call = pending.call = replace(call, again=True)
        pending.sent, pending.accepted = True, False
        due = now + self.patience.accept
        self._pending.watch_accept(pending, due)
        self._messages.append(call)
        self.soonest = min(self.soonest, due)

    def _watch(self, pending: PendingCall, due: float) -> None:
        self._pending.watch_result(pending, due)
        self.soonest = min(self.soonest, due)

    def _ack(self, now: float, *ids: str) -> None:
        if self.up:
            self._settled.acknowledge(now, *ids)
            self.soonest = min(self.soonest, self._settled.due)

    def _give_up(self, id_: str, cause: str, text: str) -> None:
        if self.up:
            self._messages.append(m.Cancel(id_, cause))
        self._end(id_, cause, text, m.Executed.UNKNOWN)

    def _end_all(self, cause: str, text: str) -> None:
        for id_, pending in list(self._pending.items()):
            its = UNREACHABLE if cause == LOST and not pending.sent else cause
            self._end(id_, its, text, m.Executed.UNKNOWN if pending.sent else pending.if_unsent)
        for id_ in list(self._commands):
            self._no_answer(id_, cause)

    def _end(self, id_: str, cause: str, text: str, executed: m.Executed) -> None:
        pending = self._pending.pop(id_)
        if pending.sent:
            self._settled.give_up(id_)
        outcome, waiter = m.Outcome(id_, ERROR, {}, cause, text, executed), pending.waiter
        if waiter is None:
            self._notices.append(outcome)
        elif not waiter.done():
            waiter.set_result(outcome)

    def _no_answer(self, id_: str, cause: str) -> None:
        self._commands.pop(id_, None)
        self._notices.append(m.Answer(id_, False, {"cause": cause}))
