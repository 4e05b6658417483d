"""The closed loop without cameras: balls that roll off the edge, noisy predictions, the servo with
its drives, and the cup that catches them.

The mechanics of the ball in the cup are written for this test: a sphere in a smooth cylinder with a
rim, restitution 0.3, friction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from petrobot.services.motion.model import nominal_arm, nominal_cell

CELL = nominal_cell()
RADIUS, DEPTH, WALL, BALL = CELL.cup.radius, CELL.cup.depth, CELL.cup.wall, CELL.ball_radius
RESTITUTION, FRICTION = 0.3, 0.3
STEP = 5e-4
Vector = np.ndarray[Any, np.dtype[np.float64]]


class CatchTrial(NamedTuple):
    """A ball as it leaves the edge: position y (m), speed (m/s), heading (rad), and the time after
    its release (s)."""

    y: float
    speed: float
    heading: float
    time: float

    @property
    def velocity(self) -> Vector:
        return np.array(
            [-self.speed * math.cos(self.heading), self.speed * math.sin(self.heading), 0.0]
        )


def throw(rng: np.random.Generator, low: float, high: float) -> CatchTrial:
    """Draw a nominal throw: released 0.1 m from the far edge with 70 to 100 % of the spin of
    rolling and an unknown rolling resistance."""
    length = 1.5
    release, target = rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)
    rolling = rng.uniform(low, high) * (0.6 + 0.4 * rng.uniform(0.7, 1.0))
    drag = 0.006 * rng.uniform(0.7, 1.3) * 9.81
    leaving = math.sqrt(rolling**2 - 2 * drag * length)
    heading = math.atan2(target - release, length)
    return CatchTrial(
        target, leaving, heading, 2 * length / math.cos(heading) / (rolling + leaving)
    )


class BallInCup:
    """A ball in flight and in a cup at rest."""

    def __init__(self, start: CatchTrial, mouth: Vector, axis: Vector) -> None:
        self.p = np.array([CELL.near_edge, start.y, CELL.table_top + BALL])
        self.v = start.velocity
        self.w = np.cross([0.0, 0.0, 1.0], self.v) / BALL
        self._mouth, self._axis = mouth, axis

    def caught(self) -> bool:
        """Return whether the ball lies in the cup at the end."""
        for _ in range(round(0.7 / STEP)):
            self.v = self.v - np.array([0.0, 0.0, CELL.gravity * STEP])
            self.p = self.p + self.v * STEP
            touched = self._contact()
            if touched is not None:
                self._bounce(*touched)
        height, outward, _ = self._place()
        return -DEPTH < height < 0.01 and outward < RADIUS

    def _place(self) -> tuple[float, float, Vector]:
        """Return height above the mouth, distance from the axis and direction from the axis."""
        offset = self.p - self._mouth
        height = float(offset @ self._axis)
        radial = offset - height * self._axis
        outward = float(np.linalg.norm(radial)) + 1e-12
        return height, outward, radial / outward

    def _contact(self) -> tuple[Vector, float] | None:
        """Return normal and depth of the deepest contact."""
        height, outward, away = self._place()
        found: list[tuple[float, Vector]] = []
        if -DEPTH - BALL < height < 0.0 and outward < RADIUS:
            found += [(outward - (RADIUS - BALL), -away), (BALL - DEPTH - height, self._axis)]
        elif -DEPTH < height <= 0.0:
            found += [(RADIUS + WALL + BALL - outward, away)]
        if height > 0.0:
            nearest = min(max(outward, RADIUS), RADIUS + WALL)
            gap = math.hypot(outward - nearest, height) + 1e-12
            found += [(BALL - gap, ((outward - nearest) * away + height * self._axis) / gap)]
        depth, normal = max(found, key=lambda each: each[0], default=(-1.0, self._axis))
        return (normal, depth) if depth > 0.0 else None

    def _bounce(self, normal: Vector, depth: float) -> None:
        self.p = self.p + depth * normal
        into = -float(self.v @ normal)
        if into <= 0.0:
            return
        slip = self.v + into * normal + np.cross(self.w, -BALL * normal)
        sliding = float(np.linalg.norm(slip)) + 1e-12
        push = (1.0 + (RESTITUTION if into > 0.05 else 0.0)) * into
        drag = -min(FRICTION * push, 0.4 * sliding) / sliding * slip
        self.v = self.v + push * normal + drag
        self.w = self.w + 1.5 / BALL * np.cross(-normal, drag)


def _catch(
    rig: Any, ball: CatchTrial, strategy: str, rng: np.random.Generator, noise: float, blind: float
) -> bool:
    """Simulate one throw: vision sees the ball after `blind` s, with errors of `noise` (m at the
    edge per remaining second)."""
    begun = rig.now
    bias = rng.normal(0.0, 0.5 * noise)
    rig.arm.command(rig.now, {"do": "follow", "strategy": strategy})
    cycle = 0
    while True:
        left = ball.time - (rig.now - begun)
        if cycle % 5 == 0 and ball.time - left >= blind and left > -0.2:
            sigma = 0.001 + noise * max(left, 0.0)
            y = ball.y + bias * max(left, 0.0) + rng.normal(0.0, 0.5 * sigma)
            vx, vy, _ = ball.velocity * (1.0 + rng.normal(0.0, 0.3 * sigma))
            rig.feed(
                [left + rng.normal(0.0, 0.2 * sigma), 0.62, y, 0.62, vx, vy, 0.0, sigma, sigma]
            )
        if cycle % 20 == 0:
            rig.arm.command(rig.now, {"do": "follow"})
        rig.tick()
        cycle += 1
        plan = rig.arm.state()["plan"]
        if plan is not None and plan["arrival"] <= 0.0:
            break
        assert cycle < 1500
    at = rig.arm._guard.place(rig.plant.q)
    result = BallInCup(ball, np.array(at.mouth), np.array(at.axis)).caught()
    rig.arm.command(rig.now, {"do": "move", "pose": "home"})
    assert rig.run(3.0, lambda: bool(rig.arm.state()["in_place"]))
    return result


def _caught(rig: Any, regime: tuple[float, float], number: int, **how: Any) -> int:
    rng = np.random.default_rng([round(10 * regime[0]), number])
    score = sum(_catch(rig, throw(rng, *regime), rng=rng, **how) for _ in range(number))
    assert rig.arm.state()["stale_executed"] == 0
    assert rig.arm.state()["faults"] == []
    return score


REGIMES = {"A": (0.7, 1.5), "B": (1.5, 2.0), "C": (2.0, 2.5)}


@pytest.mark.once
@pytest.mark.parametrize(("regime", "noise"), [("A", 0.02), ("B", 0.02), ("C", 0.02), ("C", 0.0)])
def test_tilted_catches_nearly_all(rig: Any, regime: str, noise: float) -> None:
    number = 5
    assert (
        _caught(rig, REGIMES[regime], number, strategy="tilted", noise=noise, blind=0.2)
        >= number - 1
    )


def test_the_upright_cup_catches_slow_balls(rig: Any) -> None:
    assert _caught(rig, REGIMES["A"], 4, strategy="upright", noise=0.02, blind=0.2) >= 3


def test_without_the_cup_in_place_nothing_is_caught() -> None:
    ball = CatchTrial(0.1, 1.5, 0.0, 1.0)
    assert not BallInCup(ball, np.array([0.5, -0.1, 0.55]), np.array([0.0, 0.0, 1.0])).caught()


@pytest.mark.proof
@pytest.mark.parametrize(("regime", "floor"), [("A", 0.98), ("B", 0.94), ("C", 0.89)])
def test_a_thousand_throws(make_rig: Callable[[], Any], regime: str, floor: float) -> None:
    number = 1000
    share = (
        _caught(
            make_rig().enable(), REGIMES[regime], number, strategy="tilted", noise=0.02, blind=0.25
        )
        / number
    )
    z = 1.96
    centre = share + z * z / (2 * number)
    lower = (centre - z * math.sqrt(share * (1 - share) / number + (z / (2 * number)) ** 2)) / (
        1 + z * z / number
    )
    assert lower >= floor


def test_the_home_pose_is_near_every_ball() -> None:
    """From home, the joints can reach every throw of regimes A to C in 0.55 s, which leaves at
    least 0.1 s for vision."""
    from petrobot.services.motion.interception import STRATEGIES, Interceptor, Prediction
    from petrobot.services.motion.kinematics import Puma, branch_of
    from petrobot.services.motion.limits import CollisionGuard

    arm = nominal_arm()
    puma = Puma.of(arm)
    home = arm.poses["home"]
    interceptor = Interceptor(
        puma, CELL, CollisionGuard(puma, arm, CELL), home, branch_of(puma, np.array(home))
    )
    rng = np.random.default_rng(7)
    for low, high in REGIMES.values():
        for _ in range(150):
            ball = throw(rng, low, high)
            vx, vy, vz = ball.velocity
            prediction = Prediction(ball.time, (0.62, ball.y, 0.62), (vx, vy, vz), 0.0, 0.0)
            plan = interceptor.plan(
                STRATEGIES["tilted"],
                prediction,
                home,
                [0.0] * 6,
                arm.speed.tolist(),
                arm.acceleration.tolist(),
            )
            assert plan is not None
            assert plan.reach < 0.55
            assert plan.slack > 0.1
