"""The ends of set-point streams in a worker.

The newest value wins. The sending end sends it at absolute times, and repeats it until its run ends
or withdraws it; the receiving end has a watchdog on its age.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence

from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.codec import LIMITS
from petrobot.services.comm.protocol.messages import SetPoint
from petrobot.services.comm.streams.stream import STALE_AFTER, StreamSender
from petrobot.services.comm.tls.credentials import credentials

_log = logging.getLogger(__name__)

# --- receiving ---

SLACK = 1e-6  # s: rounding neither makes a value too old nor delays one by a tick


class SetpointReceiver:
    """Implements `services.device.Setpoint` for the driver, and `Sink` for the receiver of the
    stream's messages."""

    def __init__(self, period: float, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.begin(period)

    def begin(self, period: float) -> None:
        """Begin as if nothing had arrived; `period` is that of the stream (s)."""
        self._limit = STALE_AFTER * period + SLACK
        self._values: tuple[float, ...] | None = None
        self._arrived = -math.inf
        self._published = -math.inf
        self._count = 0

    @property
    def values(self) -> tuple[float, ...] | None:
        """The newest set point; None before the first one, and if it is stale (older than three
        periods)."""
        return self._values if self.age <= self._limit else None

    @property
    def age(self) -> float:
        """Time since the newest one arrived (s; inf before the first)."""
        return self._clock() - self._arrived

    @property
    def held(self) -> float:
        """Time since the sender first sent these values, without their transport (s). A repetition
        does not make them younger."""
        return self._clock() - self._published

    @property
    def count(self) -> int:
        """Number of set points that arrived."""
        return self._count

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """Accept a set point whose values its sender first sent `held` seconds ago."""
        now = self._clock()
        self._values, self._arrived, self._published = tuple(values), now, now - held
        self._count += 1

    def withdraw(self) -> None:
        """Note that the sender withdrew it or has ended: it is stale at once."""
        self._values = None


# --- sending ---

MOST = (LIMITS[SetPoint.KIND] - 64) // 9
"""Most numbers of a set point: each takes 9 bytes of its message."""


class Sent(Struct, frozen=True):
    """A set point to send: the newest value of a stream, how long ago its action published it (s),
    and how long ago its run began (s)."""

    run: str
    stream: str
    values: tuple[float, ...]
    elapsed: float
    age: float


class _Outlet(Struct):
    period: float
    run: str = ""
    began: float = 0.0
    values: tuple[float, ...] = ()
    published: float = 0.0
    next: float = -math.inf
    """Earliest time of the next send."""


class Outlets:
    """All streams that the runs of one worker may send to; a machine: `publish`, `advance`,
    `due`."""

    def __init__(self, periods: Mapping[str, float]) -> None:
        self._periods = periods
        self._outlets: dict[str, _Outlet] = {}
        self._open: dict[str, _Outlet] = {}

    def publish(
        self, now: float, run: str, began: float, stream: str, values: Sequence[float]
    ) -> None:
        """Make `values` of a run, which began at `began`, the newest of a stream. Raises ValueError
        for an unknown stream, and for what is not a list of finite numbers."""
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
            outlet.next = max(outlet.next, now)  # after a pause, missed sends are not made up for
        outlet.run, outlet.began = run, began
        outlet.values, outlet.published = numbers, now
        self._open[stream] = outlet

    def withdraw(self, stream: str, run: str | None = None) -> None:
        """Withdraw a stream's last value (if `run` is given, only if that run published it)."""
        if stream in self._open and run in (None, self._open[stream].run):
            del self._open[stream]

    def close(self, run: str) -> None:
        """Withdraw the set points of a run that ended."""
        for stream in [s for s, outlet in self._open.items() if outlet.run == run]:
            del self._open[stream]

    def advance(self, now: float) -> list[Sent]:
        """Return the set points to send now: at most one per stream and period, new or repeated."""
        sent = []
        for stream, outlet in self._open.items():
            if now + SLACK < outlet.next:
                continue
            late = now - outlet.next
            # absolute times keep the rate; after a gap of more than a period the grid starts again
            outlet.next = (outlet.next if late < outlet.period else now) + outlet.period
            elapsed, age = max(0.0, now - outlet.published), max(0.0, now - outlet.began)
            sent.append(Sent(outlet.run, stream, outlet.values, elapsed, age))
        return sent

    def due(self) -> float | None:
        """Return when `advance` has something to send next (s), None if no stream is open."""
        return min((outlet.next for outlet in self._open.values()), default=None)


# All streams that a worker sends: find the receivers through the node, keep the connections, drop
# what cannot be sent now.

ASK_AGAIN = 0.25
"""Time between two requests for the address of an absent receiver (s)."""


class StreamOutlets:
    """Sending ends by stream, made when first needed. If a receiver does not accept a stream, its
    address is requested again."""

    def __init__(self, directory: Directory, sender: str, keys: Sequence[bytes]) -> None:
        self._sender = sender
        self._streams = directory.streams
        self._credentials = credentials(directory, sender, tuple(keys) or None)
        self._outlets: dict[str, StreamSender] = {}
        self._asked: dict[str, float] = {}
        self._refusals: dict[str, str] = {}
        """The last refusal of each stream that was logged."""

    def send(self, now: float, sent: Sent) -> bool:
        """Send a set point. Return True if the stream's address must be requested (again)."""
        outlet = self._outlets.get(sent.stream)
        if outlet is not None and outlet.send(sent.values, sent.elapsed, sent.run, sent.age):
            return False
        if now < self._asked.get(sent.stream, -math.inf) + ASK_AGAIN:
            return False
        self._asked[sent.stream] = now
        return outlet is None or not outlet.up

    def found(self, stream: str, host: str, port: int, ticket: str) -> None:
        """Connect to a stream's address, unless it is connected there already."""
        older, entry = self._outlets.get(stream), self._streams[stream]
        if older is not None and older.up:
            return
        if older is not None:
            if older.refusal not in ("", self._refusals.get(stream)):
                self._refusals[stream] = older.refusal
                _log.warning("stream %s: refused by %s: %s", stream, entry.to, older.refusal)
            older.close()
        key = self._credentials.stream_key(ticket)
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
        """Advance the connections; return True while one is being opened."""
        lines = [outlet.advance() for outlet in self._outlets.values()]
        return None in lines

    def close(self) -> None:
        """End all streams."""
        for outlet in self._outlets.values():
            outlet.close()
