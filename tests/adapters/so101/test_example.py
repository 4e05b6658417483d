"""The task of `examples/so101`, in a lock-step cell: driver and servos are two parties."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "so101"


@pytest.mark.processes
def test_the_task_runs_in_lock_step(tmp_path: Path) -> None:
    cell = shutil.copytree(EXAMPLE, tmp_path / "cell")
    command = [sys.executable, "-m", "petrobot.coordinator", "run", "carry.toml"]
    done = subprocess.run(
        [*command, "--mode", "lockstep", "--json", "out.json"],
        cwd=cell,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((cell / "out.json").read_text(encoding="utf-8"))
    assert result["status"] == "success" and 10.0 < result["sim_s"] < 20.0
