"""The called end of the node protocol for all callers of a node, as a machine: what runs, how it
ended, who was told.

Used alike in real time (`server.py` drives it) and in lock step. The node takes its `orders` and
reports back with `finish`, `feedback`, `raise_event` and `answer`. What it promises:

- A call id is run at most once in the life of this boot: a known id is re-attached or answered from
  its stored result, one
  whose result is gone is remembered as an id. Once the memory for ids was full
  (`FinishedIds.complete`), a call that may have been sent before (`Call.again`) and is not known
  does not run: it may be among those forgotten.
- Every run ends with one outcome, kept until its caller acknowledges it or `Retention.results` is
  over.
- A run goes on no longer than its deadline, and no longer without its caller than its offer's
  `orphan_time`.
- A device takes orders from one caller at a time: the holder of its lease.

Refusals are outcomes with status error and executed = no: unknown_service, local_only, old_epoch,
device_leased, device_needs_coordinator, cancelled (before it began), and busy from the node's
runner. executed = unknown: rebooted (meant for another boot), forgotten (its result was kept no
longer, or perhaps not even its id).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from petrobot.services.comm.calls.events import EventBoard
from petrobot.services.comm.calls.peers import (
    COORDINATOR,
    Inline,
    Offer,
    Peers,
)
from petrobot.services.comm.calls.runs import (
    DEADLINE,
    NEVER,
    ActiveRun,
    ActiveRuns,
    ResultStore,
    Retention,
)
from petrobot.services.comm.protocol.messages import (
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
)
from petrobot.services.comm.protocol.plain import NotPlainError, plain
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, negotiate

__all__ = [
    "Callee",
    "CancelOrder",
    "CommandOrder",
    "Inline",
    "Offer",
    "Order",
    "Retention",
    "StartOrder",
]

ERROR: Final = "error"
HOLD, RELEASE, HELD = "hold", "release", "held"
ANSWERS: Final = 64
"""Answers to commands that are kept. A command is repeated at once or never, and an answer is some
hundred bytes."""


@dataclass(frozen=True, slots=True)
class StartOrder:
    """Order: begin this run, report back with `finish`."""

    call: Call
    peer: str


@dataclass(frozen=True, slots=True)
class CancelOrder:
    """Order: stop this run (stop routine first); `finish` still reports its end. Given once a
    run."""

    id: str
    reason: str
    """"cancelled", "deadline" or "orphan", or the caller's own words."""


@dataclass(frozen=True, slots=True)
class CommandOrder:
    """Order: carry out a command, report back with `answer`."""

    command: Command
    peer: str


Order = StartOrder | CancelOrder | CommandOrder


class Callee:
    """What a node offers, to all its callers. `offers` are by name; `boot` is drawn anew at each
    start of the process.

    Callers are known by their name: one process a name. Raises nothing on what callers do; `finish`
    and its like raise ValueError when the node itself names a run that does not go on.
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
    ) -> None:
        self.name = name
        self.boot = boot
        self.offers: Mapping[str, Offer] = dict(offers)
        self.directory = directory
        self.events = EventBoard()
        self.soonest = NEVER
        """Never later than `due` (s): a shell whose timer is set for no later time need not ask for
        that."""
        self._keeping = keeping or Retention()
        self._peers = Peers(name, directory, any_directory, self._keeping.lease)
        self._running = ActiveRuns()
        self._results = ResultStore(self._keeping, self.events.forget_run)
        self._commands: dict[str, tuple[str, str]] = {}
        """Peer and verb of each command that waits for its answer."""
        self._answers: OrderedDict[tuple[str, str], Answer] = OrderedDict()
        """The newest answers by caller and command, for a command that comes again."""
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

    # Callers come and go.

    def link_up(
        self, now: float, peer: str, hello: Hello, *, local: bool = True
    ) -> Welcome | Refuse:
        """A caller has connected (`peer` is its name, `local` whether it lives on this host). Says
        what to answer it."""
        refusal = self._peers.refusal(peer, hello)
        if refusal is not None:
            return refusal
        known = self._peers.get(peer)
        if known is None or (known.boot, known.epoch) != (hello.boot, hello.epoch):
            # Another process of that name counts its commands from the beginning again.
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
        return Welcome(version, self.name, self.boot, offers, tuple(runs), self.directory)

    def link_down(self, now: float, peer: str, *, leaves: bool = False) -> None:
        """The link of a caller is down; with `leaves` it said good-bye and gives up its leases and
        subscriptions."""
        if not self._peers.go(now, peer, leaves):
            return
        self.events.peer_down(peer, leaves)
        for id_, run in self._running.items():
            if run.peer == peer and run.orphan_time is not None:
                self._running.watch_orphan(id_, now + run.orphan_time)
                self.soonest = min(self.soonest, now + run.orphan_time)

    # What callers say.

    def receive(self, now: float, peer: str, message: Message) -> None:
        """Take a message of a caller; kinds that only a client is sent are left alone."""
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
        if call.boot and call.boot != self.boot:
            text = f"this call was meant for another boot of {self.name}"
            # Kept: a CANCEL that follows must not be answered as if the call had never left its
            # caller.
            self._end(now, peer, Outcome(id_, ERROR, {}, "rebooted", text, Executed.UNKNOWN))
            return
        if call.again and not self._results.gone.complete:
            # Before any refusal: that would say that it was not executed.
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
        """The outcome of a call to a service that is answered on the spot, None if it is another
        kind of call.

        As `receive`, but the answer does not go through `messages`: the shell sends it, then has it
        kept by `keep`.
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
        if (call.boot and call.boot != self.boot) or (call.again and not results.gone.complete):
            return None
        if self._peers.refusal_of_call(now, peer, call, offer, self._in_use) is not None:
            return None
        return self._answered(now, offer.inline, call)

    def keep(self, now: float, peer: str, outcome: Outcome, weight: int | None = None) -> None:
        """What `answer_inline` gave is on its way: keep it until it is acknowledged, as every
        result.

        `weight` is its length on the wire (bytes), None where it is not known.
        """
        self._results.add(now, peer, outcome, weight)
        due = now + self._keeping.results
        if due < self.soonest:
            self.soonest = due

    @property
    def has_work(self) -> bool:
        """Whether there are orders or messages to take out."""
        return bool(self._orders or self._messages)

    def _known(self, peer: str, id_: str) -> None:
        """A call that came before: tell where it stands, never run it again."""
        run = self._running.get(id_)
        owner = run.peer if run is not None else self._results.owner(id_)
        outcome = self._results.get(id_)
        if owner and owner != peer:
            text = f"{owner} made a call of this id"
            self._messages.append((peer, Outcome(id_, ERROR, {}, "id_taken", text, Executed.NO)))
        elif run is not None:
            self._messages.append((peer, Accept(id_)))
        elif outcome is not None:
            self._messages.append((peer, outcome))
        else:
            text = "its result was kept no longer"
            self._messages.append(
                (peer, Outcome(id_, ERROR, {}, "forgotten", text, Executed.UNKNOWN))
            )

    def _maybe_forgotten(self, id_: str) -> Outcome:
        text = f"{self.name} has forgotten ids of its oldest calls, and this one may be among them"
        return Outcome(id_, ERROR, {}, "forgotten", text, Executed.UNKNOWN)

    def _in_use(self, device: str) -> bool:
        return any(run.device == device for run in self._running.values())

    @staticmethod
    def _answered(now: float, inline: Inline, call: Call) -> Outcome:
        try:
            return inline(now, call)
        except Exception as fault:
            # A fault in a service is its caller's error, not the node's end.
            text = f"{call.service} failed: {type(fault).__name__}: {fault}"
            return Outcome(call.id, ERROR, {}, "crashed", text, Executed.UNKNOWN)

    def _start(self, now: float, peer: str, call: Call, offer: Offer) -> None:
        self._running[call.id] = ActiveRun(call, peer, now, offer.device, offer.orphan_time)
        deadline = call.deadline if call.deadline is not None else offer.deadline
        if deadline is not None:
            self._running.limit(call.id, now + deadline)
            self.soonest = min(self.soonest, now + deadline)
        self._messages.append((peer, Accept(call.id)))
        self._orders.append(StartOrder(call, peer))

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
            # The call itself may still be on its way: remember that it must not begin.
            self._end(
                now, peer, Outcome(cancel.id, ERROR, {}, "cancelled", cancel.reason, Executed.NO)
            )

    def _take_subscribe(self, now: float, peer: str, subscribe: Subscribe) -> None:
        known = self._peers.get(peer)
        if known is not None:
            waiting = self.events.subscribe(peer, subscribe.names, known.role == COORDINATOR)
            self._messages.extend((peer, event) for event in waiting)

    def _take_event_ack(self, now: float, peer: str, ack: EventAck) -> None:
        self.events.acknowledge(peer, ack.source, ack.number)

    def _take_command(self, now: float, peer: str, command: Command) -> None:
        if command.id in self._commands or (peer, command.id) in self._answers:
            self._known_command(peer, command.id)
            return
        self._commands[command.id] = peer, command.verb
        if command.verb == RELEASE:
            self._running.release_all(now, [command.target] if command.target else None)
            self.soonest = min(self.soonest, self._running.due())
        self._orders.append(CommandOrder(command, peer))

    def _known_command(self, peer: str, id_: str) -> None:
        """A command that came before is not carried out again: its answer is said again, or comes
        when it is there."""
        if (answer := self._answers.get((peer, id_))) is not None:
            self._messages.append((peer, answer))
        elif (owner := self._commands[id_][0]) != peer:
            text = f"{owner} gave a command of this id"
            self._messages.append((peer, Answer(id_, False, {"cause": "id_taken", "text": text})))

    # What the node reports.

    def finish(
        self,
        now: float,
        id: str,  # noqa: A002
        status: str,
        values: Mapping[str, Any] | None = None,
        cause: str = "",
        text: str = "",
        executed: Executed = Executed.YES,
        seconds: float | None = None,
        cpu_seconds: float = 0.0,
        deferred: bool = False,
    ) -> Outcome:
        """A run has ended; gives the outcome its caller is told. `seconds` is taken from the clock
        when left out.

        One that was stopped by its deadline ends ERROR `deadline` whatever it says; one stopped for
        another reason keeps its own status if it had ended before. Raises ValueError if no such run
        goes on.
        """
        run = self._running.pop(id, None)
        if run is None:
            raise ValueError(f"run {id}: no such run goes on")
        took = now - run.began if seconds is None else seconds
        if run.reason == "deadline":
            text = (
                text
                or f"it had not ended within its deadline (it ended {status} after {took:.3f} s)"
            )
            outcome = Outcome(id, ERROR, {}, "deadline", text, executed, took, cpu_seconds)
        else:
            if run.stopping and cause == "cancelled":
                cause, text = run.reason, text or run.call.service
            outcome = Outcome(
                id, status, values or {}, cause, text, executed, took, cpu_seconds, deferred
            )
        outcome = _sendable(outcome)
        self._end(now, run.peer, outcome)
        return outcome

    def feedback(
        self,
        now: float,
        id: str,  # noqa: A002
        fraction: float,
        data: Mapping[str, Any] | None = None,
    ) -> None:
        """Tell a run's caller how far it is (0 to 1); nothing is kept for one that is away."""
        run = self._running.get(id)
        if run is None:
            raise ValueError(f"run {id}: no such run goes on")
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
    ) -> Event:
        """Raise an event: of the outside world for whoever subscribed to it, or of a run that goes
        on, for its caller.

        A latched one is numbered by its source (default: this node) and kept until it is
        acknowledged.
        """
        owner = ""
        if run:
            if run not in self._running:
                raise ValueError(f"run {run}: no such run goes on")
            owner = self._running[run].peer
        event = Event(name, source or self.name, 0, plain(data or {}, "data"), run)
        event, peers = self.events.raise_event(event, latched, owner)
        for peer in peers:
            self._send(peer, event)
        return event

    def answer(self, now: float, id: str, ok: bool, data: Mapping[str, Any] | None = None) -> None:  # noqa: A002
        """Answer a command. Of a `hold`, `answers` in the data say by device (runs without one:
        this node's name) what became of it: the deadlines of runs that are held stand still until a
        `release`. Raises ValueError if nobody waits for it.
        """
        peer, verb = self._commands.pop(id, ("", ""))
        if not peer:
            raise ValueError(f"command {id}: nobody waits for its answer")
        if verb == HOLD and data is not None:
            answers = data.get("answers", {})
            self._running.hold_all(
                now, ["" if d == self.name else d for d, said in answers.items() if said == HELD]
            )
        answer = Answer(id, ok, plain(data or {}, "data"))
        self._answers[peer, id] = answer
        if len(self._answers) > ANSWERS:
            self._answers.popitem(last=False)
        self._send(peer, answer)

    # What the node takes out.

    def orders(self) -> list[Order]:
        """What the node has to do, in order; each order is given once."""
        orders, self._orders = self._orders, []
        return orders

    def messages(self) -> list[tuple[str, Message]]:
        """What to send, and to which caller, in order; each message is given once."""
        messages, self._messages = self._messages, []
        return messages

    def running(self) -> dict[str, str]:
        """Runs that go on: service by call id."""
        return {id_: run.call.service for id_, run in self._running.items()}

    # What time does.

    def advance(self, now: float) -> None:
        """Stop what is over its deadline or an orphan for too long; forget what was kept long
        enough."""
        for due, kind, id_, run in self._running.over(now):
            if kind == DEADLINE or self._is_orphan(run, due):
                self._stop(id_, run, kind, kind)
        self._results.advance(now)

    def _is_orphan(self, run: ActiveRun, now: float) -> bool:
        return run.orphan_time is not None and self._peers.is_away(now, run.peer, run.orphan_time)

    def due(self) -> float | None:
        """When `advance` has something to do next (s), None if never."""
        soonest = self._running.due()
        results = self._results.due()
        self.soonest = soonest if results is None else min(soonest, results)
        return self.soonest if self.soonest < NEVER else None

    def _stop(self, id_: str, run: ActiveRun, reason: str, cause: str) -> None:
        if not run.stopping:
            run.stopping, run.reason = True, cause
            self._orders.append(CancelOrder(id_, reason))

    def _end(self, now: float, peer: str, outcome: Outcome) -> None:
        self._results.add(now, peer, outcome)
        self.soonest = min(self.soonest, now + self._keeping.results)
        self._send(peer, outcome)

    def _send(self, peer: str, message: Message) -> None:
        if self._peers.is_up(peer) or self._peers.get(peer) is None:
            self._messages.append((peer, message))


def _sendable(outcome: Outcome) -> Outcome:
    """The outcome in plain data; an ERROR in its place if its values are none."""
    try:
        values = plain(outcome.values, "values") if outcome.values else outcome.values
    except NotPlainError as fault:
        text = f"what it returned cannot be sent: {fault}"
        return replace(
            outcome, status=ERROR, values={}, cause="bad_result", text=text, deferred=False
        )
    return replace(outcome, status=str(outcome.status), values=values)
