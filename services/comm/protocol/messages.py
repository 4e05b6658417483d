"""Messages of the node protocol as plain typed records.

Each class has a `KIND`, its number on the wire. `codec.py` turns messages into bytes and back. Only
durations are sent, never a clock reading. docs/protocol.md describes the exchange.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, ClassVar, Final

from msgspec import Struct, field

COORDINATOR: Final = "coordinator"
"""Name of the coordinator: its role in HELLO, its table in services.toml, its certificate."""
EMERGENCY_STOP: Final = "emergency_stop"
"""Verb of the operator: stop at once and refuse all commands. Also the cause of a run that its node
ended or refused because of it; a driver may give this cause, too, for a stop of its own device."""
LATCHED: Final = "latched"
"""Value of such a result if the node's stop is not cleared, or its caller did not know of it."""
STOPS: Final = "stops"
"""Value of a latched result: the number of cleared stops that its caller knows of from then on."""
LEASE: Final = "lease"
"""Verb of a COMMAND by which a coordinator takes a device before its first call."""
_BOOT: Final = re.compile(r"(.*)\+([0-9]{1,18})(?:/([0-9]{1,18}(?:\.[0-9]+)?))?", re.DOTALL)
SEED: Final = "seed"
"""Verb and key of the COMMAND that tells the mission's seed to devices that no action uses."""


def boot_text(process: str, stops: int, since: float = math.inf) -> str:
    """Return the boot of a node: the random text of its process, and how many emergency stops were
    cleared on it, if any. A call to a device that names another number is refused, so a caller that
    slept through a stop moves nothing. In WELCOME also the time since the last one was cleared (s):
    an order that is older is not carried out."""
    ago = "" if since == math.inf else f"/{since:.6f}"
    return f"{process}+{stops}{ago}" if stops else process


def split_boot(boot: str) -> tuple[str, int, float]:
    """Return what `boot_text` put together."""
    found = _BOOT.fullmatch(boot)
    return (found[1], int(found[2]), float(found[3] or math.inf)) if found else (boot, 0, math.inf)


class Executed(StrEnum):
    """Whether an action that finished with ERROR may have changed the world."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


class Hello(Struct, frozen=True):
    """First message of the connecting side: who it is and which versions it speaks."""

    KIND: ClassVar[int] = 1
    oldest_version: int
    newest_version: int
    role: str
    """"coordinator", "node" or "client"."""
    name: str
    boot: str
    """Random text of each start of the process, so that a restarted process is never taken for the
    old one."""
    epoch: int = 0
    """Raised at each restart of a coordinator. Messages with an older epoch are refused."""
    directory: str = ""
    """Hash of the sender's services.toml."""
    auth: bytes = b""
    """The wanted server name with a nonce (with a key) or a checksum (without); see
    docs/protocol.md."""


class Welcome(Struct, frozen=True):
    """Positive answer to Hello."""

    KIND: ClassVar[int] = 2
    version: int
    name: str
    boot: str
    offers: tuple[str, ...] = ()
    """Actions and services that this caller may call."""
    runs: tuple[str, ...] = ()
    """Ids of this caller's calls that are still active, or finished and not acknowledged."""
    directory: str = ""
    auth: bytes = b""
    """Proof that the server knows the key; without a key a checksum of the opening."""


class Refuse(Struct, frozen=True):
    """The connection is refused, or ended because the other side broke the protocol. Nothing
    follows it."""

    KIND: ClassVar[int] = 3
    code: str
    text: str


class Call(Struct, frozen=True):
    """Run an action or call a service.

    `id` is unique for ever. A node never runs the same id twice: it answers a known id with what it
    knows.
    """

    KIND: ClassVar[int] = 4
    id: str
    service: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    deadline: float | None = None
    """Longest duration of the run (s); the node enforces it."""
    epoch: int = 0
    boot: str = ""
    """Boot of the peer that the caller means (`boot_text`); empty: any. Another process answers
    `executed = unknown`."""
    parent: str = ""
    """Id of the call on whose behalf this one is made; it is cancelled together with its parent."""
    seed: int = 0
    """Seed of the mission run, from which an action derives its random numbers."""
    again: bool = False
    """The call may have been sent before. A node that may have forgotten its id does not run it.

    Left out on the wire when false.
    """


class Accept(Struct, frozen=True):
    """The call was accepted and its run begins."""

    KIND: ClassVar[int] = 5
    id: str


class Feedback(Struct, frozen=True):
    """Progress of a run (fraction from 0 to 1), for people."""

    KIND: ClassVar[int] = 6
    id: str
    fraction: float
    data: Mapping[str, Any] = field(default_factory=dict)


class Outcome(Struct, frozen=True):
    """RESULT: the outcome of a call. The node keeps it until it is acknowledged."""

    KIND: ClassVar[int] = 7
    id: str
    status: str
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    executed: Executed = Executed.YES
    seconds: float = 0.0
    """Duration of the run on the node's clock (s)."""
    cpu_seconds: float = 0.0
    deferred: bool = False
    """The status is provisional: a later verdict may correct it for the estimates.

    Left out on the wire when false.
    """


class ResultAck(Struct, frozen=True):
    """The caller has stored the result; the node may forget it."""

    KIND: ClassVar[int] = 8
    id: str
    more: tuple[str, ...] = ()
    """Ids of further results that are acknowledged with it."""


class Cancel(Struct, frozen=True):
    """Stop a run. It still finishes with an Outcome (cause `cancelled`, unless it finished
    before)."""

    KIND: ClassVar[int] = 9
    id: str
    reason: str = ""


class Event(Struct, frozen=True):
    """An event of the outside world or of an active run (`run` is its call id), or a changed
    variable."""

    KIND: ClassVar[int] = 10
    name: str
    source: str
    number: int
    """Counts up from 1 for each source; 0 for an event that needs no acknowledgement (a pulse)."""
    data: Mapping[str, Any] = field(default_factory=dict)
    run: str = ""


class EventAck(Struct, frozen=True):
    """The receiver has stored the source's events up to this number."""

    KIND: ClassVar[int] = 11
    source: str
    number: int


class Subscribe(Struct, frozen=True):
    """Send me events of these names from now on; replaces an earlier subscription. With `fresh`,
    latched events of the time before are not for me."""

    KIND: ClassVar[int] = 12
    names: tuple[str, ...]
    fresh: bool = False


class Command(Struct, frozen=True):
    """A command to the node itself, not an action: `hold`, `release`, `stop` (stop routine of all
    devices), `status`, ..."""

    KIND: ClassVar[int] = 13
    id: str
    verb: str
    target: str = ""
    """A device; empty for the whole node."""
    data: Mapping[str, Any] = field(default_factory=dict)


class Answer(Struct, frozen=True):
    """Answer to a Command."""

    KIND: ClassVar[int] = 14
    id: str
    ok: bool
    data: Mapping[str, Any] = field(default_factory=dict)


class Ping(Struct, frozen=True):
    """Heartbeat."""

    KIND: ClassVar[int] = 15
    number: int


class Pong(Struct, frozen=True):
    """Answer to a Ping."""

    KIND: ClassVar[int] = 16
    number: int


class Tick(Struct, frozen=True):
    """Lock step: all envelopes that the sender sends to this receiver at this tick. It also marks
    the end of the tick."""

    KIND: ClassVar[int] = 17
    number: int
    envelopes: tuple[Any, ...] = ()


class Bye(Struct, frozen=True):
    """The sender closes the connection in an orderly way."""

    KIND: ClassVar[int] = 18
    text: str = ""


class Challenge(Struct, frozen=True):
    """A server's answer to Hello when it has a key: its nonce."""

    KIND: ClassVar[int] = 19
    auth: bytes


class Proof(Struct, frozen=True):
    """Answer to Challenge: proves that the client knows the key."""

    KIND: ClassVar[int] = 20
    auth: bytes


class StreamOpen(Struct, frozen=True):
    """First message on a stream's own connection: one set point follows every `period` seconds."""

    KIND: ClassVar[int] = 21
    stream: str
    period: float
    ticket: str = ""
    """The ticket that the receiving node issued for this stream; a receiver that needs none ignores
    it."""


class SetPoint(Struct, frozen=True):
    """The newest set point of a stream, repeated every period as long as the sender wants it
    followed."""

    KIND: ClassVar[int] = 22
    number: int
    """Counts up from 1 with each message of the stream."""
    values: tuple[float, ...]
    held: float = 0.0
    """Age of these values at the sender (s): 0 when they are new."""
    elapsed: float = 0.0
    """Time since the stream was opened, on the sender's clock (s). From it the receiver computes
    the delay."""


class Withdraw(Struct, frozen=True):
    """The last set point must not be followed any longer; what comes next is of another run, or the
    first on this connection."""

    KIND: ClassVar[int] = 23
    before: float = 0.0
    """How long before STREAM_OPEN that run began (s); 0: after it."""


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
