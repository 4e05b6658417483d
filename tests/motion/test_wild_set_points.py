"""No set point, however extreme, makes the arm violate table, floor, pedestal, joint limits, speeds
or accelerations.

Contact is checked with points over the whole cup and forearm, independently of the guard that must
prevent it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from numpy.typing import NDArray

from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.model import nominal_arm, nominal_cell

Array = NDArray[np.float64]

ARM, CELL = nominal_arm(), nominal_cell()
PUMA = Puma.of(ARM)
CYCLE = 0.004
TURN = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
ROUND = np.stack([np.cos(TURN), np.sin(TURN)], axis=-1)
MONSTERS = [
    float("nan"),
    float("inf"),
    -float("inf"),
    1e300,
    -1e300,
    1.4e154,
    -1.4e154,
    999.0,
    -999.0,
    5e-324,
    -0.0,
    0.0,
    1e9,
    -1e-12,
]


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw numbers that are mostly plausible set points, sometimes impossible ones."""
    return st.one_of(
        st.floats(low, high), st.floats(low, high), st.floats(), st.sampled_from(MONSTERS)
    )


POINTS = st.tuples(
    _numbers(-0.2, 1.5),  # time to go
    _numbers(0.3, 0.9),  # where the ball leaves the table ...
    _numbers(-1.2, 1.2),
    _numbers(0.0, 1.2),
    _numbers(-4.0, 1.0),  # ... how fast ...
    _numbers(-2.0, 2.0),
    _numbers(-1.0, 1.0),
    _numbers(0.0, 0.1),  # ... and how surely
    _numbers(0.0, 0.1),
)
POSES = st.one_of(
    st.lists(_numbers(-6.0, 6.0), min_size=6, max_size=6),
    st.tuples(
        *(st.floats(lo, hi) for lo, hi in zip(ARM.lower.tolist(), ARM.upper.tolist(), strict=True))
    ).map(list),
    st.sampled_from(["home", "empty", "ready"]),
)
COMMANDS = st.one_of(
    st.builds(
        lambda name: {"do": "follow", "strategy": name}, st.sampled_from(["tilted", "upright"])
    ),
    st.builds(
        lambda pose, speed: {"do": "move", "pose": pose, "speed": speed}, POSES, _numbers(0.1, 1.0)
    ),
    st.just({"do": "hold"}),
)
STEPS = st.lists(
    st.tuples(COMMANDS, st.lists(POINTS, min_size=1, max_size=6), st.integers(5, 60)),
    min_size=1,
    max_size=6,
)


def _solid(q: Array) -> Array:
    """Return points (n, 3) on the outside of cup and forearm (m, base frame) at a joint pose, from
    the kinematics alone."""
    frame = PUMA.forward(q)
    turn, wrist = frame[:3, :3], frame[:3, 3]
    mouth, axis = turn @ CELL.cup.mouth + wrist, turn @ CELL.cup.axis
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    ring = (ROUND @ np.stack([side, np.cross(axis, side)])) * (CELL.cup.radius + CELL.cup.wall)
    heights = np.linspace(0.0, CELL.cup.depth + CELL.cup.wall, 4)
    cup = np.concatenate([mouth - height * axis + ring for height in heights])
    elbow = _elbow(q)
    middles = elbow + np.linspace(0.0, 1.0, 9)[:, None] * (wrist - elbow)
    lowest, foremost = [0.0, 0.0, -ARM.body.forearm], [ARM.body.forearm, 0.0, 0.0]
    return np.concatenate([cup, middles + lowest, middles + foremost])


def _elbow(q: Array) -> Array:
    """Return where the forearm begins: the third frame's origin, moved along its joint's offset."""
    c1, s1 = np.cos(q[0]), np.sin(q[0])
    reach = PUMA.a2 * np.cos(q[1]) + PUMA.a3 * np.cos(q[1] + q[2])
    height = PUMA.d1 + PUMA.a2 * np.sin(q[1]) + PUMA.a3 * np.sin(q[1] + q[2])
    return np.array([reach * c1 + PUMA.d3 * s1, reach * s1 - PUMA.d3 * c1, height])


def _check(commanded: list[list[float]]) -> None:
    """Check joint limits, speeds, accelerations, table and floor in every cycle."""
    q = np.array(commanded[1:])
    assert np.all(np.isfinite(q))
    assert np.all(q >= ARM.lower - 1e-6) and np.all(q <= ARM.upper + 1e-6)
    qd = np.diff(q, axis=0) / CYCLE
    assert np.all(np.abs(qd) <= ARM.speed * (1 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / CYCLE <= ARM.acceleration * (1 + 1e-6))
    for pose in q[np.append(True, np.any(qd != 0.0, axis=1))]:
        points = _solid(pose)
        assert not np.any((points[:, 0] > CELL.near_edge) & (points[:, 2] < CELL.table_top)), (
            "in the table"
        )
        assert points[:, 2].min() > 0.0, "in the floor"


# a failing arm session is long: making it smaller would take minutes, and it shows what is wrong as
# it is
@settings(
    max_examples=25,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(STEPS)
def test_no_set_point_makes_the_arm_violate_its_limits(
    make_rig: Any, steps: list[tuple[Any, list[Any], int]]
) -> None:
    rig = make_rig().enable()
    begun = len(rig.commanded)
    for body, points, cycles in steps:
        try:
            rig.arm.command(rig.now, body)
        except ValueError:
            assert body["do"] == "move"
        for cycle in range(cycles):
            if cycle % 5 == 0:
                rig.feed(points[cycle // 5 % len(points)])
            rig.tick()
    rig.arm.stop(rig.now)
    assert rig.run(2.0, rig.arm.stopped)
    _check(rig.commanded[begun:])
    assert rig.arm.state()["stale_executed"] == 0
    assert rig.arm.state()["faults"] == []
