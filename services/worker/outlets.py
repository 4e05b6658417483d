"""The sending ends of set-point streams: newest value wins, paced by absolute deadline, repeated
while its run stands by it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.codec import LIMITS
from petrobot.services.comm.protocol.messages import SetPoint
from petrobot.services.comm.streams.stream import StreamSender
from petrobot.services.comm.tls.credentials import credentials

MOST = (LIMITS[SetPoint.KIND] - 64) // 9
"""Numbers of a set point: 9 bytes each in its message, and room for the rest of it."""
SLACK = 1e-6  # s: binary fractions of a period must not cost a whole tick


@dataclass(frozen=True, slots=True)
class Sent:
    """A set point that leaves: the newest value of a stream, and how long ago its action published
    it (s)."""

    run: str
    stream: str
    values: tuple[float, ...]
    elapsed: float


@dataclass
class _Outlet:
    period: float
    run: str = ""
    values: tuple[float, ...] = ()
    published: float = 0.0
    next: float = -math.inf
    """Earliest time of the next send."""


class Outlets:
    """All streams that the runs of one place may send to; a machine: `publish`, `advance`,
    `due`."""

    def __init__(self, periods: Mapping[str, float]) -> None:
        self._periods = periods
        self._outlets: dict[str, _Outlet] = {}
        self._open: dict[str, _Outlet] = {}

    def publish(self, now: float, run: str, stream: str, values: Sequence[float]) -> None:
        """Make `values` the newest of a stream. Raises ValueError for an unknown stream, and for
        what is not a list of finite numbers."""
        outlet = self._outlets.get(stream)
        if outlet is None:
            try:
                outlet = self._outlets[stream] = _Outlet(self._periods[stream])
            except KeyError:
                raise ValueError(
                    f"no stream is named {stream!r}; services.toml has: "
                    f"{', '.join(self._periods) or 'none'}"
                ) from None
        try:
            numbers = tuple(float(v) for v in values)
        except (TypeError, ValueError):
            raise ValueError(
                f"set point of {stream!r}: expected a list of numbers, found {values!r:.100}"
            ) from None
        if len(numbers) > MOST:
            raise ValueError(
                f"set point of {stream!r}: expected at most {MOST} numbers, found {len(numbers):,}"
            )
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"set point of {stream!r} is not finite: {numbers}")
        if stream not in self._open:
            outlet.next = max(outlet.next, now)  # a pause is no delay to be made up for
        outlet.run, outlet.values, outlet.published = run, numbers, now
        self._open[stream] = outlet

    def withdraw(self, stream: str, run: str | None = None) -> None:
        """Stop standing by a stream's last value (only if it is that run's, when one is given)."""
        if stream in self._open and run in (None, self._open[stream].run):
            del self._open[stream]

    def close(self, run: str) -> None:
        """A run ended: nobody stands by its set points any more."""
        for stream in [s for s, outlet in self._open.items() if outlet.run == run]:
            del self._open[stream]

    def advance(self, now: float) -> list[Sent]:
        """What is to be sent now: of each open stream at most one value in a period, new or
        repeated."""
        sent = []
        for stream, outlet in self._open.items():
            if now + SLACK < outlet.next:
                continue
            late = now - outlet.next
            # absolute deadlines keep the rate; after a gap of more than a period the grid starts
            # anew
            outlet.next = (outlet.next if late < outlet.period else now) + outlet.period
            sent.append(Sent(outlet.run, stream, outlet.values, max(0.0, now - outlet.published)))
        return sent

    def due(self) -> float | None:
        """When `advance` has something to send next (s), None if nothing is open."""
        return min((outlet.next for outlet in self._open.values()), default=None)


# All streams that a worker sends: finds the receivers through its node, keeps the connections,
# drops what cannot go now.

ASK_AGAIN = 0.25
"""Seconds between questions for the address of a receiver that is not there."""


class StreamOutlets:
    """Sending ends by stream, made when first needed. A receiver that does not take a stream is
    asked for anew."""

    def __init__(self, directory: Directory, sender: str) -> None:
        self._sender = sender
        self._streams = directory.streams
        self._credentials = credentials(directory, sender)
        self._outlets: dict[str, StreamSender] = {}
        self._asked: dict[str, float] = {}

    def send(self, now: float, sent: Sent) -> bool:
        """Send a set point. True when the stream's address is wanted (again)."""
        outlet = self._outlets.get(sent.stream)
        if outlet is not None and outlet.send(sent.values, sent.elapsed):
            return False
        if now < self._asked.get(sent.stream, -math.inf) + ASK_AGAIN:
            return False
        self._asked[sent.stream] = now
        return outlet is None or not outlet.up

    def found(self, stream: str, host: str, port: int, ticket: str) -> None:
        """A stream's address is known: connect, unless it is connected there."""
        older = self._outlets.get(stream)
        if older is not None and older.up:
            return
        if older is not None:
            older.close()
        key, entry = self._credentials.stream_key(ticket), self._streams[stream]
        outlet = StreamSender(
            self._sender,
            stream,
            entry.period,
            host,
            port,
            receiver=entry.to,
            ticket=ticket,
            key=key,
        )
        outlet.advance()
        self._outlets[stream] = outlet

    def advance(self) -> bool:
        """Look after the connections; True while one is being opened."""
        lines = [outlet.advance() for outlet in self._outlets.values()]
        return None in lines

    def close(self) -> None:
        """End all streams."""
        for outlet in self._outlets.values():
            outlet.close()
