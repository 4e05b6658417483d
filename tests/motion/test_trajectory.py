"""Online trajectories: limits for any sequence of targets, exact and nearly time-optimal
arrival."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.motion.model import nominal_arm
from petrobot.services.motion.trajectory import (
    Trajectory,
    braking_distance,
    reach_time,
    synchronised,
)
from tests.waiting import Limit

ARM = nominal_arm()
PERIOD = 0.004
ANGLE = st.floats(-2.5, 2.5)
STEP = st.tuples(st.one_of(st.none(), st.lists(ANGLE, min_size=6, max_size=6)), st.integers(1, 60))


def _trajectory() -> Trajectory:
    return Trajectory([0.0] * 6, PERIOD, ARM.speed.tolist(), ARM.acceleration.tolist())


def _advance(trajectory: Trajectory) -> None:
    trajectory.accept(*trajectory.proposed())


@settings(max_examples=40)
@given(st.lists(STEP, min_size=1, max_size=12))
def test_limits_hold_for_any_sequence_of_targets(
    steps: list[tuple[list[float] | None, int]],
) -> None:
    trajectory = _trajectory()
    for target, cycles in steps:
        trajectory.aim(target)
        for _ in range(cycles):
            q, qd = trajectory.q, trajectory.qd
            _advance(trajectory)
            change = np.abs(np.subtract(trajectory.qd, qd))
            assert np.all(np.abs(trajectory.qd) <= ARM.speed * (1 + 1e-9))
            assert np.all(change <= ARM.acceleration * PERIOD * (1 + 1e-9))
            assert np.allclose(
                np.subtract(trajectory.q, q), 0.5 * PERIOD * np.add(trajectory.qd, qd), atol=1e-12
            )


@settings(max_examples=40)
@given(st.lists(STEP, max_size=6), st.lists(ANGLE, min_size=6, max_size=6))
def test_it_arrives_exactly_and_nearly_as_early_as_possible(
    steps: list[tuple[list[float] | None, int]], target: list[float]
) -> None:
    trajectory = _trajectory()
    for before, cycles in steps:
        trajectory.aim(before)
        for _ in range(cycles):
            _advance(trajectory)
    least = reach_time(
        np.subtract(target, trajectory.q), np.array(trajectory.qd), ARM.speed, ARM.acceleration
    )
    trajectory.aim(target)
    arrived = [math.inf] * 6
    for cycle in range(1, math.ceil(float(least.max()) / PERIOD) + 4):
        _advance(trajectory)
        for joint in range(6):
            if abs(trajectory.q[joint] - target[joint]) < 1e-8 and abs(trajectory.qd[joint]) < 1e-9:
                arrived[joint] = min(arrived[joint], cycle * PERIOD)
    assert np.all(np.array(arrived) <= least + 2 * PERIOD + 1e-9)
    assert np.all(np.array(arrived) >= least - PERIOD - 1e-9)
    assert trajectory.arrived()
    assert trajectory.still


@settings(max_examples=40)
@given(st.lists(ANGLE, min_size=6, max_size=6), st.integers(1, 200))
def test_braking_ends_where_predicted(target: list[float], cycles: int) -> None:
    trajectory = _trajectory()
    trajectory.aim(target)
    for _ in range(cycles):
        _advance(trajectory)
    rest, q, qd = trajectory.resting(trajectory.q, trajectory.qd), trajectory.q, trajectory.qd
    path = [q]
    limit = Limit("rest", steps=10_000)
    while not trajectory.still and limit.left():
        trajectory.accept(*trajectory.braking())
        path.append(trajectory.q)
    for number, pose in enumerate(path):
        assert np.allclose(
            next(trajectory.stopping(q, qd, number / max(len(path) - 1, 1))), pose, atol=1e-9
        )
    assert trajectory.still
    assert np.allclose(trajectory.q, rest, atol=1e-9)


@pytest.mark.parametrize("distance", [1e-9, 1e-6, 1e-4, 0.01, 0.3, 2.0])
def test_from_rest_the_time_equals_the_textbook_formula(distance: float) -> None:
    speed, acceleration = ARM.speed, ARM.acceleration
    ramp = speed * speed / acceleration
    expected = np.where(
        distance < ramp,
        2 * np.sqrt(distance / acceleration),
        speed / acceleration + distance / speed,
    )
    assert np.allclose(reach_time(np.full(6, distance), np.zeros(6), speed, acceleration), expected)
    assert np.allclose(
        reach_time(np.full(6, -distance), np.zeros(6), speed, acceleration), expected
    )


def test_overshoot_is_counted_when_the_joint_is_too_fast_to_stop() -> None:
    one = np.ones(1)
    # 1 rad/s towards a target 0.1 rad ahead at 1 rad/s^2: rests 0.5 m ahead after 1 s, then 0.4 rad
    # back.
    assert reach_time(0.1 * one, one, 2 * one, one)[0] == pytest.approx(1.0 + 2 * math.sqrt(0.4))


@given(st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_synchronised_joints_end_together(target: list[float]) -> None:
    error = np.array(target)
    speed, acceleration = synchronised(error, ARM.speed, ARM.acceleration)
    times = reach_time(error, np.zeros(6), speed, acceleration)
    longest = float(reach_time(error, np.zeros(6), ARM.speed, ARM.acceleration).max())
    long_enough = reach_time(error, np.zeros(6), ARM.speed, ARM.acceleration) > 0.05 * longest
    assert np.allclose(times[long_enough], longest, atol=1e-9)
    assert np.all(speed <= ARM.speed * (1 + 1e-12))
    assert np.all(acceleration <= ARM.acceleration * (1 + 1e-12))


def test_a_joint_brakes_to_lowered_limits() -> None:
    trajectory = _trajectory()
    trajectory.aim([2.0] * 6)
    for _ in range(60):
        _advance(trajectory)
    before = list(trajectory.qd)
    trajectory.limit((0.2 * ARM.speed).tolist(), ARM.acceleration.tolist())
    _advance(trajectory)
    assert np.allclose(np.subtract(before, trajectory.qd), ARM.acceleration * PERIOD)
    for _ in range(60):
        _advance(trajectory)
    assert np.all(np.abs(trajectory.qd) <= 0.2 * ARM.speed + 1e-12)


def test_limits_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive"):
        _trajectory().limit([0.0] * 6, [1.0] * 6)


def test_braking_distance_has_the_sign_of_the_motion() -> None:
    assert braking_distance(-1.0, PERIOD, 10.0) == pytest.approx(-0.05)
    assert braking_distance(0.0, PERIOD, 10.0) == 0.0
