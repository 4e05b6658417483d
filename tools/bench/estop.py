"""Measure how long an emergency stop takes: from the order to the quick stop on the drives' bus,
and for the whole command.

    python tools/bench/estop.py                     200 stops over an open connection, 20 commands
    python tools/bench/estop.py --stops 50 --json out.json

The simulated drives, the motion node and this bench are processes of their own, as in the cell.
*Warm*: the client is already connected, as the coordinator and the page's server are; the time is
from the order until a port on the bus receives the first controlword QUICK STOP. *Command*:
`petrobot estop` from the start of its process, including Python and its imports. Before each stop
an action enables the drives again. The bus has cycles of 4 ms, which cost 2 ms on average.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import quantile

from petrobot.coordinator.launch import local_programs
from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, EmergencyLine
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.canopen.cia402 import DriveState
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import Hello
from petrobot.services.comm.tls.credentials import Credentials
from tests.security.arm_cell import ROOT, Ear, cell_in, ear_on

FLOOR_MS = 20.0
"""Limit of the 99th percentile of a warm stop on an idle machine (ms)."""
PATIENCE = 30.0


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Return p50, p99 and the largest value (ms)."""
    shown = {
        "p50_ms": quantile(seconds, 0.5),
        "p99_ms": quantile(seconds, 0.99),
        "max_ms": max(seconds),
    }
    return {"n": len(seconds), **{name: round(1e3 * value, 2) for name, value in shown.items()}}


async def enabled(client: Client, ear: Ear) -> None:
    """Enable the drives again, until they follow set points."""
    outcome = await asyncio.wait_for(client.call("ready", deadline=PATIENCE), PATIENCE)
    if outcome.status != "success":
        raise RuntimeError(f"the drives are not ready: {outcome.cause}: {outcome.text}")
    await asyncio.to_thread(ear.until, lambda e: e.all_in(DriveState.OPERATION_ENABLED), PATIENCE)


async def warm(line: EmergencyLine, client: Client, ear: Ear, stops: int) -> list[float]:
    """Time stops over a connection that is already open."""
    took = []
    for _ in range(stops):
        await line.order(CLEAR, PATIENCE)
        await enabled(client, ear)
        ear.forget()
        begun = time.monotonic()
        await line.order(STOP, PATIENCE)
        await asyncio.to_thread(ear.until, lambda e: e.quick_stop_at is not None, PATIENCE)
        assert ear.quick_stop_at is not None
        took.append(ear.quick_stop_at - begun)
    return took


async def commands(
    directory: Directory, line: EmergencyLine, client: Client, ear: Ear, stops: int
) -> list[float]:
    """Time stops by the whole command."""
    took = []
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "estop",
        "--services",
        str(directory.source),
    ]
    for _ in range(stops):
        await line.order(CLEAR, PATIENCE)
        await enabled(client, ear)
        ear.forget()
        begun = time.monotonic()
        process = subprocess.Popen(
            [*command, "--journal", str(directory.source.parent)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
        )
        await asyncio.to_thread(ear.until, lambda e: e.quick_stop_at is not None, PATIENCE)
        assert ear.quick_stop_at is not None
        took.append(ear.quick_stop_at - begun)
        await asyncio.to_thread(process.wait)
    return took


async def measure(folder: Path, stops: int, whole: int) -> dict[str, Any]:
    """Measure all figures."""
    directory = cell_in(folder)
    name = secrets.token_hex(4)
    hello = Hello(2, 2, "coordinator", "coordinator", name, 1, directory.hash)
    async with Supervisor(local_programs(directory), folder / "logs", respawn=False):
        with ear_on(directory) as ear:
            line = EmergencyLine(directory, "motion", Credentials())
            client = Client(*directory.address("motion"), Caller("motion", hello, auto_ack=True))
            client.start()
            assert await line.connect(PATIENCE) and await client.connected(PATIENCE)
            before = os.getloadavg()[0]
            figures = {
                "warm": summary(await warm(line, client, ear, stops)),
                "command": summary(await commands(directory, line, client, ear, whole)),
                "load": [round(before, 1), round(os.getloadavg()[0], 1)],
                "cores": len(os.sched_getaffinity(0)),
                "machine": platform.machine(),
            }
            await line.close()
            await client.close()
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stops", type=int, default=200, help="warm stops (default: %(default)s)")
    parser.add_argument(
        "--commands", type=int, default=20, help="whole commands (default: %(default)s)"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the figures as JSON")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = asyncio.run(measure(Path(folder), options.stops, options.commands))
    for what in ("warm", "command"):
        row = figures[what]
        print(
            f"{what:8} n {row['n']:4}  p50 {row['p50_ms']:7.2f} ms  p99 {row['p99_ms']:7.2f} "
            f" max {row['max_ms']:7.2f}"
        )
    kept = "kept" if figures["warm"]["p99_ms"] < FLOOR_MS else "NOT KEPT"
    print(
        f"floor of {FLOOR_MS:g} ms at p99, warm, on an idle machine: {kept} (load "
        f"{figures['load'][0]:g})"
    )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
