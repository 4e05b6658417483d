"""The commands as a user calls them: campaign, resume, forecast, comparison, bad input."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.campaign import text_of
from petrobot.coordinator.studies.campaign.conduct import (
    CampaignProgress,
    ProgressLine,
    clock,
    line,
)
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, write_manifest
from petrobot.coordinator.studies.campaign.table import held, times
from tests.processes import children
from tests.studies.campaign.conftest import HERE, SERVICES, TASK
from tests.waiting import PATIENCE_S, Limit, wait_for

ROOT = HERE.parents[1]
TOY = [str(TASK), "--services", str(SERVICES)]


def campaign(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run the command in this process (its workers are other processes); return its JSON."""
    out = folder.with_suffix(".json")
    assert (
        main(
            [
                "campaign",
                *TOY,
                "--out",
                str(folder),
                "--workers",
                "1",
                "--json",
                str(out),
                *arguments,
            ]
        )
        == 0
    )
    result: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return result


@pytest.mark.processes
def test_train_forecast_run_and_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The whole sequence on the toy cell, with the documented keys."""
    train = campaign(
        tmp_path / "train",
        "--runs",
        "300",
        "--regime",
        "easy,rough",
        "--selector",
        "random",
        "--block",
        "30",
    )
    promised = {
        "task",
        "regimes",
        "seed",
        "runs",
        "selector",
        "workers",
        "rows",
        "R_goal",
        "P_complete",
        "wilson",
        "by_regime",
    }
    promised |= {"chosen", "J", "sim_s", "wall_s", "times_real_time_per_core", "estimates"}
    assert promised <= set(train)
    assert train["wilson"][0] < train["R_goal"] < train["wilson"][1]
    assert set(train["by_regime"]) == {"easy", "rough"}
    assert sum(train["chosen"]["look"].values()) == train["begun"] <= train["runs"] == 300
    assert all(0 < j < 2.01 for j in train["J"]["look"].values())
    capsys.readouterr()
    shown = []
    for numbers in (tmp_path / "train", tmp_path / "train" / "estimates.db"):
        main(["analyse", str(TASK), "--view", "gspn", "--estimates", str(numbers)])
        shown.append(capsys.readouterr().out)
    assert "measured in" in shown[0] and shown[0] == shown[1]
    registered = tmp_path / "f.json"
    told = [
        "forecast",
        str(TASK),
        "--estimates",
        str(tmp_path / "train"),
        "--runs",
        "150",
        "--replicates",
        "60",
    ]
    assert main([*told, "--out", str(registered)]) == 0
    new = [
        "--runs",
        "300",
        "--regime",
        "easy,rough",
        "--selector",
        "random",
        "--block",
        "30",
        "--seed",
        "2",
    ]
    found = campaign(tmp_path / "new", *new, "--check", str(registered))["check"]
    assert found["agrees"] and found["registered_before"] and found["same_task_file"]
    assert {row["figure"] for row in found["rows"]} == {
        "R_goal",
        "P_complete",
        "mean",
        "q90",
        "R_conj",
    }
    capsys.readouterr()
    table = tmp_path / "table.md"
    assert (
        main(
            [
                "forecast",
                "--compare",
                str(registered),
                str(tmp_path / "new"),
                "--markdown",
                str(table),
            ]
        )
        == 0
    )
    assert table.read_text(encoding="utf-8").count("| easy |") == 7
    assert main(["forecast", "--compare", str(registered), str(tmp_path / "train")]) == 2
    assert "was trained on" in capsys.readouterr().err
    file = [
        "forecast",
        str(TASK),
        "--estimates",
        train["estimates"],
        "--runs",
        "100",
        "--replicates",
        "20",
        "--json",
        "-",
    ]
    assert main(file) == 0
    from_sums = json.loads(capsys.readouterr().out)
    for regime in ("easy", "rough"):
        own = train["by_regime"][regime]["R_goal"]
        assert from_sums["regimes"][regime]["figures"]["R_goal"]["value"] == pytest.approx(
            own, abs=0.05
        )


@pytest.mark.processes
def test_a_finished_campaign_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command returns the same result at once, and `--regime X` is `--set regime=X`;
    another number of runs has its own folder."""
    monkeypatch.chdir(tmp_path)
    told = ["campaign", *TOY, "--workers", "1", "--set", "regime=rough"]
    assert main(["campaign", *TOY, "--workers", "1", "--regime", "rough", "--runs", "4"]) == 0
    (folder,) = (tmp_path / "campaigns").iterdir()
    first = (folder / "sessions.csv").read_bytes()
    capsys.readouterr()
    assert main([*told, "--runs", "4"]) == 0
    assert "nothing left to do" in capsys.readouterr().out
    assert (folder / "sessions.csv").read_bytes() == first
    assert main([*told, "--runs", "5"]) == 0
    assert len(list((tmp_path / "campaigns").iterdir())) == 2


@pytest.mark.processes
def test_a_killed_campaign_is_resumed(tmp_path: Path) -> None:
    """SIGINT during the campaign, then --resume, gives the table of an uninterrupted campaign."""
    arguments = [
        *TOY,
        "--runs",
        "150",
        "--regime",
        "easy,rough",
        "--selector",
        "ucb1",
        "--batch",
        "10",
        "--workers",
        "2",
    ]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}"}
    command = [sys.executable, "-m", "petrobot.coordinator", "campaign"]

    def start(*more: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [*command, *more], cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL
        )

    part = start(*arguments, "--out", "part")
    table = tmp_path / "part" / "table.csv"
    wait_for(lambda: part.poll() is not None or (table.exists() and b"\n" in table.read_bytes()))
    part.kill()
    part.wait()
    assert 0 < table.read_bytes().count(b"\n") < 151
    assert start("--resume", "part").wait() == 0
    assert start(*arguments, "--out", "whole").wait() == 0
    assert table.read_bytes() == (tmp_path / "whole" / "table.csv").read_bytes()
    sessions = (tmp_path / "part" / "sessions.csv").read_text(encoding="utf-8").splitlines()
    assert len(sessions) == 3  # The killed one is listed, too.


def test_names_longer_than_their_column_are_separated_from_the_next_column() -> None:
    """Regimes with several disturbances have long names."""
    part = {"R_goal": 0.75, "wilson": [0.6, 0.9], "P_complete": 1.0, "mean": 4.0, "q90": 5.0}
    result = {
        "task": "t",
        "begun": 4,
        "selector": "fixed",
        "seed": 1,
        "sim_s": 1.0,
        "wall_s": 1.0,
        "rows": "table.csv",
    }
    result |= {
        "by_regime": {"C+arm50+latency200": part},
        "chosen": {},
        "J": {},
        "times_real_time_per_core": 1.0,
        **part,
    }
    rows = [line.split() for line in text_of(result).splitlines()[1:3]]
    assert [row[:3] for row in rows] == [
        ["C+arm50+latency200", "R_goal", "0.7500"],
        ["all", "R_goal", "0.7500"],
    ]


@pytest.mark.processes
def test_no_worker_outlives_a_killed_campaign(tmp_path: Path) -> None:
    """Not even a hanging worker does, which is frozen here."""
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "campaign",
        *TOY,
        "--runs",
        "20000",
        "--regime",
        "easy",
        "--workers",
        "2",
    ]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}"}
    campaign = subprocess.Popen(
        [*command, "--out", "part"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: _frozen_with_its_workers_at_work(campaign, tmp_path / "part"))
        workers = [os.pidfd_open(pid) for pid in children(campaign.pid)]
        for worker in workers:
            signal.pidfd_send_signal(worker, signal.SIGSTOP)
    finally:
        campaign.kill()
        campaign.wait()
    gone = [bool(select.select([worker], [], [], PATIENCE_S)[0]) for worker in workers]
    for worker in workers:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(worker, signal.SIGKILL)
        os.close(worker)
    assert gone == [True, True]


def _frozen_with_its_workers_at_work(campaign: subprocess.Popen[bytes], folder: Path) -> bool:
    """Freeze a campaign with two workers that both have begun their first block."""

    def at_work() -> bool:
        known, there = {int(row["worker"]) for row in times(folder)}, children(campaign.pid)
        return len(there) == 2 and known.issuperset(there)

    assert campaign.poll() is None
    if not at_work():  # frozen at each look, it would hardly begin on a busy host
        return False
    campaign.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, campaign.pid, os.WSTOPPED)
    if at_work():
        return True
    campaign.send_signal(signal.SIGCONT)
    return False


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["campaign", *TOY, "--selector", "oracle"], "choose one of fixed, round_robin"),
        (["campaign", *TOY, "--choose", "look=stare"], "choose one of look_quick"),
        (["campaign", *TOY, "--choose", "look"], "expected TASK=ACTION"),
        (
            ["campaign", *TOY, "--regime", "hard", "--set", "regime=easy"],
            "--set: regime is given as easy and as hard",
        ),
        (["campaign", *TOY, "--regime", "easy,easy"], "each regime once"),
        (["campaign", *TOY, "--seed", "-1"], "-1 is not a whole number of at least 0"),
        (["campaign", *TOY, "--credit", "task"], "--credit task: --selector fixed does not learn"),
        (["campaign", *TOY, "--batch", "5"], "--batch 5: --selector fixed does not learn"),
        (["campaign", *TOY, "--rho", "-3"], "-3 is not a number of at least 0"),
        (["campaign", *TOY, "--rho", "nan"], "nan is not a number of at least 0"),
        (["campaign", *TOY, "--rho", "inf"], "inf is not a number of at least 0"),
        (["campaign", *TOY, "--rho", "much"], "much is not a number of at least 0"),
        (["campaign", *TOY, "--target", "3"], "3 is not a number of more than 0 and at most 1"),
        (["campaign", *TOY, "--target", "0"], "0 is not a number of more than 0 and at most 1"),
        (["campaign", *TOY, "--target", "nan"], "nan is not a number of more than 0 and at most 1"),
        (["campaign", *TOY, "--set", "speed=1"], "no parameter 'speed'"),
        (["campaign", "catch_ball", *TOY[1:]], "may not run with"),
        (["campaign", "--resume", "nowhere"], "holds no campaign"),
        (["campaign", *TOY, "--resume", "nowhere"], "TASK: a campaign is continued as it began"),
        (["campaign", "--resume", "nowhere", "--runs", "7"], "--runs: a campaign is continued"),
        (["campaign", "--resume", "nowhere", "--rho", "0.5"], "--rho: a campaign is continued"),
        (["campaign", "--resume", "nowhere", "--out", "other"], "--out: a campaign is continued"),
        (["campaign"], "give a TASK"),
        (["campaign", *TOY, "--learned", "nowhere"], "not the result of a finished campaign"),
        (["campaign", *TOY, "--check", "nowhere.json"], "nowhere.json is not a forecast"),
        (["forecast", str(TASK)], "--estimates CAMPAIGN"),
        (["forecast", str(TASK), "--estimates", "nowhere.db"], "holds no estimates"),
        (["forecast", "--compare", "nowhere.json", "nowhere"], "is not a forecast"),
    ],
)
def test_bad_input(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit code 2, and one line with the remedy."""
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


def test_choices_of_another_regime_are_no_learned_choices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first alternatives are not passed off as what was learned."""
    write_manifest(tmp_path, CampaignPlan(str(TASK), str(SERVICES), 3, ("easy",), 1))
    result = {"task": "fetch", "selector": "thompson", "policy": {"easy": {}}}
    (tmp_path / "result.json").write_text(json.dumps(result), encoding="utf-8")
    given = ["campaign", *TOY, "--regime", "easy,rough", "--learned", str(tmp_path)]
    assert main(given) == 2
    assert "nothing was learned of regime rough; there are easy" in capsys.readouterr().err


# --- progress ---------------------------------------------------------------------------------


@pytest.mark.processes
def test_two_processes_never_write_one_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second process reports which one is writing to the folder, and changes nothing. A lock
    whose holder has ended is ignored."""
    folder = tmp_path / "one"
    campaign(folder, "--runs", "3")
    before = (folder / "table.csv").read_bytes()
    (folder / "table.csv").write_bytes(before + b"half a row of the one that is at it")
    with held(folder):
        assert main(["campaign", *TOY, "--out", str(folder), "--workers", "1", "--runs", "3"]) == 2
    assert f"process {os.getpid()} is running this campaign" in capsys.readouterr().err
    assert (folder / "table.csv").read_bytes() != before
    campaign(folder, "--runs", "3")
    assert (folder / "table.csv").read_bytes() == before


def test_progress_line() -> None:
    """It has a bar, the share of trials that met their goal in this session, and the remaining time
    at this session's speed."""
    shown = line(CampaignProgress(60, 100, 20, 30, 80.0))
    assert "60/100" in shown and "75.0% met" in shown and "1:20 gone, 1:20 to go" in shown
    assert line(CampaignProgress(0, 10, 0, 0, 0.0)).startswith("[....")
    assert [clock(s) for s in (0, 59.6, 3600)] == ["0:00", "1:00", "1:00:00"]


def test_progress_is_for_terminals(capsys: pytest.CaptureFixture[str]) -> None:
    """In a terminal one line is overwritten; elsewhere nothing is printed."""
    silent = ProgressLine(sys.stderr)
    silent(CampaignProgress(1, 2, 0, 1, 1.0))
    silent.close()
    assert capsys.readouterr().err == ""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal:
        shown = ProgressLine(terminal)
        for done in (1, 2):
            shown(CampaignProgress(done, 2, 0, 1, float(done)))
        shown.close()
        told = b""
        limit = Limit("the end of the line")
        while not told.endswith(b"\n") and limit.left():
            told += os.read(ours, 1000)
    os.close(ours)
    assert told.count(b"\r[") == 2 and told.count(b"\n") == 1
