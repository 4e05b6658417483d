"""What is recorded of a trial: scripted missions of the shipped task, and conversion to rows and
back."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.engine import (
    Begin,
    Chosen,
    Corrected,
    Engine,
    EventOccurred,
    RunEnded,
    Stimulus,
    StopConfirmed,
)
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.studies.campaign.block import scores
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, identity
from petrobot.coordinator.studies.campaign.table import TrialRow, cells, columns, read_row
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial, TrialLog
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import load
from petrobot.services.action import Status as ActionStatus
from petrobot.services.scripted import ScriptedRun
from tests.run.scripted_cell import directory_for, scripts
from tests.studies.campaign.conftest import TASK

TOY = load(TASK)


def logged(lines: dict[str, list[ScriptedRun]], runs: int = 3) -> tuple[TrialLog, Mission]:
    """Return trials of catch_ball with scripted actions."""
    task = load_task("catch_ball")
    cell, party = lockstep_cell(directory_for(task), Setting(task, runs=runs), scripts(task, lines))
    log = TrialLog(task, lambda record, values: record.seconds)
    party.mission.executor.observers.append(log)
    assert cell.run(lambda: party.over, 400_000)
    return log, party.mission


def test_a_trial_lists_its_runs_and_the_transitions_that_took_them() -> None:
    """Durations count from the arrival of the token; parallel runs are both listed; the trial ends
    when all tokens are back."""
    log, _ = logged(
        {"locate_ball": [ScriptedRun(seconds=(0.4, 0.4), values={"ball": [0.0], "images": 20})]}
    )
    assert len(log.trials) == 3
    trial = log.trials[0]
    by_place = {run.place: run for run in trial.runs}
    assert [
        by_place[p].taken
        for p in ("locate_ball", "track_ball", "move_to_point", "catch_ball", "return_home")
    ] == [
        "located",
        "tracked",
        "in_place",
        "missed",
        "homed",
    ]
    assert by_place["locate_ball"].seconds == pytest.approx(0.4, abs=0.01)
    assert by_place["locate_ball"].took >= by_place["locate_ball"].seconds
    assert by_place["locate_ball"].values == {"images": 20.0}
    assert (
        by_place["track_ball"].begun
        == by_place["move_to_point"].begun
        == pytest.approx(by_place["locate_ball"].took)
    )
    home = by_place["return_home"]
    assert trial.time == pytest.approx(home.begun + home.took)
    assert trial.waits[0][0] == "start" and 0 <= trial.waits[0][1] <= 0.05
    assert trial.fired["located"] == 1 and trial.completed and trial.all_success


def test_an_error_branch_belongs_to_its_trial() -> None:
    """Recovery is part of the trial that needed it, not of the next one."""
    bad = ScriptedRun(ActionStatus.ERROR, (0.1, 0.1), cause="unreachable", text="too far")
    log, _ = logged(
        {"move_to_point": [bad, ScriptedRun(seconds=(0.2, 0.2)), ScriptedRun(seconds=(0.2, 0.2))]}
    )
    first, second, _ = log.trials
    assert (first.status, first.cause) == ("error", "unreachable")
    assert first.fired["recovered"] == first.fired["arm_back"] == 1
    assert first.completed and not first.all_success
    assert second.status == "success" and "recovered" not in second.fired


def test_a_preempted_run_costs_the_time_until_its_token_was_taken() -> None:
    """As for `run --learn`: its node says some time later that it has stopped."""
    task = load_task("catch_ball")
    engine, log = Engine(task), TrialLog(task, lambda record, values: record.seconds)
    state = engine.initial()
    script: list[tuple[float, Stimulus]] = [
        (0.0, Begin()),
        (1.0, EventOccurred("image_tick")),
        (1.0, Chosen("locate_ball#1", "locate_hough")),
        (2.0, RunEnded("locate_ball#1", Status.SUCCESS)),
        (2.0, Chosen("move_to_point#1", "intercept_tilted")),
        (2.5, EventOccurred("ball_caught")),
        (2.504, StopConfirmed("move_to_point#1", seconds=0.504)),
    ]
    for now, stimulus in script:
        log.stimulus(now, stimulus)
        state, said = engine.handle(state, stimulus)
        for one in said:
            log.instruction(now, one)
        log.settled(now, state)
    (run,) = [run for run in log.trials[0].runs if run.cancelled]
    assert (run.taken, run.took, run.seconds, run.cost) == ("caught_early", 0.5, 0.504, 0.5)


def test_giving_up_leaves_later_trials_unstarted() -> None:
    """The last trial was started but not completed; later ones were not started."""
    dead = [ScriptedRun(ActionStatus.ERROR, (0.1, 0.1), cause="drive_fault")]
    log, mission = logged({"move_to_point": dead, "recover_arm": dead}, runs=4)
    assert len(log.trials) == 1 < mission.runs
    assert not log.trials[0].completed and log.trials[0].time is None
    assert log.trials[0].status == "error"


def test_a_deferred_verdict_corrects_the_entry() -> None:
    """It is corrected once, for the estimates."""
    log, _ = logged({}, runs=1)
    log.instruction(
        9.0,
        Corrected(
            "locate_ball#1",
            "locate_ball",
            "locate_background",
            Status.SUCCESS,
            Status.FAILURE,
            "late",
        ),
    )
    runs = [run for run in log.trials[0].runs if run.place == "locate_ball"]
    known = [key for key in log._entries if key.startswith("locate_ball")]
    log.instruction(
        9.0,
        Corrected(known[0], "locate_ball", runs[0].action, Status.SUCCESS, Status.FAILURE, "late"),
    )
    assert (runs[0].status, runs[0].cause) == ("failure", "late")


# --- rows -------------------------------------------------------------------------------------

TEXT = st.text(st.characters(exclude_characters="\r", exclude_categories=["Cs"]), max_size=12)
FINITE = st.floats(-1e6, 1e6).map(lambda x: round(x, 6))
RUNS = st.builds(
    RunEntry,
    place=st.sampled_from(["look", "grip", "mend"]),
    action=st.sampled_from(["look_quick", "grip_soft"]),
    begun=FINITE,
    took=FINITE,
    status=st.sampled_from(["success", "failure", "error", ""]),
    cause=TEXT,
    text=TEXT,
    seconds=FINITE,
    cost=st.none() | FINITE,
    values=st.dictionaries(TEXT, FINITE, max_size=2),
)
TRIALS = st.builds(
    Trial,
    k=st.integers(1, 99),
    begun=FINITE,
    time=st.none() | FINITE,
    completed=st.booleans(),
    goals=st.integers(0, 3),
    status=st.sampled_from(["success", "failure", "error"]),
    cause=TEXT,
    runs=st.lists(RUNS, max_size=3),
    waits=st.lists(st.builds(Waited, TEXT, FINITE, st.sampled_from(WaitEnd)), max_size=2),
    fired=st.dictionaries(TEXT, st.integers(1, 3), max_size=2),
)
SCORES = st.dictionaries(
    st.sampled_from(["t.x", "t.flag", "t.word"]),
    st.booleans() | FINITE | st.integers(-5, 5) | st.sampled_from(["caught", 'a,b\n"c"']),
)


@given(TRIALS | st.none(), SCORES, st.booleans())
def test_rows_survive_conversion(trial: Trial | None, score: dict[str, Any], known: bool) -> None:
    """CSV keeps any text; results that the first block did not have are stored in `more`."""
    row = TrialRow(7, "easy", 1_000_000, trial.k if trial else 2, 1, 3.25, trial, score)
    names = columns(TOY, [row] if known else [])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerow(cells(TOY, row, names))
    out.seek(0)
    (record,) = csv.DictReader(io.StringIO(out.getvalue(), newline=""))
    back = read_row(record)
    assert back.trial == row.trial
    assert back.score == row.score
    assert (back.n, back.regime, back.seed, back.k, back.mission_s) == (
        row.n,
        row.regime,
        row.seed,
        row.k,
        row.mission_s,
    )


def test_carriage_returns_do_not_break_the_table() -> None:
    """They are converted to newlines, which CSV quotes."""
    row = TrialRow(1, "", 1, 1, 0, 1.0, Trial(1, 0.0, cause="one\rtwo\r\nthree"))
    names = columns(TOY, [])
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([names, cells(TOY, row, names)])
    (record,) = csv.DictReader(io.StringIO(out.getvalue(), newline=""))
    assert record["cause"] == "one\ntwo\nthree"


@given(TRIALS)
def test_trials_survive_conversion_to_plain_data(trial: Trial) -> None:
    """A worker sends them to the campaign."""
    import json

    assert Trial.from_plain(json.loads(json.dumps(trial.to_plain()))) == trial


def test_scores_are_assigned_to_their_trials() -> None:
    """They are assigned by `run` if given, otherwise by `n`; plain values belong to a single
    trial."""
    score = {
        "balls": [
            {"n": 1, "run": 2, "x": 0.5},
            {"n": 2, "run": 3, "x": 0.7},
            {"n": 3, "run": None, "x": 0.9},
        ],
        "parts": [{"n": 1, "y": 1.0}],
        "seen": 3,
    }
    one, two, three = scores(score, 3)
    assert one == {"parts.n": 1, "parts.y": 1.0}
    assert two == {"balls.n": 1, "balls.x": 0.5}
    assert three == {"balls.n": 2, "balls.x": 0.7}
    assert scores({"time_s": 4.0, "track": {"a": 1}, "penalties": []}, 1) == [{"score.time_s": 4.0}]
    assert scores({"time_s": 4.0}, 2) == [{}, {}]


def test_the_identity_of_a_campaign_does_not_depend_on_its_folder(toy_plan: CampaignPlan) -> None:
    """The same files in another folder are the same campaign."""
    from msgspec.structs import replace

    assert identity(replace(toy_plan, task="/elsewhere.toml")) == identity(toy_plan)
    assert identity(replace(toy_plan, seed=2)) != identity(toy_plan)
