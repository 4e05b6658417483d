"""Convergence on Bernoulli worlds: the fast variant, the textbook gain for comparison, and gains
outside the conditions, which must get stuck (negative controls).

The full study, with figures for every selector, is tools/bench/learning.py; the limits here are its
lower bounds.
"""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.learning.batch import Response
from petrobot.coordinator.learning.rules import NikolicFu, Rule, Tracking
from petrobot.coordinator.learning.selectors import RULES
from tests.learning.worlds import BanditWorld, PlayedTrials, gapped, play

pytestmark = pytest.mark.once

SEEDS = 1000


def free(gap: float, best: float = 0.9) -> BanditWorld:
    """Return a world in which only reliability counts."""
    return replace(gapped(gap, best), cost=(0.0,) * 4)


def converged(rule: Rule, world: BanditWorld, trials: int = 500, seeds: int = SEEDS) -> float:
    """Return the share of seeds with p >= 0.95 on the optimum."""
    played = play(rule, world, trials, seeds, np.random.default_rng(1))
    return float(np.mean(played.p_best[-1] >= 0.95))


@pytest.mark.parametrize("gap", [0.4, 0.3, 0.2])
@pytest.mark.parametrize("best", [0.95, 0.9, 0.8, 0.6])
def test_the_fast_variant_finds_the_optimum_in_500_trials(gap: float, best: float) -> None:
    """p >= 0.95 in at least 99 % of 1,000 seeds at gaps of 0.2 and more with 4 actions, for any
    best reliability."""
    assert converged(RULES["nikolic_fu_fast"](), free(gap, best)) >= 0.99


def test_costs_with_scatter_are_found_too() -> None:
    """J differs only in cost (gap 0.25), and the cost of a run has a standard deviation of 32 %."""
    world = BanditWorld("costs", (0.9,) * 4, (4.0, 4.0, 4.0, 3.0))
    assert converged(RULES["nikolic_fu_fast"](), world) >= 0.99


def test_the_textbook_gain_converges_more_slowly() -> None:
    """The order of its actions is right more and more often; p follows slowly."""
    shares = [
        converged(RULES["nikolic_fu"](), free(0.4), trials, 300) for trials in (100, 500, 2500)
    ]
    assert shares == sorted(shares)
    assert shares[0] < 0.2
    assert shares[-1] > 0.95


@pytest.mark.parametrize(
    "rule",
    [NikolicFu("k^-0.6", k0=1.0, exponent=0.6), NikolicFu("c = 2", c=2.0, k0=2.0)],
    ids=["k^-0.6", "c = 2"],
)
def test_gains_outside_the_conditions_get_stuck(rule: NikolicFu) -> None:
    """Negative controls: many seeds end at a wrong action, and three times as many trials change
    hardly anything."""
    played = play(rule, free(0.2, 0.6), 3000, 300, np.random.default_rng(1), (1000, 3000))
    stuck = played.p_best < 0.01
    assert stuck[0].mean() > 0.1
    assert np.mean(stuck[1][stuck[0]]) > 0.9


def test_the_conditions_tell_these_gains_apart() -> None:
    """Condition (i): the gains sum to infinity. Condition (ii): so do the products of 1 - gamma.
    Partial sums up to 1e6 keep growing or stop."""
    k = np.arange(1.0, 1e6)

    def sums(rule: NikolicFu) -> tuple[float, float]:
        gain = rule.gain(k)
        products = np.cumprod(1 - gain)
        return float(gain[len(k) // 10 :].sum()), float(products[len(k) // 10 :].sum())

    textbook, fast_gain, double = (
        NikolicFu(),
        NikolicFu(k0=1.0, exponent=0.6),
        NikolicFu(c=2.0, k0=2.0),
    )
    assert sums(textbook)[0] > 1
    assert sums(textbook)[1] > 1
    assert sums(fast_gain)[1] < 1e-12
    assert sums(double)[1] < 1e-3


@pytest.mark.parametrize("name", ["nikolic_fu_fast", "thompson", "ucb1", "discretised_pursuit"])
def test_equal_actions_cost_no_regret(name: str) -> None:
    """If all actions are equal, every winner is right: the paper's claim that slow learning is then
    harmless."""
    played = play(RULES[name](), free(0.0), 300, 50, np.random.default_rng(2))
    assert np.all(played.regret == 0.0)
    assert np.all(played.optimal == 1.0)


def changing(rule: Rule) -> PlayedTrials:
    """Return a world whose best and worst action swap after 1,000 of 2,000 trials."""
    world = BanditWorld("changing", (0.5, 0.5, 0.5, 0.9), (0.0,) * 4, 1000, (0.9, 0.5, 0.5, 0.5))
    return play(rule, world, 2000, 300, np.random.default_rng(3), (1000, 2000))


def test_tracking_follows_a_world_that_changes() -> None:
    """Most of the last hundred choices are the new best action; the converging scheme still prefers
    the old one."""
    following, converging = changing(Tracking()), changing(RULES["nikolic_fu_fast"]())
    assert following.optimal.mean() > 0.85
    assert converging.optimal.mean() < 0.5
    assert np.median(following.batch.own["restarts"]) >= 1


def test_tracking_rarely_reports_a_change_in_a_constant_world() -> None:
    """Count the false alarms in 2,000 trials of a constant world."""
    played = play(Tracking(), free(0.2), 2000, 300, np.random.default_rng(4))
    assert np.mean(played.batch.own["restarts"] > 0) < 0.1


def test_tracking_follows_a_small_change_after_many_trials() -> None:
    """R changes by 0.13 after 4,000 trials, which tests for changes rarely notice: thanks to the
    floor of the gain, p follows within 600 trials.

    Without the floor the gain is 1 / 4000^0.7 = 0.003 by then, and p of the new best action is 0.76
    instead of 0.96.
    """
    world = BanditWorld("drifting", (0.85, 0.72), (0.0, 0.0), 4000, (0.72, 0.85))
    played = play(Tracking(), world, 4600, 100, np.random.default_rng(5))
    assert played.p_best[0].mean() > 0.9


def test_the_gain_of_tracking_never_falls_below_its_floor() -> None:
    """In one trial after ten thousand, p moves towards the best action by exactly the floor, and
    every action keeps a probability above 0."""
    rule, p = Tracking(), np.array([[0.9, 0.1]])
    batch = rule.begin(1, 2)
    batch.p[:], batch.k[:], batch.tries[:], batch.runs[:], batch.successes[:] = (
        p,
        10_000,
        5_000,
        100,
        [[10, 90]],
    )
    rule.learn(
        batch, Response(np.array([1]), np.array([1.0]), np.array([np.nan]), np.array([True]))
    )
    assert batch.p == pytest.approx(p + rule.gain_floor * (np.array([[0.0, 1.0]]) - p))
    batch.p[:] = [[1.0, 0.0]]
    assert rule.probabilities(batch, np.ones((1, 2), bool)).min() == pytest.approx(
        rule.probability_floor
    )
