"""Set points: outlets that send them, and receivers in which they age."""

from __future__ import annotations

import math
from itertools import pairwise

from hypothesis import given, settings, strategies as st

from petrobot.services.worker.setpoints import Outlets, Sent, SetpointReceiver
from tests.node.conftest import Clock


@settings(max_examples=40, deadline=None)
@given(
    publications=st.lists(st.tuples(st.integers(0, 100), st.booleans()), max_size=30),
    period_ticks=st.integers(1, 10),
)
def test_an_outlet_sends_the_newest_at_most_once_a_period(
    publications: list[tuple[int, bool]], period_ticks: int
) -> None:
    period, outlets = 0.004 * period_ticks, Outlets({"s": 0.004 * period_ticks})
    at = dict(publications)
    newest: tuple[float, float] | None = None
    times: list[float] = []
    for tick in range(120):
        now = 0.004 * tick
        if tick in at:
            if at[tick]:
                outlets.publish(now, "run", 0.0, "s", [float(tick)])
                newest = (float(tick), now)
            else:
                outlets.withdraw("s")
                newest = None
        for sent in outlets.advance(now):
            assert newest is not None
            assert sent == Sent("run", "s", (newest[0],), max(0.0, now - newest[1]), now)
            times.append(now)
        due = outlets.due()
        assert (due is None) == (newest is None)
        assert due is None or due > now - 1e-5
    assert all(b - a >= period - 2e-3 for a, b in pairwise(times))
    outlets.publish(1.0, "run", 0.5, "s", [1.0])
    outlets.withdraw("s", "other run")
    assert outlets.due() is not None
    outlets.close("run")
    assert outlets.due() is None


def test_a_set_point_ages_and_goes_stale() -> None:
    clock = Clock()
    point = SetpointReceiver(0.02, clock)
    assert (point.values, point.age, point.held, point.count) == (None, math.inf, math.inf, 0)
    clock.now = 1.0
    point.take([1.0, 2.0], held=0.015)
    clock.now = 1.06
    assert (point.values, round(point.age, 6), round(point.held, 6)) == ((1.0, 2.0), 0.06, 0.075)
    clock.now = 1.061
    assert (point.values, round(point.age, 6)) == (None, 0.061)
    point.take([3.0, 4.0])
    assert (point.values, point.held, point.count) == ((3.0, 4.0), 0.0, 2)
    point.withdraw()
    assert (point.values, point.count) == (None, 2)
