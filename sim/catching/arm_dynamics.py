"""Mass matrix and bias torques of the arm in this project's own code, for the portable back end.

The recursive Newton-Euler algorithm in link coordinates (J. Y. S. Luh et al. 1980). Frame i stands
at joint i and turns with link i; its z axis is the joint's axis.

Two steps make it fast. The inertial numbers are regrouped, so that most of them are zero. And since
which ones are zero depends on the arm, plain Python does not execute the algorithm itself, but a
function *traced* from it: the algorithm is executed once with symbols instead of angles and speeds,
each operation on a symbol becomes a line of the function, and terms times zero are left out. numba
compiles the algorithm as it stands. Both give the same bits, since products with 0, 1 and -1 and
sums with 0 are exact.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from petrobot.services.host.numba_kernels import kernel, packed, plain
from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.puma_model import JOINTS, PrincipalInertia, PumaModel, real_inertia
from petrobot.sim.catching.truth import Vector

Triple = tuple[float, float, float]
Motion = tuple[Triple, Triple, Triple]
"""Angular velocity (rad/s), angular acceleration (rad/s^2) and acceleration of the origin (m/s^2)
of a link, in its own frame. The base accelerates upwards with g, which stands for gravity."""


def regrouped(model: PumaModel, load: PrincipalInertia | None = None) -> list[float]:
    """Return the arm as numbers for the recursion; `load` is what the flange carries, in frame 6.

    For each joint: a and d (m), cosine and sine of alpha of the joint before; then of its link the
    first moments x and y (kg m), Jxx, Jzz, Jxy, Jxz and Jyz (kg m^2, about the frame's origin).

    A thin rod on the axis of joint i does not feel that joint's rotation, so it may belong to link
    i - 1 instead. From each link, last to first, a rod is cut off that has the link's mass, first
    moment along z, and Jyy. So these three are zero for what is left of the link. Nothing else
    changes: tests/sim/test_puma.py compares arms that have no zero anywhere with PyBullet.
    """
    numbers: list[float] = []
    rod_mass, rod_moment, rod_inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    for i in reversed(range(JOINTS)):
        # From the link's far end, where its published numbers and the next link's rod are given, to
        # its own frame.
        c, s = model.twists[i]
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        offset = np.array([model.a[i], 0.0, model.d[i]])
        bodies = [model.links[i], *([load] if load is not None and i == JOINTS - 1 else [])]
        mass, moment = rod_mass, turn @ rod_moment
        inertia = turn @ rod_inertia @ turn.T + _shift(mass, moment, offset)
        moment = moment + mass * offset
        for body in bodies:
            centre = turn @ np.array(body.centre) + offset
            own = turn @ np.diag(real_inertia(body.inertia)) @ turn.T
            inertia = inertia + own + _shift(body.mass, np.zeros(3), centre)
            mass, moment = mass + body.mass, moment + body.mass * centre
        rod_mass, rod_moment = mass, np.array([0.0, 0.0, moment[2]])
        rod_inertia = np.diag([inertia[1, 1], inertia[1, 1], 0.0])
        (c, s), a, d = (
            (model.twists[i - 1], model.a[i - 1], model.d[i - 1]) if i else ((1.0, 0.0), 0.0, 0.0)
        )
        left = inertia - rod_inertia
        numbers[:0] = [a, d, c, s, moment[0], moment[1], left[0, 0], left[2, 2]]
        numbers[8:8] = [left[0, 1], left[0, 2], left[1, 2]]
    return [float(number) for number in numbers]


def _shift(mass: float, moment: Vector, offset: Vector) -> Vector:
    """Return what a body's inertia about the origin (3, 3) gains when the body is moved by
    `offset`; `moment` is its first moment before."""
    both = np.outer(moment, offset)
    eye = np.eye(3)
    gained: Vector = mass * (offset @ offset * eye - np.outer(offset, offset)) + (
        2.0 * (moment @ offset) * eye - both - both.T
    )
    return gained


# The algorithm. It runs with floats and with symbols, so it uses nothing but + - and *.


@kernel
def _accelerated(motion: Motion, x: float, y: float, z: float) -> Triple:
    """Return the acceleration of a link's point, relative to its origin: wd x p + w x (w x p)."""
    (wx, wy, wz), (ax, ay, az), _ = motion
    xx, yy, zz = wx * wx, wy * wy, wz * wz
    xy, xz, yz = wx * wy, wx * wz, wy * wz
    return (
        (xy - az) * y + (xz + ay) * z - (yy + zz) * x,
        (xy + az) * x + (yz - ax) * z - (xx + zz) * y,
        (xz - ay) * x + (yz + ax) * y - (xx + yy) * z,
    )


@kernel
def _into(v: Triple, ca: float, sa: float, c: float, s: float) -> Triple:
    """Return a vector of the link before in this link's frame."""
    x, y, z = v
    y, z = ca * y + sa * z, ca * z - sa * y
    return c * x + s * y, c * y - s * x, z


@kernel
def _out_of(v: Triple, ca: float, sa: float, c: float, s: float) -> Triple:
    """Return a vector of this link's frame in that of the link before."""
    x, y, z = v
    x, y = c * x - s * y, s * x + c * y
    return x, ca * y - sa * z, sa * y + ca * z


@kernel
def _forward(
    before: Motion, numbers: Sequence[float], at: int, c: float, s: float, qd: float, qdd: float
) -> Motion:
    """Return the motion of a link from that of the link before; `at`: where its numbers begin."""
    a, d, ca, sa = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    x, y, z = _accelerated(before, a, 0.0, d)
    wx, wy, wz = _into(before[0], ca, sa, c, s)
    ax, ay, az = _into(before[1], ca, sa, c, s)
    vx, vy, vz = before[2]
    return (
        (wx, wy, wz + qd),
        (ax + wy * qd, ay - wx * qd, az + qdd),
        _into((vx + x, vy + y, vz + z), ca, sa, c, s),
    )


@kernel
def _load(motion: Motion, numbers: Sequence[float], at: int) -> tuple[Triple, Triple]:
    """Return force (N) and torque about the origin (N m) that move a link so."""
    hx, hy, jxx, jzz = numbers[at + 4], numbers[at + 5], numbers[at + 6], numbers[at + 7]
    jxy, jxz, jyz = numbers[at + 8], numbers[at + 9], numbers[at + 10]
    (wx, wy, wz), (ax, ay, az), (vx, vy, vz) = motion
    lx, ly, lz = jxx * wx + jxy * wy + jxz * wz, jxy * wx + jyz * wz, jxz * wx + jyz * wy + jzz * wz
    return _accelerated(motion, hx, hy, 0.0), (
        jxx * ax + jxy * ay + jxz * az + (wy * lz - wz * ly) + hy * vz,
        jxy * ax + jyz * az + (wz * lx - wx * lz) - hx * vz,
        jxz * ax + jyz * ay + jzz * az + (wx * ly - wy * lx) + (hx * vy - hy * vx),
    )


@kernel
def _back(
    carried: tuple[Triple, Triple],
    own: tuple[Triple, Triple],
    numbers: Sequence[float],
    at: int,
    c: float,
    s: float,
) -> tuple[Triple, Triple]:
    """Return force and torque on a link: its `own` load, and that of the link behind it, whose
    joint's numbers begin at `at`."""
    a, d, ca, sa = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    fx, fy, fz = _out_of(carried[0], ca, sa, c, s)
    nx, ny, nz = _out_of(carried[1], ca, sa, c, s)
    (gx, gy, gz), (mx, my, mz) = own
    return (gx + fx, gy + fy, gz + fz), (
        mx + nx - d * fy,
        my + ny + (d * fx - a * fz),
        mz + nz + a * fy,
    )


@kernel
def newton_euler(
    c: Six, s: Six, qd: Six, qdd: Six, gravity: float, numbers: Sequence[float]
) -> Six:
    """Return the six torques (N m) that move the arm with speeds `qd` (rad/s) and accelerations
    `qdd` (rad/s^2) at angles whose cosines and sines are `c` and `s`."""
    still = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, gravity)
    one = _forward(still, numbers, 0, c[0], s[0], qd[0], qdd[0])
    two = _forward(one, numbers, 11, c[1], s[1], qd[1], qdd[1])
    three = _forward(two, numbers, 22, c[2], s[2], qd[2], qdd[2])
    four = _forward(three, numbers, 33, c[3], s[3], qd[3], qdd[3])
    five = _forward(four, numbers, 44, c[4], s[4], qd[4], qdd[4])
    six = _forward(five, numbers, 55, c[5], s[5], qd[5], qdd[5])
    on6 = _load(six, numbers, 55)
    on5 = _back(on6, _load(five, numbers, 44), numbers, 55, c[5], s[5])
    on4 = _back(on5, _load(four, numbers, 33), numbers, 44, c[4], s[4])
    on3 = _back(on4, _load(three, numbers, 22), numbers, 33, c[3], s[3])
    on2 = _back(on3, _load(two, numbers, 11), numbers, 22, c[2], s[2])
    on1 = _back(on2, _load(one, numbers, 0), numbers, 11, c[1], s[1])
    return on1[1][2], on2[1][2], on3[1][2], on4[1][2], on5[1][2], on6[1][2]


_REST: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def bias_torques(q: Six, qd: Six, gravity: float, numbers: Sequence[float]) -> Six:
    """Return the torques (N m) that hold the arm against gravity, Coriolis and centrifugal forces
    at angles `q` (rad) and speeds `qd` (rad/s)."""
    cos, sin = math.cos, math.sin
    c = cos(q[0]), cos(q[1]), cos(q[2]), cos(q[3]), cos(q[4]), cos(q[5])
    s = sin(q[0]), sin(q[1]), sin(q[2]), sin(q[3]), sin(q[4]), sin(q[5])
    return newton_euler(c, s, qd, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), gravity, numbers)


@kernel
def upper_mass(c: Six, s: Six, numbers: Sequence[float]) -> tuple[float, ...]:
    """Return the upper half of the mass matrix (kg m^2) row by row, with its diagonal: each column
    is the torques for a unit acceleration of one joint at rest, without gravity."""
    rest = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    a = newton_euler(c, s, rest, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, numbers)
    b = newton_euler(c, s, rest, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), 0.0, numbers)
    d = newton_euler(c, s, rest, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), 0.0, numbers)
    e = newton_euler(c, s, rest, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0), 0.0, numbers)
    f = newton_euler(c, s, rest, (0.0, 0.0, 0.0, 0.0, 1.0, 0.0), 0.0, numbers)
    g = newton_euler(c, s, rest, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), 0.0, numbers)
    first = a[0], b[0], d[0], e[0], f[0], g[0], b[1], d[1], e[1], f[1], g[1]
    return (*first, d[2], e[2], f[2], g[2], e[3], f[3], g[3], f[4], g[4], g[5])


@kernel
def mass_numbers(q: Six, numbers: Sequence[float]) -> tuple[float, ...]:
    """Return `upper_mass` at angles `q` (rad)."""
    cos, sin = math.cos, math.sin
    c = cos(q[0]), cos(q[1]), cos(q[2]), cos(q[3]), cos(q[4]), cos(q[5])
    s = sin(q[0]), sin(q[1]), sin(q[2]), sin(q[3]), sin(q[4]), sin(q[5])
    return upper_mass(c, s, numbers)


_UPPER = np.triu_indices(JOINTS)


# Tracing


class _Symbol:
    """A number that is not known yet. Operations on it write lines of a function."""

    __slots__ = ("lines", "name")

    def __init__(self, name: str, lines: dict[str, str]) -> None:
        """`lines`: the name of each expression computed so far."""
        self.name, self.lines = name, lines

    def _write(self, expression: str) -> _Symbol:
        """Return the value of an expression; the same expression is computed once."""
        name = self.lines.setdefault(expression, f"t{len(self.lines)}")
        return _Symbol(name, self.lines)

    def __add__(self, other: Any) -> Any:
        if other == 0.0:
            return self
        name = _text(other)
        if name.startswith("-"):  # a + (-b) and a - b have the same bits
            return self._write(f"{self.name} - {name[1:]}")
        if self.name.startswith("-"):
            return self._write(f"{name} - {self.name[1:]}")
        return self._write(f"{self.name} + {name}")

    def __radd__(self, other: float) -> Any:
        return self + other

    def __sub__(self, other: Any) -> Any:
        return self + -other

    def __rsub__(self, other: float) -> Any:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        if other == 0.0:
            return 0.0
        if other == 1.0:
            return self
        if other == -1.0:
            return -self
        first, second = self.name, _text(other)
        negative = first.startswith("-") != second.startswith("-")
        product = self._write(f"{first.lstrip('-')} * {second.lstrip('-')}")
        return -product if negative else product

    def __rmul__(self, other: float) -> Any:
        return self * other

    def __neg__(self) -> _Symbol:
        name = self.name
        return _Symbol(name[1:] if name.startswith("-") else f"-{name}", self.lines)


def _text(value: Any) -> str:
    return value.name if isinstance(value, _Symbol) else repr(value)


_ANGLES = [f"{function}{joint}" for function in "cs" for joint in range(JOINTS)]
_SPEEDS = [f"v{joint}" for joint in range(JOINTS)]


def _function(lines: dict[str, str], values: Sequence[Any], *, speeds: bool) -> Callable[..., Any]:
    """Return a function of the angles `q`, and of the speeds `qd` if it has `speeds`, that computes
    traced values."""
    used = _used(lines, [_text(value).lstrip("-") for value in values])
    body = [f"{_SPEEDS[joint]} = qd[{joint}]" for joint in range(JOINTS) if speeds]
    for word, name in (("cos", "c"), ("sin", "s")):
        body += [f"{name}{joint} = {word}(q[{joint}])" for joint in range(JOINTS)]
    body += [f"{name} = {expression}" for expression, name in lines.items() if name in used]
    # -0.0 + 0.0 is 0.0: which terms were left out does not show in the sign of a zero
    body.append(f"return ({', '.join(f'{_text(value)} + 0.0' for value in values)})")
    head = "def traced(q, qd):" if speeds else "def traced(q):"
    scope: dict[str, Any] = {"cos": math.cos, "sin": math.sin}
    # The text consists of names made here and of numbers of the arm, as floats. The standard
    # library makes its data classes in the same way.
    exec("\n    ".join([head, *body]), scope)  # noqa: S102
    function: Callable[..., Any] = scope["traced"]
    return function


def _used(lines: dict[str, str], needed: list[str]) -> set[str]:
    """Return the names of the lines that these names need."""
    expressions = {name: expression for expression, name in lines.items()}
    used: set[str] = set()
    while needed:
        name = needed.pop()
        if name in expressions and name not in used:
            used.add(name)
            needed += [word.lstrip("-") for word in expressions[name].split()]
    return used


@contextlib.contextmanager
def _as_they_stand() -> Iterator[None]:
    """Take back the compilation of the algorithm's functions: symbols are no floats."""
    scope = globals()
    kernels = {name: f for name, f in scope.items() if hasattr(f, "py_func")}
    scope.update({name: plain(f) for name, f in kernels.items()})
    try:
        yield
    finally:
        scope.update(kernels)


def traced(
    gravity: float, numbers: Sequence[float]
) -> tuple[Callable[[Six, Six], Six], Callable[[Six], Sequence[float]]]:
    """Return `bias_torques` and `mass_numbers` for one arm as straight-line code."""
    lines: dict[str, str] = {}
    symbols: list[Any] = [_Symbol(name, lines) for name in (*_ANGLES, *_SPEEDS)]
    c, s, qd = (tuple(symbols[k : k + JOINTS]) for k in range(0, 3 * JOINTS, JOINTS))
    numbers = [float(number) for number in numbers]
    with _as_they_stand():
        bias = _function(lines, newton_euler(c, s, qd, _REST, gravity, numbers), speeds=True)
        lines.clear()
        mass = _function(lines, upper_mass(c, s, numbers), speeds=False)
    return bias, mass


class OwnArmDynamics:
    """Mass matrix and bias torques of one arm, without rotors and friction, by the algorithm above.
    Implements `physics.ArmDynamics`."""

    def __init__(
        self, model: PumaModel, gravity: float, load: PrincipalInertia | None = None
    ) -> None:
        self._gravity = gravity
        self._numbers = packed(bias_torques, regrouped(model, load))
        self._bias: Callable[[Six, Six], Six] | None = None
        self._mass: Callable[[Six], Sequence[float]] | None = None
        if not hasattr(bias_torques, "py_func"):
            self._bias, self._mass = traced(gravity, self._numbers)

    def bias(self, q: Six, qd: Six) -> Six:
        """Return six torques (N m) that hold the arm against gravity, Coriolis and centrifugal
        forces."""
        if self._bias is not None:
            return self._bias(q, qd)
        return bias_torques(q, qd, self._gravity, self._numbers)

    def mass_matrix(self, q: Six) -> Vector:
        """Return the mass matrix (6, 6) kg m^2."""
        upper = self._mass(q) if self._mass is not None else mass_numbers(q, self._numbers)
        mass = np.empty((JOINTS, JOINTS))
        mass[_UPPER] = upper
        mass.T[_UPPER] = upper
        return mass

    def close(self) -> None:
        """Release nothing: this back end holds nothing outside Python."""
