"""The numbers of cell and arms: forward and inverse kinematics, and messages about bad files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from petrobot import JointChain
from petrobot.services.adapters.so101.arm import CHAIN
from petrobot.services.adapters.ur.arm import chain
from petrobot.services.joint_chain import rotation_matrix
from petrobot.services.picking.model import (
    NumbersError,
    OutOfReachError,
    arm_named,
    cell_named,
    read_arm,
    read_cell,
)
from petrobot.sim.picking.gripper import true_arm
from tests.sim.picking.bench import FILES, site

ARMS = ["so101", "ur5e"]
ANGLE = st.floats(-1.5, 1.5)


@settings(max_examples=20, deadline=None)
@given(arm=st.sampled_from(ARMS), x=st.floats(0.125, 0.205), y=st.floats(-0.095, 0.095),
       z=st.floats(0.004, 0.065), turn=st.floats(-3.0, 3.0))  # fmt: skip
@example(arm="so101", x=0.173828125, y=0.0, z=0.015625, turn=0.0)  # a singular pose on the way
def test_over_and_tool_are_inverse_wherever_parts_lie(
    arm: str, x: float, y: float, z: float, turn: float
) -> None:
    numbers = arm_named(arm)
    joints = numbers.over(x, y, z, turn)
    pose = numbers.chain.tool(joints)
    closing, _, approach = rotation_matrix(pose[3:]).T
    assert math.dist(pose[:3], (x, y, z)) < 1e-6
    assert approach[2] < -0.999999
    assert abs(math.remainder(math.atan2(closing[1], closing[0]) - turn, math.pi)) < 1e-5
    limits = numbers.chain.limits.values()
    assert all(low <= q <= high for q, (low, high) in zip(joints, limits, strict=True))


@pytest.mark.parametrize("arm", ARMS)
def test_every_slot_can_be_reached(arm: str) -> None:
    numbers = arm_named(arm)
    for tray in cell_named().trays.values():
        for slot in tray.slots:
            for z in (0.004, 0.065):
                tip = numbers.chain.point(numbers.over(*slot, z, 0.0))
                assert math.dist(tip, (*slot, z)) < 1e-6


@pytest.mark.parametrize(
    ("arm", "own", "off"), [("so101", CHAIN, 2e-4), ("ur5e", chain("ur5e", (0.0, 0.0, 0.15)), 1e-6)]
)
@given(joints=st.lists(ANGLE, min_size=6, max_size=6))
def test_each_arm_is_the_one_of_its_adapter(
    arm: str, own: JointChain, off: float, joints: list[float]
) -> None:
    numbers = arm_named(arm)
    joints = joints[: len(own.limits)]
    x, y, z = own.point(joints)
    base = math.pi if arm == "ur5e" else 0.0  # as it is turned on its table
    seen = x * math.cos(base) + numbers.foot[0], y * math.cos(base) + numbers.foot[1], z
    assert math.dist(numbers.chain.point(joints), seen) < off


@settings(max_examples=20, deadline=None)
@pytest.mark.parametrize("arm", ARMS)
@given(joints=st.lists(ANGLE, min_size=6, max_size=6))
def test_the_laboratory_has_the_same_arm_but_for_its_errors(arm: str, joints: list[float]) -> None:
    numbers = arm_named(arm)
    joints = joints[: len(numbers.chain.limits)]
    errors = dict.fromkeys(("base", "base_z", "base_yaw", "joint_zero"), 0.0)
    exact = true_arm(site(arm).numbers, errors, np.random.default_rng(0))
    assert math.dist(numbers.chain.point(joints), exact.tool(joints)[:3]) < 1e-9
    away = math.dist(numbers.chain.point(joints), site(arm).arm().tool(joints)[:3])
    assert 1e-4 < away < 0.02


def test_a_point_out_of_reach_is_refused() -> None:
    with pytest.raises(OutOfReachError, match=r"so101 cannot reach x 0\.600"):
        arm_named("so101").over(0.6, 0.0, 0.02, 0.0)


@pytest.mark.parametrize(
    ("name", "old", "new", "text"),
    [
        ("so101", "[gripper]", "[fingers]", "so101.toml: key 'gripper' is missing"),
        ("so101", "rest = [0.0, ", "rest = [", "poses.rest: expected 5 joint angles"),
        ("cell", 'shape = "round"', 'shape = "ball"', "expected box or round, found 'ball'"),
        ("cell", 'tray = "boxes"', 'tray = "bin"', "expected boxes or rounds, found 'bin'"),
        ("cell", "[camera]", "[camera", "cell.toml:10: not valid TOML: "),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_key(
    name: str, old: str, new: str, text: str
) -> None:
    read = read_cell if name == "cell" else read_arm
    content = Path(FILES / f"{name}.toml").read_text()
    assert old in content
    with pytest.raises(NumbersError, match=text.replace(".", r"\.")):
        read(content.replace(old, new), f"{name}.toml")


def test_a_missing_file_is_refused() -> None:
    with pytest.raises(NumbersError, match="name a shipped file"):
        arm_named("no_such_arm")


def test_pixel_and_point_are_inverse() -> None:
    eye = cell_named().eye
    for x, y, z in ((0.1, 0.05, 0.0), (0.2, -0.1, 0.03)):
        assert eye.point(*eye.pixel(x, y, z), z) == pytest.approx((x, y))
