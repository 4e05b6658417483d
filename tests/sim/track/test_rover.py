"""The rover's body against closed forms: lag, arcs, slip, battery."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.sim.track.course import FloorPose
from petrobot.sim.track.rover import RoverBody
from petrobot.sim.track.truth import RoverTruth, TrackSite, WheelTruth

SETTINGS = {
    "placed": 0.0,
    "placed_heading": 0.0,
    "brake_lag": 0.02,
    "friction": 1.2,
    "inertia": 0.12,
    "rated_torque": 8.0,
    "electronics": 30.0,
}
IDEAL = RoverTruth(
    wheels=(WheelTruth(0.1, 0.06), WheelTruth(0.1, 0.06)),
    track_width=0.4,
    top_speed=12.0,
    nominal_voltage=24.0,
    acceleration=20.0,
    encoder_counts=20_000,
    slip=0.0,
    slip_time=0.2,
    slip_aside=0.0,
    slip_turn=0.0,
    battery=(24.0, 0.0, 0.0),
    settings=SETTINGS,
)


ORIGIN = FloorPose(0.0, 0.0, 0.0)


def rover(pose: FloorPose = ORIGIN, seed: int = 1, **changes: Any) -> RoverBody:
    rng = np.random.default_rng(seed)
    made = RoverBody(replace(IDEAL, **changes), rng)
    made.place(made.truth, pose, rng)
    return made


def command(body: RoverBody, left: float, right: float) -> None:
    """Set the wheels' speeds (rad/s), brakes off."""
    for wheel, target in zip(body.wheels, (left, right), strict=True):
        wheel.braked, wheel.target = False, target


def settled(body: RoverBody, left: float, right: float) -> None:
    """Set the wheels' speeds as if they turned at them already."""
    command(body, left, right)
    for wheel in body.wheels:
        wheel.speed = wheel.target


speeds = st.floats(-8.0, 8.0)


@given(speeds, speeds, st.floats(0.1, 5.0), st.floats(-3.0, 3.0))
@settings(max_examples=80, deadline=None)
def test_constant_wheel_speeds_give_a_circular_arc(
    left: float, right: float, time: float, heading: float
) -> None:
    body = rover(FloorPose(1.0, 2.0, heading))
    settled(body, left, right)
    body.move_to(time)
    v, w = 0.05 * (left + right), 0.1 * (right - left) / 0.4
    turned = w * time
    chord = v * time * (math.sin(0.5 * turned) / (0.5 * turned) if abs(turned) > 1e-9 else 1.0)
    assert body.heading == pytest.approx(heading + turned, abs=1e-9)
    assert body.x == pytest.approx(1.0 + chord * math.cos(heading + 0.5 * turned), abs=2e-4)
    assert body.y == pytest.approx(2.0 + chord * math.sin(heading + 0.5 * turned), abs=2e-4)
    assert (body.speed, body.turn) == pytest.approx((v, w), abs=1e-9)


@given(speeds, st.floats(0.001, 0.5))
@settings(max_examples=60, deadline=None)
def test_a_wheel_follows_with_its_lag(target: float, time: float) -> None:
    body = rover()
    command(body, target, target)
    body.move_to(time)
    fall = math.exp(-time / 0.06)
    assert body.wheels[0].speed == pytest.approx(target * (1.0 - fall), abs=1e-5)
    assert body.wheels[0].angle == pytest.approx(target * (time - 0.06 * (1.0 - fall)), abs=1e-6)


@given(st.lists(st.floats(0.001, 0.09), min_size=1, max_size=30))
@settings(max_examples=40, deadline=None)
def test_the_rate_of_queries_hardly_changes_the_motion(pauses: list[float]) -> None:
    """Where the rover is depends on when it is looked at by rounding of the arcs alone, and by when
    it is first seen that a wheel is nearer to its set point than what counts as there (1e-6 rad/s,
    so less than that times its lag)."""
    often, once = (rover(slip=0.02, slip_aside=0.01, slip_turn=0.02, seed=3) for _ in range(2))
    for body in (often, once):
        command(body, 3.0, 6.0)
    now = 0.0
    for pause in pauses:
        now += pause
        often.move_to(now)
    once.move_to(now)
    assert often.wheels[1].angle == pytest.approx(once.wheels[1].angle, abs=1e-7)
    assert (often.x, often.y, often.heading) == pytest.approx(
        (once.x, once.y, once.heading), abs=2e-4
    )


def test_brakes_hold() -> None:
    body = rover()
    settled(body, 5.0, 5.0)
    for wheel in body.wheels:
        wheel.braked = True
    body.move_to(0.3)
    assert body.standing
    assert body.x == pytest.approx(0.5 * 0.02, abs=1e-3)  # 0.5 m/s times the brakes' lag
    x = body.x
    body.move_to(2.0)
    assert (body.x, body.speed) == (x, 0.0)


def test_skidding_reduces_the_turn_and_pushes_outwards() -> None:
    firm, skidding = rover(), rover(slip_aside=0.06, slip_turn=0.12)
    for body in (firm, skidding):
        settled(body, 4.0, 6.0)
        body.move_to(math.pi)
    lateral = 0.5 * 0.5
    assert firm.heading == pytest.approx(0.5 * math.pi)
    assert skidding.heading == pytest.approx(0.5 * math.pi / (1.0 + 0.12 * lateral), rel=1e-6)
    assert skidding.x > firm.x + 0.02
    right_turn = rover(slip_aside=0.06)
    settled(right_turn, 6.0, 4.0)
    right_turn.move_to(0.5)
    plain = rover()
    settled(plain, 6.0, 4.0)
    plain.move_to(0.5)
    assert right_turn.y > plain.y  # outwards of a right turn is to the left


def test_slip_has_the_configured_spread_and_correlation_time() -> None:
    body = rover(slip=0.02, slip_time=0.2)
    settled(body, 5.0, 5.0)
    ways, last = [], 0.0
    for slot in range(1, 8001):
        body.move_to(0.02 * slot)
        ways.append(body.x - last if abs(body.heading) < 0.5 else math.nan)
        last = body.x
        body.heading, body.y = 0.0, 0.0
    slips = 1.0 - np.array(ways) / 0.01
    assert np.nanstd(slips) == pytest.approx(
        0.02 / math.sqrt(2.0), rel=0.15
    )  # the mean of two wheels
    kept = np.corrcoef(slips[:-10], slips[10:])[0, 1]
    assert kept == pytest.approx(math.exp(-1.0), abs=0.12)


def test_the_battery_sags_with_time_and_load() -> None:
    body = rover(battery=(22.0, 0.05, 0.35))
    body.move_to(10.0)
    idle = body.voltage
    assert idle == pytest.approx(22.0 - 0.5 - 0.35 * 30.0 / 21.0, abs=0.05)
    settled(body, 10.0, 10.0)
    body.move_to(10.5)
    assert body.voltage < idle - 0.2
    assert body.top_speed == pytest.approx(12.0 * body.voltage / 24.0)


def test_a_rover_put_elsewhere_keeps_its_counters() -> None:
    body = rover()
    settled(body, 5.0, 5.0)
    body.move_to(1.0)
    counted = body.wheels[0].angle
    body.place(body.truth, FloorPose(3.0, 4.0, 1.0), np.random.default_rng(2))
    assert body.pose == (3.0, 4.0, 1.0)
    assert body.standing
    assert body.wheels[0].angle == counted == pytest.approx(5.0)


def test_the_same_random_draws_give_the_same_path() -> None:
    def way(seed: int) -> FloorPose:
        body = rover(slip=0.02, seed=seed)
        settled(body, 5.0, 5.2)
        body.move_to(10.0)
        return body.pose

    assert way(4) == way(4)
    assert way(4) != way(5)


def test_the_shipped_truth_is_near_the_nominal_rover(track_site: TrackSite) -> None:
    truth = track_site.truth("straight").rover
    assert all(0.0 < abs(wheel.radius - 0.1) < 0.0015 for wheel in truth.wheels)
    assert 0.0 < abs(truth.track_width - 0.4) < 0.016
    worn = track_site.truth("straight+miscalibrated").rover
    assert worn.wheels[0].radius > truth.wheels[0].radius * 1.014
    assert worn.wheels[1].radius == truth.wheels[1].radius
