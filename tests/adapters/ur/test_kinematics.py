"""The arms' geometry: published poses, and joint angles that reach the given poses."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from petrobot.services.adapters.ur.kinematics import MODELS, Geometry, between

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)


@pytest.mark.parametrize(
    ("model", "place"),
    [
        ("ur3e", (-0.45675, -0.22315, 0.0665)),
        ("ur5e", (-0.8172, -0.2329, 0.0628)),
        ("ur10e", (-1.18425, -0.2907, 0.06085)),
    ],
)
def test_stretched_out_the_flange_is_where_the_pendant_shows_it(
    model: str, place: tuple[float, ...]
) -> None:
    """All joints at zero: sums of the lengths (d1 - d5 above, d4 + d6 aside, a2 + a3 out)."""
    pose = Geometry(model).tool([0.0] * 6)
    assert pose[:3] == pytest.approx(place) and pose[3:] == pytest.approx((math.pi / 2, 0.0, 0.0))


@given(ANGLES, st.sampled_from(sorted(MODELS)))
def test_joints_lead_to_the_pose_near_where_they_are_sought(q: list[float], model: str) -> None:
    arm = Geometry(model, (0.0, 0.02, 0.15))
    q[2] = math.copysign(max(0.3, abs(q[2])), q[2])  # away from singular poses
    q[4] = math.copysign(max(0.3, abs(q[4])), q[4])
    found = arm.joints(arm.tool(q), [a + 0.02 for a in q])
    if found is not None:
        assert arm.tool(found)[:3] == pytest.approx(arm.tool(q)[:3], abs=1e-6)
        assert between(arm.tool(found), arm.tool(q), 0.5)[:3] == pytest.approx(
            arm.tool(q)[:3], abs=1e-6
        )


def test_a_pose_out_of_reach_has_no_joints() -> None:
    assert (
        Geometry("ur3e").joints([2.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, -1.0, 1.0, 0.0, 1.0, 0.0])
        is None
    )


@given(st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_between_turns_about_one_axis(angle: float, share: float) -> None:
    start, end = [0.0] * 6, [1.0, 0.0, 0.0, 0.0, 0.0, angle]
    assert between(start, end, share) == pytest.approx(
        [share, 0.0, 0.0, 0.0, 0.0, share * angle], abs=1e-7
    )
