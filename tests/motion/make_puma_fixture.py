"""Make `puma560_golden.json` from an independent implementation: the Robotics Toolbox for Python's
Puma560 (MIT licence).

Run it once, in a separate environment (the toolbox is large and not a dependency of this project):

    python -m venv /tmp/rtb && /tmp/rtb/bin/pip install roboticstoolbox-python==1.5.0
    /tmp/rtb/bin/python tests/motion/make_puma_fixture.py

Each case: joint angles (rad), pose of frame 6 (4 x 4, m) and geometric Jacobian in the base frame
(6 x 6). For the home pose: gravity torques (N m) and joint-space inertia with rotors (6 x 6, kg
m^2) of the arm without cup.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import roboticstoolbox

CASES = 60
HOME = (18.7, 53.4, -216.3, 6.7, 48.6, 3.4)
"""Degrees; the home pose of services/motion/puma560.toml."""


def main() -> None:
    """Write the fixture next to this file."""
    puma = roboticstoolbox.models.DH.Puma560()
    rng = np.random.default_rng(560)
    poses = rng.uniform(puma.qlim[0], puma.qlim[1], (CASES, 6))
    cases = [
        {"q": q.tolist(), "pose": puma.fkine(q).A.tolist(), "jacobian": puma.jacob0(q).tolist()}
        for q in [np.zeros(6), *poses]
    ]
    home = np.radians(HOME)
    body = {
        "source": f"roboticstoolbox-python {roboticstoolbox.__version__}, models.DH.Puma560",
        "cases": cases,
        "home": {
            "q": home.tolist(),
            "gravity": np.asarray(puma.gravload(home)).tolist(),
            "inertia": np.asarray(puma.inertia(home)).tolist(),
        },
    }
    Path(__file__).with_name("puma560_golden.json").write_text(
        json.dumps(body) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
