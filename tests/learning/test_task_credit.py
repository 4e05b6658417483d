"""Credit by the task: what judges a choice, when, and that the one thing that is learned otherwise
is the choice."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.coordinator.engine import Stimulus
from petrobot.coordinator.engine.stimuli import Abort
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.estimate import Observation
from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import Credit, RunEnd, TrialEnd
from petrobot.coordinator.learning.selectors import credited, verdicts_of_task
from petrobot.coordinator.learning.session import LearningSession, LearningSetting
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.studies.campaign.block import costs
from petrobot.coordinator.studies.campaign.observed import observation
from petrobot.coordinator.studies.campaign.trials import TrialLog
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.file import loads
from petrobot.services.action import Context, Result, Status as ActionStatus, error, success
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.scripted import Scripted, ScriptedRun
from tests.learning.cell import TASK_FILE, directory, scripts, sorting

Scripts = Mapping[str, Callable[..., Any]]


@pytest.fixture(scope="module")
def task() -> Task:
    """The sorting task: pick a part, place it."""
    return sorting()


def played(
    task: Task,
    selector: LearningSelector,
    runs: int,
    does: Scripts | None = None,
    log: TrialLog | None = None,
    stop: tuple[float, Stimulus] | None = None,
) -> Mission:
    """Run the task; `stop`: a stimulus at a simulated time (s)."""
    cell, party = lockstep_cell(
        directory(task), Setting(task, {}, runs, 1, selector), does or scripts()
    )
    mission = party.mission
    if log is not None:
        mission.executor.observers.append(log)
    if stop is not None:
        assert not cell.run(lambda: party.over, round(stop[0] / TICK))
        mission.executor.stimulate(cell.now, stop[1])
    assert cell.run(lambda: party.over, 900_000)
    return mission


def verdicts(selector: LearningSelector) -> list[Credit]:
    return [record for record in selector.records if isinstance(record, Credit)]


def test_the_task_judges_each_action_of_a_token_once() -> None:
    """By goal and cost of the trial, in the measure of the primitive task. A run that its node
    never began counts as such; one that was cancelled before it began does not count."""
    measures = {"pick": "wall", "place": "value:tries", "press": "cpu", "wipe": "count"}
    runs = [
        ("pick", "fast", "", Observation(Status.SUCCESS, 1.0, values={"tries": 9.0})),
        ("pick", "fast", "", Observation(Status.FAILURE, 2.0)),
        ("place", "soft", "x=1", Observation(Status.ERROR, 1.0, cpu_seconds=0.25)),
        ("place", "hard", "", Observation(None, 0.5, executed=Executed.NO, preempted_by="jam")),
        ("press", "flat", "", Observation(None, 0.5, preempted_by="jam", cpu_seconds=0.5)),
        ("wipe", "wet", "", Observation(Status.ERROR, 0.0, executed=Executed.NO)),
        ("wipe", "dry", "", Observation(Status.SUCCESS, 0.5, values={"count": 3.0})),
    ]
    for met, status in ((True, Status.SUCCESS), (False, Status.FAILURE)):
        found = {
            (one.primitive_task, one.action): one
            for one in verdicts_of_task(runs, met, 7.5, measures.__getitem__)
        }
        assert list(found) == [
            *(("pick", "fast"), ("place", "soft"), ("press", "flat")),
            *(("wipe", "wet"), ("wipe", "dry")),
        ]
        missing = found.pop(("wipe", "wet"))
        assert missing.outcome is runs[5][3]
        assert {one.outcome.status for one in found.values()} == {status}
        assert {one.outcome.seconds for one in found.values()} == {7.5}
        assert found["place", "soft"].context == "x=1"
        assert found["place", "soft"].outcome.values == {"tries": 9.0}
        assert found["press", "flat"].outcome.cpu_seconds == 0.75
        # four runs that report no number count one each, as a measure `count` has it
        assert found["wipe", "dry"].outcome.values == {"count": 7.0}
    (unknown,) = verdicts_of_task(runs[:1], False, math.nan, lambda _: "value:none")
    assert math.isnan(unknown.outcome.values["none"])


def breaking() -> Task:
    """The sorting task, which gives up for good when a part is lost; picking costs CPU time."""
    text = TASK_FILE.read_text(encoding="utf-8").replace('cost = "wall"', 'cost = "cpu"')
    text = text.replace('free == 1"\n', 'free == 1"\nfinal_error = "broken == 1"\n')
    text = text.replace(
        'in = ["place:error"]\nout = ["free"]', 'in = ["place:error"]\nout = ["broken"]'
    )
    return loads(text + '\n[places.broken]\nkind = "control"\n', "sorting.toml")


@pytest.mark.parametrize("gives_up", [False, True])
def test_a_mission_run_judges_as_a_campaign_does(task: Task, gives_up: bool) -> None:
    """The verdicts of the learning selector are those that the rows of a campaign's table give:
    the same trials, goals, durations and costs. They come before the next token is taken. A trial
    in which the task gave up as designed has not met the goal, and no duration. No measured CPU
    time counts, also of runs whose own cost is another."""
    does = scripts()
    if gives_up:
        task = breaking()
        lines = [ScriptedRun(seconds=(0.2, 0.2))] * 9 + [
            ScriptedRun(ActionStatus.ERROR, (0.2, 0.2))
        ]
        does |= {name: Scripted(lines) for name in ("place_soft", "place_hard")}
    learning = Learning(task, "nikolic_fu", credit="task")
    selector = LearningSelector(learning, seed=3, declared={})
    log = TrialLog(task, costs(task, directory(task)))
    played(task, selector, 40, does, log)
    assert [trial.time is None for trial in log.trials].count(True) == gives_up
    expected: list[Credit] = []
    for trial in log.trials:
        took = math.nan if trial.time is None else trial.time
        ends = [
            (name, run.action, "regime=A", observation(task, run))
            for run in trial.runs
            for name in [task.primitive_task_of(run.place).name]
        ]
        expected += verdicts_of_task(
            ends, trial.goals > 0, took, lambda name: task.primitive_tasks[name].cost
        )
    found = verdicts(selector)
    assert {one.outcome.status for one in found} == {Status.SUCCESS, Status.FAILURE}
    assert [(c.primitive_task, c.action, c.context, c.outcome.status) for c in found] == [
        (c.primitive_task, c.action, c.context, c.outcome.status) for c in expected
    ]
    for mine, table in zip(found, expected, strict=True):
        assert mine.outcome.seconds == pytest.approx(table.outcome.seconds, abs=2e-6, nan_ok=True)
        assert mine.outcome.values == pytest.approx(table.outcome.values, nan_ok=True)
        assert mine.outcome.cpu_seconds == table.outcome.cpu_seconds
    ended, judged = 0, 0
    for record in selector.records:
        ended += isinstance(record, RunEnd) and record.primitive_task == "pick"
        judged += isinstance(record, Credit) and record.primitive_task == "pick"
        assert judged in (ended - 1, ended)


def misleading() -> Scripts:
    """A quick pick that reports success and does not hold the part, and a slow one that does;
    placing shows it."""
    held: dict[str, bool] = {}

    def picking(seconds: float, holds: bool) -> Callable[..., Any]:
        async def pick(ctx: Context) -> Result:
            held["part"] = holds
            await ctx.sleep(seconds)
            return success(weight=1.5)

        return pick

    async def place(ctx: Context) -> Result:
        await ctx.sleep(0.2)
        return success(tries=1) if held["part"] else error("lost")

    return {
        "pick_fast": picking(0.1, False),
        "pick_slow": picking(0.3, True),
        "pick_blind": picking(0.2, False),
        "place_soft": place,
        "place_hard": place,
    }


@pytest.mark.parametrize(
    ("credit", "learned", "least", "most"),
    [("action", "pick_fast", 0, 0), ("task", "pick_slow", 15, 20)],
)
def test_only_the_tasks_verdict_finds_the_action_that_meets_the_goal(
    task: Task, credit: str, learned: str, least: int, most: int
) -> None:
    """An action that judges itself by what it sees is preferred for being quick. Of 20 parts, some
    are lost to the jam."""
    selector = LearningSelector(Learning(task, "nikolic_fu", credit=credit), seed=1)
    played(task, selector, 80, misleading())
    p = selector.learning.selectors["pick"].learned("regime=A")
    assert max(p, key=lambda action: p[action]) == learned and p[learned] > 0.9
    selector.learning.freeze()
    again = LearningSelector(selector.learning, seed=2)
    log = TrialLog(task, costs(task, directory(task)))
    played(task, again, 20, misleading(), log)
    assert least <= sum(trial.goals for trial in log.trials) <= most
    # estimates count how each run itself ended, with either credit
    for key, tally in selector.learning.estimates.tallies.items():
        if key.primitive_task == "pick":
            assert tally.count(Status.SUCCESS) == tally.runs > 0


def test_what_was_given_up_is_not_judged(task: Task) -> None:
    """At whatever moment: all trials that came to their end, and no other."""
    open_ = 0
    for moment in np.arange(5.0, 5.6, 0.06):
        selector = LearningSelector(Learning(task, "round_robin", credit="task"), seed=1)
        log = TrialLog(task, costs(task, directory(task)))
        played(task, selector, 50, log=log, stop=(float(moment), Abort("enough")))
        ended = sum(trial.completed for trial in log.trials)
        open_ += len(log.trials) - ended
        assert sum(c.primitive_task == "pick" for c in verdicts(selector)) == ended > 3
        assert sum(isinstance(record, TrialEnd) for record in selector.records) == ended
    assert open_ > 3


def test_both_credits_live_in_one_file(task: Task, tmp_path: Path) -> None:
    """Estimates are common; what the selectors learned is kept apart, also in a resumed run."""
    path, states = tmp_path / "learned.db", {}
    for credit in ("action", "task"):
        setting = LearningSetting(path, "nikolic_fu", credit=credit)
        assert LearningSetting.of_plain(setting.to_plain()) == setting
        session = LearningSession(task, setting, seed=1)
        played(task, session.selector, 30, misleading())
        session.save()
        states[credit] = session.learning.state()
    kept = EstimatesFile(path).read()
    for credit, state in states.items():
        assert kept.states(credited("nikolic_fu", credit)) == state
    again = LearningSession(task, LearningSetting(path, "nikolic_fu", credit="task"), seed=2)
    assert again.learning.state() == states["task"]
    with pytest.raises(ValueError, match="expected action or task, got 'luck'"):
        LearningSession(task, LearningSetting(path, "nikolic_fu", credit="luck"), seed=1)
