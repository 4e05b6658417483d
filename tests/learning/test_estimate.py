"""Tallies: what each kind of result changes, merging, corrections, intervals and quantiles."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import replace
from scipy import stats

from petrobot.coordinator.learning.estimate import (
    SIZE,
    Observation,
    Sample,
    Tally,
    quantile,
)
from petrobot.coordinator.learning.selectors import cost_of
from petrobot.coordinator.learning.statistics import Moments, added, clopper_pearson, wilson
from petrobot.coordinator.task import Executed, Status
from tests.learning.conftest import COUNTED, OBSERVATIONS, tally_of

NUMBERS = st.lists(st.floats(-1e3, 1e3), max_size=30)


def of(numbers: list[float]) -> Moments:
    """Return the moments of some numbers."""
    out = Moments()
    for x in numbers:
        out = out.adding(x)
    return out


def close(one: Moments, other: Moments) -> bool:
    """Return whether two moments are equal up to rounding."""
    return one.n == other.n and np.allclose(
        [one.mean, one.variance], [other.mean, other.variance], atol=1e-6
    )


@given(NUMBERS, NUMBERS)
def test_moments_are_those_of_numpy_and_merge(one: list[float], other: list[float]) -> None:
    """Mean and variance of one stream, and of two merged streams."""
    both = of(one).merged(of(other))
    assert close(both, of(one + other))
    if len(one + other) > 1:
        assert both.mean == pytest.approx(np.mean(one + other), abs=1e-9)
        assert both.variance == pytest.approx(np.var(one + other, ddof=1), abs=1e-6)
        assert (both.low, both.high) == (min(one + other), max(one + other))


@given(NUMBERS, st.floats(-1e3, 1e3))
def test_a_number_can_be_removed_again(numbers: list[float], x: float) -> None:
    """Adding and then removing a number restores the moments."""
    assert close(of(numbers).adding(x).without(x), of(numbers))


def test_moments_survive_large_offsets() -> None:
    """The variance of 1e9 + {0, 1, 2} is 1: no cancellation."""
    assert of([1e9, 1e9 + 1, 1e9 + 2]).variance == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("seen", "runs", "reliability", "availability", "censored"),
    [
        (Observation(Status.SUCCESS, 1.0), 1, 1.0, 1.0, 0),
        (Observation(Status.FAILURE, 1.0, "late"), 1, 0.0, 1.0, 0),
        (Observation(Status.ERROR, 1.0, "lost"), 1, 0.0, 1.0, 0),
        (Observation(Status.ERROR, 1.0, "lost", Executed.UNKNOWN), 1, 0.0, 1.0, 0),
        (Observation(Status.ERROR, 0.0, "unreachable", Executed.NO), 0, math.nan, 0.0, 0),
        (Observation(None, 0.4, preempted_by="ball_lost"), 0, math.nan, 1.0, 1),
        (Observation(Status.SUCCESS, 0.4, preempted_by="caught"), 1, 1.0, 1.0, 0),
        (Observation(None, 0.0, executed=Executed.NO, preempted_by="caught"), 0, math.nan, 1.0, 0),
    ],
    ids=[
        "success",
        "failure",
        "error",
        "unknown",
        "never executed",
        "censored",
        "preempted success",
        "never began",
    ],
)
def test_the_numbers_that_each_result_changes(
    seen: Observation, runs: int, reliability: float, availability: float, censored: int
) -> None:
    """R counts executed, uncensored runs; a run that never executed lowers only the
    availability."""
    tally = Tally().adding(seen)
    assert tally.runs == runs
    assert tally.reliability == pytest.approx(reliability, nan_ok=True)
    assert tally.availability == availability
    assert tally.censored == censored
    assert tally.unknown == (seen.executed is Executed.UNKNOWN)


@given(OBSERVATIONS, OBSERVATIONS, OBSERVATIONS)
def test_tallies_merge_like_sets_of_runs(
    a: list[Observation], b: list[Observation], c: list[Observation]
) -> None:
    """Merging is commutative and associative, and gives what a single counter would have counted
    (up to rounding of the sums)."""
    x, y, z = tally_of(a, "a"), tally_of(b, "b"), tally_of(c, "c")
    assert x.merged(y).counts == y.merged(x).counts
    assert x.merged(y).sample == y.merged(x).sample
    left, right = x.merged(y).merged(z), x.merged(y.merged(z))
    whole = tally_of(a + b + c)
    for one in (left, right):
        assert one.counts == whole.counts
        assert one.not_executed == whole.not_executed
        assert (one.changes, one.unknown, one.censored) == (
            whole.changes,
            whole.unknown,
            whole.censored,
        )
        assert set(one.durations) == set(whole.durations)
        assert all(close(one.durations[e], whole.durations[e]) for e in whole.durations)
        assert close(one.cpu, whole.cpu)
        assert all(close(one.values[v], whole.values[v]) for v in whole.values)
    assert left.sample == right.sample


@given(OBSERVATIONS)
def test_a_tally_survives_conversion_to_plain_data(seen: list[Observation]) -> None:
    """JSON keeps a tally exactly, and its keys are sorted, so equal tallies have equal texts."""
    tally = tally_of(seen)
    text = json.dumps(tally.to_plain())
    assert Tally.of_plain(json.loads(text)) == tally
    assert list(tally.counts) == sorted(tally.counts)
    assert list(tally.durations) == sorted(tally.durations)


@given(OBSERVATIONS, COUNTED, st.sampled_from(Status))
def test_a_deferred_verdict_changes_r_once(
    seen: list[Observation], deferred: Observation, status: Status
) -> None:
    """The corrected tally counts as if the run had ended with the corrected status. Before, the run
    does not count in R."""
    assert deferred.status is not None
    deferred = replace(deferred, judged=False)
    before, alone = tally_of([*seen, deferred]), tally_of(seen)
    assert (before.judged, before.successes) == (alone.judged, alone.successes)
    assert before.runs == alone.runs + 1
    corrected = before.correcting(deferred, status, "seen later")
    expected = tally_of(
        [
            *seen,
            Observation(status, deferred.seconds, "seen later", preempted_by=deferred.preempted_by),
        ]
    )
    assert corrected.counts == expected.counts
    assert {e: m.n for e, m in corrected.durations.items()} == {
        e: m.n for e, m in expected.durations.items()
    }
    assert corrected.corrected == (status is not deferred.status)
    assert corrected.runs == corrected.judged == expected.runs
    assert corrected.reliability == expected.reliability


def test_a_verdict_without_a_matching_run_is_refused() -> None:
    """No run of that status and cause was counted."""
    with pytest.raises(KeyError):
        Tally().correcting(Observation(Status.SUCCESS, 1.0), Status.FAILURE)
    with pytest.raises(KeyError):
        Tally().correcting(Observation(None, 1.0), Status.FAILURE)


@pytest.mark.parametrize(
    ("measure", "mean"),
    [("wall", 2.0), ("cpu", 0.2), ("count", 1.0), ("value:images", 5.0), ("value:energy", 0.0)],
)
def test_cost_by_measure(measure: str, mean: float) -> None:
    """Every declared measure is kept over the counted runs; an unknown value has no numbers."""
    seen = [
        Observation(Status.SUCCESS, 1.0, cpu_seconds=0.1, values={"images": 4.0}),
        Observation(Status.FAILURE, 3.0, "late", cpu_seconds=0.3, values={"images": 6.0}),
        Observation(None, 50.0, preempted_by="gone"),
    ]
    assert tally_of(seen).cost(measure).mean == pytest.approx(mean)
    with pytest.raises(ValueError, match="not a cost measure"):
        tally_of(seen).cost("pictures")


@given(OBSERVATIONS, st.lists(st.none() | st.integers(0, 9), min_size=25, max_size=25))
def test_a_cost_counted_in_tries_is_the_reported_number_or_one(
    seen: list[Observation], counts: list[int | None]
) -> None:
    """The tally sums what learners receive run by run; a preempted run that counts no tries has no
    cost."""
    told = [
        replace(one, values={} if n is None else {"count": float(n)})
        for one, n in zip(seen, counts, strict=False)
    ]
    counted = [one for one in told if one.status is not None and one.executed is not Executed.NO]
    found = tally_of(told).cost("count")
    assert found.n == len(counted)
    assert found.total == pytest.approx(sum(cost_of(one, "count") for one in counted))
    assert [cost_of(one, "count") for one in counted] == [
        one.values.get("count", 1.0) for one in counted
    ]


@given(st.integers(0, 60), st.integers(0, 60), st.sampled_from([0.8, 0.9, 0.95]))
def test_intervals_equal_those_of_scipy(successes: int, others: int, level: float) -> None:
    """Wilson and Clopper-Pearson intervals as in scipy; the exact interval is never shorter."""
    n = successes + others
    if n == 0:
        assert wilson(0, 0) == clopper_pearson(0, 0) == (0.0, 1.0)
        return
    known = stats.binomtest(successes, n)
    for made, method in ((wilson, "wilson"), (clopper_pearson, "exact")):
        low, high = made(successes, n, level)
        expected = known.proportion_ci(level, method)
        assert low == pytest.approx(expected.low, abs=1e-9)
        assert high == pytest.approx(expected.high, abs=1e-9)


@pytest.mark.parametrize("p", [0.05, 0.5, 0.93])
def test_exact_intervals_cover(p: float) -> None:
    """Over all outcomes of 40 runs, the exact interval covers p with at least 95 %."""
    weight = stats.binom.pmf(np.arange(41), 40, p)
    covered = [low <= p <= high for low, high in (clopper_pearson(i, 40) for i in range(41))]
    exact = float(weight @ np.array(covered))
    assert exact >= 0.95


@given(st.lists(st.floats(0, 100), min_size=1, max_size=60), st.floats(0, 1))
def test_quantiles_interpolate(numbers: list[float], q: float) -> None:
    """Quantiles interpolate like those of numpy."""
    assert quantile(numbers, q) == pytest.approx(float(np.quantile(numbers, q)), abs=1e-9)


def test_the_sample_stays_bounded_and_uniform() -> None:
    """Of 5,000 durations in [0, 1], `SIZE` are kept, and they are distributed uniformly
    (Kolmogorov-Smirnov test at 1e-3)."""
    sample = Sample()
    for i in range(5000):
        sample = sample.adding(f"x/{i}", i / 5000, None, "success")
    assert len(sample.kept) == SIZE
    assert stats.kstest(sample.seconds(), "uniform").pvalue > 1e-3


@given(st.lists(st.lists(st.integers(0, 10**6), max_size=300), min_size=2, max_size=4))
def test_samples_merge_in_any_order(parts: list[list[int]]) -> None:
    """Merging is idempotent, commutative and associative, and equals the sample of all runs."""
    made = []
    for i, part in enumerate(parts):
        sample = Sample()
        for j, x in enumerate(part):
            sample = sample.adding(f"{i}/{j}", float(x), None, "success")
        made.append(sample)
    forward, backward = Sample(), Sample()
    for sample in made:
        forward = forward.merged(sample).merged(sample)
    for sample in reversed(made):
        backward = sample.merged(backward)
    assert forward == backward


def plain_of(*seen: Observation) -> dict[str, Any]:
    """Return the tally of some runs as plain data, as a file holds it."""
    plain: dict[str, Any] = json.loads(json.dumps(tally_of(list(seen)).to_plain()))
    return plain


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"counts": [["success", "", -5]]}, "-5 runs: expected a whole number"),
        ({"counts": [["success", "", 1.5]]}, "1.5 runs"),
        ({"counts": [["success", "", True]]}, "True runs"),
        ({"counts": [["success", "", 3]]}, "3 runs ended with success, but 2 such"),
        ({"counts": [["error", "", 2]]}, "0 runs ended with success, but 2 such"),
        ({"durations": {"success": [-2, 1.0, 0.0, 1.0, 1.0]}}, "-2 numbers"),
        ({"durations": {"success": [2, 1.0, -1.0, 1.0, 1.0]}}, "low <= mean <= high"),
        ({"durations": {"success": [2, float("nan"), 0.0, 1.0, 1.0]}}, "low <= mean <= high"),
        ({"durations": {"success": [2, 9.0, 0.0, 1.0, 1.0]}}, "low <= mean <= high"),
        ({"durations": {"success": [2, -1.0, 0.0, -1.0, -1.0]}}, "expected seconds from 0"),
        (
            {"durations": {"success": [2, 1.0, 0.0, 1.0, 1.0], "lost": [1, 1.0, 0.0, 1.0, 1.0]}},
            "neither one of success",
        ),
        (
            {"cpu": [3, 1.0, 0.0, 1.0, 1.0]},
            "3 numbers called cpu: expected a whole number from 0 to 2",
        ),
        ({"values": {"images": [3, 1.0, 0.0, 1.0, 1.0]}}, "called images"),
        ({"waited": [3, 1.0, 0.0, 1.0, 1.0]}, "3 waits"),
        ({"not_executed": {"dead": -1}}, "-1 runs that never began"),
        ({"unknown": 3}, "from 0 to 2"),
        ({"corrected": -1}, "-1 corrections"),
        ({"changes": 1}, "1 changes cannot have counted 2 runs"),
        ({"sample": [[i, 1.0, -1.0, "success"] for i in range(3)]}, "3 runs in the sample"),
    ],
)
def test_numbers_that_no_sequence_of_runs_can_produce_are_refused(
    change: dict[str, Any], said: str
) -> None:
    """One bad number, once merged, would falsify all figures that it is added to."""
    run = Observation(Status.SUCCESS, 1.0)
    assert Tally.of_plain(plain_of(run, run)).runs == 2
    with pytest.raises(ValueError, match=re.escape(said)):
        Tally.of_plain({**plain_of(run, run), **change})


@given(OBSERVATIONS, COUNTED, st.sampled_from(Status), OBSERVATIONS)
def test_every_tally_of_real_runs_is_accepted(
    seen: list[Observation], deferred: Observation, status: Status, others: list[Observation]
) -> None:
    """This includes corrected and merged tallies, and those with runs without a verdict: the
    check refuses no valid tally."""
    deferred = replace(deferred, judged=False)
    corrected = tally_of([*seen, deferred]).correcting(deferred, status, "seen later")
    tally = corrected.merged(tally_of([*others, deferred], "other"))
    assert Tally.of_plain(json.loads(json.dumps(tally.to_plain()))) == tally


def test_sums_have_the_same_bits_on_every_interpreter() -> None:
    """As Python 3.11 adds; the builtin of 3.12 and later gives 1.0 here."""
    assert added([0.1] * 10) == 0.9999999999999999 and added(()) == 0.0
