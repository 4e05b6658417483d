"""Where the cup is for the arm's joint angles, as pure numbers: a kernel of sim/site.py."""

from __future__ import annotations

import math
from collections.abc import Sequence

from petrobot.services.comm.compiled import kernel, packed
from petrobot.sim.arm_motion import Six
from petrobot.sim.puma_model import ArmModel

Triple = tuple[float, float, float]


@kernel
def carried(q: Six, numbers: Sequence[float]) -> tuple[Triple, Triple, Triple, Triple]:
    """Axes x, y, z and origin (m, base frame) of a frame mounted on the flange, at encoder angles
    `q` (rad).

    `numbers` (see `numbers_of`): five a joint (zero of its encoder in rad, d and a in m, cosine and
    sine of alpha), the base (m), then the frame's axes and origin in the flange's frame. The same
    sums in the same order as `ArmModel.flange_frame` and `Frame3.point`, which say what they mean.
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
    arm: ArmModel, zero: Sequence[float], axes: Sequence[Triple], origin: Triple
) -> Sequence[float]:
    """What `carried` reads: an arm with encoders that show `zero` (six, rad) too little, and a
    frame mounted on its flange."""
    joints = zip(zero, arm.d, arm.a, arm.twists, strict=True)
    each = [
        number for angle, d, a, (cosine, sine) in joints for number in (angle, d, a, cosine, sine)
    ]
    return packed(
        carried, [*each, *arm.base, *[number for axis in axes for number in axis], *origin]
    )
