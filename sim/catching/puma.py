"""The arm as a body that torques move: rigid-body dynamics, rotors, friction, brakes, hard stops.

Mass matrix and bias torques come from PyBullet with the published values; rotor inertia (up to 2.3
kg m^2 at the joint, more than most links) is added here, since URDF cannot express it. The
integration is semi-implicit Euler. An arm that stands still, held by friction or brakes, costs
almost nothing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pybullet

from petrobot.services.host.numba_kernels import packed
from petrobot.sim.catching.arm_motion import (
    Matrix,
    Six,
    held,
    held_packed,
    motors,
    stepped,
    stepped_packed,
)
from petrobot.sim.catching.puma_model import JOINTS, PrincipalInertia, PumaModel
from petrobot.sim.catching.truth import Vector

# The arm as URDF: PyBullet computes its mass matrix and its gravity, Coriolis and centrifugal
# torques from it.

_LEAST_MASS = 1e-9
_ZERO = (0.0, 0.0, 0.0)


def urdf(model: PumaModel, flange_load: PrincipalInertia | None = None) -> str:
    """Return the arm as URDF text: links base, link1 to link6; `flange_load`: what is bolted to
    link 6, in frame 6."""
    base = _inertial_text(PrincipalInertia(0.0, _ZERO, _ZERO), _ZERO, 0.0)
    parts = [
        '<robot name="arm">',
        f'<link name="base">{base}</link>',
    ]
    for i, link in enumerate(model.links):
        x, y, z = model.base if i == 0 else (model.a[i - 1], 0.0, model.d[i - 1])
        roll = 0.0 if i == 0 else model.alpha[i - 1]
        parent = "base" if i == 0 else f"link{i}"
        parts.append(
            f'<joint name="joint{i + 1}" type="revolute"><parent link="{parent}"/><child '
            f'link="link{i + 1}"/>'
            f'<origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="{model.lower[i]}" upper="{model.upper[i]}" effort="{model.torque[i]}" '
            f'velocity="{model.speed[i]}"/></joint>'
        )
        parts.append(f'<link name="link{i + 1}">{_inertial(model, i, link)}</link>')
    if flange_load is not None:
        end = len(model.links) - 1
        parts.append(
            '<joint name="load" type="fixed"><parent link="link6"/><child link="load"/>'
            f'<origin xyz="{model.a[end]!r} 0 {model.d[end]!r}" rpy="{model.alpha[end]!r} 0 '
            '0"/></joint>'
            f'<link name="load">{_inertial_text(flange_load, flange_load.centre, 0.0)}</link>'
        )
    parts.append("</robot>")
    return "\n".join(parts)


def _inertial(model: PumaModel, i: int, link: PrincipalInertia) -> str:
    """Return the link's inertial element: its centre moved from DH frame i + 1 to the URDF link
    frame, turned by the twist."""
    c, s = model.twists[i]
    x, y, z = link.centre
    return _inertial_text(
        link, (model.a[i] + x, c * y - s * z, model.d[i] + s * y + c * z), model.alpha[i]
    )


def _inertial_text(link: PrincipalInertia, centre: tuple[float, float, float], roll: float) -> str:
    ixx, iyy, izz = _physical(link.inertia)
    x, y, z = centre
    return (
        f'<inertial><origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/><mass '
        f'value="{max(link.mass, _LEAST_MASS)!r}"/>'
        f'<inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _physical(inertia: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the tensor with its lesser moments raised just enough to belong to a real body
    (triangle inequality of principal moments); the greatest is kept.

    Where a lesser moment was left out because the link never turns about that axis (link 1),
    raising it changes nothing. For link 3 it is 0.004 of 0.086 kg m^2, less than the publications
    differ.
    """
    order = sorted(range(3), key=lambda k: inertia[k])
    lack = inertia[order[2]] - inertia[order[0]] - inertia[order[1]]
    if lack <= 0.0:
        return inertia
    # A little above equality: Bullet compares in rounded arithmetic.
    share = 0.5 * lack * (1.0 + 1e-9) + 1e-12
    mended = list(inertia)
    mended[order[0]] += share
    mended[order[1]] += share
    return mended[0], mended[1], mended[2]


_REFRESH = (0.01, 0.01, 0.1, 0.1)
"""rad, of joints 2 to 5; the mass matrix is computed again when a joint has moved so far, which
changes it by less than 1 %. It does not depend on joint 1, and on the wrist only through light
links."""
_STICTION = 1.05
"""Dry friction of a joint at rest as a multiple of that of a moving joint: the joint sticks where
sliding fades."""
_REST: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_BRAKE = 2.0
"""Torque of a joint's brake as a multiple of the motor's."""


class RigidBody:
    """Mass matrix and bias torques of the arm by PyBullet, without rotors and friction; a physics
    client of its own."""

    def __init__(
        self, model: PumaModel, gravity: float, flange_load: PrincipalInertia | None = None
    ) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0.0, 0.0, -gravity, physicsClientId=self._client)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(urdf(model, flange_load), encoding="utf-8")
            self._body = pybullet.loadURDF(
                str(file),
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=self._client,
            )
        self._zero = [0.0] * JOINTS

    def mass_matrix(self, q: Sequence[float]) -> Vector:
        """Return the mass matrix (6, 6) kg m^2."""
        return np.array(
            pybullet.calculateMassMatrix(self._body, list(q), physicsClientId=self._client)
        )

    def bias(self, q: Sequence[float], qd: Sequence[float]) -> Six:
        """Return six torques (N m) that hold the arm against gravity, Coriolis and centrifugal
        forces."""
        torques: Six = pybullet.calculateInverseDynamics(
            self._body, q, qd, self._zero, physicsClientId=self._client
        )
        return torques

    def link_frame(self, q: Sequence[float], link: int) -> tuple[Vector, Vector]:
        """Return origin (3,) and rotation (3, 3) of a URDF link (0 to 5) as PyBullet places it; for
        checks."""
        for joint, angle in enumerate(q):
            pybullet.resetJointState(self._body, joint, angle, physicsClientId=self._client)
        state = pybullet.getLinkState(
            self._body, link, computeForwardKinematics=1, physicsClientId=self._client
        )
        return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(
            3, 3
        )

    def close(self) -> None:
        """Disconnect the physics client."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1


class ArmPlant:
    """The arm as its drives see it: six torques in, six positions and speeds out.

    `q` (rad) and `qd` (rad/s) are what the encoders show. Drives write torques (N m at the joint)
    to `tau` and engage or release brakes; `step` moves the arm. Plain floats, since six numbers are
    too few for an array to be faster (11 us a step against 30).
    """

    def __init__(
        self,
        model: PumaModel,
        gravity: float,
        start: Sequence[float],
        speed_factor: float = 1.0,
        load: PrincipalInertia | None = None,
    ) -> None:
        """`speed_factor`: share of its joint speeds that the arm reaches (a slow arm); `load`: what
        the flange carries."""
        self.model = model
        self.q: Six = _six(start)
        self.qd: Six = _REST
        self.tau: list[float] = [0.0] * JOINTS
        self.moves = 0
        """Counts the steps in which the arm moved: unchanged means that the pose is unchanged."""
        self.still = True
        """Whether no joint moves."""
        self._body = RigidBody(model, gravity, load)
        self._rotors = np.diag(model.rotor)
        self._limit, self._viscous = _six(model.torque), _six(model.viscous)
        self._dry: list[float] = model.coulomb.tolist()
        self._ends = _six(model.lower), _six(model.upper)
        self._braked = [True] * JOINTS
        self._hold = self._stick = _REST
        self._greatest = _six(model.speed)
        self._packs = hasattr(stepped_packed, "py_func")
        """Whether kernels are compiled: then they receive what seldom changes in packed form, else
        as tuples."""
        for joint in range(JOINTS):
            self.brake(joint)
        self._friction = _REST
        self._bias = self._body.bias(self.q, self.qd)
        self.slow_down(speed_factor)
        self._refresh()
        self._warm_up()

    def _warm_up(self) -> None:
        """Compile the kernels, or load them from the cache, now and not when the arm first
        moves."""
        self._held(_REST)
        self._stepped(0.001, _REST, self._bias)

    @property
    def braked(self) -> tuple[bool, ...]:
        """Which brakes are engaged."""
        return tuple(self._braked)

    def brake(self, joint: int) -> None:
        """Engage the brake of a joint (0 to 5) and switch its torque off."""
        self.tau[joint] = 0.0
        self._braked[joint] = True
        hold = self._dry[joint] + _BRAKE * self._limit[joint]
        self._hold, self._stick = _put(self._hold, joint, hold), _put(self._stick, joint, hold)
        self._pack()

    def release(self, joint: int) -> None:
        """Release the brake of a joint (0 to 5)."""
        self._braked[joint] = False
        self._hold = _put(self._hold, joint, self._dry[joint])
        self._stick = _put(self._stick, joint, _STICTION * self._dry[joint])
        self._pack()

    def slow_down(self, factor: float) -> None:
        """Limit the joints to this share (0 to 1] of their greatest speeds from now on."""
        if not 0.0 < factor <= 1.0:
            raise ValueError(f"speed factor: expected a number above 0 and at most 1, got {factor}")
        self._greatest = _six(self.model.speed * factor)
        self._pack()

    def _pack(self) -> None:
        """Pack the numbers that compiled kernels read, after one has changed."""
        if self._packs:
            groups = (
                self._limit,
                self._greatest,
                self._viscous,
                self._hold,
                self._stick,
                *self._ends,
            )
            self._numbers = packed(stepped_packed, [number for group in groups for number in group])

    def step(self, dt: float, tau: Sequence[float] | None = None) -> None:
        """Advance by `dt` (s) under torques `tau` (six, N m), those in `self.tau` if None."""
        if tau is not None:
            self.tau[:] = tau
        a, b, c, d, e, f = self.tau
        asked = a, b, c, d, e, f
        if self.still and self._held(asked):
            return
        if not self._near(self.q):
            self._refresh()
        self._bias = bias = self._body.bias(self.q, self.qd)
        self.moves += 1
        self.q, self.qd, self._friction, self.still = self._stepped(dt, asked, bias)

    def _held(self, asked: Six) -> bool:
        """Return whether friction and brakes hold the standing arm under these torques."""
        if self._packs:
            return held_packed(asked, self.qd, self._bias, self._numbers)
        return held(motors(asked, self._limit, self.qd, self._greatest), self._bias, self._stick)

    def _stepped(self, dt: float, asked: Six, bias: Six) -> tuple[Six, Six, Six, bool]:
        """Return angles, speeds and dry friction after `dt`, and whether the arm then stands
        still."""
        if self._packs:
            return stepped_packed(
                dt, self.q, self.qd, asked, bias, self._friction, self._rows, self._numbers
            )
        return stepped(
            dt,
            self.q,
            self.qd,
            asked,
            bias,
            self._inverse,
            self._friction,
            self._limit,
            self._greatest,
            self._viscous,
            self._hold,
            self._stick,
            *self._ends,
        )

    def _near(self, q: Six) -> bool:
        """Return whether the mass matrix is still accurate enough."""
        _, a, b, c, d, _ = self._at
        u, v, w, x = _REFRESH
        return -u < q[1] - a < u and -v < q[2] - b < v and -w < q[3] - c < w and -x < q[4] - d < x

    def _refresh(self) -> None:
        inverse = np.linalg.inv(self._body.mass_matrix(self.q) + self._rotors)
        if self._packs:
            self._rows: Any = inverse.ravel()
        else:
            a, b, c, d, e, f = map(_six, inverse.tolist())
            self._inverse: Matrix = a, b, c, d, e, f
        self._at = self.q

    def close(self) -> None:
        """Disconnect the physics client."""
        self._body.close()


def _six(values: Iterable[float]) -> Six:
    a, b, c, d, e, f = map(float, values)
    return a, b, c, d, e, f


def _put(values: Six, joint: int, value: float) -> Six:
    """The same with another value at one joint."""
    return _six((*values[:joint], value, *values[joint + 1 :]))
