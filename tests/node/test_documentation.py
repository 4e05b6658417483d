"""The examples of docs/actions.md and docs/drivers.md work: their files are written out and run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from petrobot.services.comm.location_file import load, verify_imports
from petrobot.services.comm.lockstep.cell import LockStepCell
from petrobot.services.comm.protocol.messages import Outcome
from petrobot.services.node.lockstep import LockstepNode
from petrobot.services.scripted import load as load_script
from tests.node.test_lockstep import Coordinator

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "docs" / "actions.md", ROOT / "docs" / "drivers.md"]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with all files of the pages."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"```(?:python|toml)\n# file: (\S+)\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 7
    for name, text in blocks:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.processes
def test_the_pages_own_test_passes(files: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_gripping.py"],
        cwd=files,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{files}"},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "4 passed" in ended.stdout


@pytest.mark.parametrize("mocked", [False, True])
def test_the_pages_node_runs_its_action(files: Path, mocked: bool) -> None:
    directory = load(files / "services.toml")
    assert verify_imports(directory, "bench") == ()
    node = LockstepNode(
        directory, "bench", substitutes=load_script(files / "script.toml") if mocked else None
    )
    coordinator = Coordinator(directory, [(2, "grip", {}), (400, "grip", {})])
    cell = LockStepCell([node, coordinator])
    cell.run(lambda: False, 800)
    ends = [n for _, n in coordinator.heard if isinstance(n, Outcome)]
    assert [(e.status, e.cause) for e in ends] == [
        ("failure", "empty") if mocked else ("success", ""),
        ("success", ""),
    ]
    assert ends[1].values == {"width": 0.03}
