"""Choice of catching poses: the cup is where the ball will be, in time, clear of the table, and
without jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.services.motion.interception import STRATEGIES, CatchPlan, Interceptor, Prediction
from petrobot.services.motion.kinematics import Puma, branch_of
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import nominal_arm, nominal_cell
from petrobot.services.motion.trajectory import reach_time

ARM, CELL = nominal_arm(), nominal_cell()
PUMA = Puma.of(ARM)
GUARD = CollisionGuard(PUMA, ARM, CELL)
HOME = ARM.poses["home"]
INTERCEPTOR = Interceptor(PUMA, CELL, GUARD, HOME, branch_of(PUMA, np.array(HOME)))
STILL = (0.0,) * 6
SPEED, ACCELERATION = ARM.speed.tolist(), ARM.acceleration.tolist()


def _exit(
    y: float, speed: float, heading: float, time_to_go: float = 0.5, sigma_y: float = 0.0
) -> Prediction:
    """Return a ball that leaves the edge at `y` with a heading of `heading` rad from straight."""
    velocity = (-speed * math.cos(heading), speed * math.sin(heading), 0.0)
    return Prediction(
        time_to_go, (CELL.near_edge, y, CELL.table_top + CELL.ball_radius), velocity, sigma_y, 0.0
    )


def _plan(
    prediction: Prediction, strategy: str = "tilted", before: CatchPlan | None = None
) -> CatchPlan | None:
    return INTERCEPTOR.plan(
        STRATEGIES[strategy], prediction, HOME, STILL, SPEED, ACCELERATION, before
    )


THROWS = st.builds(_exit, st.floats(-0.3, 0.3), st.floats(0.4, 2.45), st.floats(-0.2, 0.2))


@settings(max_examples=60)
@given(THROWS, st.sampled_from(["tilted", "upright"]))
def test_every_nominal_ball_has_a_reachable_pose_on_its_path(
    prediction: Prediction, strategy: str
) -> None:
    plan = _plan(prediction, strategy)
    assert plan is not None
    pose = PUMA.forward(np.array(plan.q))
    mouth, axis = pose[:3, :3] @ CELL.cup.mouth + pose[:3, 3], pose[:3, :3] @ CELL.cup.axis
    assert np.allclose(mouth, plan.point, atol=1e-9)
    assert np.allclose(axis, plan.axis, atol=1e-9)
    # The point lies on the ball's parabola at the time of arrival.
    fall = plan.arrival - prediction.time_to_go
    x, y, z = prediction.point
    vx, vy, _ = prediction.velocity
    assert np.allclose(
        plan.point, (x + vx * fall, y + vy * fall, z - 0.5 * CELL.gravity * fall**2), atol=1e-9
    )
    # The cup is held as the strategy says, against the ball, and the pose is clear and on the arm's
    # own branch.
    assert axis[2] == pytest.approx(math.cos(STRATEGIES[strategy].tilt))
    assert axis[0] * vx + axis[1] * vy <= 1e-12
    assert GUARD.violation(plan.q) == ""
    assert branch_of(PUMA, np.array(plan.q)) == branch_of(PUMA, np.array(HOME))
    # Times are those of the trajectory generator.
    assert plan.reach == pytest.approx(
        float(reach_time(np.subtract(plan.q, HOME), np.zeros(6), ARM.speed, ARM.acceleration).max())
    )
    assert plan.slack == pytest.approx(
        plan.arrival - plan.reach - min(plan.reach / 0.05, 1.0) * STRATEGIES[strategy].margin
    )


@settings(max_examples=60)
@given(THROWS, st.floats(-0.001, 0.001), st.floats(-0.005, 0.005))
def test_small_changes_of_the_prediction_move_the_pose_a_little(
    prediction: Prediction, dy: float, dv: float
) -> None:
    first = _plan(prediction)
    assert first is not None
    x, y, z = prediction.point
    vx, vy, vz = prediction.velocity
    changed = replace(prediction, point=(x, y + dy, z), velocity=(vx * (1 + dv), vy, vz))
    second = _plan(changed, before=first)
    assert second is not None
    if second.candidate == first.candidate:
        assert np.abs(np.subtract(second.q, first.q)).max() < 0.05
        return
    # Another candidate is taken only where limits or guard forbid the old one now, or have
    # forbidden the new one before.
    assert _alone(first.candidate, changed) is None or _alone(second.candidate, prediction) is None


def _alone(candidate: int, prediction: Prediction) -> CatchPlan | None:
    """Return the plan if there were no other candidate."""
    strategy = STRATEGIES["tilted"]
    depth, hand = divmod(candidate, len(strategy.hands))
    alone = replace(strategy, depths=(strategy.depths[depth],), hands=(strategy.hands[hand],))
    return INTERCEPTOR.plan(alone, prediction, HOME, STILL, SPEED, ACCELERATION)


@pytest.mark.parametrize("strategy", ["tilted", "upright"])
def test_a_cup_in_place_stays_there_until_the_ball_arrives(strategy: str) -> None:
    far = _plan(_exit(0.1, 1.2, 0.0, time_to_go=1.0), strategy)
    assert far is not None
    for time_to_go in (0.5, 0.2, 0.05, 0.0, 0.04 - far.arrival + 1.0):
        near = INTERCEPTOR.plan(
            STRATEGIES[strategy],
            _exit(0.1, 1.2, 0.0, time_to_go),
            far.q,
            STILL,
            SPEED,
            ACCELERATION,
            far,
        )
        assert near is not None
        assert near.candidate == far.candidate


def test_a_late_ball_is_met_where_the_delay_is_smallest() -> None:
    late = _plan(_exit(0.3, 2.4, 0.0, time_to_go=0.0))
    assert late is not None
    assert late.slack < 0.0
    slow = _plan(_exit(0.3, 2.4, 0.0, time_to_go=2.0))
    assert slow is not None
    assert late.reach <= slow.reach + 1e-9


def test_coarse_predictions_move_the_arm_only_a_part_of_the_way() -> None:
    sure, unsure = _plan(_exit(0.2, 1.5, 0.0)), _plan(_exit(0.2, 1.5, 0.0, sigma_y=0.17))
    assert sure is not None
    assert unsure is not None
    assert sure.point[1] == pytest.approx(0.2)
    assert unsure.point[1] == pytest.approx(0.1)


def test_a_ball_out_of_reach_has_no_plan() -> None:
    assert _plan(_exit(1.2, 1.5, 0.0)) is None


def test_a_set_point_ages_until_it_is_used() -> None:
    prediction = Prediction.parse([0.5, 0.62, 0.1, 0.62, -1.0, 0.0, 0.0, 0.003, 0.01], age=0.02)
    assert prediction.time_to_go == pytest.approx(0.48)
    assert prediction.sigma_y == 0.003


@pytest.mark.parametrize(
    "values",
    [
        [0.5] * 8,
        [0.5, 0.62, 0.1, 0.62, 1.0, 0.0, 0.0, 0.003, 0.01],
        [0.5, 0.62, math.nan, 0.62, -1.0, 0.0, 0.0, 0.003, 0.01],
        [0.5, 0.62, 0.1, 0.62, -1.0, 0.0, 0.0, -0.003, 0.01],
    ],
)
def test_malformed_catch_points_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="catch point: expected"):
        Prediction.parse(values)


def test_a_cup_along_the_flange_is_refused() -> None:
    cup = replace(CELL.cup, axis=(0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="expected an axis across"):
        Interceptor(PUMA, replace(CELL, cup=cup), GUARD, HOME, branch_of(PUMA, np.array(HOME)))
