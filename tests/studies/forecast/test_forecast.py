"""Forecasts of a task with known probabilities: their intervals cover the true values and they keep
dependence, which the product rule does not."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import replace
from scipy.stats import binom, norm

from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.time.whatif import read_change
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast.agreement import (
    agreement,
    quantile_interval,
    time_p_value,
)
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.direct import (
    holm,
    predictive_interval,
    share_p_value,
)
from petrobot.coordinator.studies.forecast.distributions import RunDistributions, dependences
from petrobot.coordinator.studies.forecast.history import ForecastError, Training
from petrobot.coordinator.studies.forecast.predict import Request, figures, predict
from petrobot.coordinator.studies.forecast.registered import read, register, write
from petrobot.coordinator.studies.forecast.residual import durations, measured
from petrobot.coordinator.studies.forecast.whatif import changed
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.conftest import Make, with_transitions

RUNS = 400


def forecast(task: Task, trials: list[Trial], **given_: Any) -> dict[str, Any]:
    """A forecast from trials with their own choices; `net`: by simulation."""
    training = Training.of(task, trials)
    choices = given_.pop("choices", choices_of(training))
    return predict(training, Request(RUNS, choices, replicates=60, point=20_000, **given_))


@pytest.mark.parametrize("net", [None, True])
def test_marginals_of_the_training_are_kept(
    pair: Task, make_trials: Make, net: bool | None
) -> None:
    """However runs depend on each other: the simulated net, too, composes what was measured."""
    trials = make_trials(1500, np.random.default_rng(1))
    found = forecast(pair, trials, net=net)["figures"]
    own = figures(measured(Training.of(pair, trials)))
    for name in ("R_goal", "P_complete", "R_conj"):
        assert found[name]["value"] == pytest.approx(own[name], abs=0.015)
    for name in ("mean", "q90"):
        assert found[name]["value"] == pytest.approx(own[name], rel=0.01)


def test_dependence_is_found_and_unfolded_and_the_product_is_wrong(
    pair: Task, make_trials: Make
) -> None:
    """Statuses within a trial depend on each other: the product of marginals is too small, the
    forecast with contexts is not."""
    trials = make_trials(1500, np.random.default_rng(2))
    training = Training.of(pair, trials)
    assert dependences(training)[0]["p"] < 1e-6
    made = forecast(pair, trials, net=True)
    assert ("second", "outcome", "outcome of first") in {
        (s["place"], s["of"], s["by"]) for s in made["splits"]
    }
    new = {"": Training.of(pair, make_trials(RUNS, np.random.default_rng(3)))}
    found = agreement({"regimes": {"": made}}, new)
    assert found["agrees"], found["rows"]
    (control,) = found["negative_control"]
    assert control["forecast"] < control["measured"] - 0.05
    assert control["rejected"]


def test_without_dependence_the_product_is_not_rejected(pair: Task, make_trials: Make) -> None:
    """Control experiment: independent statuses multiply."""
    trials = make_trials(1500, np.random.default_rng(4), dependence=0.0)
    assert dependences(Training.of(pair, trials))[0]["p"] > 0.01
    found = agreement(
        {"regimes": {"": forecast(pair, trials)}},
        {"": Training.of(pair, make_trials(RUNS, np.random.default_rng(5), 0.0))},
    )
    assert not found["negative_control"][0]["rejected"]


def test_the_comparison_rejects_a_changed_world(pair: Task, make_trials: Make) -> None:
    """The comparison can fail: it reports different times and different shares."""
    made = forecast(pair, make_trials(1500, np.random.default_rng(6)))
    slower = [
        replace(t, time=t.time * 1.05 if t.time else None)
        for t in make_trials(RUNS, np.random.default_rng(7))
    ]
    found = agreement({"regimes": {"": made}}, {"": Training.of(pair, slower)})
    assert not found["agrees"]
    assert {row["figure"] for row in found["rows"] if (row["p_holm"] or 1) < 0.01} >= {"mean"}
    assert 0.75 < made["figures"]["R_goal"]["value"] < 0.85
    fewer = [
        replace(t, goals=t.goals * (i % 4 > 0))
        for i, t in enumerate(make_trials(RUNS, np.random.default_rng(8)))
    ]
    assert not agreement({"regimes": {"": made}}, {"": Training.of(pair, fewer)})["agrees"]


def test_a_changed_duration_that_the_total_hides_is_named(pair: Task, make_trials: Make) -> None:
    """The second run ends with the signal, so it makes up for a longer first one; runs of one
    trial count once. An older file, without durations, is still compared."""
    made = forecast(pair, make_trials(1000, np.random.default_rng(6)))
    same = make_trials(RUNS, np.random.default_rng(7))
    longer = [
        replace(
            t,
            runs=[
                replace(t.runs[0], took=t.runs[0].took + 0.1),
                *(replace(r, begun=r.begun + 0.1, took=r.took - 0.1) for r in t.runs[1:]),
            ],
        )
        for t in same
    ]
    old = {key: value for key, value in made.items() if key != "durations"}
    for said, trials, differing in (
        (made, same, []),
        (made, longer, ["first_a", "second_a"]),
        (old, longer, []),
    ):
        found = agreement({"regimes": {"": said}}, {"": Training.of(pair, trials)})
        assert all(row["agrees"] is not False for row in (*found["rows"], *found["law"]))
        named = [row["action"] for row in found["durations"] if row["agrees"] is False]
        assert named == differing and found["agrees"] is not bool(differing)
    alike = [replace(t, runs=[t.runs[0]] * 3 + t.runs[1:]) for t in same]
    times, _ = durations(Training.of(pair, alike))["first", "first_a"]
    assert times.tolist() == [round(t.runs[0].took, 4) for t in same]


def test_a_place_that_only_one_side_entered_differs_unless_by_chance(
    pair: Task, make_trials: Make
) -> None:
    """Its runs cannot be compared, but how many trials entered it can."""
    trials = make_trials(1000, np.random.default_rng(6), dependence=0.0)
    for entering, agrees in ((3, True), (60, False)):
        few = [t if i < entering else replace(t, runs=t.runs[:1]) for i, t in enumerate(trials)]
        alone = [replace(t, runs=t.runs[:1]) for t in trials]
        for known, new in ((few, alone), (alone, few)):
            made = forecast(pair, known)
            found = agreement({"regimes": {"": made}}, {"": Training.of(pair, new)})
            rows = [row["agrees"] for row in found["routing"] if row["place"] == "second"]
            assert rows == [agrees]


def test_unfolding_keeps_the_spread_of_the_time(pair: Task, make_trials: Make) -> None:
    """A long first run is followed by a short second one: independent draws would make the spread
    of the time too large."""
    trials = make_trials(1500, np.random.default_rng(9))
    training = Training.of(pair, trials)
    real = measured(training)
    met = real.goals > 0
    assert np.std(real.time[met]) < 0.05
    made = forecast(pair, trials, net=True)
    assert made["residual"][-1]["p"] > 0.001
    new = Training.of(pair, make_trials(RUNS, np.random.default_rng(10)))
    law = agreement({"regimes": {"": made}}, {"": new})["law"][0]
    assert law["agrees"]


def test_a_choice_that_was_never_measured_is_refused(pair: Task, make_trials: Make) -> None:
    """A what-if forecast needs at least some runs of the action; with them it works."""
    trials = make_trials(300, np.random.default_rng(11))
    other = {"first": {"first_b": 1.0}, "second": {"second_a": 1.0}}
    with pytest.raises(ValueError, match="first_b was never run"):
        forecast(pair, trials, choices=other)
    both = make_trials(1000, np.random.default_rng(12), actions=("first_a", "first_b"))
    alone = figures(
        measured(
            Training.of(pair, make_trials(4000, np.random.default_rng(13), actions=("first_b",)))
        )
    )
    assert forecast(pair, both, choices=other)["figures"]["mean"]["value"] == pytest.approx(
        alone["mean"], rel=0.02
    )


@pytest.mark.once
def test_predictive_intervals_cover(pair: Task, make_trials: Make) -> None:
    """In 40 worlds, nearly all 95 % intervals for R_goal and the mean cover the true value (99.9 %
    binomial bound)."""
    inside = 0
    for seed in range(20):
        random = np.random.default_rng(100 + seed)
        training = Training.of(pair, make_trials(250, random))
        made = predict(
            training, Request(200, choices_of(training), seed, replicates=40, point=8000)
        )
        found = agreement(
            {"regimes": {"": made}}, {"": Training.of(pair, make_trials(200, random))}
        )
        inside += sum(
            row["p"] >= 0.05 for row in found["rows"] if row["figure"] in ("R_goal", "mean")
        )
    assert binom.cdf(inside, 40, 0.95) > 0.001


def test_the_weight_of_censored_runs_goes_to_later_ends(pair: Task) -> None:
    """Aalen-Johansen by hand: ends at 1 (success) and 3 (failure); the run censored at 2 passes its
    third to the end at 3."""
    runs = [
        RunEntry("first", "first_a", 0.0, took, status)
        for took, status in ((1.0, "success"), (2.0, ""), (3.0, "failure"))
    ]
    law = next(
        iter(
            RunDistributions(
                Training.of(pair, [Trial(1, 0.0, runs=[run]) for run in runs])
            ).contexts.values()
        )
    ).ends
    assert law.took.tolist() == [1.0, 3.0]
    assert law.weight.tolist() == pytest.approx([1 / 3, 2 / 3])


RACE = with_transitions("""
schema = 1
[task]
name = "race"
final = "jobs == 0 and free == 1"
runs_place = "jobs"
[primitive_tasks]
look = { goal = "seen", alternatives = ["look"], deadline = 2.0 }
hold = { goal = "held", alternatives = ["hold"], deadline = 9.0 }
move = { goal = "moved", alternatives = ["move"], deadline = 9.0 }
[places]
jobs = { kind = "control", tokens = 4 }
free = { kind = "resource", tokens = 1 }
look = { kind = "action" }
hold = { kind = "action" }
move = { kind = "action" }
begin: jobs, free -> look
seen: look:normal -> hold, move
not_seen: look:error -> free
done: hold:preempt=success, move:normal -> free
slipped: hold:error, move:preempt=failure -> free
stopped: move:error, hold:preempt=failure -> free
""")
"""A ball is looked for; then the gripper holds until the arm has moved, or slips before."""


def race(
    n: int, random: np.random.Generator, slow: float = 1.0, faults: float = 1.0
) -> list[Trial]:
    """Draw trials in which looking and moving take `slow` times as long, and slips are `faults`
    times as frequent. Looking hangs in 2 % until its deadline, and may be too slow for it."""
    out = []
    for _ in range(n):
        took = 9.0 if random.random() < 0.02 else slow * float(random.uniform(0.6, 1.2))
        late = took > 2.0
        took = min(took, 2.0)
        taken = "not_seen" if late else "seen"
        status = "error" if late else "success"
        runs = [RunEntry("look", "look", 0.0, took, status, taken=taken, seconds=took)]
        time, worst = took, status
        if not late:
            moved = slow * float(random.uniform(0.8, 1.2))
            slip = float(random.uniform(0.0, 4.0)) if random.random() < 0.3 * faults else 9.0
            rest, slipped = min(moved, slip), slip < moved
            worst, taken = ("error", "slipped") if slipped else ("success", "done")
            for place in ("hold", "move"):
                cut = slipped == (place == "move")
                one = ("failure" if slipped else "success") if cut else worst
                runs.append(
                    RunEntry(
                        place, place, took, rest, one, taken=taken, cancelled=cut, seconds=rest
                    )
                )
            time += rest
        out.append(Trial(1, 0.0, round(time, 6), True, 0, worst, "", runs, []))
    return out


@pytest.mark.parametrize(
    ("slow", "faults", "changes"),
    [
        (1.0, 2.5, ["hold.error.share*=2.5"]),
        (0.6, 1.0, ["look.mean*=0.6", "move.mean*=0.6"]),
        (1.9, 1.0, ["look.success.mean*=1.9", "move.move.success.mean*=1.9"]),
        (1.3, 0.2, ["hold.error.share*=0.2", "look.success.mean=1.17", "move.mean*=1.3"]),
    ],
)
def test_other_durations_and_shares_are_forecast_as_they_then_come(
    slow: float, faults: float, changes: list[str]
) -> None:
    """Also of runs that are cut off, or that become too slow for their deadline."""
    task = loads(RACE, "race.toml")
    asked = [read_change(text) for text in changes]
    trained = race(6000, np.random.default_rng(1))
    found = forecast(task, trained, changes=asked)
    assert found["from"] == "net" and ", ".join(changes) in found["assumptions"][-1]
    truth = figures(
        measured(Training.of(task, race(20_000, np.random.default_rng(2), slow, faults)))
    )
    for name in ("R_conj", "P_complete"):
        assert found["figures"][name]["value"] == pytest.approx(truth[name], abs=0.015)
    for name in ("mean", "q90"):
        assert found["figures"][name]["value"] == pytest.approx(truth[name], rel=0.03)


DRILL = with_transitions("""
schema = 1
[task]
name = "drill"
final = "jobs == 0 and free == 1"
runs_place = "jobs"
goal_transitions = ["drilled"]
[primitive_tasks]
drill = { deadline = 30.0 }
[events]
hot = { memory = "latched", mean_wait = 8.0 }
[places]
jobs = { kind = "control", tokens = 4 }
free = { kind = "resource", tokens = 1 }
drill = { kind = "action" }
begin: jobs, free -> drill
drilled: drill:normal -> free
broke: drill:error -> free
too_hot: drill:preempt=failure -> free; event = "hot"
too_long: drill:preempt=none -> free; after = AFTER
""")


def drills(n: int, random: np.random.Generator, after: float, slow: float = 1.0) -> list[Trial]:
    """Draw trials in which drilling takes `slow` times as long, until it is hot, or too long."""
    out = []
    for _ in range(n):
        own, hot = slow * float(random.uniform(2.0, 4.0)), float(random.exponential(8.0))
        took, taken, status = min((own, "drilled", "success"), (hot, "too_hot", "failure"),
                                  (after, "too_long", ""))  # fmt: skip
        cut = taken != "drilled"
        run = RunEntry(
            "drill", "drill", 0.0, took, status, taken=taken, cancelled=cut, seconds=took
        )
        out.append(Trial(1, 0.0, took, True, int(not cut), status or "success", "", [run], []))
    return out


@pytest.mark.parametrize(
    ("after", "slow"), [(5.0, 1.0), (5.0, 1.5), (3.5, 1.5), (5.0, 3.0), (5.0, 0.5)]
)
def test_runs_that_last_longer_are_preempted_more_often(after: float, slow: float) -> None:
    """Also by a timer that no run of the training met. What an event or a timer preempted kept its
    share: R_goal was .91 for .76 in a task like this one, without a doubt."""
    task = loads(DRILL.replace("AFTER", str(after)), "drill.toml")
    training = Training.of(task, drills(3000, np.random.default_rng(1), after))
    runs = changed(training, training.runs, [read_change(f"drill.mean*={slow}")])
    truth = Training.of(task, drills(30_000, np.random.default_rng(2), after, slow)).runs
    for outcome in {*runs.outcome.tolist(), *truth.outcome.tolist()}:
        shares = [float((one.outcome == outcome).mean()) for one in (runs, truth)]
        assert shares[0] == pytest.approx(shares[1], abs=0.03)
        own = [one.took[one.outcome == outcome] for one in (runs, truth)]
        if min(map(len, own)) > 50:
            assert own[0].mean() == pytest.approx(own[1].mean(), rel=0.05)
    assert runs.took.max() <= after + 1e-9


@pytest.mark.parametrize(("after", "guessed"), [(3.5, True), (5.0, False)])
def test_faster_runs_that_were_always_preempted_are_a_guess(after: float, guessed: bool) -> None:
    """No run of the training shows when those would have ended."""
    task = loads(DRILL.replace("AFTER", str(after)), "drill.toml")
    trained, asked = drills(600, np.random.default_rng(1), after), [read_change("drill.mean*=0.5")]
    found = forecast(task, trained, changes=asked)
    said = [one for one in found["doubts"] if "so how long it would take now is a guess" in one]
    assert bool(said) is guessed, found["doubts"]


def test_trials_that_are_all_alike_depend_on_no_order() -> None:
    """A forecast of constant times printed warnings of a division by 0 and tested with nan."""
    one = next(t for t in race(50, np.random.default_rng(1)) if t.all_success)
    alike = [replace(one, time=0.012)] * 300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = forecast(loads(RACE, "race.toml"), alike)
    assert found["figures"]["mean"]["value"] == pytest.approx(0.012) and not found["doubts"]


def test_the_product_of_a_what_if_has_its_shares() -> None:
    """It was that of the training, beside an R_conj with other faults."""
    trained, asked = race(2000, np.random.default_rng(1)), [read_change("hold.error.share=0")]
    found = forecast(loads(RACE, "race.toml"), trained, changes=asked)["product"]
    late = [run for t in trained for run in t.runs if run.place == "hold"]
    ends = [run.status == "success" for run in late if run.status != "error"]
    assert np.mean(ends) > np.mean([run.status == "success" for run in late]) + 0.01
    assert found["factors"]["hold"] == pytest.approx(np.mean(ends), abs=0.005)
    assert found["R_conj"] == pytest.approx(np.prod([*found["factors"].values()]), abs=1e-5)


def test_a_preempted_run_counts_in_the_product_as_its_arc_says() -> None:
    """A run that is always preempted when all went well has a reliability, too, not none."""
    trained = race(2000, np.random.default_rng(1))
    found = forecast(loads(RACE, "race.toml"), trained)["product"]["factors"]
    for place in ("look", "hold", "move"):
        ends = [run.status == "success" for t in trained for run in t.runs if run.place == place]
        assert found[place] == pytest.approx(np.mean(ends), abs=1e-6) and found[place] > 0.5


STEPS = with_transitions("""
schema = 1
[task]
name = "steps"
final = "jobs == 0 and free == 1"
goal_transitions = ["done"]
runs_place = "jobs"
[primitive_tasks]
look.goal = "seen"
look.alternatives = ["look_0", "look_1", "look_2", "look_3", "look_4"]
look.deadline = 9.0
plan = { goal = "planned", alternatives = ["plan_0", "plan_1", "plan_2"], deadline = 9.0 }
grasp = { goal = "held", alternatives = ["grasp_0", "grasp_1"], deadline = 9.0 }
[places]
jobs = { kind = "control", tokens = 4 }
free = { kind = "resource", tokens = 1 }
look = { kind = "action" }
plan = { kind = "action" }
grasp = { kind = "action" }
begin: jobs, free -> look
seen: look:normal -> plan
not_seen: look:error -> free
planned: plan:normal -> grasp
not_planned: plan:error -> free
done: grasp:normal -> free
dropped: grasp:error -> free
""")
QUALITY = {
    "look": (0.97, 0.90, 0.99, 0.80, 0.95),
    "plan": (0.97, 0.85, 0.99),
    "grasp": (0.95, 0.80),
}
"""How much each choice multiplies the chance to hold the part."""


def steps(n: int, random: np.random.Generator, plan: float = 1.0) -> list[Trial]:
    """Draw trials that choose at random; only the last step shows how good all choices were.
    `plan`: seconds that planning takes."""
    out = []
    for _ in range(n):
        chosen = {place: int(random.integers(len(q))) for place, q in QUALITY.items()}
        chance = float(np.prod([QUALITY[place][k] for place, k in chosen.items()]))
        held = random.random() < chance
        runs = []
        for i, (place, k) in enumerate(chosen.items()):
            status, taken = "success", ("seen", "planned", "done")[i]
            if place == "grasp" and not held:
                status, taken = "error", "dropped"
            took = plan if place == "plan" else 1.0
            runs.append(RunEntry(place, f"{place}_{k}", 1.0 * i, took, status, taken=taken))
        out.append(Trial(1, 0.0, 3.0, True, int(held), runs[-1].status, "", runs, []))
    return out


@pytest.mark.parametrize("combination", [(1, 1, 1), (2, 2, 0)])
def test_a_combination_that_few_trials_made_is_forecast_from_what_each_choice_does(
    combination: tuple[int, int, int],
) -> None:
    """Ten of 300 trials made it. Without what each choice does elsewhere, the mean of twelve
    forecasts is .69 for .61, and .85 for .93, and the intervals hold in five of twelve."""
    task = loads(STEPS, "steps.toml")
    chosen = dict(zip(QUALITY, combination, strict=True))
    truth = float(np.prod([QUALITY[place][k] for place, k in chosen.items()]))
    choices = {place: {f"{place}_{k}": 1.0} for place, k in chosen.items()}
    found = [
        forecast(task, steps(300, np.random.default_rng(seed)), choices=choices)
        for seed in range(8)
    ]
    assert {one["from"] for one in found} == {"net"}
    values = [one["figures"]["R_goal"]["value"] for one in found]
    held = sum(
        low <= truth <= high for low, high in (o["figures"]["R_goal"]["confidence"] for o in found)
    )
    assert np.mean(values) == pytest.approx(truth, abs=0.045) and held >= 6


def test_a_choice_counts_while_its_run_is_still_active() -> None:
    """The arm grasps while the camera still tracks: what tracks decides what is held."""
    beside = (
        STEPS.replace(
            'in = ["look:normal"]\nout = ["plan"]', 'in = ["look:normal"]\nout = ["plan", "grasp"]'
        )
        .replace('in = ["plan:normal"]\nout = ["grasp"]', 'in = ["plan:normal"]\nout = []')
        .replace('in = ["plan:error"]\nout = ["free"]', 'in = ["plan:error"]\nout = []')
    )
    task, found = loads(beside, "steps.toml"), []
    for seed in range(3):
        trained = steps(600, np.random.default_rng(seed), plan=1.5)
        choices = {**choices_of(Training.of(task, trained)), "plan": {"plan_1": 1.0}}
        found.append(forecast(task, trained, choices=choices, net=True))
    mean = float(np.mean(QUALITY["look"]) * np.mean(QUALITY["grasp"]))
    values = [one["figures"]["R_goal"]["value"] for one in found]
    assert np.mean(values) == pytest.approx(0.85 * mean, abs=0.02)


def test_a_change_by_nothing_changes_nothing() -> None:
    """The figures are those of the simulated net, to the bit."""
    task, trials = loads(RACE, "race.toml"), race(300, np.random.default_rng(3))
    changes = [read_change(text) for text in ("look.mean*=1", "hold.error.share*=1")]
    plain, changed = forecast(task, trials, net=True), forecast(task, trials, changes=changes)
    assert changed["figures"] == plain["figures"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("jobs=2", "change the task file"),
        ("look.success.cv=0.1", "durations as measured"),
        ("lok.mean*=2", "race has no such number"),
        ("look.mean=2", "race has no such number"),
        ("look.see.error.share=0.1", "its alternatives are look"),
        ("look.failure.share=0.1", "no run in look ended so"),
        ("hold.error.share*=40", "a share is from 0 to 1"),
        ("look.success.mean*=0", "a mean above 0"),
    ],
)
def test_a_change_that_cannot_be_forecast_is_refused(change: str, words: str) -> None:
    """Bad input is named, with what is possible."""
    task, trials = loads(RACE, "race.toml"), race(200, np.random.default_rng(4))
    with pytest.raises(NetFileError, match=words):
        forecast(task, trials, changes=[read_change(change)])


def test_a_forecast_of_an_older_version_is_still_compared(pair: Task, make_trials: Make) -> None:
    """Files of schema 1 contain a standard deviation instead of a distribution of each figure."""
    made = forecast(pair, make_trials(1500, np.random.default_rng(6)))
    sd = {"R_goal": 0.02, "P_complete": 0.0, "R_conj": 0.02, "mean": 0.02, "q90": 0.01}
    old = {
        **made,
        "figures": {
            name: {"value": f["value"], "interval": f["interval"], "sd": sd[name]}
            for name, f in made["figures"].items()
        },
        "law": {k: made["law"][k] for k in ("q", "s")},
        "distance_99": 0.08,
    }
    same = {"": Training.of(pair, make_trials(RUNS, np.random.default_rng(7)))}
    found = agreement({"regimes": {"": old}}, same)
    assert found["agrees"], found
    (mean,) = (row for row in found["rows"] if row["figure"] == "mean")
    scale = np.sqrt((1 / RUNS + 1 / 1500) / (1 / made["runs"] + 1 / 1500))
    z = abs(mean["measured"] - mean["forecast"]) / (0.02 * scale)
    assert mean["p"] == pytest.approx(2 * norm.sf(z), abs=0.01)


@pytest.mark.parametrize("net", [None, True])
def test_a_task_without_goals_has_no_share_of_goals(
    pair: Task, make_trials: Make, net: bool | None
) -> None:
    """Nor has the comparison with a forecast of an older version, which still had a 0 there."""
    task = replace(pair, goal_transitions=())
    made = forecast(task, make_trials(200, np.random.default_rng(8)), net=net)
    assert list(made["figures"]) == ["P_complete", "R_conj", "mean", "q90"]
    older = {**made, "figures": {"R_goal": made["figures"]["R_conj"], **made["figures"]}}
    new = {"": Training.of(task, make_trials(100, np.random.default_rng(9)))}
    for said in (made, older):
        rows = agreement({"regimes": {"": said}}, new)["rows"]
        assert [row["figure"] for row in rows] == list(made["figures"])


@pytest.mark.parametrize("figure", ["mean", "q90"])
def test_a_time_at_the_end_of_its_interval_has_a_p_value_of_five_per_cent(
    pair: Task, make_trials: Make, figure: str
) -> None:
    """Interval and test say the same; far outside the p-value goes to 0, inside to 1."""
    found = forecast(pair, make_trials(400, np.random.default_rng(6)))["figures"][figure]
    curve, value = np.array(found["curve"]), found["value"]

    def p(seen: float) -> float:
        return time_p_value(value, curve, seen, RUNS, RUNS, 400)

    for end in found["interval"]:
        assert p(end) == pytest.approx(0.05, abs=0.002)
    low, high = found["interval"]
    assert p(curve[len(curve) // 2]) > 0.95
    assert p(value + 5 * (high - low)) < 1e-6
    assert p(low + 0.3 * (high - low)) > 0.1


# --- statistics -------------------------------------------------------------------------------


def test_holm_by_hand() -> None:
    """The sorted p-values .01 .03 .04 are multiplied by 3, 2, 1 and never decrease."""
    assert holm([0.03, 0.01, 0.04]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_lies_between_plain_and_bonferroni(p_values: list[float]) -> None:
    """It also keeps the order."""
    adjusted = holm(p_values)
    assert all(
        p <= a <= min(1.0, len(p_values) * p) + 1e-12
        for p, a in zip(p_values, adjusted, strict=True)
    )


@given(st.floats(0.0, 1.0), st.integers(10, 5000), st.integers(1, 2000))
def test_share_test_and_interval_agree(value: float, weight: int, n: int) -> None:
    """A share in the middle of the interval is never rejected at 5 %."""
    low, high = predictive_interval(value, weight, n)
    middle = round(n * (low + high) / 2)
    assert share_p_value(value, weight, middle, n) > 0.05
    assert 0.0 <= low <= high <= 1.0


def test_a_share_of_one_tolerates_a_rare_miss() -> None:
    """999 of 1,000 do not contradict a forecast made from 1,000 of 1,000; 980 do."""
    assert share_p_value(1.0, 1000, 999, 1000) > 0.05
    assert share_p_value(1.0, 1000, 980, 1000) < 1e-3


def test_quantile_interval_holds_its_quantile() -> None:
    """For uniform numbers the 90 % quantile is in its 90 % interval about nine times in ten."""
    random = np.random.default_rng(1)
    hits = sum(
        low <= 0.9 <= high
        for low, high in (quantile_interval(random.random(300), 0.9) for _ in range(200))
    )
    assert 165 <= hits <= 198


# --- registered files -------------------------------------------------------------------------


def test_a_registered_forecast_stays_as_it_is(
    pair: Task, make_trials: Make, tmp_path: Path
) -> None:
    """It is never overwritten; a changed file is refused."""
    training = {"": Training.of(pair, make_trials(200, np.random.default_rng(1)))}
    request = {"": Request(100, choices_of(training[""]), replicates=20, point=2000)}
    made = register(pair, training, request, {"estimates": {"campaign": "c"}})
    path = tmp_path / "f.json"
    write(path, made)
    assert read(path) == made
    with pytest.raises(ForecastError, match="never overwritten"):
        write(path, made)
    path.write_text(path.read_text().replace('"runs": 100', '"runs": 101'), encoding="utf-8")
    with pytest.raises(ForecastError, match="was changed"):
        read(path)
    with pytest.raises(ForecastError, match="no trial of regime B"):
        register(pair, training, {"B": request[""]}, {})


def test_the_same_seed_gives_the_same_forecast(pair: Task, make_trials: Make) -> None:
    """All random numbers are seeded."""
    trials = make_trials(300, np.random.default_rng(1))
    assert forecast(pair, trials) == forecast(pair, trials)


def test_the_stochastic_view_is_reported_too(pair: Task, make_trials: Make) -> None:
    """It keeps shares and means exactly, but assumes independent statuses: its R_conj is the
    product, not the true value."""
    from petrobot.coordinator.studies.campaign.observed import estimates_of
    from petrobot.coordinator.studies.campaign.table import TrialRow
    from petrobot.coordinator.studies.forecast.registered import exact

    trials = make_trials(1500, np.random.default_rng(14))
    training = Training.of(pair, trials)
    rows = [TrialRow(i, "", i, 1, i, 1.0, trial) for i, trial in enumerate(trials)]
    found = exact(pair, estimates_of(pair, rows, "t"), "", choices_of(training))
    own = figures(measured(training))
    assert found["R_goal"] == pytest.approx(own["R_goal"], abs=1e-3)
    assert found["mean"] == pytest.approx(own["mean"], rel=0.01)  # without the wait for the tick
    product = forecast(pair, trials)["product"]["R_conj"]
    assert found["R_conj"] == pytest.approx(product, abs=1e-3)
    assert found["R_conj"] < own["R_conj"] - 0.05
