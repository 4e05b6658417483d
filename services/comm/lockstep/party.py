"""A party of a lock-step cell: the coordinator, a node or the laboratory, without clock or sockets
of its own.

Lock step advances in ticks of `TICK` seconds. At tick k each party first receives the envelopes due
at k, ordered by (tick sent, source, sequence), then advances to the time k * TICK; then what it
sent is collected. An envelope sent at tick k is due at k plus the delay of its link, which is at
least one tick, even if both ends are in one process. So one process and four processes produce the
same run, and so does moving an endpoint to another party.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

TICK = 0.004
"""Length of a lock-step tick (s): one cycle of the 250 Hz servo loop."""


class Envelope(NamedTuple):
    """A message between endpoints. `source` and `target` are endpoint names (an action, a device, a
    service or a party), not processes.

    `channel` says what `body` is: "call" a message of the node protocol, "can" frames, "serial"
    and "tcp" bytes, "image" an image body, "stream" a set point, "control" a request of the cell
    itself (for example the start of images). `party` is the receiving party.
    """

    party: str
    source: str
    target: str
    channel: str
    body: Any


class Posted(NamedTuple):
    """An envelope on its way: due tick, and its sequence number within its source (from 0)."""

    due: int
    sequence: int
    envelope: Envelope


class Party(Protocol):
    """One party of a lock-step cell."""

    @property
    def name(self) -> str:
        """Name of the party, unique in the cell."""

    def receive(self, now: float, envelope: Envelope) -> None:
        """Handle an envelope that is due."""

    def advance(self, now: float) -> None:
        """Do all that is due at `now` (s of simulated time)."""

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
