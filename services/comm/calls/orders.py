"""What a node offers to its callers, and what its callee orders it to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from petrobot.services.comm.protocol.messages import Call, Command, Outcome

Inline = Callable[[float, Call], Outcome]
"""A service answered on the spot, in the node's loop: (now, call) to outcome. It must neither wait
nor compute for long."""


@dataclass(frozen=True, slots=True)
class Offer:
    """An action or service of this node."""

    scope: str = "network"
    """"network", or "local": for callers on this host alone."""
    device: str = ""
    orphan_time: float | None = None
    """Seconds that a run goes on without its caller; None: for ever."""
    deadline: float | None = None
    """Seconds for a call that names none."""
    inline: Inline | None = None
    roles: frozenset[str] = frozenset()
    """Roles of the callers that may call it; none: all."""


@dataclass(frozen=True, slots=True)
class StartRun:
    """Order: begin this run, report back with `finish`."""

    call: Call
    peer: str


@dataclass(frozen=True, slots=True)
class CancelRun:
    """Order: stop this run (stop routine first); `finish` still reports its end. Given once a
    run."""

    id: str
    reason: str
    """"cancelled", "deadline" or "orphan", or the caller's own words."""


@dataclass(frozen=True, slots=True)
class Commanded:
    """Order: carry out a command, report back with `answer`."""

    command: Command
    peer: str


Order = StartRun | CancelRun | Commanded
