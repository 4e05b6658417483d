"""When a forecast is doubtful: the difference is significant and large enough to matter."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import rankdata, spearmanr

from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast import residual
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.history import Training
from petrobot.coordinator.studies.forecast.play import Played
from petrobot.coordinator.studies.forecast.predict import Request, predict
from petrobot.coordinator.studies.forecast.registered import contradictions, unlike_trials
from petrobot.coordinator.studies.forecast.residual import (
    doubts,
    measured,
    order_doubts,
    overlapping,
    residuals,
    routing,
)
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.test_preempting import ONE_WAY, one_way, trials_of

pytestmark = pytest.mark.once

NOTHING = Played(np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros(0, np.bool_), np.zeros(0))


@pytest.mark.parametrize(
    ("of", "p", "off", "doubtful"),
    [
        ("goal", 1e-9, 0.019, False),
        ("goal", 1e-9, 0.021, True),
        ("goal", 0.02, 0.3, False),
        ("ways out of watch", 1e-3, 0.1, True),
        ("time", 1e-9, 0.04, False),
        ("time", 1e-9, 0.06, True),
        ("mean time", 1e-9, 0.04, False),
        ("mean time", 1e-9, 0.06, True),
    ],
)
def test_doubts_need_a_significant_and_relevant_difference(
    of: str, p: float, off: float, doubtful: bool
) -> None:
    """With many trials every model differs significantly somewhere; with few, a large difference
    may be chance."""
    said = doubts([{"of": of, "p": p, "p_holm": p, "off": off}], NOTHING, 1000)
    assert bool(said) == doubtful
    assert not said or of in said[0]


def test_times_that_are_equal_but_for_rounding_do_not_differ() -> None:
    """Durations that never vary: their rounding errors are no spread, two constants that differ
    surely do, and one constant is compared with what varies."""
    equal, rounded = np.full(40, 0.3), np.full(40, 0.1 + 0.2)
    rounded[::2] = 0.3
    assert residual._same_mean(equal, rounded) == 1.0
    assert residual._same_mean(equal, np.full(40, 0.31)) == 0.0
    assert set(residual._classes(rounded, np.full(40, 0.1 + 0.2)).tolist()) == {4.0}
    assert 0.01 < residual._same_mean(rounded, np.linspace(0.29, 0.31, 40)) <= 1.0
    assert residual._same_mean(rounded, np.linspace(0.39, 0.41, 40)) < 1e-6


def test_the_distance_is_the_largest_difference_of_shares_or_relative_difference_of_means() -> None:
    """Tried with trials simulated exactly as recorded, then with some that miss a goal, then with
    all taking longer."""
    training = Training.of(loads(ONE_WAY, "scan.toml"), trials_of(one_way, 1000, 3))
    real = measured(training)
    same = replace(real, ways=routing(training))
    assert all(row["off"] == 0.0 and row["p_holm"] == 1.0 for row in residuals(training, same))
    reached = np.flatnonzero(real.goals > 0)
    goals = real.goals.copy()
    goals[reached[:150]] = 0
    found = {
        row["of"]: row
        for row in residuals(training, replace(same, goals=goals, time=real.time * 1.2))
    }
    assert found["goal"]["off"] == pytest.approx(0.15)
    assert found["mean time"]["off"] == pytest.approx(0.2)
    assert found["complete"]["off"] == 0.0
    said = doubts(list(found.values()), same, 1000)
    assert any("goal, off by 15.0%" in one for one in said) and any(
        "mean time" in one for one in said
    )


def test_a_place_that_only_one_side_entered_is_no_doubt_if_that_may_be_chance() -> None:
    """One trial of the training entered it, none of four times as many simulated ones; or half of
    the training did."""
    training = Training.of(loads(ONE_WAY, "scan.toml"), trials_of(one_way, 200, 3))
    real = measured(training)
    for entering, doubtful in ((1, False), (100, True)):
        trials = [
            replace(t, runs=t.runs[: 1 + (i < entering)]) for i, t in enumerate(training.trials)
        ]
        few = Training.of(training.task, trials)
        last = trials[0].runs[1].place
        ways = {place: counts for place, counts in routing(few).items() if place != last}
        played = Played(
            np.repeat(real.goals, 4),
            np.repeat(real.completed, 4),
            np.repeat(real.all_success, 4),
            np.repeat(real.time, 4),
            ways=ways,
        )
        (row,) = (r for r in residuals(few, played) if r["of"] == f"ways out of {last}")
        assert (row["p_holm"] < 0.01) is doubtful
        assert row["off"] == entering / 200


def timed(times: np.ndarray, goals: np.ndarray) -> Training:
    """Trials with these times and goals."""
    trials = [
        replace(trial, time=round(float(t), 6), goals=int(g))
        for trial, t, g in zip(trials_of(one_way, len(times), 3), times, goals, strict=True)
    ]
    return Training.of(loads(ONE_WAY, "scan.toml"), trials)


def test_trials_that_depend_on_their_order_are_doubtful() -> None:
    """A trend, and a time that follows the one before; independent trials, also long-tailed ones
    with a few failures side by side, are not."""
    random, n = np.random.default_rng(1), 300
    even, goals = random.lognormal(0.0, 1.0, n), np.ones(n, np.int64)
    assert order_doubts(timed(even, goals)) == []
    neighbours = goals.copy()
    neighbours[[20, 21, 90, 91, 150, 210]] = 0
    assert order_doubts(timed(even, neighbours)) == []
    (trend,) = order_doubts(timed(even * np.linspace(1.0, 3.0, n), goals))
    assert trend.startswith("the training's time changes with the order of the trials")
    follows = np.zeros(n)
    for k in range(1, n):
        follows[k] = 0.5 * follows[k - 1] + random.normal()
    (lag,) = order_doubts(timed(10.0 + follows, goals))
    assert "time depends on the trial before" in lag


def test_trials_at_the_same_time_are_doubtful() -> None:
    """A task that works on several tokens at once: what a trial waits for the others is in its
    time. A new mission run begins at 0 again."""
    random, n = np.random.default_rng(3), 100
    training = timed(random.exponential(1.0, n), np.ones(n, np.int64))
    begins = np.concatenate([[0.0], np.cumsum([t.time or 0.0 for t in training.trials])[:-1]])
    for early, found in ((0.0, 0), (0.001, n - 2)):
        trials = [
            replace(
                trial,
                k=i % 50 + 1,
                begun=round(float(at - begins[i // 50 * 50]), 6) - early * (i % 50),
            )
            for i, (trial, at) in enumerate(zip(training.trials, begins, strict=True))
        ]
        one = Training.of(training.task, trials)
        assert overlapping(one) == found
        assert [doubt[:2] for doubt in order_doubts(one)] == [str(found)] * (found > 0)


@pytest.mark.parametrize(
    ("few", "of", "seconds", "told"),
    [
        (2, 300, 60.0, "the mean time (1.393 s, 1 s without them) rests on 2 of"),
        (5, 300, 60.0, ""),  # enough to tell how often they come
        (2, 300, 5.0, ""),  # little of the mean
        (2, 20, 1.3, "the 90 % quantile rests on 2 of"),
        (0, 300, 60.0, ""),
    ],
)
def test_figures_that_rest_on_a_few_trials_of_a_rare_branch_are_doubtful(
    few: int, of: int, seconds: float, told: str
) -> None:
    """The reason contains the figure with and without these trials."""
    trials = []
    for i in range(of):
        long = i % (of // max(few, 1)) == 1 and few > 0
        time, taken = (seconds, "lost") if long else (1.0, "found")
        runs = [RunEntry("locate", "locate_a", 0.0, time, "success", taken=taken)]
        trials.append(Trial(1, 0.0, time, True, 1, runs=runs))
    known = Training.of(loads(ONE_WAY, "scan.toml"), trials)
    said = predict(known, Request(100, choices_of(known), net=False))["doubts"]
    assert [told in doubt and "those with lost: " in doubt for doubt in said] == [True] * bool(told)


def test_independent_trials_are_seldom_doubtful() -> None:
    """At 0.03 % for each training: at most 2 of 200."""
    random = np.random.default_rng(2)
    found = sum(
        bool(order_doubts(timed(random.exponential(1.0, 60), random.random(60) < 0.9)))
        for _ in range(200)
    )
    assert found <= 2


def correlations(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Pearson's correlation of one sample of ranks with each row of others."""
    a, b = one - one.mean(), others - others.mean(axis=1, keepdims=True)
    return np.asarray(b @ a / np.sqrt((a @ a) * (b * b).sum(axis=1)))


def test_stopping_early_decides_as_all_permutations_do() -> None:
    """Correlations whose p-values lie around the level, and all permutations drawn at once: the
    p-values below the level are the same, the others stay above it."""
    random, level, count = np.random.default_rng(3), residual.ORDER_LEVEL, residual.PERMUTATIONS
    near = 0
    for sample in random.normal(size=(30, 40)):
        follows = 0.65 * sample + random.normal(size=40)
        r, early = residual._rank_test(sample, follows)
        one, other = rankdata(sample), rankdata(follows)
        assert r == pytest.approx(correlations(one, other[None])[0])
        mixed = np.random.default_rng(0).permuted(np.tile(other, (count, 1)), axis=1)
        beyond = int(np.sum(np.abs(correlations(one, mixed)) >= abs(r) - 1e-9))
        full = (beyond + 1) / (count + 1)
        assert early == full if full < level else early >= level
        near += level / 3 < full < level
    assert near >= 2


@pytest.mark.parametrize("swapped", [(0, 0), (0, 1), (0, 2), (0, 3)])
def test_the_order_of_few_trials_is_judged_as_by_all_their_orders(swapped: tuple[int, int]) -> None:
    """All 8! orders, with a tie: at least `AT_ONCE` are drawn, so p is within 2 deviations."""
    one, other = np.arange(8.0), np.array([0.0, 1.0, 2.0, 2.0, 4.0, 5.0, 6.0, 7.0])
    other[list(swapped)] = other[list(swapped)[::-1]]
    r, p = residual._rank_test(one, other)
    orders = rankdata(other)[np.array(list(permutations(range(8))))]
    exact = float(np.mean(np.abs(correlations(rankdata(one), orders)) >= abs(r) - 1e-9))
    drawn = residual.PERMUTATIONS if p < residual.ORDER_LEVEL else residual.AT_ONCE
    assert abs(p - exact) < 2 * np.sqrt(exact / drawn) + 1 / drawn
    assert spearmanr(one, other).pvalue < residual.LIKELY


@pytest.mark.parametrize(
    ("other", "contradicts"),
    [
        ({}, []),
        ({"R_goal": 0.59, "mean": 2.4}, []),
        ({"P_complete": 0.98}, ["P_complete is 0.5"]),
        ({"mean": 2.6}, ["mean is 2 "]),
        ({"mean": None}, []),
    ],
)
@pytest.mark.parametrize(
    "untested", [{"same": False}, {"what_if": ["a.mean*=2"]}, {"whole": False}]
)
def test_two_views_that_contradict_each_other_are_doubtful_where_no_trial_tells(
    other: dict[str, Any], contradicts: list[str], untested: dict[str, Any]
) -> None:
    values = {"R_goal": 0.5, "P_complete": 0.5, "mean": 2.0}
    figures = {
        name: {"value": value, "confidence": [0.95 * value, 1.05 * value]}
        for name, value in values.items()
    }
    said = {"from": "net", "whole": True, "same": True, "asked": [], "figures": figures}
    found = contradictions(said | untested, values | other)
    assert len(found) == len(contradicts)
    for text, words in zip(found, contradicts, strict=True):
        assert words in text
    assert not contradictions(said, values | other), "the trials tell"
    assert not contradictions(said | {"asked": ["a"]}, values | other), "the view does not know"
    assert not contradictions(said | untested, {"why": "not solved"})
    assert not unlike_trials(said, values | other), "the figures are not those of the trials"
    wrong = unlike_trials(said | {"from": "trials"}, values | other)
    assert wrong.count(" by the trials, but ") == len(contradicts)
    assert all(words in wrong for words in contradicts)
