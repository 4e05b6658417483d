"""The example: it may run, it runs in lock step, and dry."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main

TASK = str(Path(__file__).parents[3] / "examples" / "ur" / "carry.toml")


@pytest.mark.processes
def test_it_may_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", TASK]) == 0, capsys.readouterr()


@pytest.mark.processes
@pytest.mark.parametrize("dry_run", [[], ["--dry-run"]])
def test_it_carries_a_part(tmp_path: Path, dry_run: list[str]) -> None:
    out = tmp_path / "out.json"
    run = ["run", TASK, "--mode", "lockstep", "--runs", "1", "--quiet", "--json", str(out)]
    assert main([*run, *dry_run]) == 0
    result = json.loads(out.read_text())
    assert (result["status"], result["firings"]) == ("success", 9)
