"""The map of the track: sights and plans collected in the odometry frame, queried near the
rover."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.mobile.odometry import Pose
from petrobot.services.mobile.paths import arc
from petrobot.services.mobile.sight import LineEnd, TrackAhead, TrackEnd
from petrobot.services.mobile.track_map import TrackMap

FAR = 12


def sight(
    pose: Pose, line: Pose, bend: float = 0.0, end: LineEnd | None = None, noise: float = 0.0
) -> TrackAhead:
    """Return what a camera at `pose` reports of a line (a circle of this curvature through `line`),
    from 0.43 m ahead on."""
    random = np.random.default_rng(round(1e6 * abs(pose.x + pose.y)))
    points: list[tuple[float, float]] = []
    for x, y in arc(Pose(*line.floor(-1.0, 0.0), line.heading) if bend == 0.0 else line, bend, 5.0):
        ahead, left = pose.body(x, y)
        if 0.43 <= ahead < 1.1 and abs(left) < 0.5 and len(points) < FAR:
            points.append((ahead, left + float(random.normal(0.0, noise))))
    return TrackAhead(0.0, 1.0 if points else 0.0, end, tuple(points))


def driven(line: Pose, poses: list[Pose], bend: float = 0.0, noise: float = 0.0) -> TrackMap:
    """Return a map of what was seen from these poses."""
    track = TrackMap()
    for pose in poses:
        track.take(pose, sight(pose, line, bend, noise=noise))
    return track


@settings(max_examples=40)
@given(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2), st.floats(-3, 3), st.floats(0.0, 0.004))
def test_the_line_at_the_axle_is_known_from_what_was_seen_ahead(
    aside: float, askew: float, heading: float, noise: float
) -> None:
    line = Pose(0.3, -0.2, heading)
    poses = [Pose(*line.floor(0.03 * i, 0.0), heading) for i in range(40)]
    track = driven(line, poses, noise=noise)
    pose = Pose(*poses[-1].floor(0.0, aside), heading + askew)
    fit = track.fit(pose, 0.0)
    assert fit is not None
    assert fit.y == pytest.approx(-aside / math.cos(askew), abs=0.006)
    assert fit.heading == pytest.approx(-askew, abs=0.03)
    assert abs(fit.curvature) < 0.3


@pytest.mark.parametrize("bend", [1.0, -1.0])
def test_the_curvature_at_the_axle_is_known(bend: float) -> None:
    line = Pose(0.0, 0.0, 0.0)
    way = arc(line, bend, 1.2)
    poses = [Pose(x, y, bend * (i + 1) * 1.2 / len(way)) for i, (x, y) in enumerate(way)]
    track = driven(line, poses, bend, noise=0.002)
    fit = track.fit(poses[-1], 0.05)
    assert fit is not None and fit.curvature == pytest.approx(bend, abs=0.2)


def test_nothing_is_known_where_nothing_was_seen() -> None:
    track = driven(Pose(0, 0, 0), [Pose(0, 0, 0)])
    assert track.fit(Pose(0, 0, 0), 0.0) is None and track.fit(Pose(0, 0, 0), 0.6) is not None
    assert track.ahead(Pose(0, 0, 0)) == pytest.approx(1.05, abs=0.06)


def test_a_standing_rover_stores_only_a_few_sights() -> None:
    track, pose = TrackMap(), Pose(0, 0, 0)
    taken = [track.take(pose, sight(pose, Pose(0, 0, 0))) for _ in range(20)]
    assert 2 <= sum(taken) <= 6 and not any(taken[8:])


def test_a_sight_that_contradicts_the_map_is_refused() -> None:
    line = Pose(0, 0, 0)
    track = driven(line, [Pose(0.03 * i, 0, 0) for i in range(20)])
    pose = Pose(0.6, 0, 0)
    assert not track.take(pose, sight(pose, Pose(0, 0.3, 0))) and track.refused == 1
    assert track.take(Pose(0.63, 0, 0), sight(Pose(0.63, 0, 0), line)) and track.refused == 0


def test_the_end_is_the_mean_of_its_sights_and_bounds_what_is_ahead() -> None:
    track = TrackMap()
    for i in range(4):
        pose = Pose(0.03 * i, 0, 0)
        end = LineEnd(TrackEnd.T, 0.9 - pose.x + 0.01 * (-1) ** i, 0.0)
        track.take(pose, sight(pose, Pose(0, 0, 0), end=end))
    assert track.end is not None
    kind, x, y = track.end
    assert kind is TrackEnd.T and (x, y) == pytest.approx((0.9, 0.0), abs=0.003)
    assert track.ahead(Pose(0.5, 0, 0)) == pytest.approx(0.4, abs=0.003)
    assert track.ahead(Pose(1.0, 0, 0)) < 0.0
    known = [track.complete]
    track.begin()
    known.append(track.complete)
    assert known == [True, False]


def test_a_plan_is_used_until_the_line_is_seen() -> None:
    line = Pose(0, 0, 0)
    track = driven(line, [Pose(0.03 * i, 0, 0) for i in range(20)])
    track.begin()
    track.plan(arc(Pose(1.6, 0, 0), 0.0, 2.0))
    assert track.fit(Pose(2.5, 0.05, 0), 0.0) == pytest.approx(track.fit(Pose(2.5, 0.05, 0), 0.0))
    planned = track.fit(Pose(2.5, 0.05, 0), 0.0)
    assert planned is not None and planned.y == pytest.approx(-0.05, abs=1e-6)
    pose = Pose(2.5, 0, 0)
    assert track.take(pose, sight(pose, Pose(2.0, 0.03, 0)))
    seen = track.fit(pose, 0.8)
    assert seen is not None and seen.y == pytest.approx(0.03, abs=1e-6), (
        "the plan is dropped where the line is seen"
    )


def test_a_line_far_from_the_plan_replaces_it_by_a_smooth_path() -> None:
    track = TrackMap()
    track.plan(arc(Pose(0, 0, 0), 0.0, 3.0))
    pose, line = Pose(0.5, 0, 0), Pose(0, 0.15, 0)
    far = TrackAhead(0.0, 1.0, None, tuple((x, y) for x, y in sight(pose, line).points if x > 0.8))
    assert track.take(pose, far)
    here, there = track.fit(pose, 0.0), track.fit(pose, 1.0)
    assert here is not None and abs(here.y) < 0.01 and abs(here.heading) < 0.1, (
        "it begins where the rover is"
    )
    assert there is not None and there.y == pytest.approx(0.15, abs=0.005), "it ends on the line"
    bends = [fit.curvature for i in range(11) if (fit := track.fit(pose, 0.1 * i)) is not None]
    assert len(bends) == 11 and max(map(abs, bends)) < 2.0, "no step, which would look like a bend"


def test_only_a_line_through_a_gate_begins_a_gated_stretch() -> None:
    track = TrackMap()
    track.begin([Pose(2.0, 0.0, 0.0)])
    pose = Pose(1.2, 0, 0)
    assert not track.take(pose, sight(pose, Pose(2.0, 0.45, 0.0))) and track.sights == 0
    assert (
        track.take(pose, sight(pose, Pose(2.0, 0.1, 0.1)))
        and track.sights == 1
        and track.entry is not None
    )
    assert track.entry.heading == pytest.approx(0.1, abs=1e-6)


def test_gates_are_checked_until_the_stretch_has_been_found() -> None:
    track, pose, behind = TrackMap(), Pose(1.2, 0, 0), Pose(1.2, 0, math.pi)
    track.begin([Pose(2.0, 0.0, 0.0)])
    regained = [track.regained]
    assert track.take(pose, sight(pose, Pose(2.0, 0.0, 0.0)))
    assert not track.take(behind, sight(behind, Pose(1.2, 0.0, math.pi))), (
        "turned back: where it came from is in view"
    )
    track.settle()
    regained.append(track.regained)
    assert track.take(behind, sight(behind, Pose(1.2, 0.0, math.pi)))
    track.begin([Pose(3.0, 0.0, 0.0)])
    assert [*regained, track.regained] == [False, True, False]


def test_without_looking_no_sight_is_stored() -> None:
    track, pose = TrackMap(), Pose(0, 0, 0)
    track.begin(look=False)
    assert not track.take(pose, sight(pose, Pose(0, 0, 0))) and track.complete
    track.begin()
    assert track.take(pose, sight(pose, Pose(0, 0, 0)))
