"""The guard: for any command, forearm and cup stay clear of table, floor and pedestal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, example, given, settings, strategies as st

from petrobot.services.host.numba_kernels import COMPILED, plain
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.limits import LOOKS, NEAR, CollisionGuard, clear, clear_step
from petrobot.services.motion.model import nominal_arm, nominal_cell
from petrobot.services.motion.steering import CLOSER, Steering
from petrobot.services.motion.trajectory import Six, Trajectory, six

ARM, CELL = nominal_arm(), nominal_cell()
PUMA = Puma.of(ARM)
GUARD = CollisionGuard(PUMA, ARM, CELL)
HOME = np.array(ARM.poses["home"])
ANGLES = st.tuples(
    *(
        st.floats(low, high)
        for low, high in zip(ARM.lower.tolist(), ARM.upper.tolist(), strict=True)
    )
)
NEARBY = st.tuples(*(st.floats(-0.9, 0.9) for _ in range(6)))


@given(ANGLES)
def test_parts_are_where_the_kinematics_puts_them(angles: tuple[float, ...]) -> None:
    pose, at = PUMA.forward(np.array(angles)), GUARD.place(angles)
    assert np.allclose(at.wrist, pose[:3, 3], atol=1e-12)
    assert np.allclose(at.mouth, pose[:3, :3] @ CELL.cup.mouth + pose[:3, 3], atol=1e-12)
    assert np.allclose(at.axis, pose[:3, :3] @ CELL.cup.axis, atol=1e-12)
    assert np.linalg.norm(np.subtract(at.elbow, at.wrist)) == pytest.approx(PUMA.d4)


def _surface(q: np.ndarray) -> np.ndarray:
    """Return points (n, 3) over the whole outside of the cup."""
    at = GUARD.place(q.tolist())
    axis = np.array(at.axis)
    first = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second) * (
        CELL.cup.radius + CELL.cup.wall
    )
    heights = np.linspace(0.0, CELL.cup.depth + CELL.cup.wall, 5)
    return np.concatenate([np.array(at.mouth) - height * axis + ring for height in heights])


@given(NEARBY)
def test_a_pose_that_counts_as_clear_has_no_part_of_the_cup_in_the_table(
    offset: tuple[float, ...],
) -> None:
    q = HOME + offset
    if GUARD.violation(q.tolist()):
        return
    points = _surface(q)
    assert not np.any((points[:, 0] > CELL.near_edge) & (points[:, 2] < CELL.table_top))
    assert points[:, 2].min() > 0.0
    inside = np.hypot(points[:, 0], points[:, 1]) < ARM.body.base
    assert not np.any(inside & (points[:, 2] < PUMA.d1))


@settings(max_examples=12)
@given(st.lists(st.tuples(NEARBY, st.integers(5, 90)), min_size=2, max_size=8))
def test_no_sequence_of_set_points_passes_the_guard(
    steps: list[tuple[tuple[float, ...], int]],
) -> None:
    trajectory = Trajectory(HOME.tolist(), 0.004, ARM.speed.tolist(), ARM.acceleration.tolist())
    for offset, cycles in steps:
        trajectory.aim((HOME + offset).tolist())
        for _ in range(cycles):
            before = trajectory.qd
            GUARD.advance(trajectory)
            assert np.all(
                np.abs(np.subtract(trajectory.qd, before)) <= ARM.acceleration * 0.004 * (1 + 1e-9)
            )
            assert np.all(np.abs(trajectory.qd) <= ARM.speed * (1 + 1e-9))
            # A margin of 5 mm covers the motion between the checked poses.
            points = _surface(np.array(trajectory.q))
            assert not np.any((points[:, 0] > CELL.near_edge) & (points[:, 2] < CELL.table_top))


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        ([200, 53.4, -216.3, 6.7, 48.6, 3.4], "joint 1 beyond its limit"),
        ([18.7, 30.0, -190.0, 6.7, 48.6, 3.4], "cup at the table"),
        ([85, -25, -125, -20, 15, 80], "cup at the floor"),
        ([-5, 195, 25, -10, 15, -95], "cup at the pedestal"),
        ([155, 205, -145, 120, -80, 220], "forearm at the table"),
        ([160, -45, -90, -60, 85, -130], "forearm at the floor"),
        ([65, 220, 25, 150, -20, 20], "wrist at the pedestal"),
    ],
)
def test_the_obstacle_that_would_be_touched_is_named(pose: list[float], says: str) -> None:
    assert GUARD.violation(np.radians(pose).tolist()) == says


def test_a_refused_step_is_reported_and_the_arm_stops_before_the_table() -> None:
    trajectory = Trajectory(HOME.tolist(), 0.004, ARM.speed.tolist(), ARM.acceleration.tolist())
    into_table = HOME + np.radians([0, -30, 30, 0, 0, 0])
    assert GUARD.violation(into_table.tolist())
    trajectory.aim(into_table.tolist())
    refused = [GUARD.advance(trajectory) for _ in range(200)]
    assert refused[0] == ""
    assert refused[-1] == "cup at the table"
    assert GUARD.violation(trajectory.q) == ""
    assert np.abs(trajectory.qd).max() < 0.1


def test_an_arm_switched_on_in_a_forbidden_pose_may_leave_it_slowly() -> None:
    stuck = np.radians([18.7, 30.0, -190.0, 6.7, 48.6, 3.4])
    steering = Steering(GUARD, lambda q: None, HOME.tolist(), 0.004, ARM.acceleration)
    steering.limit(ARM.speed.tolist())
    steering.reset(stuck.tolist())
    steering.move(HOME.tolist())
    fastest, close = np.zeros(6), GUARD.closer(CLOSER)
    for _ in range(1000):
        before = close.violation(
            steering.trajectory.resting(steering.trajectory.q, steering.trajectory.qd)
        )
        steering.cycle()
        if before:
            assert close.violation(stuck.tolist())
            fastest = np.maximum(fastest, np.abs(steering.trajectory.qd))
    assert steering.arrived
    assert np.all(fastest <= 0.1 * ARM.speed + 1e-9)


def _beside_contact(offset: Sequence[float]) -> list[float]:
    """Return a pose almost in contact, on the straight way from home to a pose that is not clear;
    that pose itself if it is clear."""
    barely, clear_share, end_share = GUARD.barely(), 0.0, 1.0

    def on_the_way(share: float) -> list[float]:
        return [h + share * o for h, o in zip(HOME.tolist(), offset, strict=True)]

    if not barely.violation(on_the_way(end_share)):
        return on_the_way(end_share)
    for _ in range(14):
        middle = (clear_share + end_share) / 2
        if barely.violation(on_the_way(middle)):
            end_share = middle
        else:
            clear_share = middle
    return on_the_way(clear_share)


@settings(max_examples=60, deadline=None)
@example((-0.3, 0.0, 0.5, 0.7, -0.6, 0.8), (-0.9, 0.5, 0.6, -0.7, -0.1, 0.6))
@given(NEARBY, NEARBY)
def test_an_arm_switched_on_beside_the_table_touches_nothing_on_its_way(
    start: tuple[float, ...], end: tuple[float, ...]
) -> None:
    """Where neither guard is satisfied it creeps, and creeping has a guard, too."""
    goal = (HOME + end).tolist()
    assume(not GUARD.violation(goal))
    contact = CollisionGuard(PUMA, ARM, CELL, cup_margin=0.0, arm_margin=0.0)
    steering = Steering(GUARD, lambda q: None, HOME.tolist(), 0.004, ARM.acceleration)
    steering.limit(ARM.speed.tolist())
    steering.reset(_beside_contact(start))
    steering.move(goal)
    for _ in range(400):
        steering.cycle()
        assert contact.violation(steering.trajectory.q) == ""


def test_a_guard_with_a_smaller_margin_allows_poses_that_a_wider_one_refuses() -> None:
    wide = CollisionGuard(PUMA, ARM, CELL, cup_margin=0.10, arm_margin=0.10)
    assert GUARD.violation(HOME.tolist()) == ""
    assert wide.violation(HOME.tolist()) == "cup at the table"
    assert wide.closer(0.05).violation(HOME.tolist()) == ""


@settings(max_examples=40)
@given(NEARBY, st.integers(1, 60))
def test_a_clear_rest_pose_is_not_reused_for_another_arm(
    offset: tuple[float, ...], cycles: int
) -> None:
    guard = CollisionGuard(PUMA, ARM, CELL)
    moving, stuck = (
        Trajectory(HOME.tolist(), 0.004, ARM.speed.tolist(), ARM.acceleration.tolist())
        for _ in range(2)
    )
    moving.aim((HOME + offset).tolist())
    stuck.reset(np.radians([18.7, 30.0, -190.0, 6.7, 48.6, 3.4]).tolist())
    for _ in range(cycles):
        guard.advance(moving)
        assert guard.stops_clear(moving) == (
            GUARD.violation(moving.resting(moving.q, moving.qd)) == ""
        )
        assert not guard.stops_clear(stuck)


SIX = st.tuples(*[st.floats(-2.0, 2.0, allow_subnormal=False)] * 6)


@pytest.mark.skipif(not COMPILED, reason="numba is not installed (the extra `fast`)")
@settings(max_examples=150, deadline=None)
@given(angles=ANGLES, goal=ANGLES, share=SIX)
def test_a_compiled_guard_gives_the_same_bits(angles: Six, goal: Six, share: Six) -> None:
    """Commanded positions, velocities and clearances are equal with compiled and plain code."""
    qd = six(0.5 * s * v for s, v in zip(share, ARM.speed.tolist(), strict=True))
    limits = six(ARM.speed), six(ARM.acceleration), six(ARM.acceleration)
    numbers = 0.004, NEAR, angles, qd, goal, *limits, *GUARD._geometry
    assert repr(clear_step(*numbers)) == repr(plain(clear_step)(*numbers))
    assert clear(angles, *GUARD._geometry) == plain(clear)(angles, *GUARD._geometry)


@settings(max_examples=150, deadline=None)
@given(goal=ANGLES, share=SIX)
def test_a_clear_step_can_stop_anywhere_on_its_path(goal: Six, share: Six) -> None:
    """The guard's single check of a step agrees with checks of all its poses one by one."""
    trajectory = Trajectory(HOME.tolist(), 0.004, ARM.speed.tolist(), ARM.acceleration.tolist())
    trajectory.qd = six(0.5 * s * v for s, v in zip(share, ARM.speed.tolist(), strict=True))
    trajectory.aim(goal)
    q, qd = trajectory.proposed()
    rest = trajectory.resting(q, qd)
    poses = [rest, q]
    if max(abs(a - b) for a, b in zip(rest, q, strict=True)) > NEAR:
        poses += trajectory.stopping(q, qd, *LOOKS)
    refused = next(filter(None, map(GUARD.violation, poses)), "")
    braked = trajectory.braking()
    assert GUARD.advance(trajectory) == refused
    assert (trajectory.q, trajectory.qd) == (braked if refused else (q, qd))
