"""Kinematics of the SO-101 against the transformations of its published URDF."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from petrobot.services.adapters.so101.kinematics import CHAIN, JOINTS, inverse
from petrobot.services.joint_chain import rotation_matrix

HALF = math.pi / 2
URDF = [
    ((0.0207909, -0.0230745, 0.0948817), (-math.pi, 0, HALF)),
    ((-0.0303992, -0.0182778, -0.0542), (-HALF, -HALF, 0)),
    ((-0.11257, -0.028, 0), (0, 0, HALF)),
    ((-0.1349, 0.0052, 0), (0, 0, -HALF)),
    ((0, -0.0611, 0.0181), (HALF, 0, math.pi)),
]
"""Origins (m, roll-pitch-yaw) of the joints, each after the one before; all turn about their z."""
TIP = ((-0.0079, -0.000218121, -0.0981274), (HALF, 0, HALF))
angles = st.tuples(*(st.floats(low, high) for low, high in list(JOINTS.values())[:5]))


def matrix(place: Any, turn: Any) -> Any:
    (cr, cp, cy), (sr, sp, sy) = np.cos(turn), np.sin(turn)
    about_x = [[1, 0, 0], [0, cr, -sr], [0, sr, cr]]
    about_y = [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    about_z = [[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]
    whole = np.eye(4)
    whole[:3, :3] = np.array(about_z) @ np.array(about_y) @ np.array(about_x)
    whole[:3, 3] = place
    return whole


@given(angles)
def test_the_tip_is_where_the_urdf_has_it(q: Any) -> None:
    pose = np.eye(4)
    for origin, angle in zip(URDF, q, strict=True):
        pose = pose @ matrix(*origin) @ matrix((0, 0, 0), (0, 0, angle))
    roll_axis = -pose[:3, 2]  # from the wrist to the tip
    x, y, z = (pose @ matrix(*TIP))[:3, 3]
    pan = URDF[0][0]
    expected = -(y - pan[1]), x - pan[0], z  # forward is the URDF's -y
    tip = CHAIN.tool(q)
    assert tip[:3] == pytest.approx(expected, abs=2e-6)
    assert rotation_matrix(tip[3:])[2, 0] == pytest.approx(roll_axis[2], abs=2e-5)


@given(angles)
def test_inverse_gives_angles_that_bring_the_tip_there(q: Any) -> None:
    tip, pitch = CHAIN.point(q), -sum(q[1:4])
    x, y, z = tip
    found = inverse(x, y, z, pitch, q[4])
    assert CHAIN.point(found) == pytest.approx(tip, abs=1e-6) and found[4] == q[4]
    assert math.remainder(-sum(found[1:4]) - pitch, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    for (low, high), angle in zip(JOINTS.values(), found, strict=False):
        assert low <= angle <= high


def test_a_point_in_front_is_reached_with_the_elbow_up() -> None:
    pan, lift, elbow, *_ = inverse(0.2, -0.1, 0.05, -HALF, 0.3)
    assert pan == pytest.approx(math.atan2(0.1, 0.2), abs=0.02)
    # stretched out: the forearm lies 1.288 rad above its direction at zero
    assert -HALF < lift < HALF and elbow > -1.288


@pytest.mark.parametrize(
    ("x", "z", "roll", "words"),
    [
        (0.6, 0.1, 0.0, "no joint positions.* mm and"),
        (0.0, 0.1, 0.0, "no joint positions"),
        (-0.25, 0.05, 0.0, "no joint positions"),
        (0.2, 0.05, 3.0, "roll: expected -2.793 to 2.793 rad"),
    ],
)
def test_what_cannot_be_reached_is_refused_in_words(
    x: float, z: float, roll: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        inverse(x, 0.0, z, -HALF, roll)
