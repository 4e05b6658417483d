"""`make proof`: checks every promised figure in full and writes them to docs/figures.md. Resumes where it stopped.

Each proof is a command whose result is kept in reports/proof with the state of the sources that gave it; a proof whose
sources have not changed since is not run again. `--only NAME` runs one, `--fresh` forgets what is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "reports" / "proof"
FIGURES = ROOT / "docs" / "figures.md"
SOURCES = ("coordinator", "services", "sim", "services.toml", "tests")
THROWS = 1000
SEED = 20_000
FLOORS = {"A": 0.98, "B": 0.94, "C": 0.89}
DISTURBED_THROWS = 200

Result = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Proof:
    """One figure: how it is measured, and whether it holds."""

    name: str
    measure: Callable[[], Result]
    holds: Callable[[Result], bool]
    floor: str


def wilson_lower(successes: int, trials: int, z: float = 1.959964) -> float:
    """Lower end of Wilson's 95 % interval for a share (Wilson 1927)."""
    if trials == 0:
        return 0.0
    share = successes / trials
    centre = share + z * z / (2 * trials)
    margin = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    return (centre - margin) / (1 + z * z / trials)


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command of this environment; its output is kept for the error message."""
    return subprocess.run([sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


def run_task(*arguments: str) -> dict[str, Any]:
    """The result of a `petrobot run`."""
    path = KEPT / "out.json"
    done = command("coordinator", "run", *arguments, "--quiet", "--json", str(path))
    if done.returncode not in (0, 1):
        raise RuntimeError(f"petrobot run {' '.join(arguments)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result


def catching(regime: str, throws: int) -> Callable[[], Result]:
    """Throws of a regime in lock step: caught among the reachable ones."""

    def measure() -> Result:
        result = run_task(
            "catch_ball", "--mode", "lockstep", "--runs", str(throws), "--seed", str(SEED), "--regime", regime
        )
        reachable = [t for t in result["throws"] if t["reachable"]]
        caught = sum(t["caught"] for t in reachable)
        return {
            "regime": regime,
            "throws": len(result["throws"]),
            "reachable": len(reachable),
            "caught of reachable": caught,
            "caught of all": sum(t["caught"] for t in result["throws"]),
            "wilson_lower": round(wilson_lower(caught, len(reachable)), 4),
            "times real time": round(result["sim_s"] / result["wall_s"], 1),
        }

    return measure


def tests_marked_proof() -> Result:
    """Every test that takes too long for `make test`."""
    done = command("pytest", "-m", "proof", "-n", "2", "-q")
    return {"exit": done.returncode, "last line": done.stdout.strip().splitlines()[-1] if done.stdout.strip() else ""}


def same_file_anywhere() -> Result:
    """One seed, one file: in one process, in one process a node, and beside a process that takes a core."""
    arguments = ("catch_ball", "--mode", "lockstep", "--runs", "20", "--seed", str(SEED))
    alone = run_task(*arguments)
    spread = run_task(*arguments, "--processes", "0")
    load = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        loaded = run_task(*arguments)
    finally:
        load.kill()
        load.wait()
    speeds = {name: round(r["sim_s"] / r["wall_s"], 1) for name, r in (("one", alone), ("one a node", spread))}
    for result in (alone, spread, loaded):
        del result["wall_s"]
    return {"spread": alone == spread, "loaded": alone == loaded, **speeds, "cycle_s": round(alone["sim_s"] / 20, 2)}


def disturbances() -> list[str]:
    """Every disturbed regime by name, each at every speed."""
    laboratory = tomllib.loads((ROOT / "sim" / "laboratory.toml").read_text(encoding="utf-8"))
    return [f"{speed}+{name}" for name in laboratory["disturbances"] for speed in FLOORS]


def proofs() -> list[Proof]:
    """All of them, in the order in which people wait for them."""
    main = [
        Proof(f"catch {regime}", catching(regime, THROWS), _above(floor), f"lower Wilson bound >= {floor}")
        for regime, floor in FLOORS.items()
    ]
    disturbed = [
        Proof(f"catch {name}", catching(name, DISTURBED_THROWS), lambda r: r["throws"] == DISTURBED_THROWS, "measured")
        for name in disturbances()
    ]
    return [
        *main,
        Proof("same file", same_file_anywhere, lambda r: bool(r["spread"] and r["loaded"]), "equal files"),
        Proof("long tests", tests_marked_proof, lambda r: r["exit"] == 0, "all pass"),
        *disturbed,
    ]


def _above(floor: float) -> Callable[[Result], bool]:
    return lambda result: bool(result["wilson_lower"] >= floor)


def fingerprint() -> str:
    """Hash of all sources that a figure depends on."""
    digest = hashlib.sha256()
    for top in SOURCES:
        base = ROOT / top
        files = [base] if base.is_file() else sorted(p for p in base.rglob("*") if p.suffix in (".py", ".toml", ".eds"))
        for path in files:
            digest.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def kept(proof: Proof, sources: str) -> dict[str, Any] | None:
    """A result of the same sources, if there is one."""
    path = KEPT / f"{proof.name.replace(' ', '_')}.json"
    if not path.exists():
        return None
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return data if data["sources"] == sources else None


def prove(proof: Proof, sources: str) -> dict[str, Any]:
    """Measure, judge and keep."""
    begun = time.monotonic()
    result = proof.measure()
    data = {
        "sources": sources,
        "holds": proof.holds(result),
        "result": dict(result),
        "minutes": round((time.monotonic() - begun) / 60, 1),
    }
    (KEPT / f"{proof.name.replace(' ', '_')}.json").write_text(json.dumps(data, indent=2), encoding="utf-8")
    return data


def figures(rows: list[tuple[Proof, dict[str, Any]]]) -> str:
    """The page that docs/ quotes."""
    lines = ["# Figures", "", "Written by `make proof`; every line can be made again with that command.", ""]
    lines += ["| what | floor | holds | measured |", "|---|---|---|---|"]
    for proof, data in rows:
        measured = ", ".join(f"{key} {value}" for key, value in data["result"].items())
        lines.append(f"| {proof.name} | {proof.floor} | {'yes' if data['holds'] else '**no**'} | {measured} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is not proved yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAME", help="one proof")
    parser.add_argument("--fresh", action="store_true", help="forget what is kept")
    options = parser.parse_args()
    KEPT.mkdir(parents=True, exist_ok=True)
    sources, rows = fingerprint(), []
    todo = [p for p in proofs() if options.only in (None, p.name)]
    for number, proof in enumerate(todo, 1):
        data = None if options.fresh else kept(proof, sources)
        word = "kept" if data else "measured"
        data = data or prove(proof, sources)
        rows.append((proof, data))
        holds = "holds" if data["holds"] else "DOES NOT HOLD"
        print(
            f"[{number}/{len(todo)}] {proof.name}: {holds} ({word}, {data['minutes']} min): {data['result']}",
            flush=True,
        )
    if options.only is None:
        FIGURES.write_text(figures(rows), encoding="utf-8")
    return 0 if all(data["holds"] for _, data in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
