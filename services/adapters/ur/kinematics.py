"""The joints of UR arms.

Denavit-Hartenberg parameters: Universal Robots, "DH Parameters for calculations of kinematics and
dynamics" (support article 16538). A robot's own calibration differs by a few tenths of a
millimetre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from petrobot import JointChain

# d1, a2, a3, d4, d5, d6 (m)
MODELS = {
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
}
TURN = (-2 * math.pi, 2 * math.pi)


def chain(model: str, tool: Sequence[float] = (0.0, 0.0, 0.0)) -> JointChain:
    """Return the joints of a model with a tool point `tool` (m, in the flange's frame)."""
    d1, a2, a3, d4, d5, d6 = MODELS[model]
    rows = [
        {"name": "base", "d": d1, "alpha": math.pi / 2},
        {"name": "shoulder", "a": a2},
        {"name": "elbow", "a": a3},
        {"name": "wrist_1", "d": d4, "alpha": math.pi / 2},
        {"name": "wrist_2", "d": d5, "alpha": -math.pi / 2},
        {"name": "wrist_3", "d": d6},
    ]
    return JointChain(({**row, "limits": TURN} for row in rows), (*tool, 0.0, 0.0, 0.0))
