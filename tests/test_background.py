"""The designer's analysis in a process of its own: what it says, and how it ends when it takes too
long."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator import background as background
from petrobot.coordinator.analysis.may_run import Budget
from petrobot.coordinator.background import (
    BackgroundProcess,
    RefusedError,
    Superseded,
    analysed,
)
from petrobot.coordinator.learning.estimate import Observation, Tally, TallyKey
from petrobot.coordinator.learning.estimates_file import EstimatesFile, FileContents
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.propagation import newest_measured
from petrobot.coordinator.page.task_work import export
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import loads
from tests.waiting import until

CATCH_BALL = (Path(background.__file__).parent / "tasks" / "catch_ball.toml").read_text(
    encoding="utf-8"
)


async def analysis(text: str, filename: str) -> dict[str, Any]:
    """Return the analysis of a task from a process of its own."""
    apart = BackgroundProcess()
    try:
        answer: dict[str, Any] = json.loads(
            await apart.do("analysis", {"text": text, "filename": filename, "cell": None})
        )
    finally:
        await apart.close()
    return answer


@pytest.mark.processes
async def test_verdicts_and_forecast_come_from_a_process_of_its_own() -> None:
    answer = await analysis(CATCH_BALL, "catch_ball.toml")
    assert answer["complete"] is True
    assert {"bounded", "sound", "controllable"} <= {
        verdict["name"] for verdict in answer["verdicts"]
    }
    wrong = {v["name"]: v["problem"] for v in answer["verdicts"] if v["holds"] is False}
    assert wrong and not any(wrong.values()), "what a task that gives up cannot do is no problem"
    assert set(answer["heat"]) >= {"locate_ball", "track_ball"}, (
        "the last line is the fullest: with the forecast"
    )


@pytest.mark.processes
async def test_an_invalid_task_is_refused_with_its_fault() -> None:
    with pytest.raises(ValueError, match=r"drawn\.toml"):
        await analysis("schema = 1\n[task]\n", "drawn.toml")


def test_a_search_that_ran_out_of_states_leaves_verdicts_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("petrobot.coordinator.analysis.may_run.BUDGET", Budget(10, 1000))
    answer = next(analysed(CATCH_BALL.replace("tokens = 4", "tokens = 4000"), "catch_ball.toml"))
    assert answer["complete"] is False
    assert None in {verdict["holds"] for verdict in answer["verdicts"]}


def test_the_forecast_is_added_without_another_search(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = analysed(CATCH_BALL, "catch_ball.toml")
    first = next(answers)
    monkeypatch.delattr("petrobot.coordinator.analysis.report.progress_of")
    monkeypatch.delattr("petrobot.coordinator.analysis.report.explore")
    second = next(answers)
    assert second["heat"] and not first["heat"]
    assert second["verdicts"] == first["verdicts"] and second["markings"] == first["markings"]


def test_the_forecast_takes_the_newest_measured_numbers_and_names_their_file(
    tmp_path: Path,
) -> None:
    for name, action, seconds in (("old", "locate_hough", 9.0), ("new", "locate_hough", 4.0)):
        made = Estimates()
        key = TallyKey("locate_ball", action, "")
        made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, seconds), "t")
        EstimatesFile(tmp_path / f"{name}.db").add(made, {})
    other = Estimates()
    other.tallies[TallyKey("wash", "wash", "")] = Tally().adding(
        Observation(Status.SUCCESS, 2.0), "t"
    )
    EstimatesFile(tmp_path / "of_another_task.db").add(other, {})
    (tmp_path / "broken.db").write_text("not a database")
    for age, name in enumerate(("broken", "of_another_task", "new", "old")):
        os.utime(tmp_path / f"{name}.db", (1e9 - age, 1e9 - age))
    *_, declared = analysed(CATCH_BALL, "catch_ball.toml")
    *_, measured = analysed(CATCH_BALL, "catch_ball.toml", estimates=str(tmp_path))
    assert f"numbers as measured in {tmp_path / 'new.db'}" in " ".join(measured["notes"])
    assert "numbers as measured" not in " ".join(declared["notes"])
    key = next(name for name in measured["figures"] if name.startswith("mean time"))
    assert measured["figures"][key] > declared["figures"][key] + 3.0
    drawn = export(CATCH_BALL, "catch_ball.toml", "gspn.svg", None, str(tmp_path)).text
    assert "new.db" in drawn and "measured in 1 run" in drawn


def test_forecasts_take_the_numbers_of_the_own_plant_first(tmp_path: Path) -> None:
    """A newer file of scripted actions counts only where actions are scripted, too."""

    def note(plant: str) -> str:
        *_, answer = analysed(CATCH_BALL, "catch_ball.toml", None, "", str(tmp_path), plant)
        return " ".join(answer["notes"])

    for age, plant in enumerate(("mock", "simulated", "real one", "dry-run")):
        made, file = Estimates(), tmp_path / f"{plant}.db"
        key = TallyKey("locate_ball", "locate_hough", "")
        made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, 4.0), "t")
        EstimatesFile(file).add(made, {}, plant=plant)
        os.utime(file, (1e9 - age, 1e9 - age))
    assert "mock.db (plant mock), else" in note("mock")
    assert "simulated.db (plant simulated), else" in note("simulated")
    assert "real one.db (plant real one, nothing of real two), else" in note("real two")
    (tmp_path / "real one.db").unlink()
    assert "simulated.db (plant simulated, nothing of real two), else" in note("real two")
    (tmp_path / "simulated.db").unlink()
    assert "numbers as measured" not in note("real two")
    assert "dry-run.db" in note("dry-run")


def test_an_estimates_file_is_read_again_only_when_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = EstimatesFile(tmp_path / "lab.db")
    made = Estimates()
    key = TallyKey("locate_ball", "locate_hough", "")
    made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, 4.0), "t")
    file.add(made, {})
    task, read = loads(CATCH_BALL, "catch_ball.toml"), EstimatesFile.read
    asked: list[str | None] = []

    def counted(file: EstimatesFile, plant: str | None = None) -> FileContents:
        asked.append(plant)
        return read(file, plant)

    monkeypatch.setattr(EstimatesFile, "read", counted)
    for runs in (1, 1, 2):
        if runs == 2:
            file.add(made, {})
        measured, _ = newest_measured(str(tmp_path), task, None)
        [source] = measured.sources.values()
        assert source.startswith(f"measured in {runs} run")
        assert len(asked) == 2 * runs
    (tmp_path / "gone.db").symlink_to(tmp_path / "removed meanwhile")
    assert newest_measured(str(tmp_path), task, None)[1]


@pytest.mark.processes
def test_the_kernel_ends_a_process_that_takes_too_much_processor_time() -> None:
    """Not wall-clock time: a machine that is busy with a mission changes no verdict."""
    spinning = (
        "from itertools import repeat\n"
        "from petrobot.coordinator import background\n"
        "background.HARD_END = 0\n"
        "def analysed(text, filename):\n"
        "    yield {'said': 1}\n"
        "    yield all(repeat(1))\n"
        "background.analysed = analysed\n"
        "background.main()\n"
    )
    order = b'{"work": "analysis", "given": {"text": "", "filename": "drawn.toml"}}\n'
    ended = subprocess.run(
        [sys.executable, "-c", spinning],
        input=order,
        capture_output=True,
        check=False,
        timeout=240.0,
    )
    assert ended.returncode == -signal.SIGXCPU
    assert ended.stdout == b'{"said": 1}\n', "what was known before is told"


@pytest.mark.processes
@pytest.mark.parametrize("said", ['{"said": 1}', ""])
async def test_a_process_that_does_not_end_is_given_up(
    said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gets no processor time, or hangs: what it has said by then counts."""
    mute = tmp_path / "mute"
    mute.write_text(
        f"#!/bin/sh\n{f'echo {said!r}' if said else ':'}\nexec tail -f /dev/null\n",
        encoding="ascii",
    )
    mute.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(mute))
    # Until `mute` says something, a busy machine may take a while.
    monkeypatch.setattr(background, "PATIENCE", 8.0 if said else 1.0)
    if said:
        assert await analysis("", "drawn.toml") == {"said": 1}
    else:
        with pytest.raises(ValueError, match="took too long"):
            await analysis("", "drawn.toml")


@pytest.fixture
async def apart() -> AsyncIterator[BackgroundProcess]:
    made = BackgroundProcess()
    yield made
    await made.close()


FINDINGS = {"text": CATCH_BALL, "filename": "catch_ball.toml", "cell": None}
LONG = {"text": CATCH_BALL.replace("tokens = 4", "tokens = 4000"), "filename": "catch_ball.toml"}
"""An analysis that lasts longer than its test."""


@pytest.mark.processes
async def test_one_process_does_orders_one_after_the_other(apart: BackgroundProcess) -> None:
    first = await apart.do("findings", FINDINGS)
    process = apart.process
    several = await asyncio.gather(*(apart.do("findings", FINDINGS) for _ in range(3)))
    assert several == [first] * 3
    assert apart.process == process is not None
    with pytest.raises(RefusedError, match="no such run"):
        await apart.do("run", {"folder": "nowhere", "run": "none"})
    assert await apart.do("findings", FINDINGS) == first, "a refusal does not end it"


@pytest.mark.processes
async def test_it_has_a_low_priority_and_ignores_the_keyboard(
    apart: BackgroundProcess,
) -> None:
    await apart.do("findings", FINDINGS)
    assert apart.process is not None
    assert os.getpriority(os.PRIO_PROCESS, apart.process) >= 10
    assert os.getpgid(apart.process) == apart.process, "Ctrl-C is for the coordinator"


@pytest.mark.processes
async def test_a_newer_drawing_replaces_the_older_one(apart: BackgroundProcess) -> None:
    """Running or waiting, the older ones are given up at once; those of other desks and other work
    are not."""
    first = asyncio.create_task(apart.do("analysis", LONG, "desk 1"))
    await until(lambda: apart.process is not None, "its process to start")
    other = asyncio.create_task(apart.do("findings", FINDINGS, "desk 2"))
    second = asyncio.create_task(apart.do("analysis", LONG, "desk 1"))
    third = asyncio.create_task(apart.do("findings", FINDINGS, "desk 1"))
    async with asyncio.timeout(60):
        done = await asyncio.gather(first, other, second, third, return_exceptions=True)
    assert [isinstance(each, Superseded) for each in done] == [True, False, True, False]


@pytest.mark.processes
async def test_a_killed_process_is_started_again(apart: BackgroundProcess) -> None:
    await apart.do("findings", FINDINGS)
    assert apart.process is not None
    os.kill(apart.process, signal.SIGKILL)
    with contextlib.suppress(RefusedError):  # whoever asks first may find it dying
        await apart.do("findings", FINDINGS)
    assert json.loads(await apart.do("findings", FINDINGS)) is not None


@pytest.mark.processes
async def test_giving_up_an_order_ends_its_process(
    apart: BackgroundProcess,
) -> None:
    order = asyncio.create_task(apart.do("analysis", LONG))
    await until(lambda: apart.process is not None, "its process to start")
    order.cancel()
    with pytest.raises(asyncio.CancelledError):
        await order
    assert apart.process is None


@pytest.mark.processes
async def test_a_process_that_is_killed_while_it_reads_leaves_nothing_to_be_logged(
    apart: BackgroundProcess,
) -> None:
    said: list[str] = []
    asyncio.get_running_loop().set_exception_handler(
        lambda _loop, context: said.append(context["message"])
    )
    await apart.do("findings", FINDINGS)
    assert apart.process is not None
    os.kill(apart.process, signal.SIGSTOP)
    long = {**FINDINGS, "text": CATCH_BALL + "#" * 2_000_000}
    order = asyncio.create_task(apart.do("findings", long))
    await asyncio.sleep(0)
    os.kill(apart.process, signal.SIGKILL)
    with pytest.raises(RefusedError):
        await order
    del order
    await apart.do("findings", FINDINGS)  # in another process: the killed one is forgotten
    gc.collect()
    assert said == []
