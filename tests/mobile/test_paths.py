"""Plans across a square without a track, and gates through which it can resume."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from petrobot.services.mobile.odometry import Pose
from petrobot.services.mobile.paths import arc, arc_through, join, passes, resume_poses, straight

POSES = st.builds(Pose, st.floats(-5, 5), st.floats(-5, 5), st.floats(-7, 7))


@given(POSES)
def test_the_circle_through_a_place_of_resumption_is_the_missing_element(end: Pose) -> None:
    """To a place straight ahead it is straight; to one at the side it has the radius of the arcs
    and ends in the direction in which the track resumes."""
    on, left, right = resume_poses(end, 2.0, 1.0)
    for gate, radius in ((on, math.inf), (left, 1.0), (right, 1.0)):
        points = arc_through(end, gate.x, gate.y, 0.5)
        nearest = min(math.dist(p, (gate.x, gate.y)) for p in points)
        assert nearest < 1e-6
        (x0, y0), (x1, y1) = points[-2], points[-1]
        assert math.cos(math.atan2(y1 - y0, x1 - x0) - gate.heading) == pytest.approx(1.0, abs=1e-6)
        if radius == 1.0:
            centre = end.floor(0.0, 1.0 if gate is left else -1.0)
            assert all(abs(math.dist(p, centre) - 1.0) < 1e-9 for p in points[: len(points) // 2])


@given(POSES, st.floats(-1.5, 1.5), st.floats(0.2, 3.0))
def test_points_of_an_arc_are_evenly_apart_and_as_long(
    begin: Pose, curvature: float, length: float
) -> None:
    points = [(begin.x, begin.y), *arc(begin, curvature, length)]
    steps = [math.dist(a, b) for a, b in pairwise(points)]
    assert max(steps) - min(steps) < 1e-6
    assert sum(steps) == pytest.approx(length, rel=0.01)


@given(POSES, POSES)
def test_a_join_begins_and_ends_where_it_should(begin: Pose, end: Pose) -> None:
    points = join(begin, end, 0.3)
    assert points[0] == pytest.approx((begin.x, begin.y))
    assert min(math.dist(p, (end.x, end.y)) for p in points) < 1e-6
    assert points[-1] == pytest.approx(end.floor(0.3, 0.0))


def test_a_straight_leads_from_one_place_to_the_other() -> None:
    points = straight((1.0, 1.0), (1.0, 2.0))
    assert points[-1] == pytest.approx((1.0, 2.0)) and all(
        x == pytest.approx(1.0) for x, _ in points
    )


@given(POSES, st.floats(-0.25, 0.25), st.floats(-0.5, 0.5))
def test_a_line_through_a_gate_passes_but_not_backwards(
    gate: Pose, aside: float, askew: float
) -> None:
    through = Pose(*gate.floor(0.0, aside), gate.heading + askew)
    line = [through.floor(0.05 * i, 0.0) for i in range(-4, 8)]
    assert passes(line, gate, 0.3, 0.6)
    assert not passes(line[::-1], gate, 0.3, 0.6), "it would lead the rover back"


@pytest.mark.parametrize(
    ("aside", "askew"), [(0.9, 0.0), (-0.9, 0.0), (0.0, 1.2), (0.0, -1.2), (0.6, 0.5)]
)
def test_a_line_beside_a_gate_or_across_it_does_not_pass(aside: float, askew: float) -> None:
    gate = Pose(1.0, 2.0, 0.4)
    other = Pose(*gate.floor(0.0, aside), gate.heading + askew)
    assert not passes([other.floor(0.05 * i, 0.0) for i in range(12)], gate, 0.3, 0.6)
