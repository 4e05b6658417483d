"""The back end `bullet`: PyBullet computes the arm's dynamics and the ball's contacts.

Nothing else imports PyBullet, and this module is imported only when the back end is chosen.

The arm is given to PyBullet as URDF with the published values. Rotor inertia (up to 2.3 kg m^2 at
the joint, more than most links) is added in sim/catching/puma.py, since URDF cannot express it.

The ball's contacts are a small space of ball, table and cup, stepped at 1 kHz. The cup is 16 flat
boxes and a disc that move with the arm. Bullet gives bodies without mass no velocity in a contact,
so the cup is a free body with a mass (1 t) that no ball can move; each step puts it where the arm
holds it, with the velocity that takes it to where the arm will hold it next. It is loaded as URDF,
since a body made otherwise has 16 shapes at most, and with two bodies a step takes more than twice
the time (21 us instead of 9).

Restitution: Bullet lets contacts act before bodies touch and then forgets the bounce, and its
correction of overlap adds speed. With a breaking threshold of 10 um and a correction of 2 % per
step, impacts at 0.2 to 2.4 m/s on a resting or moving cup return with 0.30 to 0.33 of their speed
for a coefficient of 0.3 (tests/sim/test_contact.py).
"""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pybullet

from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.ball import BallModel, BallState
from petrobot.sim.catching.physics import TABLE_TOP
from petrobot.sim.catching.puma_model import (
    JOINTS,
    Frame3,
    PrincipalInertia,
    PumaModel,
    real_inertia,
    twist,
)
from petrobot.sim.catching.truth import CupTruth, TableTruth, Vector

_ANVIL = 1000.0
"""kg, mass of the cup."""
_HULL_MARGIN = 0.001
"""How much Bullet enlarges a cylinder of a URDF in all directions (m)."""
Quaternion = tuple[float, float, float, float]
_LEAST_MASS = 1e-9
"""kg, for links whose mass the publications leave out."""
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
    ixx, iyy, izz = real_inertia(link.inertia)
    x, y, z = centre
    return (
        f'<inertial><origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/><mass '
        f'value="{max(link.mass, _LEAST_MASS)!r}"/>'
        f'<inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


_idle: list[int] = []
"""Physics clients that nobody uses. To connect takes 20 ms and more, during which no Python runs:
a cell in real time would hear nothing of its drives. To empty a client takes 1 ms."""


def _connect(owner: object) -> tuple[int, Callable[[], object]]:
    """Return an empty physics client and what gives it back: at the latest, the end of its owner,
    as a lock-step cell that is given up is not closed."""
    client = _idle.pop() if _idle else pybullet.connect(pybullet.DIRECT)
    pybullet.resetSimulation(physicsClientId=client)
    return client, weakref.finalize(owner, _idle.append, client)


class BulletArmDynamics:
    """Mass matrix and bias torques of the arm by PyBullet, without rotors and friction; a physics
    client of its own. Implements `physics.ArmDynamics`."""

    def __init__(
        self, model: PumaModel, gravity: float, flange_load: PrincipalInertia | None = None
    ) -> None:
        self._client, self._disconnect = _connect(self)
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
        """Give the physics client back."""
        self._disconnect()


class BulletBallContact:
    """Ball, table and cup in a physics client of its own. Everything in the base frame. Implements
    `physics.BallContact`."""

    def __init__(
        self,
        model: BallModel,
        table: TableTruth,
        cup: CupTruth,
        wall: float,
        settings: Mapping[str, Any],
    ) -> None:
        """`wall`: thickness of the cup's wall and bottom (m); `settings`: the laboratory file."""
        self._model = model
        self._cup_depth = cup.depth
        self.dt = float(settings["step"]["contact"])
        self._client, self._disconnect = _connect(self)
        pybullet.setGravity(0.0, 0.0, -model.gravity, physicsClientId=self._client)
        pybullet.setTimeStep(self.dt, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            contactBreakingThreshold=1e-5,
            contactERP=0.02,
            erp=0.02,
            restitutionVelocityThreshold=0.05,
            physicsClientId=self._client,
        )
        self._ball = self._body(model.mass, self._shape(pybullet.GEOM_SPHERE, radius=model.radius))
        self._surface(self._ball, 1.0, 1.0)  # Bullet multiplies both bodies' coefficients
        inertia = model.inertia_factor * model.mass * model.radius**2
        pybullet.changeDynamics(
            self._ball, -1, localInertiaDiagonal=[inertia] * 3, physicsClientId=self._client
        )
        self._make_table(table, settings["ball"])
        self._cup = self._load(cup_urdf(cup, wall, int(settings["cup"]["walls"])))
        self._surface(self._cup, cup.restitution, float(settings["cup"]["friction"]))
        # Bullet's rolling friction is a lever arm (m).
        lever = float(settings["cup"]["rolling_resistance"]) * model.radius
        pybullet.changeDynamics(self._cup, -1, rollingFriction=lever, physicsClientId=self._client)
        pybullet.setCollisionFilterPair(
            self._table, self._cup, -1, -1, 0, physicsClientId=self._client
        )

    def _shape(self, kind: int, **size: Any) -> int:
        return int(pybullet.createCollisionShape(kind, physicsClientId=self._client, **size))

    def _body(
        self, mass: float, shape: int, position: tuple[float, float, float] = (0.0, 0.0, -10.0)
    ) -> int:
        return int(
            pybullet.createMultiBody(mass, shape, -1, position, physicsClientId=self._client)
        )

    def _surface(self, body: int, restitution: float, friction: float) -> None:
        pybullet.changeDynamics(
            body,
            -1,
            restitution=restitution,
            lateralFriction=friction,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self._client,
        )

    def _make_table(self, table: TableTruth, ball: Mapping[str, Any]) -> None:
        length = table.far_edge - table.near_edge
        half = [length / 2.0, table.half_width, TABLE_TOP / 2.0]
        centre = (table.near_edge + length / 2.0, 0.0, table.top - TABLE_TOP / 2.0)
        self._table = self._body(0.0, self._shape(pybullet.GEOM_BOX, halfExtents=half), centre)
        self._surface(self._table, float(ball["table_restitution"]), float(ball["friction"]))

    def _load(self, text: str) -> int:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "cup.urdf"
            file.write_text(text, encoding="utf-8")
            return int(pybullet.loadURDF(str(file), physicsClientId=self._client))

    def put_ball(self, state: BallState) -> None:
        """Set the ball's state."""
        pybullet.resetBasePositionAndOrientation(
            self._ball, state.position, (0.0, 0.0, 0.0, 1.0), physicsClientId=self._client
        )
        pybullet.resetBaseVelocity(
            self._ball, state.velocity, state.spin, physicsClientId=self._client
        )

    def ball(self) -> BallState:
        """Return the ball's state."""
        position, _ = pybullet.getBasePositionAndOrientation(
            self._ball, self._client
        )  # Positional arguments are a third faster.
        velocity, spin = pybullet.getBaseVelocity(self._ball, self._client)
        return BallState(position, velocity, spin)

    def step(self, before: Frame3, after: Frame3) -> BallState:
        """Step by `dt` while the cup moves from `before` to `after` (origin: mouth centre, z out of
        the mouth)."""
        (vx, vy, vz), (wx, wy, wz) = twist(before, after, self.dt)
        (zx, zy, zz), (ox, oy, oz), depth = before.z, before.origin, self._cup_depth
        rx, ry, rz = (
            -depth * zx,
            -depth * zy,
            -depth * zz,
        )  # From the mouth to the body's origin, the inner bottom.
        # The last term: the step subtracts the effect of gravity again before contacts are solved.
        speed = (
            vx + wy * rz - wz * ry,
            vy + wz * rx - wx * rz,
            vz + wx * ry - wy * rx + self._model.gravity * self.dt,
        )
        client = self._client
        pybullet.resetBasePositionAndOrientation(
            self._cup, (ox + rx, oy + ry, oz + rz), quaternion(before), client
        )
        pybullet.resetBaseVelocity(self._cup, speed, (wx, wy, wz), client)
        pybullet.stepSimulation(client)
        return self.ball()

    def close(self) -> None:
        """Give the physics client back."""
        self._disconnect()


def cup_urdf(cup: CupTruth, wall: float, count: int) -> str:
    """Return the cup as URDF: `count` boxes around the z axis and a disc below; origin in the
    middle of the inner bottom."""
    reach, width = cup.radius + wall / 2.0, 2.0 * (cup.radius + wall) * math.tan(math.pi / count)
    shapes = []
    for k in range(count):
        angle = 2.0 * math.pi * k / count
        shapes.append(
            f'<origin xyz="{reach * math.cos(angle)!r} {reach * math.sin(angle)!r} '
            f'{cup.depth / 2.0!r}" rpy="0 0 {angle!r}"/>'
            f'<geometry><box size="{wall!r} {width!r} {cup.depth!r}"/></geometry>'
        )
    shapes.append(
        f'<origin xyz="0 0 {-wall / 2.0 - _HULL_MARGIN!r}"/>'
        f'<geometry><cylinder radius="{cup.radius + wall - _HULL_MARGIN!r}" '
        f'length="{wall!r}"/></geometry>'
    )
    collisions = "".join(f"<collision>{shape}</collision>" for shape in shapes)
    inertial = (
        f'<mass value="{_ANVIL!r}"/><inertia ixx="1e3" iyy="1e3" izz="1e3" ixy="0" '
        'ixz="0" iyz="0"/>'
    )
    return (
        '<robot name="cup"><link '
        f'name="cup"><inertial>{inertial}</inertial>{collisions}</link></robot>'
    )


def quaternion(frame: Frame3) -> Quaternion:
    """Return the orientation of a frame as (x, y, z, w); the largest component comes first, so
    nothing is divided by a small one."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz), _ = frame
    trace = xx + yy + zz
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        return (yz - zy) / s, (zx - xz) / s, (xy - yx) / s, 0.25 * s
    if xx >= yy and xx >= zz:
        s = 2.0 * math.sqrt(1.0 + xx - yy - zz)
        return 0.25 * s, (yx + xy) / s, (zx + xz) / s, (yz - zy) / s
    if yy >= zz:
        s = 2.0 * math.sqrt(1.0 + yy - xx - zz)
        return (yx + xy) / s, 0.25 * s, (zy + yz) / s, (zx - xz) / s
    s = 2.0 * math.sqrt(1.0 + zz - xx - yy)
    return (zx + xz) / s, (zy + yz) / s, 0.25 * s, (xy - yx) / s
