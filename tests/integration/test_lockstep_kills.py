"""kill -9 of the coordinator of a catching task in lock step, resumed each time: the
outcome equals that of an undisturbed run.

The nodes and the laboratory are in another process, which continues. Every action is rejoined
(`on_resume`): in lock step simulated time, and so the ball, waits for the new coordinator.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration.cell_files import ROOT, services_file

pytestmark = [pytest.mark.processes, pytest.mark.long]
SEED = 3


def experiments(folder: Path, runs: int, kills: Sequence[Sequence[int]]) -> list[dict[str, Any]]:
    """Return the outcome of each experiment (tests/integration/mortal_cell.py)."""
    folder.mkdir()
    services = services_file(folder, edits={'on_resume = "error"': 'on_resume = "rejoin"'})
    given = [str(folder / "runs"), str(services), str(SEED), str(runs), json.dumps(kills)]
    command = [sys.executable, "-m", "tests.integration.mortal_cell", *given]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def judge(outcome: dict[str, Any], undisturbed: dict[str, Any]) -> None:
    """Check that the end is the same, no call was executed twice or left out, and every unknown
    execution is reported."""
    assert outcome["lives"] == len(outcome["kills"]) + 1, (
        f"not killed as often as wanted: {outcome}"
    )
    assert outcome["same"] == undisturbed["same"], (
        f"another outcome with kills at {outcome['kills']}"
    )
    assert outcome["twice"] == [] and outcome["unknown"] == []
    assert outcome["calls"] == outcome["recorded"] == undisturbed["calls"]


def test_four_kills_change_nothing(tmp_path: Path) -> None:
    """All are in one mission run, at operations drawn from a seed, some operations apart."""
    kills = np.random.default_rng(2).integers(1, 24, 4).tolist()
    undisturbed, killed = experiments(tmp_path / "cell", 2, [[], kills])
    assert (
        undisturbed["same"]["status"] == "success" and undisturbed["same"]["caught"] == [True] * 2
    )
    judge(killed, undisturbed)


@pytest.mark.proof
def test_a_kill_at_every_record_changes_nothing(tmp_path: Path) -> None:
    """After every append, flush and sync of the journal in turn: hundreds of mission runs,
    thousands of calls."""
    [undisturbed] = experiments(tmp_path / "undisturbed", 4, [[]])
    kills = [[operation] for operation in range(1, undisturbed["operations"])]
    outcomes = experiments(tmp_path / "killed", 4, kills)
    for outcome in outcomes:
        judge(outcome, undisturbed)
    calls = sum(outcome["calls"] for outcome in outcomes)
    print(
        f"{len(outcomes)} mission runs, each killed once; {calls} calls, none executed "
        "twice, none unknown"
    )
    assert calls >= 2_000
