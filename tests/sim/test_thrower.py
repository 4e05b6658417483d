"""What is thrown and when: distributions, keyed random draws, the thrower's waiting."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from petrobot.sim.catching.ball import BallModel, TableMotion
from petrobot.sim.catching.site import Site
from petrobot.sim.catching.thrower import Thrower, draw_throw

REGIMES = {"A": (0.7, 1.5), "B": (1.5, 2.0), "C": (2.0, 2.5)}


def uniform_p(values: Sequence[float], low: float, high: float) -> float:
    """Return the asymptotic p-value of the Kolmogorov-Smirnov test that `values` are uniform."""
    x = np.sort((np.asarray(values) - low) / (high - low))
    n = len(x)
    steps = np.arange(n + 1) / n
    distance = max((steps[1:] - x).max(), (x - steps[:-1]).max())
    k = np.arange(1, 101)
    return float(2 * np.sum((-1.0) ** (k - 1) * np.exp(-2 * n * k**2 * distance**2)))


@pytest.mark.parametrize("regime", REGIMES)
def test_throws_are_distributed_as_the_cell_says(site: Site, regime: str) -> None:
    truth = site.truth(regime)
    throws = [draw_throw(3, n, site.cell, truth) for n in range(1, 1001)]
    nominal = site.cell["ball"]["rolling_resistance"]
    drawn = {
        "speed": ([t.speed for t in throws], REGIMES[regime]),
        "exit": ([t.exit_y for t in throws], (-0.30, 0.30)),
        "delay": ([t.delay for t in throws], (0.3, 0.8)),
        "spin": ([t.spin_share for t in throws], (0.7, 1.0)),
        "resistance": ([t.rolling_resistance for t in throws], (0.7 * nominal, 1.3 * nominal)),
    }
    for name, (values, (low, high)) in drawn.items():
        assert low <= min(values) and max(values) <= high, name
        assert uniform_p(values, low, high) > 1e-3, name


@pytest.mark.parametrize("regime", REGIMES)
def test_every_ball_leaves_the_near_edge_where_it_is_aimed(site: Site, regime: str) -> None:
    truth = site.truth(regime)
    model = BallModel.of(site.cell["ball"], 0.2)
    for n in range(1, 301):
        throw = draw_throw(4, n, site.cell, truth)
        assert math.hypot(*throw.start.velocity) == pytest.approx(throw.speed)
        assert truth.table.far_edge - throw.start.position[0] == pytest.approx(0.10)
        motion = TableMotion(model, throw.start, throw.rolling_resistance)
        leaves = motion.first_crossing(0, truth.table.near_edge)
        assert motion.state(leaves).position[1] == pytest.approx(throw.exit_y, abs=1e-9)


def test_a_throw_depends_only_on_seed_and_number(site: Site) -> None:
    truth = site.truth("B")
    alone = draw_throw(9, 17, site.cell, truth)
    for n in (1, 5, 16):
        draw_throw(9, n, site.cell, truth)
    assert draw_throw(9, 17, site.cell, truth) == alone
    assert draw_throw(8, 17, site.cell, truth) != alone != draw_throw(9, 18, site.cell, truth)


def test_it_waits_its_delay_when_all_is_ready_and_again_after_an_interruption(site: Site) -> None:
    thrower = Thrower(site.cell, site.truth("A"), seed=1)
    delay = draw_throw(1, 1, site.cell, site.truth("A")).delay
    assert thrower.advance(10.0, True) is None
    assert thrower.advance(10.0 + 0.9 * delay, True) is None
    assert thrower.advance(10.0 + 0.95 * delay, False) is None
    assert thrower.advance(20.0, True) is None
    assert thrower.advance(20.0 + 0.99 * delay, True) is None
    thrown = thrower.advance(20.0 + delay, True)
    assert thrown is not None and thrown.n == 1


def test_it_stops_after_the_requested_number_of_throws(site: Site) -> None:
    thrower = Thrower(site.cell, site.truth("A"), seed=1, throws=2)
    thrown = [t.n for k in range(4000) if (t := thrower.advance(0.004 * k, True)) is not None]
    assert thrown == [1, 2]
