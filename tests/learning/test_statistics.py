"""Intervals: of the lowest of several probabilities, of J, and what a target needs. Their coverage
is simulated; a share of 4,000 repetitions is known to about +-0.7 points (95 %)."""

from __future__ import annotations

from math import inf, isnan

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.learning.estimate import Observation, Tally
from petrobot.coordinator.learning.objective import Question, compare
from petrobot.coordinator.learning.statistics import (
    Moments,
    lowest_share,
    mean_interval,
    objective_interval,
    runs_needed,
    wilson,
)
from petrobot.coordinator.task import Status

pytestmark = pytest.mark.once

REPEATED = 4000
NEAR = 0.943
"""A coverage of 0.95 is measured as less than this in one of 50 studies."""

REGIMES = [
    *([r] * m for m in (2, 5, 12, 30) for r in (0.5, 0.9, 0.98, 0.999)),
    [0.9, 0.99, 0.99, 0.99],
    [0.7, 0.72, 0.95, 1.0],
    list(np.linspace(0.6, 0.95, 12)),
]


@pytest.mark.parametrize("truth", REGIMES, ids=lambda t: f"{len(t)} from {min(t):.3g}")
@pytest.mark.parametrize("n", [12, 60, 400])
def test_the_interval_of_the_lowest_share_covers_it(truth: list[float], n: int) -> None:
    """Whatever the number of regimes and however alike they are. The interval of the share that
    happens to be the lowest covers 12 equal regimes in about 3 of 4 studies only."""
    rng = np.random.default_rng([n, len(truth), round(1e4 * truth[0])])
    seen = rng.binomial(n, np.array(truth), size=(REPEATED, len(truth)))
    # bounds grow with the number of successes, so the lowest share has the lowest ones
    low, high = np.array([lowest_share([(int(k), n)] * len(truth)) for k in range(n + 1)]).T
    lowest = seen.min(axis=1)
    covered = (low[lowest] <= min(truth)) & (min(truth) <= high[lowest])
    assert covered.mean() >= NEAR
    if truth == [0.9] * 12 and n == 60:
        naive = np.array([wilson(k, n) for k in range(n + 1)])[lowest]
        assert ((naive[:, 0] <= 0.9) & (naive[:, 1] >= 0.9)).mean() < 0.8


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 50)), min_size=1, max_size=8))
def test_the_interval_of_the_lowest_share_contains_the_lowest_share(
    counts: list[tuple[int, int]],
) -> None:
    counts = [(min(s, n), n) for s, n in counts]
    low, high = lowest_share(counts)
    assert 0.0 <= low <= min(s / n for s, n in counts) <= high <= 1.0


@given(st.floats(0.3, 1.0), st.floats(0.05, 0.999))
def test_a_target_is_reached_after_the_runs_that_it_needs(share: float, target: float) -> None:
    """And not a run earlier."""
    n = runs_needed(share, target)
    if n is None:
        assert share <= target
    else:
        assert n > 10**9 or wilson(share * n, n)[0] >= target - 1e-7
        assert n == 1 or n > 10**9 or wilson(share * (n - 1), n - 1)[0] < target + 1e-7


def test_the_example_of_the_documentation() -> None:
    assert wilson(38, 38)[0] == pytest.approx(0.908, abs=5e-4)
    assert runs_needed(1.0, 0.95) == 73
    assert runs_needed(0.9, 0.95) is None


def test_a_mean_of_what_is_never_negative_has_no_negative_bound() -> None:
    few = Moments().adding(0.0).adding(0.1)
    assert mean_interval(few)[0] == 0.0 and mean_interval(few)[1] > 0.1
    assert mean_interval(Moments().adding(-1.0).adding(1.0))[0] < -1.0
    assert mean_interval(Moments().adding(2.0)) == (0.0, inf)


def study(correlated: float, reliability: float, n: int, measure: str) -> tuple[float, float]:
    """Return the coverage of J's interval and its mean width over 200 studies of one action, whose
    cost is `correlated` seconds larger when it succeeds."""
    rng, covered, widths = np.random.default_rng([n, round(100 * reliability)]), 0, 0.0
    truth = 1.0 - reliability + 0.3 * (2.0 + correlated * reliability)
    for _ in range(200):
        tally = Tally()
        for good in rng.random(n) < reliability:
            cost = float(rng.normal(2.0, 0.2)) + correlated * good
            status = Status.SUCCESS if good else Status.FAILURE
            tally = tally.adding(Observation(status, cost, cpu_seconds=cost, values={"used": cost}))
        f = compare({"a": {"": tally}}, Question(measure, rho=0.3)).of("a")
        covered += f.j_lower <= truth <= f.j_upper
        widths += (f.j_upper - f.j_lower) / 200
    return covered / 200, widths


@pytest.mark.parametrize("correlated", [-1.0, 0.0, 1.5])
def test_the_interval_of_j_knows_that_success_and_cost_come_from_the_same_runs(
    correlated: float,
) -> None:
    """0.905: a coverage of 0.95 is measured as less in one of 200 studies. Where only sums of
    the cost are known, the interval is wider, never narrower."""
    covered, width = study(correlated, 0.8, 40, "wall")
    assert covered >= 0.905
    unknown, wider = study(correlated, 0.8, 40, "value:used")
    assert unknown >= covered and wider >= width
    if correlated == 0.0:
        return
    # a dear success: R and C cancel out in J
    assert (width > study(0.0, 0.8, 40, "cpu")[1]) == (correlated < 0)


def test_one_run_says_nothing_of_the_spread_of_its_cost() -> None:
    f = compare(
        {"a": {"": Tally().adding(Observation(Status.SUCCESS, 1.0))}}, Question(rho=1.0)
    ).of("a")
    assert f.j == 1.0 and isnan(f.j_lower) and isnan(f.j_upper)
    assert objective_interval((0.5, 0.4, 0.7), (1.0, -inf, inf), 0.0) == pytest.approx((0.3, 0.6))


def test_chance_rarely_makes_an_action_clearly_the_best() -> None:
    """Among equal actions. Where one is better by far, it is clear."""
    rng = np.random.default_rng(8)

    def tally(r: float) -> Tally:
        out = Tally()
        for good in rng.random(60) < r:
            out = out.adding(
                Observation(Status.SUCCESS if good else Status.FAILURE, float(rng.uniform(1, 2)))
            )
        return out

    for actions in (2, 5):
        clear = sum(
            not compare(
                {str(i): {"": tally(0.8)} for i in range(actions)}, Question()
            ).level_with_best
            for _ in range(100)
        )
        assert clear <= 13  # 5 expected for two actions, fewer for more
    found = compare({"good": {"": tally(0.95)}, "bad": {"": tally(0.4)}}, Question())
    assert found.best == "good" and found.level_with_best == () and found.clear


def test_an_action_is_not_clearly_the_best_where_too_little_is_known() -> None:
    """One run of another action has no interval, and an action alone is compared with nothing."""
    good = Tally()
    for cost in (1.0, 1.1, 0.9, 1.0):
        good = good.adding(Observation(Status.SUCCESS, cost))
    once = Tally().adding(Observation(Status.FAILURE, 9.0))
    found = compare({"good": {"": good}, "once": {"": once}}, Question(rho=1.0))
    assert found.best == "good" and found.level_with_best == ("once",) and not found.clear
    assert not compare({"good": {"": good}, "never": {}}, Question()).clear
