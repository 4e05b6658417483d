"""Simulation against the exact chain; phase-type distributions against their moments and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from scipy.stats import gamma

from petrobot.coordinator.analysis.time.completion import completion, completion_time
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
from petrobot.coordinator.analysis.time.markov import long_run
from petrobot.coordinator.analysis.time.phase_type import fit, gamma_quantile
from petrobot.coordinator.analysis.time.simulate import (
    IntervalEstimate,
    goal_by_marking,
    simulate,
)
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import KANBAN_RATES, kanban, queue, stages
from tests.analysis.random_nets import gspns, transient


def sure(name: int) -> np.random.Generator:
    return np.random.default_rng(1000 + name)


def test_the_long_run_of_kanban_lies_in_the_intervals() -> None:
    gspn = Gspn.of(kanban(1), KANBAN_RATES)
    exact = long_run(Chain.of(gspn))
    seen = simulate(gspn, sure(1), replicas=400, horizon=400.0, warmup=60.0, confidence=0.9999)
    assert seen.complete and seen.completed is None
    for name, value in exact.throughput.items():
        assert seen.throughput[name].covers(value), name
    for name, value in exact.mean_tokens.items():
        assert seen.mean_tokens[name].covers(value), name
    width = seen.throughput["tin1"].high - seen.throughput["tin1"].low
    assert width < 0.03


def test_completion_lies_in_the_intervals() -> None:
    net = Net.build(
        {"run": 1, "retry": 0, "ok": 0, "lost": 0},
        {
            "good": ({"run": 1}, {"ok": 1}),
            "bad": ({"run": 1}, {"retry": 1}),
            "again": ({"retry": 1}, {"run": 1}),
            "give_up": ({"retry": 1}, {"lost": 1}),
        },
    )
    gspn = Gspn.of(net, {"good": 2.0, "bad": 1.0}, weights={"again": 3.0, "give_up": 1.0})
    chain = Chain.of(gspn)
    goal = chain.space.tokens(2) > 0
    done = completion(chain, goal)
    seen = simulate(
        gspn,
        sure(2),
        replicas=4000,
        goal=lambda tokens: tokens[2] > 0,
        horizon=1e9,
        confidence=0.9999,
    )
    assert seen.completed is not None and seen.time is not None
    assert seen.completed.covers(done.probability) and seen.time.covers(done.mean)
    assert seen.quantile(0.9) == pytest.approx(completion_time(chain, goal).quantile(0.9), rel=0.1)
    same = simulate(
        gspn, sure(2), replicas=4000, goal=goal_by_marking(lambda m: m[2] > 0), horizon=1e9
    )
    assert np.array_equal(same.times, seen.times)


@settings(max_examples=25, deadline=None)
@given(gspns(), st.integers(0, 2**32))
def test_random_nets_lie_in_wide_intervals(gspn: Gspn, seed: int) -> None:
    chain = Chain.of(gspn)
    assume(chain.n <= 60)
    times, replicas = 3.0, 300
    grid = np.linspace(0, times, 61)
    tokens = np.stack([chain.space.tokens(p) for p in range(len(gspn.net.places))], axis=1)
    exact = np.asarray(np.trapezoid(transient(chain, grid.tolist()) @ tokens, grid, axis=0)) / times
    seen = simulate(
        gspn, np.random.default_rng(seed), replicas=replicas, horizon=times, confidence=1 - 1e-9
    )
    for value, (_, found) in zip(exact, seen.mean_tokens.items(), strict=True):
        assert found.low - 0.03 <= value <= found.high + 0.03


def test_limits_and_determinism() -> None:
    gspn = Gspn.of(queue(3), {"arrive": 1.0, "serve": 2.0})
    cut = simulate(gspn, sure(3), replicas=10, horizon=1e6, firings=500)
    assert not cut.complete and cut.firings == 500
    one, two = (simulate(gspn, sure(4), replicas=10, horizon=20.0) for _ in range(2))
    assert one.throughput == two.throughput and one.mean_tokens == two.mean_tokens
    with pytest.raises(ValueError, match="horizon"):
        simulate(gspn, sure(5))


def test_a_dead_replica_is_not_completed() -> None:
    gspn = Gspn.of(stages(2), {"t0": 1.0, "t1": 1.0})
    seen = simulate(gspn, sure(6), replicas=20, goal=lambda tokens: tokens[0] > 5, horizon=1e3)
    assert (
        seen.completed is not None
        and seen.completed.mean == 0.0
        and seen.time is None
        and seen.complete
    )


@settings(max_examples=200, deadline=None)
@given(st.floats(0.05, 50.0), st.floats(0.13, 3.0))
def test_fits_meet_mean_and_variance(mean: float, cv: float) -> None:
    fitted = fit(mean, (cv * mean) ** 2)
    assert fitted.mean == pytest.approx(mean, rel=1e-9)
    assert fitted.variance == pytest.approx((cv * mean) ** 2, rel=1e-7)
    assert sum(b.probability for b in fitted.branches) == pytest.approx(1.0)
    assert all(0 <= b.probability <= 1 and 1 <= b.stages <= 64 for b in fitted.branches)
    assert fitted.cdf(fitted.quantile(0.9)) == pytest.approx(0.9, abs=1e-9)


def test_a_variance_that_needs_more_stages_keeps_the_mean_and_reports_the_error() -> None:
    fitted = fit(2.0, 0.0, stages=25)
    assert fitted.mean == pytest.approx(2.0) and fitted.variance == pytest.approx(4.0 / 25)
    assert fitted.error_at_90(2.0) == pytest.approx(
        gamma(25, scale=2 / 25).ppf(0.9) / 2 - 1, rel=1e-9
    )
    shifted = fit(2.0, 0.01, shift=1.8)
    assert shifted.mean == pytest.approx(2.0) and shifted.variance == pytest.approx(0.01)
    assert shifted.cdf(1.8) == 0.0
    with pytest.raises(ValueError, match="expected mean > shift"):
        fit(1.0, 0.1, shift=1.0)


def test_the_reference_of_declared_durations_is_the_gamma_distribution() -> None:
    assert gamma_quantile(3.0, 1.5) == pytest.approx(gamma(6.0, scale=0.5).ppf(0.9))
    assert gamma_quantile(3.0, 0.0) == 3.0


def test_estimates() -> None:
    wide, narrow = (IntervalEstimate.share(k, 10 * k, 0.95) for k in (3, 300))
    assert wide.low < narrow.low < 0.1 < narrow.high < wide.high
    for n in (10, 1000):
        assert IntervalEstimate.share(0, n, 0.95).low == 0.0
        assert IntervalEstimate.share(n, n, 0.95).high == 1.0
    assert IntervalEstimate.of(np.array([1.0]), 0.95).covers(1e9)


def test_an_inhibitor_stops_arrivals() -> None:
    """A queue that accepts two customers, with equal rates: 0, 1 and 2 are equally likely, so
    the mean is 1."""
    net = Net.build(
        {"source": 1, "waiting": 0},
        {"arrives": ({"source": 1}, {"source": 1, "waiting": 1}), "leaves": ({"waiting": 1}, {})},
        inhibitors={"arrives": {"waiting": 2}},
    )
    gspn = Gspn.of(net, {"arrives": 1.0, "leaves": 1.0})
    seen = simulate(gspn, sure(7), replicas=200, horizon=220.0, warmup=20.0, confidence=0.9999)
    assert seen.mean_tokens["waiting"].covers(1.0) and seen.mean_tokens["waiting"].high < 1.2


def test_a_simulation_that_is_stopped_early_is_not_one_of_the_fastest_replicas() -> None:
    """Its intervals contained only those that had ended, which take less time than the others."""
    net = Net.build(
        {"run": 4, "ok": 0}, {"go": ({"run": 1}, {"ok": 1}), "no": ({"run": 1}, {"run": 1})}
    )
    gspn = Gspn.of(net, {"go": 1.0, "no": 9.0}, servers={"go": 1, "no": 1})
    done = completion(Chain.of(gspn), Chain.of(gspn).space.tokens(1) == 4)
    cut = simulate(
        gspn, sure(9), replicas=20_000, goal=lambda tokens: tokens[1] == 4, firings=300_000
    )
    assert not cut.complete and cut.time is not None
    assert cut.time.covers(done.mean), (cut.time, done.mean)
    assert not cut.active and 1000 <= cut.replicas < 20_000
    first = simulate(gspn, sure(9), replicas=20_000, goal=lambda tokens: tokens[1] == 4, firings=30)
    assert not first.complete and first.active == first.replicas
