"""Lock step in one process: several parties, tick by tick, every envelope in the one order that any
placement gives.

At tick k each party takes the envelopes due at k, ordered by (tick sent, source, sequence), then
advances to k * TICK; what it sends is due after the delay of its link, one tick at least. So
parties never see each other within a tick, and neither their order nor the process they live in
shows. Bodies are passed on as they would arrive from another process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import TICK, Envelope, Party, Posted
from petrobot.services.comm.protocol.codec import decode, encode
from petrobot.services.comm.protocol.messages import Message
from petrobot.services.comm.protocol.plain import SCALARS, NotPlainError, copy_array, plain

_MESSAGES = frozenset(get_args(Message))
_FLAT = frozenset((float, int, str, bytes, bool))
_FRAMES = frozenset((Frame,))
_DTYPES = (np.dtype("u1"), np.dtype("<f8"))
_MOST_DIMENSIONS = 4
_ORDER = itemgetter(0, 1, 2)

_Due = tuple[int, str, int, Envelope]
"""Tick sent, source, sequence, envelope."""


class CellError(Exception):
    """A lock-step cell cannot go on; the text names the party and what to do."""


class Delays:
    """Delays of the links in ticks, by `"source/target"` (endpoint names) or by channel; the former
    goes first.

    Whatever is not named takes one tick. Raises CellError for a delay below one.
    """

    def __init__(self, table: Mapping[str, int] | None = None) -> None:
        self._table = dict(table or {})
        self._ways: dict[tuple[str, str, str], int] = {}
        for name, ticks in self._table.items():
            if type(ticks) is not int or ticks < 1:
                raise CellError(
                    f"link {name}: a delay of {ticks!r}; give a whole number of ticks, at least 1"
                )

    def ticks(self, envelope: Envelope) -> int:
        """Ticks that this envelope is on its way."""
        if not self._table:
            return 1
        way = envelope[1:4]
        ticks = self._ways.get(way)
        if ticks is None:
            source, target, channel = way
            by_ends = self._table.get(f"{source}/{target}")
            ticks = self._ways[way] = self._table.get(channel, 1) if by_ends is None else by_ends
        return ticks


def as_received(channel: str, body: Any) -> Any:
    """The body as it arrives in another process: messages checked and in plain data, arrays as
    tuples, images read-only (those that their sender has locked are passed on as they are).

    Raises NotPlainError or ProtocolError for what no envelope carries.
    """
    kind = type(body)
    if kind is tuple:
        if channel == "can" and body and _FRAMES.issuperset(map(type, body)):
            return body
        if _FLAT.issuperset(map(type, body)):
            return body
    elif kind in SCALARS or (kind is Frame and channel == "can"):
        return body
    elif kind in _MESSAGES:
        return decode(encode(body))
    if isinstance(body, np.ndarray):
        return body if _frozen(body) else copy_array(body)
    if isinstance(body, (tuple, list)):
        return tuple(as_received(channel, item) for item in body)
    if isinstance(body, Mapping):
        if not all(type(key) is str for key in body):
            raise NotPlainError("a key of a map is not a str")
        return {key: as_received(channel, item) for key, item in body.items()}
    return plain(body, "body")


def _frozen(array: NDArray[Any]) -> bool:
    """Whether an array is already what would arrive: nobody can write to it, as its maker has
    locked memory of its own."""
    flags = array.flags
    locked = not flags.writeable and flags.owndata and flags.c_contiguous
    return locked and array.dtype in _DTYPES and array.ndim <= _MOST_DIMENSIONS


class LocalParties:
    """The parties that live in this process, their inboxes, and the numbers of what they send."""

    def __init__(
        self, parties: Iterable[Party], delays: Delays, everybody: Iterable[str] = ()
    ) -> None:
        self._parties: dict[str, Party] = {}
        for party in sorted(parties, key=lambda one: one.name):
            if party.name in self._parties:
                raise CellError(f"two parties are named {party.name}; give each a name of its own")
            self._parties[party.name] = party
        self._names = frozenset(everybody) | frozenset(self._parties)
        self._delays = delays
        self._inboxes: dict[str, dict[int, list[_Due]]] = {name: {} for name in self._parties}
        self._sequences: dict[str, int] = {}
        self._owners: dict[str, str] = {}

    def replace(self, party: Party) -> None:
        """Another party takes a name over. Raises CellError if there is none of its name."""
        if party.name not in self._parties:
            raise CellError(f"no party is named {party.name}; there are {sorted(self._parties)}")
        self._parties[party.name] = party

    def step(self, tick: int) -> list[Posted]:
        """Run one tick. Gives the envelopes for parties that do not live here, in the order they
        were sent."""
        now = tick * TICK
        outside: list[Posted] = []
        for name, party in self._parties.items():
            due = self._inboxes[name].pop(tick, None)
            if due is not None:
                if len(due) > 1:
                    due.sort(key=_ORDER)
                for _, _, _, envelope in due:
                    party.receive(now, envelope)
            party.advance(now)
            for envelope in party.drain():
                posted = self._post(tick, name, envelope)
                if envelope.party in self._parties:
                    self.deliver(tick, posted)
                else:
                    outside.append(posted)
        return outside

    def deliver(self, sent: int, posted: Posted) -> None:
        """Put an envelope that was sent at this tick into its party's inbox."""
        due, sequence, envelope = posted
        inbox = self._inboxes[envelope.party]
        one = sent, envelope.source, sequence, envelope
        if due in inbox:
            inbox[due].append(one)
        else:
            inbox[due] = [one]

    def own(self, source: str, party: str) -> None:
        """Note which party an endpoint lives in. Raises CellError if two parties send under one
        name."""
        owner = self._owners.setdefault(source, party)
        if owner != party:
            raise CellError(
                f"{owner} and {party} both send as {source}; an endpoint lives in one party"
            )

    def _post(self, tick: int, sender: str, envelope: Envelope) -> Posted:
        party, source, target, channel, sent = envelope
        if self._owners.get(source) != sender:
            self.own(source, sender)
        if party not in self._names:
            raise CellError(
                f"{source} sends to the party {party}, which is not in the cell: "
                f"{sorted(self._names)}"
            )
        try:
            body = as_received(channel, sent)
        except Exception as fault:
            text = f"{source} sends {target} on {channel} what no envelope carries: {fault}"
            raise CellError(text) from fault
        if body is not sent:
            envelope = Envelope(party, source, target, channel, body)
        sequence = self._sequences.get(source, 0)
        self._sequences[source] = sequence + 1
        return Posted(tick + self._delays.ticks(envelope), sequence, envelope)


class LockStepCell:
    """A whole cell in one process."""

    def __init__(self, parties: Sequence[Party], delays: Delays | None = None) -> None:
        self._half = LocalParties(parties, delays or Delays())
        self.tick = 0
        """The next tick to run."""

    @property
    def now(self) -> float:
        """Simulated time of the next tick (s)."""
        return self.tick * TICK

    def step(self) -> None:
        """Run one tick."""
        self._half.step(self.tick)
        self.tick += 1

    def replace(self, party: Party) -> None:
        """Another party takes a name over, as a process that was started again does; what is on its
        way still arrives."""
        self._half.replace(party)

    def run(self, until: Callable[[], bool], max_ticks: int) -> bool:
        """Run ticks until `until()` holds after one, at most `max_ticks`. Says whether it held."""
        for _ in range(max_ticks):
            self.step()
            if until():
                return True
        return False
