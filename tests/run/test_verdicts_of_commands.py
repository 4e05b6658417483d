"""Deferred verdicts on the command line: run with --learn, read the log and the report, replay the
run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from tests.run.judged_parts import FOLDER

Petrobot = Callable[..., str]


@pytest.fixture
def petrobot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Petrobot:
    """Run a command on the judged cell in its own folder, and return what it printed."""
    monkeypatch.chdir(tmp_path)

    def command(*words: str) -> str:
        assert main(list(words)) == 0
        return capsys.readouterr().out

    return command


def test_a_run_its_log_and_its_estimates(petrobot: Petrobot, tmp_path: Path) -> None:
    cell = ["--services", str(FOLDER / "services.toml")]
    order = [
        "run",
        str(FOLDER / "sort.toml"),
        "--mode",
        "lockstep",
        "--journal",
        "kept",
        "--json",
        "out.json",
        *cell,
    ]
    petrobot(*order, "--learn", "learned.db", "--selector", "fixed")
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert result["status"] == "success" and "verdicts" not in result
    petrobot("learned", "show", "learned.db", "--json", "shown.json")
    shown = (tmp_path / "shown.json").read_text(encoding="utf-8")
    (pick,) = [
        one
        for one in json.loads(shown)["primitive_tasks"]["pick"]["actions"]
        if one["action"] == "pick_left"
    ]
    counted = [pick[key] for key in ("runs", "unjudged", "R", "corrected")]
    assert counted == [5, 1, 0.4, 3]
    (run,) = [path for path in (tmp_path / "kept").iterdir() if path.is_dir()]
    told = petrobot("log", str(run))
    lines = [line.split("s  ", 1)[1].split() for line in told.splitlines() if " judged " in line]
    assert lines[0] == [
        "judged",
        "pick#1",
        "FAILURE,",
        "was",
        "SUCCESS",
        "crooked:",
        "held",
        "by",
        "a",
        "corner",
    ]
    assert [line[1] for line in lines] == ["pick#1", "pick#2", "pick#4", "pick#5", "pick#3"]
    assert sum("provisional SUCCESS" in line for line in told.splitlines()) == 6
    xes = petrobot("log", str(run), "--format", "xes")
    assert xes.count('value="verdict on pick"') == 5
    petrobot("report", str(run), "--out", "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "crooked" in page and "fell" in page
