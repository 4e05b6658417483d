"""Compare the speed of the wire with other libraries in one run: round trip of a call, calls per
second, 100 kB, set-point streams.

    python tools/bench/wire.py                      everything that is installed
    python tools/bench/wire.py --quick --json out.json
    python tools/bench/wire.py --against ../older   beside petrobot of another checkout, in turns
    python tools/bench/wire.py --big                how long large messages keep other callers

The contenders alternate every few calls, so that a busy machine affects all of them. Each end is a
process of its own. Everything is measured three times: with both ends SCHED_FIFO on different cores
(where that is permitted), as ordinary processes that share one core, and as the scheduler decides.
The first two show the cost of the code. In the third, the scheduler may keep both ends of one
contender on one core and those of another on two, where each message has to wake the other end.
Only ratios matter: microseconds depend on the machine.

The other checkout of `--against` has its own `.venv`; its `wire.py` may be in `tests/bench`.
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

from tools.bench.processes import load, pin, quantile, share, show, start, unpin
from tools.bench.wire_asker import Asker, ask
from tools.bench.wire_contenders import (
    BIG_KINDS,
    Bare,
    Contender,
    Petrobot,
    PetrobotSealed,
    PetrobotWorker,
    load_with,
)
from tools.bench.wire_peers import CONTENDERS
from tools.bench.wire_streams import measure_streams

from petrobot.services.host.parent_death import die_with

IN_FLIGHT = 64
LEAST = 50
"""Fewest calls of each task in flight when calls per second are measured, so that the start has no
weight."""
BIG = 100_000
GAP = 0.001
"""Seconds between spaced calls: long enough for the other end to sleep."""
ROWS = ("call", "spaced", "round p50", "spaced p50", "big", "rate")
OURS = (Petrobot, PetrobotSealed, PetrobotWorker)
SCRIPTS = ("tools/bench/wire.py", "tests/bench/wire.py")
TURN = 20
"""Calls of one contender before the next has its turn."""
NOISE = 1.15
"""Differences of ratios below this are noise on a machine with other load."""
PEERS = ("Pyro5", "RPyC", "pyzmq", "grpc.aio")
PINNED, SHARED, ORDINARY = "a core each end", "one core for both ends", "as the scheduler likes it"
"""How the two ends are scheduled."""


class ResultTable:
    """The measured values by contender."""

    def __init__(
        self, contenders: Sequence[type[Contender]], pinned: bool, older: Path | None = None
    ) -> None:
        self.rows: dict[str, dict[str, list[float]]] = {}
        self._askers = {one.name: Asker(__file__, one.name, pinned) for one in contenders}
        for one in OURS if older is not None else ():
            assert older is not None
            older = older.resolve()
            script = next(older / f for f in SCRIPTS if (older / f).exists())
            python = str(older / ".venv" / "bin" / "python")
            self._askers[f"{one.name} (older)"] = Asker(str(script), one.name, pinned, python)

    def measure(self, rounds: int, calls: int) -> None:
        """Measure all contenders in rounds. Within a round they take turns every few calls, so that
        other load on the machine affects them all."""
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
        """Return microseconds and calls per second, and their ratios to the bare echo (median,
        least and largest of the rounds)."""
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
        """Return for each round one contender's figure as a multiple of another's."""
        return [
            own / its for own, its in zip(self.rows[name][what], self.rows[to][what], strict=True)
        ]


Goals = dict[str, tuple[list[float], float, bool]]
"""Results by goal: the values of the rounds, the limit, and whether their median is within it."""


def call_goals(table: ResultTable) -> Goals:
    """Return the goals of calls."""
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


def goals_against(table: ResultTable) -> Goals:
    """Return the goals beside an older petrobot."""
    goals: Goals = {}
    for one in OURS:
        older = f"{one.name} (older)"
        most = 0.65 if one is PetrobotWorker else 1.0
        for what, column in (("in a row", "round p50"), ("spaced", "spaced p50")):
            found = _below(table.ratios(one.name, older, column), most)
            goals[f"{one.name}: p50 of the older, {what}"] = found
        rates = table.ratios(one.name, older, "rate")
        goals[f"{one.name}: calls/s of the older"] = rates, 1.0, quantile(rates, 0.5) >= 1.0
    return goals


def stream_goals(streams: dict[str, dict[str, float]]) -> Goals:
    """Return the goals of set-point streams."""
    return {
        f"p99 <= 1.4 x raw, {name}": _below([row["p99_to_raw"], row["round_p99_to_raw"]], 1.4)
        for name, row in streams.items()
        if name.startswith("petrobot")
    }


def _below(found: list[float], limit: float) -> tuple[list[float], float, bool]:
    return found, limit, quantile(found, 0.5) <= limit


def scheduled(how: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements with one way of scheduling."""
    pinned = how == PINNED
    older = arguments.against
    all_of_them = [one for one in CONTENDERS if _is_installed(one)]
    table = ResultTable(all_of_them if older is None else [Bare, *OURS], pinned, older)
    try:
        table.measure(arguments.rounds, arguments.calls)
    finally:
        table.close()
    calls = table.results()
    if older is not None:
        print(f"\n== {how} ==")
        show("calls", calls)
        _show_goals(goals := goals_against(table))
        return {"calls": calls, "goals": goals}
    streams = measure_streams(max(arguments.rounds // 3, 1), arguments.seconds, pinned)
    goals = call_goals(table) | stream_goals(streams)
    print(f"\n== {how} ==")
    show("calls", calls)
    show("streams (age when taken)", streams)
    _show_goals(goals)
    return {"calls": calls, "streams": streams, "goals": goals}


def _show_goals(goals: Goals) -> None:
    print(
        f"\n{'goal (median, least and largest of the rounds)':52}{'limit':>7}{'median':>8}"
        f"{'least':>8}{'largest':>8}"
    )
    for goal, (found, limit, met) in goals.items():
        row = "".join(f"{one:8.2f}" for one in (quantile(found, 0.5), min(found), max(found)))
        print(f"{goal:52}{limit:7.2f}{row}  {'met' if met else 'NOT MET'}")


def measure_big(rounds: int, calls: int) -> dict[str, dict[str, float]]:
    """Measure how long a small call takes (us): first alone, then while another process sends or
    receives large messages through the same node without a pause."""
    asker = Asker(__file__, PetrobotSealed.name, False)
    taken: dict[str, list[float]] = {kind: [] for kind in ("nothing", *BIG_KINDS)}
    for _ in range(rounds):
        for kind, found in taken.items():
            loader = None
            if kind != "nothing":
                loader = start(__file__, "--load", kind, asker.port, pinned=False)
                assert loader.stdout is not None
                loader.stdout.readline()
            found += asker.latencies(calls, 0, GAP)
            if loader is not None:
                loader.kill()
                loader.communicate()
    asker.close()
    return {
        kind: {
            "p50_us": quantile(found, 0.5) * 1e6,
            "p99_us": quantile(found, 0.99) * 1e6,
            "most_us": max(found) * 1e6,
        }
        for kind, found in taken.items()
    }


def _is_installed(one: type[Contender]) -> bool:
    return not one.needs or importlib.util.find_spec(one.needs) is not None


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements, with every way of scheduling that is permitted."""
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
    die_with(os.getppid())  # also where the bench ends before it has started all contenders
    name, *port = [arguments.serve] if arguments.serve else arguments.ask
    contender = next(one for one in CONTENDERS if one.name == name)()
    if arguments.pin:
        pin(0 if port else 1)
    if port:
        ask(contender, int(port[0]))
    else:
        contender.serve()


def main() -> None:
    """Read the options, measure and print."""
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
    parser.add_argument("--against", type=Path, metavar="FOLDER", help="another checkout")
    parser.add_argument("--big", action="store_true", help="large messages beside small calls")
    parser.add_argument("--load", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--ask", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve or arguments.ask:
        _be_one_end(arguments)
        return
    if arguments.load:
        load_with(arguments.load[0], int(arguments.load[1]))
        return
    if arguments.big:
        print(f"load of this machine: {load()}")
        show("small calls beside", measure_big(arguments.rounds, arguments.calls))
        return
    if arguments.quick:
        arguments.rounds, arguments.calls, arguments.seconds = 3, 500, 1.0
    results = run(arguments)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
