"""What a caller tells its owner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from petrobot.services.comm.protocol.messages import Answer, Event, Outcome


@dataclass(frozen=True, slots=True)
class Accepted:
    """The peer took the call; its run begins."""

    id: str


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is (0 to 1)."""

    id: str
    fraction: float
    data: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Ended:
    """The one end of a call."""

    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Late:
    """The peer's own result of a call that had ended here before (lost, given up): to be recorded;
    it moves nothing."""

    outcome: Outcome


@dataclass(frozen=True, slots=True)
class EventArrived:
    """An event, each number of a source once."""

    event: Event


@dataclass(frozen=True, slots=True)
class Answered:
    """Answer to a command; `ok` False with data `cause` when the peer gave none."""

    answer: Answer


@dataclass(frozen=True, slots=True)
class PeerLost:
    """The link is down."""

    reason: str


@dataclass(frozen=True, slots=True)
class PeerBack:
    """The link is up. `runs` are ids that the peer still runs or whose results it keeps for this
    caller's name."""

    name: str
    boot: str
    same_boot: bool
    """Whether it is the boot of the last link (False at the first)."""
    offers: tuple[str, ...]
    runs: tuple[str, ...]


Notice = Accepted | Progress | Ended | Late | EventArrived | Answered | PeerLost | PeerBack
