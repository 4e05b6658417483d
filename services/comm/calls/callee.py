"""Server side of the node protocol for all callers of a node (sans-I/O).

It is used both in real time (`server.py` drives it) and in lock step. The node carries out its
`orders` and reports back with `finish`, `feedback`, `raise_event` and `answer`. It guarantees:

- A call id runs at most once in one boot of the node. A known id is answered with ACCEPT (active)
  or with its stored result; an id whose result was dropped is still remembered. Once the memory for
  ids was full (`FinishedIds.complete` is False), an unknown call that may have been sent before
  (`Call.again`) does not run, because its id may be a forgotten one.
- Every run produces one outcome, kept until its caller acknowledges it or until the time
  `Retention.results` has passed.
- A run is active no longer than its deadline, and no longer than its offer's `orphan_time` without
  its caller.
- A device accepts orders from one caller at a time: the holder of its lease.
- ACCEPT comes before every other message about its run. With `accept_after` it is held for that
  long and left out if the run has finished by then: a RESULT says as much, and a message less saves
  both ends a quarter of the time that a short call takes.

Refusals are outcomes with status error and executed = no: unknown_service, local_only, old_epoch,
device_leased, device_overtaken, device_needs_coordinator, cancelled (before it began), and busy
from the node's runner. With executed = unknown: rebooted (meant for another boot), and forgotten
(its result, or perhaps even its id, is no longer kept).
"""

from __future__ import annotations

import heapq
import math
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, Final

import msgpack
from msgspec import Struct
from msgspec.structs import replace

from petrobot.services.comm.calls.events import KEPT, EventBoard
from petrobot.services.comm.calls.peers import Inline as Inline, Offer as Offer, Peers
from petrobot.services.comm.protocol.messages import (
    COORDINATOR,
    Accept,
    Answer,
    Bye,
    Call,
    Cancel,
    Command,
    Event,
    EventAck,
    Executed,
    Feedback,
    Hello,
    Message,
    Outcome,
    Ping,
    Pong,
    Refuse,
    ResultAck,
    Subscribe,
    Welcome,
    boot_text,
    split_boot,
)
from petrobot.services.comm.protocol.plain import NotPlainError, plain
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, negotiate

NEVER: Final = float("inf")
DEADLINE: Final = "deadline"
TOO_MANY_EVENTS: Final = "too_many_events"
TOO_MANY_TEXT: Final = f"raised events faster than they are stored: {KEPT:,} of its action wait"
ORPHAN: Final = "orphan"


class ActiveRun(Struct):
    """An active run; times in seconds on the node's clock.

    `stopping` is set when it was ordered to stop; `reason` says why.
    """

    call: Call
    peer: str
    began: float
    device: str
    orphan_time: float | None
    limit: float = NEVER
    """When its deadline ends (s)."""
    held: float | None = None
    """Since when an operator holds it (s)."""
    released: int = 0
    """Number of the command that released it last, held or not."""
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

    def hold_all(self, now: float, devices: Collection[str], asked: float, number: int) -> None:
        """Stop the clocks of the deadlines of the runs that these devices had ("" for runs without
        a device) when the hold, command `number`, was asked for (s). A later run begins unheld, and
        one that was released before the hold was answered goes on."""
        for run in self.values():
            if run.device in devices and run.held is None and run.began <= asked:
                run.held = now if run.released < number else None

    def release_all(self, now: float, devices: Collection[str] | None, number: int) -> None:
        """Restart the stopped deadlines of these devices' runs (None: of all), later by the
        duration of the pause. This is command `number`."""
        for id_, run in self.items():
            if devices is not None and run.device not in devices:
                continue
            run.released = number
            if run.held is None:
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


class Retention(Struct, frozen=True):
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


_weigh = msgpack.Packer(default=lambda value: None, unicode_errors="surrogatepass").pack
"""Packs data to learn its length on the wire; what cannot be sent counts 0 bytes."""


_DIGITS = "0123456789"
_ENDS = {
    end: bit
    for bit, end in enumerate(
        ["", *(f"{n:0{size}}" for size in (1, 2, 3) for n in range(10**size))]
    )
}
"""The bit of each end of an id in its group: of no, one, two or three digits."""


class FinishedIds:
    """Ids of calls whose results are dropped, stored so compactly that ordinary use never forgets
    one.

    Callers count their calls (docs/protocol.md, `id`). So the last three digits of an id are a bit
    of a Python integer, and the text before them names its group. A million calls of one caller
    need about 1,000 groups of 300 bytes. At most `limit` groups are kept; then the oldest is
    dropped.

    Dropping a group means that an unknown id may have run before. `complete` says whether that can
    be; the callee then refuses repeated calls that it does not know (`Call.again`).
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._groups: OrderedDict[str, int] = OrderedDict()
        self.complete = True
        """Whether no id was ever forgotten: then an unknown id certainly never ran here."""

    def __contains__(self, id_: str) -> bool:
        group, bit = _split(id_)
        bits = self._groups.get(group)
        return bits is not None and bits >> bit & 1 == 1

    def add(self, id_: str) -> None:
        """Remember an id."""
        group, bit = _split(id_)
        groups = self._groups
        groups[group] = groups.get(group, 0) | 1 << bit
        if len(groups) > self._limit:
            groups.popitem(last=False)
            self.complete = False


def _split(id_: str) -> tuple[str, int]:
    """Return the group of an id and its bit there. No two ids have both in common, because group
    and end together are the id."""
    bit = _ENDS.get(id_[-3:])
    if bit is not None:
        return id_[:-3], bit
    group = id_.rstrip(_DIGITS)
    return group, _ENDS[id_[len(group) :]]


class ResultStore:
    """Results by call id. `forgotten` is called with each id whose result is dropped."""

    def __init__(self, keeping: Retention, forgotten: Callable[[str], None]) -> None:
        self._keeping = keeping
        self._forgotten = forgotten
        # An OrderedDict finds its first entry at once. A plain dict scans over all entries that
        # were deleted before it, and results are deleted at the front.
        self._results: OrderedDict[str, tuple[Outcome, str, float, int]] = OrderedDict()
        self._weight = 0
        self.kept: Collection[str] = self._results.keys()
        """Ids whose result is kept (for a quick look; see `in`)."""
        self.gone = FinishedIds(keeping.id_groups)
        """Ids whose result is dropped."""

    def __contains__(self, id_: str) -> bool:
        return id_ in self._results or id_ in self.gone

    def add(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """Keep a result for its caller. `weight` is its length on the wire (bytes); left out, the
        length of its values is taken."""
        if weight is None:
            weight = len(_weigh(outcome.values))
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


ERROR: Final = "error"
HOLD, RELEASE, HELD = "hold", "release", "held"
ANSWERS: Final = 64
"""How many answers to commands are kept. A command is repeated at once or never, and an answer has
some hundred bytes."""


Order = Call | Cancel | Command
"""What the node must do: a message of a caller that was accepted, or a CANCEL of the node's own.

Call: begin this run, and report its result with `finish`. Cancel: stop this run, stop routine
first; `finish` still reports its result; given once per run. `reason` is "cancelled", "deadline",
"orphan", or the text that the caller gave. Command: carry it out, and report with `answer`.
"""


class Callee:
    """The actions and services of a node, for all its callers.

    `offers` are by name. `boot` is a new random text at each start of the process. Callers are
    known by name: one process per name. Nothing that a caller does raises an exception; `finish`
    and similar methods raise ValueError when the node itself names a run that is not active.
    """

    def __init__(
        self,
        name: str,
        boot: str,
        offers: Mapping[str, Offer],
        *,
        directory: str = "",
        any_directory: bool = False,
        keeping: Retention | None = None,
        accept_after: float = 0.0,
    ) -> None:
        self.name = name
        self.boot = boot
        self.stops = 0
        """How many emergency stops of the node were cleared; WELCOME tells it."""
        self.since_cleared: Callable[[], float] = lambda: math.inf
        """Returns the time since the last one was cleared (s), which WELCOME tells, too."""
        self.offers: Mapping[str, Offer] = dict(offers)
        self.directory = directory
        self.events = EventBoard()
        self.soonest = NEVER
        """A time that is never later than `due` (s). A shell whose timer is not set for later need
        not compute `due`, which is slower."""
        self._keeping = keeping or Retention()
        self._peers = Peers(name, directory, any_directory, self._keeping.lease)
        self._running = ActiveRuns()
        self._accept_after = accept_after
        self._accepts: deque[tuple[float, str]] = deque()
        """Runs whose ACCEPT is held: until when (s), and id. Those of finished runs are left
        out."""
        self._results = ResultStore(self._keeping, self.events.forget_run)
        self._numbers = 0
        """How many commands have come."""
        self._commands: dict[str, tuple[str, str, float, int]] = {}
        """Caller and verb of each command that waits for its answer, and when it came (s)."""
        self._answers: OrderedDict[tuple[str, str], Answer] = OrderedDict()
        """The newest answers by caller and command, for commands that are repeated."""
        self._orders: list[Order] = []
        self._messages: list[tuple[str, Message]] = []
        self._takers: Mapping[type, Callable[[float, str, Any], None]] = {
            Call: self._take_call,
            ResultAck: self._take_ack,
            Cancel: self._take_cancel,
            Subscribe: self._take_subscribe,
            EventAck: self._take_event_ack,
            Command: self._take_command,
            Ping: self._take_ping,
            Hello: self._take_hello,
            Bye: self._take_bye,
        }

    # Connections of callers.

    def link_up(
        self, now: float, peer: str, hello: Hello, *, local: bool = True
    ) -> Welcome | Refuse:
        """A caller has connected. Return the answer to its HELLO.

        `peer` is its name, `local` whether it lives on this host.
        """
        refusal = self._peers.refusal(peer, hello)
        if refusal is not None:
            return refusal
        known = self._peers.get(peer)
        if known is None or (known.boot, known.epoch) != (hello.boot, hello.epoch):
            # A new process of that name counts its commands from 1 again.
            self._answers = OrderedDict(
                (key, kept) for key, kept in self._answers.items() if key[0] != peer
            )
        forgotten = self._peers.come(peer, hello, local)
        self.events.peer_down(forgotten, leaves=True)
        self._messages.extend((peer, event) for event in self.events.waiting(peer))
        version = negotiate(hello.oldest_version, hello.newest_version) or NEWEST_VERSION
        offers = tuple(
            name for name, offer in self.offers.items() if local or offer.scope != "local"
        )
        runs = [id_ for id_, run in self._running.items() if run.peer == peer] + self._results.of(
            peer
        )
        boot = boot_text(self.boot, self.stops, self.since_cleared())
        return Welcome(version, self.name, boot, offers, tuple(runs), self.directory)

    def link_down(self, now: float, peer: str, *, leaves: bool = False) -> None:
        """The connection of a caller is closed. With `leaves` it said BYE and gives up leases and
        subscriptions."""
        if not self._peers.go(now, peer, leaves):
            return
        self.events.peer_down(peer, leaves)
        for id_, run in self._running.items():
            if run.peer == peer and run.orphan_time is not None:
                self._running.watch_orphan(id_, now + run.orphan_time)
                self.soonest = min(self.soonest, now + run.orphan_time)

    def lease(self, now: float, id_: str, device: str) -> tuple[str, str] | None:
        """Give a device to the caller of this command. Return why not: cause and text; None if it
        has it."""
        return self._peers.lease(now, self.commander(id_), device, self._in_use)

    # Messages of callers.

    def receive(self, now: float, peer: str, message: Message) -> None:
        """Handle a message of a caller. Kinds that only a client receives are ignored."""
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(now, peer, message)

    def _take_hello(self, now: float, peer: str, hello: Hello) -> None:
        self._messages.append((peer, self.link_up(now, peer, hello)))

    def _take_bye(self, now: float, peer: str, bye: Bye) -> None:
        self.link_down(now, peer, leaves=True)

    def _take_ping(self, now: float, peer: str, ping: Ping) -> None:
        self._messages.append((peer, Pong(ping.number)))

    def _take_call(self, now: float, peer: str, call: Call) -> None:
        id_ = call.id
        if id_ in self._running or id_ in self._results:
            self._known(peer, id_)
            return
        if self._means_another(call):
            text = f"{self.name} was restarted; this call was meant for its previous process"
            # The outcome is stored. Otherwise a following CANCEL would find no trace of the call
            # and answer executed = no.
            self._end(now, peer, Outcome(id_, ERROR, {}, "rebooted", text, Executed.UNKNOWN))
            return
        if call.again and not self._results.gone.complete:
            # Checked before any refusal, because a refusal says executed = no.
            self._end(now, peer, self._maybe_forgotten(id_))
            return
        offer = self.offers.get(call.service)
        refusal = self._peers.refusal_of_call(now, peer, call, offer, self._in_use)
        if refusal is not None or offer is None:
            cause, text = refusal or ("unknown_service", "")
            self._end(now, peer, Outcome(id_, ERROR, {}, cause, text, Executed.NO))
        elif offer.inline is not None:
            self._end(now, peer, self._answered(now, offer.inline, call))
        else:
            self._start(now, peer, call, offer)

    def answer_inline(self, now: float, peer: str, call: Call) -> Outcome | None:
        """Return the outcome of a call to an inline service; None for any other call.

        Like `receive`, but the answer does not go through `messages`: the shell sends it, then
        calls `keep`.
        """
        offer = self.offers.get(call.service)
        id_ = call.id
        results = self._results
        if (
            offer is None
            or offer.inline is None
            or id_ in results.kept
            or id_ in results.gone
            or id_ in self._running
        ):
            return None
        if self._means_another(call) or (call.again and not results.gone.complete):
            return None
        if self._peers.refusal_of_call(now, peer, call, offer, self._in_use) is not None:
            return None
        return self._answered(now, offer.inline, call)

    def keep(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """Store an outcome that `answer_inline` returned until it is acknowledged, like every
        result.

        `weight` is its length on the wire (bytes), None if unknown.
        """
        self._results.add(now, peer, outcome, weight)
        due = now + self._keeping.results
        if due < self.soonest:
            self.soonest = due

    def _means_another(self, call: Call) -> bool:
        """Whether the call was meant for an earlier process of this node."""
        boot = call.boot
        return bool(boot) and boot != self.boot and split_boot(boot)[0] != self.boot

    def _known(self, peer: str, id_: str) -> None:
        """Answer a call id that came before with what is known; never run it again."""
        run = self._running.get(id_)
        owner = run.peer if run is not None else self._results.owner(id_)
        outcome = self._results.get(id_)
        if owner and owner != peer:
            text = f"{owner} already made a call with this id; use unique ids"
            self._messages.append((peer, Outcome(id_, ERROR, {}, "id_taken", text, Executed.NO)))
        elif run is not None:
            self._send_accepts(NEVER)
            self._messages.append((peer, Accept(id_)))
        elif outcome is not None:
            self._messages.append((peer, outcome))
        else:
            text = "this call was handled before, but its result is no longer kept"
            self._messages.append(
                (peer, Outcome(id_, ERROR, {}, "forgotten", text, Executed.UNKNOWN))
            )

    def _maybe_forgotten(self, id_: str) -> Outcome:
        text = f"{self.name} has forgotten the ids of its oldest calls; this may be one of them"
        return Outcome(id_, ERROR, {}, "forgotten", text, Executed.UNKNOWN)

    def _in_use(self, device: str) -> bool:
        return any(run.device == device for run in self._running.values())

    @staticmethod
    def _answered(now: float, inline: Inline, call: Call) -> Outcome:
        try:
            return inline(now, call)
        except Exception as fault:
            # An exception in a service is an error of this call; it must not end the node.
            text = f"{call.service} failed: {type(fault).__name__}: {fault}"
            return Outcome(call.id, ERROR, {}, "crashed", text, Executed.UNKNOWN)

    def _start(self, now: float, peer: str, call: Call, offer: Offer) -> None:
        self._running[call.id] = ActiveRun(call, peer, now, offer.device, offer.orphan_time)
        deadline = call.deadline if call.deadline is not None else offer.deadline
        if deadline is not None:
            self._running.limit(call.id, now + deadline)
            self.soonest = min(self.soonest, now + deadline)
        if self._accept_after:
            due = now + self._accept_after
            self._accepts.append((due, call.id))
            if due < self.soonest:
                self.soonest = due
        else:
            self._messages.append((peer, Accept(call.id)))
        self._orders.append(call)

    def _take_ack(self, now: float, peer: str, ack: ResultAck) -> None:
        self._results.acknowledge(peer, (ack.id, *ack.more))

    def _take_cancel(self, now: float, peer: str, cancel: Cancel) -> None:
        run = self._running.get(cancel.id)
        if run is not None:
            if run.peer == peer:
                self._stop(cancel.id, run, cancel.reason or "cancelled", "cancelled")
        elif cancel.id in self._results:
            self._known(peer, cancel.id)
        elif not self._results.gone.complete:
            self._end(now, peer, self._maybe_forgotten(cancel.id))
        else:
            # The CANCEL may have overtaken its CALL: remember that the call must not begin.
            self._end(
                now, peer, Outcome(cancel.id, ERROR, {}, "cancelled", cancel.reason, Executed.NO)
            )

    def _take_subscribe(self, now: float, peer: str, subscribe: Subscribe) -> None:
        known = self._peers.get(peer)
        if known is not None:
            if subscribe.fresh:
                self.events.skip(peer)
            waiting = self.events.subscribe(peer, subscribe.names, known.role == COORDINATOR)
            self._messages.extend((peer, event) for event in waiting)

    def _take_event_ack(self, now: float, peer: str, ack: EventAck) -> None:
        self.events.acknowledge(peer, ack.source, ack.number)

    def _take_command(self, now: float, peer: str, command: Command) -> None:
        if command.id in self._commands or (peer, command.id) in self._answers:
            self._known_command(peer, command.id)
            return
        self._numbers += 1
        self._commands[command.id] = peer, command.verb, now, self._numbers
        if command.verb == RELEASE:
            devices = [command.target] if command.target else None
            self._running.release_all(now, devices, self._numbers)
            self.soonest = min(self.soonest, self._running.due())
        self._orders.append(command)

    def _known_command(self, peer: str, id_: str) -> None:
        """Answer a repeated command with its stored answer, or as soon as there is one; never
        carry it out twice."""
        if (answer := self._answers.get((peer, id_))) is not None:
            self._messages.append((peer, answer))
        elif (owner := self._commands[id_][0]) != peer:
            text = f"{owner} already gave a command with this id; use unique ids"
            self._messages.append((peer, Answer(id_, False, {"cause": "id_taken", "text": text})))

    # Reports of the node.

    def finish(self, now: float, end: Outcome, *, plain_already: bool = False) -> Outcome:
        """A run has finished: store its outcome, send it to the caller and return it.

        `plain_already`: its values came in a message or were checked, so they are plain data.
        A run that was stopped by its deadline, or for too many events, ends as that ERROR whatever
        it reports; one that was stopped for another reason keeps its own status if it finished
        before. Raises
        ValueError if no such run is active.
        """
        run = self._running.pop(end.id, None)
        if run is None:
            raise ValueError(f"run {end.id}: no active run has this id")
        if run.reason == DEADLINE:
            text = end.text or (
                f"took longer than its deadline (it finished with {end.status} after "
                f"{end.seconds:.3f} s)"
            )
            end = replace(end, status=ERROR, values={}, cause=DEADLINE, text=text, deferred=False)
        elif run.reason == TOO_MANY_EVENTS:
            cause, text = TOO_MANY_EVENTS, TOO_MANY_TEXT
            end = replace(end, status=ERROR, values={}, cause=cause, text=text, deferred=False)
        elif run.stopping and end.cause == "cancelled":
            end = replace(end, cause=run.reason, text=end.text or run.call.service)
        outcome = _sendable(end, plain_already or not end.values)
        self._end(now, run.peer, outcome)
        return outcome

    def feedback(
        self,
        now: float,
        id: str,  # noqa: A002
        fraction: float,
        data: Mapping[str, Any] | None = None,
    ) -> None:
        """Report the progress of a run (0 to 1) to its caller. Nothing is stored for a caller that
        is away."""
        run = self._running.get(id)
        if run is None:
            raise ValueError(f"run {id}: no active run has this id")
        self._send(run.peer, Feedback(id, min(max(fraction, 0.0), 1.0), plain(data or {}, "data")))

    def raise_event(
        self,
        now: float,
        name: str,
        data: Mapping[str, Any] | None = None,
        *,
        source: str = "",
        latched: bool = False,
        run: str = "",
    ) -> Event | None:
        """Raise an event of the outside world for its subscribers, or of an active run for its
        caller.

        A latched event is numbered by its source (default: this node) and kept until it is
        acknowledged. A run whose action has too many such events is stopped instead; then None is
        returned.
        """
        owner = ""
        if run:
            if run not in self._running:
                raise ValueError(f"run {run}: no active run has this id")
            active = self._running[run]
            if latched and self.events.is_full(source or self.name):
                self._stop(run, active, TOO_MANY_TEXT, TOO_MANY_EVENTS)
            if active.reason == TOO_MANY_EVENTS:
                return None
            owner = active.peer
        event = Event(name, source or self.name, 0, plain(data or {}, "data"), run)
        event, peers = self.events.raise_event(event, latched, owner)
        for peer in peers:
            self._send(peer, event)
        return event

    def tell_coordinators(self, name: str) -> None:
        """Send a pulse to each connected coordinator, whatever it has subscribed to."""
        for peer in self._peers.coordinators():
            self._send(peer, Event(name, self.name, 0))

    def answer(self, now: float, id: str, ok: bool, data: Mapping[str, Any] | None = None) -> None:  # noqa: A002
        """Answer a command. Raises ValueError if no such command waits for an answer.

        After a `hold`, `answers` in the data says for each device what happened (this node's name
        stands for runs without a device). The deadlines of held runs stand still until a `release`.
        """
        peer, verb, asked, number = self._commands.pop(id, ("", "", now, 0))
        if not peer:
            raise ValueError(f"command {id}: no command with this id waits for an answer")
        if verb == HOLD and data is not None:
            answers = data.get("answers", {})
            held = ["" if d == self.name else d for d, said in answers.items() if said == HELD]
            self._running.hold_all(now, held, asked, number)
        answer = Answer(id, ok, plain(data or {}, "data"))
        self._answers[peer, id] = answer
        if len(self._answers) > ANSWERS:
            self._answers.popitem(last=False)
        self._send(peer, answer)

    # Output.

    def orders(self) -> list[Order]:
        """Take out what the node must do, in order; each order is returned once."""
        orders, self._orders = self._orders, []
        return orders

    def messages(self) -> list[tuple[str, Message]]:
        """Take out the messages to send, with their callers, in order; each is returned once."""
        messages, self._messages = self._messages, []
        return messages

    def running(self) -> dict[str, str]:
        """Return the service of each active run, by call id."""
        return {id_: run.call.service for id_, run in self._running.items()}

    def service_of(self, id_: str) -> str | None:
        """Return the service of a run; None if it is not active."""
        run = self._running.get(id_)
        return None if run is None else run.call.service

    def why_stopped(self, id_: str, cause: str) -> str:
        """Return in words why an active run is stopped: it passed its deadline or is an orphan."""
        run = self._running[id_]
        if cause == ORPHAN:
            away = f"its coordinator was away for {run.orphan_time:g} s"
            return f"{away}, so its node stopped it (`orphan_time` in services.toml)"
        deadline = run.call.deadline
        seconds = self.offers[run.call.service].deadline if deadline is None else deadline
        return f"took longer than its deadline of {seconds:g} s"

    def commander(self, id_: str) -> str:
        """Return the caller of a command that waits for its answer; empty if none does."""
        return self._commands[id_][0] if id_ in self._commands else ""

    # Time.

    def advance(self, now: float) -> None:
        """Stop runs that are past their deadline or were orphaned for too long; drop old
        results."""
        for due, kind, id_, run in self._running.over(now):
            if kind == DEADLINE or self._is_orphan(run, due):
                self._stop(id_, run, kind, kind)
        self._results.advance(now)
        if self._accepts:
            self._send_accepts(now)

    def _send_accepts(self, now: float) -> None:
        """Send the held ACCEPTs that are due; NEVER: all of them."""
        accepts = self._accepts
        while accepts and (accepts[0][0] <= now or accepts[0][1] not in self._running):
            _, id_ = accepts.popleft()
            run = self._running.get(id_)
            if run is not None and self._peers.is_up(run.peer):
                self._messages.append((run.peer, Accept(id_)))

    def _is_orphan(self, run: ActiveRun, now: float) -> bool:
        return run.orphan_time is not None and self._peers.is_away(now, run.peer, run.orphan_time)

    def due(self) -> float | None:
        """Return when `advance` must be called next (s), None if never."""
        soonest = self._running.due()
        while self._accepts and self._accepts[0][1] not in self._running:
            self._accepts.popleft()
        if self._accepts:
            soonest = min(soonest, self._accepts[0][0])
        results = self._results.due()
        self.soonest = soonest if results is None else min(soonest, results)
        return self.soonest if self.soonest < NEVER else None

    def _stop(self, id_: str, run: ActiveRun, reason: str, cause: str) -> None:
        if not run.stopping:
            run.stopping, run.reason = True, cause
            self._orders.append(Cancel(id_, reason))

    def _end(self, now: float, peer: str, outcome: Outcome) -> None:
        self._results.add(now, peer, outcome)
        self.soonest = min(self.soonest, now + self._keeping.results)
        self._send(peer, outcome)

    def _send(self, peer: str, message: Message) -> None:
        if self._accepts and type(message) is not Outcome:
            self._send_accepts(NEVER)
        if self._peers.is_up(peer) or self._peers.get(peer) is None:
            self._messages.append((peer, message))


def _sendable(outcome: Outcome, plain_already: bool) -> Outcome:
    """Return the outcome in plain data, or an ERROR outcome if its values are not plain."""
    try:
        values = outcome.values if plain_already else plain(outcome.values, "values")
    except NotPlainError as fault:
        text = f"the values that it returned cannot be sent: {fault}"
        return replace(
            outcome, status=ERROR, values={}, cause="bad_result", text=text, deferred=False
        )
    if values is outcome.values and type(outcome.status) is str:
        return outcome
    return replace(outcome, status=str(outcome.status), values=values)
