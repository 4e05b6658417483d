"""The arm as numbers and geometry: read from the arm file, forward kinematics, solid parts. SI
units, radians.

The laboratory reads the published values from the file that services.toml or cell.toml names; it
has no copy of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct

from petrobot.sim.catching.truth import LaboratoryError, Vector, read_toml

JOINTS = 6
_DEGREE = math.pi / 180.0


class Frame3(NamedTuple):
    """A frame in the base frame: its axes x, y, z and its origin, each (x, y, z)."""

    x: tuple[float, float, float]
    y: tuple[float, float, float]
    z: tuple[float, float, float]
    origin: tuple[float, float, float]

    def rotation(self) -> Vector:
        """Return the rotation (3, 3); its columns are the axes."""
        return np.array((self.x, self.y, self.z)).T

    def point(self, p: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return a point given in this frame in the base frame."""
        a, b, c = p
        x, y, z, o = self
        return (
            o[0] + a * x[0] + b * y[0] + c * z[0],
            o[1] + a * x[1] + b * y[1] + c * z[1],
            o[2] + a * x[2] + b * y[2] + c * z[2],
        )

    def local(self, p: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return a point given in the base frame in this frame."""
        x, y, z, o = self
        a, b, c = p[0] - o[0], p[1] - o[1], p[2] - o[2]
        return (
            a * x[0] + b * x[1] + c * x[2],
            a * y[0] + b * y[1] + c * y[2],
            a * z[0] + b * z[1] + c * z[2],
        )


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
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz), o = before
    (ax, ay, az), (bx, by, bz), (cx, cy, cz), p = after
    wx = (xy * az - xz * ay) + (yy * bz - yz * by) + (zy * cz - zz * cy)
    wy = (xz * ax - xx * az) + (yz * bx - yx * bz) + (zz * cx - zx * cz)
    wz = (xx * ay - xy * ax) + (yx * by - yy * bx) + (zx * cy - zy * cx)
    half = 0.5 / dt
    return ((p[0] - o[0]) / dt, (p[1] - o[1]) / dt, (p[2] - o[2]) / dt), (
        wx * half,
        wy * half,
        wz * half,
    )


class PrincipalInertia(Struct, frozen=True):
    """Mass (kg), centre of mass (m) and principal inertia about it (kg m^2) in the link's own DH
    frame."""

    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]


def real_inertia(inertia: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return principal moments with the lesser ones raised just enough to belong to a real body
    (triangle inequality); the greatest is kept.

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


class PumaModel(Struct, frozen=True):
    """One entry per joint, base to flange. `rotor`, `viscous`, `coulomb` are converted to the joint
    (kg m^2, N m s/rad, N m)."""

    base: tuple[float, float, float]
    d: tuple[float, ...]
    a: tuple[float, ...]
    alpha: tuple[float, ...]
    twists: tuple[tuple[float, float], ...]
    """Cosine and sine of each alpha, exact for right angles."""
    lower: Vector
    upper: Vector
    speed: Vector
    acceleration: Vector
    torque: Vector
    rotor: Vector
    viscous: Vector
    coulomb: Vector
    links: tuple[PrincipalInertia, ...]
    flange: float
    radii: Mapping[str, float]
    """m, of the capsules that stand for the solid parts of the arm: base, upper_arm, forearm,
    wrist."""
    poses: Mapping[str, Vector]

    def frames(self, q: Sequence[float]) -> tuple[Frame3, ...]:
        """Return frames 0 to 6 at joint angles `q` (six, rad)."""
        # plain floats: 8 us a pose
        frames = [Frame3((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), self.base)]
        xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
        ox, oy, oz = self.base
        for angle, d, a, (ca, sa) in zip(q, self.d, self.a, self.twists, strict=True):
            c, s = math.cos(angle), math.sin(angle)
            nx, ny, nz = c * yx - s * xx, c * yy - s * xy, c * yz - s * xz
            xx, xy, xz = c * xx + s * yx, c * xy + s * yy, c * xz + s * yz
            ox, oy, oz = ox + d * zx + a * xx, oy + d * zy + a * xy, oz + d * zz + a * xz
            yx, yy, yz = ca * nx + sa * zx, ca * ny + sa * zy, ca * nz + sa * zz
            zx, zy, zz = ca * zx - sa * nx, ca * zy - sa * ny, ca * zz - sa * nz
            frames.append(Frame3((xx, xy, xz), (yx, yy, yz), (zx, zy, zz), (ox, oy, oz)))
        return tuple(frames)

    def solid_parts(
        self, q: Sequence[float], cup_bottom: tuple[float, float, float]
    ) -> tuple[Vector, Vector]:
        """Return the capsules of the arm: end points (6, 2, 3) in the base frame and radii (6,), m;
        the last one holds the cup."""
        frames = self.frames(q)
        shoulder, elbow, wrist = frames[1].origin, frames[2].origin, frames[4].origin
        beside = frames[2].point((0.0, 0.0, self.d[2]))
        flange = frames[JOINTS].point((0.0, 0.0, self.flange))
        ends = [
            (self.base, shoulder),
            (shoulder, elbow),
            (elbow, beside),
            (beside, wrist),
            (wrist, flange),
            (flange, frames[JOINTS].point(cup_bottom)),
        ]
        r = self.radii
        return np.array(ends), np.array(
            [r["base"], r["upper_arm"], r["forearm"], r["forearm"], r["wrist"], 0.015]
        )


def read_arm(path: Path) -> PumaModel:
    """Read the arm of a file like services/motion/puma560.toml. Raises LaboratoryError naming file,
    key and remedy."""
    table = read_toml(path)
    try:
        joints, links = table["joint"], table["link"]
        if len(joints) != JOINTS or len(links) != JOINTS:
            raise LaboratoryError(
                f"{path}: expected {JOINTS} tables [[joint]] and [[link]] each, got {len(joints)} "
                f"and {len(links)}"
            )
        return _model(table, joints, links)
    except KeyError as fault:
        raise LaboratoryError(
            f"{path}: key {fault} is missing; the head of the shipped file lists the keys"
        ) from fault
    except (TypeError, ValueError) as fault:
        raise LaboratoryError(
            f"{path}: {fault}; the head of the shipped file says what each key holds"
        ) from fault


def _model(
    table: Mapping[str, Any], joints: list[dict[str, Any]], links: list[dict[str, Any]]
) -> PumaModel:
    def column(key: str) -> Vector:
        return np.array([float(joint[key]) for joint in joints])

    gear = column("gear")
    limits = np.array([joint["limits"] for joint in joints], dtype=float) * _DEGREE
    x, y, z = table["frame"]["base"]
    return PumaModel(
        base=(float(x), float(y), float(z)),
        d=tuple(column("d").tolist()),
        a=tuple(column("a").tolist()),
        alpha=tuple((column("alpha") * _DEGREE).tolist()),
        twists=tuple(
            (round(math.cos(t), 15), round(math.sin(t), 15))
            for t in (column("alpha") * _DEGREE).tolist()
        ),
        lower=limits[:, 0],
        upper=limits[:, 1],
        speed=column("speed") * _DEGREE,
        acceleration=column("acceleration"),
        torque=column("torque"),
        rotor=gear**2 * column("rotor_inertia"),
        viscous=gear**2 * column("viscous"),
        coulomb=gear * column("coulomb"),
        links=tuple(
            PrincipalInertia(float(n["mass"]), tuple(n["centre"]), tuple(n["inertia"]))
            for n in links
        ),
        flange=float(table["frame"]["flange"]),
        radii={key: float(value) for key, value in table["body"].items()},
        poses={
            name: np.array(pose, dtype=float) * _DEGREE for name, pose in table["poses"].items()
        },
    )
