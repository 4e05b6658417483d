"""Runs that are preempted because another one has ended: the net determines when, and their own
results are censored.

The true values are known: two runs begin together, each draws how and when it would end, and the
first one to end preempts the other.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.time.measured import is_cause
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.learning.propagation import incidences, propagate, unended
from petrobot.coordinator.studies.campaign.observed import estimates_of
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.distributions import (
    Drawer,
    RunDistributions,
    with_weights,
)
from petrobot.coordinator.studies.forecast.history import NONE, STATUSES, Seen, Training
from petrobot.coordinator.studies.forecast.net_arrays import Structure
from petrobot.coordinator.studies.forecast.predict import Request, figures, predict
from petrobot.coordinator.studies.forecast.residual import measured
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.conftest import with_transitions

HEAD = with_transitions("""
schema = 1
[task]
name = "scan"
goal_transitions = ["found"]
runs_place = "parts"
final = "parts == 0 and idle == 1"
[primitive_tasks]
locate = { goal = "located", alternatives = ["locate_a"], deadline = 9.0 }
watch = { goal = "watched", alternatives = ["watch_a"], deadline = 9.0 }
[events.bell]
scope = "external"
memory = "pulse"
mean_wait = 1.0
[variables.dark]
type = "bool"
[places]
parts = { kind = "control", tokens = 4 }
idle = { kind = "resource", tokens = 1 }
locate = { kind = "action" }
watch = { kind = "action" }
next: parts, idle -> watch, locate
""")
ALONE = HEAD.replace('out = ["watch", "locate"]', 'out = ["watch"]')
"""Without a run of `locate`."""

ONE_WAY = HEAD + with_transitions("""
found: locate:normal, watch:preempt=none -> idle
lost: locate:error, watch:preempt=none -> idle
found_late: locate:normal, watch:normal -> idle
lost_late: locate:error, watch:normal -> idle
found_blind: locate:normal, watch:error -> idle
lost_blind: locate:error, watch:error -> idle
""")
"""A task in which the end of locating preempts watching; locating is never preempted."""

BOTH_WAYS = HEAD + with_transitions("""
found: locate:normal, watch:preempt=none -> idle
lost: locate:error, watch:preempt=none -> idle
late: locate:preempt=failure, watch:normal -> idle
late_blind: locate:preempt=failure, watch:error -> idle
""")
"""A task in which the run that ends first preempts the other."""


def one_way(random: np.random.Generator, slow: float = 1.0) -> Trial:
    """Draw a trial of ONE_WAY: locating takes 0.5 to 1.5 s, watching is exponential with mean
    `slow` s."""
    locate, watch = random.uniform(0.5, 1.5), random.exponential(slow)
    status = ("success", "failure", "error")[int(random.choice(3, p=(0.6, 0.3, 0.1)))]
    seen = "success" if random.random() < 0.8 else "failure"
    stem = "lost" if status == "error" else "found"
    if watch > locate:
        other = RunEntry(
            "watch", "watch_a", 0.0, locate, "", taken=stem, cancelled=True, seconds=locate
        )
    else:
        stem += "_late"
        other = RunEntry("watch", "watch_a", 0.0, watch, seen, taken=stem, seconds=watch)
    own = RunEntry("locate", "locate_a", 0.0, locate, status, taken=stem, seconds=locate)
    return Trial(
        1, 0.0, locate, True, int(stem == "found"), runs=[other, own], fired={"next": 1, stem: 1}
    )


def both_ways(random: np.random.Generator) -> Trial:
    """Draw a trial of BOTH_WAYS with the same distributions."""
    locate, watch = random.uniform(0.5, 1.5), random.exponential(1.0)
    status = ("success", "failure", "error")[int(random.choice(3, p=(0.6, 0.3, 0.1)))]
    if locate < watch:
        taken = "lost" if status == "error" else "found"
        runs = [
            RunEntry("locate", "locate_a", 0.0, locate, status, taken=taken, seconds=locate),
            RunEntry(
                "watch", "watch_a", 0.0, locate, "", taken=taken, cancelled=True, seconds=locate
            ),
        ]
    else:
        taken, seen = "late", "success" if random.random() < 0.8 else "failure"
        runs = [
            RunEntry(
                "locate",
                "locate_a",
                0.0,
                watch,
                "failure",
                taken=taken,
                cancelled=True,
                seconds=watch,
            ),
            RunEntry("watch", "watch_a", 0.0, watch, seen, taken=taken, seconds=watch),
        ]
    return Trial(
        1,
        0.0,
        min(locate, watch),
        True,
        int(taken == "found"),
        runs=runs,
        fired={"next": 1, taken: 1},
    )


def trials_of(make: object, n: int, seed: int) -> list[Trial]:
    """Draw n trials."""
    random = np.random.default_rng(seed)
    assert callable(make)
    return [make(random) for _ in range(n)]


FIRST = math.exp(-0.5) - math.exp(-1.5)
"""Probability that a uniform time on [0.5, 1.5] is shorter than an exponential one of mean 1: the
integral of exp(-t)."""


@pytest.mark.parametrize(
    ("text", "make", "goal", "conj"),
    [
        pytest.param(
            ONE_WAY, one_way, 0.9 * FIRST, 0.6 * (FIRST + 0.8 * (1 - FIRST)), id="one way"
        ),
        pytest.param(BOTH_WAYS, both_ways, 0.9 * FIRST, 0.6 * FIRST, id="both ways"),
    ],
)
def test_preemptions_by_the_end_of_another_run_are_forecast(
    text: str, make: object, goal: float, conj: float
) -> None:
    """The forecast agrees with closed forms within the accuracy of 3,000 training trials, and
    simulated trials do not differ from those of the training."""
    task = loads(text, "scan.toml")
    training = Training.of(task, trials_of(make, 3000, 1))
    made = predict(
        training, Request(400, choices_of(training), replicates=40, point=20_000, net=True)
    )
    found, own = made["figures"], figures(measured(training))
    assert found["R_goal"]["value"] == pytest.approx(goal, abs=0.03)
    assert found["R_conj"]["value"] == pytest.approx(conj, abs=0.03)
    assert found["P_complete"]["value"] == 1.0
    assert found["mean"]["value"] == pytest.approx(own["mean"], rel=0.02)
    assert found["q90"]["value"] == pytest.approx(own["q90"], rel=0.02)
    assert made["doubts"] == []


@pytest.mark.parametrize(
    ("text", "make", "conj"),
    [
        pytest.param(ONE_WAY, one_way, 0.6 * (FIRST + 0.8 * (1 - FIRST)), id="one way"),
        pytest.param(BOTH_WAYS, both_ways, 0.6 * FIRST, id="both ways"),
    ],
)
def test_the_stochastic_view_preempts_when_the_other_run_has_ended(
    text: str, make: object, conj: float
) -> None:
    """It always completes, and a preempted run does not end as drawn; its phase-type durations are
    approximations, which cost some accuracy."""
    task = loads(text, "scan.toml")
    rows = [
        TrialRow(i, "", i, 1, i, 1.0, trial) for i, trial in enumerate(trials_of(make, 1500, 2))
    ]
    task = replace(task, runs_place="parts")
    found = propagate(task, estimates_of(task, rows, "t"))
    assert found.complete == pytest.approx(1.0, abs=1e-9)
    assert found.goal == pytest.approx(0.9 * FIRST, abs=0.06)  # 512 runs of a sample, and phases
    assert found.conjunctive ** (1 / 4) == pytest.approx(conj, abs=0.06)  # of all four tokens


def test_a_run_that_never_ends_by_itself_is_simulated_and_solved() -> None:
    """All its recorded runs were censored, so it stays active until it is preempted, however long
    the other run takes."""
    task = loads(ONE_WAY, "scan.toml")
    trials = [one_way(np.random.default_rng(seed), 1e9) for seed in range(400)]
    training = Training.of(task, trials)
    made = predict(
        training, Request(100, choices_of(training), replicates=20, point=4000, net=True)
    )
    assert made["figures"]["P_complete"]["value"] == 1.0
    assert made["figures"]["R_goal"]["value"] == pytest.approx(
        np.mean([t.goals for t in trials]), abs=0.02
    )
    rows = [TrialRow(i, "", i, 1, i, 1.0, trial) for i, trial in enumerate(trials)]
    assert propagate(task, estimates_of(task, rows, "t")).complete == pytest.approx(1.0, abs=1e-9)


def test_a_situation_without_recorded_runs_is_reported() -> None:
    """No other transition takes the run now, so it stays active for longer than any recorded one,
    and the forecast says that it is doubtful."""
    text = ALONE + with_transitions("""
stop: idle, locate:normal, watch:preempt=none -> idle
found: watch:normal -> idle
lost: watch:error -> idle
""")
    random = np.random.default_rng(1)
    runs = [(min(0.5, t), t < 0.5) for t in random.exponential(1.0, 300)]
    trials = [
        Trial(
            1,
            0.0,
            t,
            True,
            int(ended),
            runs=[RunEntry("watch", "watch_a", 0.0, t, "success" if ended else "")],
        )
        for t, ended in runs
    ]
    training = Training.of(loads(text, "scan.toml"), trials)
    made = predict(
        training, Request(100, choices_of(training), replicates=20, point=4000, net=True)
    )
    assert any("watch" in doubt and "longer" in doubt for doubt in made["doubts"]), made["doubts"]


# --- causes -----------------------------------------------------------------------------------

EVENTS = """
[transitions.rung]
in = ["watch:preempt=none"{more}]
out = ["idle"]
{how}
"""


@pytest.mark.parametrize(
    ("more", "how", "cause"),
    [
        ("", 'event = "bell"', True),
        ("", "after = 1.0", True),
        (', "idle"', 'event = "bell"', False),  # it is taken while the run is active
        (', "armed"', 'event = "bell"', True),
        (', "armed"', "after = 1.0", True),
        (', "idle"', "", False),
        (', "locate:normal"', "", False),
        (', "locate:normal"', "after = 1.0", False),
    ],
)
def test_causes_of_end_are_events_and_timers_that_take_one_run(
    more: str, how: str, cause: bool
) -> None:
    """All other preemptions follow from the marking. `armed` is there as long as the run."""
    armed = ONE_WAY.replace('out = ["watch"', 'out = ["armed", "watch"')
    armed = armed.replace("[transitions", "[places.armed]\n[transitions", 1)
    text = armed if "armed" in more else ONE_WAY
    task = loads(text + EVENTS.format(more=more, how=how), "scan.toml")
    assert is_cause(task.flat, task.flat.transitions["rung"]) is cause
    move = next(m for m in Structure.of(task).moves if m.name == "rung")
    assert move.cause is cause


@pytest.mark.parametrize(
    ("more", "how", "why"),
    [
        (
            ', "locate:normal"',
            'event = "bell"',
            "transitions.rung: forecasts know an event that preempts one run",
        ),
        (
            ', "locate:preempt=none"',
            'event = "bell"',
            "transitions.rung: forecasts know an event that preempts one run",
        ),
        ("", 'when = "dark"', "transitions.rung: when it preempts is decided by variables alone"),
    ],
)
def test_tasks_that_cannot_be_forecast_correctly_are_refused_by_name(
    more: str, how: str, why: str
) -> None:
    """The alternative would be a wrong forecast."""
    task = loads(ONE_WAY + EVENTS.format(more=more, how=how), "scan.toml")
    with pytest.raises(ValueError, match=why):
        Structure.of(task)


def test_an_event_that_preempts_and_counts_no_try_is_a_cause() -> None:
    """Such preemptions are a way to end, not mere censoring: half of the runs ring at 1 s, half end
    at 2 s."""
    text = ALONE + EVENTS.format(more="", how='event = "bell"')
    text += with_transitions("""
found: watch:normal -> idle
lost: watch:error -> idle
located: locate:normal -> idle
not_located: locate:error -> idle
""")
    ends = (("", 1.0, "rung"), ("success", 2.0, "found"))
    trials = [
        Trial(
            1,
            0.0,
            took,
            True,
            int(taken == "found"),
            runs=[RunEntry("watch", "watch_a", 0.0, took, status, taken=taken)],
        )
        for status, took, taken in ends
    ] * 50
    for trial in trials:
        trial.runs[0].cancelled = trial.runs[0].taken == "rung"
    training = Training.of(loads(text, "scan.toml"), trials)
    made = predict(
        training, Request(100, choices_of(training), replicates=20, point=4000, net=True)
    )["figures"]
    assert made["R_goal"]["value"] == pytest.approx(0.5, abs=0.03)
    assert made["mean"]["value"] == pytest.approx(1.5, abs=0.03)


def test_a_timer_over_two_runs_fires_once_for_both() -> None:
    """It fires at 1.02 s, as measured, not at the declared 1 s, and only if both runs are still
    active."""
    text = BOTH_WAYS + with_transitions("""
dog: locate:preempt=failure, watch:preempt=none -> idle; after = 1.0
""")
    random = np.random.default_rng(7)
    trials = []
    for trial in trials_of(both_ways, 1500, 8):
        if trial.time is not None and trial.time > 1.02:
            runs = [
                RunEntry(
                    "locate",
                    "locate_a",
                    0.0,
                    1.02,
                    "failure",
                    taken="dog",
                    cancelled=True,
                    seconds=1.02,
                ),
                RunEntry(
                    "watch", "watch_a", 0.0, 1.02, "", taken="dog", cancelled=True, seconds=1.02
                ),
            ]
            random.shuffle(runs)
            trial = Trial(1, 0.0, 1.02, True, 0, runs=runs, fired={"next": 1, "dog": 1})
        trials.append(trial)
    training = Training.of(loads(text, "scan.toml"), trials)
    assert set(training.waits["dog"][0].round(9)) == {1.02}
    made = predict(
        training, Request(400, choices_of(training), replicates=20, point=20_000, net=True)
    )
    own = figures(measured(training))
    for name in ("R_goal", "R_conj"):
        assert made["figures"][name]["value"] == pytest.approx(own[name], abs=0.02)
    assert made["figures"]["mean"]["value"] == pytest.approx(own["mean"], rel=0.02)
    assert made["figures"]["q90"]["value"] == pytest.approx(1.02)
    assert made["doubts"] == []


# --- censoring --------------------------------------------------------------------------------


def test_weights_are_the_aalen_johansen_estimate() -> None:
    """They equal the estimator of the stochastic view; the rest beyond the longest run equals the
    Kaplan-Meier estimate computed by hand."""
    random = np.random.default_rng(3)
    training = Training.of(loads(BOTH_WAYS, "scan.toml"), trials_of(both_ways, 200, 4))
    for place in (0, 1):
        runs = training.runs.of(training.runs.place == place)
        runs = runs.of(random.permutation(len(runs)))
        ended = with_weights(runs)
        left = float(ended.weight[ended.outcome == NONE].sum())
        causes = [None if c else str(o) for c, o in zip(runs.censored, runs.outcome, strict=True)]
        for cause, law in incidences(runs.took.tolist(), causes).items():
            own = ended.outcome == int(cause)
            assert float(ended.weight[own].sum()) == pytest.approx(law.share * (1 - left), abs=1e-9)
            assert float(np.average(ended.took[own], weights=ended.weight[own])) == pytest.approx(
                law.mean, rel=1e-9
            )
        assert unended(runs.took.tolist(), causes) == pytest.approx((left, float(runs.took.max())))


def watched(runs: list[tuple[str, float, str]]) -> list[Trial]:
    """Return trials of one run each: its status, how long it took (s), and what preempted it."""
    return [
        Trial(
            1,
            0.0,
            runs=[
                RunEntry("watch", "watch_a", 0.0, took, status, taken=taken, cancelled=bool(taken))
            ],
        )
        for status, took, taken in runs
    ]


def test_beyond_the_longest_run_by_hand() -> None:
    """One run ends at 1 s, two are censored at 2 and 3 s: two thirds remain, the share that a
    constant rate would leave at 3 s."""
    task = loads(ONE_WAY, "scan.toml")
    runs = [("success", 1.0, ""), ("", 2.0, "found"), ("", 3.0, "found")]
    trials = watched(runs)
    (context,) = RunDistributions(Training.of(task, trials)).contexts.values()
    assert context.ends.weight.tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3])
    assert context.ends.beyond.tolist() == [False, True, True]
    assert context.ends.rate == pytest.approx(-math.log(2 / 3) / 3.0)


def test_a_run_beyond_the_longest_one_ends_at_the_latest_at_its_deadline() -> None:
    """Then it ends with ERROR, although the extrapolation would go on at a constant rate."""
    task = loads(ONE_WAY, "scan.toml")
    deadline = task.primitive_tasks["watch"].deadline
    runs = [("success", 1.0, "")] + [("", deadline - 1.0, "found")] * 9
    trials = watched(runs)
    training = Training.of(task, trials)
    n, code = 500, training.vocabulary.actions.index("watch_a") + 1
    drawer = Drawer(RunDistributions(training), {}, np.ones((1, 10)), np.random.default_rng(1))
    place, zeros = training.vocabulary.places.index("watch"), np.zeros(n, np.int64)
    seen = Seen.nothing(len(training.vocabulary.places), n)
    ends = drawer.ends(place, np.full(n, code), zeros, seen)
    assert float(ends.took.max()) == deadline
    status, _ = training.vocabulary.parts(ends.outcome[ends.took == deadline])
    assert {STATUSES[s] for s in status.tolist()} == {Status.ERROR}


def test_without_measurements_declared_durations_race(tmp_path: object) -> None:
    """Before any run, the declared estimates are used: a preempting end needs no declared wait."""
    guess = (
        "deadline = 9.0, estimates = { success = { share = 1.0, mean = 1.0, cv = 1.0 }, "
        "failure = { share = 0.0, mean = 0.0 }, error = { share = 0.0, mean = 0.0 } }"
    )
    declared = ONE_WAY.replace("deadline = 9.0", guess)
    from petrobot.coordinator.analysis.time.task_forecast import forecast

    found = forecast(stochastic_view(loads(declared, "scan.toml")))
    assert found.goal_reliability == pytest.approx(0.5, abs=1e-6)


def test_the_tasks_of_these_tests_are_valid() -> None:
    """Both are read and forecast without an error."""
    for text in (ONE_WAY, BOTH_WAYS):
        task: Task = loads(text, "scan.toml")
        assert Structure.of(task).moves
