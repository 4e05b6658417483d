"""The joints of the SO-101, and how its gripper is brought to a point.

All lengths are those of Simulation/SO101/so101_new_calib.urdf in TheRobotStudio/SO-ARM100 (m). The
frame here has its origin on the pan axis at the level of the base's origin, x forward, y left and z
up at zero angles, where the gripper points forward.
"""

from __future__ import annotations

import math
from typing import Any, Final

from petrobot import JointChain


def _joint(
    name: str, low: float, high: float, axis: tuple[int, int, int], *point: float
) -> dict[str, Any]:
    return {"name": name, "limits": (low, high), "axis": axis, "point": point}


CHAIN: Final = JointChain(
    [
        _joint("shoulder_pan", -1.91986, 1.91986, (0, 0, -1), 0.0, 0.0, 0.0),
        _joint("shoulder_lift", -1.74533, 1.74533, (0, 1, 0), 0.0303992, 0.0, 0.1490817),
        _joint("elbow_flex", -1.69, 1.69, (0, 1, 0), 0.0583992, 0.0, 0.2616517),
        _joint("wrist_flex", -1.65806, 1.65806, (0, 1, 0), 0.1932992, 0.0, 0.2668517),
        _joint("wrist_roll", -2.79253, 2.79253, (-1, 0, 0), 0.1932992, -0.0001778, 0.2668517),
    ],
    (0.3525266, -0.000395921, 0.2589517, 0.0, 0.0, 0.0),
)
"""The five joints of the arm, and the gripper's tip."""
JOINTS: Final = {**CHAIN.limits, "gripper": (-0.174533, 1.74533)}
"""All joints with their limits (rad), of the same file."""
STARTS: Final = 50
"""Poses from which the angles of a point are sought."""


def inverse(x: float, y: float, z: float, pitch: float, roll: float) -> list[float]:
    """Return five angles that bring the tip there, found from a pose with the elbow up and the arm
    facing the point if that leads there. `pitch` is the gripper's angle above the horizontal,
    `roll` the angle of the joint wrist_roll (rad).

    Raises ValueError if it is out of reach, or only with angles outside `JOINTS`.
    """
    rotation = CHAIN.tool((0.0, 0.0, 0.0, -pitch, roll))[3:]
    near = (-math.atan2(y, x), 0.0, 0.0, -pitch, roll)
    low, high = CHAIN.limits["wrist_roll"]
    if not low <= roll <= high:
        raise ValueError(f"roll: expected {low:.3f} to {high:.3f} rad, found {roll:.3f}")
    return CHAIN.joints(
        (x, y, z, *rotation), near, any_heading=True, keep=("wrist_roll",), starts=STARTS
    )
