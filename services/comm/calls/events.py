"""Events on their way: at the node latched ones are numbered and kept until they are safe, at the
caller taken once."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from petrobot.services.comm.protocol.codec import NAME_LENGTH
from petrobot.services.comm.protocol.messages import Event, EventAck

KEPT = 1_000
"""Latched events of one source that are kept; then the oldest gives way."""


@dataclass(slots=True)
class _Kept:
    event: Event
    owner: str
    """Caller whose run raised it; empty for an event of the outside world, which goes to whoever
    asked for it."""
    safe: set[str] = field(default_factory=set)


@dataclass(slots=True)
class _Listener:
    names: frozenset[str]
    durable: bool
    """Comes back after a lost link and finds what came meanwhile (a coordinator)."""
    up: bool = True


class EventBoard:
    """Who wants which events, and which latched ones somebody still waits for."""

    def __init__(self) -> None:
        self._listeners: dict[str, _Listener] = {}
        self._kept: dict[str, deque[_Kept]] = {}
        self._numbers: dict[str, int] = {}
        self._runs: set[str] = set()
        """Runs that have raised latched events."""
        self.lost = 0
        """Latched events that gave way to newer ones before anybody had them."""

    def subscribe(self, peer: str, names: Iterable[str], durable: bool) -> list[Event]:
        """From now on `peer` gets these events. Gives the kept ones that it has not said to be
        safe, oldest first."""
        self._listeners[peer] = _Listener(frozenset(names), durable)
        return self.waiting(peer)

    def waiting(self, peer: str) -> list[Event]:
        """Kept events that this peer should have and has not said to be safe, by source, oldest
        first."""
        return [
            kept.event for kept in self._all() if peer not in kept.safe and self._wants(peer, kept)
        ]

    def raise_event(self, event: Event, latched: bool, owner: str) -> tuple[Event, list[str]]:
        """The event as it goes out (numbered if latched) and to whom now. `owner` alone gets an
        event of his run."""
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
        if len(kept) == KEPT:
            kept.popleft()
            self.lost += 1
        kept.append(_Kept(event, owner))
        if event.run:
            self._runs.add(event.run)
        return event

    def acknowledge(self, peer: str, source: str, number: int) -> None:
        """The events of this source up to this number are safe with `peer`; what nobody else waits
        for is forgotten."""
        kept = self._kept.get(source)
        if kept is None:
            return
        for one in kept:
            if one.event.number <= number and self._wants(peer, one):
                one.safe.add(peer)
        self._kept[source] = deque(one for one in kept if self._awaited(one))

    def peer_down(self, peer: str, leaves: bool) -> None:
        """The link of a peer is down; one that leaves in good order, or is not durable, is
        forgotten."""
        listener = self._listeners.get(peer)
        if listener is None:
            return
        listener.up = False
        if leaves or not listener.durable:
            del self._listeners[peer]

    def forget_run(self, run: str) -> None:
        """A run is over and acknowledged: its events are gone with it."""
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
    """Events of one peer as its caller takes them: each number of a source once."""

    def __init__(self) -> None:
        self._seen: dict[str, OrderedDict[int, None]] = {}
        self._unsafe: dict[str, set[int]] = {}

    def take(self, event: Event, safe: bool) -> tuple[bool, EventAck | None]:
        """Whether this event is new, and what to acknowledge. `safe`: its owner needs no time to
        make it so."""
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
        """This event of its source and those before it are safe now; gives what to tell the peer,
        if anything."""
        unsafe = self._unsafe.get(event.source, set())
        if event.number not in unsafe:
            return None
        unsafe -= {number for number in unsafe if number <= event.number}
        return EventAck(event.source, event.number)

    def clear(self) -> None:
        """The peer is another process: its numbers begin anew."""
        self._seen.clear()
        self._unsafe.clear()


# Deferred verdicts on the wire: a latched event whose name says which mission run it is for, so
# that it is delivered once.
#
# A run's id is its call's, `MISSION/PLACE#NUMBER`. Whoever judges it, on whatever node, raises
# `verdict:MISSION` with the data {run, status, cause, text}; the coordinator of that mission run asks
# for this name, and says when it has the verdict safe.

VERDICT_EVENTS: Final = "verdict:"
"""What the names of these events begin with."""
STATUSES: Final = ("success", "failure", "error")


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """What somebody says that a run really came to."""

    run: str
    """The run's id, as its own context gave it."""
    status: str
    cause: str = ""
    text: str = ""

    def to_data(self) -> dict[str, Any]:
        """The event's data."""
        return {"run": self.run, "status": self.status, "cause": self.cause, "text": self.text}

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> RunVerdict:
        """What `to_data` gave; cause and text may be left out. Raises ValueError naming what does
        not fit."""
        run, status, cause, text = (
            data.get("run"),
            data.get("status"),
            data.get("cause", ""),
            data.get("text", ""),
        )
        if not isinstance(run, str) or not run:
            raise ValueError(
                f"verdict: run is {run!r}; give the run's id as its own context gave it (ctx.run)"
            )
        if status not in STATUSES:
            raise ValueError(f"verdict on {run}: status is {status!r}; give {', '.join(STATUSES)}")
        if not isinstance(cause, str) or not isinstance(text, str):
            raise ValueError(
                f"verdict on {run}: cause and text are texts, not {cause!r} and {text!r}"
            )
        return cls(run, str(status), cause, text)


def mission_of(run: str) -> str:
    """The mission run that a run belongs to. Raises ValueError for what is no run's id."""
    mission, _, place = run.rpartition("/") if isinstance(run, str) else ("", "", "")
    if not mission or not place.rpartition("#")[0] or len(run) > NAME_LENGTH:
        raise ValueError(
            f"{run!r} is no run that can be judged; give what its own context gave as ctx.run"
        )
    return mission


def verdict_event(mission: str) -> str:
    """Name of the event by which runs of this mission run are judged."""
    return VERDICT_EVENTS + mission
