"""How often selectors end on the best action: the study of docs/figures-selectors.md against its
floors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from tools.proof.proof import KEPT, FigureProof, Result, command

SURE = 0.99
RULE = "nikolic_fu_fast"


def study() -> Result:
    """Return the shares of 1,000 seeds with p >= 0.95 on the best of 4 actions after 500 trials,
    for the two gaps that have a floor.

    Raises RuntimeError when the study fails.
    """
    path = KEPT / "convergence.study.json"
    path.unlink(missing_ok=True)
    done = command("tools.bench.learning", "--json", str(path))
    if done.returncode:
        raise RuntimeError(f"tools.bench.learning: exit {done.returncode}\n{done.stderr[-2000:]}")
    worlds: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))["worlds"]
    found: dict[str, Any] = {}
    for rule in (RULE, "nikolic_fu"):
        for world in ("easy", "middle"):
            found[f"{rule}, {world}"] = round(float(worlds[rule][world]["converged"]), 4)
    return found


def proofs() -> list[FigureProof]:
    """Return the proof of the study."""
    sources = ("coordinator/learning", "tools/bench/learning.py")
    holds = lambda r: min(r[f"{RULE}, {world}"] for world in ("easy", "middle")) >= SURE  # noqa: E731
    floor = f"fast variant >= {SURE} at gaps .4 and .2"
    return [
        FigureProof(
            "convergence of selectors", "Learning, simulated worlds", study, holds, floor, sources
        )
    ]
