"""The port of a mission, for the page and the command line: a snapshot, its numbered changes, and
commands, all as plain data; who holds the controls.

docs/operator-protocol.md defines the format, which browsers and the command line use, too.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from time import monotonic
from typing import Any, Protocol

from petrobot.coordinator.operator.changes import KINDS, State, apply, copy_state, empty_state

# --- interface ---

PROTOCOL = 1
"""Version of docs/operator-protocol.md, in every snapshot."""

FREE = frozenset({"estop", "remark", "take_controls", "ask_controls", "release_controls"})
"""Commands for every client. `release_controls` does nothing without the controls."""
VERBS = FREE | {
    "load",
    "start",
    "pause",
    "resume",
    "step",
    "breakpoint",
    "add_tokens",
    "remove_tokens",
    "raise_event",
    "force_exit",
    "abort",
    "clear_estop",
    "override_selector",
}
"""All commands; those that are not in `FREE` need the controls. `Operation._do_VERB`
(commands.py) carries one out; the station those about the next run."""


class MissionPort(Protocol):
    """A mission as the page sees it. All methods are called in the coordinator's event loop and
    return plain JSON data."""

    def snapshot(self) -> dict[str, Any]:
        """Return the whole state with `sequence`, the number of the last change in it."""

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Call `receive` with every later change, numbered without gaps, until the returned
        function is called.

        `receive` never blocks and never raises. A change must not be modified after it was passed
        on.
        """

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command; return after it is journaled: {"ok": True, ...} or {"ok": False,
        "code", "text"}."""


StartForm = Callable[[str], Awaitable[Mapping[str, Any]]]
"""Returns the options of a task file's start: {task, runs ({default, place} or None), seed, modes,
parameters: [{name, type, default, text}], learn: {selectors, selector, credits, contexts,
estimates}}. Raises RefusedError."""
Offers = Callable[[], Sequence[Mapping[str, Any]]]
"""Returns the current offers of the nodes, for the designer, one entry for each action: {action,
primitive_task, node, device, args ({name: default}), up}."""


# --- feed of changes ---
# It numbers changes, keeps the resulting snapshot, and passes them to subscribers: the same for
# every mission.

Receive = Callable[[dict[str, Any]], None]
READ_FOR = 5.0
"""Time for which one who read a snapshot counts as watching (s): a script asks again and again."""


class Feed:
    """The state of a mission as its clients see it. Not thread-safe: it belongs to one event loop.

    `emit` costs some microseconds per subscriber; it encodes and sends nothing.
    """

    def __init__(self) -> None:
        self._state = empty_state()
        self._receivers: dict[int, Receive] = {}
        self._tickets = 0
        self._read = -math.inf
        """When a snapshot was read last."""
        self.clock: Callable[[], float] | None = None
        """The mission's clock (s) while a run is active. Without it the time is that of the last
        change that had one, which may be long ago."""

    @property
    def state(self) -> State:
        """The current state; read only."""
        return self._state

    @property
    def watched(self) -> bool:
        """Whether there is a subscriber, or a client has just read a snapshot."""
        return bool(self._receivers) or monotonic() - self._read < READ_FOR

    def emit(self, kind: str, *, time: float | None = None, **fields: Any) -> None:
        """Publish a change. `time` is the mission's clock (s), by default its time now."""
        if kind not in KINDS:
            raise ValueError(f"no change of kind {kind!r}")
        change = {"kind": kind, "sequence": self._state["sequence"] + 1, **fields}
        change["time"] = self._now() if time is None else time
        apply(self._state, change)
        for receive in tuple(self._receivers.values()):
            receive(change)

    def replace(self, **parts: Any) -> None:
        """Start from a new state, as for another mission: clients get a new snapshot. Parts not
        given are empty."""
        sequence = self._state["sequence"]
        unknown = parts.keys() - self._state.keys()
        if unknown:
            raise ValueError(f"no part of a snapshot: {', '.join(sorted(unknown))}")
        self._state = {**empty_state(), **parts, "sequence": sequence}
        self.emit("reset")

    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the whole state."""
        self._read = monotonic()
        return {**copy_state(self._state), "time": self._now()}

    def _now(self) -> float:
        known: float = self._state["time"]
        return known if self.clock is None else max(known, self.clock())

    def subscribe(self, receive: Receive) -> Callable[[], None]:
        """Call `receive` with every later change, until the returned function is called."""
        self._tickets += 1
        ticket = self._tickets
        self._receivers[ticket] = receive

        def stop() -> None:
            self._receivers.pop(ticket, None)

        return stop


class Followed:
    """What clients can follow: a mission run, or the coordinator of a cell."""

    feed: Feed

    def snapshot(self) -> dict[str, Any]:
        """Return the current state."""
        return self.feed.snapshot()

    def subscribe(self, receive: Receive) -> Callable[[], None]:
        """Call `receive` with every later change."""
        return self.feed.subscribe(receive)


# --- controls ---
# One operator holds them, the others watch and may ask for them. They outlive mission runs.

Answer = dict[str, Any]


class Controls:
    """The holder and the clients that ask; every change is published on the feed."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.holder: str | None = None
        self._asking: list[str] = []

    def plain(self) -> dict[str, Any]:
        """Return the state as in a snapshot."""
        return {"holder": self.holder, "asking": list(self._asking)}

    def fault(self, who: str, verb: str) -> Answer | None:
        """Return why a client may not give a command; None if it may."""
        if verb in FREE or self.holder == who:
            return None
        return refusal(
            "not_holder",
            f"{self.holder or 'no operator'} holds the controls; take or ask for them first",
        )

    def take(self, who: str) -> Answer:
        """Take the controls if they are free."""
        if self.holder not in (None, who):
            return refusal("held", f"{self.holder} holds the controls; ask for them")
        return self._hand_over(who)

    def ask(self, who: str) -> Answer:
        """Notify the holder that another client asks for the controls."""
        if who != self.holder and who not in self._asking:
            self._asking.append(who)
        return self._hand_over(self.holder)

    def release(self, who: str, to: object) -> Answer:
        """Free the controls, or hand them to a client that asks; ignored from a client without
        them."""
        if who != self.holder:
            return {"ok": True}
        return self._hand_over(to if isinstance(to, str) and to in self._asking else None)

    def carry_out(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer | None:
        """Answer commands about the controls; return None for every other command."""
        if verb == "take_controls":
            return self.take(who)
        if verb == "ask_controls":
            return self.ask(who)
        return self.release(who, data.get("to")) if verb == "release_controls" else None

    def _hand_over(self, holder: str | None) -> Answer:
        self.holder = holder
        self._asking = [name for name in self._asking if name != holder]
        self._feed.emit("controls", controls=self.plain())
        return {"ok": True}


def refusal(code: str, text: str) -> Answer:
    """Return the answer to a command that is not carried out."""
    return {"ok": False, "code": code, "text": text}
