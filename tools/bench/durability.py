"""Measure what the journal costs: a token in, an action started in another process, its result, a
firing, the next start, again and again.

    python tools/bench/durability.py                    run it on the disk where runs/ is
    python tools/bench/durability.py --rounds 5 --json out.json

The contenders alternate within one run: the bare wire (one call after the other), the executor
without a journal, with a journal that is flushed (actions without a device), and with one that is
synced at each start (an action with a device). It also counts syncs per firing, and times a group
of independent starts that share one sync. Only ratios matter: microseconds depend on machine and
disk.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import load, quantile

from petrobot.coordinator.launch import Setting, local_programs, realtime_mission
from petrobot.coordinator.run.interfaces import Forgetful, Store
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.coordinator.task.file import loads
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.protocol.messages import Hello
from tests.ports import free_ports

LINES = 8
"""Number of independent lines of the group task: as many actions start at once."""
SERVICES = """
schema = 1
[nodes.far]
host = "127.0.0.1"
port = {port}
{device}
{actions}
"""
DEVICE = '[devices.hand{n}]\nnode = "far"\ndriver = "tests.chaos.hands:Hand"\n'
ACTION = '[actions.do{n}]\nrun = "tests.chaos.hands:nothing"\ntask = "do{n}"\n{where}\n'
HEAD = """
schema = 1
[task]
name = "bench"
runs_place = "runs"
final = "{final}"
[places.runs]
kind = "control"
tokens = {tokens}
"""
LINE = """
[primitive_tasks.do{n}]
goal = "nothing"
alternatives = ["do{n}"]
deadline = 10.0
[places.free{n}]
kind = "resource"
tokens = 1
[places.do{n}]
kind = "action"
task = "do{n}"
[transitions.go{n}]
in = ["runs", "free{n}"]
out = ["do{n}"]
priority = {n}
[transitions.done{n}]
in = ["do{n}:normal"]
out = ["free{n}"]
[transitions.failed{n}]
in = ["do{n}:error"]
out = ["free{n}"]
"""


def task_text(lines: int, tokens: int) -> str:
    """Return a task in which so many parallel lines use up a place's tokens."""
    final = " and ".join(["runs == 0", *(f"free{n} == 1" for n in range(lines))])
    return HEAD.format(final=final, tokens=tokens) + "".join(LINE.format(n=n) for n in range(lines))


def directory(folder: Path, lines: int, device: bool) -> Directory:
    """Return a cell of one node with an action for each line, each with a device of its own or
    without one."""
    actions = "".join(
        ACTION.format(n=n, where=f'device = "hand{n}"' if device else 'node = "far"')
        for n in range(lines)
    )
    devices = "".join(DEVICE.format(n=n) for n in range(lines)) if device else ""
    text = SERVICES.format(port=free_ports(1)[0], device=devices, actions=actions)
    folder.mkdir()
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return parse(text, path)


class JournalBench:
    """Measures the contenders. `us`: us per token of each round, by contender."""

    def __init__(self, folder: Path, tokens: int) -> None:
        self._folder = folder
        self._tokens = tokens
        self._number = 0
        self.us: dict[str, list[float]] = {}
        self.counts: dict[str, dict[str, float]] = {}

    async def wire(self, places: Directory) -> None:
        """Make the same calls without a coordinator, one after the other."""
        node = places.nodes["far"]
        hello = Hello(2, 99, "coordinator", f"wire{self._number}", "b", 1, places.hash)
        client = Client(node.host, node.port, Caller("far", hello))
        client.start()
        if not await client.connected(10.0):
            raise RuntimeError("the node does not answer")
        begun = time.perf_counter()
        for _ in range(self._tokens):
            outcome = await client.call("do0")
            if outcome.status != "success":
                raise RuntimeError(str(outcome))
        self._keep("bare wire", begun)
        await client.close()

    async def mission(self, name: str, places: Directory, lines: int, journal: bool) -> None:
        """Run the task until its tokens are used up."""
        self._number += 1
        task, identity = loads(task_text(lines, self._tokens), "bench"), f"bench-{self._number}"
        writer = JournalWriter(self._folder / f"{identity}.journal", {}) if journal else None
        loop = asyncio.get_running_loop()
        store: Store = Forgetful() if writer is None else JournalStore(writer, loop.time())
        mission = realtime_mission(places, Setting(task), identity, store)
        shell = RealtimeMission(mission, places)
        try:
            await shell.connect(10.0)
            syncs, begun = writer.syncs if writer else 0, time.perf_counter()
            await shell.run()
            self._keep(name, begun)
        finally:
            await shell.close()
        if any(r.cause for r in mission.tally.runs):
            raise RuntimeError(f"{name}: {mission.tally.runs[0]}")
        if writer is not None:
            used = writer.syncs - syncs
            self.counts[name] = {
                "syncs": used,
                "firings": mission.tally.firings,
                "starts": self._tokens,
            }
            writer.close()

    def _keep(self, name: str, begun: float) -> None:
        self.us.setdefault(name, []).append((time.perf_counter() - begun) / self._tokens * 1e6)


async def measure(folder: Path, rounds: int, tokens: int) -> JournalBench:
    """Measure all contenders in turn, so that other load on the machine affects them all."""
    bench = JournalBench(folder, tokens)
    plain, held, group = (
        directory(folder / "a", 1, False),
        directory(folder / "b", 1, True),
        directory(folder / "c", LINES, True),
    )
    turns: list[Callable[[], Awaitable[None]]] = [
        lambda: bench.wire(plain),
        lambda: bench.mission("no journal", plain, 1, False),
        lambda: bench.mission("journal, no device", plain, 1, True),
        lambda: bench.mission("no journal, device", held, 1, False),
        lambda: bench.mission("journal, device", held, 1, True),
        lambda: bench.mission(f"no journal, {LINES} devices", group, LINES, False),
        lambda: bench.mission(f"journal, {LINES} devices", group, LINES, True),
    ]
    programs = [
        program.__class__(f"{program.name} {n}", program.command)
        for n, places in enumerate((plain, held, group))
        for program in local_programs(places)
    ]
    async with Supervisor(programs, folder / "logs"):
        for _ in range(rounds + 1):
            for turn in turns:
                await turn()
    for values in bench.us.values():
        del values[0]  # the first round only warms up
    return bench


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="on the disk to measure (default: here)"
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--tokens", type=int, default=200)
    parser.add_argument("--json", metavar="FILE", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        bench = asyncio.run(measure(Path(folder).resolve(), options.rounds, options.tokens))
    base = statistics.median(bench.us["bare wire"])
    print(f"{options.rounds} rounds of {options.tokens} tokens; load {load()}")
    print(
        f"{'us per token':28}{'median':>10}{'best':>10}{'worst':>10}{'x wire':>8}"
        f"{'syncs/firing':>14}"
    )
    rows: dict[str, Any] = {}
    for name, values in bench.us.items():
        counts = bench.counts.get(name, {})
        per = counts["syncs"] / counts["firings"] if counts else 0.0
        rows[name] = {
            "us": values,
            "ratio": statistics.median(values) / base,
            "syncs_per_firing": per,
            **counts,
        }
        middle, low, high = statistics.median(values), min(values), quantile(values, 1.0)
        print(f"{name:28}{middle:10.0f}{low:10.0f}{high:10.0f}{middle / base:8.1f}{per:14.3f}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
