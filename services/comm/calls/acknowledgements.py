"""What a caller remembers of calls that have ended: which results are safe, what was given up, what
is to be acknowledged."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from petrobot.services.comm.protocol.messages import ResultAck

REMEMBERED: Final = 10_000
"""Ids of ended calls that are remembered at least."""
ACKS_AT_ONCE: Final = 64
"""Acknowledgements that wait no longer for others."""
IN_ONE: Final = 200
"""Most of them in one message: so many of the longest ids keep to its limit."""

_NEVER: Final = float("inf")


class Settled:
    """Ended calls of one caller. An acknowledgement waits up to `delay` seconds for others to go
    with it."""

    def __init__(self, delay: float) -> None:
        self._delay = delay
        self._safe: dict[str, bool] = {}
        self._given_up: OrderedDict[str, None] = OrderedDict()
        self._acks: list[str] = []
        self.due = _NEVER
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
        acks, self._acks, self.due = self._acks, [], _NEVER
        return [
            ResultAck(acks[n], tuple(acks[n + 1 : n + IN_ONE])) for n in range(0, len(acks), IN_ONE)
        ]

    def link_lost(self) -> None:
        """What waits is not told any more: the peer lists what it keeps when it is back."""
        self._acks.clear()
        self.due = _NEVER

    def peer_is_new(self) -> None:
        """The peer is another process: nothing given up can turn up any more."""
        self._given_up.clear()
