"""The designer's analysis in a process of its own: what it says, and how it ends when it takes too long."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from coordinator import analysing
from coordinator.analysing import analyse_apart, analysed

CATCH_BALL = (Path(analysing.__file__).parent / "tasks" / "catch_ball.toml").read_text(encoding="utf-8")


@pytest.mark.processes
async def test_verdicts_and_forecast_come_from_a_process_of_its_own() -> None:
    answer = await analyse_apart(CATCH_BALL, "catch_ball.toml")
    assert answer["complete"] is True
    assert {"bounded", "sound", "controllable"} <= {verdict["name"] for verdict in answer["verdicts"]}
    assert set(answer["heat"]) >= {"locate_ball", "track_ball"}, "the last line is the fullest: with the forecast"


@pytest.mark.processes
async def test_a_text_that_is_no_task_is_refused_with_its_fault() -> None:
    with pytest.raises(ValueError, match=r"drawn\.toml"):
        await analyse_apart("schema = 1\n[task]\n", "drawn.toml")


def test_a_search_that_ran_out_of_time_leaves_verdicts_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(analysing, "SECONDS", 0.0)
    monkeypatch.setattr(analysing, "STATES", 1 << 40)
    answer = analysed(CATCH_BALL.replace("tokens = 4", "tokens = 4000"), "catch_ball.toml")
    assert answer["complete"] is False
    assert None in {verdict["holds"] for verdict in answer["verdicts"]}


@pytest.mark.processes
def test_the_kernel_ends_one_that_takes_too_much_processor_time() -> None:
    """Not wall-clock time: a machine that is busy with a mission changes no verdict."""
    spinning = (
        "from itertools import repeat\n"
        "from coordinator import analysing\n"
        "analysing.HARD_END = 1\n"
        "analysing.analysed = lambda text, name, view: all(repeat(1)) if view == 'gspn' else {'said': 1}\n"
        "analysing.main()\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", spinning, "drawn.toml"], input=b"", capture_output=True, check=False, timeout=240.0
    )
    assert ended.returncode == -signal.SIGKILL
    assert ended.stdout == b'{"said": 1}\n', "what was known before is told"


@pytest.mark.processes
@pytest.mark.parametrize("said", ['{"said": 1}', ""])
async def test_one_that_does_not_end_is_given_up(said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets no processor time, or hangs: what it has said by then counts."""
    mute = tmp_path / "mute"
    mute.write_text(f"#!/bin/sh\n{f'echo {said!r}' if said else ':'}\nexec tail -f /dev/null\n", encoding="ascii")
    mute.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(mute))
    monkeypatch.setattr(analysing, "PATIENCE", 1.0)
    if said:
        assert await analyse_apart("", "drawn.toml") == {"said": 1}
    else:
        with pytest.raises(ValueError, match="took too long"):
            await analyse_apart("", "drawn.toml")
