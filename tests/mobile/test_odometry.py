"""Dead reckoning with two wheels, and poses in the recent past."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, strategies as st

from petrobot.services.mobile.odometry import Odometry, Pose, turned

ANGLE = st.floats(-20.0, 20.0)
PLACE = st.floats(-5.0, 5.0)


@given(st.floats(0.05, 3.0), st.floats(-1.5, 1.5), st.integers(1, 40))
def test_an_arc_is_exact_in_any_number_of_steps(length: float, turn: float, steps: int) -> None:
    odometry = Odometry(0.4)
    for i in range(steps):
        odometry.add(0.02 * i, (length - 0.2 * turn) / steps, (length + 0.2 * turn) / steps)
    radius = length / turn if abs(turn) > 1e-9 else math.inf
    x = length if math.isinf(radius) else radius * math.sin(turn)
    y = 0.0 if math.isinf(radius) else radius * (1.0 - math.cos(turn))
    assert odometry.pose == pytest.approx((x, y, turn), abs=1e-6)
    assert odometry.way == pytest.approx(length)


def test_turning_on_the_spot_adds_no_distance() -> None:
    odometry = Odometry(0.4)
    odometry.add(0.0, -0.2, 0.2)
    assert odometry.pose == pytest.approx((0.0, 0.0, 1.0)) and odometry.way == 0.0


@given(PLACE, PLACE, ANGLE, PLACE, PLACE)
def test_body_and_floor_are_inverse(
    x: float, y: float, heading: float, ahead: float, left: float
) -> None:
    pose = Pose(x, y, heading)
    assert pose.body(*pose.floor(ahead, left)) == pytest.approx((ahead, left), abs=1e-9)


def test_the_pose_between_two_cycles_is_interpolated() -> None:
    odometry = Odometry(0.4)
    for i in range(10):
        odometry.add(0.02 * i, 0.01, 0.01)
    assert odometry.at(0.07).x == pytest.approx(0.045)
    assert odometry.at(1.0) == odometry.pose, "not before the next cycle"
    assert odometry.at(-1.0).x == pytest.approx(0.01), "the oldest one known"


@given(ANGLE)
def test_a_turned_angle_points_the_same_way(angle: float) -> None:
    assert -math.pi < turned(angle) <= math.pi + 1e-12
    assert math.cos(turned(angle) - angle) == pytest.approx(1.0)
