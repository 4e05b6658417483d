"""Set points of joints and of an axis, whatever they are told."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from petrobot import Axis, Driver, JointMotion, check_driver
from petrobot.services.device import faults_of_keys

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


@settings(max_examples=60)
@given(st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-3.0, 3.0)), min_size=2, max_size=4))
def test_a_way_that_begins_as_soon_as_the_last_has_ended_keeps_the_acceleration(
    goals: list[tuple[float, float]],
) -> None:
    motion = moved()
    seen = [list(motion.q)]
    for goal in goals:
        motion.begin([goal])
        for _ in range(1000):
            if motion.moving:
                motion.step()
                seen.append(list(motion.q))
        assert motion.arrived and motion.q == list(goal)
    for joint in zip(*seen, strict=True):
        rates = [0.0, *((after - at) / DT for at, after in pairwise(joint)), 0.0]
        assert all(abs(b - a) <= 8.0 * DT + 1e-9 for a, b in pairwise(rates))


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


class Lift(Axis):
    """An axis with two stations; `blocked` for as long as a door is open."""

    period = DT
    obeys = (*Axis.obeys, "dry_run")
    along = "z"
    stations = {"low": 0.2, "high": 1.2}  # noqa: RUF012 - as its users write it
    top_speed = 0.8
    acceleration = 2.0
    blocked = False

    def step(self, now: float) -> None:
        self.allowed = 0.0 if self.blocked else 0.8
        super().step(now)


def moves(lift: Axis, most: int = 1000) -> list[float]:
    """Step until it stands; where it was."""
    seen = [lift.at]
    for _ in range(most):
        lift.step(0.0)
        seen.append(lift.at)
        if lift.stopped():
            return seen
    raise AssertionError(f"still moving after {most} steps")


def test_an_axis_keeps_the_rules_of_drivers() -> None:
    commands: list[dict[str, Any]] = [{"to": "high"}, {"to": 0.3, "speed": 0.8}]
    assert check_driver(Lift, commands, simulated=True).faults == []


@settings(max_examples=60)
@given(
    st.lists(st.floats(0.2, 1.2), min_size=1, max_size=3),
    st.floats(0.1, 1.0),
    st.integers(1, 60),
    st.sampled_from(["stop", "pause", "block", "turn"]),
)
def test_an_axis_keeps_speed_acceleration_and_ends(
    goals: list[float], speed: float, steps: int, happens: str
) -> None:
    lift = Lift({"speed": speed}, None)
    seen = [lift.at, lift.at]
    for goal in goals:  # the next one comes while it moves
        lift.command(0.0, {"to": goal})
        for step in range(steps):
            lift.paused = happens == "pause" and step % 7 < 3
            lift.blocked = happens == "block" and step % 7 < 3
            lift.step(0.0)
            seen.append(lift.at)
        if happens == "stop":
            lift.stop(0.0)
    lift.paused = lift.blocked = False
    seen += [*moves(lift)[1:], lift.at]
    rates = [(b - a) / DT for a, b in pairwise(seen)]
    assert max(map(abs, rates)) <= 0.8 * speed + 1e-6
    assert all(abs(b - a) <= 2.0 * DT + 1e-6 for a, b in pairwise(rates))
    assert all(0.2 - 1e-9 <= at <= 1.2 + 1e-9 for at in seen)
    arrived = lift.state()["arrived"]
    assert lift.velocity == 0.0 and arrived is (happens != "stop")
    if arrived:
        assert lift.at == goals[-1]


def test_an_axis_takes_as_long_as_its_trapezoid() -> None:
    lift = Lift({}, None)
    lift.command(0.0, {"to": "high"})
    assert len(moves(lift)) * DT == pytest.approx(1.0 / 0.8 + 0.8 / 2.0, abs=0.06)


def test_an_axis_begins_at_0_or_at_the_end_next_to_it() -> None:
    assert Lift({}, None).at == 0.2 and Lift({"ends": [-1.0, 2.0]}, None).at == 0.0


def test_an_axis_stands_still_while_it_is_paused_or_blocked() -> None:
    lift = Lift({}, None)
    lift.command(0.0, {"to": "high"})
    assert not lift.stopped()  # it is about to move
    lift.blocked = True
    for _ in range(5):
        lift.step(0.0)
    assert lift.at == 0.2 and lift.velocity == 0.0
    lift.hold(0.0)
    assert lift.stopped()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"to": "hihg"}, "to: 'hihg' is none of low, high"),
        ({"to": 1.3}, "to: expected 0.2 to 1.2 m, found 1.3"),
        ({"to": 1.1}, "to: the point x = 0.000, y = 0.000, z = 1.100 m lies outside"),
        ({"to": math.nan}, r"to: expected 1 finite numbers, found \[nan\]"),
        ({"to": True}, "to: expected 1 finite numbers"),
        ({"to": None}, "to: expected 1 finite numbers"),
        ({"to": "low", "speed": 0.0}, "speed: expected a share above 0 and at most 1, found 0"),
        ({"to": "low", "fast": True}, r"command: unknown keys \['fast'\]; expected \['to'\], opti"),
        ({}, r"command: is missing \['to'\]"),
    ],
)
def test_what_an_axis_refuses_leaves_it_where_it_is(body: dict[str, Any], words: str) -> None:
    lift = Lift({"workspace": {"z": [0.0, 1.0]}}, None)
    with pytest.raises(ValueError, match=words):
        lift.command(0.0, body)
    assert lift.goal is None and lift.stopped()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"stations": {}},
            r"ends: is missing; give \[least, greatest\] position in m, or stations",
        ),
        ({"ends": [1.2, 0.2]}, r"ends: expected \[least, greatest\] position, found \[1.2, 0.2\]"),
        ({"ends": [0.0]}, "ends: expected 2 finite numbers"),
        ({"ends": [0.0, 1.0]}, r"stations: high lies beyond the ends \[0.0, 1.0\] m"),
        ({"stations": {"low": "0.2"}}, "stations.low: expected 1 finite numbers, found"),
        ({"top_speed": 0.0}, r"top_speed: expected a number above 0 \(m/s\), found 0.0"),
        (
            {"acceleration": -1},
            r"acceleration: expected a number above 0 \(m/s\^2\), found -1",
        ),
        ({"top_sped": 1.0}, "top_sped: .*top_speed"),
    ],
)
def test_keys_of_an_axis_that_make_no_sense_are_refused(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Lift(keys, None)
    assert [name for name, _ in faults_of_keys(Lift, keys)], "a check finds it, too"


def test_an_axis_is_between_its_ends_when_it_is_set_up() -> None:
    class Up(Lift):
        def setup(self) -> None:
            self.first = self.at

    assert Up({"stations": {"low": 0.2, "high": 1.2}}, None).first == 0.2


def test_an_axis_without_stations_moves_between_its_ends() -> None:
    class Rail(Axis):
        ends = [0.0, 1.0]  # noqa: RUF012 - as its users write it

    rail = Rail({}, None)
    with pytest.raises(ValueError, match="to: 'left' is none of its stations: it has none; give"):
        rail.command(0.0, {"to": "left"})
    rail.command(0.0, {"to": 0.5})
    assert moves(rail)[-1] == 0.5


def test_an_axis_must_lie_along_x_y_or_z() -> None:
    class Up(Lift):
        along = "up"

    with pytest.raises(ValueError, match="along: expected x, y or z in the driver, found 'up'"):
        Up({}, None)
