"""The arm's data: the file is read completely, faults are named, and the torques suffice for the
accelerations."""

from __future__ import annotations

import json
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import (
    ArmFileError,
    nominal_arm,
    nominal_cell,
    read_arm,
    read_cell,
)

ARM = files("petrobot.services.motion").joinpath("puma560.toml").read_text(encoding="utf-8")
CELL = files("petrobot.services").joinpath("cell.toml").read_text(encoding="utf-8")


def test_the_nominal_arm_is_the_published_one() -> None:
    arm = nominal_arm()
    assert np.degrees(arm.speed).round(6).tolist() == [82, 74, 122, 228, 241, 228]
    assert arm.d[0] == pytest.approx(26.45 * 0.0254)
    file = tomllib.loads(ARM)
    assert [joint["torque"] for joint in file["joint"]] == [97.6, 186.4, 89.4, 24.2, 20.1, 21.3]
    assert sum(link["mass"] for link in file["link"]) == pytest.approx(23.45)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "limits = [-160.0, 160.0]",
            "limits = [-160.0]",
            "joint 1: limits: expected a list of 2 numbers",
        ),
        ("speed = 74.0", 'speed = "much"', "joint 2: speed: expected a finite number"),
        ("wrist = 0.055", "", "body: wrist: expected a finite number"),
        ("home = [18.7", "home = [180.0", "poses.home: lies outside the joint limits"),
        (
            "[[joint]]\nd = 0.67183",
            "[[spare]]\nd = 0.67183",
            "expected 6 tables [[joint]], got 5",
        ),
    ],
)
def test_a_bad_arm_is_refused_by_name(old: str, new: str, says: str) -> None:
    assert old in ARM
    with pytest.raises(ArmFileError, match=r"puma560\.toml") as caught:
        read_arm(ARM.replace(old, new, 1))
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[cup]", "[mug]", r"table \[cup\] is missing"),
        ("axis = [-1.0, 0.0, 0.0]", "axis = [-1.0, 0.5, 0.0]", "unit vector"),
        ("near_edge = 0.62", "near_edge = true", "near_edge: expected a finite number"),
    ],
)
def test_a_bad_cell_is_refused_by_name(old: str, new: str, says: str) -> None:
    assert old in CELL
    with pytest.raises(ArmFileError, match=says):
        read_cell(CELL.replace(old, new, 1))


def test_kinematics_refuses_another_arm() -> None:
    with pytest.raises(ValueError, match="PUMA's twists"):
        Puma.of(read_arm(ARM.replace("alpha = -90.0", "alpha = -80.0", 1)))


def test_the_torques_suffice_for_the_accelerations() -> None:
    """With inertia and gravity of the independent model and our friction, all joints at home can
    accelerate at their limits at once, in any combination of signs, at their maximum speeds."""
    golden = json.loads(Path(__file__).with_name("puma560_golden.json").read_text(encoding="utf-8"))
    arm = nominal_arm()
    home = golden["home"]
    assert np.allclose(home["q"], arm.poses["home"], atol=1e-9), (
        "make the fixture again: the home pose has changed"
    )
    torque, gear, coulomb, viscous = (
        np.array([joint[key] for joint in tomllib.loads(ARM)["joint"]])
        for key in ("torque", "gear", "coulomb", "viscous")
    )
    inertia, gravity = np.array(home["inertia"]), np.abs(home["gravity"])
    needed = (
        np.abs(inertia) @ arm.acceleration
        + gravity
        + coulomb * gear
        + viscous * gear**2 * arm.speed
    )
    assert np.all(needed <= torque), (needed / torque).tolist()


def test_named_poses_are_clear_and_the_cup_is_at_the_edge() -> None:
    arm, cell = nominal_arm(), nominal_cell()
    guard = CollisionGuard(Puma.of(arm), arm, cell)
    for name, pose in arm.poses.items():
        assert guard.violation(pose) == "", name
    home, empty = guard.place(arm.poses["home"]), guard.place(arm.poses["empty"])
    assert abs(home.mouth[1]) < 0.005
    assert 0.05 < cell.near_edge - home.mouth[0] < 0.20
    assert home.mouth[2] < cell.table_top
    assert empty.axis[2] < -0.9
