"""The oracle's poses, times and verdicts, checked without its own equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.sim.catching.oracle import Oracle, OracleVerdict
from petrobot.sim.catching.site import CupMount, Site
from petrobot.sim.catching.thrower import draw_throw
from petrobot.sim.catching.truth import Truth

THROWS = 60


def verdicts(site: Site, regime: str, throws: int = THROWS) -> list[OracleVerdict]:
    truth = site.truth(regime)
    oracle, home = Oracle(site.arm, truth, site.cell), site.arm.poses["home"].tolist()
    return [oracle.judge(draw_throw(1, n, site.cell, truth), home) for n in range(1, throws + 1)]


@pytest.mark.parametrize(
    ("regime", "least"), [("A", 0.98), ("B", 0.98), ("C", 0.95), ("A+arm50", 0.98)]
)
def test_nearly_every_ball_of_the_regimes_can_be_reached(
    site: Site, regime: str, least: float
) -> None:
    assert np.mean([v.reachable for v in verdicts(site, regime)]) >= least


@pytest.mark.parametrize("regime", ["A", "C"])
def test_its_poses_hold_the_cup_where_the_ball_will_be(site: Site, regime: str) -> None:
    """Checked with the forward kinematics of mount and arm, and the closed form of the ball's
    path."""
    from petrobot.sim.catching.ball import BallModel, TableMotion, fly

    truth = site.truth(regime)
    oracle, mount = Oracle(site.arm, truth, site.cell), CupMount(site.arm, truth)
    home, model = site.arm.poses["home"].tolist(), BallModel.of(site.cell["ball"], 0.2)
    for n in range(1, 21):
        throw = draw_throw(2, n, site.cell, truth)
        verdict = oracle.judge(throw, home)
        if verdict.pose is None:
            continue
        motion = TableMotion(model, throw.start, throw.rolling_resistance)
        leaves = motion.first_crossing(0, truth.table.near_edge)
        ball = fly(motion.state(leaves), verdict.at - leaves, 9.81)
        cup = mount.frame(tuple(verdict.pose.tolist()))
        assert cup.origin == pytest.approx(ball.position, abs=2e-3)
        slant = np.array(ball.velocity) @ cup.z / np.linalg.norm(ball.velocity)
        assert slant < -np.cos(truth.settings["oracle"]["greatest_slant"] + 0.01)
        assert (site.arm.lower - 1e-3 <= verdict.pose).all() and (
            verdict.pose <= site.arm.upper + 1e-3
        ).all()


@settings(max_examples=30, deadline=None)
@given(way=st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_travel_time_is_that_of_the_slowest_joint(site: Site, way: list[float]) -> None:
    """Integrated numerically, full acceleration, cruise at the limit and full braking cover at
    least the distance."""
    oracle = Oracle(site.arm, site.truth("A"), site.cell)
    total = float(oracle.travel_time(np.array(way)))
    covered = []
    for speed, acceleration in zip(site.arm.speed, site.arm.acceleration, strict=True):
        t = np.linspace(0.0, total, 4001)
        profile = np.minimum(np.minimum(acceleration * t, acceleration * (total - t)), speed)
        covered.append(float(np.trapezoid(profile, t)))
    shortage = [abs(w) - c for w, c in zip(way, covered, strict=True)]
    assert max(shortage) == pytest.approx(0.0, abs=2e-3)


def test_a_slower_arm_has_less_time_left(site: Site) -> None:
    margins = [
        [v.margin for v in verdicts(site, regime, 20)] for regime in ("B", "B+arm50", "B+arm30")
    ]
    assert all(a > b > c for a, b, c in zip(*margins, strict=True))


def test_an_arm_without_time_reaches_nothing(site: Site) -> None:
    truth = replace(site.truth("C"), arm_speed=0.02)
    oracle = Oracle(site.arm, truth, site.cell)
    far = np.clip(
        site.arm.poses["home"] + [1.2, 0.4, 0.0, 1.0, 0.0, 0.0], site.arm.lower, site.arm.upper
    )
    assert not any(
        oracle.judge(draw_throw(1, n, site.cell, truth), far.tolist()).reachable
        for n in range(1, 21)
    )


def test_a_ball_that_never_leaves_the_near_edge_is_out_of_reach(site: Site) -> None:
    truth = site.truth("A")
    throw = draw_throw(1, 1, site.cell, truth)
    slow = throw.start._replace(velocity=(-0.05, 0.0, 0.0), spin=(0.0, -2.5, 0.0))
    verdict = Oracle(site.arm, truth, site.cell).judge(
        replace(throw, start=slow), site.arm.poses["home"].tolist()
    )
    assert not verdict.reachable and verdict.pose is None


def best_by_closed_form(site: Site, truth: Truth, oracle: Oracle, n: int) -> float:
    """Return the best margin over finely sampled times, tilts and rotations of the cup, with the
    closed-form inverse kinematics of `motion`."""
    from petrobot.services.motion.kinematics import Puma
    from petrobot.services.motion.model import nominal_arm
    from petrobot.sim.catching.ball import BallModel, TableMotion

    oracle._rules = {
        **oracle._rules,
        "tilt_shares": np.linspace(0.0, 1.0, 11),
        "interval": 0.015,
        "first": 0.02,
    }
    throw, home = draw_throw(6, n, site.cell, truth), site.arm.poses["home"]
    motion = TableMotion(
        BallModel.of(site.cell["ball"], 0.2), throw.start, throw.rolling_resistance
    )
    leaves = motion.first_crossing(0, truth.table.near_edge)
    state = motion.state(leaves)
    fall, mouths, axes = oracle._places(np.array(state.position), np.array(state.velocity))
    flange_axis = truth.cup.axis
    aside = np.cross(flange_axis, [0.0, 1.0, 0.0])
    flange = np.stack([flange_axis, aside, np.cross(flange_axis, aside)], axis=1)
    best = -np.inf
    across = np.cross(axes, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    for turn in np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False):
        first = np.cos(turn) * across + np.sin(turn) * np.cross(axes, across)
        rotation = np.stack([axes, first, np.cross(axes, first)], axis=-1) @ flange.T
        pose = np.zeros((len(axes), 4, 4))
        pose[:, :3, :3], pose[:, :3, 3], pose[:, 3, 3] = (
            rotation,
            mouths - rotation @ truth.cup.mouth,
            1.0,
        )
        q = Puma.of(nominal_arm()).inverse(pose, near=home) - truth.joint_zero
        margins = leaves + fall[:, None] - oracle.travel_time(q - home)
        if np.isfinite(margins).any():
            best = max(best, float(np.nanmax(margins)))
    return best


@pytest.mark.parametrize("regime", ["A", "C+arm30"])
def test_verdicts_agree_with_closed_form_kinematics(site: Site, regime: str) -> None:
    """The numerical search finds nearly the margin of exhaustive closed-form sampling, and never
    more."""
    truth = site.truth(regime)
    agreed = 0
    for n in range(1, 9):
        verdict = Oracle(site.arm, truth, site.cell).judge(
            draw_throw(6, n, site.cell, truth), site.arm.poses["home"].tolist()
        )
        best = best_by_closed_form(site, truth, Oracle(site.arm, truth, site.cell), n)
        assert verdict.margin <= best + 0.05
        agreed += verdict.reachable == (best >= 0.0)
    assert agreed >= 7
