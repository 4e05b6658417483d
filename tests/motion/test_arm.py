"""The driver `Arm` on simulated drives, in simulated time: enabling, moving, following, and every
reason to stop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

from petrobot.services.comm.canopen.cia402 import DriveFault
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import nominal_arm, nominal_cell

ARM = nominal_arm()
PUMA = Puma.of(ARM)
TOUCH = CollisionGuard(PUMA, ARM, nominal_cell(), cup_margin=0.0, arm_margin=0.0)
"""Reports real contact, without margins."""
CYCLE = 0.004
AWAY = [math.radians(angle) for angle in (-60.0, 63.0, -205.0, 40.0, 70.0, 90.0)]
"""A pose far from home with a clear path to it."""
STREAM_PERIOD = 0.02


def _point(y: float = 0.1, time_to_go: float = 1.0, speed: float = 1.2) -> list[float]:
    return [time_to_go, 0.62, y, 0.62, -speed, 0.0, 0.0, 0.002, 0.005]


def _follow(rig: Any, seconds: float, y: float = 0.1, arrival: float = 2.0) -> None:
    """Follow a stream of one prediction for a ball that arrives in `arrival` seconds."""
    begun = rig.now
    for cycle in range(round(seconds / CYCLE)):
        if cycle % 20 == 0:
            rig.arm.command(rig.now, {"do": "follow"})
        if cycle % 5 == 0:
            rig.feed(_point(y, arrival - (rig.now - begun)))
        rig.tick()


def _check_limits(rig: Any) -> None:
    """Check that all commanded speeds and accelerations were within the arm's limits."""
    q = np.array(rig.commanded[1:])
    qd = np.diff(q, axis=0) / CYCLE
    assert np.all(np.abs(qd) <= ARM.speed * (1 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / CYCLE <= ARM.acceleration * (1 + 1e-6))


def test_it_enables_itself_at_the_start_and_holds_where_it_is(make_rig: Any) -> None:
    rig = make_rig(start=ARM.poses["ready"])
    rig.enable()
    assert rig.now < 0.5
    rig.run(0.5)
    state = rig.arm.state()
    assert state["mode"] == "hold"
    assert state["still"]
    assert state["faults"] == []
    assert state["power"] is True
    assert np.allclose(state["q"], ARM.poses["ready"], atol=2e-3)
    assert not any(rig.plant.braked)


def test_it_stays_off_when_configured_so(make_rig: Any) -> None:
    rig = make_rig(config={"enable": False})
    assert rig.run(1.0, lambda: rig.arm.state()["phase"] == "running")
    rig.run(0.2)
    assert rig.arm.state()["mode"] == "off"
    assert all(rig.plant.braked)
    with pytest.raises(ValueError, match="the drives are not enabled"):
        rig.arm.command(rig.now, {"do": "move", "pose": "home"})
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()


def test_a_move_arrives_with_all_joints_at_once_and_within_limits(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    assert rig.run(4.0, lambda: bool(rig.arm.state()["in_place"]))
    assert np.allclose(rig.plant.q, AWAY, atol=3e-3)
    path = np.array(rig.commanded)
    moving = np.abs(np.diff(path, axis=0)) > 0
    ends = [np.flatnonzero(moving[:, joint]).max() for joint in range(6)]
    assert max(ends) - min(ends) <= 3
    _check_limits(rig)
    assert max(rig.arm.state()["following_error"], 0.0) < 0.01


def test_speed_is_a_fraction_of_the_maximum(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY, "speed": 0.3})
    assert rig.run(12.0, lambda: bool(rig.arm.state()["in_place"]))
    speeds = np.abs(np.diff(np.array(rig.commanded), axis=0)) / CYCLE
    assert np.all(speeds <= 0.3 * ARM.speed)
    assert np.any(speeds > 0.25 * ARM.speed)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({}, "unknown command None"),
        ({"do": "dance"}, "unknown command 'dance': know move, follow"),
        ({"do": "move", "pose": "moon"}, "unknown pose 'moon': know home, empty, ready"),
        ({"do": "move", "pose": [0.0] * 5}, "expected a name or 6 finite angles"),
        ({"do": "move", "pose": [0.0] * 5 + [math.nan]}, "expected a name or 6 finite angles"),
        ({"do": "move", "pose": [9.0] + [0.0] * 5}, "joint 1 beyond its limit"),
        ({"do": "move", "pose": [0.33, 0.52, -3.3, 0.12, 0.85, 0.06]}, "cup at the table"),
        ({"do": "move", "pose": "home", "speed": 0.0}, "expected a number from 0.001 to 1"),
        ({"do": "move", "pose": "home", "speed": True}, "expected a number from 0.001 to 1"),
        ({"do": "follow", "strategy": "net"}, "unknown strategy 'net': know tilted, upright"),
    ],
)
def test_bad_commands_are_refused_and_change_nothing(
    rig: Any, body: dict[str, Any], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        rig.arm.command(rig.now, body)
    rig.run(0.2)
    assert rig.arm.state()["mode"] == "hold"
    assert rig.arm.state()["still"]


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"speed": 0.0}, "speed: expected a number above 0"),
        ({"speed": "fast"}, "speed: expected a number .*, found 'fast'"),
        ({"stream_period": -1.0}, "stream_period"),
        ({"enable": 1}, "enable: expected true or false .*, found 1"),
        ({"sped": 0.5}, "sped: unknown key; did you mean 'speed'"),
    ],
)
def test_a_bad_configuration_is_refused(make_rig: Any, config: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make_rig(config=config)


def test_following_brings_the_cup_to_the_predicted_point(rig: Any) -> None:
    _follow(rig, 1.0, y=0.2)
    state = rig.arm.state()
    assert state["mode"] == "follow"
    assert state["in_place"]
    plan = state["plan"]
    assert plan["arrival"] == pytest.approx(2.0 - 1.0 + math.sqrt(2 * 0.055 / 9.81), abs=0.03)
    mouth = rig.arm._guard.place(rig.plant.q).mouth
    assert np.allclose(mouth, plan["point"], atol=2e-3)
    assert state["stale_executed"] == 0
    assert state["oldest_executed"] <= STREAM_PERIOD
    _check_limits(rig)


@pytest.mark.parametrize("thinking", [0.001, 0.003, 0.011, 0.050])
def test_a_cycle_that_takes_long_executes_nothing_stale(rig: Any, thinking: float) -> None:
    """A set point that is fresh when a cycle begins may be stale when its target is sent: the clock
    at the moment of sending decides."""
    _follow(rig, 0.12, y=0.3)
    rig.thinking = thinking
    assert rig.run(0.1, lambda: rig.arm.state()["reason"] == "no_setpoint")
    state = rig.arm.state()
    assert state["stale_executed"] == 0
    assert state["oldest_executed"] <= 3 * STREAM_PERIOD + 1e-9


def test_it_holds_within_three_periods_of_the_stream(rig: Any) -> None:
    _follow(rig, 0.12, y=0.3)
    assert not rig.arm.state()["still"]
    ceased = rig.now - STREAM_PERIOD
    while rig.arm.state()["reason"] != "no_setpoint":
        rig.tick()
        assert rig.now - ceased <= 3 * STREAM_PERIOD + 2 * CYCLE
    rig.arm.command(rig.now, {"do": "follow"})
    assert rig.run(0.3, lambda: bool(rig.arm._trajectory.still))
    state = rig.arm.state()
    assert state["stale_executed"] == 0
    assert state["oldest_executed"] <= 3 * STREAM_PERIOD + 1e-9
    assert not state["in_place"]
    _check_limits(rig)
    _follow(rig, 0.8, y=0.3)
    assert rig.arm.state()["in_place"], "it resumes when set points arrive again"


@pytest.mark.parametrize("y", [-0.3, 0.3])
@pytest.mark.parametrize("speed", [0.38, 0.5])
def test_slow_balls_close_to_the_edge_are_reached_by_a_detour(
    rig: Any, y: float, speed: float
) -> None:
    begun = rig.now
    for cycle in range(250):
        if cycle % 20 == 0:
            rig.arm.command(rig.now, {"do": "follow"})
        if cycle % 5 == 0:
            rig.feed(_point(y, 1.2 - (rig.now - begun), speed))
        rig.tick()
        assert TOUCH.violation(rig.plant.q) == ""
    assert rig.arm.state()["in_place"]
    rig.arm.command(rig.now, {"do": "move", "pose": "home"})
    assert rig.run(3.0, lambda: bool(rig.arm.state()["in_place"]))
    _check_limits(rig)


def test_bad_set_points_do_not_keep_an_old_one_alive(rig: Any) -> None:
    _follow(rig, 0.1, y=0.3)
    rubbish = 0
    while rig.arm.state()["reason"] != "no_setpoint":
        rig.feed([math.nan] * 9)
        rubbish += 1
        rig.tick()
        assert rubbish * CYCLE <= 3 * STREAM_PERIOD + 2 * CYCLE
    assert rig.arm.state()["setpoints_refused"] >= 10


def test_repeats_keep_a_set_point_alive(rig: Any) -> None:
    values = _point(0.2)
    for cycle in range(250):
        if cycle % 20 == 0:
            rig.arm.command(rig.now, {"do": "follow"})
        if cycle % 5 == 0:
            rig.feed(values)
        rig.tick()
    state = rig.arm.state()
    assert state["in_place"]
    assert state["plan"]["arrival"] == pytest.approx(
        1.0 - 1.0 + math.sqrt(2 * 0.055 / 9.81), abs=0.03
    )


def test_it_holds_when_its_action_stops_sending(rig: Any) -> None:
    _follow(rig, 0.1)
    silent = rig.now
    cycle = 0
    while rig.arm.state()["mode"] == "follow":
        if cycle % 5 == 0:
            rig.feed(_point(0.3 if cycle % 10 else -0.3, 2.0))
        rig.tick()
        cycle += 1
        assert rig.now - silent < 0.6
    assert rig.arm.state()["reason"] == "silent_action"
    rig.run(0.3)
    assert rig.arm.stopped()


def test_old_set_points_from_before_following_do_not_count(rig: Any) -> None:
    rig.feed(_point(0.3))
    rig.arm.command(rig.now, {"do": "follow"})
    rig.run(0.1)
    assert rig.arm.state()["plan"] is None
    assert rig.arm.state()["still"]


def test_a_ball_out_of_reach_is_reported_as_unreachable(rig: Any) -> None:
    _follow(rig, 0.1, y=1.3)
    assert rig.arm.state()["reason"] == "unreachable"
    assert rig.arm.state()["plan"] is None


def test_the_stop_routine_brakes_at_the_limits_and_holds(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    assert not rig.arm.stopped()
    rig.arm.stop(rig.now)
    stopped = rig.now
    assert rig.run(0.5, rig.arm.stopped)
    assert rig.now - stopped < 0.2
    rig.arm.stop(rig.now)
    _check_limits(rig)
    assert rig.arm.state()["mode"] == "hold"


def test_pause_and_release_by_the_operator(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    assert rig.arm.hold(rig.now) == "held"
    rig.run(0.3)
    assert rig.arm.stopped()
    assert not rig.arm.state()["in_place"]
    rig.arm.release(rig.now)
    assert rig.run(4.0, lambda: bool(rig.arm.state()["in_place"]))
    _check_limits(rig)


def test_following_continues_after_a_pause(rig: Any) -> None:
    _follow(rig, 0.2)
    rig.arm.hold(rig.now)
    rig.run(1.5)
    assert rig.arm.stopped()
    rig.arm.release(rig.now)
    _follow(rig, 0.8, y=-0.2)
    assert rig.arm.state()["in_place"]


def test_disable_stops_first_and_then_applies_the_brakes(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    rig.arm.command(rig.now, {"do": "disable"})
    assert rig.run(1.0, lambda: rig.arm.state()["mode"] == "off")
    rig.commanded.pop()  # With the power off, the commanded position follows the measured one.
    _check_limits(rig)
    rig.run(1.0)
    assert all(rig.plant.braked)
    assert rig.arm.state()["faults"] == []
    assert rig.arm.stopped()


@pytest.mark.parametrize(
    "fault", [DriveFault.OVERCURRENT, DriveFault.OVERHEATED, DriveFault.ENCODER]
)
def test_a_drive_fault_stops_all_drives_and_a_reset_enables_them_again(
    rig: Any, fault: DriveFault
) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    rig.drives.trip(3, fault)
    assert rig.run(0.5, lambda: bool(rig.arm.state()["faults"]))
    cause, joint, code, text = rig.arm.state()["faults"][0]
    assert (cause, joint, code) == ("drive_fault", 3, fault)
    assert text.startswith("joint 4: ")
    assert rig.run(1.0, lambda: max(map(abs, rig.plant.qd)) < 0.01)
    rig.run(0.2)
    assert rig.arm.state()["mode"] == "off"
    with pytest.raises(ValueError, match="joint 4"):
        rig.arm.command(rig.now, {"do": "move", "pose": "home"})
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()
    assert rig.arm.state()["faults"] == []
    rig.arm.command(rig.now, {"do": "move", "pose": "home"})
    assert rig.run(4.0, lambda: bool(rig.arm.state()["in_place"]))


def test_an_open_power_chain_is_a_fault_until_it_is_closed(rig: Any) -> None:
    rig.drives.power(False)
    assert rig.run(0.2, lambda: bool(rig.arm.state()["faults"]))
    assert all(fault[0] == "power" for fault in rig.arm.state()["faults"])
    rig.run(0.2)
    assert rig.arm.state()["power"] is False
    assert all(rig.plant.braked)
    rig.arm.command(rig.now, {"do": "reset"})
    rig.run(1.0)
    assert not rig.arm.state()["enabled"]
    rig.drives.power(True)
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()


def test_a_silent_bus_is_an_error_and_the_drives_stop_by_themselves(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    rig.wire.cut = True
    cut = rig.now
    assert rig.run(0.5, lambda: bool(rig.arm.state()["faults"]))
    assert rig.now - cut < 0.05
    assert rig.arm.state()["faults"][0][0] == "bus"
    assert rig.run(0.5, lambda: max(map(abs, rig.plant.qd)) < 0.01)
    rig.run(1.0)
    assert all(rig.plant.braked)
    rig.wire.cut = False
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()


def test_a_dead_bus_is_an_error_and_recovers(rig: Any) -> None:
    rig.wire.dead = True
    rig.run(0.1)
    assert rig.arm.state()["faults"][0] == ("bus", None, 0, "the bus is dead")
    rig.run(2.5)
    rig.wire.dead = False
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()


def test_when_the_motion_node_dies_the_drives_stop_by_themselves(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.3)
    assert max(map(abs, rig.plant.qd)) > 0.3
    died = rig.now
    while max(map(abs, rig.plant.qd)) > 0.01:
        rig.tick(arm_lives=False)
        assert rig.now - died < 0.3
    for _ in range(30):
        rig.tick(arm_lives=False)
    assert all(rig.plant.braked)


def test_a_drive_that_restarts_is_noticed(rig: Any) -> None:
    rig.run(0.2)  # A boot-up message before the first heartbeat may be older than the start.
    rig.drives.drives[1].boot(rig.now)
    rig.run(0.1)
    assert ("bus", 1, 0, "node 2 has restarted") in rig.arm.state()["faults"]
    rig.arm.command(rig.now, {"do": "reset"})
    rig.enable()


def test_drives_that_start_late_are_found(make_rig: Any) -> None:
    rig = make_rig()
    rig.wire.cut = True
    rig.run(2.0)
    assert rig.arm.state()["faults"][0][0] == "bus"
    rig.wire.cut = False
    assert rig.run(3.0, lambda: bool(rig.arm.state()["enabled"]))
    assert rig.arm.state()["faults"] == []


def test_a_blocked_joint_ends_in_a_following_error(rig: Any) -> None:
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    rig.run(0.2)
    rig.plant.step = lambda dt, tau: None
    assert rig.run(0.5, lambda: bool(rig.arm.state()["faults"]))
    assert {fault[2] for fault in rig.arm.state()["faults"]} == {DriveFault.FOLLOWING_ERROR}


@pytest.mark.parametrize("factor", [0.5, 0.3])
def test_a_slow_arm_is_driven_at_its_reduced_speed(make_rig: Any, factor: float) -> None:
    rig = make_rig()
    rig.drives.slow_down(factor)
    rig.enable()
    _follow(rig, 1.8, y=0.25, arrival=3.0)
    assert rig.arm.state()["faults"] == []
    assert rig.arm.state()["in_place"]
    assert not rig.arm.state()["limited"]
    speeds = np.abs(np.diff(np.array(rig.commanded[1:]), axis=0)) / CYCLE
    assert np.all(speeds <= factor * ARM.speed)


@pytest.mark.parametrize("factor", [0.5, 0.3])
def test_commands_adapt_to_an_arm_that_slows_down_during_a_motion(rig: Any, factor: float) -> None:
    _follow(rig, 0.2, y=-0.3)
    rig.drives.slow_down(factor)
    _follow(rig, 3.3, y=0.3, arrival=3.5)
    assert rig.arm.state()["faults"] == []
    assert rig.arm.state()["in_place"]
    assert rig.arm.state()["following_error"] < 0.01
    rig.drives.slow_down(1.0)
    rig.run(1.2)
    rig.arm.command(rig.now, {"do": "move", "pose": AWAY})
    begun = len(rig.commanded)
    assert rig.run(4.0, lambda: bool(rig.arm.state()["in_place"]))
    speeds = np.abs(np.diff(np.array(rig.commanded[begun:]), axis=0)) / CYCLE
    assert np.max(speeds / ARM.speed) > 0.9, "the driver must notice that the arm is fast again"


def test_a_ball_in_the_cup_is_reported_once_when_it_stays(rig: Any) -> None:
    rig.drives.ball(True)
    rig.run(0.2)
    assert rig.arm.state()["ball_in_cup"]
    assert rig.events == [], "no action waits for a ball"
    rig.drives.ball(False)
    _follow(rig, 0.2)
    rig.drives.ball(True)
    _follow(rig, 0.04)
    rig.drives.ball(False)
    _follow(rig, 0.2)
    assert rig.events == [], "the ball only bounced"
    rig.drives.ball(True)
    _follow(rig, 0.2)
    assert rig.events == ["ball_caught"]
    _follow(rig, 0.2)
    assert rig.events == ["ball_caught"]


def test_strategies_get_their_parameters_from_the_command(rig: Any) -> None:
    rig.arm.command(
        rig.now, {"do": "follow", "strategy": "tilted", "tilt": 0.2, "depths": [0.06, 0.09]}
    )
    for cycle in range(100):
        if cycle % 5 == 0:
            rig.feed(_point(0.0, 2.0 - cycle * CYCLE))
        rig.tick()
    plan = rig.arm.state()["plan"]
    assert plan["axis"][2] == pytest.approx(math.cos(0.2))
    assert min(abs(0.62 - plan["point"][2] - depth) for depth in (0.06, 0.09)) < 1e-9


WORLD = st.lists(
    st.tuples(
        st.one_of(
            st.builds(
                lambda y: {"do": "move", "pose": y}, st.sampled_from(["home", "empty", "ready"])
            ),
            st.just({"do": "hold"}),
            st.builds(
                lambda name: {"do": "follow", "strategy": name},
                st.sampled_from(["tilted", "upright"]),
            ),
            st.just({"do": "move", "pose": [9.0] * 6}),
        ),
        st.lists(st.floats(-3.0, 3.0, allow_nan=False), min_size=9, max_size=9),
        st.integers(1, 40),
    ),
    min_size=1,
    max_size=8,
)


TURNING_BACK: list[tuple[Any, list[float], int]] = [
    ({"do": "hold"}, [0.0] * 9, 53),
    ({"do": "move", "pose": "home"}, [0.0] * 9, 9),
    ({"do": "move", "pose": "ready"}, [0.0] * 9, 86),
]
"""Slowly along the table and back: each step could stop where nothing was touched, but the steps
between touched the table."""


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=WORLD)
@example(steps=TURNING_BACK)
def test_limits_hold_for_any_commands_and_streams(
    make_rig: Any, steps: list[tuple[Any, list[float], int]]
) -> None:
    rig = make_rig().enable()
    for body, values, cycles in steps:
        try:
            rig.arm.command(rig.now, body)
        except ValueError:
            assert body["do"] == "move"
        for cycle in range(cycles):
            if cycle % 5 == 0:
                rig.feed(values)
            rig.tick()
    _check_limits(rig)
    assert rig.arm.state()["stale_executed"] == 0
    assert rig.arm.state()["faults"] == []
    assert all(TOUCH.violation(q) == "" for q in rig.commanded)
