"""What a node and the place where its actions run say to each other about runs, as plain records
that cross a socket."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any, ClassVar

from petrobot.services.comm.protocol.messages import Executed


@dataclass(frozen=True, slots=True)
class Begin:
    """Start a run of an action."""

    KIND: ClassVar[str] = "begin"
    id: str
    action: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    deadline: float | None = None
    """Seconds that the run may take."""
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Stop:
    """Cancel a run; `cause` becomes that of its end."""

    KIND: ClassVar[str] = "stop"
    id: str
    cause: str = "cancelled"
    text: str = ""


@dataclass(frozen=True, slots=True)
class Answered:
    """The end of a call that a run made."""

    KIND: ClassVar[str] = "answered"
    id: str
    status: str
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Hold:
    """Operator's pause: freeze the runs (True) or let them go on (False)."""

    KIND: ClassVar[str] = "hold"
    frozen: bool


@dataclass(frozen=True, slots=True)
class Ended:
    """A run's end. `executed` says whether it may have touched the world."""

    KIND: ClassVar[str] = "ended"
    id: str
    status: str
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    executed: str = Executed.YES
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    deferred: bool = False
    """Its status is provisional."""


@dataclass(frozen=True, slots=True)
class Judged:
    """The verdict of run `by` on an earlier run that had ended provisionally."""

    KIND: ClassVar[str] = "judged"
    by: str
    run: str
    status: str
    cause: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Progressed:
    """How far a run is, 0 to 1."""

    KIND: ClassVar[str] = "progressed"
    id: str
    fraction: float
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Raised:
    """An internal event of a run (`run` is its id), or an external one of a device (`run` is
    empty)."""

    KIND: ClassVar[str] = "raised"
    run: str
    name: str
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Asked:
    """A run calls a service; `id` is the child call's."""

    KIND: ClassVar[str] = "asked"
    run: str
    id: str
    service: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    deadline: float | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Dropped:
    """A run no longer waits for a call that it made: cancel it."""

    KIND: ClassVar[str] = "dropped"
    id: str


@dataclass(frozen=True, slots=True)
class Sent:
    """A set point leaves: the newest value of a stream and how long ago its action published it
    (s)."""

    KIND: ClassVar[str] = "sent"
    run: str
    stream: str
    values: tuple[float, ...]
    elapsed: float


@dataclass(frozen=True, slots=True)
class Told:
    """Answer to an operator's command: a word, and data about the device and its runs."""

    KIND: ClassVar[str] = "told"
    id: str
    answer: str
    data: Mapping[str, Any] = field(default_factory=dict)


Order = Begin | Stop | Answered | Hold
Report = Ended | Judged | Progressed | Raised | Asked | Dropped | Sent | Told
_RECORDS: dict[str, type[Order] | type[Report]] = {
    kind.KIND: kind
    for kind in (
        Begin,
        Stop,
        Answered,
        Hold,
        Ended,
        Judged,
        Progressed,
        Raised,
        Asked,
        Dropped,
        Sent,
        Told,
    )
}


# Looking the fields up for each record took a third of the time that packing takes.
_LENGTHS = {kind.KIND: 1 + len(fields(kind)) for kind in _RECORDS.values()}
_VALUES: dict[str, Callable[[Order | Report], Any]] = {
    kind.KIND: attrgetter("KIND", *(f.name for f in fields(kind))) for kind in _RECORDS.values()
}


def flat(record: Order | Report) -> list[Any]:
    """The record as a list that msgpack packs."""
    return list(_VALUES[record.KIND](record))


def record(items: list[Any]) -> Order | Report:
    """The record that `flat` made a list of. Raises ValueError for anything else."""
    kind = _RECORDS.get(items[0]) if items else None
    if kind is None or len(items) != _LENGTHS[kind.KIND]:
        raise ValueError(f"not a record: {items!r:.80}")
    return kind(*items[1:])
