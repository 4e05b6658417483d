"""Number changes, keep the resulting snapshot, and pass them to subscribers: the part of a mission
port that is the same for every mission."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic
from typing import Any

from petrobot.coordinator.operator.changes import KINDS, State, apply, copy_state, empty_state

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
