"""Deferred verdicts, from the provisional result to the estimates: in lock step, over lost links
and after resumes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.engine import Engine
from petrobot.coordinator.engine.instructions import Corrected
from petrobot.coordinator.engine.stimuli import RunEnded, Verdict
from petrobot.coordinator.launch import Setting, lockstep_party, make_mission, resumed_mission
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.mission import Mission, MissionError
from petrobot.coordinator.run.recording import replay
from petrobot.coordinator.run.timeline import Timeline
from petrobot.coordinator.studies.campaign.trials import TrialLog
from petrobot.coordinator.task import Status
from petrobot.services.comm.calls.callee import Callee, Offer
from petrobot.services.comm.calls.events import RunVerdict, mission_of, verdict_event
from petrobot.services.comm.lockstep.cell import LockStepCell
from petrobot.services.comm.protocol import messages as m
from tests.run.judged_parts import (
    FAIL,
    LEARNED,
    OK,
    PARTS,
    TRULY,
    Heard,
    directory,
    learned,
    learner,
    sorting,
    told,
)
from tests.run.test_resume import CrashError, MortalStore
from tests.run.toy_arm import TIDY, WORK, Bench


class Cellar:
    """The judged cell in lock step; its nodes outlive their coordinator."""

    def __init__(self, folder: Path) -> None:
        self.task, self.directory = sorting(), directory()
        self.journal = folder / "run.journal"
        self.heard, self.selector = Heard(), learner(self.task)
        self.nodes = [
            lockstep_party(self.directory, node) for node in self.directory.nodes.values()
        ]
        self.cell: LockStepCell | None = None

    def begin(self, lives: int = 0, *observers: Any) -> tuple[Mission, MortalStore]:
        header = {"mission": "m", "mode": "lockstep", "seed": 1, "runs": PARTS, "parameters": {}}
        store = MortalStore(JournalWriter(self.journal, header), lives)
        setting = Setting(self.task, runs=PARTS, seed=1, selector=self.selector)
        mission = make_mission(self.directory, setting, "m", "boot-1", store)
        mission.executor.observers += [self.heard, *observers]
        self._go(mission)
        return mission, store

    def resume(self) -> Mission:
        """Resume as a new process: its learner and observers start empty, and get the journal's
        records."""
        self.heard, self.selector = Heard(), learner(self.task)
        assert self.cell is not None
        mission, go_on = resumed_mission(
            self.directory,
            self.task,
            Engine(self.task),
            read_journal(self.journal),
            [self.selector, self.heard],
            self.cell.now,
            self.selector,
        )
        self._go(mission, go_on)
        return mission

    def _go(self, mission: Mission, begin: Callable[[float], None] | None = None) -> None:
        party = CoordinatorParty(self.directory, mission, begin=begin)
        if self.cell is None:
            self.cell = LockStepCell([party, *self.nodes])
        else:
            self.cell.replace(party)
        assert self.cell.run(lambda: party.over, 100_000)


def test_verdicts_of_another_node_and_of_the_score_correct_each_run_once(tmp_path: Path) -> None:
    """The estimates, the selector and the run's tally have the verdicts; the net continued with the
    provisional results."""
    cellar = Cellar(tmp_path)
    timeline, log = Timeline(), TrialLog(cellar.task, lambda record, values: record.seconds)
    mission, _ = cellar.begin(0, timeline, log)
    assert told(mission) == TRULY
    assert learned(cellar.selector) == LEARNED
    assert [c.run for c in cellar.heard.corrected] == [
        "pick#1",
        "pick#2",
        "pick#4",
        "pick#5",
        "pick#3",
    ]
    assert cellar.heard.notes["no_verdict_due"] == 2, (
        "the second on the first pick, and the one on a run that was sure"
    )
    assert set(mission.executor.state.deferred) == {"pick#6"} and not mission.executor.state.early
    assert [(c.status, c.worst[1]) for c in mission.tally.cycles] == list(TRULY.values())
    assert [(t.status, t.cause) for t in log.trials] == [(s.value, c) for s, c in TRULY.values()]
    assert [t.all_success for t in log.trials] == [s is OK for s, _ in TRULY.values()]
    assert {run: (timeline.bars[run].status, timeline.bars[run].cause) for run in TRULY} == TRULY
    assert timeline.bars["pick#1"].text == "held by a corner"


def test_the_score_receives_unjudged_runs_and_its_verdicts_are_not_in_the_result(
    tmp_path: Path,
) -> None:
    mission, _ = Cellar(tmp_path).begin()
    result = mission.result("lockstep", 0.0)
    assert result["hidden"] == ["m/pick#3", "m/pick#6"] and "verdicts" not in result
    assert [row["held"] for row in result["parts"]] == [
        "failure",
        "success",
        "success",
        "failure",
        "success",
        "success",
    ]


def test_the_score_of_a_long_mission_run_gets_the_newest_cycles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One call carries no more; before, the run ended without any result."""
    monkeypatch.setattr("petrobot.coordinator.run.mission.MOST_TOLD", 35)
    mission, _ = Cellar(tmp_path).begin()
    result = mission.result("lockstep", 0.0)
    assert [row["n"] for row in result["parts"]] == [3, 4, 5, 6]
    assert result["scored"] == "the newest 4 of 6 cycles: one call carries no more"
    assert result["status"] == "success" and len(mission.tally.cycles) == 6


def test_a_replay_gives_the_same_verdicts(tmp_path: Path) -> None:
    cellar = Cellar(tmp_path)
    mission, _ = cellar.begin()
    steps = list(replay(read_journal(cellar.journal), Engine(cellar.task)))
    assert steps[-1].state == mission.executor.state
    assert [
        i for step in steps for i in step.instructions if isinstance(i, Corrected)
    ] == cellar.heard.corrected
    again = learner(cellar.task)
    for step in steps:
        again.stimulus(step.time, step.stimulus)
        for instruction in step.instructions:
            again.instruction(step.time, instruction)
        again.settled(step.time, step.state)
    assert again.records == cellar.selector.records


def test_a_coordinator_that_dies_anywhere_counts_each_verdict_once(tmp_path: Path) -> None:
    """It dies before a verdict is journaled, between journal and acknowledgement, or between the
    score's verdicts and the score."""
    whole, store = Cellar(tmp_path / "whole").begin()
    assert store.operations > 60
    verdicts = places_of_verdicts(tmp_path / "whole" / "run.journal", store.operations)
    for lives in verdicts:
        cellar = Cellar(tmp_path / str(lives))
        with pytest.raises(CrashError):
            cellar.begin(lives)
        mission = cellar.resume()
        assert told(mission) == TRULY, f"crash at operation {lives}"
        assert learned(cellar.selector) == LEARNED, f"crash at operation {lives}"
        assert len(cellar.heard.corrected) == 5
        assert mission.result("lockstep", 0.0)["hidden"] == whole.result("lockstep", 0.0)["hidden"]


def places_of_verdicts(journal: Path, operations: int) -> Sequence[int]:
    """Return operations of the journal spread over the whole run, and the last twelve (those of the
    score)."""
    assert (
        sum(
            isinstance(s.stimulus, Verdict)
            for s in replay(read_journal(journal), Engine(sorting()))
        )
        == 7
    )
    return [*range(20, operations - 12, 9), *range(operations - 12, operations)]


@pytest.mark.parametrize(
    ("verdicts", "says"),
    [
        (["pick#3"], "score: verdicts"),
        ({"m/pick#3": "failure"}, "score: verdicts"),
        ({"m/pick#3": {"status": "good"}}, "expected status success, failure, error, got 'good'"),
    ],
)
def test_malformed_verdicts_of_a_score_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdicts: Any, says: str
) -> None:
    import judged_cell.actions as actions  # type: ignore[import-not-found]  # on the path of the cell alone

    monkeypatch.setattr(actions, "score", lambda ctx, *, cycles: actions.success(verdicts=verdicts))
    with pytest.raises(MissionError, match=says):
        Cellar(tmp_path).begin()


# --- over a network: links that break, verdicts that come early, late, twice or for no run


class Judges(Bench):
    """The toy task with one arm; its node is a real callee, so that links can break."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.node = Callee(
            "motion", "n1", {"do_work": Offer(device="arm"), "do_tidy": Offer(device="arm")}
        )

    def connect(self, now: float) -> None:
        """Connect the link, or connect it again."""
        welcome = self.node.link_up(now, "m", self.caller.hello)
        assert isinstance(welcome, m.Welcome)
        self.caller.link_up(now, welcome)
        self.carry(now)

    def cut(self, now: float) -> None:
        """Break the link; messages in transit are lost."""
        self.node.messages()
        self.node.link_down(now, "m")
        self.caller.link_down(now, "cut")

    def carry(self, now: float) -> None:
        """Deliver all messages that are in transit."""
        for _ in range(4):
            self.go(now)
            for message in self.sent():
                self.node.receive(now, "m", message)
            for _, message in self.node.messages():
                self.caller.receive(now, message)
        self.go(now)

    def end(
        self, now: float, run: str, status: str, *, deferred: bool = False, cause: str = ""
    ) -> None:
        """A run has ended."""
        self.node.finish(now, m.Outcome(run, status, cause=cause, deferred=deferred))
        self.carry(now)

    def judge(
        self, now: float, status: str, cause: str = "", run: str = WORK, **other: Any
    ) -> None:
        """Send a verdict on a run from the node. `other`: data of the event in place of a
        verdict."""
        data = {**RunVerdict(run, status, cause).to_data(), **other.get("data", {})}
        self.node.raise_event(now, verdict_event("m"), data, source="judge", latched=True)

    @property
    def corrected(self) -> list[tuple[str, Status, Status, str]]:
        """Return the corrections so far."""
        found = [i for step in self.steps for i in step.instructions if isinstance(i, Corrected)]
        return [(c.run, c.was, c.status, c.cause) for c in found]


def working() -> Judges:
    """Begin work."""
    bench = Judges()
    bench.begin()
    bench.executor.subscribe(0.0, fresh=True)
    bench.connect(0.1)
    return bench


def judged() -> Judges:
    """End work provisionally and begin tidy."""
    bench = working()
    bench.end(1.0, WORK, "success", deferred=True)
    assert list(bench.node.running()) == [TIDY] and bench.records[0].deferred
    return bench


CROOKED = [("work#1", OK, FAIL, "crooked")]


def test_a_link_that_breaks_between_result_and_verdict_only_delays_the_verdict() -> None:
    bench = judged()
    bench.cut(1.1)
    bench.judge(1.2, "failure", "crooked")
    assert bench.corrected == []
    bench.connect(1.5)
    bench.carry(1.6)
    assert bench.corrected == CROOKED
    assert bench.node.events.waiting("m") == [], "acknowledged"


def test_a_verdict_whose_acknowledgement_is_lost_comes_again_and_counts_once() -> None:
    bench = judged()
    bench.judge(1.2, "failure", "crooked")
    for _, message in bench.node.messages():
        bench.say(1.2, message)
    assert [type(message) for message in bench.sent(m.EventAck)] == [m.EventAck]
    bench.cut(1.3)
    bench.connect(1.5)
    bench.carry(1.6)
    assert bench.corrected == CROOKED and bench.reports == []
    assert bench.node.events.waiting("m") == []


def test_of_two_verdicts_on_one_run_the_first_counts() -> None:
    bench = judged()
    bench.judge(1.2, "failure", "crooked")
    bench.judge(1.2, "success")
    bench.carry(1.3)
    assert bench.corrected == CROOKED and bench.reports == ["no_verdict_due"]


def test_a_verdict_that_comes_before_the_result_counts() -> None:
    """The judge's node is reached, that of the run is not yet."""
    bench = working()
    bench.judge(0.5, "failure", "crooked")
    bench.carry(0.5)
    assert bench.corrected == [] and bench.executor.state.early
    bench.end(1.0, WORK, "success", deferred=True)
    assert bench.corrected == CROOKED and bench.fired == ["go", "worked"], (
        "the net went on by what the run said"
    )


@pytest.mark.parametrize("preempted", [False, True], ids=["sure", "preempted"])
def test_an_early_verdict_on_a_run_that_is_not_provisional(
    preempted: bool,
) -> None:
    bench = working()
    bench.judge(0.5, "failure", "crooked")
    bench.carry(0.5)
    if preempted:
        bench.ring(0.6)
        bench.carry(0.6)
    bench.end(1.0, WORK, "error", cause="broken", deferred=preempted)
    assert bench.records[0].cancelled is preempted
    assert (
        bench.corrected == []
        and bench.reports == ["no_verdict_due"]
        and not bench.executor.state.early
    )


def test_a_verdict_after_a_resume() -> None:
    """One comes while no coordinator runs, one had been journaled but not acknowledged: each counts
    once."""
    bench = judged()
    bench.cut(1.1)
    bench.judge(1.2, "failure", "crooked")
    after = bench.resumed(2.0, runs=[TIDY])
    event = bench.node.events.subscribe("m", (verdict_event("m"),), True)
    assert len(event) == 1
    after.say(2.1, *event)
    after.say(2.2, *event)
    third = after.resumed(3.0, runs=[TIDY])
    third.say(3.1, *event)
    corrections = [i for step in third.steps for i in step.instructions if isinstance(i, Corrected)]
    assert [(c.run, c.was, c.status, c.cause) for c in corrections] == CROOKED
    assert third.reports == ["no_verdict_due"], "the new process asked for it once more"


def test_without_a_verdict_the_provisional_result_counts() -> None:
    bench = judged()
    bench.end(2.0, TIDY, "success")
    assert bench.executor.finished is not None
    assert bench.corrected == [] and bench.records[0].deferred and bench.records[0].status is OK
    bench.judge(2.5, "failure", "crooked")
    bench.carry(2.5)
    assert bench.corrected == CROOKED, (
        "the net is at its end, the mission run is still being scored"
    )


@pytest.mark.parametrize(
    ("run", "more", "reports"),
    [
        (WORK, {"status": "good"}, []),
        (WORK, {"run": 7}, []),
        (WORK, {"cause": 7}, []),
        ("other/work#1", {}, ["no_verdict_due"]),
        ("m/work#9", {}, ["no_verdict_due"]),
    ],
)
def test_malformed_verdicts_and_unknown_runs_change_nothing(
    run: str, more: dict[str, Any], reports: list[str]
) -> None:
    bench = judged()
    bench.judge(1.2, "failure", run=run, data=more)
    bench.carry(1.3)
    assert bench.corrected == [] and bench.reports == reports
    assert bench.node.events.waiting("m") == [], (
        "acknowledged: it would not become better by being sent again"
    )


def test_a_final_result_or_an_unexecuted_run_cannot_be_judged() -> None:
    for deferred, executed in (
        (False, m.Executed.YES),
        (True, m.Executed.NO),
        (True, m.Executed.UNKNOWN),
    ):
        bench = Bench().begin()
        status = "success" if executed is m.Executed.YES else "error"
        bench.say(1.0, m.Outcome(WORK, status, {}, "odd", executed=executed, deferred=deferred))
        (ended,) = [step.stimulus for step in bench.steps if isinstance(step.stimulus, RunEnded)]
        assert not ended.deferred and not bench.executor.state.deferred


@pytest.mark.parametrize(
    "run", ["", "work#1", "m/work", "m/work#1/2", "m/#1", "m" * 255 + "/a#1", None, 7]
)
def test_an_invalid_run_id_is_refused_in_the_action(run: Any) -> None:
    with pytest.raises(ValueError, match=r"pass ctx\.run of the run's own context"):
        mission_of(run)
    assert mission_of("catch_ball/5/locate_ball#3") == "catch_ball/5"
