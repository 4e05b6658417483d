"""Intervals cover as often as they say, on worlds whose truth is known (a small version of the
proof), and the experiment notices intervals that do not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import binom
from tools.proof import coverage

from petrobot.coordinator.studies.campaign.trials import Trial
from petrobot.coordinator.studies.forecast import predict as module
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.direct import (
    effective,
    mean_figure,
    quantile_figure,
    trial_weights,
)
from petrobot.coordinator.studies.forecast.history import Training
from petrobot.coordinator.studies.forecast.predict import figures
from petrobot.coordinator.studies.forecast.residual import measured

pytestmark = pytest.mark.once

FEW = 25


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "KNOWN", 400)


@pytest.mark.parametrize("world", [*coverage.worlds(), coverage.what_if()], ids=lambda w: w.name)
def test_intervals_cover(world: coverage.World) -> None:
    """Each of ten intervals holds in at least as many of 25 repetitions as a 95 % interval does
    except once in 100,000, none is refused, and the times' intervals are not wide."""
    found = coverage.covered(world, FEW, 150, 150)
    least = int(binom.ppf(1e-5, FEW, 0.95))
    assert found["missed"] == 0
    for name, kinds in found["hits"].items():
        for kind, hits in kinds.items():
            assert hits >= least, (name, kind)
    for name, wide in found["widths"].items():
        assert max(wide.values()) < 1.5, name


def test_narrow_intervals_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The experiment can fail: intervals of half the width miss too often."""

    def half(*given: Any) -> dict[str, Any]:
        found = mean_figure(*given)
        for kind in ("interval", "confidence"):
            middle = sum(found[kind]) / 2
            found[kind] = [(x + middle) / 2 for x in found[kind]]
        return found

    monkeypatch.setattr(module, "mean_figure", half)
    found = coverage.covered(coverage.worlds()[1], 60, 100, 100)
    assert found["hits"]["mean"]["interval"] < binom.ppf(1e-3, 60, 0.95)
    assert any(
        fault.startswith("mean (interval): pooled") for fault in coverage.verdict([found], 60)
    )


def test_independent_branches_miss_what_a_common_cause_does() -> None:
    """The simulated net, whose branches are independent, is rejected on the same training from
    which the trials themselves give the right mean."""
    world = coverage.worlds()[2]
    training = Training.of(world.task, world.draw(np.random.default_rng(1), 1500).trials())
    request = module.Request(300, choices_of(training), replicates=20, point=8000)
    made = module.predict(training, request)
    low, high = made["figures"]["mean"]["confidence"]
    assert made["from"] == module.TRIALS and not made["doubts"]
    assert low <= coverage.figures_of(world)["mean"] <= high
    assert min(row["p_holm"] for row in made["residual"]) < 0.01


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_intervals_of_times_scale_and_contain_their_figure(unit: float) -> None:
    """In milliseconds they are a thousand times the ones in seconds; more new trials narrow the
    predictive interval towards the confidence interval."""
    times, even = np.random.default_rng(1).lognormal(0.0, 1.0, 200), np.ones(200)

    def mean(t: coverage.Values, n: int) -> dict[str, Any]:
        return mean_figure(t, even, n, np.random.default_rng(2))

    def quantile(t: coverage.Values, n: int) -> dict[str, Any]:
        return quantile_figure(t, even, n, 0.9)

    for figure in (mean, quantile):
        plain, scaled, many = figure(times, 100), figure(unit * times, 100), figure(times, 10**6)
        assert scaled["interval"] == pytest.approx([unit * x for x in plain["interval"]], rel=1e-5)
        assert plain["interval"][0] < plain["confidence"][0] < plain["value"]
        assert plain["value"] < plain["confidence"][1] < plain["interval"][1]
        assert many["interval"] == pytest.approx(many["confidence"], rel=0.03)


def test_equal_times_have_an_interval_of_one_point() -> None:
    """Nothing varies: no division by a standard error of 0."""
    times, even = np.full(40, 2.5), np.ones(40)
    assert mean_figure(times, even, 10, np.random.default_rng(1))["interval"] == [2.5, 2.5]
    assert quantile_figure(times, even, 10, 0.9)["interval"] == [2.5, 2.5]


@pytest.mark.parametrize("n", [2, 3])
def test_the_mean_of_two_or_three_trials_is_not_sure(n: int) -> None:
    """Student's interval: a bootstrap of so few has hardly a sample whose mean differs."""
    rng, even, held = np.random.default_rng(4), np.ones(n), 0
    for _ in range(60):
        low, high = mean_figure(rng.uniform(1.0, 3.0, n), even, 20, rng)["confidence"]
        held += low <= 2.0 <= high
    assert held >= 50  # 55 expected


def test_no_time_is_forecast_below_0() -> None:
    """Three trials, one of them much shorter, leave the mean open to both sides; the distribution
    for comparisons keeps its shape."""
    times, even = np.array([0.3, 5.4, 5.6]), np.ones(3)
    found = mean_figure(times, even, 20, np.random.default_rng(1))
    assert found["interval"][0] == found["confidence"][0] == 0.0
    assert found["curve"][0] < 0.0 < found["value"] < found["interval"][1]


def test_quantile_limits_are_the_binomial_ones() -> None:
    """Against order statistics by hand: of 100 uniform times, P(X_(i) <= q90) = P(Bin(100, .9) >=
    i)."""
    times = np.arange(1, 101) / 101
    low, high = quantile_figure(times, np.ones(100), 100, 0.9)["confidence"]
    assert binom.sf(int(np.floor(low * 101)) - 1, 100, 0.9) > 0.975
    assert binom.sf(int(np.ceil(low * 101)) - 1, 100, 0.9) <= 0.976
    assert binom.sf(int(np.ceil(high * 101)) - 1, 100, 0.9) < 0.026


def test_weights_of_a_what_if_are_how_much_more_often_its_trials_come() -> None:
    """Trials with the other action count nothing, the others twice; of 1,000 about 500 remain."""
    world = coverage.what_if()
    training = Training.of(world.task, world.draw(np.random.default_rng(1), 1000).trials())
    asked = {**choices_of(training), **world.choose}
    weights = trial_weights(training, asked)
    second = np.array([t.runs[0].action == "a_b" for t in training.trials])
    assert not weights[~second].any()
    assert weights[second] == pytest.approx(1.0 / second.mean())
    assert effective(weights) == pytest.approx(second.sum())
    assert trial_weights(training, choices_of(training)).tolist() == [1.0] * 1000


def by_missions(random: np.random.Generator, n: int, effect: float) -> list[Trial]:
    """Trials of a sequence, five in each mission run; a mission is slow, and fails, as a whole."""
    world = coverage.worlds()[0]
    mission = np.repeat(random.normal(size=n // 5), 5)
    drawn = world.draw(random, n)
    drawn.time = drawn.time + effect * mission
    drawn.goal = drawn.goal & (mission < 2.0 - effect)
    trials = drawn.trials()
    for i, trial in enumerate(trials):
        before = trials[i - 1] if i % 5 else None
        trial.k = i % 5 + 1
        trial.begun = 0.0 if before is None else before.begun + max(0.0, before.time or 0.0)
    return trials


def test_trials_of_one_mission_that_are_alike_count_as_fewer() -> None:
    """With a common effect of each mission run the intervals still cover; plain ones would not, and
    without such an effect nothing changes."""
    task, hits = coverage.worlds()[0].task, dict.fromkeys((*module.SHARES, *module.TIMES), 0)
    apart, plain, effects = 0, 0, []
    for seed in range(25):
        random = np.random.default_rng(seed)
        known = Training.of(task, by_missions(random, 200, 1.5))
        new = figures(measured(Training.of(task, by_missions(random, 200, 1.5))))
        made = module.predict(known, module.Request(200, choices_of(known), net=False))
        assert not made["doubts"]
        for name, found in made["figures"].items():
            hits[name] += found["interval"][0] <= new[name] <= found["interval"][1]
        effects.append(made["law"]["likeness"])
        low, high = mean_figure(measured(known).time, np.ones(200), 200, random)["interval"]
        plain += low <= new["mean"] <= high
        alone = Training.of(task, by_missions(random, 200, 0.0))
        even = module.predict(alone, module.Request(200, choices_of(alone), net=False))
        apart += even["law"]["likeness"] == 1.0
    assert min(hits.values()) >= binom.ppf(1e-4, 25, 0.95), hits
    assert plain < binom.ppf(1e-3, 25, 0.95)
    assert 2.0 < float(np.median(effects)) < 4.0
    assert apart >= 19
