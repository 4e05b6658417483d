"""A party of a lock-step cell: the coordinator, a node or the laboratory, as a machine without
clock or sockets of its own.

Lock step goes in ticks of `TICK` seconds. At tick k each party first gets the envelopes due at k,
ordered by (time, source, sequence), then `advance`s to the time k * TICK, and what it sent is
collected. An envelope sent at tick k is due at k + its link's delay, at least one tick, also when
both ends are in one process: so one and four processes give one and the same run, and so does
moving an endpoint to another party.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

TICK = 0.004
"""Length of a lock-step tick (s): one cycle of the 250 Hz servo loop."""


class Envelope(NamedTuple):
    """A message on its way. `source` and `target` are endpoint names (an action, a device, a
    service or a party), not processes.

    `channel` says what `body` is: "call" a message of the node protocol, "can" a `Frame`, "image"
    an `Image` body, "stream" a set point, "control" anything of the cell's own (start of images,
    ...). `party` is the receiving party.
    """

    party: str
    source: str
    target: str
    channel: str
    body: Any


class Posted(NamedTuple):
    """An envelope on its way: due at a tick, and the how-manieth of its source it is (from 0)."""

    due: int
    sequence: int
    envelope: Envelope


class Party(Protocol):
    """One party of a lock-step cell."""

    @property
    def name(self) -> str:
        """Unique in the cell."""

    def receive(self, now: float, envelope: Envelope) -> None:
        """Take an envelope that is due."""

    def advance(self, now: float) -> None:
        """Do all that is due at `now` (s of simulated time)."""

    def drain(self) -> Sequence[Envelope]:
        """What was sent since the last call, in order."""
