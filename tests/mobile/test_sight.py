"""Parabolas through points, and set points of track_ahead as numbers."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.mobile.sight import (
    STREAMED,
    UNSEEN,
    LineEnd,
    Sight,
    TrackAhead,
    TrackEnd,
    fit_line,
    thinned,
)

SMALL = st.floats(-2.0, 2.0)


@given(st.floats(-0.3, 0.3), st.floats(-0.8, 0.8), st.floats(-1.5, 1.5))
def test_a_parabola_is_recovered(offset: float, slope: float, bend: float) -> None:
    x = np.linspace(0.43, 0.93, 16)
    d = x - x[0]
    line = fit_line(x, offset + slope * d + 0.5 * bend * d * d)
    assert (line.offset, line.slope, line.bend) == pytest.approx((offset, slope, bend), abs=1e-6)
    assert line.at(0.93) == pytest.approx(offset + 0.5 * slope + 0.125 * bend)


@given(
    st.floats(0.0, 0.2),
    st.floats(0.0, 1.0),
    st.sampled_from(list(TrackEnd)),
    st.lists(st.tuples(SMALL, SMALL), max_size=STREAMED),
    st.floats(0.0, 0.1),
)
def test_the_time_that_a_set_point_was_held_is_added_to_its_age(
    age: float, confidence: float, kind: TrackEnd, points: list[tuple[float, float]], held: float
) -> None:
    end = None if kind is TrackEnd.NONE else LineEnd(kind, 0.7, -0.1)
    back = TrackAhead.parse(TrackAhead(age, confidence, end, tuple(points)).values(), held)
    assert (back.confidence, back.end, back.points) == (confidence, end, tuple(points))
    assert back.age == pytest.approx(age + held)


@pytest.mark.parametrize(
    "values",
    [[], [0.1, 1.0, 0.0, 0.0], [0.1, 1.0, 0.0, 0.0, 0.0, 0.5], [-0.1, 1, 0, 0, 0], [0, 1, 7, 0, 0]],
)
def test_numbers_that_are_not_a_set_point_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="track_ahead"):
        TrackAhead.parse(values)


def test_streamed_points_begin_with_the_nearest_and_keep_apart() -> None:
    x = np.linspace(0.43, 1.4, 60)
    points = thinned(Sight(x, 0.1 * x, 1.0))
    assert points[0] == (x[0], 0.1 * x[0]) and len(points) == STREAMED
    assert all(math.dist(a, b) >= 0.05 for a, b in pairwise(points))


def test_nothing_seen_cannot_be_described() -> None:
    assert not UNSEEN.seen and thinned(UNSEEN) == ()
    with pytest.raises(ValueError, match="no line"):
        UNSEEN.describe()


@given(st.floats(-0.3, 0.3), st.floats(-0.7, 0.7), st.floats(-1.1, 1.1))
def test_offset_heading_and_curvature_of_a_circle_are_recovered(
    offset: float, heading: float, curvature: float
) -> None:
    way = np.linspace(0.0, 0.5, 20)
    angle = heading + curvature * way
    step = way[1]
    x = 0.43 + np.concatenate(
        [[0.0], np.cumsum(np.cos(angle[:-1] + 0.5 * curvature * step) * step)]
    )
    y = offset + np.concatenate(
        [[0.0], np.cumsum(np.sin(angle[:-1] + 0.5 * curvature * step) * step)]
    )
    ahead = np.concatenate([[True], np.diff(x) > 0.0])
    shape = Sight(x[ahead], y[ahead], 1.0).describe()
    assert shape.offset == pytest.approx(offset, abs=0.002)
    assert shape.heading == pytest.approx(heading, abs=0.02)
    assert shape.curvature == pytest.approx(curvature, abs=0.12)
