"""The messages of the node protocol: what two processes say to each other, as plain typed records.

Each class has a `KIND`, its number on the wire; `wire.py` turns messages into bytes and back. Only
durations cross the wire, never a clock reading. The exchange is described in docs/protocol.md.

Nobody changes a message once it is made. Call and Outcome are not frozen all the same: that would
make each of them eight times as long to make (0.9 us instead of 0.1), and every call makes four.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar


class Executed(StrEnum):
    """Whether an action that ended in ERROR touched the world."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of the side that connects: who it is and what it speaks."""

    KIND: ClassVar[int] = 1
    oldest_version: int
    newest_version: int
    role: str
    """"coordinator", "node" or "client"."""
    name: str
    boot: str
    """Drawn anew at each start of the process: another boot never answers for this one."""
    epoch: int = 0
    """Raised at each restart of a coordinator; messages of an older epoch are refused."""
    directory: str = ""
    """Hash of the sender's services.toml."""
    auth: bytes = b""
    """The sender's nonce when the link has a key, else empty."""


@dataclass(frozen=True, slots=True)
class Welcome:
    """Answer to Hello."""

    KIND: ClassVar[int] = 2
    version: int
    name: str
    boot: str
    offers: tuple[str, ...] = ()
    """Actions and services that this caller may call."""
    runs: tuple[str, ...] = ()
    """Ids of calls still going on, or ended and not acknowledged yet, of this caller's name."""
    directory: str = ""
    auth: bytes = b""
    """Proof that the server knows the key when the link has one, else empty."""


@dataclass(frozen=True, slots=True)
class Refuse:
    """The connection is refused or ended by a fault of the other side; nothing follows it."""

    KIND: ClassVar[int] = 3
    code: str
    text: str


@dataclass(slots=True)
class Call:
    """Run an action or ask a service. `id` is unique for ever; a known id is answered from what is
    known, never run twice."""

    KIND: ClassVar[int] = 4
    id: str
    service: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    deadline: float | None = None
    """Seconds that the run may take; enforced by the node."""
    epoch: int = 0
    boot: str = ""
    """Boot that the caller believes to talk to; empty: any. Another boot answers `executed =
    unknown`."""
    parent: str = ""
    """Id of the call on whose behalf this one is made; cancelled with it."""
    seed: int = 0
    """Seed of the mission run: an action's random draws are keyed by it."""
    again: bool = False
    """It may have been sent before: a node that cannot rule out that it ran and was forgotten does
    not run it.

    Left out on the wire when false."""


@dataclass(frozen=True, slots=True)
class Accept:
    """The call was taken and its run begins."""

    KIND: ClassVar[int] = 5
    id: str


@dataclass(frozen=True, slots=True)
class Feedback:
    """Progress of a run (fraction 0 to 1), for people."""

    KIND: ClassVar[int] = 6
    id: str
    fraction: float
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class Outcome:
    """RESULT: how the call ended; kept by the node until acknowledged."""

    KIND: ClassVar[int] = 7
    id: str
    status: str
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    executed: Executed = Executed.YES
    seconds: float = 0.0
    """How long the run took on the node's clock."""
    cpu_seconds: float = 0.0
    deferred: bool = False
    """The status is provisional: a later verdict may correct it for the estimates. Left out on the
    wire when false."""


@dataclass(frozen=True, slots=True)
class ResultAck:
    """The caller has the result safe; the node may forget it."""

    KIND: ClassVar[int] = 8
    id: str
    more: tuple[str, ...] = ()
    """Ids of further results acknowledged with it."""


@dataclass(frozen=True, slots=True)
class Cancel:
    """Stop a run; it still ends with an Outcome (cause `cancelled` unless it had ended before)."""

    KIND: ClassVar[int] = 9
    id: str
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """An event of the outside world, of a run that goes on (`run` is its call id), or a changed
    variable."""

    KIND: ClassVar[int] = 10
    name: str
    source: str
    number: int
    """Counts up by source from 1; 0 for one that need not be acknowledged (a pulse)."""
    data: Mapping[str, Any] = field(default_factory=dict)
    run: str = ""


@dataclass(frozen=True, slots=True)
class EventAck:
    """The receiver has the source's events up to this number safe."""

    KIND: ClassVar[int] = 11
    source: str
    number: int


@dataclass(frozen=True, slots=True)
class Subscribe:
    """Send me the events of these names from now on (replaces an earlier subscription)."""

    KIND: ClassVar[int] = 12
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Command:
    """A node-level order that is no action: `hold`, `release`, `stop` (stop routine of all
    devices), `status`."""

    KIND: ClassVar[int] = 13
    id: str
    verb: str
    target: str = ""
    """A device, or empty for all of the node."""
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer to a Command."""

    KIND: ClassVar[int] = 14
    id: str
    ok: bool
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Ping:
    """Heartbeat."""

    KIND: ClassVar[int] = 15
    number: int


@dataclass(frozen=True, slots=True)
class Pong:
    """Answer to a Ping."""

    KIND: ClassVar[int] = 16
    number: int


@dataclass(frozen=True, slots=True)
class Tick:
    """Lock step: all that the sender sends at this tick to the receiver, and its end-of-tick mark
    in one."""

    KIND: ClassVar[int] = 17
    number: int
    envelopes: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class Bye:
    """The sender leaves in good order."""

    KIND: ClassVar[int] = 18
    text: str = ""


@dataclass(frozen=True, slots=True)
class Challenge:
    """Answer of a server with a key to Hello: its nonce."""

    KIND: ClassVar[int] = 19
    auth: bytes


@dataclass(frozen=True, slots=True)
class Proof:
    """Answer to Challenge: the client knows the key."""

    KIND: ClassVar[int] = 20
    auth: bytes


@dataclass(frozen=True, slots=True)
class StreamOpen:
    """First message on a stream's own connection: set points of this stream follow, one each
    `period` seconds."""

    KIND: ClassVar[int] = 21
    stream: str
    period: float
    ticket: str = ""
    """What the receiving node gave out for this stream; a receiver that asks for none ignores
    it."""


@dataclass(frozen=True, slots=True)
class SetPoint:
    """The newest set point of a stream, repeated each period while its sender stands by it."""

    KIND: ClassVar[int] = 22
    number: int
    """Counts up from 1 with each message of the stream."""
    values: tuple[float, ...]
    held: float = 0.0
    """Seconds that the sender has stood by these values already: 0 when they are new."""
    elapsed: float = 0.0
    """Seconds since the stream was opened, on the sender's clock: tells the receiver what was late
    on its way."""


@dataclass(frozen=True, slots=True)
class Withdraw:
    """The sender stands by its last set point no more."""

    KIND: ClassVar[int] = 23


Message = (
    Hello
    | Welcome
    | Refuse
    | Call
    | Accept
    | Feedback
    | Outcome
    | ResultAck
    | Cancel
    | Event
    | EventAck
    | Subscribe
    | Command
    | Answer
    | Ping
    | Pong
    | Tick
    | Bye
    | Challenge
    | Proof
    | StreamOpen
    | SetPoint
    | Withdraw
)
