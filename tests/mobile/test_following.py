"""Both control laws bring a rover with lagging wheels onto lines and arcs and keep it there; its
speed depends on curvature and on how far the line is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.mobile.following import LAWS, TIGHTEST, SpeedProfile
from petrobot.services.mobile.odometry import Pose
from petrobot.services.mobile.track_map import Fit
from tests.mobile.conftest import DrawnFloor

pytestmark = pytest.mark.once

PERIOD, LAG = 0.02, 0.06
EVERY = pytest.mark.parametrize("law", LAWS)


def looking(floor: DrawnFloor, pose: Pose, s: float) -> dict[float, Fit]:
    """The line near `s` in the body frame, by distance ahead."""
    way = np.arange(max(0.0, s - 0.3), s + 0.9, 0.02)
    seen = [pose.body(at.x, at.y) for at in (floor.at(float(w)) for w in way)]
    x, y = np.array([p[0] for p in seen]), np.array([p[1] for p in seen])
    fits = {}
    for d in np.arange(-0.1, 0.7, 0.02):
        near = np.abs(x - d) < 0.1
        if near.sum() >= 4:
            c = np.polyfit(x[near] - d, y[near], 2)
            fits[round(float(d), 2)] = Fit(float(c[2]), float(c[1]), 2.0 * float(c[0]))
    return fits


def drive(law: str, floor: DrawnFloor, begin: Pose, speed: float, seconds: float) -> list[float]:
    """Distances (m) from the centre line, each cycle: wheels of first order, one cycle of delay,
    the speed profile's speed."""
    profile, pose, turning, pending = SpeedProfile(), begin, 0.0, 0.0
    present, errors = 0.0, []
    samples = [(w, floor.at(float(w))) for w in np.arange(0.0, 6.5, 0.02)]
    for _ in range(round(seconds / PERIOD)):
        s, off = min(
            ((w, math.hypot(p.x - pose.x, p.y - pose.y)) for w, p in samples),
            key=lambda pair: pair[1],
        )
        fits = looking(floor, pose, s)
        curvature = LAWS[law].curvature(
            lambda d, fits=fits: fits.get(round(round(d / 0.02) * 0.02, 2)),  # type: ignore[misc]
            present,
        )
        assert curvature is not None, "the line is known all around"
        present = profile.towards(present, profile.speed(speed, curvature, 9.0), PERIOD)
        wanted, pending = pending, present * curvature
        for _ in range(4):
            turning += PERIOD / 4 / LAG * (wanted - turning)
            heading = pose.heading + turning * PERIOD / 4
            step = present * PERIOD / 4
            pose = Pose(
                pose.x + step * math.cos(heading), pose.y + step * math.sin(heading), heading
            )
        errors.append(off)
    return errors


@EVERY
@settings(max_examples=4, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(-0.3, 0.3))
def test_a_rover_next_to_a_straight_line_reaches_it_and_stays_on_it(
    law: str, aside: float, askew: float
) -> None:
    errors = drive(law, DrawnFloor("SSS"), Pose(0.4, aside, askew), 0.5, 4.5)
    assert max(errors) < abs(aside) + 0.12
    assert max(errors[-25:]) < 0.012


@pytest.mark.parametrize(("law", "bound"), [("feed_forward", 0.012), ("pursuit", 0.045)])
@pytest.mark.parametrize("elements", ["SLS", "SRS"])
def test_an_arc_is_followed(law: str, bound: float, elements: str) -> None:
    errors = drive(law, DrawnFloor(elements), Pose(0.4, 0.0, 0.0), 0.5, 8.0)
    assert max(errors) < bound


def test_the_feed_forward_stays_stable_at_twice_the_speed() -> None:
    errors = drive("feed_forward", DrawnFloor("SSS"), Pose(0.4, 0.1, 0.0), 1.0, 3.5)
    assert max(errors[-25:]) < 0.01


@EVERY
def test_without_a_line_the_curvature_is_zero(law: str) -> None:
    assert LAWS[law].curvature(lambda d: None, 0.5) is None


@EVERY
@given(st.floats(-0.6, 0.6), st.floats(-2.0, 2.0), st.floats(-9.0, 9.0), st.floats(0.0, 1.0))
def test_no_curve_tighter_than_the_limit_is_commanded(
    law: str, y: float, slope: float, bend: float, speed: float
) -> None:
    curvature = LAWS[law].curvature(lambda d: Fit(y, slope, bend), speed)
    assert curvature is not None and abs(curvature) <= TIGHTEST


@EVERY
@given(st.floats(-0.4, 0.4), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0))
def test_left_and_right_are_mirror_images(law: str, y: float, slope: float, bend: float) -> None:
    one = LAWS[law].curvature(lambda d: Fit(y, slope, bend), 0.5)
    other = LAWS[law].curvature(lambda d: Fit(-y, -slope, -bend), 0.5)
    assert one is not None and other is not None and one == pytest.approx(-other)


@given(st.floats(0.1, 1.2), st.floats(-3.0, 3.0), st.floats(-0.5, 3.0))
def test_the_speed_respects_the_curve_and_the_known_part_of_the_line(
    asked: float, curvature: float, ahead: float
) -> None:
    profile = SpeedProfile()
    speed = profile.speed(asked, curvature, ahead)
    assert 0.0 <= speed <= asked
    assert speed**2 * abs(curvature) <= profile.sideways + 1e-9
    assert speed**2 / (2.0 * profile.braking) <= max(0.0, ahead) + 1e-9, (
        "it can still stop before the end"
    )


@given(st.floats(0.0, 1.2), st.floats(0.0, 1.2))
def test_set_speeds_change_gently_and_arrive(present: float, wanted: float) -> None:
    profile, speeds = SpeedProfile(), [present]
    for _ in range(200):
        speeds.append(profile.towards(speeds[-1], wanted, PERIOD))
    steps = np.diff(speeds)
    assert (
        steps.max() <= profile.raising * PERIOD + 1e-9
        and steps.min() >= -1.6 * profile.braking * PERIOD - 1e-9
    )
    assert speeds[-1] == pytest.approx(wanted)
