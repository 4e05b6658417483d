"""Numbers changes, keeps the snapshot that they lead to, and hands them to subscribers: the half of
a mission port that is the same for every mission."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from petrobot.coordinator.operator.changes import KINDS, State, apply, copy_state, empty_state

Receive = Callable[[dict[str, Any]], None]


class Feed:
    """The state of a mission as its clients see it. Not for threads: one loop owns it.

    `emit` costs some microseconds a subscriber; nothing is encoded or sent in it.
    """

    def __init__(self) -> None:
        self._state = empty_state()
        self._receivers: dict[int, Receive] = {}
        self._tickets = 0

    @property
    def state(self) -> State:
        """The state now; look, do not alter."""
        return self._state

    @property
    def watched(self) -> bool:
        """Whether anybody follows."""
        return bool(self._receivers)

    def emit(self, kind: str, *, time: float | None = None, **fields: Any) -> None:
        """Something changed. `time` is the mission's clock (s); without it the clock stays."""
        if kind not in KINDS:
            raise ValueError(f"no change of kind {kind!r}")
        change = {"kind": kind, "sequence": self._state["sequence"] + 1, **fields}
        change["time"] = self._state["time"] if time is None else time
        apply(self._state, change)
        for receive in tuple(self._receivers.values()):
            receive(change)

    def replace(self, **parts: Any) -> None:
        """Begin anew, as for another mission: clients get a fresh snapshot. Parts not given are
        empty."""
        sequence = self._state["sequence"]
        unknown = parts.keys() - self._state.keys()
        if unknown:
            raise ValueError(f"no part of a snapshot: {', '.join(sorted(unknown))}")
        self._state = {**empty_state(), **parts, "sequence": sequence}
        self.emit("reset")

    def snapshot(self) -> dict[str, Any]:
        """The whole state; later changes do not reach it."""
        return copy_state(self._state)

    def subscribe(self, receive: Receive) -> Callable[[], None]:
        """Give every later change to `receive`; call what is returned to stop."""
        self._tickets += 1
        ticket = self._tickets
        self._receivers[ticket] = receive

        def stop() -> None:
            self._receivers.pop(ticket, None)

        return stop
