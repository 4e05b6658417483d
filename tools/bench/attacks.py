"""Measure what attacks cost a node: its memory, and how long the calls of an honest client take
meanwhile.

    python tools/bench/attacks.py
    python tools/bench/attacks.py --json out.json

The server is a process of its own; the attackers are other processes (for connections) or this one.
*Grown*: the increase of the server's largest resident set (VmHWM) since its start. The honest
client calls every millisecond from this process. This process also attacks, so the times are upper
bounds; only the ratios to the row without an attack matter.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import quantile

from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.tls.certificates import make_certificates
from tests.security.conftest import KEY, MIB, Stranger, Victim, frame
from tests.security.test_attacks import STRANGE, _bombard, _flood, crowd_at

CROWD = 10_000
LEAST = 200
"""Fewest calls of the honest client in each row, however short the attack is."""
Attack = Callable[[Victim], contextlib.AbstractAsyncContextManager[None]]


async def times(client: Client, until: Callable[[int], bool]) -> list[float]:
    """Measure how long calls take, one each millisecond (s)."""
    took: list[float] = []
    while not until(len(took)):
        begun = time.monotonic()
        outcome = await client.call("echo", {"n": len(took)})
        if outcome.status != "success":
            raise RuntimeError(f"the honest client was not served: {outcome}")
        took.append(time.monotonic() - begun)
        await asyncio.sleep(0.001)
    return took


HEAVY = """
import asyncio, sys
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.protocol.wire import NEWEST_VERSION as V

PAYLOADS = [
    [[]] * 19_900, [{}] * 19_900, [[None] * 5] * 19_900, [None] * 130_000, [1.5] * 110_000,
    ["x"] * 130_000,
    bytes(1_900_000), "x" * 1_900_000, {str(n): n for n in range(21_000)}, [[None] * 40] * 99_000,
]

async def main():
    caller = Caller("vision", m.Hello(V, V, "client", "heavy", "h1"), auto_ack=True)
    client = Client(sys.argv[1], int(sys.argv[2]), caller, key=bytes.fromhex(sys.argv[3]))
    client.start()
    assert await client.connected(20.0)
    print("ready", flush=True)
    for _ in range(3):
        for payload in PAYLOADS:
            two = (client.call("echo", {"v": payload}) for _ in range(2))
            outcomes = await asyncio.gather(*two)
            print(len(str(payload)[:9]), outcomes[0].status, outcomes[0].cause, flush=True)
    await client.close()

asyncio.run(main())
"""


@contextlib.asynccontextmanager
async def heavy(server: Victim) -> AsyncIterator[None]:
    """A caller with the key sends the messages that take longest to read, two at a time, from a
    process of its own."""
    command = [sys.executable, "-c", HEAVY, server.host, str(server.port), KEY.hex()]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    process = await asyncio.create_subprocess_exec(
        *command, env=environment, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    await process.stdout.readline()
    yield
    await process.communicate()
    if process.returncode:
        raise RuntimeError("the heavy caller failed")


@contextlib.asynccontextmanager
async def nothing(server: Victim) -> AsyncIterator[None]:
    """No attack."""
    done = asyncio.create_task(asyncio.sleep(2.0))
    yield
    await done


@contextlib.asynccontextmanager
async def connections(server: Victim) -> AsyncIterator[None]:
    """Another process opens ten thousand connections."""
    async with crowd_at(server, CROWD) as crowd:
        opened = asyncio.create_task(asyncio.to_thread(crowd.stdout.readline))
        yield
        await opened


@contextlib.asynccontextmanager
async def noise(server: Victim) -> AsyncIterator[None]:
    """A thousand connections send random bytes."""
    done = asyncio.gather(*(_bombard(server, lambda n: n >= 250, seed) for seed in range(4)))
    yield
    await done


@contextlib.asynccontextmanager
async def flood(server: Victim) -> AsyncIterator[None]:
    """One caller sends heartbeats as fast as it can."""
    stranger = await Stranger.at(server)
    await stranger.open(None, STRANGE)
    burst = b"".join(frame(m.Ping(n)) for n in range(4_000))
    done = asyncio.create_task(_flood(stranger, burst))
    yield
    done.cancel()
    await asyncio.gather(done, return_exceptions=True)
    stranger.writer.transport.abort()


async def under(attack: Attack, server: Victim) -> dict[str, Any]:
    """Measure one row: the honest client's calls under one attack."""
    client = server.client()
    client.start()
    assert await client.connected(20.0)
    over = asyncio.Event()
    async with attack(server):
        calls = asyncio.create_task(times(client, lambda n: over.is_set() and n >= LEAST))
    over.set()
    took = await calls
    await client.close()
    return {
        "calls": len(took),
        "p50_ms": round(1e3 * quantile(took, 0.5), 2),
        "p99_ms": round(1e3 * quantile(took, 0.99), 2),
        "max_ms": round(1e3 * max(took), 1),
        "grown_MiB": round(server.grown() / MIB, 1),
        "faults": server.about()["faults"],
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the figures as JSON")
    parser.add_argument("--only", metavar="TEXT", default="", help="rows whose name has this text")
    options = parser.parse_args()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        make_certificates(Path(folder), ["coordinator", "vision"])
        cases: list[tuple[str, Attack, dict[str, Any]]] = [
            ("calm", nothing, {}),
            ("10,000 connections", connections, {}),
            ("10,000, shared key", connections, {"key": KEY.hex()}),
            ("10,000, TLS", connections, {"folder": folder}),
            ("random bytes", noise, {}),
            ("flood of heartbeats", flood, {}),
            ("heavy calls, shared key", heavy, {"key": KEY.hex()}),
        ]
        for name, attack, settings in [case for case in cases if options.only in case[0]]:
            server = Victim(settings)
            try:
                rows[name] = asyncio.run(under(attack, server))
            finally:
                server.close()
            row = rows[name]
            print(
                f"{name:22} calls {row['calls']:5}  p50 {row['p50_ms']:7.2f} ms  p99 "
                f"{row['p99_ms']:8.2f}"
                f"  max {row['max_ms']:8.1f}  grown {row['grown_MiB']:5.1f} MiB"
            )
    print(f"load {os.getloadavg()[0]:.1f}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
