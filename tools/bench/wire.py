"""Compare the speed of the wire with other libraries in one run: round trip of a call, calls per
second, 100 kB, set-point streams.

    python tools/bench/wire.py                      everything that is installed
    python tools/bench/wire.py --quick --json out.json

The contenders alternate every few calls, so that a busy machine affects all of them. Each end is a
process of its own. Everything is measured three times: with both ends SCHED_FIFO on different cores
(where that is permitted), as ordinary processes that share one core, and as the scheduler decides.
The first two show the cost of the code. In the third, the scheduler may keep both ends of one
contender on one core and those of another on two, where each message has to wake the other end.
Only ratios matter: microseconds depend on the machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.bench.processes import load, pin, quantile, share, show, unpin
from tools.bench.wire_asker import Asker, ask
from tools.bench.wire_contenders import Bare, Contender, Petrobot, PetrobotSealed
from tools.bench.wire_peers import CONTENDERS
from tools.bench.wire_streams import measure_streams

IN_FLIGHT = 64
LEAST = 50
"""Calls of each of those in flight, at least, when calls per second are counted: a start must not
weigh."""
BIG = 100_000
GAP = 0.001
"""Seconds between spaced calls: the other end sleeps by then."""
ROWS = ("call", "spaced", "round p50", "spaced p50", "big", "rate")
TURN = 20
"""Calls of one contender before the next has its turn."""
NOISE = 1.15
"""Ratios nearer to 1 than this say nothing on a machine that does other things too."""
PEERS = ("Pyro5", "RPyC", "pyzmq", "grpc.aio")
PINNED, SHARED, ORDINARY = "a core each end", "one core for both ends", "as the scheduler likes it"
"""How the two ends are scheduled."""


class ResultTable:
    """What was measured, by contender."""

    def __init__(self, contenders: Sequence[type[Contender]], pinned: bool) -> None:
        self.rows: dict[str, dict[str, list[float]]] = {}
        self._askers = {one.name: Asker(__file__, one.name, pinned) for one in contenders}

    def measure(self, rounds: int, calls: int) -> None:
        """Rounds of all; within a round they take turns every few calls, so that the machine is in
        one mood for all."""
        for number in range(rounds):
            taken = self._take_turns(calls, 0.0)
            spaced = self._take_turns(calls // 4, GAP)
            for name, one in self._askers.items():
                row = self.rows.setdefault(name, {column: [] for column in ROWS})
                row["call"] += taken[name]
                row["spaced"] += spaced[name]
                row["round p50"].append(quantile(taken[name], 0.5))
                row["spaced p50"].append(quantile(spaced[name], 0.5))
                row["big"] += one.latencies(max(calls // 20, 20), BIG)
                row["rate"].append(one.rate(max(calls // IN_FLIGHT, LEAST) * IN_FLIGHT, IN_FLIGHT))
            print(f"round {number + 1} of {rounds} done", file=sys.stderr)

    def _take_turns(self, calls: int, gap: float) -> dict[str, list[float]]:
        taken: dict[str, list[float]] = {name: [] for name in self._askers}
        for _ in range(max(calls // TURN, 1)):
            for name, one in self._askers.items():
                taken[name] += one.latencies(TURN, 0, gap)
        return taken

    def close(self) -> None:
        """End all processes."""
        for one in self._askers.values():
            one.close()

    def results(self) -> dict[str, dict[str, float]]:
        """Microseconds and calls per second, and their ratios to the bare echo's (median, least and
        largest of the rounds)."""
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
        return [
            own / its for own, its in zip(self.rows[name][what], self.rows[to][what], strict=True)
        ]


Goals = dict[str, tuple[list[float], float, bool]]
"""By goal: what the rounds gave, the limit, and whether their median keeps to it."""


def call_goals(table: ResultTable) -> Goals:
    """The goals of calls."""
    ours, sealed, bare = Petrobot.name, PetrobotSealed.name, Bare.name
    goals: Goals = {}
    for what, column in (("calls in a row", "round p50"), ("spaced calls", "spaced p50")):
        goals[f"p50 <= 1.6 x bare echo, {what}"] = _below(table.ratios(ours, bare, column), 1.6)
        goals[f"p50 <= 2.0 x bare echo with MAC, {what}"] = _below(
            table.ratios(sealed, bare, column), 2.0
        )
        for peer in PEERS:
            if peer in table.rows:
                goals[f"p50 not above {peer}'s, {what}"] = _below(
                    table.ratios(ours, peer, column), NOISE
                )
    for peer in ("Pyro5", "RPyC"):
        if peer in table.rows:
            rates = table.ratios(ours, peer, "rate")
            goals[f"calls/s >= 3 x {peer}'s"] = rates, 3.0, quantile(rates, 0.5) >= 3.0
    return goals


def stream_goals(streams: dict[str, dict[str, float]]) -> Goals:
    """The goals of set-point streams."""
    return {
        f"p99 <= 2 x raw, {name}": _below([row["p99_to_raw"], row["round_p99_to_raw"]], 2.0)
        for name, row in streams.items()
        if name.startswith("petrobot")
    }


def _below(found: list[float], limit: float) -> tuple[list[float], float, bool]:
    return found, limit, quantile(found, 0.5) <= limit


def scheduled(how: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """All measurements with one way of scheduling."""
    pinned = how == PINNED
    table = ResultTable([one for one in CONTENDERS if _is_installed(one)], pinned)
    try:
        table.measure(arguments.rounds, arguments.calls)
    finally:
        table.close()
    calls = table.results()
    streams = measure_streams(max(arguments.rounds // 3, 1), arguments.seconds, pinned)
    goals = call_goals(table) | stream_goals(streams)
    print(f"\n== {how} ==")
    show("calls", calls)
    show("streams (age when taken)", streams)
    print(
        f"\n{'goal (median, least and largest of the rounds)':52}{'limit':>7}{'median':>8}"
        f"{'least':>8}{'largest':>8}"
    )
    for goal, (found, limit, met) in goals.items():
        row = "".join(f"{one:8.2f}" for one in (quantile(found, 0.5), min(found), max(found)))
        print(f"{goal:52}{limit:7.2f}{row}  {'met' if met else 'NOT MET'}")
    return {"calls": calls, "streams": streams, "goals": goals}


def _is_installed(one: type[Contender]) -> bool:
    return not one.needs or importlib.util.find_spec(one.needs) is not None


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """All measurements, in every way of scheduling that is permitted."""
    missing = [one.name for one in CONTENDERS if not _is_installed(one)]
    where: dict[str, Any] = {
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "load_before": load(),
    }
    where["missing"] = missing
    results: dict[str, Any] = {"where": where}
    if arguments.pin and pin(0):
        results[PINNED] = scheduled(PINNED, arguments)
        unpin()
    if share():
        results[SHARED] = scheduled(SHARED, arguments)
        unpin()
    results[ORDINARY] = scheduled(ORDINARY, arguments)
    where["load_after"] = load()
    print(f"\nnot installed: {', '.join(missing) or 'none'}")
    print(f"load of this machine before: {where['load_before']}; after: {where['load_after']}")
    return results


def _be_one_end(arguments: argparse.Namespace) -> None:
    name, *port = [arguments.serve] if arguments.serve else arguments.ask
    contender = next(one for one in CONTENDERS if one.name == name)()
    if arguments.pin:
        pin(0 if port else 1)
    if port:
        ask(contender, int(port[0]))
    else:
        contender.serve()


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=9, help="interleaved rounds")
    parser.add_argument(
        "--calls", type=int, default=2000, help="calls of each contender in a round"
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="length of each stream")
    parser.add_argument(
        "--quick", action="store_true", help="3 rounds of 500 calls, streams of 1 s"
    )
    parser.add_argument("--json", metavar="FILE", help="write the results")
    parser.add_argument(
        "--pin",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="measure with SCHED_FIFO, too",
    )
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--ask", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve or arguments.ask:
        _be_one_end(arguments)
        return
    if arguments.quick:
        arguments.rounds, arguments.calls, arguments.seconds = 3, 500, 1.0
    results = run(arguments)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
