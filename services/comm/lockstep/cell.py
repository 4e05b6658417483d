"""Lock step in one process: several parties advance tick by tick; the order of envelopes is the
same for any distribution over processes.

At tick k each party receives the envelopes due at k, ordered by (tick sent, source, sequence), then
advances to k * TICK. What it sends is due after the delay of its link, at least one tick. So a
party never sees what another party does within the same tick, and neither the order of the parties
nor their processes can influence the result. Bodies are converted to what would arrive from another
process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, get_args

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import TICK, Envelope, Party, Posted
from petrobot.services.comm.protocol.codec import decode, encode
from petrobot.services.comm.protocol.messages import Message
from petrobot.services.comm.protocol.plain import (
    SCALARS,
    NotPlainError,
    copy_array,
    is_numpy,
    plain,
)
from petrobot.services.host.toml_text import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MESSAGES = frozenset(get_args(Message))
_FLAT = frozenset((float, int, str, bytes, bool))
_FRAMES = frozenset((Frame,))
_DTYPES = ("|u1", "<f8")
_MOST_DIMENSIONS = 4
_ORDER = itemgetter(0, 1, 2)

_Due = tuple[int, str, int, Envelope]
"""Tick sent, source, sequence, envelope."""


class CellError(InputError):
    """A lock-step cell cannot continue; the text names the party and what to do."""

    exit_code = 3


class Delays:
    """Delays of the links in ticks, by `"source/target"` (endpoint names) or by channel; the former
    has priority.

    Links without an entry take one tick. Raises CellError for a delay below one tick.
    """

    def __init__(self, table: Mapping[str, int] | None = None) -> None:
        self._table = dict(table or {})
        self._ways: dict[tuple[str, str, str], int] = {}
        for name, ticks in self._table.items():
            if type(ticks) is not int or ticks < 1:
                raise CellError(
                    f"link {name}: expected a delay of a whole number of ticks, at least 1, "
                    f"got {ticks!r}"
                )

    def ticks(self, envelope: Envelope) -> int:
        """Return how many ticks this envelope takes."""
        if not self._table:
            return 1
        way = envelope[1:4]
        ticks = self._ways.get(way)
        if ticks is None:
            source, target, channel = way
            by_ends = self._table.get(f"{source}/{target}")
            ticks = self._ways[way] = self._table.get(channel, 1) if by_ends is None else by_ends
        return ticks


# The order of the tests is by frequency: CAN frames and tuples of numbers are sent every tick and
# must not be copied.
def as_received(channel: str, body: Any) -> Any:
    """Return the body as it would arrive in another process.

    Messages are checked and converted to plain data, arrays become tuples, images become read-only
    copies (an image that its sender has locked is passed on as it is). Raises NotPlainError or
    ProtocolError for what an envelope cannot carry.
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
    if is_numpy(body, "ndarray"):
        return body if _frozen(body) else copy_array(body)
    if isinstance(body, (tuple, list)):
        return tuple(as_received(channel, item) for item in body)
    if isinstance(body, Mapping):
        if not all(type(key) is str for key in body):
            raise NotPlainError("a key of a map is not a str")
        return {key: as_received(channel, item) for key, item in body.items()}
    return plain(body, "body")


def _frozen(array: NDArray[Any]) -> bool:
    """Return whether an array is already what would arrive: it owns its memory and is read-only, so
    no party can change it."""
    flags = array.flags
    locked = not flags.writeable and flags.owndata and flags.c_contiguous
    return locked and array.dtype.str in _DTYPES and array.ndim <= _MOST_DIMENSIONS


class LocalParties:
    """The parties of this process, their inboxes, and the sequence numbers of what they send."""

    def __init__(
        self, parties: Iterable[Party], delays: Delays, everybody: Iterable[str] = ()
    ) -> None:
        self._parties: dict[str, Party] = {}
        for party in sorted(parties, key=lambda one: one.name):
            if party.name in self._parties:
                raise CellError(f"two parties are named {party.name}; rename one of them")
            self._parties[party.name] = party
        self._names = frozenset(everybody) | frozenset(self._parties)
        self._delays = delays
        self._inboxes: dict[str, dict[int, list[_Due]]] = {name: {} for name in self._parties}
        self._sequences: dict[str, int] = {}
        self._owners: dict[str, str] = {}

    def replace(self, party: Party) -> None:
        """Replace a party by a new one of the same name. Raises CellError if there is none of that
        name."""
        if party.name not in self._parties:
            raise CellError(f"no party is named {party.name}; known: {sorted(self._parties)}")
        self._parties[party.name] = party

    def step(self, tick: int) -> list[Posted]:
        """Run one tick. Return the envelopes for parties of other processes, in the order they were
        sent."""
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
                if posted is not None:
                    outside.append(posted)
        return outside

    def deliver(self, sent: int, posted: Posted) -> None:
        """Put an envelope that was sent at tick `sent` into the inbox of its party."""
        due, sequence, envelope = posted
        self._put(due, (sent, envelope.source, sequence, envelope))

    def _put(self, due: int, one: _Due) -> None:
        inbox = self._inboxes[one[3].party]
        if due in inbox:
            inbox[due].append(one)
        else:
            inbox[due] = [one]

    def own(self, source: str, party: str) -> None:
        """Record the party of an endpoint. Raises CellError if two parties send under one endpoint
        name.

        Sequence numbers are counted per endpoint name; two senders under one name would have no
        defined order.
        """
        owner = self._owners.setdefault(source, party)
        if owner != party:
            raise CellError(
                f"{owner} and {party} both send as {source}; an endpoint belongs to one party"
            )

    def _post(self, tick: int, sender: str, envelope: Envelope) -> Posted | None:
        """Put an envelope into the inbox of its party; return it if that is in another process."""
        party, source, target, channel, sent = envelope
        if self._owners.get(source) != sender:
            self.own(source, sender)
        if party not in self._names:
            raise CellError(
                f"{source} sends to the party {party}, which is not in the cell; known: "
                f"{sorted(self._names)}"
            )
        try:
            body = as_received(channel, sent)
        except Exception as fault:
            text = f"{source} sends data to {target} on {channel} that cannot be sent: {fault}"
            raise CellError(text) from fault
        if body is not sent:
            envelope = Envelope(party, source, target, channel, body)
        sequence = self._sequences.get(source, 0)
        self._sequences[source] = sequence + 1
        due = tick + self._delays.ticks(envelope)
        if party not in self._parties:
            return Posted(due, sequence, envelope)
        self._put(due, (tick, source, sequence, envelope))
        return None


class LockStepCell:
    """A whole cell in one process."""

    def __init__(self, parties: Sequence[Party], delays: Delays | None = None) -> None:
        self._half = LocalParties(parties, delays or Delays())
        self.tick = 0
        """The next tick to run."""

    @property
    def now(self) -> float:
        """Return the simulated time of the next tick (s)."""
        return self.tick * TICK

    def step(self) -> None:
        """Run one tick."""
        self._half.step(self.tick)
        self.tick += 1

    def replace(self, party: Party) -> None:
        """Replace a party, as a restarted process does; envelopes on their way still arrive."""
        self._half.replace(party)

    def run(self, until: Callable[[], bool], max_ticks: int) -> bool:
        """Run ticks until `until()` holds after one, at most `max_ticks`. Return whether it
        held."""
        for _ in range(max_ticks):
            self.step()
            if until():
                return True
        return False
