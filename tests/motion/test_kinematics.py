"""Kinematics against two independent implementations, and as properties."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.motion.kinematics import BRANCHES, Puma, branch_of
from petrobot.services.motion.model import nominal_arm

GOLDEN: dict[str, Any] = json.loads(
    Path(__file__).with_name("puma560_golden.json").read_text(encoding="utf-8")
)
MODEL = nominal_arm()
PUMA = Puma.of(MODEL)
ANGLES = st.tuples(
    *(
        st.floats(low, high)
        for low, high in zip(MODEL.lower.tolist(), MODEL.upper.tolist(), strict=True)
    )
)


def test_forward_agrees_with_the_robotics_toolbox() -> None:
    q = np.array([case["q"] for case in GOLDEN["cases"]])
    expected = np.array([case["pose"] for case in GOLDEN["cases"]])
    assert np.abs(PUMA.forward(q) - expected).max() < 1e-6


def _urdf() -> str:
    """Return the arm as URDF: the joint of DH row i rotates about z of frame i - 1, followed by
    Tz(d) Tx(a) Rx(alpha)."""
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    parts = [f'<link name="l{number}">{inertial}</link>' for number in range(8)]
    xyz, roll = "0 0 0", 0.0
    for number in range(6):
        parts.append(
            f'<joint name="j{number}" type="continuous"><parent link="l{number}"/><child '
            f'link="l{number + 1}"/>'
            f'<origin xyz="{xyz}" rpy="{roll!r} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        xyz, roll = (
            f"{float(MODEL.a[number])!r} 0 {float(MODEL.d[number])!r}",
            float(MODEL.alpha[number]),
        )
    parts.append(
        '<joint name="flange" type="fixed"><parent link="l6"/><child link="l7"/><origin '
        f'xyz="{xyz}" rpy="{roll!r} 0 0"/></joint>'
    )
    return f'<robot name="puma">{"".join(parts)}</robot>'


def test_forward_agrees_with_pybullet(tmp_path: Path) -> None:
    pybullet = pytest.importorskip("pybullet", exc_type=ImportError)
    file = tmp_path / "puma.urdf"
    file.write_text(_urdf(), encoding="utf-8")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(file), useFixedBase=True, physicsClientId=client)
        for case in GOLDEN["cases"]:
            for joint, angle in enumerate(case["q"]):
                pybullet.resetJointState(body, joint, angle, physicsClientId=client)
            state = pybullet.getLinkState(
                body, 6, computeForwardKinematics=1, physicsClientId=client
            )
            pose = PUMA.forward(np.array(case["q"]))
            assert np.abs(np.array(state[4]) - pose[:3, 3]).max() < 1e-6
            turn = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            assert np.abs(turn - pose[:3, :3]).max() < 1e-6
    finally:
        pybullet.disconnect(client)


@given(ANGLES)
def test_every_solution_reaches_the_pose_within_the_limits(angles: tuple[float, ...]) -> None:
    pose = PUMA.forward(np.array(angles))
    for q, branch in zip(PUMA.inverse(pose), BRANCHES, strict=True):
        if np.isnan(q).any():
            continue
        assert np.all(q >= PUMA.lower - 1e-8)
        assert np.all(q <= PUMA.upper + 1e-8)
        assert np.abs(PUMA.forward(q) - pose).max() < 1e-7
        if abs(math.sin(q[4])) > 1e-6:
            assert branch_of(PUMA, q).wrist == branch.wrist


@given(ANGLES)
def test_the_original_joint_angles_are_among_the_solutions(angles: tuple[float, ...]) -> None:
    q = np.array(angles)
    planar = PUMA.forward(q)[:2, 3]
    stretched = abs(math.sin(q[2] + math.atan2(PUMA.d4, PUMA.a3)))
    over_axis = abs(math.hypot(*planar) - PUMA.d3)
    if abs(math.sin(q[4])) < 1e-3 or stretched < 1e-3 or over_axis < 1e-3:
        return  # At a singularity neighbouring solutions coincide.
    solutions = PUMA.inverse(PUMA.forward(q), near=q)
    mine = solutions[BRANCHES.index(branch_of(PUMA, q))]
    assert np.abs(mine - q).max() < 1e-6


def test_there_are_eight_different_solutions() -> None:
    """Without joint limits, a pose inside the workspace has eight different solutions."""
    free = Puma(
        PUMA.d1, PUMA.a2, PUMA.a3, PUMA.d3, PUMA.d4, np.full(6, -math.pi), np.full(6, math.pi)
    )
    q = np.array([0.3, 0.6, -2.4, 0.4, 0.8, -0.5])
    solutions = free.inverse(free.forward(q))
    assert not np.isnan(solutions).any()
    assert np.abs(free.forward(solutions) - free.forward(q)).max() < 1e-9
    wrapped = np.round((solutions + math.pi) % (2 * math.pi), 6)
    assert len({tuple(row) for row in wrapped.tolist()}) == 8
    for solution, branch in zip(solutions, BRANCHES, strict=True):
        assert branch_of(free, solution) == branch


@pytest.mark.parametrize("near", [0.0, 0.7, -1.1])
def test_at_the_wrist_singularity_q4_is_kept(near: float) -> None:
    q = np.array([0.2, 0.8, -2.5, near, 0.0, 0.3])
    solution = PUMA.inverse(PUMA.forward(q), (branch_of(PUMA, q),), near=q)[0]
    assert np.abs(solution - q).max() < 1e-9


def test_out_of_reach_and_over_the_shoulder_axis_have_no_solution() -> None:
    far = np.eye(4)
    far[:3, 3] = (2.0, 0.0, 0.6)
    assert np.isnan(PUMA.inverse(far)).all()
    near = np.eye(4)
    near[:3, 3] = (0.0, 0.05, 1.0)
    assert np.isnan(PUMA.inverse(near)).all()


def test_batches_equal_single_poses() -> None:
    q = np.array([case["q"] for case in GOLDEN["cases"][:12]])
    poses = PUMA.forward(q.reshape(3, 4, 6))
    assert poses.shape == (3, 4, 4, 4)
    together = PUMA.inverse(poses)
    assert together.shape == (3, 4, 8, 6)
    for index in np.ndindex(3, 4):
        np.testing.assert_array_equal(together[index], PUMA.inverse(poses[index]))
