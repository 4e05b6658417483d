"""The arm as a body that torques move: rigid-body dynamics, rotors, friction, brakes, hard stops.

Mass matrix and bias torques come from PyBullet on the published values; rotor inertia (up to 2.3 kg m^2 at the joint, more
than most links) is added here, as URDF has no place for it. Integration is semi-implicit Euler. An arm that stands
still, held by friction or brakes, costs next to nothing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from operator import ge, le
from pathlib import Path

import numpy as np
import pybullet

from sim.puma_model import JOINTS, ArmModel, Link
from sim.puma_urdf import urdf
from sim.truth import Vector

_REFRESH = (0.01, 0.01, 0.1, 0.1)
"""rad, of joints 2 to 5; the mass matrix is computed anew when a joint has moved so far: it changes by less than 1 % meanwhile.
It does not depend on joint 1, and on the wrist only by its light links."""
_STILL = 1e-4
"""rad/s; slower than this and held by friction, a joint stops."""
_STICTION = 1.05
"""Dry friction of a joint at rest as a multiple of that of a moving one: where sliding dies down, the joint sticks."""
_BRAKE = 2.0
"""Torque of a joint's brake as a multiple of the motor's."""
_FADE = 0.15
"""Above its greatest speed the motor's torque fades to nothing within this share of it (back EMF)."""


class RigidBody:
    """Mass matrix and bias torques of the arm by PyBullet, without rotors and friction; a physics client of its own."""

    def __init__(self, model: ArmModel, gravity: float, flange_load: Link | None = None) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0.0, 0.0, -gravity, physicsClientId=self._client)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(urdf(model, flange_load), encoding="utf-8")
            self._body = pybullet.loadURDF(
                str(file), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self._client
            )
        self._zero = [0.0] * JOINTS

    def mass_matrix(self, q: Sequence[float]) -> Vector:
        """(6, 6) kg m^2."""
        return np.array(pybullet.calculateMassMatrix(self._body, list(q), physicsClientId=self._client))

    def bias(self, q: Sequence[float], qd: Sequence[float]) -> Sequence[float]:
        """Six torques (N m) that hold the arm against gravity, Coriolis and centrifugal forces."""
        torques: Sequence[float] = pybullet.calculateInverseDynamics(
            self._body, q, qd, self._zero, physicsClientId=self._client
        )
        return torques

    def link_frame(self, q: Sequence[float], link: int) -> tuple[Vector, Vector]:
        """Origin (3,) and rotation (3, 3) of a URDF link (0 to 5) as PyBullet places it; for checks."""
        for joint, angle in enumerate(q):
            pybullet.resetJointState(self._body, joint, angle, physicsClientId=self._client)
        state = pybullet.getLinkState(self._body, link, computeForwardKinematics=1, physicsClientId=self._client)
        return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)

    def close(self) -> None:
        """End the physics client."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1


class ArmPlant:
    """The arm as its drives feel it: six torques in, six positions and speeds out.

    `q` (rad) and `qd` (rad/s) are as the encoders show them, lists of six floats; do not write to them. Drives put
    torques (N m at the joint) into `tau` and engage or release brakes; `step` moves the arm on. Plain floats, as six
    numbers are too few for an array to pay (11 us a step against 30).
    """

    def __init__(
        self,
        model: ArmModel,
        gravity: float,
        start: Sequence[float],
        speed_factor: float = 1.0,
        load: Link | None = None,
    ) -> None:
        """`speed_factor`: share of its joint speeds that the arm reaches (a slow arm); `load`: what the flange carries."""
        self.model = model
        self.q: list[float] = [float(angle) for angle in start]
        self.qd: list[float] = [0.0] * JOINTS
        self.tau: list[float] = [0.0] * JOINTS
        self.moves = 0
        """Counts the steps in which the arm moved: unchanged means that the pose is unchanged."""
        self.still = True
        """Whether no joint moves."""
        self._body = RigidBody(model, gravity, load)
        self._rotors = np.diag(model.rotor)
        self._limit: list[float] = model.torque.tolist()
        self._viscous: list[float] = model.viscous.tolist()
        self._dry: list[float] = model.coulomb.tolist()
        self._lower: list[float] = model.lower.tolist()
        self._upper: list[float] = model.upper.tolist()
        self._braked = [True] * JOINTS
        self._hold, self._stick = [0.0] * JOINTS, [0.0] * JOINTS
        for joint in range(JOINTS):
            self.brake(joint)
        self._friction = [0.0] * JOINTS
        self._bias = self._body.bias(self.q, self.qd)
        self.slow_down(speed_factor)
        self._refresh()

    @property
    def braked(self) -> tuple[bool, ...]:
        """Which brakes are engaged."""
        return tuple(self._braked)

    def brake(self, joint: int) -> None:
        """Engage the brake of a joint (0 to 5) and take its torque away."""
        self.tau[joint] = 0.0
        self._braked[joint] = True
        self._hold[joint] = self._dry[joint] + _BRAKE * self._limit[joint]
        self._stick[joint] = self._hold[joint]

    def release(self, joint: int) -> None:
        """Release the brake of a joint (0 to 5)."""
        self._braked[joint] = False
        self._hold[joint] = self._dry[joint]
        self._stick[joint] = _STICTION * self._dry[joint]

    def slow_down(self, factor: float) -> None:
        """From now on the joints reach this share (0 to 1] of their greatest speeds."""
        if not 0.0 < factor <= 1.0:
            raise ValueError(f"speed factor {factor}: must be above 0 and at most 1")
        self._greatest: list[float] = (self.model.speed * factor).tolist()
        self._slowest = min(self._greatest)

    def step(self, dt: float, tau: Sequence[float] | None = None) -> None:
        """Move on by `dt` (s) under torques `tau` (six, N m), those in `self.tau` if None."""
        if tau is not None:
            self.tau[:] = tau
        drive = self._motor_torque()
        if self.still and _held(drive, self._bias, self._stick):
            return
        self._integrate(dt, drive)

    def _motor_torque(self) -> list[float]:
        """What the motors give: within the torque limits, fading above the greatest speed for what would speed up."""
        qd, slowest = self.qd, self._slowest
        if max(qd) <= slowest and min(qd) >= -slowest:
            return [
                limit if tau > limit else -limit if tau < -limit else tau
                for tau, limit in zip(self.tau, self._limit, strict=True)
            ]
        return [
            (limit if tau > limit else -limit if tau < -limit else tau)
            if -greatest <= speed <= greatest
            else _faded(tau, limit, speed / greatest)
            for tau, limit, speed, greatest in zip(self.tau, self._limit, qd, self._greatest, strict=True)
        ]

    def _integrate(self, dt: float, drive: list[float]) -> None:
        q, qd = self.q, self.qd
        if not self._near(q):
            self._refresh()
        self._bias = bias = self._body.bias(q, qd)
        t0, t1, t2, t3, t4, t5 = [
            u - b - c * v + f for u, b, c, v, f in zip(drive, bias, self._viscous, qd, self._friction, strict=True)
        ]
        speed = [
            v + dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
            for v, (a, b, c, d, e, f) in zip(qd, self._inverse, strict=True)
        ]
        speed = self._rub(dt, speed)
        self.moves += 1
        if max(speed) < _STILL and min(speed) > -_STILL and _held(drive, bias, self._stick):
            self.still, self.qd = True, [0.0] * JOINTS
            return
        self.still = False
        self.q = [angle + dt * v for angle, v in zip(q, speed, strict=True)]
        self.qd = speed
        self._stop_at_ends()

    def _near(self, q: list[float]) -> bool:
        """Whether the mass matrix is still good enough."""
        _, a, b, c, d, _ = self._at
        u, v, w, x = _REFRESH
        return -u < q[1] - a < u and -v < q[2] - b < v and -w < q[3] - c < w and -x < q[4] - d < x

    def _rub(self, dt: float, speed: list[float]) -> list[float]:
        """Take dry friction off speeds: the torque that would stop the joint within the step, at most its limit.

        Last step's friction is the first guess (already in `speed`), so the coupling of the joints settles over a few steps.
        """
        before = self._friction
        stopping = [f - v / (dt * gain) for f, v, gain in zip(before, speed, self._diagonal, strict=True)]
        self._friction = friction = [
            hold if f > hold else -hold if f < -hold else f for f, hold in zip(stopping, self._hold, strict=True)
        ]
        if friction != before:
            for f, last, row in zip(friction, before, self._inverse, strict=True):
                if f != last:
                    push = dt * (f - last)  # the matrix is symmetric: a row is a column
                    speed = [v + push * gain for v, gain in zip(speed, row, strict=True)]
        return speed

    def _stop_at_ends(self) -> None:
        if all(map(ge, self.q, self._lower)) and all(map(le, self.q, self._upper)):
            return
        for i, (angle, low, high) in enumerate(zip(self.q, self._lower, self._upper, strict=True)):
            if not low <= angle <= high:
                self.q[i] = min(max(angle, low), high)
                self.qd[i] = 0.0

    def _refresh(self) -> None:
        inverse = np.linalg.inv(self._body.mass_matrix(self.q) + self._rotors)
        self._inverse: list[list[float]] = inverse.tolist()
        self._diagonal: list[float] = np.diag(inverse).tolist()
        self._at = self.q

    def close(self) -> None:
        """End the physics client."""
        self._body.close()


def _faded(tau: float, limit: float, overspeed: float) -> float:
    """A motor's torque beyond its greatest speed: less, and at last none, for what would speed it up."""
    rest = max(0.0, 1.0 - (abs(overspeed) - 1.0) / _FADE) * limit
    high, low = (rest, limit) if overspeed > 0.0 else (limit, rest)
    return high if tau > high else -low if tau < -low else tau


def _held(drive: list[float], bias: Sequence[float], hold: list[float]) -> bool:
    """Whether friction and brakes can hold a standing arm against what pulls at it."""
    return all(-h <= u - b <= h for u, b, h in zip(drive, bias, hold, strict=True))
