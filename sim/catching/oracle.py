"""Which balls could be caught at all: an estimate, by an oracle that knows the trajectory at
release and moves at the joint limits.

It is not a bound: it tries some moments and tilts, and searches poses from a few guesses, so a ball
that it calls unreachable may still be caught. A ball counts as *reachable* if there is a moment of
its fall and a pose of the arm, within the joint limits, that holds the cup's mouth around the ball,
turned towards it, clear of the table, and if every joint gets there from its angle at release
before the ball does, from rest to rest with the greatest joint speed and acceleration of the arm
file.

Poses are found numerically for all moments and tilts at once, independently of the closed form that
motion uses: Gauss-Newton on five equations (mouth centre, and two of its direction, since a round
cup may turn about its axis), for the joint displacement whose greatest travel time is least
(iteratively reweighted least squares).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.sim.catching.ball import BallModel
from petrobot.sim.catching.puma_model import PumaModel
from petrobot.sim.catching.thrower import Throw
from petrobot.sim.catching.truth import Truth, Vector
from petrobot.sim.catching.world import motion_on_table

_ITERATIONS = 14
_DAMPING = 1e-7
_STRIDE = 0.5
"""Greatest change of a joint in an iteration (rad)."""
_WRIST_GUESSES = (0.0, 1.3, -1.3)
"""rad, turns of joint 4 (and back of joint 6) from which poses are searched until the ball is found
reachable."""
_NORM = 6.0
"""Exponent of the norm of travel times that approximates their maximum."""
_PLACE = 1e-3
"""Distance and angle within which a pose counts as found (m, rad)."""


class OracleVerdict(Struct, frozen=True):
    """`margin` (s) is how much earlier than the ball the cup can be there, at best; negative: too
    late; -inf: no pose."""

    reachable: bool
    margin: float
    pose: Vector | None
    """(6,) rad, the best catching pose found."""
    at: float
    """When the ball reaches the pose, after its release (s)."""


_NEVER = OracleVerdict(False, -math.inf, None, math.inf)


class Oracle:
    """Judges throws for one truth. The rules stand in `[oracle]` of the laboratory file."""

    def __init__(self, model: PumaModel, truth: Truth, cell: Mapping[str, Any]) -> None:
        self._arm = model
        self._truth = truth
        self._ball = BallModel.of(cell["ball"], truth.settings["ball"]["friction"])
        self._rules = truth.settings["oracle"]
        self._rim = truth.cup.radius + float(cell["cup"]["wall"])

    def judge(self, throw: Throw, q: Sequence[float]) -> OracleVerdict:
        """Return the verdict on a throw with the arm at encoder angles `q` (six, rad) at
        release."""
        motion = motion_on_table(self._ball, throw.start, throw.rolling_resistance, self._truth)
        table = self._truth.table
        leaves = motion.first_crossing(0, table.near_edge)
        sideways = min(
            motion.first_crossing(1, table.half_width), motion.first_crossing(1, -table.half_width)
        )
        if not leaves < min(sideways, math.inf):
            return _NEVER
        exit_state = motion.state(leaves)
        fall, mouths, axes = self._places(
            np.array(exit_state.position), np.array(exit_state.velocity)
        )
        if not len(fall):
            return _NEVER
        start = np.asarray(q, dtype=float) + self._truth.joint_zero
        verdict = _NEVER
        for wrist in _WRIST_GUESSES:
            guess = start + np.array([0.0, 0.0, 0.0, wrist, 0.0, -wrist])
            poses, found = self.poses(mouths, axes, start, guess)
            margins = np.where(found, leaves + fall - self.travel_time(poses - start), -np.inf)
            best = int(np.argmax(margins))
            if margins[best] > verdict.margin:
                margin, pose = float(margins[best]), poses[best] - self._truth.joint_zero
                verdict = OracleVerdict(margin >= 0.0, margin, pose, leaves + float(fall[best]))
            if verdict.reachable:
                break
        return verdict

    def _places(self, exit_point: Vector, velocity: Vector) -> tuple[Vector, Vector, Vector]:
        """Return moments of the fall (n,) s, the ball's centre then (n, 3), and directions of the
        cup's mouth (n, 3)."""
        rules, g = self._rules, self._ball.gravity
        fall = np.arange(rules["first"], rules["last"], rules["interval"])
        points = (
            exit_point + fall[:, None] * velocity - np.outer(0.5 * g * fall**2, [0.0, 0.0, 1.0])
        )
        speed = math.hypot(velocity[0], velocity[1])
        back = np.array([-velocity[0], -velocity[1], 0.0]) / speed
        slant = np.arctan2(speed, g * fall)
        shares = np.array(rules["tilt_shares"])
        tilt = (slant[:, None] * shares).ravel()
        off = (slant[:, None] * (1.0 - shares)).ravel()
        axes = np.cos(tilt)[:, None] * np.array([0.0, 0.0, 1.0]) + np.sin(tilt)[:, None] * back
        fall, points = np.repeat(fall, len(shares)), np.repeat(points, len(shares), axis=0)
        fits = (off <= rules["greatest_slant"]) & self._clear(points, axes)
        return fall[fits], points[fits], axes[fits]

    def _clear(self, mouths: Vector, axes: Vector) -> Vector:
        """Return which cups (n,) stand in front of the table's edge and above the floor."""
        across, upright = (
            self._rim * np.sqrt(np.maximum(0.0, 1.0 - axes[:, k] ** 2)) for k in (0, 2)
        )
        bottoms = mouths - self._truth.cup.depth * axes
        ahead = np.maximum(mouths[:, 0], bottoms[:, 0]) + across
        lowest = np.minimum(mouths[:, 2], bottoms[:, 2]) - upright
        clear: Vector = (ahead <= self._truth.table.near_edge - self._rules["clearance"]) & (
            lowest > 0.0
        )
        return clear

    def poses(
        self, mouths: Vector, axes: Vector, start: Vector, guess: Vector
    ) -> tuple[Vector, Vector]:
        """Return joint angles (n, 6) that hold the cup's mouth at `mouths` (n, 3), directed to
        `axes` (n, 3), reached soonest from `start` (6,), searched from `guess` (6,); and which of
        them are correct (n,). All are within the joint limits."""
        q = np.repeat(np.clip(guess, self._arm.lower, self._arm.upper)[None], len(mouths), axis=0)
        speed2 = self._arm.speed**2
        weight = np.repeat(speed2[None], len(mouths), axis=0)
        locked = np.zeros_like(q, dtype=bool)
        across = _two_normals(axes)
        error, jacobian = self._error(q, mouths, axes, across)
        for _ in range(_ITERATIONS):
            away = self._displacement(
                q - start, error, jacobian, np.where(locked, 0.0, weight), locked
            )
            q = np.clip(
                q + np.clip(start + away - q, -_STRIDE, _STRIDE), self._arm.lower, self._arm.upper
            )
            # A joint driven against its limit stays there; the others compensate.
            locked |= (q <= self._arm.lower) | (q >= self._arm.upper)
            times = np.abs(q - start) / self._arm.speed
            share = times / times.max(axis=1, keepdims=True).clip(1e-6) + 0.1
            weight = 0.5 * (weight + speed2 / share ** (_NORM - 2.0))
            error, jacobian = self._error(q, mouths, axes, across)
        right = np.abs(error).max(axis=1) < _PLACE
        return q, right

    @staticmethod
    def _displacement(
        away: Vector, error: Vector, jacobian: Vector, weight: Vector, locked: Vector
    ) -> Vector:
        """Return the displacement from the start (n, 6) with the least weighted square that removes
        `error`, to first order; locked joints keep theirs."""
        kept = np.where(locked, away, 0.0)
        wanted = np.einsum("nij,nj->ni", jacobian, away - kept) + error
        spread = weight[:, None, :] * jacobian
        gram = spread @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(5)
        moved: Vector = np.einsum(
            "nji,nj->ni", spread, np.linalg.solve(gram, wanted[..., None])[..., 0]
        )
        return moved + kept

    def _error(
        self, q: Vector, mouths: Vector, axes: Vector, across: Vector
    ) -> tuple[Vector, Vector]:
        """Return what is left to the goal (n, 5), and its Jacobian (n, 5, 6); `across` are
        `_two_normals(axes)`."""
        origin, turn, pivots, spins = self._chain(q)
        mouth = origin + turn @ self._truth.cup.mouth
        axis = turn @ self._truth.cup.axis
        moved = _cross(spins, mouth[:, None] - pivots)
        turned = _cross(spins, axis[:, None])
        error = np.concatenate(
            [mouths - mouth, np.einsum("nij,nj->ni", across, axes - axis)], axis=1
        )
        # a cup upside down would satisfy the two equations as well
        error[:, 3] += np.where(np.einsum("ni,ni->n", axis, axes) < 0.0, 1.0, 0.0)
        jacobian = np.concatenate(
            [moved.transpose(0, 2, 1), across @ turned.transpose(0, 2, 1)], axis=1
        )
        return error, jacobian

    def _chain(self, q: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        """Return frame 6 (origin (n, 3), rotation (n, 3, 3)) and each joint's pivot and axis (n, 6,
        3)."""
        n = len(q)
        origin = np.repeat(np.array([self._arm.base]), n, axis=0)
        x, y, z = (np.repeat(axis[None], n, axis=0) for axis in np.eye(3))
        pivots, spins = np.empty((n, 6, 3)), np.empty((n, 6, 3))
        c, s = np.cos(q), np.sin(q)
        for j, (d, a, (ca, sa)) in enumerate(
            zip(self._arm.d, self._arm.a, self._arm.twists, strict=True)
        ):
            pivots[:, j], spins[:, j] = origin, z
            cj, sj = c[:, j, None], s[:, j, None]
            x, y = x * cj + y * sj, y * cj - x * sj
            origin = origin + d * z + a * x
            y, z = ca * y + sa * z, ca * z - sa * y
        return origin, np.stack([x, y, z], axis=-1), pivots, spins

    def travel_time(self, way: Vector) -> Vector:
        """Return the seconds (...,) for joint displacements (..., 6) rad from rest to rest; the
        slowest joint decides."""
        way, v, a = np.abs(way), self._arm.speed * self._truth.arm_speed, self._arm.acceleration
        ramps = v * v / a
        times = np.where(way < ramps, 2.0 * np.sqrt(way / a), way / v + v / a)
        longest: Vector = times.max(axis=-1)
        return longest


def _cross(a: Vector, b: Vector) -> Vector:
    """Return vector products (..., 3) of vectors (..., 3): the same as numpy's, three times faster
    for so few."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.subtract(a[..., i] * b[..., j], a[..., j] * b[..., i], out=product[..., k])
    return product


def _two_normals(axes: Vector) -> Vector:
    """Return two unit vectors (n, 2, 3) perpendicular to each of `axes` (n, 3) and to each
    other."""
    aside = np.where(np.abs(axes[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(axes, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], axis=1)
