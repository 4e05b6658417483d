"""Mass matrix and bias torques of the arm in this project's own code, for the portable back end.

The recursive Newton-Euler algorithm (J. Y. S. Luh, M. W. Walker, R. P. C. Paul, On-line
computational scheme for mechanical manipulators, J. Dyn. Syst. Meas. Control 102, 1980) and the
composite rigid body algorithm (M. W. Walker, D. E. Orin, Efficient dynamic computer simulation of
robotic mechanisms, J. Dyn. Syst. Meas. Control 104, 1982) in link coordinates. Frame i stands at
joint i and turns with link i; its z axis is the joint's axis.

Three steps make them fast. Second moments replace the inertia tensors (C. A. Balafoutis, R. V.
Patel, P. Misra, Efficient modeling and computation of manipulator dynamics using orthogonal
Cartesian tensors, IEEE J. Robotics and Automation 4, 1988). The numbers of the links are regrouped,
so that masses and some moments are zero. And for arms with the geometry of a PUMA, right angles and
offsets that are zero, both algorithms are written out without the terms that vanish. Other arms
have `general_torques`, which is slower.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from petrobot.services.host.numba_kernels import kernel, packed
from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.puma_model import JOINTS, PrincipalInertia, PumaModel, real_inertia
from petrobot.sim.catching.truth import Vector

WIDTH = 11
"""Numbers of each joint; `regrouped` lists them."""


def regrouped(model: PumaModel, load: PrincipalInertia | None = None) -> list[float]:
    """Return the arm as numbers for the recursions; `load` is what the flange carries, in frame 6.

    For each joint: a and d (m), cosine and sine of alpha of the joint before; then of its link the
    first moments x and y (kg m) and the second moments xx, yy, xy, xz and yz (kg m^2: the sum of
    mass times x x, ...), all about the frame's origin.

    A thin rod on the axis of joint i does not feel that joint's rotation, so it may belong to link
    i - 1 instead. From each link, last to first, a rod is cut off that has the link's mass, its
    first moment along z, and its second moment zz. So these three are zero for what is left of the
    link. Nothing else changes: tests/sim/test_puma.py compares arms that have no zero anywhere
    with PyBullet.
    """
    numbers: list[float] = []
    rod_mass, rod_moment, rod_second = 0.0, np.zeros(3), np.zeros((3, 3))
    for i in reversed(range(JOINTS)):
        # From the link's far end, where its published numbers and the next link's rod are given, to
        # its own frame.
        c, s = model.twists[i]
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        offset = np.array([model.a[i], 0.0, model.d[i]])
        bodies = [model.links[i], *([load] if load is not None and i == JOINTS - 1 else [])]
        mass, moment = rod_mass, turn @ rod_moment
        both = np.outer(moment, offset)
        second = turn @ rod_second @ turn.T + both + both.T + mass * np.outer(offset, offset)
        moment = moment + mass * offset
        for body in bodies:
            centre = turn @ np.array(body.centre) + offset
            principal = np.array(real_inertia(body.inertia))
            own = turn @ np.diag(0.5 * principal.sum() - principal) @ turn.T
            second = second + own + body.mass * np.outer(centre, centre)
            mass, moment = mass + body.mass, moment + body.mass * centre
        rod_mass, rod_moment = mass, np.array([0.0, 0.0, moment[2]])
        rod_second = np.diag([0.0, 0.0, second[2, 2]])
        (c, s), a, d = (
            (model.twists[i - 1], model.a[i - 1], model.d[i - 1]) if i else ((1.0, 0.0), 0.0, 0.0)
        )
        numbers[:0] = [a, d, c, s, moment[0], moment[1], second[0, 0], second[1, 1]]
        numbers[8:8] = [second[0, 1], second[0, 2], second[1, 2]]
    return [float(number) for number in numbers]


_TWISTS = (1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (0.0, -1.0)
_NO_A, _NO_D = (1, 4, 5), (2, 5)
"""Joints (from 0) before which a PUMA has no a, no d."""


def is_puma(numbers: Sequence[float]) -> bool:
    """Return whether an arm, `regrouped`, has the geometry that `puma_bias` and `puma_mass`
    assume."""
    rows = [tuple(numbers[at : at + 4]) for at in range(0, JOINTS * WIDTH, WIDTH)]
    return (
        tuple((c, s) for _, _, c, s in rows) == _TWISTS
        and all(rows[joint][0] == 0.0 for joint in _NO_A)
        and all(rows[joint][1] == 0.0 for joint in _NO_D)
    )


# How a link moves is given by its angular velocity w, its angular acceleration, the acceleration v
# of its frame's origin (that of the base is g upwards, which stands for gravity), and the matrix u
# with which a point p of the link has the acceleration v + u p: u = [acceleration]x + [w]x [w]x.
# A link with first moments h and second moments s then takes the force u h (its mass is zero) and,
# about its origin, the torque sum of p x u p, which is linear in s, and h x v.


def general_torques(
    q: Sequence[float],
    qd: Sequence[float],
    qdd: Sequence[float],
    gravity: float,
    numbers: Sequence[float],
) -> Six:
    """Return the six torques (N m) that move an arm with speeds `qd` (rad/s) and accelerations
    `qdd` (rad/s^2) at angles `q` (rad), whatever its geometry."""
    u, forces, torques = np.zeros((3, 3)), [], []
    speed, turning, v = np.zeros(3), np.zeros(3), np.array([0.0, 0.0, gravity])
    turns, offsets, axis = [], [], np.array([0.0, 0.0, 1.0])
    for joint in range(JOINTS):
        a, d, ca, sa, hx, hy, xx, yy, xy, xz, yz = numbers[joint * WIDTH : (joint + 1) * WIDTH]
        c, s = math.cos(q[joint]), math.sin(q[joint])
        turns.append(np.array([[c, -s, 0.0], [ca * s, ca * c, -sa], [sa * s, sa * c, ca]]))
        offsets.append(np.array([a, 0.0, d]))
        back = turns[-1].T
        v = back @ (v + u @ offsets[-1])
        speed, turning = back @ speed, back @ turning
        turning = turning + qdd[joint] * axis + qd[joint] * np.cross(speed, axis)
        speed = speed + qd[joint] * axis
        u = np.outer(speed, speed) - speed @ speed * np.eye(3) + np.cross(np.eye(3), turning)
        h, second = np.array([hx, hy, 0.0]), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, 0.0]])
        forces.append(u @ h)
        w = second @ u.T  # the sum of p (u p)^T
        torque = np.array([w[1, 2] - w[2, 1], w[2, 0] - w[0, 2], w[0, 1] - w[1, 0]])
        torques.append(torque + np.cross(h, v))
    for joint in range(JOINTS - 1, 0, -1):
        force = turns[joint] @ forces[joint]
        forces[joint - 1] += force
        torques[joint - 1] += turns[joint] @ torques[joint] + np.cross(offsets[joint], force)
    one, two, three, four, five, six = (float(torque[2]) for torque in torques)
    return one, two, three, four, five, six


@kernel
def puma_bias(q: Six, qd: Six, gravity: float, numbers: Sequence[float]) -> Six:
    """Return the torques (N m) that hold a PUMA against gravity, Coriolis and centrifugal forces at
    angles `q` (rad) and speeds `qd` (rad/s)."""
    cos, sin = math.cos, math.sin
    _, b2, b3, b4, b5, b6 = qd
    c2, c3, c4, c5, c6 = cos(q[1]), cos(q[2]), cos(q[3]), cos(q[4]), cos(q[5])
    s2, s3, s4, s5, s6 = sin(q[1]), sin(q[2]), sin(q[3]), sin(q[4]), sin(q[5])
    a2, a3, d3, d4 = numbers[22], numbers[33], numbers[34], numbers[45]

    # Link 2. Here and below: w angular velocity, a angular acceleration, v acceleration of the
    # origin, u as above, f and n the link's force and torque.
    wx, wy, wz = s2 * qd[0], c2 * qd[0], b2
    vx, vy = s2 * gravity, c2 * gravity
    ax, ay = wy * wz, -wx * wz
    pp, qq, zz = wx * wx, wy * wy, wz * wz
    uxx, uyy, uzz, uxy = -qq - zz, -pp - zz, -pp - qq, wx * wy
    uzx, uzy = -2.0 * ay, 2.0 * ax  # uxz and uyz are zero, uyx is uxy
    hx, hy, xx, yy = numbers[15], numbers[16], numbers[17], numbers[18]
    xy, xz, yz = numbers[19], numbers[20], numbers[21]
    n2x = uzx * xy - uxy * xz + uzy * yy + (uzz - uyy) * yz
    n2y = (uxx - uzz) * xz + uxy * yz - uzx * xx - uzy * xy
    n2z = (uyy - uxx) * xy + uxy * (xx - yy) + hx * vy - hy * vx

    # Link 3, whose axis is parallel
    x, y, z = vx + uxx * a2, vy + uxy * a2, uzx * a2
    vx, vy, vz = c3 * x + s3 * y, c3 * y - s3 * x, z
    wx, wy, wz = c3 * wx + s3 * wy, c3 * wy - s3 * wx, wz + b3
    ax, ay, az = c3 * ax + s3 * ay + wy * b3, c3 * ay - s3 * ax - wx * b3, 0.0
    pp, qq, zz, pq, pz, qz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
    uxx, uyy, uzz, uxy = -qq - zz, -pp - zz, -pp - qq, pq
    uxz, uzx, uyz, uzy = pz + ay, pz - ay, qz - ax, qz + ax
    hx, hy, xx, yy = numbers[26], numbers[27], numbers[28], numbers[29]
    xy, xz, yz = numbers[30], numbers[31], numbers[32]
    f3x, f3y, f3z = uxx * hx + uxy * hy, uxy * hx + uyy * hy, uzx * hx + uzy * hy
    n3x = uzx * xy - uxy * xz + uzy * yy + (uzz - uyy) * yz + hy * vz
    n3y = (uxx - uzz) * xz + uxy * yz - uzx * xx - uzy * xy - hx * vz
    n3z = (uyy - uxx) * xy + uxy * (xx - yy) + uyz * xz - uxz * yz + hx * vy - hy * vx

    # Link 4, whose axis is turned by -90 degrees
    x, y, z = vx + uxx * a3 + uxz * d3, vy + uxy * a3 + uyz * d3, vz + uzx * a3 + uzz * d3
    vx, vy, vz = c4 * x - s4 * z, -c4 * z - s4 * x, y
    wx, wy, wz = c4 * wx - s4 * wz, -c4 * wz - s4 * wx, wy + b4
    ax, ay, az = c4 * ax - s4 * az + wy * b4, -c4 * az - s4 * ax - wx * b4, ay
    pp, qq, zz, pq, pz, qz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
    uxx, uyy, uzz = -qq - zz, -pp - zz, -pp - qq
    uxy, uyx, uxz, uzx, uyz, uzy = pq - az, pq + az, pz + ay, pz - ay, qz - ax, qz + ax
    hx, hy, xx, yy = numbers[37], numbers[38], numbers[39], numbers[40]
    xy, xz, yz = numbers[41], numbers[42], numbers[43]
    f4x, f4y, f4z = uxx * hx + uxy * hy, uyx * hx + uyy * hy, uzx * hx + uzy * hy
    n4x = uzx * xy - uyx * xz + uzy * yy + (uzz - uyy) * yz + hy * vz
    n4y = (uxx - uzz) * xz + uxy * yz - uzx * xx - uzy * xy - hx * vz
    n4z = (uyy - uxx) * xy + uyx * xx - uxy * yy + uyz * xz - uxz * yz + hx * vy - hy * vx

    # Link 5: 90 degrees
    x, y, z = vx + uxz * d4, vy + uyz * d4, vz + uzz * d4
    vx, vy, vz = c5 * x + s5 * z, c5 * z - s5 * x, -y
    wx, wy, wz = c5 * wx + s5 * wz, c5 * wz - s5 * wx, b5 - wy
    ax, ay, az = c5 * ax + s5 * az + wy * b5, c5 * az - s5 * ax - wx * b5, -ay
    pp, qq, zz, pq, pz, qz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
    uxx, uyy, uzz = -qq - zz, -pp - zz, -pp - qq
    uxy, uyx, uxz, uzx, uyz, uzy = pq - az, pq + az, pz + ay, pz - ay, qz - ax, qz + ax
    hx, hy, xx, yy = numbers[48], numbers[49], numbers[50], numbers[51]
    xy, xz, yz = numbers[52], numbers[53], numbers[54]
    f5x, f5y, f5z = uxx * hx + uxy * hy, uyx * hx + uyy * hy, uzx * hx + uzy * hy
    n5x = uzx * xy - uyx * xz + uzy * yy + (uzz - uyy) * yz + hy * vz
    n5y = (uxx - uzz) * xz + uxy * yz - uzx * xx - uzy * xy - hx * vz
    n5z = (uyy - uxx) * xy + uyx * xx - uxy * yy + uyz * xz - uxz * yz + hx * vy - hy * vx

    # Link 6: -90 degrees, and its origin is that of link 5
    vx, vy, vz = c6 * vx - s6 * vz, -c6 * vz - s6 * vx, vy
    wx, wy, wz = c6 * wx - s6 * wz, -c6 * wz - s6 * wx, wy + b6
    ax, ay, az = c6 * ax - s6 * az + wy * b6, -c6 * az - s6 * ax - wx * b6, ay
    pp, qq, zz, pq, pz, qz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
    uxx, uyy, uzz = -qq - zz, -pp - zz, -pp - qq
    uxy, uyx, uxz, uzx, uyz, uzy = pq - az, pq + az, pz + ay, pz - ay, qz - ax, qz + ax
    hx, hy, xx, yy = numbers[59], numbers[60], numbers[61], numbers[62]
    xy, xz, yz = numbers[63], numbers[64], numbers[65]
    fx, fy, fz = uxx * hx + uxy * hy, uyx * hx + uyy * hy, uzx * hx + uzy * hy
    nx = uzx * xy - uyx * xz + uzy * yy + (uzz - uyy) * yz + hy * vz
    ny = (uxx - uzz) * xz + uxy * yz - uzx * xx - uzy * xy - hx * vz
    n6z = (uyy - uxx) * xy + uyx * xx - uxy * yy + uyz * xz - uxz * yz + hx * vy - hy * vx

    # Forces and torques add up from link to link, back to the base.
    fx, fy, fz = f5x + c6 * fx - s6 * fy, f5y + fz, f5z - s6 * fx - c6 * fy
    nx, ny, n5z = n5x + c6 * nx - s6 * ny, n5y + n6z, n5z - s6 * nx - c6 * ny
    x, y, z = c5 * fx - s5 * fy, -fz, s5 * fx + c5 * fy
    fx, fy, fz = f4x + x, f4y + y, f4z + z
    x, y, z = c5 * nx - s5 * ny - d4 * y, d4 * x - n5z, s5 * nx + c5 * ny
    nx, ny, n4z = n4x + x, n4y + y, n4z + z
    x, y, z = c4 * fx - s4 * fy, fz, -s4 * fx - c4 * fy
    fx, fy, fz = f3x + x, f3y + y, f3z + z
    x, y, z = c4 * nx - s4 * ny - d3 * y, n4z + d3 * x - a3 * z, a3 * y - s4 * nx - c4 * ny
    nx, ny, n3z = n3x + x, n3y + y, n3z + z
    n2x, n2y = n2x + c3 * nx - s3 * ny, n2y + s3 * nx + c3 * ny - a2 * fz
    n2z = n2z + n3z + a2 * (s3 * fx + c3 * fy)
    return s2 * n2x + c2 * n2y, n2z, n3z, n4z, n5z, n6z


Wrench = tuple[float, float, float, float, float, float]
"""Force (N) and torque about the origin (N m)."""
Body = tuple[float, float, float, float, float, float, float, float, float]
"""First moments x, y, z and second moments xx, yy, zz, xy, xz, yz of a rigid body without mass."""


@kernel
def _joined(body: Body, numbers: Sequence[float], at: int, c: float, s: float) -> Body:
    """Return the body behind a joint and the link before it as one body in that link's frame; the
    joint's numbers begin at `at`."""
    hx, hy, hz, xx, yy, zz, xy, xz, yz = body
    a, d, ca, sa = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    # By the joint's angle about z
    hx, hy = c * hx - s * hy, s * hx + c * hy
    xz, yz = c * xz - s * yz, s * xz + c * yz
    u, v, both = c * xx - s * xy, c * xy - s * yy, xx + yy
    xx, xy = c * u - s * v, s * u + c * v
    yy = both - xx
    # By alpha about x
    hy, hz = ca * hy - sa * hz, sa * hy + ca * hz
    xy, xz = ca * xy - sa * xz, sa * xy + ca * xz
    u, v, both = ca * yy - sa * yz, ca * yz - sa * zz, yy + zz
    yy, yz = ca * u - sa * v, sa * u + ca * v
    zz = both - yy
    at = at - WIDTH
    return (
        hx + numbers[at + 4],
        hy + numbers[at + 5],
        hz,
        xx + 2.0 * a * hx + numbers[at + 6],
        yy + numbers[at + 7],
        zz + 2.0 * d * hz,
        xy + a * hy + numbers[at + 8],
        xz + a * hz + d * hx + numbers[at + 9],
        yz + d * hy + numbers[at + 10],
    )


@kernel
def _before(wrench: Wrench, numbers: Sequence[float], at: int, c: float, s: float) -> Wrench:
    """Return a wrench on a joint, whose numbers begin at `at`, on the joint before."""
    fx, fy, fz, nx, ny, nz = wrench
    a, d, ca, sa = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    fx, fy = c * fx - s * fy, s * fx + c * fy
    fy, fz = ca * fy - sa * fz, sa * fy + ca * fz
    nx, ny = c * nx - s * ny, s * nx + c * ny
    ny, nz = ca * ny - sa * nz, sa * ny + ca * nz
    return fx, fy, fz, nx - d * fy, ny + d * fx - a * fz, nz + a * fy


@kernel
def _started(body: Body) -> Wrench:
    """Return what a joint must give to the body behind it for 1 rad/s^2."""
    hx, hy, _, xx, yy, _, _, xz, yz = body
    return -hy, hx, 0.0, -xz, -yz, xx + yy


@kernel
def mass_numbers(q: Six, numbers: Sequence[float]) -> tuple[float, ...]:
    """Return the upper half of the mass matrix (kg m^2) at angles `q` (rad), row by row with its
    diagonal, of an arm of any geometry.

    Column i is the torques when joint i alone accelerates all that is behind it with 1 rad/s^2.
    """
    cos, sin = math.cos, math.sin
    c2, c3, c4, c5, c6 = cos(q[1]), cos(q[2]), cos(q[3]), cos(q[4]), cos(q[5])
    s2, s3, s4, s5, s6 = sin(q[1]), sin(q[2]), sin(q[3]), sin(q[4]), sin(q[5])
    xx, yy, xy, xz, yz = numbers[61], numbers[62], numbers[63], numbers[64], numbers[65]
    body = (numbers[59], numbers[60], 0.0, xx, yy, 0.0, xy, xz, yz)
    w66 = _started(body)
    w56 = _before(w66, numbers, 55, c6, s6)
    w46 = _before(w56, numbers, 44, c5, s5)
    w36 = _before(w46, numbers, 33, c4, s4)
    w26 = _before(w36, numbers, 22, c3, s3)
    w16 = _before(w26, numbers, 11, c2, s2)
    body = _joined(body, numbers, 55, c6, s6)
    w55 = _started(body)
    w45 = _before(w55, numbers, 44, c5, s5)
    w35 = _before(w45, numbers, 33, c4, s4)
    w25 = _before(w35, numbers, 22, c3, s3)
    w15 = _before(w25, numbers, 11, c2, s2)
    body = _joined(body, numbers, 44, c5, s5)
    w44 = _started(body)
    w34 = _before(w44, numbers, 33, c4, s4)
    w24 = _before(w34, numbers, 22, c3, s3)
    w14 = _before(w24, numbers, 11, c2, s2)
    body = _joined(body, numbers, 33, c4, s4)
    w33 = _started(body)
    w23 = _before(w33, numbers, 22, c3, s3)
    w13 = _before(w23, numbers, 11, c2, s2)
    body = _joined(body, numbers, 22, c3, s3)
    w22 = _started(body)
    w12 = _before(w22, numbers, 11, c2, s2)
    w11 = _started(_joined(body, numbers, 11, c2, s2))
    return (
        *(w11[5], w12[5], w13[5], w14[5], w15[5], w16[5]),
        *(w22[5], w23[5], w24[5], w25[5], w26[5]),
        *(w33[5], w34[5], w35[5], w36[5]),
        *(w44[5], w45[5], w46[5]),
        *(w55[5], w56[5], w66[5]),
    )


_UPPER = np.triu_indices(JOINTS)
_REST: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class OwnArmDynamics:
    """Mass matrix and bias torques of one arm, without rotors and friction, by the algorithms
    above. Implements `physics.ArmDynamics`."""

    def __init__(
        self, model: PumaModel, gravity: float, load: PrincipalInertia | None = None
    ) -> None:
        self._gravity = gravity
        numbers = regrouped(model, load)
        self._puma = is_puma(numbers)
        self._numbers = packed(puma_bias, numbers)

    def bias(self, q: Six, qd: Six) -> Six:
        if self._puma:
            return puma_bias(q, qd, self._gravity, self._numbers)
        return general_torques(q, qd, _REST, self._gravity, self._numbers)

    def mass_matrix(self, q: Six) -> Vector:
        upper = mass_numbers(q, self._numbers)
        mass = np.empty((JOINTS, JOINTS))
        mass[_UPPER] = upper
        mass.T[_UPPER] = upper
        return mass

    def close(self) -> None:
        """Release nothing: this back end holds nothing outside Python."""
