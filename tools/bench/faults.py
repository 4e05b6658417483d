"""Measure how long it takes until a lost process is noticed: a node by its caller, the sender of a
set-point stream by its receiver.

    python tools/bench/faults.py                      30 rounds of each
    python tools/bench/faults.py --rounds 5 --json out.json
    python tools/bench/faults.py --busy --alarms 60   both cores busy; also false alarms in 60 s

Each round starts a process, waits until it works, and kills it (kill -9), freezes it (SIGSTOP) or
cuts its cable (no byte arrives, and no end of the connection), or only the direction to it. A node
counts as noticed when the caller gets `PeerLost`, a stream when its receiver withdraws the last
value (in periods of the stream), a run when the caller receives its end: ERROR `lost`, executed =
unknown. Limits: killed node 50 ms, its run 0.3 s; frozen or cut: both 1.2 s; one direction cut: 1.2
s, its run 3.2 s; stream: 3 periods and one pass of the receiver's loop (the longest in these
rounds). A false alarm is a living node that is reported lost:
with `--alarms`, four nodes with one run each are watched for so many seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import platform
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import load, quantile

from petrobot.services.comm.calls.caller import Caller, Notice, PeerLost
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.streams.stream import STALE_AFTER, Incoming, StreamReceiver
from tests.comm.fault_parts import HOST, STREAM, Cable, LinkFault, first_line, inflict, part

KNOWN_WITHIN = {
    LinkFault.KILLED: 0.05,
    LinkFault.FROZEN: 1.2,
    LinkFault.CUT: 1.2,
    LinkFault.DEAF: 1.2,
}
"""Limits (s) until the caller knows of a fault."""
ENDED_WITHIN = {
    LinkFault.KILLED: 0.3,
    LinkFault.FROZEN: 1.2,
    LinkFault.CUT: 1.2,
    LinkFault.DEAF: 3.2,
}
"""Limits (s) until the caller receives the end of the run. A deaf node hangs up, and the caller
tries for 2 s to reach it again (docs/protocol.md)."""
WATCHED = 4
"""Number of living nodes while false alarms are counted."""
PERIODS = (0.004, 0.02, 0.04)
"""Periods of the streams (s): the servo's cycle, and two that a catching cell could use."""
LOOKS = 0.001
"""Seconds between two checks of the stream's receiver."""
LIMIT = 30.0


async def lose_a_node(fault: LinkFault) -> tuple[float, float]:
    """Return the seconds from the fault until the caller knows of it, and until its run has
    ended."""
    told: dict[type[Notice], float] = {}
    changed = asyncio.Event()

    def take(now: float, notices: list[Notice]) -> None:
        told.update({type(one): now for one in notices})
        changed.set()

    async def until(kind: type[Notice]) -> float:
        async with asyncio.timeout(LIMIT):
            while kind not in told:
                changed.clear()
                await changed.wait()
        return told[kind]

    with part("node") as process:
        cable = Cable(int(await asyncio.to_thread(first_line, process)))
        caller = Caller("motion", m.Hello(2, 2, "coordinator", "coord", "c1", 1))
        # A process that is killed is connected directly. Through the simulated cable, the
        # connection would stay open after its death.
        port = cable.far if fault is LinkFault.KILLED else cable.port
        client = Client(HOST, port, caller, on_notices=take)
        client.start()
        if not await client.connected(LIMIT):
            raise TimeoutError("the node does not answer")
        caller.call(client.now(), m.Call("1", "move"))
        client.flush()
        await until(m.Accept)
        began = client.now()
        inflict(fault, process, cable)
        known, ended = await until(PeerLost), await until(m.Outcome)
        await client.close()
        cable.close()
    return known - began, ended - began


async def false_alarms(seconds: float) -> dict[str, int]:
    """Return how often living nodes were reported lost, and how their runs ended meanwhile."""
    lost: list[PeerLost] = []
    ended: list[m.Outcome] = []

    def take(now: float, notices: list[Notice]) -> None:
        lost.extend(one for one in notices if isinstance(one, PeerLost))
        ended.extend(one for one in notices if isinstance(one, m.Outcome))

    with contextlib.ExitStack() as stack:
        clients = []
        for number in range(WATCHED):
            process = stack.enter_context(part("node"))
            port = int(await asyncio.to_thread(first_line, process))
            caller = Caller("motion", m.Hello(2, 2, "coordinator", "coord", f"c{number}", 1))
            clients.append(Client(HOST, port, caller, on_notices=take))
            clients[-1].start()
            if not await clients[-1].connected(LIMIT):
                raise TimeoutError("the node does not answer")
            caller.call(clients[-1].now(), m.Call(str(number), "move"))
            clients[-1].flush()
        await asyncio.sleep(seconds)
        found = {"links lost": len(lost), "runs ended": len(ended)}
        for client in clients:
            await client.close()
    return found


@contextlib.contextmanager
def busy(wanted: bool) -> Iterator[None]:
    """Start two processes for each core that never wait."""
    code = "while True: pass"
    spinning = [
        subprocess.Popen([sys.executable, "-c", code])
        for _ in range(2 * (os.cpu_count() or 1) * wanted)
    ]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


class Last:
    """A sink that knows whether its last value is still valid."""

    def __init__(self) -> None:
        self.count = 0
        self.valid = False

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        self.count += 1
        self.valid = True

    def withdraw(self) -> None:
        self.valid = False


def lose_a_sender(fault: LinkFault, period: float) -> tuple[float, float]:
    """Return the seconds from the fault until the last set point is withdrawn, and the longest time
    between two checks."""
    last = Last()
    receiver = StreamReceiver("motion", {STREAM: Incoming(period, last)})
    cable = Cable(receiver.address[1])

    def look(until_valid: bool, count: int) -> tuple[float, float]:
        longest, before = 0.0, time.monotonic()
        end = before + LIMIT
        while (last.valid is not until_valid) or last.count < count:
            if before > end:
                raise TimeoutError("the stream does not come up, or does not end")
            select.select([], [], [], LOOKS)
            receiver.poll()
            now = time.monotonic()
            longest, before = max(longest, now - before), now
        return before, longest

    with part("sender", str(cable.port), str(period)) as process:
        look(True, 25)
        began = time.monotonic()
        inflict(fault, process, cable)
        over, longest = look(False, 0)
    cable.close()
    receiver.close()
    return over - began, longest


def row(values: Sequence[float], limit: float) -> dict[str, float]:
    """Return the table row of a fault."""
    return {
        "median": quantile(values, 0.5),
        "p99": quantile(values, 0.99),
        "max": max(values),
        "floor": limit,
        "rounds": len(values),
    }


def run(rounds: int, periods: Sequence[float]) -> dict[str, dict[str, float]]:
    """Measure all faults."""
    found = {}
    for fault in LinkFault:
        pairs = [asyncio.run(lose_a_node(fault)) for _ in range(rounds)]
        limit = KNOWN_WITHIN[fault]
        found[f"node {fault.value}: known (ms)"] = row(
            [1e3 * known for known, _ in pairs], 1e3 * limit
        )
        found[f"node {fault.value}: run ended (ms)"] = row(
            [1e3 * ended for _, ended in pairs], 1e3 * ENDED_WITHIN[fault]
        )
    for period in periods:
        for fault in (LinkFault.KILLED, LinkFault.FROZEN, LinkFault.CUT):
            taken = [lose_a_sender(fault, period) for _ in range(rounds)]
            limit = STALE_AFTER + max(longest for _, longest in taken) / period
            name = f"stream of {1e3 * period:g} ms, sender {fault.value} (periods)"
            found[name] = row([over / period for over, _ in taken], limit)
    return found


def main() -> None:
    """Read the options, measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, default=30, help="of each fault (default: %(default)s)"
    )
    parser.add_argument(
        "--busy", action="store_true", help="with two processes a core that never wait"
    )
    parser.add_argument(
        "--alarms",
        type=float,
        default=0.0,
        metavar="S",
        help="count false alarms for so many seconds",
    )
    parser.add_argument("--nodes", action="store_true", help="nodes alone, no streams")
    parser.add_argument("--json", metavar="FILE", help="write the results")
    arguments = parser.parse_args()
    before = load()
    with busy(arguments.busy):
        found = run(arguments.rounds, () if arguments.nodes else PERIODS)
        alarms = asyncio.run(false_alarms(arguments.alarms)) if arguments.alarms else {}
    where: dict[str, Any] = {
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "load_before": before,
        "load_after": load(),
    }
    print(f"{'':48}{'median':>10}{'p99':>10}{'max':>10}{'floor':>10}")
    for name, one in found.items():
        figures = "".join(f"{one[key]:10.2f}" for key in ("median", "p99", "max", "floor"))
        print(f"{name:48}{figures}{'' if one['p99'] <= one['floor'] else '   NOT MET'}")
    print(
        f"{arguments.rounds} of each; load of this machine before: {before}; after: "
        f"{where['load_after']}"
    )
    if alarms:
        print(f"false alarms in {arguments.alarms:g} s with {WATCHED} nodes that live: {alarms}")
    if arguments.json:
        shown = {
            name: {key: (None if math.isinf(v) else v) for key, v in one.items()}
            for name, one in found.items()
        }
        results = {"where": where, "faults": shown, "alarms": alarms}
        Path(arguments.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
