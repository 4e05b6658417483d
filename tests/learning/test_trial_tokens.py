"""Which trial a token belongs to: tasks that work on several tokens at a time, and tasks that take
one after the other, for which a trial ends when the marking is as it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.engine import State, Stimulus
from petrobot.coordinator.engine.instructions import Finished, Fired, Instruction
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import Credit, TrialEnd
from petrobot.coordinator.learning.trial_tokens import TrialTokens
from petrobot.coordinator.run import lockstep
from petrobot.coordinator.studies.campaign.trials import Trial, TrialLog
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.file import loads
from petrobot.services.action import Status as ActionStatus
from petrobot.services.comm.protocol.messages import Feedback
from petrobot.services.scripted import ScriptedRun
from tests.run.scripted_cell import directory_for, scripts

PIPE = """
schema = 1
[task]
name = "pipe"
final = "rack == 0 and hand == 1"
goal_transitions = ["weighed"]
runs_place = "rack"
final_error = "broken > 0"
[task.parameters]
regime = "A"
[errors]
to = "broken"
[primitive_tasks]
load = { deadline = 3.0 }
weigh = { deadline = 9.0 }
[places]
rack = { kind = "control", tokens = 1 }
hand = { kind = "resource", tokens = 1 }
scale = { kind = "resource", tokens = 2 }
broken = {}
there = { capacity = 2 }
load = { kind = "action", holds = "hand" }
weigh = { kind = "action", holds = "scale", servers = 2 }
[transitions]
start = { in = ["rack"], out = ["load"] }
loaded = { in = ["load:normal"], out = ["there"] }
next = { in = ["there"], out = ["weigh"] }
weighed = { in = ["weigh:normal"] }
"""
"""A hand loads one part after the other, two scales weigh them: up to five at a time."""


def run(seconds: float, status: ActionStatus = ActionStatus.SUCCESS) -> ScriptedRun:
    return ScriptedRun(status, (seconds, seconds), cause="" if status == "success" else "slipped")


@dataclass
class Watched:
    """An observer that compares the ends of trials with the markings."""

    task: Task
    tokens: TrialTokens = field(init=False)
    ends: int = 0

    def __post_init__(self) -> None:
        self.tokens = TrialTokens(self.task)

    def instruction(self, now: float, instruction: Instruction) -> None:
        if not isinstance(instruction, Fired):
            return
        net, before = self.task.net, self.tokens.begun
        own = net.place_index[self.task.flat.runs_place]
        number = self.tokens.fired(instruction)
        idle = all(
            tokens == net.initial[place]
            for place, tokens in enumerate(instruction.after)
            if place != own
        )
        began = instruction.after[own] < instruction.before[own]
        assert number == self.tokens.begun == before + began
        assert self.tokens.back == ([number] if idle else [])
        self.ends += idle

    def stimulus(self, now: float, stimulus: Stimulus) -> None: ...

    def progress(self, now: float, run: str, notice: Feedback) -> None: ...

    def settled(self, now: float, state: State) -> None: ...


def played(
    task: Task,
    runs: int,
    lines: dict[str, list[ScriptedRun]],
    *observers: Any,
    selector: LearningSelector | None = None,
) -> tuple[list[Trial], list[TrialEnd]]:
    """Return the trials as a campaign records them and as the learner does."""
    selector = selector or LearningSelector(Learning(task, "fixed"))
    setting = Setting(task, runs=runs, selector=selector)
    cell, party = lockstep_cell(directory_for(task), setting, scripts(task, lines))
    log = TrialLog(task, lambda record, values: record.seconds)
    party.mission.executor.observers += [log, *observers]
    assert cell.run(lambda: party.over, 400_000)
    return log.trials, [r for r in selector.records if isinstance(r, TrialEnd)]


def test_what_happens_to_a_token_is_told_to_its_trial() -> None:
    """Each of twelve parts is loaded and weighed once and meets its goal, also where a later part
    is ready first. Its time goes from the rack to the scale."""
    task = loads(PIPE, "pipe.toml")
    weighing = [run(3.0), run(0.5), run(2.5), run(0.25), run(1.0)]
    trials, ends = played(task, 12, {"load": [run(0.5)], "weigh": weighing})
    assert [trial.k for trial in trials] == [*range(1, 13)]
    for trial in trials:
        assert [entry.place for entry in trial.runs] == ["load", "weigh"]
        assert trial.goals == 1 and trial.completed and trial.all_success
        weigh = trial.runs[1]
        assert trial.time == pytest.approx(weigh.begun + weigh.took)
        assert trial.fired == {"start": 1, "loaded": 1, "next": 1, "weighed": 1}
    left = [trial.begun + (trial.time or 0.0) for trial in trials]
    assert left != sorted(left)  # the second part was ready before the first
    assert [(end.goal, end.success) for end in ends] == [(True, True)] * 12
    assert {end.context for end in ends} == {"regime=A"}  # also of the first, which begins at once


def test_the_lost_trial_is_the_one_whose_token_is_lost() -> None:
    """The third part slips while two others are weighed: these meet their goals, and the third is
    the one that was not completed."""
    task = loads(PIPE, "pipe.toml")
    loading = [run(0.5), run(0.5), run(0.25, ActionStatus.ERROR), *[run(0.5)] * 9]
    trials, ends = played(task, 8, {"load": loading, "weigh": [run(4.0)]})
    lost = [trial.k for trial in trials if not trial.completed]
    assert lost == [3]
    assert [trial.goals for trial in trials if trial.completed] == [1] * (len(trials) - 1)
    assert trials[2].status == "error" and trials[2].cause == "slipped"
    assert sorted((end.goal, end.success) for end in ends) == [
        (False, False),
        *[(True, True)] * (len(trials) - 1),
    ]


@pytest.mark.parametrize("end", ['final_error = "broken > 0"', ""])
def test_the_trial_of_a_task_without_a_runs_place_is_lost_with_its_mission(end: str) -> None:
    """It counts as not completed, whether the task gives up by `final_error` or gets stuck."""
    text = PIPE.replace('runs_place = "rack"', "").replace('final_error = "broken > 0"', end)
    task = loads(text, "pipe.toml")
    (trial,), ends = played(task, 1, {"load": [run(0.5, ActionStatus.ERROR)]})
    assert (trial.completed, trial.status, trial.cause) == (False, "error", "slipped")
    assert [(end.goal, end.success) for end in ends] == [(False, False)]


def test_a_trial_that_waits_for_ever_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """In lock step such a run is aborted, which is no operator's doing."""
    monkeypatch.setattr(lockstep, "PATIENCE", 20.0)
    text = PIPE.replace('out = ["weigh"] }', 'out = ["weigh"], event = "never" }')
    task = loads(f'{text}[events]\nnever = {{ scope = "external" }}\n', "pipe.toml")
    selector = LearningSelector(Learning(task, "fixed", credit="task"))
    (trial,), ends = played(task, 1, {"load": [run(0.5)]}, selector=selector)
    assert not trial.completed and [(end.goal, end.success) for end in ends] == [(False, False)]
    judged = [
        (r.primitive_task, r.outcome.status) for r in selector.records if isinstance(r, Credit)
    ]
    assert judged == [("load", Status.FAILURE)]


@pytest.mark.parametrize("lines", [
    {},
    {"move_to_point": [run(0.2, ActionStatus.ERROR), run(0.2), run(0.2)]},
    {"locate_ball": [run(0.3, ActionStatus.ERROR), run(0.3)]},
    {"track_ball": [run(0.3), run(0.2, ActionStatus.ERROR)]},
    {"return_home": [run(0.3), run(0.2, ActionStatus.ERROR)]},
])  # fmt: skip
def test_one_token_at_a_time_is_back_when_the_marking_is(
    lines: dict[str, list[ScriptedRun]],
) -> None:
    """In the shipped task every firing belongs to the token taken last, and a trial ends when the
    marking is the initial one."""
    task = load_task("catch_ball")
    watched = Watched(task)
    trials, _ = played(task, 6, lines, watched)
    assert len(trials) == watched.tokens.begun
    assert watched.ends == sum(trial.time is not None for trial in trials)


def test_a_finished_mission_loses_what_its_final_error_looks_at() -> None:
    """Without tokens there, all that are not back are lost; after success none is."""
    task = loads(PIPE, "pipe.toml")
    for status, expected in ((Status.SUCCESS, set()), (Status.ERROR, {1})):
        tokens = TrialTokens(task)
        net = task.net
        after = [*net.initial]
        for place, more in (("rack", -1), ("hand", -1), ("load", 1)):
            after[net.place_index[place]] += more
        assert tokens.fired(Fired(1, "start", net.initial, tuple(after), "begin")) == 1
        assert tokens.on_its_way(1) and tokens.of("load#1") == 1
        assert tokens.lost(Finished(status, "aborted")) == expected


TUG = """
schema = 1
[task]
name = "tug"
final = "rack == 0 and hand == 1"
runs_place = "rack"
[primitive_tasks]
pull = { deadline = 3.0 }
watch = { deadline = 9.0 }
[places]
rack = { kind = "control", tokens = 1 }
hand = { kind = "resource", tokens = 1 }
pull = { kind = "action" }
watch = { kind = "action" }
[transitions]
start = { in = ["rack", "hand"], out = ["pull", "watch"] }
pulled = { in = ["pull:normal", "watch:preempt=failure"], out = ["hand"] }
"""
"""The next part begins in the step that preempts the watch, before the watch has stopped."""


def test_a_preempted_run_counts_in_its_trial_after_the_next_one_has_begun() -> None:
    """Its cost and its FAILURE are those of the trial that started it, as in a campaign."""
    task = loads(TUG, "tug.toml")
    trials, ends = played(task, 5, {"pull": [run(0.5)], "watch": [run(4.0)]})
    assert [(end.success, end.runs) for end in ends] == [(False, ("pull", "watch"))] * 5
    assert [trial.all_success for trial in trials] == [False] * 5
    costs = [sum(entry.cost or 0.0 for entry in trial.runs) for trial in trials]
    # to a tick: to the learner a preempted run lasts from its token's coming to its being taken
    assert [end.cost for end in ends] == pytest.approx(costs, abs=0.01) and min(costs) > 0.9


def by_hand(task: Task) -> tuple[TrialTokens, Callable[..., int]]:
    """Two parts in the rack, and a function that fires a transition with these runs."""
    tokens, net = TrialTokens(task), task.net
    marking = [*net.initial]
    marking[net.place_index["rack"]] = 2

    def fire(transition: str, *runs: str) -> int:
        before, index = tuple(marking), net.transition_index[transition]
        for arcs, sign in ((net.consume, -1), (net.produce, 1)):
            for place, weight in arcs[index]:
                marking[place] += sign * weight
        return tokens.fired(Fired(1, transition, before, tuple(marking), "stability", runs))

    return tokens, fire


def test_a_counter_beside_a_run_is_taken_with_its_own_run() -> None:
    """The second part is done first. The token that came first is not its own: with it both parts
    would count as one trial with two goals and one without any."""
    text = PIPE.replace('["load"] }', '["load", "used"] }').replace(
        "broken = {}", "broken = {}\nused = {}"
    )
    text = text.replace('holds = "hand" }', "servers = 2 }")
    text = text.replace('["load:normal"]', '["load:normal", "used"]')
    _, fire = by_hand(loads(text, "pipe.toml"))
    assert [fire("start"), fire("start")] == [1, 2]
    assert [fire("loaded", "load#2"), fire("loaded", "load#1")] == [2, 1]


TRAY = """
schema = 1
[task]
name = "tray"
final = "rack == 0 and hand == 1"
runs_place = "rack"
[events.full]
scope = "internal"
by = "put"
mean_wait = 1.0
[primitive_tasks]
put = { deadline = 3.0 }
change = { deadline = 3.0 }
[places]
rack = { kind = "control", tokens = 1 }
hand = { kind = "resource", tokens = 1 }
trays = { kind = "resource", tokens = 1 }
put = { kind = "action", holds = "hand" }
change = { kind = "action" }
[transitions]
start = { in = ["rack"], out = ["put"] }
full = { in = ["put:going", "trays"], out = ["change"], event = "full" }
ready = { in = ["put:normal"] }
changed = { in = ["change:normal"], out = ["trays"] }
"""
"""A run says with an event that a tray is full, and goes on."""


def test_a_run_that_a_firing_only_reads_stays_the_same_run() -> None:
    tokens, fire = by_hand(loads(TRAY, "tray.toml"))
    assert [fire("start"), fire("full"), fire("ready", "put#1")] == [1, 1, 1]
    assert fire("start") == 2 and tokens.of("put#2") == 2 and tokens.of("change#1") == 1
    assert [fire("changed", "change#1"), fire("ready", "put#2")] == [1, 2]
    assert not tokens.on_its_way(1) and not tokens.on_its_way(2)


WAITER = """
schema = 1
[task]
name = "waiter"
final = "rack == 0 and hand == 1"
goal_transitions = ["served"]
runs_place = "rack"
[primitive_tasks]
serve = { deadline = 9.0 }
nod = { deadline = 9.0 }
[places]
rack = { kind = "control", tokens = 1 }
hand = { kind = "resource", tokens = 1 }
serve = { kind = "action", holds = "hand" }
listening = { tokens = 1, LISTENS }
thinking = { LISTENS }
nod = { kind = "action", LISTENS HOLDS }
[transitions]
start = { in = ["rack"], out = ["serve"] }
served = { in = ["serve:normal"] }
dropped = { in = ["serve:error"] }
rings = { in = ["listening"], out = ["thinking"], after = 0.5 }
nods = { in = ["thinking"], out = ["nod"], priority = 1 }
nodded = { in = ["nod:normal"], out = ["listening"] }
tired = { in = ["nod:error"], out = ["listening"] }
"""
"""A branch beside the work, whose token is away most of the time."""


@pytest.mark.parametrize(
    ("listens", "holds", "least", "longest"),
    [
        ("listen = true", "", 0.7, 0.75),
        ("listen = true", ", holds = 'hand'", 0.7, 0.75),
        ("capacity = 1", "", 1.0, 2.0),
    ],
    ids=["it only listens", "it needs the hand", "it works"],
)
def test_a_branch_beside_the_work_leaves_every_trial_its_end(
    listens: str, holds: str, least: float, longest: float
) -> None:
    """A part that is done while the branch is busy has a time, that of the first moment at which
    the task could end; one that was dropped is judged. Both were left out once the next part had
    begun, and with them the trials that took longest."""
    text = WAITER.replace("LISTENS }\nthinking", "listen = true }\nthinking")
    task = loads(text.replace("LISTENS", listens).replace("HOLDS", holds), "waiter.toml")
    serving = [run(0.7), run(0.2), run(0.7, ActionStatus.ERROR), run(0.4), run(0.6)]
    selector = LearningSelector(Learning(task, "fixed", credit="task"))
    lines = {"serve": serving, "nod": [run(0.6)]}
    trials, ends = played(task, 20, lines, selector=selector)
    assert len(trials) == len(ends) == 20 and all(trial.completed for trial in trials)
    times = [trial.time for trial in trials if trial.time is not None]
    assert len(times) == 20 and least < max(times) <= longest
    judged = [r for r in selector.records if isinstance(r, Credit) and r.primitive_task == "serve"]
    assert [r.outcome.status is Status.SUCCESS for r in judged].count(False) == 4
    assert len(judged) == 20


def test_a_trial_that_uses_up_a_stock_has_its_end() -> None:
    """What it took never comes back, so nothing waits for it."""
    text = PIPE.replace('in = ["rack"]', 'in = ["rack", "screws*2"]').replace(
        "broken = {}", 'broken = {}\nscrews = { kind = "control", tokens = 99 }'
    )
    trials, _ = played(loads(text, "pipe.toml"), 12, {"load": [run(0.5)], "weigh": [run(0.7)]})
    assert len(trials) == 12
    for trial in trials:
        assert trial.time == pytest.approx(trial.runs[1].begun + trial.runs[1].took)
