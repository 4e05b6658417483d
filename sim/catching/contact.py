"""Where the ball may touch something: a small PyBullet space of ball, table and cup, stepped at 1
kHz.

The cup is 16 flat boxes and a disc that move with the arm. Bullet gives bodies without mass no
velocity in a contact, so the cup is a free body with a mass (1 t) that no ball can move; each step
puts it where the arm holds it, with the velocity that takes it to where the arm will hold it next.
It is loaded as URDF, since a body made otherwise has 16 shapes at most, and with two bodies a step
takes more than twice the time (21 us instead of 9).

Restitution: Bullet lets contacts act before bodies touch and then forgets the bounce, and its
correction of overlap adds speed. With a breaking threshold of 10 um and a correction of 2 % per
step, impacts at 0.2 to 2.4 m/s on a resting or moving cup return with 0.30 to 0.33 of their speed
for a coefficient of 0.3 (tests/sim/test_contact.py).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pybullet

from petrobot.sim.catching.ball import BallModel, BallState
from petrobot.sim.catching.puma_model import Frame3
from petrobot.sim.catching.truth import CupTruth, TableTruth

_ANVIL = 1000.0
"""kg, mass of the cup."""
_HULL_MARGIN = 0.001
"""m by which Bullet enlarges a cylinder of a URDF in all directions."""
_SLAB = 0.030
"""m, thickness of the table top."""
Quaternion = tuple[float, float, float, float]


class ContactSpace:
    """Ball, table and cup in a physics client of its own. Everything in the base frame."""

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
        self._client = pybullet.connect(pybullet.DIRECT)
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
        half = [length / 2.0, table.half_width, _SLAB / 2.0]
        centre = (table.near_edge + length / 2.0, 0.0, table.top - _SLAB / 2.0)
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
        """Disconnect the physics client."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1


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


def twist(
    before: Frame3, after: Frame3, dt: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Velocity of the origin (m/s) and angular velocity (rad/s) that lead from one frame to another
    in `dt` (s).

    Angular velocity to first order in the angle turned, half the sum of axis x change of axis:
    exact to 1e-5 at 5 rad/s.
    """
    if before is after:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    o, p = before.origin, after.origin
    wx = wy = wz = 0.0
    for a, b in zip(before[:3], after[:3], strict=True):
        wx += a[1] * b[2] - a[2] * b[1]
        wy += a[2] * b[0] - a[0] * b[2]
        wz += a[0] * b[1] - a[1] * b[0]
    half = 0.5 / dt
    return ((p[0] - o[0]) / dt, (p[1] - o[1]) / dt, (p[2] - o[2]) / dt), (
        wx * half,
        wy * half,
        wz * half,
    )
