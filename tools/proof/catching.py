"""Figures of the catching cell: throws in each regime, disturbed throws, and the same file for the
same seed.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tomllib
from collections.abc import Callable
from typing import Any

from tools.proof.proof import LOCK_STEP, ROOT, FigureProof, Result, digest, run_task

from petrobot.coordinator.learning.statistics import wilson

CHAPTER = "Catching, lock step"
THROWS = 1000
DISTURBED_THROWS = 200
SEED = 20_000
SAMPLE = 10
FLOORS = {"A": 0.98, "B": 0.94, "C": 0.89}


def catching(regime: str, throws: int) -> Callable[[], Result]:
    """Run throws of a regime; return how many of the reachable ones were caught, and how far from
    the middle of the cup."""

    def measure() -> Result:
        return summary(_run(f"catch_{regime}", regime, throws))

    return measure


def sample(regime: str) -> Callable[[], str]:
    """Run a few balls of a regime; return a digest of all that is known of them."""

    def short() -> str:
        result = _run(f"sample_{regime}", regime, SAMPLE)
        return digest([result["throws"], result["sim_s"]])

    return short


def _run(name: str, regime: str, throws: int) -> dict[str, Any]:
    given = ("--mode", "lockstep", "--seed", str(SEED), "--regime", regime)
    return run_task(name, "catch_ball", *given, "--runs", str(throws))


def summary(result: dict[str, Any]) -> Result:
    """Return the figures of a run for docs/figures.md."""
    throws = result["throws"]
    reachable = [t for t in throws if t["reachable"]]
    caught = sum(t["caught"] for t in reachable)
    misses = [t["miss_mm"] for t in throws if t["miss_mm"] is not None]
    return {
        "throws": len(throws),
        "reachable": len(reachable),
        "caught of reachable": caught,
        "caught of all": sum(t["caught"] for t in throws),
        "Wilson lower bound": round(wilson(caught, len(reachable))[0], 4),
        "median miss (mm)": round(statistics.median(misses), 1) if misses else None,
        "cycle (s)": round(result["sim_s"] / len(throws), 2),
    }


def same_file_anywhere() -> Result:
    """Compare result files of one seed: in one process, with a process per node, and while another
    process keeps a core busy."""
    given = ("catch_ball", "--mode", "lockstep", "--runs", "20", "--seed", str(SEED))
    alone = run_task("alone", *given)
    spread = run_task("spread", *given, "--processes", "0")
    load = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        loaded = run_task("loaded", *given)
        loaded_spread = run_task("loaded_spread", *given, "--processes", "0")
    finally:
        load.kill()
        load.wait()
    speeds = {
        name: round(r["sim_s"] / r["wall_s"], 1) for name, r in (("one", alone), ("spread", spread))
    }
    cycle = round(alone["sim_s"] / 20, 2)
    for result in (alone, spread, loaded, loaded_spread):
        del result["wall_s"]
    return {
        "same in a process a node": alone == spread,
        "same under load": alone == loaded == loaded_spread,
        "times real time, one process": speeds["one"],
        "times real time, a process a node": speeds["spread"],
        "cycle (s)": cycle,
    }


def disturbances() -> list[str]:
    """Return every disturbed regime by name, each at every speed."""
    laboratory = tomllib.loads(
        (ROOT / "sim" / "catching" / "laboratory.toml").read_text(encoding="utf-8")
    )
    return [f"{speed}+{name}" for name in laboratory["disturbances"] for speed in FLOORS]


def proofs() -> list[FigureProof]:
    """Return the proofs: throws first, then determinism and speed."""
    main = [
        FigureProof(
            regime,
            CHAPTER,
            catching(regime, THROWS),
            _above(floor),
            f"lower bound >= {floor}",
            LOCK_STEP,
            sample=sample(regime),
        )
        for regime, floor in FLOORS.items()
    ]
    disturbed = [
        FigureProof(
            *(
                name,
                CHAPTER,
                catching(name, DISTURBED_THROWS),
                lambda r: r["throws"] > 0,  # in the dark fewer are thrown than runs end
            ),
            *("measured", LOCK_STEP),
            sample=sample(name),
        )
        for name in disturbances()
    ]
    same = FigureProof(
        *("one seed, one file", "Lock step", same_file_anywhere, _same),
        "equal files; >= 10x in one process, >= 4x in four",
        LOCK_STEP,
        alone=True,
    )
    return [*main, same, *disturbed]


def _same(result: Result) -> bool:
    equal = result["same in a process a node"] and result["same under load"]
    fast = (
        result["times real time, one process"] >= 10
        and result["times real time, a process a node"] >= 4
    )
    return bool(equal and fast)


def _above(floor: float) -> Callable[[Result], bool]:
    return lambda result: bool(result["Wilson lower bound"] >= floor)
