"""The learning selector on the executor: what it records, in which contexts, and that replay
restores the same state."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from math import isnan
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from petrobot.coordinator.engine import Engine, Override, State
from petrobot.coordinator.engine.instructions import Corrected, RunRecorded, StartRun
from petrobot.coordinator.engine.stimuli import RunEnded
from petrobot.coordinator.launch import Setting, lockstep_cell, with_runs
from petrobot.coordinator.learning.estimate import TallyKey
from petrobot.coordinator.learning.learner import (
    ContextError,
    Contexts,
    LearningSelector,
    usual_contexts,
)
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.objective import Comparison, Question, compare
from petrobot.coordinator.learning.records import (
    Choice,
    Passage,
    RunEnd,
)
from petrobot.coordinator.learning.selectors import RULES
from petrobot.coordinator.operator.commands import Operation
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.realtime import RealtimeMission
from petrobot.coordinator.run.recording import JournalStore, replay
from petrobot.coordinator.studies.campaign.block import costs
from petrobot.coordinator.studies.campaign.observed import estimates_of
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import TrialLog
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.file import loads
from petrobot.services.scripted import Scripted, ScriptedRun
from tests.learning.cell import directory, run, scripts, sorting


@pytest.fixture(scope="module")
def task() -> Task:
    """The sorting task."""
    return sorting()


def learner(task: Task, name: str = "nikolic_fu_fast", **more: Any) -> LearningSelector:
    """Return a selector without any experience."""
    return LearningSelector(Learning(task, name), **more)


def test_every_result_and_choice_is_recorded(task: Task) -> None:
    """Tallies agree with the mission's own counts."""
    selector = learner(task, seed=1)
    mission = run(task, selector, runs=12)
    recorded = Counter((r.primitive_task, r.action, r.status) for r in mission.tally.runs)
    tallies = selector.learning.estimates.tallies
    assert sum(recorded.values()) > 15
    for key, tally in tallies.items():
        assert key.context == "regime=A"
        for status in Status:
            assert tally.count(status) == recorded[key.primitive_task, key.action, status]
        assert tally.censored == recorded[key.primitive_task, key.action, None]
    choices = [r for r in selector.records if isinstance(r, Choice)]
    assert len(choices) == len([r for r in selector.records if isinstance(r, RunEnd)])


def test_trials_of_the_task_are_counted_as_campaigns_count_them(task: Task) -> None:
    """One end of each trial, with the status and the cost that the observer of campaigns gives."""
    selector = learner(task, "round_robin", seed=1)
    cell, party = lockstep_cell(directory(task), Setting(task, {}, 12, 1, selector), scripts())
    log = TrialLog(task, costs(task, directory(task)))
    party.mission.executor.observers.append(log)
    assert cell.run(lambda: party.over, 900_000)
    rows = [TrialRow(t.k, "A", 0, t.k, 0, 0.0, t) for t in log.trials]
    expected = estimates_of(task, rows, "").trials
    found = selector.learning.gained.trials
    assert list(found) == list(expected) and len(log.trials) == 12
    for key, sums in expected.items():
        assert (found[key].n, found[key].success, found[key].goals, found[key].runs) == (
            sums.n, sums.success, sums.goals, sums.runs,
        )  # fmt: skip
        assert found[key].cost.total == pytest.approx(sums.cost.total)


def test_costs_durations_waits_and_values(task: Task) -> None:
    """The node's own duration, the additional wait of the token, numbers of the result, and the
    wait for the pulse are recorded."""
    selector = learner(task, "round_robin", seed=1)
    run(task, selector, runs=12)
    known = selector.learning.estimates
    slow = known.tally(TallyKey("pick", "pick_slow", "regime=A"))
    assert 0.3 <= slow.wall.low <= slow.wall.high <= 0.41
    assert 0 < slow.waited.mean < 0.05
    assert slow.cpu.n == 0 or slow.cpu.mean >= 0
    soft = known.tally(TallyKey("place", "place_soft", "regime=A"))
    assert soft.cost("value:tries").mean == 2.0
    assert list(soft.values) == ["tries"]
    begin = next(flow for key, flow in known.flows.items() if key.transition == "begin")
    assert begin.fired == 12
    assert 0 < begin.waits.mean <= 0.05
    assert selector.learning.question("place").measure == "value:tries"


def test_a_trial_says_as_what_a_preempted_run_counts(task: Task) -> None:
    """Not how its node answered the cancel, which looks like an error of the action."""
    setting = Setting(task, {}, 40, 1, learner(task, "round_robin", seed=2))
    cell, party = lockstep_cell(directory(task), setting, scripts())
    log = TrialLog(task, costs(task, directory(task)))
    party.mission.executor.observers.append(log)
    assert cell.run(lambda: party.over, 900_000)
    texts = {run.text for trial in log.trials for run in trial.runs if run.cancelled}
    assert texts == {"preempted by jammed, not counted"}


def test_a_preempted_run_is_censored_by_its_transition(task: Task) -> None:
    """`jam` comes every 1.24 s and preempts placing runs, which then count no try: exposure grows,
    R does not change."""
    selector = learner(task, "round_robin", seed=2)
    run(task, selector, runs=40)
    tallies = selector.learning.estimates.of("place")
    censored = {a: t["regime=A"] for a, t in tallies.items() if t["regime=A"].censored}
    assert censored
    for tally in censored.values():
        assert "none:jammed" in tally.durations
        assert tally.reliability == 1.0
        assert tally.durations["none:jammed"].high < 0.55


@pytest.mark.parametrize("name", sorted(RULES))
def test_the_same_seed_gives_the_same_choices(task: Task, name: str) -> None:
    """Draws depend on seed, generation and run; another generation gives other draws."""

    def choices(**more: int) -> list[tuple[str, str]]:
        selector = learner(task, name, **more)
        run(task, selector, runs=25, seed=3)
        return [(r.primitive_task, r.action) for r in selector.records if isinstance(r, Choice)]

    assert choices(seed=3) == choices(seed=3)
    if name in ("nikolic_fu", "thompson", "reward_inaction"):
        assert choices(seed=3) != choices(seed=3, generation=1)


def test_replay_restores_the_same_state(task: Task, tmp_path: Path) -> None:
    """The recorded steps give a new selector exactly the state of the live one, so a resumed run
    continues as if it had not been interrupted; the journal holds the reasons of the choices."""
    path = tmp_path / "run.journal"
    store = JournalStore(JournalWriter(path, {"mission": "m", "mode": "lockstep"}), 0.0)
    live = learner(task, seed=4)
    run(task, live, runs=15, seed=4, store=store)
    store.writer.sync()
    known, _ = with_runs(task, 15)
    devices: Mapping[str, str] = {
        a.name: a.device for a in directory(task).actions.values() if a.device
    }
    again = learner(task, seed=4)
    reasons = []
    for step in replay(read_journal(path), Engine(known, devices)):
        again.stimulus(step.time, step.stimulus)
        reasons.append(getattr(step.stimulus, "reason", ""))
        for instruction in step.instructions:
            again.instruction(step.time, instruction)
        again.settled(step.time, step.state)
    assert again.records == live.records
    assert again.learning.state() == live.learning.state()
    assert again.learning.gained.tallies == live.learning.gained.tallies
    assert sum("nikolic_fu_fast: " in reason for reason in reasons) == sum(
        isinstance(r, Choice) for r in live.records
    )


def test_a_selector_that_is_not_live_learns_nothing(task: Task) -> None:
    """Its records, applied later, give the estimates."""
    frozen, later = learner(task, "round_robin", seed=1, live=False), Learning(task, "round_robin")
    run(task, frozen, runs=10)
    assert not frozen.learning.gained.tallies
    for record in frozen.records:
        later.apply(record)
    assert sum(t.runs for t in later.estimates.tallies.values()) >= 10


def test_contexts_follow_parameters_variables_and_conditions(task: Task) -> None:
    """A context lists each part with name and value; a value that was never written is
    `unknown`."""
    contexts = Contexts(("regime", "light < 0.5", "weight > 1.0"))
    selector = learner(task, "round_robin", seed=1, contexts=contexts)
    run(task, selector, runs=12, parameters={"regime": "B", "light": 0.3})
    seen = {k.context for k in selector.learning.estimates.tallies}
    assert seen == {
        "regime=B, light < 0.5=true, weight > 1.0=unknown",
        "regime=B, light < 0.5=true, weight > 1.0=true",
    }
    assert usual_contexts(task) == Contexts(("regime",))
    assert Contexts().of({"regime": "B"}) == ""


@pytest.mark.parametrize(
    ("part", "said"), [("speed", "no parameter or variable 'speed'"), ("regime ==", "column")]
)
def test_a_context_with_an_unknown_name_is_refused(task: Task, part: str, said: str) -> None:
    """It is refused at the start, with the list of known names."""
    with pytest.raises(ContextError, match=said):
        LearningSelector(Learning(task), Contexts((part,)))


def test_choices_of_the_user_and_the_operator_override_the_selector(task: Task) -> None:
    """Both are counted and labelled as such. The executor answers the operator's choice and writes
    it to the journal."""
    selector = learner(task, seed=1, chosen={"pick": "pick_slow"})
    run(task, selector, runs=4, first=[Override("place", "place_hard")])
    assert {r.action for r in selector.records if isinstance(r, Choice)} == {
        "pick_slow",
        "place_hard",
    }
    assert selector.choose("pick", "pick#9", ("pick_fast", "pick_slow"))[1] == "chosen by the user"
    assert selector.learning.selectors["pick"].learner("regime=A").runs[0, 1] == 4


def test_a_run_that_ended_provisionally_counts_in_r_when_it_is_judged(task: Task) -> None:
    """Once: a second verdict, or one on another run, changes nothing. Before, it says only how it
    ended."""
    selector = learner(task, seed=1)
    selector.settled(0.0, State((0,), {"regime": "A"}))
    selector.instruction(0.0, StartRun("pick#1", "pick", "pick", "pick_slow", {}, 5.0))
    ended = RunRecorded(
        "pick#1",
        "pick",
        "pick",
        "pick_slow",
        Status.SUCCESS,
        "",
        "",
        Executed.YES,
        0.4,
        deferred=True,
    )
    selector.instruction(0.4, ended)
    key = TallyKey("pick", "pick_slow", "regime=A")
    tally, batch = selector.learning.estimates.tally(key), selector.learning.selectors["pick"]
    assert (tally.runs, tally.judged, tally.wall.n) == (1, 0, 1) and isnan(tally.reliability)
    assert batch.learner("regime=A").runs[0, 1] == 0.0
    verdict = Corrected("pick#1", "pick", "pick_slow", Status.SUCCESS, Status.FAILURE, "crooked")
    for correction in (
        verdict,
        verdict,
        Corrected("pick#2", "pick", "pick_slow", Status.SUCCESS, Status.FAILURE),
    ):
        selector.instruction(1.0, correction)
    tally = selector.learning.estimates.tally(key)
    assert (tally.reliability, tally.corrected, tally.runs, tally.judged) == (0.0, 1, 1, 1)
    learned = batch.learner("regime=A")
    assert (learned.runs[0, 1], learned.successes[0, 1]) == (1.0, 0.0)


def test_a_run_that_was_lost_with_its_node_cost_the_time_until_that_was_noticed(
    task: Task,
) -> None:
    """Its node reports no time. As a run of no time it would make its action the cheapest one."""
    selector = learner(task, seed=1)
    selector.settled(0.0, State((0,), {"regime": "A"}))
    selector.instruction(1.0, StartRun("pick#1", "pick", "pick", "pick_slow", {}, 5.0))
    which = ("pick#1", "pick", "pick", "pick_slow", Status.ERROR)
    selector.instruction(1.5, RunRecorded(*which, "lost", "", Executed.UNKNOWN, 0.0))
    tally = selector.learning.estimates.tally(TallyKey("pick", "pick_slow", "regime=A"))
    assert (tally.wall.n, tally.wall.mean) == (1, 0.5)


def test_alternatives_are_judged_in_a_context_or_over_scenarios(task: Task) -> None:
    """In one context all experience counts; over scenarios the declared target (0.9) excludes
    actions that never reach it."""
    selector = learner(task, "round_robin", seed=1)
    for regime in ("A", "B"):
        run(task, selector, runs=120, parameters={"regime": regime})

    def compared(question: Question, context: str | None = None) -> Comparison:
        known = selector.learning.estimates.of("pick", context)
        alternatives = task.primitive_tasks["pick"].alternatives
        return compare({action: known.get(action, {}) for action in alternatives}, question)

    judged = compared(selector.learning.question("pick"), "regime=A")
    assert judged.of("pick_blind").scenarios == ("regime=A",)
    assert judged.best == "pick_fast"  # R 1/3, but at a quarter of the cost
    over = compared(selector.learning.asked()["pick"])
    assert over.best == "pick_slow"
    assert over.of("pick_slow").scenarios == ("regime=A", "regime=B")
    assert over.of("pick_slow").runs == 2 * judged.of("pick_slow").runs
    assert not over.of("pick_blind").admissible
    assert not over.of("pick_fast").admissible


def test_firings_are_counted(task: Task) -> None:
    """Every firing counts as a passage; only transitions that wait just for an event have a
    wait."""
    selector = learner(task, "fixed", seed=1)
    mission = run(task, selector, runs=5)
    passages = [r for r in selector.records if isinstance(r, Passage)]
    assert len(passages) == mission.tally.firings
    assert {p.transition for p in passages if p.waited is not None} == {"begin"}


def test_declared_cpu_time_counts_for_each_thing_that_a_run_used() -> None:
    """A run that says in `count` how many images it used costs so many times its compute time."""
    task = sorting()
    pick = replace(task.primitive_tasks["pick"], cost="cpu")
    costly = replace(task, primitive_tasks={**task.primitive_tasks, "pick": pick})
    selector = LearningSelector(Learning(costly, "fixed"), seed=1, declared={"pick_fast": 0.002})
    used: tuple[dict[str, Any], ...] = ({"count": 40.0}, {}, {"count": "x"})
    for k, values in enumerate(used):
        ended = ("pick", "pick", "pick_fast", Status.SUCCESS, "", "", Executed.YES, 1.0)
        selector.stimulus(1.0, RunEnded(f"pick#{k}", Status.SUCCESS, values=values))
        selector.instruction(1.0, RunRecorded(f"pick#{k}", *ended))
    ends = [r.outcome.cpu_seconds for r in selector.records if isinstance(r, RunEnd)]
    assert ends == [0.08, 0.002, 0.002]


@pytest.mark.parametrize("declared", [None, {"pick_slow": 0.25}])
def test_measured_cpu_time_never_affects_choices_in_lock_step(
    task: Task, declared: dict[str, float] | None
) -> None:
    """If CPU time is the cost, lock step uses the value declared in services.toml, and real time
    the measured one."""
    costly = replace(
        task,
        primitive_tasks={
            **task.primitive_tasks,
            "pick": replace(task.primitive_tasks["pick"], cost="cpu"),
        },
    )
    selector = LearningSelector(Learning(costly, "round_robin"), seed=1, declared=declared)
    run(costly, selector, runs=9)
    cpu = selector.learning.estimates.tally(TallyKey("pick", "pick_slow", "regime=A")).cost("cpu")
    cost = selector.learning.selectors["pick"].learner("regime=A").mean_cost()[0]
    if declared is None:
        assert 0 <= cpu.mean < 0.25
    else:
        assert (cpu.low, cpu.high) == (0.25, 0.25)
        assert cost.tolist() == [0.0, 0.25, 0.0]


def test_the_summary_shows_what_was_learned(task: Task) -> None:
    """It has the probability of each alternative, and R, C and J of those that ran; reading it
    changes nothing."""
    selector = learner(task, seed=1)
    assert selector.figures("pick")["pick_slow"] == {"probability": 0.0}
    assert not selector.learning.state()["pick"]["learners"]
    run(task, selector, runs=20)
    shown = selector.figures("pick")
    assert sum(a["probability"] for a in shown.values()) == pytest.approx(1.0)
    assert shown["pick_slow"]["reliability"] == 1.0
    assert shown["pick_blind"]["j"] > shown["pick_slow"]["j"] > 0
    assert shown["pick_slow"]["cost"] == pytest.approx(0.35, abs=0.06)
    assert selector.figures("nothing of the kind") == {}
    told = compare(selector.learning.estimates.of("pick"), selector.learning.question("pick"))
    for f in told.figures:
        own = shown[f.action]
        assert (own["reliability"], own["cost"], own["j"]) == (f.reliability, f.cost, f.j)
        assert (own["j_low"], own["j_high"]) == pytest.approx((f.j_lower, f.j_upper), nan_ok=True)
        assert own["best"] == (f.action == told.best and told.clear)


async def test_the_operators_page_shows_the_state_of_learning(task: Task) -> None:
    """The snapshot has every alternative's probability from the start, and R, C and J after its
    first run."""
    selector = learner(task, seed=1)
    setting = Setting(task, {}, 12, 1, selector)
    cell, party = lockstep_cell(directory(task), setting, scripts())
    operation = Operation(
        cast(RealtimeMission, SimpleNamespace(mission=party.mission, now=lambda: 0.0)), selector
    )
    before = operation.snapshot()["selectors"]["pick"]["alternatives"]
    assert [a["action"] for a in before] == ["pick_fast", "pick_slow", "pick_blind"]
    assert all("probability" in a and "reliability" not in a for a in before)
    assert cell.run(lambda: party.over, 900_000)
    shown = {a["action"]: a for a in operation.snapshot()["selectors"]["pick"]["alternatives"]}
    assert shown["pick_slow"]["reliability"] == 1.0
    assert shown["pick_slow"] == {"action": "pick_slow", **selector.figures("pick")["pick_slow"]}
    await operation.close()


def test_the_wait_for_a_server_is_no_part_of_a_run() -> None:
    """Three tokens enter at once, and one of their runs of 2 s is active at a time. The stochastic
    view has the queue itself."""
    text = (
        'schema = 1\n[task]\nname = "queue"\nfinal = "parts == 0"\n[primitive_tasks]\n'
        'weigh = { deadline = 9.0 }\n[places]\nparts = { kind = "control", tokens = 3 }\n'
        'weigh = { kind = "action", servers = 1 }\n[transitions]\n'
        'put = { in = ["parts"], out = ["weigh"] }\n'
        'weighed = { in = ["weigh:normal"] }\nlost = { in = ["weigh:error"] }\n'
    )
    queue = loads(text, "queue.toml")
    selector = learner(queue, "fixed")
    lines = {"weigh": Scripted([ScriptedRun(seconds=(2.0, 2.0))])}
    cell, party = lockstep_cell(directory(queue), Setting(queue, selector=selector), lines)
    assert cell.run(lambda: party.over, 400_000)
    (tally,) = selector.learning.estimates.tallies.values()
    assert tally.runs == 3 and tally.waited.high < 0.05
