"""Events between node and caller: a node numbers latched events and keeps them until they are
stored; a caller accepts each once.

Also the format of deferred verdicts, which are sent as latched events.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from msgspec import Struct, field

from petrobot.services.comm.protocol.codec import NAME_LENGTH
from petrobot.services.comm.protocol.messages import Event, EventAck

KEPT = 1_000
"""How many latched events of one source are kept. Of an action, the run that raises more is
stopped; of the outside world, the oldest is dropped."""


class _Kept(Struct):
    event: Event
    owner: str
    """Caller whose run raised it; empty for an event of the outside world, which goes to its
    subscribers."""
    safe: set[str] = field(default_factory=set)
    """Callers that have acknowledged it."""


class _Listener(Struct):
    names: frozenset[str]
    durable: bool
    """The caller (a coordinator) keeps its subscription while its connection is lost, and receives
    the events of that time later."""
    up: bool = True


class EventBoard:
    """Subscriptions of the callers, and the latched events that a caller has not acknowledged
    yet."""

    def __init__(self) -> None:
        self._listeners: dict[str, _Listener] = {}
        self._kept: dict[str, deque[_Kept]] = {}
        self._numbers: dict[str, int] = {}
        self._runs: set[str] = set()
        """Runs that have raised latched events."""
        self.dropped = Counter[str]()
        """By source: how many latched events were dropped for newer ones while a subscriber had not
        acknowledged them."""

    def skip(self, peer: str) -> None:
        """No event of the time before is for this caller: a button that was pressed before a
        mission run does nothing in it."""
        for kept in self._all():
            if not kept.owner:
                kept.safe.add(peer)

    def subscribe(self, peer: str, names: Iterable[str], durable: bool) -> list[Event]:
        """Send these events to `peer` from now on. Return the kept ones that it has not
        acknowledged, oldest first."""
        self._listeners[peer] = _Listener(frozenset(names), durable)
        return self.waiting(peer)

    def waiting(self, peer: str) -> list[Event]:
        """Return the kept events for this peer that it has not acknowledged, by source, oldest
        first."""
        return [
            kept.event for kept in self._all() if peer not in kept.safe and self._wants(peer, kept)
        ]

    def is_full(self, source: str) -> bool:
        """Return whether as many events of this source wait as are kept."""
        return len(self._kept.get(source, ())) >= KEPT

    def raise_event(self, event: Event, latched: bool, owner: str) -> tuple[Event, list[str]]:
        """Return the event as it is sent (numbered if latched), and its receivers. An event of a
        run goes to its `owner` only."""
        if latched:
            event = self._number(event, owner)
        if owner:
            return event, [owner]
        return event, [
            peer for peer, one in self._listeners.items() if one.up and event.name in one.names
        ]

    def _number(self, event: Event, owner: str) -> Event:
        number = self._numbers.get(event.source, 0) + 1
        self._numbers[event.source] = number
        event = Event(event.name, event.source, number, event.data, event.run)
        kept = self._kept.setdefault(event.source, deque())
        if len(kept) >= KEPT:
            oldest = kept.popleft()
            if any(self._wants(p, oldest) and p not in oldest.safe for p in self._listeners):
                self.dropped[event.source] += 1
        kept.append(_Kept(event, owner))
        if event.run:
            self._runs.add(event.run)
        return event

    def acknowledge(self, peer: str, source: str, number: int) -> None:
        """`peer` has stored the events of this source up to this number; drop those that no other
        caller waits for."""
        kept, awaited = self._kept.get(source, deque()), list[_Kept]()
        while kept and kept[0].event.number <= number:
            one = kept.popleft()
            if self._wants(peer, one):
                one.safe.add(peer)
            if self._awaited(one):
                awaited.append(one)
        kept.extendleft(reversed(awaited))

    def peer_down(self, peer: str, leaves: bool) -> None:
        """A peer's connection is closed; its subscription is dropped if it `leaves` or is not
        durable."""
        listener = self._listeners.get(peer)
        if listener is None:
            return
        listener.up = False
        if leaves or not listener.durable:
            del self._listeners[peer]

    def forget_run(self, run: str) -> None:
        """A run is finished and acknowledged: drop its events."""
        if run not in self._runs:
            return
        self._runs.discard(run)
        for source, kept in self._kept.items():
            if any(one.event.run == run for one in kept):
                self._kept[source] = deque(one for one in kept if one.event.run != run)

    def _all(self) -> Iterator[_Kept]:
        for kept in self._kept.values():
            yield from kept

    def _wants(self, peer: str, kept: _Kept) -> bool:
        if kept.owner:
            return kept.owner == peer
        listener = self._listeners.get(peer)
        return listener is not None and kept.event.name in listener.names

    def _awaited(self, kept: _Kept) -> bool:
        if not kept.safe:
            return True
        if kept.owner:
            return False
        return any(
            listener.durable and peer not in kept.safe and kept.event.name in listener.names
            for peer, listener in self._listeners.items()
        )


class EventIntake:
    """Receiving side: accepts each number of a source once."""

    def __init__(self) -> None:
        self._seen: dict[str, OrderedDict[int, None]] = {}
        self._unsafe: dict[str, set[int]] = {}

    def take(self, event: Event, safe: bool) -> tuple[bool, EventAck | None]:
        """Return whether this event is new, and what to acknowledge now. `safe`: the owner needs no
        time to store it."""
        if not event.number:
            return True, None
        seen = self._seen.setdefault(event.source, OrderedDict())
        unsafe = self._unsafe.setdefault(event.source, set())
        new = event.number not in seen
        if new:
            seen[event.number] = None
            if len(seen) > 2 * KEPT:
                del seen[next(iter(seen))]
            if not safe:
                unsafe.add(event.number)
        return new, None if event.number in unsafe else EventAck(event.source, event.number)

    def acknowledge(self, event: Event) -> EventAck | None:
        """The owner has stored this event and those of its source before it; return what to tell
        the peer, if anything."""
        unsafe = self._unsafe.get(event.source, set())
        if event.number not in unsafe:
            return None
        unsafe -= {number for number in unsafe if number <= event.number}
        return EventAck(event.source, event.number)

    def clear(self) -> None:
        """The peer is a new process, whose event numbers begin at 1 again."""
        self._seen.clear()
        self._unsafe.clear()


# Deferred verdicts are sent as latched events, so that each is delivered once. The event's name
# tells the mission run.
#
# The id of a run is the id of its call, `MISSION/PLACE#NUMBER`. The program that judges it, on any
# node, raises the event `verdict:MISSION` with the data {run, status, cause, text}. The coordinator
# of that mission run subscribes to this name and acknowledges the event when it has stored it.

STOP_EVENT: Final = "emergency_stop:"
"""The pulse that a node sends to all coordinators at an emergency stop: each aborts, also one that
has no run on a stopped device now, or has not begun yet."""
VERDICT_EVENTS: Final = "verdict:"
"""Prefix of the names of these events."""
STATUSES: Final = ("success", "failure", "error")


class RunVerdict(Struct, frozen=True):
    """A later verdict on the outcome of a run."""

    run: str
    """Id of the run, as its own context gave it."""
    status: str
    cause: str = ""
    text: str = ""

    def to_data(self) -> dict[str, Any]:
        """Return the verdict as the data of an event."""
        return {"run": self.run, "status": self.status, "cause": self.cause, "text": self.text}

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> RunVerdict:
        """Read what `to_data` returned; cause and text may be missing. Raises ValueError that names
        what is wrong."""
        run, status, cause, text = (
            data.get("run"),
            data.get("status"),
            data.get("cause", ""),
            data.get("text", ""),
        )
        if not isinstance(run, str) or not run:
            raise ValueError(
                f"verdict: expected the id of a run (ctx.run of its own context), got {run!r}"
            )
        if status not in STATUSES:
            raise ValueError(
                f"verdict on {run}: expected status {', '.join(STATUSES)}, got {status!r}"
            )
        if not isinstance(cause, str) or not isinstance(text, str):
            raise ValueError(
                f"verdict on {run}: expected cause and text as str, got {cause!r} and {text!r}"
            )
        return cls(run, str(status), cause, text)


def mission_of(run: str) -> str:
    """Return the mission run that a run belongs to. Raises ValueError if this is not the id of a
    run."""
    mission, _, place = run.rpartition("/") if isinstance(run, str) else ("", "", "")
    if not mission or not place.rpartition("#")[0] or len(run) > NAME_LENGTH:
        raise ValueError(f"{run!r} is not the id of a run; pass ctx.run of the run's own context")
    return mission


def verdict_event(mission: str) -> str:
    """Return the name of the event that carries verdicts on runs of this mission run."""
    return VERDICT_EVENTS + mission
