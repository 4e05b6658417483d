"""One laboratory site: the nominal cell, the arm and the drives' ratings, read from the files that
services.toml names; and where the cup is for the arm's joint angles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.services.host.numba_kernels import kernel, packed
from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.drives import DriveRating, ratings
from petrobot.sim.catching.puma_model import Frame3, PrincipalInertia, PumaModel, read_arm
from petrobot.sim.catching.truth import (
    LABORATORY_FILE,
    LaboratoryError,
    Truth,
    read_toml,
    read_truth,
)

# Where the cup is for the arm's joint angles, as pure numbers.


@kernel
def carried(q: Six, numbers: Sequence[float]) -> tuple[Triple, Triple, Triple, Triple]:
    """Return axes x, y, z and origin (m, base frame) of a frame mounted on the flange, at encoder
    angles `q` (rad).

    `numbers` (see `numbers_of`): five per joint (zero of its encoder in rad, d and a in m, cosine
    and sine of alpha), the base (m), then the frame's axes and origin in the flange's frame. The
    same sums in the same order as `PumaModel.frames` and `Frame3.point`, which explain them.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    ox, oy, oz = numbers[30], numbers[31], numbers[32]
    at = 0
    for encoder in q:
        angle, d, a = encoder + numbers[at], numbers[at + 1], numbers[at + 2]
        ca, sa = numbers[at + 3], numbers[at + 4]
        at += 5
        c, s = math.cos(angle), math.sin(angle)
        nx, ny, nz = c * yx - s * xx, c * yy - s * xy, c * yz - s * xz
        xx, xy, xz = c * xx + s * yx, c * xy + s * yy, c * xz + s * yz
        ox, oy, oz = ox + d * zx + a * xx, oy + d * zy + a * xy, oz + d * zz + a * xz
        yx, yy, yz = ca * nx + sa * zx, ca * ny + sa * zy, ca * nz + sa * zz
        zx, zy, zz = ca * zx - sa * nx, ca * zy - sa * ny, ca * zz - sa * nz
    a, b, c = numbers[33], numbers[34], numbers[35]
    x = (
        (ox + a * xx + b * yx + c * zx) - ox,
        (oy + a * xy + b * yy + c * zy) - oy,
        (oz + a * xz + b * yz + c * zz) - oz,
    )
    a, b, c = numbers[36], numbers[37], numbers[38]
    y = (
        (ox + a * xx + b * yx + c * zx) - ox,
        (oy + a * xy + b * yy + c * zy) - oy,
        (oz + a * xz + b * yz + c * zz) - oz,
    )
    a, b, c = numbers[39], numbers[40], numbers[41]
    z = (
        (ox + a * xx + b * yx + c * zx) - ox,
        (oy + a * xy + b * yy + c * zy) - oy,
        (oz + a * xz + b * yz + c * zz) - oz,
    )
    a, b, c = numbers[42], numbers[43], numbers[44]
    return (
        x,
        y,
        z,
        (
            ox + a * xx + b * yx + c * zx,
            oy + a * xy + b * yy + c * zy,
            oz + a * xz + b * yz + c * zz,
        ),
    )


def numbers_of(
    arm: PumaModel, zero: Sequence[float], axes: Sequence[Triple], origin: Triple
) -> Sequence[float]:
    """Return the argument of `carried`: an arm with encoders that show `zero` (six, rad) too
    little, and a frame mounted on its flange."""
    joints = zip(zero, arm.d, arm.a, arm.twists, strict=True)
    each = [
        number for angle, d, a, (cosine, sine) in joints for number in (angle, d, a, cosine, sine)
    ]
    return packed(
        carried, [*each, *arm.base, *[number for axis in axes for number in axis], *origin]
    )


class Site(Struct, frozen=True):
    """The nominal data of the laboratory. `laboratory` is the file of errors, regimes and
    disturbances."""

    cell: Mapping[str, Any]
    arm: PumaModel
    drives: tuple[DriveRating, ...]
    laboratory: Path = LABORATORY_FILE

    def truth(self, regime: str) -> Truth:
        """Return the truth in a regime. Raises LaboratoryError for an unknown name."""
        return read_truth(self.cell, regime, self.laboratory)


def read_site(cell_file: Path, laboratory: Path = LABORATORY_FILE) -> Site:
    """Read the site from a file like services/cell.toml; it names the arm's file, relative to
    itself."""
    cell = read_toml(cell_file)
    try:
        arm_file = cell_file.parent / cell["arm"]["model"]
    except KeyError as fault:
        raise LaboratoryError(
            f"{cell_file}: [arm] model is missing; it names the arm's file, relative to this one"
        ) from fault
    arm = read_arm(arm_file)
    try:
        drives = ratings(read_toml(arm_file))
    except KeyError as fault:
        raise LaboratoryError(
            f"{arm_file}: key {fault} of a [[joint]] is missing; drives need torque, speed "
            "and inertia"
        ) from fault
    return Site(cell, arm, drives, laboratory)


def site_of(directory: Directory) -> Site:
    """Return the site that services.toml names: `[parameters] cell`, and `laboratory` if it is not
    the shipped one."""
    if "cell" not in directory.parameters:
        raise LaboratoryError(
            f'{directory.source}: [parameters] cell is missing; write cell = "services/cell.toml"'
        )
    return read_site(directory.file(directory.parameters["cell"]), laboratory_file(directory))


def laboratory_file(directory: Directory) -> Path:
    """Return the path of the laboratory file of services.toml."""
    named = directory.parameters.get("laboratory")
    return directory.file(named) if named else LABORATORY_FILE


class CupMount:
    """Where the cup really is for encoder angles: the arm's flange and the true mount."""

    def __init__(self, arm: PumaModel, truth: Truth) -> None:
        self._arm = arm
        self._zero: list[float] = truth.joint_zero.tolist()
        axis, mouth = truth.cup.axis, truth.cup.mouth
        self._z = _triple(axis)
        aside = (0.0, 1.0, 0.0) if abs(axis[1]) < 0.9 else (1.0, 0.0, 0.0)
        self._x = _unit(_cross(aside, self._z))
        self._y = _cross(self._z, self._x)
        self._mouth = _triple(mouth)
        self._bottom = _triple(mouth - truth.cup.depth * axis)
        self._numbers = numbers_of(arm, self._zero, (self._x, self._y, self._z), self._mouth)

    def frame(self, q: Six) -> Frame3:
        """Return the cup's frame at encoder angles (rad): origin in the middle of the mouth, z out
        of it."""
        x, y, z, origin = carried(q, self._numbers)
        return Frame3(x, y, z, origin)

    def solid_parts(self, q: Sequence[float]) -> tuple[Any, Any]:
        """Return the capsules of the arm at encoder angles: end points (6, 2, 3) and radii (6,), m,
        base frame."""
        true = [angle + zero for angle, zero in zip(q, self._zero, strict=True)]
        return self._arm.solid_parts(true, self._bottom)

    def load(self, mass: float, radius: float, depth: float) -> PrincipalInertia:
        """Return the cup as a body on the flange (kg, m): a thin tube around its axis."""
        middle = tuple(0.5 * (m + b) for m, b in zip(self._mouth, self._bottom, strict=True))
        along, across = mass * radius**2, mass * (0.5 * radius**2 + depth**2 / 12.0)
        inertia = tuple(along * a * a + across * (1.0 - a * a) for a in self._z)
        return PrincipalInertia(
            mass, (middle[0], middle[1], middle[2]), (inertia[0], inertia[1], inertia[2])
        )


Triple = tuple[float, float, float]


def _triple(v: Any) -> Triple:
    return float(v[0]), float(v[1]), float(v[2])


def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(a: Triple) -> Triple:
    size = (a[0] ** 2 + a[1] ** 2 + a[2] ** 2) ** 0.5
    return a[0] / size, a[1] / size, a[2] / size
