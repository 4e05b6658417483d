"""The ball's closed forms against the equations of motion."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, strategies as st

from petrobot.sim.catching.ball import BallModel, BallState, TableMotion, UnevenMotion, fly

MODEL = BallModel(radius=0.02, mass=0.0027, inertia_factor=2.0 / 3.0, gravity=9.81, friction=0.2)
RESISTANCE = 0.006

speeds = st.floats(-3.0, 3.0)
spins = st.floats(-150.0, 150.0)
starts = st.builds(
    lambda vx, vy, wx, wy: BallState((2.0, 0.1, 0.62), (vx, vy, 0.0), (wx, wy, 3.0)),
    speeds,
    speeds,
    spins,
    spins,
)


def rolling(speed: float, share: float = 1.0) -> TableMotion:
    start = BallState((0.0, 0.0, 0.02), (speed, 0.0, 0.0), MODEL.spin_of_rolling(speed, 0.0, share))
    return TableMotion(MODEL, start, RESISTANCE)


def test_a_rolling_ball_loses_59_mm_per_second_each_second() -> None:
    motion = rolling(1.5)
    assert motion.rolls_after == 0.0
    assert motion.state(0.0).velocity[0] - motion.state(1.0).velocity[0] == pytest.approx(
        0.0589, abs=5e-5
    )


@pytest.mark.parametrize(("share", "settles"), [(0.0, 0.6), (0.7, 0.88), (1.0, 1.0)])
def test_the_final_speed_of_a_sliding_ball(share: float, settles: float) -> None:
    """A hollow ball without spin ends up rolling at 3/5 of its speed: angular momentum about the
    contact point is conserved."""
    motion = rolling(2.0, share)
    assert motion.state(motion.rolls_after).velocity[0] == pytest.approx(settles * 2.0)


@given(start=starts)
def test_angular_momentum_about_the_contact_line_is_conserved_while_sliding(
    start: BallState,
) -> None:
    motion = TableMotion(MODEL, start, RESISTANCE)
    inertia = MODEL.inertia_factor * MODEL.radius

    def momentum(state: BallState) -> tuple[float, float]:
        return state.velocity[0] + inertia * state.spin[1], state.velocity[
            1
        ] - inertia * state.spin[0]

    for share in (0.25, 0.5, 0.999):
        assert momentum(motion.state(share * motion.rolls_after)) == pytest.approx(
            momentum(start), abs=1e-9
        )


@given(start=starts)
def test_sliding_ends_in_rolling(start: BallState) -> None:
    motion = TableMotion(MODEL, start, RESISTANCE)
    (vx, vy, _), (wx, wy, _) = motion.state(motion.rolls_after + 1e-12)[1:]
    assert (vx, vy) == pytest.approx((MODEL.radius * wy, -MODEL.radius * wx), abs=1e-9)


@given(start=starts, moment=st.floats(0.0, 1.2))
def test_velocity_is_the_derivative_of_position(start: BallState, moment: float) -> None:
    motion, step = TableMotion(MODEL, start, RESISTANCE), 1e-6
    assume(all(abs(moment - edge) > 1e-5 for edge in (motion.rolls_after, motion.rests_after)))
    before, after = motion.state(max(0.0, moment - step)), motion.state(moment + step)
    took = moment + step - max(0.0, moment - step)
    slope = [(b - a) / took for a, b in zip(before.position, after.position, strict=True)]
    assert slope == pytest.approx(motion.state(moment).velocity, abs=1e-4)


@given(start=starts, moment=st.floats(0.0, 5.0))
def test_a_ball_never_gains_energy(start: BallState, moment: float) -> None:
    def energy(state: BallState) -> float:
        spin = sum(w * w for w in state.spin[:2])
        return sum(v * v for v in state.velocity) + MODEL.inertia_factor * MODEL.radius**2 * spin

    motion = TableMotion(MODEL, start, RESISTANCE)
    assert energy(motion.state(moment + 0.01)) <= energy(motion.state(moment)) + 1e-9


@given(start=starts, aim=st.floats(-2.0, 4.0), axis=st.integers(0, 1))
def test_a_crossing_is_found_and_is_the_first(start: BallState, aim: float, axis: int) -> None:
    motion = TableMotion(MODEL, start, RESISTANCE)
    crossing = motion.first_crossing(axis, aim)
    side = math.copysign(1.0, start.position[axis] - aim)
    until = min(crossing, motion.rests_after, 30.0)
    for k in range(50):  # Before it, the ball is strictly on the starting side.
        assert side * (motion.state(0.98 * until * k / 50).position[axis] - aim) > -1e-9
    if crossing < math.inf:
        assert motion.state(crossing).position[axis] == pytest.approx(aim, abs=1e-6)


def even(x: float, y: float) -> tuple[float, float]:
    return 0.0, 0.0


@pytest.mark.parametrize("share", [0.0, 0.7, 1.0, 1.3])
def test_an_uneven_motion_on_an_even_table_is_the_closed_form(share: float) -> None:
    start = BallState((2.1, 0.1, 0.62), (-1.2, 0.3, 0.0), MODEL.spin_of_rolling(-1.2, 0.3, share))
    exact, found = (
        TableMotion(MODEL, start, RESISTANCE),
        UnevenMotion(MODEL, start, RESISTANCE, even),
    )
    for t in (0.0, 0.0123, 0.3, 1.1):
        assert found.state(t).position == pytest.approx(exact.state(t).position, abs=1e-3)
        assert found.state(t).velocity == pytest.approx(exact.state(t).velocity, abs=3e-3)
    for axis, value in ((0, 0.62), (1, 0.3), (0, 9.0)):
        assert found.first_crossing(axis, value) == pytest.approx(
            exact.first_crossing(axis, value), abs=2e-3
        )


@pytest.mark.parametrize("along", [-1.0, 0.5])
def test_a_slope_accelerates_a_rolling_ball_according_to_its_inertia(along: float) -> None:
    """Without rolling resistance the acceleration is s g / (1 + k) downhill, k = 2/3."""
    start = BallState((2.0, 0.0, 0.62), (along, 0.0, 0.0), MODEL.spin_of_rolling(along, 0.0))
    motion = UnevenMotion(MODEL, start, 0.0, lambda x, y: (0.0, 0.003))
    state = motion.state(1.0)
    down = 0.003 * 9.81 / (1.0 + 2.0 / 3.0)
    assert state.velocity == pytest.approx((along, -down, 0.0), abs=1e-4)
    assert state.position == pytest.approx((2.0 + along, -0.5 * down, 0.62), abs=1e-4)


def test_it_comes_to_rest_and_stays() -> None:
    motion = rolling(0.3)
    rest = motion.state(motion.rests_after)
    assert motion.rests_after == pytest.approx(0.3 / (RESISTANCE * 9.81))
    assert rest.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert motion.state(motion.rests_after + 10.0).position == pytest.approx(rest.position)


@given(speeds, speeds, st.floats(0.0, 1.0))
def test_flight_conserves_energy(vx: float, vz: float, t: float) -> None:
    start = BallState((0.0, 0.0, 1.0), (vx, 0.2, vz), (1.0, 2.0, 3.0))
    now = fly(start, t, 9.81)

    def energy(state: BallState) -> float:
        return 0.5 * sum(v * v for v in state.velocity) + 9.81 * state.position[2]

    assert energy(now) == pytest.approx(energy(start)) and now.spin == start.spin
