"""A chain of joints: poses of published arms, and joint positions that reach given ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot import JointChain
from petrobot.services.adapters.ur.arm import MODELS, chain
from petrobot.services.joint_chain import rotation_matrix, rotation_vector
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.model import nominal_arm

HALF = math.pi / 2
SIX = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)
PLANAR: list[dict[str, Any]] = [
    {"name": "one", "limits": [-2.0, 2.0], "axis": [0, 0, 1], "point": [0.0, 0.0, 0.0]},
    {"name": "two", "limits": [-2.0, 2.0], "axis": [0, 0, 3], "point": [0.5, 0.0, 0.0]},
    {
        "name": "lift",
        "limits": [0.0, 0.2],
        "axis": [0, 0, 1],
        "point": [0.8, 0.0, 0.0],
        "slide": True,
    },
]
"""A SCARA without its last joint: links of 0.5 and 0.3 m."""
SCARA = JointChain(PLANAR, (0.8, 0.0, 0.0, 0.0, 0.0, 0.0))


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, 0.2))
def test_a_scara_is_where_trigonometry_has_it(one: float, two: float, lift: float) -> None:
    x = 0.5 * math.cos(one) + 0.3 * math.cos(one + two)
    y = 0.5 * math.sin(one) + 0.3 * math.sin(one + two)
    by_rows = JointChain(
        [
            {"limits": [-2, 2], "a": 0.5},
            {"limits": [-2, 2], "a": 0.3},
            {"limits": [0, 0.2], "slide": True},
        ]
    )
    for arm in (SCARA, by_rows):
        assert arm.point((one, two, lift)) == pytest.approx((x, y, lift))
        turned = rotation_matrix(arm.tool((one, two, lift))[3:])[:2, 0]
        assert turned == pytest.approx((math.cos(one + two), math.sin(one + two)))


@given(SIX)
def test_a_puma_is_that_of_its_closed_form(q: list[float]) -> None:
    model = nominal_arm()
    arm = JointChain(
        {"limits": [-7, 7], "d": float(d), "a": float(a), "alpha": float(alpha)}
        for d, a, alpha in zip(model.d, model.a, model.alpha, strict=True)
    )
    pose, expected = arm.tool(q), Puma.of(model).forward(np.array(q))
    assert pose[:3] == pytest.approx(expected[:3, 3].tolist(), abs=1e-12)
    assert rotation_matrix(pose[3:]) == pytest.approx(expected[:3, :3], abs=1e-7)


@given(SIX, st.sampled_from(sorted(MODELS)))
def test_joints_lead_to_the_pose_near_where_they_are_sought(q: list[float], model: str) -> None:
    arm = chain(model, (0.0, 0.02, 0.15))
    q[2] = math.copysign(max(0.3, abs(q[2])), q[2])  # away from singular poses
    q[4] = math.copysign(max(0.3, abs(q[4])), q[4])
    found = arm.joints(arm.tool(q), [a + 0.02 for a in q], starts=20)
    assert arm.tool(found)[:3] == pytest.approx(arm.tool(q)[:3], abs=1e-6)
    off = rotation_matrix(arm.tool(found)[3:]) @ rotation_matrix(arm.tool(q)[3:]).T
    assert rotation_vector(off) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_a_joint_at_its_limit_stays_there_and_the_others_do_the_rest() -> None:
    tall = JointChain(
        [*PLANAR, {**PLANAR[2], "name": "more", "limits": [0.0, 0.5]}], (0.8, *[0.0] * 5)
    )
    found = tall.joints((*tall.point((0.3, 0.4, 0.2, 0.4)), 0, 0, 0.7), (0.0, 0.1, 0.0, 0.0))
    assert found[:2] == pytest.approx((0.3, 0.4)) and found[2] + found[3] == pytest.approx(0.6)
    assert 0.0 <= found[2] <= 0.2


def test_any_heading_and_joints_that_stay() -> None:
    pose = (*SCARA.point((0.5, -1.0, 0.1)), 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"nearest: \d+\.\d mm and"):
        SCARA.joints(pose, (0.1, -0.5, 0.0), starts=5)  # its direction is another one
    near = (0.1, -0.5, 0.0)
    assert SCARA.joints(pose, near, any_heading=True) == pytest.approx((0.5, -1.0, 0.1))
    with pytest.raises(ValueError, match="no joint positions"):
        SCARA.joints(pose, near, any_heading=True, keep=("two",), starts=5)


def test_a_line_is_straight_and_says_where_it_cannot_go_on() -> None:
    arm, begin = chain("ur5e"), [0.1, -1.5, 1.6, -1.7, -1.5, 0.2]
    start = arm.tool(begin)
    goal = [start[0] - 0.1, start[1] + 0.05, start[2] - 0.08, *start[3:]]
    way = arm.line(goal, begin)
    assert way[0] == begin and arm.point(way[-1]) == pytest.approx(goal[:3], abs=1e-6)
    line = np.array(goal[:3]) - start[:3]
    for q in way:
        off = np.cross(np.array(arm.point(q)) - start[:3], line) / np.linalg.norm(line)
        assert np.linalg.norm(off) < 1e-6
    with pytest.raises(ValueError, match="the tool cannot pass x = "):
        arm.line([start[0], start[1], start[2] + 1.5, *start[3:]], begin)


@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3))
def test_rotation_vectors_and_matrices_are_inverse(vector: list[float]) -> None:
    assert rotation_vector(rotation_matrix(vector)) == pytest.approx(vector, abs=1e-7)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8)])
def test_half_a_turn_has_a_vector(axis: tuple[float, ...]) -> None:
    found = rotation_vector(rotation_matrix([math.pi * part for part in axis]))
    assert abs(float(found @ axis)) == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ({"limits": [1, -1]}, "two: expected limits"),
        ({"name": "one"}, "each name once"),
        ({"axis": [0, 0, 0]}, "two.axis: expected a direction"),
        ({"point": [0, 0]}, "two.point: expected 3 finite numbers"),
        ({"alhpa": 0.1}, r"two: unknown keys \['alhpa'\]; expected axis and point, or d"),
        ({"limits": None}, "two.limits: expected 2"),
    ],
)
def test_a_wrong_row_is_refused_by_name_and_key(row: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        JointChain([PLANAR[0], {**PLANAR[1], **row}])


def test_an_arm_without_joints_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a row for each joint"):
        JointChain([])


def test_the_arms_of_the_page_are_arms() -> None:
    page = (Path(__file__).parents[2] / "docs/robots/own-arm.md").read_text(encoding="utf-8")
    made: dict[str, Any] = {}
    exec(page.split("```python\n")[1].split("```")[0], made)  # noqa: S102 - our own page
    for name, q in (("ARM", (0.3, 0.8, -1.1)), ("SCARA", (0.3, -0.8, 0.1))):
        arm: JointChain = made[name]
        found = arm.joints(arm.tool(q), [value + 0.1 for value in q])
        assert arm.point(found) == pytest.approx(arm.point(q), abs=1e-6)
