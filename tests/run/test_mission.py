"""A mission run over scripted actions in lock step: results, cycles, errors, repetition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.engine import Corrected, Engine, Finished, Fired, Report, RunRecorded
from petrobot.coordinator.engine.instructions import Marked, Severity
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.run.executor import Executor
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.mission import Cycle, Mission, MissionError, MissionTally, Stage
from petrobot.coordinator.run.timeline import Timeline
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.file import loads
from petrobot.services.action import Status as ActionStatus
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.events import STOP_EVENT
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol import messages as m
from petrobot.services.scripted import ScriptedRun
from tests.run.scripted_cell import directory_for, scripts
from tests.run.toy_arm import SERVICES, TASK


def run(task: Task, lines: dict[str, list[ScriptedRun]], **given: Any) -> tuple[Mission, Timeline]:
    """Run the task to its end, at most an hour of simulated time."""
    timeline = Timeline()
    cell, party = lockstep_cell(directory_for(task), Setting(task, **given), scripts(task, lines))
    party.mission.executor.observers.append(timeline)
    assert cell.run(lambda: party.over, 900_000)
    return party.mission, timeline


def failing(cause: str, status: ActionStatus = ActionStatus.ERROR) -> ScriptedRun:
    """Return a script whose run ends in ERROR after 0.1 s with this cause."""
    return ScriptedRun(status, (0.1, 0.1), cause=cause)


GOOD = ScriptedRun(seconds=(0.2, 0.2))


def test_an_error_of_the_net_is_logged_when_it_occurs(caplog: pytest.LogCaptureFixture) -> None:
    """A task that is stuck may never have a result."""
    tally = MissionTally(None)
    tally.instruction(1.5, Report(Severity.ERROR, "nowhere_to_go", "scan#1 has nowhere to go"))
    tally.instruction(2.0, Report(Severity.WARNING, "bad_value", "scan#1 gave nothing"))
    assert [r.getMessage() for r in caplog.records] == ["1.500 s: scan#1 has nowhere to go"]
    assert tally.happened(recovered=False) == "0 runs; 1 value missing [scan#1 gave nothing]"


def test_a_missed_goal_names_the_verdict_that_cost_it() -> None:
    """Not the error before it, from which the task recovered. A preempted run is a run, too."""
    tally, cell = (
        MissionTally(0, frozenset({"counted"})),
        parse(SERVICES.replace("ON_RESUME", "rejoin"), Path("services.toml")),
    )
    for n, verdict in enumerate((Status.SUCCESS, Status.FAILURE), 1):
        tally.instruction(n, Fired(n, "go", (3 - n,), (2 - n,), "Begin", ()))
        for place, status, cause, cancelled in (
            ("grip", Status.ERROR, "slipped", False),
            ("stand", Status.SUCCESS, "", True),
            ("scan", Status.SUCCESS, "", False),
        ):
            end = (f"{place}#{n}", place, place, "do", status, cause, "", Executed.YES, 1.0)
            tally.instruction(n, RunRecorded(*end, cancelled))
        verdicts = ("wrong_bin", "A in bin B") if verdict is Status.FAILURE else ()
        given = (f"scan#{n}", "scan", "do", Status.SUCCESS, verdict)
        tally.instruction(n, Corrected(*given, *verdicts))
        if verdict is Status.SUCCESS:
            tally.instruction(n, Fired(9, "counted", (2 - n,), (2 - n,), "x", ()))
    told = tally.happened(True, True)
    assert told.startswith("6 runs, 2 of them preempted; 2 errors, all recovered, 1 of them where")
    [row] = tally.missed(cell)
    assert (row["run"], row["cause"], row["text"]) == ("scan#2", "wrong_bin", "A in bin B")
    assert row["goals"] == 1
    tally.instruction(9.0, Corrected("scan#2", "scan", "do", Status.FAILURE, Status.SUCCESS))
    assert [row["run"] for row in tally.missed(cell)] == ["grip#2"]
    tally.goals += 1  # of which cycle?
    assert not tally.missed(cell)


def test_a_long_mission_run_needs_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that were forgotten still count."""
    monkeypatch.setattr("petrobot.coordinator.run.mission.KEPT", 10)
    tally = MissionTally(0)
    for n in range(1, 101):
        tally.instruction(n, Fired(n, "go", (101 - n,), (100 - n,), "Begin", ()))
        status, cause = (Status.ERROR, "slipped") if n % 5 == 0 else (Status.SUCCESS, "")
        tally.instruction(
            n, RunRecorded(f"w#{n}", "w", "w", "do", status, cause, "", Executed.YES, 1.0)
        )
    assert tally.happened(True) == "100 runs; 20 errors, all recovered [w: slipped (20)]"
    tally.instruction(101.0, Corrected("w#95", "w", "do", Status.ERROR, Status.SUCCESS))
    assert tally.happened(True) == "100 runs; 19 errors, all recovered [w: slipped (19)]"
    missed = ", all recovered, 19 of them where a goal was missed"
    assert missed in tally.happened(True, missed=True)
    kept = {cycle.number: cycle.status for cycle in tally.cycles}
    assert tally.begun == 100 and kept[95] is Status.SUCCESS and kept[100] is Status.ERROR
    assert 10 <= len(kept) <= 20 and 10 <= len(tally.runs) <= 20


def test_a_cycle_without_end_needs_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot on patrol: one token of the runs place, and runs for months."""
    monkeypatch.setattr("petrobot.coordinator.run.mission.KEPT", 10)
    cycle = Cycle(1, 0.0)
    for n in range(1, 101):
        cycle.count(f"w#{n}", Status.FAILURE if n in (3, 7) else Status.SUCCESS, f"late {n}", "")
    assert 10 <= len(cycle.ends) <= 20 and cycle.worst == (Status.FAILURE, "late 3", "")
    cycle.count("w#100", Status.ERROR, "slipped", "")
    assert cycle.worst == (Status.ERROR, "slipped", "")


@pytest.mark.parametrize(
    ("reason", "told"),
    [
        ("a == 0", "a == 0"),
        ("(a == 0) and b == 0", "a == 0, and the other plain place is empty"),
        (
            "((a == 0) or (b > 1)) and c.begin == 0 and d == 0; x#1 could not be stopped",
            "(a == 0) or (b > 1), and the other 2 plain places are empty; x#1 could not be stopped",
        ),
        ("(a == 0) and (b == 1) and c == 0", "(a == 0) and (b == 1) and c == 0"),
        ("(a == 0) and b == 1", "(a == 0) and b == 1"),
    ],
)
def test_the_reason_of_the_end_names_what_the_file_says(reason: str, told: str) -> None:
    """A task with subnets has dozens of plain places, and the reason had twenty lines."""
    what = "final marking reached: "
    assert Finished(Status.SUCCESS, what + reason).told == what + told
    assert Finished(Status.ERROR, "given up: (a == 0)").told == "given up: (a == 0)"


def test_four_runs_reach_final(catch_ball: Task) -> None:
    """The initial marking of figure 1 has four run tokens."""
    mission, timeline = run(catch_ball, {})
    result = mission.result("lockstep", 1.0)
    assert (result["status"], result["runs"], len(mission.tally.cycles)) == ("success", 4, 4)
    assert result["firings"] == len(timeline.firings) > 4 * 5
    assert result["sim_s"] > 4 * 2.0
    assert [c.number for c in mission.tally.cycles] == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("status", "text", "told"),
    [
        (Status.SUCCESS, "by caught", "by caught, counted as success"),
        (None, "by caught", "by caught, not counted"),
        (
            Status.SUCCESS,
            "by caught; it had ended with error, cancelled",
            "by caught, counted as success",
        ),
        (
            None,
            "by caught; it had ended with failure, slow",
            "by caught, not counted; its own result came too late: failure, slow",
        ),
    ],
)
def test_a_preempted_run_names_the_transition_that_took_its_token(
    status: Status | None, text: str, told: str
) -> None:
    """The reason names the preempting transition, not the cancelled action's own error, and how the
    run counts."""
    timeline = Timeline()
    why = f"preempted {text}"
    run = RunRecorded(
        "catch#1", "catch", "catch", "wait", status, "cancelled", why, Executed.YES, 1.0, True
    )
    timeline.instruction(1.0, run)
    bar = timeline.bars["catch#1"]
    assert (bar.status, bar.cause, bar.text) == (status, "", f"preempted {told}")
    timeline.instruction(1.0, replace(run, cancelled=False))
    assert timeline.bars["catch#1"].cause == "cancelled"


@pytest.mark.parametrize("runs", [1, 7])
def test_the_user_sets_the_number_of_runs(catch_ball: Task, runs: int) -> None:
    """--runs puts tokens into the runs place."""
    mission, _ = run(catch_ball, {}, runs=runs)
    assert len(mission.tally.cycles) == mission.runs == runs


@pytest.mark.parametrize(
    ("primitive", "cause"),
    [
        ("locate_ball", "no_ball"),
        ("track_ball", "ball_lost"),
        ("move_to_point", "unreachable"),
        ("catch_ball", "drive_fault"),
        ("return_home", "drive_fault"),
    ],
)
def test_every_error_branch_returns_to_the_normal_flow(
    catch_ball: Task, primitive: str, cause: str
) -> None:
    """An error in the first run uses up that run; the others continue."""
    good = [GOOD] * 3
    mission, timeline = run(catch_ball, {primitive: [failing(cause), *good]})
    assert mission.executor.finished is not None
    assert mission.executor.finished.status is Status.SUCCESS
    assert [c.status for c in mission.tally.cycles] == [Status.ERROR, *[Status.SUCCESS] * 3]
    assert mission.tally.cycles[0].worst[1] == cause
    assert [bar.cause for bar in timeline.bars.values() if bar.status is Status.ERROR] == [cause]


@pytest.mark.parametrize(("primitive", "met"), [("move_to_point", 3), ("return_home", 4)])
def test_an_error_that_cost_a_goal_is_told_apart(
    catch_ball: Task, primitive: str, met: int
) -> None:
    """In this script each trial whose arm arrives meets its goal, `missed`. A goal that was missed
    for another reason leaves the errors recovered."""
    goal = ("missed",)
    flat = replace(catch_ball.flat, goal_transitions=goal)
    task = replace(catch_ball, goal_transitions=goal, expansion=flat)
    mission, _ = run(task, {primitive: [failing("drive_fault"), *[GOOD] * 3]})
    told = mission.result("lockstep", 0.0)
    assert (told["status"], told["goals"]) == ("success", f"{met} of 4")
    cost = ", 1 of them where a goal was missed" if met == 3 else ""
    assert f"1 error, all recovered{cost} [" in told["happened"]
    place = mission.tally.runs_place
    assert place is not None
    after = tuple(n == place for n in range(place + 1))
    mission.tally.instruction(0.0, Marked("balls_left", (0,) * (place + 1), after))
    told = mission.result("lockstep", 0.0)  # the operator asked for one more
    assert told["goals"] == f"{met} of 5"
    assert f"1 error, all recovered{cost} [" in told["happened"]


@pytest.mark.parametrize(
    ("per_run", "runs", "said"), [(1, 3, "3 of 3"), (2, 3, "6 in 3 runs"), (2, 1, "2 in 1 run")]
)
def test_goals_are_a_share_of_the_runs_only_where_they_can_be(
    catch_ball: Task, per_run: int, runs: int, said: str
) -> None:
    goals = ("missed", "homed")[:per_run]
    flat = replace(catch_ball.flat, goal_transitions=goals)
    task = replace(catch_ball, goal_transitions=goals, expansion=flat)
    mission, _ = run(task, {}, runs=runs)
    assert mission.result("lockstep", 0.0)["goals"] == said


def test_an_arm_that_cannot_be_recovered_ends_the_task_in_error(catch_ball: Task) -> None:
    """After four failed recoveries in a row the task ends with `final_error`, with runs left."""
    mission, _ = run(
        catch_ball,
        {"move_to_point": [failing("drive_fault")], "recover_arm": [failing("drive_fault")]},
    )
    finished = mission.executor.finished
    assert finished is not None
    assert finished.status is Status.ERROR
    assert len(mission.tally.cycles) == 1
    assert sum(r.place == "recover_arm" for r in mission.tally.runs) == 4


def test_a_result_says_once_why_actions_ended_in_error(catch_ball: Task) -> None:
    """Each primitive task and cause once, the last one last; also if the task recovered."""
    lines = {"move_to_point": [failing("bad_arguments")], "recover_arm": [failing("drive_fault")]}
    mission, _ = run(catch_ball, lines)
    told = mission.result("lockstep", 0.0)["last_errors"]
    assert [(e["run"], e["cause"]) for e in told] == [
        ("move_to_point#1", "bad_arguments"),
        ("recover_arm#4", "drive_fault"),
    ]
    where = mission.executor.directory.where
    assert all(e["node"] == where(e["action"]) for e in told)
    recovered, _ = run(catch_ball, {"move_to_point": [failing("bad_arguments"), GOOD, GOOD, GOOD]})
    result = recovered.result("lockstep", 0.0)
    assert (result["status"], len(result["last_errors"])) == ("success", 1)
    good, _ = run(catch_ball, {})
    assert "last_errors" not in good.result("lockstep", 0.0)


def test_failure_continues_on_the_normal_branch(catch_ball: Task) -> None:
    """A ball that passes is a FAILURE: the run is used up, and no recovery starts."""
    mission, timeline = run(catch_ball, {"catch_ball": [failing("missed", ActionStatus.FAILURE)]})
    assert [c.status for c in mission.tally.cycles] == [Status.FAILURE] * 4
    assert not any(bar.place == "recover_arm" for bar in timeline.bars.values())


def test_a_raised_deadline_is_an_error_with_a_reason(catch_ball: Task) -> None:
    """The node ends a run at its deadline."""
    mission, _ = run(
        catch_ball, {"locate_ball": [ScriptedRun(seconds=(1e6, 1e6)), GOOD, GOOD, GOOD]}
    )
    first = mission.tally.runs[0]
    assert (first.status, first.cause) == (Status.ERROR, "deadline")
    assert 8.0 <= first.seconds < 8.2


def test_the_same_seed_gives_the_same_run(catch_ball: Task) -> None:
    """Scripts draw durations by seed and run."""
    lines = {"track_ball": [ScriptedRun(seconds=(0.1, 2.0))]}
    one, again, other = (run(catch_ball, lines, seed=seed)[1] for seed in (5, 5, 6))
    assert one.firings == again.firings
    assert one.firings != other.firings


def test_the_user_chooses_the_action(catch_ball: Task) -> None:
    """The action that the selector chose runs, and the record has the selector's reason."""
    chosen = FirstAlternative({"track_ball": "predict_kalman"})
    mission, _ = run(catch_ball, {}, selector=chosen, runs=1)
    track = next(r for r in mission.tally.runs if r.place == "track_ball")
    assert track.action == "predict_kalman"
    assert (track.status, track.cause) == (Status.ERROR, "not_offered")


def prepared_mission(memory: bool = False) -> tuple[Mission, Caller]:
    """Return a mission run that has a preparation and is connected to its node, and its caller."""
    text = TASK.replace('name = "toy"', 'name = "toy"\nprepare = "lab_prepare"')
    places = parse(
        SERVICES.replace("ON_RESUME", "rejoin")
        + '[services.lab_prepare]\nrun = "toy:prepare"\nnode = "motion"\n'
        + '[services.memory]\nnode = "motion"\n' * memory,
        Path("services.toml"),
    )
    caller = Caller("motion", m.Hello(2, 2, "coordinator", "m", "c1", 1))
    task = loads(text, "toy")
    mission = Mission(Executor(task, Engine(task), places, {"motion": caller}, "m"), {}, 1)
    caller.link_up(0.0, m.Welcome(1, "motion", "n1"))
    mission.take(0.0, "motion", caller.notices())
    return mission, caller


@pytest.mark.parametrize("prepares", [False, True], ids=["waits for devices", "prepares"])
@pytest.mark.parametrize("told", ["at once", "when it is back"])
def test_a_stop_before_the_task_has_begun_ends_the_mission_run(prepares: bool, told: str) -> None:
    """It did not subscribe to anything yet. Else a task that waits for a button would begin, and
    not say before the button that it can do nothing."""
    mission, caller = prepared_mission()
    if prepares:
        mission.start(0.0)
    if told == "at once":
        caller.receive(1.0, m.Event(STOP_EVENT, "motion", 0))
    else:
        caller.link_down(1.0, "cut")
        caller.link_up(2.0, m.Welcome(1, "motion", "n1+1"))
    with pytest.raises(MissionError, match="emergency stop, as motion reports: the task was not"):
        mission.take(2.0, "motion", caller.notices())


@pytest.mark.parametrize("boot", ["n1", "n2"])
def test_a_memory_that_was_lost_in_the_run_is_in_the_result(
    boot: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Its node, not a new connection to it, was started again."""
    mission, caller = prepared_mission(memory=True)
    mission.begun, mission.stage = 1.0, Stage.RUNNING
    caller.link_down(4.0, "cut")
    caller.link_up(5.0, m.Welcome(1, "motion", boot))
    mission.take(5.0, "motion", caller.notices())
    lost = "motion, which keeps the global memory, was started again at 4.0 s: what it held is lost"
    assert mission.result("realtime", 1.0).get("memory") == (lost if boot == "n2" else None)
    assert ("what the global memory held is lost" in caplog.text) is (boot == "n2")


def test_a_repeated_preparation_says_that_it_may_be_one() -> None:
    """The call says that it may be a repetition, so a node that has forgotten its oldest calls does
    not prepare the cell a second time."""
    asked = []
    for resumed in (False, True):
        mission, caller = prepared_mission()
        if resumed:
            mission.resume(0.0, {})
        else:
            mission.start(0.0)
        asked += [
            (call.id, call.again) for call in caller.messages(0.0) if isinstance(call, m.Call)
        ]
    assert asked == [("m/prepare", False), ("m/prepare", True)]
