"""Compare set points through a `StreamSender` with the same numbers through a raw socket: how old
each one is when it is received.

One process sends both, at the same rate, half a period apart; one process receives both from one
`select`. So both have the same scheduler, the same pacing by absolute deadlines and the same load,
and the difference is what the stream itself does.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import pin, quantile, start

from petrobot.services.comm.streams.stream import Incoming, StreamReceiver, StreamSender

RATES = (100, 250, 1000)
HOST = "127.0.0.1"
RAW, STREAM = "raw socket", "petrobot stream"
REST = (0.0,) * 7
_RECORD = struct.Struct("9d")
"""Fields of a set point: when it was due, when it was sent, and as many more numbers as a predicted
catching point has."""


def send_both(raw_port: int, stream_port: int, rate: int, seconds: float) -> None:
    """Send set points that say when they were due and when they were sent."""
    sender = StreamSender("bench", "point", 1.0 / rate, HOST, stream_port, receiver="bench")
    while not sender.up:
        sender.advance()
        time.sleep(0.001)
    with socket.create_connection((HOST, raw_port)) as raw:
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        due = time.monotonic()
        for number in range(2 * int(rate * seconds)):
            due += 0.5 / rate
            while (wait := due - time.monotonic()) > 0.0:
                time.sleep(wait)
            if number % 2:
                raw.send(_RECORD.pack(due, time.monotonic(), *REST))
            else:
                sender.send((due, time.monotonic(), *REST))
    sender.close()


class Ages:
    """A sink that records the age of each set point when it is received (s): since it was due, and
    since it was sent."""

    def __init__(self) -> None:
        self.since_due: list[float] = []
        self.since_sent: list[float] = []
        self.over = False

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        now = time.monotonic()
        self.since_due.append(now - values[0])
        self.since_sent.append(now - values[1])

    def withdraw(self) -> None:
        self.over = True


def receive_both(rate: int, seconds: float, pinned: bool) -> dict[str, Ages]:
    """Receive both streams until both have ended."""
    ages = {RAW: Ages(), STREAM: Ages()}
    receiver = StreamReceiver("bench", {"point": Incoming(1.0 / rate, ages[STREAM])})
    with socket.create_server((HOST, 0)) as listener:
        ports = [listener.getsockname()[1], receiver.address[1], rate, seconds]
        process = start(__file__, "--send", json.dumps(ports), pinned=pinned)
        raw: socket.socket | None = None
        while process.poll() is None or not (ages[RAW].over and ages[STREAM].over):
            ready, _, _ = select.select([raw or listener, *receiver.sockets()], [], [], 0.05)
            if raw is not None and raw in ready:
                data = raw.recv(64 * _RECORD.size)
                if data:
                    ages[RAW].take(_RECORD.unpack(data[-_RECORD.size :]))
                else:
                    raw.close()
                    raw = None
                    ages[RAW].over = True
            elif listener in ready:
                raw, _ = listener.accept()
            receiver.poll()
        process.communicate()
    receiver.close()
    return ages


def measure_streams(rounds: int, seconds: float, pinned: bool) -> dict[str, dict[str, float]]:
    """Return ages (us) by rate and sender, and the ratio of their p99 to the raw socket's: over all
    rounds, and the median of each round's."""
    found: dict[str, dict[str, float]] = {}
    for rate in RATES:
        taken = [receive_both(rate, seconds, pinned) for _ in range(rounds)]
        p99 = {way: [quantile(one[way].since_due, 0.99) for one in taken] for way in (RAW, STREAM)}
        for way in (RAW, STREAM):
            due = [age for one in taken for age in one[way].since_due]
            sent = [age for one in taken for age in one[way].since_sent]
            ratios = [its / raw for its, raw in zip(p99[way], p99[RAW], strict=True)]
            all_raw = [age for one in taken for age in one[RAW].since_due]
            found[f"{way}, {rate} Hz"] = {
                "p50_us": quantile(due, 0.5) * 1e6,
                "p99_us": quantile(due, 0.99) * 1e6,
                "way_p99_us": quantile(sent, 0.99) * 1e6,
                "p50_to_raw": quantile(due, 0.5) / quantile(all_raw, 0.5),
                "p99_to_raw": quantile(due, 0.99) / quantile(all_raw, 0.99),
                "round_p99_to_raw": quantile(ratios, 0.5),
            }
    return found


if __name__ == "__main__":
    if sys.argv[-1] == "--pin":
        pin(1)
    send_both(*json.loads(sys.argv[2]))
