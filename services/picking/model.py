"""The numbers of a pick-and-place cell and of its arm, read from TOML files and checked.

An arm is described by the axes of its joints (`petrobot.JointChain`), so any arm of five or six
joints can be used. `ArmNumbers.over` gives the joint angles for fingers that point straight down.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.services.host.toml_text import TomlError, read_toml
from petrobot.services.joint_chain import JointChain, rotation_matrix, rotation_vector


class NumbersError(ValueError):
    """A file of numbers cannot be used; the message names file, key and remedy."""


class OutOfReachError(ValueError):
    """The arm cannot bring its fingers there."""


class PartKind(Struct, frozen=True):
    """A kind of part: `size` (length, width) and `height` in m; the diameter of a round one is
    both."""

    name: str
    round: bool
    size: tuple[float, float]
    height: float
    tray: str


class OverheadCamera(Struct, frozen=True):
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


class Tray(Struct, frozen=True):
    """A tray: its middle, its size along x and y, and its slots in the order of filling (m)."""

    position: tuple[float, float]
    size: tuple[float, float]
    slots: tuple[tuple[float, float], ...]


class PickingCell(Struct, frozen=True):
    """The cell, as far as its services know it."""

    eye: OverheadCamera
    area: tuple[tuple[float, float], tuple[float, float]]
    """Search area for parts: x from, to; y from, to (m)."""
    kinds: Mapping[str, PartKind]
    trays: Mapping[str, Tray]


class Gripper(Struct, frozen=True):
    """Two parallel fingers (m). `numbers`: further numbers for the arm's driver."""

    opening: float
    thickness: float
    width: float
    numbers: Mapping[str, float]


class ArmNumbers(Struct, frozen=True):
    """An arm on the table."""

    name: str
    chain: JointChain
    """Its joints in the table's frame. The tool is the middle between the finger tips; its z points
    along the fingers, its x is the direction in which they close."""
    foot: tuple[float, float]
    """Where it stands (m)."""
    gripper: Gripper
    controller: str
    """Commands of its driver: a key of `petrobot.services.picking.handling.ARMS`."""
    poses: Mapping[str, tuple[float, ...]]

    def over(
        self, x: float, y: float, z: float, turn: float, near: Sequence[float] | None = None
    ) -> tuple[float, ...]:
        """Return joint angles with the tips at (x, y, z) m, the fingers straight down and closing
        along `turn` (rad, modulo half a turn), nearest to the angles `near`. Raises
        OutOfReachError."""
        reach = self.poses["reach"]
        tip = self.chain.point(reach)
        aim = math.atan2(y - self.foot[1], x - self.foot[0])
        ahead = aim - math.atan2(tip[1] - self.foot[1], tip[0] - self.foot[0])
        aimed = (reach[0] + math.remainder(ahead, 2.0 * math.pi), *reach[1:])
        found: list[tuple[float, tuple[float, ...]]] = []
        for starts in (1, 8):  # straight ahead of the arm a search may stop in a singular pose
            for start in (near or reach, reach, aimed):
                for half in (turn / 2, turn / 2 + math.pi / 2):
                    # straight down: half a turn about the line between x and the closing direction
                    pose = (x, y, z, math.pi * math.cos(half), math.pi * math.sin(half), 0.0)
                    with suppress(ValueError):
                        joints = self.chain.joints(pose, start, starts=starts)
                        pairs = zip(joints, near or start, strict=True)
                        found.append((max(abs(a - b) for a, b in pairs), tuple(joints)))
            if found:
                return min(found)[1]
        raise OutOfReachError(
            f"{self.name} cannot reach x {x:.3f}, y {y:.3f}, z {z:.3f} m with its fingers down"
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


def read_arm(text: str, source: str) -> ArmNumbers:
    """Read an arm's numbers. Raises NumbersError."""
    table = _table(text, source)
    try:
        base, tool, gripper = table["base"], table["tool"], table["gripper"]
        turn = rotation_matrix((0.0, 0.0, float(base["yaw"])))
        foot = np.asarray(base["position"], float)
        joints = [
            {**j, "axis": (turn @ j["axis"]).tolist(), "point": (turn @ j["point"] + foot).tolist()}
            for j in table["joints"]
        ]
        closing, approach = np.array(tool["closing"], float), np.array(tool["approach"], float)
        axes = np.column_stack((closing, np.cross(approach, closing), approach))
        tip = turn @ tool["tip"] + foot
        arm = ArmNumbers(
            str(table["name"]),
            JointChain(joints, [*tip.tolist(), *rotation_vector(turn @ axes).tolist()]),
            (float(foot[0]), float(foot[1])),
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
def arm_named(name: str) -> ArmNumbers:
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
        return read_toml(text, source)
    except TomlError as fault:
        raise NumbersError(str(fault)) from fault


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
