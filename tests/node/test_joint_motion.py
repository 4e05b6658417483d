"""Set points of joints, whatever they are told."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from petrobot import Driver, JointMotion

LIMITS = {"lift": (-1.5, 1.5), "turn": (-3.0, 3.0)}
DT = 0.02


class Bare(Driver):
    """A driver of two joints, whose tool is at (lift, turn, 0)."""

    period = DT
    obeys = ("speed", "workspace")


def moved(**keys: Any) -> JointMotion:
    return JointMotion(Bare(keys, None), LIMITS, 2.0, 8.0, lambda q: (*q, 0.0))


def arrive(motion: JointMotion, steps: int = 1000) -> int:
    """Step until it stands; how many steps that took."""
    for number in range(steps):
        if not motion.moving:
            return number
        motion.step()
    raise AssertionError(f"still moving after {steps} steps")


ways = st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-3.0, 3.0)), min_size=1, max_size=2)


@settings(max_examples=40)
@given(
    ways,
    st.floats(0.3, 1.0),
    st.integers(0, 80),
    st.sampled_from(["stop", "pause", "driver", "none"]),
)
def test_set_points_keep_speed_and_acceleration_and_arrive_together(
    way: list[tuple[float, float]], share: float, steps: int, happens: str
) -> None:
    motion = moved(speed=0.5)
    motion.begin([*way], share)
    seen = [list(motion.q)]
    for step in range(4000):
        if step == steps and happens == "stop":
            motion.stop()
        if happens in ("pause", "driver"):
            paused: Any = motion if happens == "pause" else motion._driver
            paused.paused = steps <= step < steps + 40
        motion.step()
        seen.append(list(motion.q))
        if not motion.moving and not motion._rests:
            break
    most = 2.0 * 0.5 * share
    fast = [max(abs(b - a) for a, b in zip(*each, strict=True)) / DT for each in pairwise(seen)]
    assert max(fast) <= most + 1e-6
    if len(way) == 1:  # a corner changes a joint's speed at once
        assert all(abs(b - a) <= 8.0 * DT + 1e-6 for a, b in pairwise([0.0, *fast, 0.0]))
        x, y = way[0]  # straight: so the joints start and arrive together
        assert all(math.isclose(a * y, b * x, abs_tol=1e-6) for a, b in seen)
    if happens != "stop":
        assert motion.arrived and motion.q == pytest.approx(way[-1])
    assert not motion.moving


def test_it_takes_as_long_as_its_trapezoid() -> None:
    motion = moved()
    motion.begin([[1.0, 2.0]])
    assert arrive(motion) * DT == pytest.approx(2.0 / 2.0 + 2.0 / 8.0, abs=0.05)


@pytest.mark.parametrize(
    ("goal", "share", "words"),
    [
        ([0.0], 1.0, "expected 2 finite numbers"),
        ([0.0, math.nan], 1.0, "expected 2 finite numbers"),
        ([0.0, True], 1.0, "expected 2 finite numbers"),
        ([1.6, 0.0], 1.0, "lift: expected -1.500 to 1.500, found 1.600"),
        ([0.0, 0.0], 0.0, "speed: expected a share above 0"),
        ([0.0, 0.0], "fast", "speed: expected 1 finite numbers"),
        ([0.5, 2.0], 1.0, "the point x = "),
    ],
)
def test_what_it_refuses_leaves_it_where_it_is(goal: Any, share: Any, words: str) -> None:
    motion = moved(workspace={"y": [-1.0, 1.0]})
    with pytest.raises(ValueError, match=words):
        motion.begin([goal], share)
    assert not motion.moving and motion.goal is None


def test_a_way_that_leaves_the_workspace_is_refused_though_both_ends_lie_inside() -> None:
    motion = moved(workspace={"y": [-0.5, 0.5]})
    with pytest.raises(ValueError, match="lies outside the workspace"):
        motion.begin([[0.0, 1.0], [1.0, 0.0]])


def test_a_tool_that_leaves_the_workspace_is_stopped_once() -> None:
    motion = moved(workspace={"x": [-0.5, 0.5]})
    motion.begin([[0.4, 0.0]])
    motion.step()
    assert motion.watch([0.1, 0.0]) == ""
    assert "lies outside" in motion.watch([0.6, 0.0])  # pushed, or not where it was thought
    assert motion.watch([0.6, 0.0]) == ""
    arrive(motion)
    assert motion.goal is None and motion.q[0] < 0.4


def test_a_second_way_waits_for_the_first_to_stop() -> None:
    motion = moved()
    motion.begin([[1.0, 1.0]])
    for _ in range(10):
        motion.step()
    with pytest.raises(ValueError, match="still moving"):
        motion.begin([[0.0, 0.0]])
    motion.stop()
    arrive(motion)
    motion.begin([[0.0, 0.0]])
    arrive(motion)
    assert motion.q == [0.0, 0.0]
    motion.halt([0.3, 0.3])
    assert motion.q == [0.3, 0.3] and not motion.moving and not motion.arrived


def test_it_has_reached_its_goal_where_the_joints_are_measured() -> None:
    motion = moved()
    assert not motion.reached(motion.q, 0.1)  # there is no goal yet
    motion.begin([[0.5, 0.0]])
    assert not motion.reached([0.5, 0.0], 0.1)  # the set point is still on its way
    arrive(motion)
    assert motion.reached([0.51, 0.0], 0.011) and not motion.reached([0.51, 0.0], 0.009)


@pytest.mark.parametrize(("speed", "acceleration"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0)])
def test_without_speed_or_acceleration_it_would_never_move(
    speed: float, acceleration: float
) -> None:
    with pytest.raises(ValueError, match="speed and acceleration above 0"):
        JointMotion(Bare({}, None), LIMITS, speed, acceleration)
