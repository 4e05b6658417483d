"""Speed of the wire beside others, in one run: call round trip, calls per second, 100 kB, set-point streams.

    python tests/bench/wire.py                       # all that is installed
    python tests/bench/wire.py --quick --json out.json

Contenders take turns every few calls, so that a busy machine is busy for all. Each server is a process of its own; with
`--pin` (the default where it is permitted) both ends are SCHED_FIFO on different cores. Ratios are what counts:
microseconds are this machine's.
"""

from __future__ import annotations

import argparse
import gc
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.bench.processes import load, pin, quantile, show, start
from tests.bench.wire_contenders import Bare, Contender, Petrobot, PetrobotSealed
from tests.bench.wire_peers import CONTENDERS
from tests.bench.wire_streams import measure_streams

IN_FLIGHT = 64
LEAST = 50
"""Calls of each of those in flight, at least, when calls per second are counted: a start must not weigh."""
BIG = 100_000
GAP = 0.001
"""Seconds between spaced calls: the other end sleeps by then."""
ROWS = ("call", "spaced", "round p50", "spaced p50", "big", "rate")
TURN = 20
"""Calls of one contender before the next has its turn."""
NOISE = 1.15
"""Ratios nearer to 1 than this say nothing on a machine that does other things too."""
PEERS = ("Pyro5", "RPyC", "pyzmq", "grpc.aio")


class Table:
    """What was measured, by contender."""

    def __init__(self, contenders: Sequence[type[Contender]], pinned: bool) -> None:
        self.rows: dict[str, dict[str, list[float]]] = {}
        self._contenders = [one() for one in contenders]
        self._processes = [start(__file__, "--serve", one.name, pinned=pinned) for one in self._contenders]
        for one, process in zip(self._contenders, self._processes, strict=True):
            assert process.stdout is not None
            one.connect(int(process.stdout.readline()))
            one.latencies(200, 0)
        gc.collect()
        gc.freeze()  # what all of them have imported is no garbage of the one that is being measured

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
                row["rate"].append(one.rate(max(calls // IN_FLIGHT, LEAST) * IN_FLIGHT, IN_FLIGHT))
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
        """Microseconds and calls per second, and their ratios to the bare echo's (median, least and largest of the rounds)."""
        found = {}
        for name, row in self.rows.items():
            ratios = self.ratios(name, Bare.name, "round p50")
            found[name] = {
                "p50_us": quantile(row["call"], 0.5) * 1e6,
                "p99_us": quantile(row["call"], 0.99) * 1e6,
                "to_bare": quantile(ratios, 0.5),
                "least": min(ratios),
                "largest": max(ratios),
                "spaced_p50_us": quantile(row["spaced"], 0.5) * 1e6,
                "spaced_to_bare": quantile(self.ratios(name, Bare.name, "spaced p50"), 0.5),
                "big_p50_us": quantile(row["big"], 0.5) * 1e6,
                "calls_per_s": quantile(row["rate"], 0.5),
            }
        return found

    def ratios(self, name: str, to: str, what: str) -> list[float]:
        """Of each round: one contender's figure as a multiple of another's."""
        return [own / its for own, its in zip(self.rows[name][what], self.rows[to][what], strict=True)]


def verdicts(table: Table, streams: dict[str, dict[str, float]]) -> dict[str, tuple[list[float], float, bool]]:
    """The goals: what the rounds gave, the limit, and whether their median keeps to it."""
    ours, sealed, bare = Petrobot.name, PetrobotSealed.name, Bare.name
    wanted: list[tuple[str, list[float], float, bool]] = []
    for what, column in (("calls in a row", "round p50"), ("spaced calls", "spaced p50")):
        wanted.append((f"p50 <= 1.6 x bare echo, {what}", table.ratios(ours, bare, column), 1.6, True))
        wanted.append((f"p50 <= 2.0 x bare echo with MAC, {what}", table.ratios(sealed, bare, column), 2.0, True))
        for peer in PEERS:
            if peer in table.rows:
                wanted.append((f"p50 not above {peer}'s, {what}", table.ratios(ours, peer, column), NOISE, True))
    for peer in ("Pyro5", "RPyC"):
        if peer in table.rows:
            wanted.append((f"calls/s >= 3 x {peer}'s", table.ratios(ours, peer, "rate"), 3.0, False))
    for name, row in streams.items():
        if name.startswith("petrobot"):
            wanted.append((f"p99 <= 2 x raw, {name}", [row["p99_to_raw"], row["round_p99_to_raw"]], 2.0, True))
    return {
        goal: (found, limit, quantile(found, 0.5) <= limit if below else quantile(found, 0.5) >= limit)
        for goal, found, limit, below in wanted
    }


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """All measurements."""
    installed = [one for one in CONTENDERS if not one.needs or importlib.util.find_spec(one.needs) is not None]
    missing = [one.name for one in CONTENDERS if one not in installed]
    pinned = arguments.pin and pin(0)
    where: dict[str, Any] = {"python": platform.python_version(), "cores": os.cpu_count(), "load_before": load()}
    table = Table(installed, pinned)
    try:
        table.measure(arguments.rounds, arguments.calls)
    finally:
        table.close()
    calls = table.results()
    streams = measure_streams(max(arguments.rounds // 3, 1), arguments.seconds, pinned)
    where |= {"load_after": load(), "pinned": pinned, "missing": missing}
    show("calls", calls)
    show("streams (age when taken)", streams)
    goals = verdicts(table, streams)
    print(f"\n{'goal (median, least and largest of the rounds)':52}{'limit':>7}{'median':>8}{'least':>8}{'largest':>8}")
    for goal, (found, limit, met) in goals.items():
        row = "".join(f"{one:8.2f}" for one in (quantile(found, 0.5), min(found), max(found)))
        print(f"{goal:52}{limit:7.2f}{row}  {'met' if met else 'NOT MET'}")
    print(f"two cores, a process each end, ahead of others: {pinned}; not installed: {', '.join(missing) or 'none'}")
    print(f"load of this machine before: {where['load_before']}; after: {where['load_after']}")
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
    arguments = parser.parse_args()
    if arguments.serve:
        if arguments.pin:
            pin(1)
        next(one for one in CONTENDERS if one.name == arguments.serve)().serve()
        return
    if arguments.quick:
        arguments.rounds, arguments.calls, arguments.seconds = 3, 500, 1.0
    results = run(arguments)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
