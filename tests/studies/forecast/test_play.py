"""Simulating a net for a forecast: parallel branches, timers, conditions, loops, inhibitors and
dead ends, each against values computed by hand."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.coordinator.analysis.may_run import Cell
from petrobot.coordinator.engine import (
    ArmTimer,
    Begin,
    Engine,
    Fired,
    RunEnded,
    StartRun,
    Stimulus,
    TimerFired,
)
from petrobot.coordinator.learning.records import Waited
from petrobot.coordinator.studies.campaign.observed import estimates_of
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial, TrialLog
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.distributions import Drawer, RunDistributions
from petrobot.coordinator.studies.forecast.history import Training, trainings_of
from petrobot.coordinator.studies.forecast.net_arrays import Structure
from petrobot.coordinator.studies.forecast.play import Play, Played
from petrobot.coordinator.studies.forecast.residual import branch_doubts, condition_doubts, doubts
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.conftest import with_transitions

GOAL = 'final = "end == 1"\nruns_place = "jobs"'
HEAD = """
schema = 1
[task]
name = "net"
{task}
[primitive_tasks]
a = { goal = "a", alternatives = ["run_a"], deadline = 99.0 }
b = { goal = "b", alternatives = ["run_b"], deadline = 99.0 }
[places]
jobs = { kind = "control", tokens = 1 }
a = { kind = "action" }
b = { kind = "action" }
end = { kind = "control" }
"""


def task_of(text: str, keys: str = GOAL) -> Task:
    """Return the task with these transitions (and other tables)."""
    return loads(with_transitions(HEAD.replace("{task}", keys) + text), "net.toml")


def play(
    text: str, trials: list[Trial], n: int = 2000, keys: str = GOAL, listening: str = ""
) -> Played:
    """Simulate trials of a task from measured runs; a place that only listens may be named."""
    task = task_of(text, keys)
    if listening:
        place = replace(task.places[listening], listen=True)
        task = replace(task, places={**task.places, listening: place})
    training = Training.of(task, trials)
    random = np.random.default_rng(1)
    drawer = Drawer(RunDistributions(training), training.waits, np.ones((1, len(trials))), random)
    return Play(
        Structure.of(training.task), drawer, choices_of(training), np.zeros(n, np.int64)
    ).run()


def entry(
    place: str, took: float, status: str = "success", taken: str = "", **more: Any
) -> RunEntry:
    """Return a finished run."""
    return RunEntry(place, f"run_{place}", 0.0, took, status, taken=taken, **more)


FORK = """
begin: jobs -> a, b
join: a:normal, b:normal -> end
a_lost: a:error -> end
b_lost: b:error -> end
"""


def test_parallel_branches_take_as_long_as_the_longer_one() -> None:
    """A run of 1 or 3 s (half each) parallel to one of 2 s: the time is 2 or 3 s, half each."""
    trials = [
        Trial(1, 0.0, runs=[entry("a", took, taken="join"), entry("b", 2.0, taken="join")])
        for took in (1.0, 3.0)
    ]
    played = play(FORK, trials)
    assert set(played.time.tolist()) == {2.0, 3.0}
    assert np.mean(played.time == 3.0) == pytest.approx(0.5, abs=0.05)
    assert played.completed.all() and played.all_success.all()


def test_recorded_choices_decide_between_outgoing_transitions_of_one_status() -> None:
    """Two normal outgoing transitions have conditions on a variable: each is taken as often as
    recorded, with the durations recorded for it."""
    text = """
[variables.found]
type = "bool"
begin: jobs -> a
yes: a:normal -> b; when = "found"
no: a:normal -> end; when = "not found"
lost: a:error -> end
done: b:normal -> end
b_lost: b:error -> end
"""
    yes = [
        Trial(
            1,
            0.0,
            runs=[
                entry("a", 1.0, taken="yes"),
                RunEntry("b", "run_b", 1.0, 5.0, "failure", taken="done"),
            ],
        )
    ]
    no = [Trial(1, 0.0, runs=[entry("a", 2.0, taken="no")])]
    played = play(text, yes + no * 3)
    assert set(played.time.tolist()) == {2.0, 6.0}
    assert np.mean(played.time == 6.0) == pytest.approx(0.25, abs=0.04)
    assert (played.all_success == (played.time == 2.0)).all()


LOOP = """
begin: jobs -> a
done: a:normal -> end
again: a:error -> a
b_done: b:normal -> end
b_lost: b:error -> end
"""


def test_a_loop_is_geometric() -> None:
    """With a probability of 1/2 to try again, the mean number of runs is 2."""
    trials = [
        Trial(1, 0.0, runs=[entry("a", 1.0, taken="done")]),
        Trial(1, 0.0, runs=[entry("a", 1.0, "error", "again")]),
    ]
    played = play(LOOP, trials, 5000)
    assert played.time.mean() == pytest.approx(2.0, abs=0.08)
    assert np.mean(played.time == 1.0) == pytest.approx(0.5, abs=0.03)


def test_a_loop_with_a_fixed_number_of_rounds_is_not_geometric() -> None:
    """Each trial is interrupted twice and then succeeds: the number of earlier runs is a
    context."""
    runs = [
        RunEntry(
            "a",
            "run_a",
            float(k),
            1.0,
            "error" if k < 2 else "success",
            taken="again" if k < 2 else "done",
        )
        for k in range(3)
    ]
    played = play(LOOP, [Trial(1, 0.0, runs=runs)] * 60)
    assert set(played.time.tolist()) == {3.0}


def test_a_rare_additional_round_is_like_the_last_frequent_one() -> None:
    """Five of 65 trials are interrupted a third time and then end: no trial is interrupted for
    ever."""

    def rounds(n: int) -> Trial:
        ends = [("error", "again")] * (n - 1) + [("success", "done")]
        return Trial(
            1,
            0.0,
            runs=[
                RunEntry("a", "run_a", float(k), 1.0, s, taken=t) for k, (s, t) in enumerate(ends)
            ],
        )

    played = play(LOOP, [rounds(3)] * 60 + [rounds(4)] * 5)
    assert played.completed.all()
    assert played.time.mean() == pytest.approx((60 * 3 + 5 * 4) / 65, abs=0.05)


def test_branches_with_equal_rounds_are_described_by_their_own_rounds() -> None:
    """In every recorded trial the rounds of one branch determine those of the other; in simulated
    trials they drift apart."""
    text = """
begin: jobs -> a, b
a_again: a:error -> a
b_again: b:error -> b
done: a:normal, b:normal -> end
"""
    random = np.random.default_rng(1)
    trials = []
    for _ in range(60):
        runs = []
        for k, drift in enumerate(random.uniform(-0.3, 0.3, 3)):
            for place, begun in (("a", 2.0 * k), ("b", 2.0 * k + 0.5)):
                end = ("error", f"{place}_again") if k < 2 else ("success", "done")
                runs.append(
                    RunEntry(place, f"run_{place}", begun, 1.5 + drift, end[0], taken=end[1])
                )
        trials.append(Trial(1, 0.0, runs=runs))
    training = Training.of(task_of(text), trials)
    found = {
        s["place"]: s["by"] for s in RunDistributions(training).splits() if s["of"] == "outcome"
    }
    assert found == {"a": "visits of a", "b": "visits of b"}
    assert play(text, trials).completed.all()


def test_timers_and_events_race() -> None:
    """An event at 1 or 3 s races with a timer of 2 s: each wins half of the time. A timer that was
    never seen to fire has its declared time."""
    text = """
[events.bell]
scope = "external"
memory = "pulse"
rung: jobs -> a; event = "bell"
tired: jobs -> end; after = 2.0
done: a:normal -> end
lost: a:error -> end
b_done: b:normal -> end
b_lost: b:error -> end
"""
    trials = [
        Trial(1, 0.0, runs=[entry("a", 4.0, taken="done")], waits=[Waited("rung", wait)])
        for wait in (1.0, 3.0)
    ]
    played = play(text, trials, keys='final = "end == 1"')
    assert set(played.time.tolist()) == {5.0, 2.0}
    assert np.mean(played.time == 2.0) == pytest.approx(0.5, abs=0.05)


def test_a_task_without_an_action_place_takes_as_long_as_its_timers() -> None:
    text = """
schema = 1
[task]
name = "timers"
final = "end == 1"
[places]
jobs = { kind = "control", tokens = 1 }
half = {}
end = { kind = "control" }
[transitions]
begin = { in = ["jobs"], out = ["half"], after = 1.5 }
done = { in = ["half"], out = ["end"], after = 2.0 }
"""
    training = Training.of(loads(text), [Trial(1, 0.0)])
    random = np.random.default_rng(1)
    drawer = Drawer(RunDistributions(training), training.waits, np.ones((1, 1)), random)
    structure = Structure.of(training.task)
    played = Play(structure, drawer, choices_of(training), np.zeros(5, np.int64)).run()
    assert played.time.tolist() == [3.5] * 5


@pytest.mark.parametrize(("listening", "time"), [("", 3.0), ("b", 1.0)])
def test_a_trial_does_not_end_while_a_run_is_active_unless_it_only_listens(
    listening: str, time: float
) -> None:
    """`final` holds as soon as the run token is taken, as in a task of `petrobot new robot`."""
    text = """
begin: jobs -> a, b
a_done: a:normal ->
a_lost: a:error ->
b_done: b:normal ->
b_lost: b:error ->
"""
    runs = [entry("a", 1.0, taken="a_done"), entry("b", 3.0, taken="b_done")]
    keys = 'final = "jobs == 0"\nruns_place = "jobs"\ngoal_transitions = ["a_done"]'
    played = play(text, [Trial(1, 0.0, runs=runs)], 1, keys, listening)
    assert (played.goals.tolist(), played.time.tolist()) == ([1], [time])


def test_a_transition_that_gives_the_run_token_back_at_once_begins_no_trial() -> None:
    """As in a campaign: the device is warmed up as soon as there is work."""
    text = """
[places.cold]
kind = "control"
tokens = 1
warm: cold, jobs -> b, jobs
begin: jobs, !cold, !b -> a
done: a:normal ->
lost: a:error ->
b_done: b:normal ->
b_lost: b:error ->
"""
    runs = [entry("b", 1.0, taken="b_done"), entry("a", 2.0, taken="done")]
    keys = 'final = "jobs == 0"\nruns_place = "jobs"\ngoal_transitions = ["done"]'
    played = play(text, [Trial(1, 0.0, runs=runs)], 1, keys)
    assert (played.goals.tolist(), played.time.tolist()) == ([1], [2.0])


def test_giving_up_and_dead_ends_do_not_complete() -> None:
    """Tried with final_error, and with a dead marking."""
    text = """
[places.broken]
kind = "resource"
begin: jobs -> a
done: a:normal, !broken -> end
lost: a:error -> broken
b_done: b:normal -> end
b_lost: b:error -> end
"""
    trials = [
        Trial(1, 0.0, runs=[entry("a", 1.0, "error", "lost")]),
        *[Trial(1, 0.0, runs=[entry("a", 1.0, taken="done")])] * 3,
    ]
    for ending in (
        'final = "end == 1"\nfinal_error = "broken == 1"\nruns_place = "jobs"',
        GOAL,
    ):
        played = play(text, trials, keys=ending)
        assert np.mean(played.completed) == pytest.approx(0.75, abs=0.04)
        assert np.isnan(played.time[~played.completed]).all()


@pytest.mark.parametrize(("priority", "completes"), [(1, True), (0, False)])
def test_a_preemption_of_higher_priority_also_takes_a_finished_run(
    priority: int, completes: bool
) -> None:
    """a has finished and waits for b, which is lost: as in the engine, only a transition with a
    priority above the normal outgoing ones then takes a."""
    text = f"""
[places.alarm]
kind = "control"
begin: jobs -> a, b
join: a:normal, b:normal -> end
b_lost: b:error -> alarm
drop: alarm, a:preempt=none -> end; priority = {priority}
a_lost: a:error, alarm -> end
"""
    runs = [entry("a", 1.0, taken="drop"), entry("b", 2.0, "error", "b_lost")]
    played = play(text, [Trial(1, 0.0, runs=runs)])
    assert played.completed.all() == played.completed.any() == completes
    assert not played.all_success.any()
    assert played.ways.get("a", {}) == ({"drop": 2000} if completes else {})


SERVERS = """
[places.c]
kind = "action"
task = "a"
servers = 2
c_done: c:normal -> end
c_lost: c:error -> end
"""


def test_an_event_that_preempts_one_of_several_runs_is_refused_with_a_remedy() -> None:
    """Which of them it takes was not measured by run: a wrong forecast would be no better."""
    text = FORK + SERVERS + '[events.stop]\nscope = "external"\nmemory = "pulse"\n'
    text += 'halt: c:preempt=none -> end; event = "stop"\n'
    with pytest.raises(ValueError, match="servers = 1"):
        play(text, [Trial(1, 0.0, runs=[entry("a", 1.0), entry("b", 1.0)])])


LINE = """
[places.a]
kind = "action"
task = "a"
servers = {a}
[places.b]
kind = "action"
task = "b"
servers = {b}
[places.tray]
kind = "control"
capacity = {tray}
[places.out]
kind = "control"
begin: jobs -> a*{parts}
a_done: a:normal*{pair} -> tray
a_lost: a:error -> end
next: tray -> b
b_done: b:normal -> out
b_lost: b:error -> end
over: out*{left} -> end
"""


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 3), st.integers(1, 3), st.integers(1, 2), st.integers(1, 3), st.integers(1, 3),
    st.sampled_from([0.5, 1.0, 2.0, 3.5]),
)  # fmt: skip
def test_servers_and_runs_that_wait_for_a_place_are_those_of_the_engine(
    a: int, b: int, pair: int, tray: int, rounds: int, long: float
) -> None:
    """Parts in a queue for several servers; ended runs stay until the tray has room or until there
    is a pair of them, and further runs begin meanwhile."""
    text = LINE.format(a=a, b=b, pair=pair, tray=tray, parts=pair * rounds, left=rounds)
    head = HEAD.replace('a = { kind = "action" }\nb = { kind = "action" }\n', "")
    task = loads(with_transitions(head.replace("{task}", GOAL) + text), "net.toml")
    trial = by_engine(task, {}, {"a": 1.0, "b": long})
    training = Training.of(task, [trial])
    random = np.random.default_rng(1)
    drawer = Drawer(RunDistributions(training), training.waits, np.ones((1, 1)), random)
    played = Play(Structure.of(task), drawer, choices_of(training), np.zeros(5, np.int64)).run()
    assert trial.completed
    assert played.time.tolist() == [trial.time] * 5


SIDEWAYS = FORK.replace(
    "[transitions.a_lost]",
    """[places.c]
kind = "action"
task = "c"
[primitive_tasks.c]
goal = "c"
alternatives = ["run_c"]
deadline = 99.0
[transitions.c_done]
in = ["c:normal"]
out = ["end"]
[transitions.c_lost]
in = ["c:error"]
out = ["end"]
[transitions.aside]
in = ["jobs"]
out = ["c"]
[transitions.a_lost]""",
)


def test_a_place_that_training_never_entered_is_never_entered() -> None:
    """It is as likely as in the training, whatever the net allows: `aside` takes no job from
    `begin`."""
    both = [entry("a", 1.0, taken="join"), entry("b", 2.0, taken="join")]
    played = play(SIDEWAYS, [Trial(1, 0.0, runs=both)])
    assert played.completed.all() and not played.barred
    assert set(played.ways) == {"a", "b"}


def test_trials_that_can_only_go_on_in_such_a_place_are_told() -> None:
    """They come to a stop, and the forecast is doubtful."""
    played = play(FORK, [Trial(1, 0.0, runs=[entry("a", 1.0)])])
    assert not played.completed.any()
    assert played.barred == {"begin": 2000}
    (doubt,) = doubts([], played, 2000)
    assert "100.0% of the simulated trials stop where only begin could continue" in doubt


@pytest.mark.parametrize(
    ("threshold", "seconds"), [("busy", 3.0), ("busy*2", 2.0), ("busy*3", 1.0)]
)
def test_an_inhibitor_blocks_until_its_place_holds_fewer_tokens(
    threshold: str, seconds: float
) -> None:
    """a ends after 1 s; b empties busy in steps, after 2 and 3 s; a transition with `!busy*k` fires
    when fewer than k tokens are left."""
    text = """
[places.busy]
kind = "control"
[places.half]
kind = "control"
begin: jobs -> a, b, busy*2
done: a:normal, !{threshold} -> end
first: b:normal, busy -> half
second: half, busy ->; after = 1.0
a_lost: a:error -> end
b_lost: b:error -> end
"""
    trials = [Trial(1, 0.0, runs=[entry("a", 1.0, taken="done"), entry("b", 2.0, taken="first")])]
    played = play(text.replace("{threshold}", threshold), trials, n=20, listening="b")
    assert played.time.tolist() == [seconds] * 20


@pytest.mark.parametrize(
    ("left", "right", "late"),
    [("weight = 3.0", "weight = 1.0", 0.25), ("priority = 1", "", 0.0), ("", "priority = 1", 1.0)],
)
def test_priority_decides_between_two_fireable_transitions_and_then_weight(
    left: str, right: str, late: float
) -> None:
    """The left branch ends at once, the right one a second later."""
    text = """
[places.fork]
kind = "control"
[places.detour]
kind = "control"
begin: jobs -> a
done: a:normal -> fork
left: fork -> end
{left}
right: fork -> detour
{right}
back: detour -> end; after = 1.0
a_lost: a:error -> end
b_done: b:normal -> end
b_lost: b:error -> end
"""
    trials = [Trial(1, 0.0, runs=[entry("a", 1.0, taken="done")])]
    played = play(text.replace("{left}", left).replace("{right}", right), trials)
    assert set(played.time.tolist()) <= {1.0, 2.0}
    assert np.mean(played.time == 2.0) == pytest.approx(late, abs=0.04)


def test_an_arc_of_weight_two_waits_for_both_tokens() -> None:
    """a ends after 1 s and b after 2 s; each leaves one token, and the end takes two."""
    text = """
[places.parts]
kind = "control"
begin: jobs -> a, b
a_done: a:normal -> parts
b_done: b:normal -> parts
both: parts*2 -> end
a_lost: a:error -> end
b_lost: b:error -> end
"""
    trials = [
        Trial(1, 0.0, runs=[entry("a", 1.0, taken="a_done"), entry("b", 2.0, taken="b_done")])
    ]
    assert play(text, trials, n=20).time.tolist() == [2.0] * 20


FULL = """
[places.shelf]
kind = "control"
tokens = 1
capacity = 1
begin: jobs -> a
store: a:normal -> shelf, end
full: a:normal -> end; after = 5.0
a_lost: a:error -> end
b_done: b:normal -> end
b_lost: b:error -> end
"""


def test_a_full_place_blocks_firing_into_it_as_in_the_engine() -> None:
    """a ends after 1 s and `store` is blocked by the full shelf, so `full` fires 5 s later, in the
    engine and in every trial of the forecast."""
    played = play(FULL, [Trial(1, 0.0, runs=[entry("a", 1.0)])], n=200)
    assert played.ways == {"a": {"full": 200}}
    assert played.time.tolist() == [6.0] * 200
    task = task_of(FULL)
    engine = Engine(task)
    state, said = engine.handle(engine.initial(), Begin())
    (run,) = [i.run for i in said if isinstance(i, StartRun)]
    state, said = engine.handle(state, RunEnded(run, Status.SUCCESS))
    assert not [i for i in said if isinstance(i, Fired)]
    (timer,) = [i for i in said if isinstance(i, ArmTimer)]
    state, said = engine.handle(state, TimerFired(timer.key))
    assert [i.transition for i in said if isinstance(i, Fired)] == ["full"]
    marked = dict(zip(task.net.places, state.marking, strict=True))
    assert marked == {"jobs": 0, "a": 0, "b": 0, "end": 1, "shelf": 1}


BRANCHES = """
[places.jobs]
kind = "control"
tokens = 1
[places.end]
kind = "control"
"""


def branches(devices: dict[str, str], at_once: str = "", queue: str = "") -> Task:
    """Branches that begin together, each with the run of its own action; `queue` has two tokens."""
    text = f'schema = 1\n[task]\nname = "net"\nfinal = "end == {len(devices) + bool(queue)}"\n'
    text += 'runs_place = "jobs"\n' + BRANCHES
    for name in devices:
        start = '\nstart = "at_once"' if name == at_once else ""
        text += f'[primitive_tasks.{name}]\ngoal = "{name}"\nalternatives = ["run_{name}"]\n'
        text += f"deadline = 99.0{start}\n"
        text += f'[places.{name}]\nkind = "action"\ntask = "{name}"\nservers = 1\n'
    begun = [name + ("*2" if name == queue else "") for name in devices]
    moves = f"begin: jobs -> {', '.join(begun)}\n"
    for name in devices:
        moves += f"{name}_done: {name}:normal -> end\n{name}_lost: {name}:error -> end\n"
    return loads(with_transitions(text + moves), "net.toml")


def by_engine(task: Task, devices: dict[str, str], took: dict[str, float]) -> Trial:
    """Play one trial in the engine by a clock; each run takes as long as `took` says."""
    engine = Engine(task, {f"run_{name}": device for name, device in devices.items()})
    log = TrialLog(task, lambda record, values: None)
    now, active, stimulus = 0.0, dict[str, float](), cast(Stimulus, Begin())
    state = engine.initial()
    for _ in range(100):
        log.stimulus(now, stimulus)
        state, said = engine.handle(state, stimulus)
        for instruction in said:
            log.instruction(now, instruction)
            if isinstance(instruction, StartRun):
                active[instruction.run] = now + took[instruction.place]
        if not active:
            return log.trials[0]
        run = min(active, key=lambda name: active[name])
        now, stimulus = active.pop(run), RunEnded(run, Status.SUCCESS)
    raise AssertionError("the trial does not end")


@pytest.mark.parametrize(
    ("devices", "at_once", "queue", "expected"),
    [
        ({"a": "arm", "b": "arm"}, "", "", 3.0),
        ({"a": "arm", "b": "gripper"}, "", "", 2.0),
        ({"a": "arm", "b": "arm", "c": "camera", "d": "camera"}, "", "", 12.0),
        ({"a": "arm", "b": "arm", "c": "arm"}, "", "", 7.0),
        ({"a": "arm", "b": "arm", "c": "arm"}, "c", "", 6.0),
        ({"a": "arm", "b": "gripper"}, "", "b", 4.0),
        ({"a": "arm", "b": "arm"}, "", "a", 4.0),
    ],
)
def test_runs_wait_for_their_device_as_in_the_engine(
    devices: dict[str, str], at_once: str, queue: str, expected: float
) -> None:
    """The first run of a device goes first; a second token of a place waits for the first one."""
    task = branches(devices, at_once, queue)
    took = {"a": 1.0, "b": 2.0, "c": 4.0, "d": 8.0}
    trial = by_engine(task, devices, took)
    used = {f"run_{name}": device for name, device in devices.items()}
    training = Training.of(task, [trial], cell=Cell({}, devices=used))
    random = np.random.default_rng(1)
    drawer = Drawer(RunDistributions(training), training.waits, np.ones((1, 1)), random)
    played = Play(
        Structure.of(task),
        drawer,
        choices_of(training),
        np.zeros(20, np.int64),
        devices=training.devices,
    ).run()
    assert trial.time == expected
    assert played.completed.all() and played.time.tolist() == [expected] * 20


def test_waits_of_an_older_table_stay_in_the_durations() -> None:
    devices = {"a": "arm", "b": "arm"}
    task = branches(devices)
    runs = [entry("a", 1.0, taken="a_done"), entry("b", 3.0, taken="b_done")]
    used = {"run_a": "arm", "run_b": "arm"}
    assert Training.of(task, [Trial(1, 0.0, runs=runs)], cell=Cell({}, devices=used)).devices == {}


SHARED = """
[places.arm]
kind = "resource"
tokens = 1
[places.a_over]
kind = "control"
[places.b_over]
kind = "control"
[places.a_waits]
kind = "control"
[places.b_waits]
kind = "control"
[places.c_waits]
kind = "control"
[primitive_tasks.c]
goal = "c"
alternatives = ["run_c"]
deadline = 99.0
[places.c]
kind = "action"
task = "c"
begin: jobs -> {begin}
get_a: a_waits, arm -> a
get_b: b_waits, arm -> b
get_c: c_waits, arm -> c
a_done: a:normal -> arm, {after_a}
b_done: b:normal -> arm, b_over
c_done: c:normal -> arm
both: a_over, b_over -> end
a_lost: a:error -> end
b_lost: b:error -> end
c_lost: c:error -> end
"""


@pytest.mark.parametrize(
    ("begin", "after_a", "listening"),
    [
        ("c_waits, b_waits, a_waits", "a_over", "c"),
        # a wants the arm again at once, but b has waited since the beginning
        ("b_waits, a_waits", "a_over, a_waits", "a"),
    ],
)
def test_a_contested_token_goes_to_who_came_first_and_then_to_the_first_in_the_file(
    begin: str, after_a: str, listening: str
) -> None:
    """a uses the arm for 1 s and then b for 2 s, as in the engine; c would take it for 4 s."""
    text = SHARED.replace("{begin}", begin).replace("{after_a}", after_a)
    runs = [entry("a", 1.0), entry("b", 2.0), entry("c", 4.0)]
    played = play(text, [Trial(1, 0.0, runs=runs)], n=50, listening=listening)
    assert played.time.tolist() == [3.0] * 50


def test_an_estimates_file_forecasts_every_try_of_a_place() -> None:
    """Each of three tries succeeds half the time, so 7 of 8 trials get through. The file does not
    tell which transition took a run; the condition of a retry holds for runs that were executed."""
    text = """
[places.lost]
kind = "control"
begin: jobs -> a
done: a:normal -> end
a_lost: a:error -> lost
b_done: b:normal -> end
b_lost: b:error -> lost
"""
    keys = with_transitions(HEAD.replace("{task}", GOAL) + text)
    keys = keys.replace('a = { kind = "action"', 'a = { kind = "action", tries = 3')
    task = loads(keys, "net.toml")
    trials = [Trial(1, 0.0, runs=[entry("a", 1.0, status)]) for status in ("success", "error")]
    training = Training.of(task, trials, whole=False)
    drawer = Drawer(RunDistributions(training), {}, np.ones((1, 2)), np.random.default_rng(1))
    structure = Structure.of(task, whole=False)
    played = Play(structure, drawer, choices_of(training), np.zeros(4000, np.int64)).run()
    assert np.mean(played.completed) == pytest.approx(7 / 8, abs=0.02)
    assert condition_doubts(training, structure.moves) == []
    assert any(text.startswith("a.retry: its condition") for text in structure.assumptions)


def test_runs_of_an_estimates_file_have_the_mean_of_all_runs() -> None:
    """The sample of 512 runs alone is several per cent off, for times with a long tail."""
    task = task_of(FORK)
    random = np.random.default_rng(4)
    seconds = random.lognormal(0.0, 1.5, 4000)
    rows = [
        TrialRow(
            i, "", i, 1, i, 1.0,
            Trial(1, 0.0, runs=[entry(place, took, seconds=took) for place in "ab"]),
        )
        for i, took in enumerate(seconds.tolist())
    ]  # fmt: skip
    training = trainings_of(task, estimates_of(task, rows, "t"))[""]
    for q in range(2):
        took = training.runs.took[training.runs.place == q]
        assert len(took) == 4000
        assert took.mean() == pytest.approx(seconds.mean(), rel=0.01)


def test_a_run_with_tries_ends_beside_a_branch_that_goes_on_for_ever() -> None:
    """Runs were taken after one try or after two. A simulated run may want the transition of
    another number of tries; it leaves by the one that the marking allows, at once."""
    text = """
[places.heard]
kind = "control"
tokens = 1
begin: jobs -> a
done: a:normal -> end
a_lost: a:error -> end
press: heard -> b
b_done: b:normal -> heard
b_lost: b:error -> heard
"""
    keys = with_transitions(HEAD.replace("{task}", GOAL) + text)
    keys = keys.replace('a = { kind = "action"', 'a = { kind = "action", tries = 3')
    keys = keys.replace('b = { kind = "action"', 'b = { kind = "action", listen = true')
    task = loads(keys, "net.toml")
    trials = []
    for n in (1, 1, 2, 3):
        ways = [("error", "a.retry")] * (n - 1) + [("success", ("done", "done.1", "done.2")[n - 1])]
        tries = [entry("a", 1.0, status, taken=taken) for status, taken in ways]
        trials.append(Trial(1, 0.0, runs=[*tries, *[entry("b", 0.7, taken="b_done")] * n]))
    training = Training.of(task, trials)
    drawer = Drawer(RunDistributions(training), {}, np.ones((1, 4)), np.random.default_rng(1))
    structure = Structure.of(training.task)
    replicate = np.zeros(1000, np.int64)
    played = Play(structure, drawer, choices_of(training), replicate, longest=100).run()
    assert played.completed.all()
    assert set(played.time.tolist()) == {1.0, 2.0, 3.0}


def test_an_estimates_file_that_leaves_a_condition_open_is_doubtful() -> None:
    """Which way a run leaves is decided by a cause that the file does not have for each run."""
    text = """
begin: jobs -> a
done: a:normal -> end
again: a:error -> b; when = "a.reason == 'slipped'"
a_lost: a:error -> end; when = "a.reason != 'slipped'"
b_done: b:normal -> end
b_lost: b:error -> end
"""
    training = Training.of(task_of(text), [Trial(1, 0.0, runs=[entry("a", 1.0)])], whole=False)
    found = condition_doubts(training, Structure.of(training.task, whole=False).moves)
    assert [doubt.partition(":")[0] for doubt in found] == ["again", "a_lost"]
    assert condition_doubts(replace(training, whole=True), Structure.of(training.task).moves) == []


DECIDED = """
[variables]
low = { type = "bool" }
mode = { type = "str", initial = "first" }
[places.held]
kind = "control"
"""


@pytest.mark.parametrize("priority", ["", "\npriority = 1"])
def test_branches_that_variables_decide_are_taken_as_in_the_trials(priority: str) -> None:
    """A battery that is low in 0.2 of the trials, and never after it was charged."""
    text = DECIDED + with_transitions(f"""
start: jobs -> a
ready: a:normal -> held
ok: held -> end
when = "not low"
charge: held -> b{priority}
when = "low"
charged: b:normal -> held
""")
    trials = [
        Trial(
            1, 0.0, 3.0 if k % 5 == 0 else 1.0, True,
            runs=[entry("a", 1.0), entry("b", 2.0)][: 1 + (k % 5 == 0)],
            fired={"start": 1, "ready": 1}
            | ({"charge": 1, "charged": 1} if k % 5 == 0 else {})
            | {"ok": 1},
        )
        for k in range(100)
    ]  # fmt: skip
    played = play(text, trials, n=4000)
    assert played.completed.all()
    assert set(np.round(played.time, 6)) == {1.0, 3.0}
    assert float(np.mean(played.time > 2.0)) == pytest.approx(0.2, abs=0.02)


def test_variables_that_transitions_set_are_played_as_the_engine_does() -> None:
    """The second run takes the other way, although no trial did."""
    text = DECIDED + with_transitions("""
start: jobs -> a
again: a:normal -> held
when = "mode == 'first'"
set = { mode = "'second'" }
back: held -> a
done: a:normal -> end
when = "mode == 'second'"
""")
    played = play(text, [Trial(1, 0.0, runs=[entry("a", 1.0)])], n=5)
    assert played.completed.all() and not played.guessed
    assert played.time.tolist() == [2.0] * 5


def test_a_branch_with_another_condition_or_other_values_is_doubtful() -> None:
    text = DECIDED + with_transitions("""
start: jobs -> a
ready: a:normal -> held
ok: held -> end
when = "LOW"
charge: held -> b
when = "not (LOW)"
charged: b:normal -> held
""")
    trial = Trial(
        1, 0.0, 1.0, True, runs=[entry("a", 1.0)], fired={"start": 1, "ready": 1, "ok": 1}
    )
    ran = task_of(text.replace("LOW", "low"))
    place = replace(ran.places["a"], out={"low": "low"})
    writes = replace(ran, places={**ran.places, "a": place})
    other = task_of(text.replace("LOW", "low or mode == 'second'"))

    def found(now: Task, *others: str) -> list[str]:
        training = replace(Training.of(now, [trial]), earlier=Training.of(ran, [trial]))
        return branch_doubts(training, Structure.of(now).moves, others)

    assert not found(ran, "a") and not found(writes)
    assert [text.partition(":")[0] for text in found(writes, "a")] == ["ok", "charge"]
    assert [text.partition(":")[0] for text in found(other)] == ["ok", "charge"]
