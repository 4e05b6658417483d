"""The numbers of a pick-and-place cell and of its arm, read from TOML files and checked.

An arm is described by its joint axes at joint angles of zero, so any arm of five or six joints can
be used. `JointChain.tool` is its forward kinematics, `JointChain.over` gives the joint angles for
fingers that point straight down.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
_NEAR: Final = 2e-4
"""Tolerance of a pose in `JointChain.over` (m and rad)."""


class NumbersError(ValueError):
    """A file of numbers cannot be used; the message names file, key and remedy."""


class OutOfReachError(ValueError):
    """The arm cannot bring its fingers there."""


@dataclass(frozen=True, slots=True)
class PartKind:
    """A kind of part: `size` (length, width) and `height` in m; the diameter of a round one is
    both."""

    name: str
    round: bool
    size: tuple[float, float]
    height: float
    tray: str


@dataclass(frozen=True, slots=True)
class OverheadCamera:
    """The camera: straight above the table, its image's u along -y and v along -x."""

    width: int
    height: int
    focal: float
    position: tuple[float, float, float]
    rate: float

    def pixel(self, x: float, y: float, z: float) -> tuple[float, float]:
        """Return the pixel of a point of the table's frame (m)."""
        scale = self.focal / (self.position[2] - z)
        return (
            self.width / 2 - 0.5 - scale * (y - self.position[1]),
            self.height / 2 - 0.5 - scale * (x - self.position[0]),
        )

    def point(self, u: float, v: float, z: float) -> tuple[float, float]:
        """Return the point at height `z` (m) that is seen at a pixel."""
        scale = (self.position[2] - z) / self.focal
        return (
            self.position[0] - scale * (v - self.height / 2 + 0.5),
            self.position[1] - scale * (u - self.width / 2 + 0.5),
        )


@dataclass(frozen=True, slots=True)
class Tray:
    """A tray: its middle, its size along x and y, and its slots in the order of filling (m)."""

    position: tuple[float, float]
    size: tuple[float, float]
    slots: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class PickingCell:
    """The cell, as far as its services know it."""

    eye: OverheadCamera
    area: tuple[tuple[float, float], tuple[float, float]]
    """Search area for parts: x from, to; y from, to (m)."""
    kinds: Mapping[str, PartKind]
    trays: Mapping[str, Tray]


@dataclass(frozen=True, slots=True)
class Gripper:
    """Two parallel fingers (m). `numbers`: further numbers for the arm's driver."""

    opening: float
    thickness: float
    width: float
    numbers: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class JointChain:
    """An arm on the table, all in the table's frame at joint angles of zero."""

    name: str
    points: Vector
    """A point on each axis (m), shape (n, 3)."""
    axes: Vector
    """Unit vectors of the axes, shape (n, 3)."""
    tip: Vector
    """The middle between the finger tips (m), shape (3,)."""
    approach: Vector
    """Unit vector along the fingers, shape (3,)."""
    closing: Vector
    """Unit vector along which the fingers close, shape (3,)."""
    limits: Vector
    """Lowest and highest angle of each joint (rad), shape (n, 2)."""
    gripper: Gripper
    controller: str
    """Commands of its driver: a key of `petrobot.services.picking.commands.ARMS`."""
    poses: Mapping[str, tuple[float, ...]]

    def tool(self, joints: Sequence[float]) -> tuple[Vector, Vector, Vector, Vector]:
        """Return tip, approach and closing direction (3,) and the Jacobian (6, n) of tip velocity
        and turning rate."""
        rotation, moved = np.eye(3), np.zeros(3)
        axes, points = [], []
        for angle, point, axis in zip(joints, self.points, self.axes, strict=True):
            axes.append(rotation @ axis)
            points.append(rotation @ point + moved)
            turned = _rotation(axis, float(angle))
            moved = moved + rotation @ (point - turned @ point)
            rotation = rotation @ turned
        tip = rotation @ self.tip + moved
        jacobian = np.vstack((np.cross(axes, tip - np.array(points)).T, np.array(axes).T))
        return tip, rotation @ self.approach, rotation @ self.closing, jacobian

    def over(
        self, x: float, y: float, z: float, turn: float, near: Sequence[float] | None = None
    ) -> tuple[float, ...]:
        """Return joint angles with the tips at (x, y, z) m, the fingers straight down and closing
        along `turn` (rad, modulo half a turn), nearest to the angles `near`.

        Damped least squares. Raises OutOfReachError.
        """
        starts = [self.poses["reach"]] if near is None else [tuple(near), self.poses["reach"]]
        aim = math.atan2(y - self.points[0][1], x - self.points[0][0])
        tip = self.tool(self.poses["reach"])[0] - self.points[0]
        begun = list(self.poses["reach"])
        begun[0] += _wrapped(aim - math.atan2(tip[1], tip[0]))
        starts.append(tuple(begun))
        found: list[tuple[float, tuple[float, ...]]] = []
        for start in starts:
            for half in (0.0, math.pi):
                joints = self._solve((x, y, z), turn + half, start)
                if joints is not None:
                    away = joints - np.asarray(near if near is not None else start)
                    found.append((float(np.abs(away).max()), tuple(joints.tolist())))
            if found:
                break
        if not found:
            raise OutOfReachError(
                f"{self.name} cannot reach x {x:.3f}, y {y:.3f}, z {z:.3f} m with its fingers down"
            )
        return min(found)[1]

    def _solve(
        self, place: tuple[float, float, float], turn: float, start: Sequence[float]
    ) -> Vector | None:
        joints: Vector = np.array(start, float)
        wanted = np.array((math.cos(turn), math.sin(turn), 0.0))
        down = np.array((0.0, 0.0, -1.0))
        for _ in range(60):
            tip, approach, closing, jacobian = self.tool(joints.tolist())
            away = np.array(place) - tip
            aside = 0.5 * (np.cross(approach, down) + np.cross(closing, wanted))
            if approach @ down < 0.0 or closing @ wanted < 0.0:
                aside += 0.5 * approach if abs(closing @ wanted) < 0.99 else 0.2 * approach
            error = np.concatenate((away, aside))
            if np.abs(error).max() < _NEAR and closing @ wanted > 0.0 and approach @ down > 0.0:
                return joints
            damping = 1e-4 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
            joints = np.clip(
                joints + np.clip(step, -0.4, 0.4), self.limits[:, 0], self.limits[:, 1]
            )
        return None


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _rotation(axis: Vector, angle: float) -> Vector:
    """Return the rotation about a unit vector (Rodrigues)."""
    x, y, z = axis
    c, s = math.cos(angle), math.sin(angle)
    k = 1.0 - c
    return np.array(
        (
            (c + x * x * k, x * y * k - z * s, x * z * k + y * s),
            (y * x * k + z * s, c + y * y * k, y * z * k - x * s),
            (z * x * k - y * s, z * y * k + x * s, c + z * z * k),
        )
    )


# Reading the files


def read_cell(text: str, source: str) -> PickingCell:
    """Read a cell's numbers. Raises NumbersError."""
    table = _table(text, source)
    try:
        camera, parts = table["camera"], table["parts"]
        kinds = {
            name: PartKind(
                name,
                _choice(source, f"kinds.{name}.shape", k["shape"], ("box", "round")) == "round",
                _pair(k["size"]),
                float(k["height"]),
                str(k["tray"]),
            )
            for name, k in table["kinds"].items()
        }
        trays = {
            name: Tray(
                _pair(t["position"]), _pair(t["size"]), tuple(_pair(slot) for slot in t["slots"])
            )
            for name, t in table["trays"].items()
        }
        x, y, z = map(float, camera["position"])
        eye = OverheadCamera(
            int(camera["width"]),
            int(camera["height"]),
            float(camera["focal_px"]),
            (x, y, z),
            float(camera["rate"]),
        )
        cell = PickingCell(eye, (_pair(parts["x"]), _pair(parts["y"])), kinds, trays)
    except (KeyError, TypeError, ValueError) as fault:
        raise _unfit(source, fault) from fault
    for kind in cell.kinds.values():
        _choice(source, f"kinds.{kind.name}.tray", kind.tray, tuple(trays))
    return cell


def read_arm(text: str, source: str) -> JointChain:
    """Read an arm's numbers. Raises NumbersError."""
    table = _table(text, source)
    try:
        base, tool, gripper = table["base"], table["tool"], table["gripper"]
        turn = _rotation(np.array((0.0, 0.0, 1.0)), float(base["yaw"]))
        foot = np.asarray(base["position"], float)
        joints = table["joints"]
        arm = JointChain(
            str(table["name"]),
            np.array([turn @ np.asarray(j["point"], float) + foot for j in joints]),
            np.array([turn @ np.asarray(j["axis"], float) for j in joints]),
            turn @ np.asarray(tool["tip"], float) + foot,
            turn @ np.asarray(tool["approach"], float),
            turn @ np.asarray(tool["closing"], float),
            np.array([_pair(j["limits"]) for j in joints]),
            Gripper(
                float(gripper["opening"]),
                float(gripper["thickness"]),
                float(gripper["width"]),
                {key: float(value) for key, value in gripper.items()},
            ),
            str(table["controller"]),
            {name: tuple(map(float, pose)) for name, pose in table["poses"].items()},
        )
    except (KeyError, TypeError, ValueError) as fault:
        raise _unfit(source, fault) from fault
    for name in ("rest", "reach"):
        if len(arm.poses.get(name, ())) != len(joints):
            raise NumbersError(
                f"{source}: poses.{name}: expected {len(joints)} joint angles (rad), found "
                f"{table['poses'].get(name)!r}"
            )
    return arm


@cache
def arm_named(name: str) -> JointChain:
    """Return the arm of a shipped file (`"so101"`, `"ur5e"`), or of the file at a path. Raises
    NumbersError."""
    own = Path(__file__).with_name(f"{name}.toml")
    path = own if own.exists() else Path(name)
    return read_arm(_text(path), path.name)


@cache
def cell_named(name: str = "cell") -> PickingCell:
    """Return the cell of the shipped file, or of the file at a path. Raises NumbersError."""
    own = Path(__file__).with_name(f"{name}.toml")
    path = own if own.exists() else Path(name)
    return read_cell(_text(path), path.name)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as fault:
        raise NumbersError(
            f"{path}: {fault.strerror}; name a shipped file (so101, ur5e, cell) or a path"
        ) from fault


def _table(text: str, source: str) -> Mapping[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise NumbersError(f"{source}: {fault}") from fault


def _pair(values: Sequence[float]) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)


def _choice(source: str, key: str, value: object, allowed: tuple[str, ...]) -> str:
    if value not in allowed:
        raise NumbersError(f"{source}: {key}: expected {' or '.join(allowed)}, found {value!r}")
    return str(value)


def _unfit(source: str, fault: Exception) -> NumbersError:
    if isinstance(fault, NumbersError):
        return fault
    what = f"key {fault} is missing" if isinstance(fault, KeyError) else str(fault)
    return NumbersError(f"{source}: {what}; the shipped files show the keys")
