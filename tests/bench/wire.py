"""Speed of the wire beside others, in one run: call round trip, calls per second, 100 kB, set-point streams.

    python tests/bench/wire.py                       # all that is installed
    python tests/bench/wire.py --quick --json out.json

Contenders take turns every few calls, so that a busy machine is busy for all. Each server is a process of its own; with
`--pin` (the default where it is permitted) both ends are SCHED_FIFO on different cores. Ratios are what counts:
microseconds are this machine's.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from services.comm.stream import Incoming, StreamReceiver, StreamSender
from tests.bench.wire_contenders import HOST, Bare, Contender, Petrobot, PetrobotSealed
from tests.bench.wire_peers import CONTENDERS

RATES = (100, 250, 1000)
IN_FLIGHT = 64
BIG = 100_000
GAP = 0.001
"""Seconds between spaced calls: the other end sleeps by then."""
ROWS = ("call", "spaced", "round p50", "spaced p50", "big", "rate")
TURN = 20
"""Calls of one contender before the next has its turn."""
RAW, STREAM = "raw socket", "petrobot stream"


def pin(core: int) -> bool:
    """Put this process on one core, ahead of ordinary processes. False where that is not permitted."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return False
    try:
        os.sched_setaffinity(0, {cores[core]})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except PermissionError:
        return False
    return True


def quantile(values: Sequence[float], q: float) -> float:
    """The q-quantile of what was measured."""
    ordered = sorted(values)
    return ordered[min(int(q * len(ordered)), len(ordered) - 1)]


def start(*arguments: str, pinned: bool) -> subprocess.Popen[str]:
    """This script again, in another part."""
    command = [sys.executable, __file__, *arguments, *(["--pin"] if pinned else ["--no-pin"])]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


class Table:
    """What was measured, by contender."""

    def __init__(self, contenders: Sequence[type[Contender]], pinned: bool) -> None:
        self.rows: dict[str, dict[str, list[float]]] = {}
        self._contenders = [one() for one in contenders]
        self._processes = [start("--serve", one.name, pinned=pinned) for one in self._contenders]
        for one, process in zip(self._contenders, self._processes, strict=True):
            assert process.stdout is not None
            one.connect(int(process.stdout.readline()))
            one.latencies(200, 0)

    def measure(self, rounds: int, calls: int) -> None:
        """Rounds of all; within a round they take turns every few calls, so that the machine is in one mood for all."""
        for number in range(rounds):
            taken = self._take_turns(calls, 0.0)
            spaced = self._take_turns(calls // 4, GAP)
            for one in self._contenders:
                row = self.rows.setdefault(one.name, {name: [] for name in ROWS})
                row["call"] += taken[one.name]
                row["spaced"] += spaced[one.name]
                row["round p50"].append(quantile(taken[one.name], 0.5))
                row["spaced p50"].append(quantile(spaced[one.name], 0.5))
                row["big"] += one.latencies(max(calls // 20, 20), BIG)
                row["rate"].append(one.rate(max(calls // IN_FLIGHT, 4) * IN_FLIGHT, IN_FLIGHT))
            print(f"round {number + 1} of {rounds} done", file=sys.stderr)

    def _take_turns(self, calls: int, gap: float) -> dict[str, list[float]]:
        taken: dict[str, list[float]] = {one.name: [] for one in self._contenders}
        for _ in range(max(calls // TURN, 1)):
            for one in self._contenders:
                taken[one.name] += one.latencies(TURN, 0, gap)
        return taken

    def close(self) -> None:
        """End all servers."""
        for one, process in zip(self._contenders, self._processes, strict=True):
            one.close()
            process.kill()
            process.communicate()

    def results(self) -> dict[str, dict[str, float]]:
        """Microseconds and calls per second, and their ratios to the bare echo's (median over rounds)."""
        bare = self.rows[Bare.name]
        found = {}
        for name, row in self.rows.items():
            ratio, spaced = (
                quantile([own / its for own, its in zip(row[p50], bare[p50], strict=True)], 0.5)
                for p50 in ("round p50", "spaced p50")
            )
            found[name] = {
                "p50_us": quantile(row["call"], 0.5) * 1e6,
                "p99_us": quantile(row["call"], 0.99) * 1e6,
                "to_bare": ratio,
                "spaced_p50_us": quantile(row["spaced"], 0.5) * 1e6,
                "spaced_to_bare": spaced,
                "big_p50_us": quantile(row["big"], 0.5) * 1e6,
                "calls_per_s": quantile(row["rate"], 0.5),
            }
        return found


def send_for_ever(port: int, rate: int, seconds: float, how: str) -> None:
    """Send set points that say when they were sent, at absolute deadlines."""
    send, close = _stream_sender(port, rate) if how == STREAM else _raw_sender(port)
    due = time.monotonic()
    for _ in range(int(rate * seconds)):
        due += 1.0 / rate
        while (wait := due - time.monotonic()) > 0.0:
            time.sleep(wait)
        send(due)
    close()


def _stream_sender(port: int, rate: int) -> tuple[Callable[[float], object], Callable[[], None]]:
    sender = StreamSender("bench", "point", 1.0 / rate, HOST, port)
    while not sender.up:
        sender.advance()
        time.sleep(0.001)
    rest = (0.0,) * 7
    return lambda due: sender.send((due, time.monotonic(), *rest)), sender.close


def _raw_sender(port: int) -> tuple[Callable[[float], object], Callable[[], None]]:
    sock = socket.create_connection((HOST, port))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return lambda due: sock.send(struct.pack("9d", due, time.monotonic(), *(0.0,) * 7)), sock.close


class _Clock:
    """A sink that writes down how old each set point is when it is taken: since it was due, and since it was sent."""

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


def measure_stream(how: str, rate: int, seconds: float, pinned: bool) -> _Clock:
    """Receive a stream in this process, sent by another."""
    sink = _Clock()
    receive = _receive_stream if how == STREAM else _receive_raw
    receive(sink, rate, seconds, pinned)
    return sink


def _receive_stream(sink: _Clock, rate: int, seconds: float, pinned: bool) -> None:
    # A stall of this machine must not end the measurement: the sink alone says when the stream is over.
    receiver = StreamReceiver("bench", {"point": Incoming(1.0 / rate, sink)})
    process = start("--send", how_to(STREAM, receiver.address[1], rate, seconds), pinned=pinned)
    while process.poll() is None or not sink.over:
        ready, _, _ = select.select(receiver.sockets(), [], [], 0.05)
        if ready:
            receiver.poll()
        elif process.poll() is not None:
            break
    process.communicate()
    receiver.close()


def _receive_raw(sink: _Clock, rate: int, seconds: float, pinned: bool) -> None:
    with socket.create_server((HOST, 0)) as listener:
        process = start("--send", how_to(RAW, listener.getsockname()[1], rate, seconds), pinned=pinned)
        sock, _ = listener.accept()
        with sock:
            while data := sock.recv(72 * 64):
                sink.take(struct.unpack("9d", data[-72:]))
        process.communicate()


def how_to(how: str, port: int, rate: int, seconds: float) -> str:
    """What a sender's process has to know."""
    return json.dumps([port, rate, seconds, how])


def measure_streams(rounds: int, seconds: float, pinned: bool) -> dict[str, dict[str, float]]:
    """Ages (us) when taken, by rate and way, and the ratio to the raw socket."""
    found: dict[str, dict[str, float]] = {}
    for rate in RATES:
        ages: dict[str, list[float]] = {RAW: [], STREAM: []}
        sent: dict[str, list[float]] = {RAW: [], STREAM: []}
        for _ in range(rounds):
            for how in ages:
                sink = measure_stream(how, rate, seconds, pinned)
                ages[how] += sink.since_due
                sent[how] += sink.since_sent
        for how in ages:
            found[f"{how}, {rate} Hz"] = {
                "p50_us": quantile(ages[how], 0.5) * 1e6,
                "p99_us": quantile(ages[how], 0.99) * 1e6,
                "way_p99_us": quantile(sent[how], 0.99) * 1e6,
                "p99_to_raw": quantile(ages[how], 0.99) / quantile(ages[RAW], 0.99),
            }
    return found


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print a table."""
    columns = list(next(iter(rows.values())))
    print(f"\n{title:28}" + "".join(f"{column:>15}" for column in columns))
    for name, row in rows.items():
        print(f"{name:28}" + "".join(f"{row[column]:15,.2f}" for column in columns))


def verdicts(calls: dict[str, dict[str, float]]) -> dict[str, Any]:
    """The goals, and whether this run met them."""
    ours, sealed = calls[Petrobot.name], calls[PetrobotSealed.name]
    goals: dict[str, Any] = {
        "p50 <= 1.6 x bare echo": ours["to_bare"],
        "p50 <= 1.6 x bare echo, spaced calls": ours["spaced_to_bare"],
        "p50 <= 2.0 x bare echo with MAC": sealed["to_bare"],
        "p50 <= 2.0 x bare echo with MAC, spaced": sealed["spaced_to_bare"],
    }
    for peer in ("Pyro5", "RPyC"):
        if peer in calls:
            goals[f"calls/s >= 3 x {peer}"] = ours["calls_per_s"] / calls[peer]["calls_per_s"]
    return goals


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """All measurements."""
    installed = [one for one in CONTENDERS if not one.needs or importlib.util.find_spec(one.needs) is not None]
    missing = [one.name for one in CONTENDERS if one not in installed]
    pinned = arguments.pin and pin(0)
    table = Table(installed, pinned)
    try:
        table.measure(arguments.rounds, arguments.calls)
    finally:
        table.close()
    calls = table.results()
    streams = measure_streams(max(arguments.rounds // 3, 1), arguments.seconds, pinned)
    where = {"python": platform.python_version(), "cores": os.cpu_count(), "pinned": pinned, "missing": missing}
    show("calls", calls)
    show("streams (age when taken)", streams)
    goals = verdicts(calls)
    print()
    for goal, value in goals.items():
        print(f"{goal:40} {value:8.2f}")
    print(f"pinned to two cores: {pinned}; not installed: {', '.join(missing) or 'none'}")
    return {"where": where, "calls": calls, "streams": streams, "goals": goals}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9, help="interleaved rounds")
    parser.add_argument("--calls", type=int, default=2000, help="calls of each contender in a round")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of each stream")
    parser.add_argument("--quick", action="store_true", help="3 rounds of 500 calls, streams of 1 s")
    parser.add_argument("--json", metavar="FILE", help="write the results")
    parser.add_argument(
        "--pin", action=argparse.BooleanOptionalAction, default=True, help="SCHED_FIFO, a core each end"
    )
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--send", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve or arguments.send:
        if arguments.pin:
            pin(1)
        if arguments.serve:
            next(one for one in CONTENDERS if one.name == arguments.serve)().serve()
        else:
            send_for_ever(*json.loads(arguments.send))
        return
    if arguments.quick:
        arguments.rounds, arguments.calls, arguments.seconds = 3, 500, 1.0
    results = run(arguments)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
