"""The PUMA 560 and its cup as numbers, read from `puma560.toml` and `cell.toml`; SI units and
radians. Of the arm's file, motion needs neither masses nor friction nor gears: these are for the
drives and the laboratory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.host.toml_text import read_toml

Vector = NDArray[np.float64]

JOINTS = 6


class ArmFileError(ValueError):
    """An arm or cell file lacks a key or has an impossible value; the message names file, key and
    what was expected."""


class Body(Struct, frozen=True):
    """Radii (m) of the capsules that stand for the solid parts of the arm."""

    base: float
    forearm: float
    wrist: float


class ArmModel(Struct, frozen=True):
    """Geometry and limits of the arm. Arrays have one entry per joint, base to flange; SI units,
    radians."""

    d: Vector
    a: Vector
    alpha: Vector
    lower: Vector
    upper: Vector
    speed: Vector
    acceleration: Vector
    body: Body
    poses: Mapping[str, tuple[float, ...]]


class Cup(Struct, frozen=True):
    """The cup and its mount on the flange.

    `mouth` (m) is the centre of its opening and `axis` (unit vector) points out of it, both in
    frame 6; `radius` is the inner one, `wall` its thickness, `depth` that of the inside (m).
    """

    mouth: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    depth: float
    wall: float


class CatchingCell(Struct, frozen=True):
    """What motion needs of the cell: cup, table (m, base frame) and ball (m, m/s^2)."""

    cup: Cup
    table_top: float
    near_edge: float
    ball_radius: float
    gravity: float


def _numbers(table: Mapping[str, Any], key: str, where: str, length: int) -> tuple[float, ...]:
    value = table.get(key)
    if (
        not isinstance(value, list)
        or len(value) != length
        or not all(isinstance(v, int | float) for v in value)
    ):
        raise ArmFileError(f"{where}: {key}: expected a list of {length} numbers, got {value!r}")
    return tuple(float(v) for v in value)


def _number(table: Mapping[str, Any], key: str, where: str) -> float:
    value = table.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ArmFileError(f"{where}: {key}: expected a finite number, got {value!r}")
    return float(value)


def _column(joints: Sequence[Mapping[str, Any]], key: str, scale: float = 1.0) -> Vector:
    return np.array(
        [
            scale * _number(joint, key, f"puma560.toml: joint {i + 1}")
            for i, joint in enumerate(joints)
        ]
    )


def read_arm(text: str) -> ArmModel:
    """Read an arm from a text in the format that the head of `puma560.toml` describes. Raises
    ArmFileError and TomlError."""
    table = read_toml(text, "puma560.toml")
    joints = table.get("joint", [])
    if len(joints) != JOINTS:
        raise ArmFileError(f"puma560.toml: expected {JOINTS} tables [[joint]], got {len(joints)}")
    limits = np.radians(
        [
            _numbers(joint, "limits", f"puma560.toml: joint {i + 1}", 2)
            for i, joint in enumerate(joints)
        ]
    )
    body = table.get("body", {})
    degree = math.pi / 180.0
    return ArmModel(
        d=_column(joints, "d"),
        a=_column(joints, "a"),
        alpha=_column(joints, "alpha", degree),
        lower=limits[:, 0],
        upper=limits[:, 1],
        speed=_column(joints, "speed", degree),
        acceleration=_column(joints, "acceleration"),
        body=Body(
            *(_number(body, key, "puma560.toml: body") for key in ("base", "forearm", "wrist"))
        ),
        poses=_poses(table.get("poses", {}), limits),
    )


def _poses(table: Mapping[str, Any], limits: Vector) -> dict[str, tuple[float, ...]]:
    poses = {
        name: tuple(np.radians(_numbers(table, name, "puma560.toml: poses", JOINTS)).tolist())
        for name in table
    }
    for name, pose in poses.items():
        if np.any(np.asarray(pose) < limits[:, 0]) or np.any(np.asarray(pose) > limits[:, 1]):
            raise ArmFileError(
                f"puma560.toml: poses.{name}: lies outside the joint limits; change the pose"
            )
    return poses


def read_cell(text: str) -> CatchingCell:
    """Read what motion needs from a text in the format of `services/cell.toml`. Raises
    ArmFileError and TomlError."""
    table = read_toml(text, "cell.toml")
    for section in ("cup", "table", "ball"):
        if section not in table:
            raise ArmFileError(
                f"cell.toml: table [{section}] is missing; services/cell.toml shows its keys"
            )
    cup, desk, ball = table["cup"], table["table"], table["ball"]
    mouth, axis = (
        _numbers(cup, "mouth", "cell.toml: cup", 3),
        np.array(_numbers(cup, "axis", "cell.toml: cup", 3)),
    )
    if abs(float(np.linalg.norm(axis)) - 1.0) > 1e-3:
        raise ArmFileError(f"cell.toml: cup.axis: expected a unit vector, got {axis.tolist()}")
    axis = axis / np.linalg.norm(axis)
    return CatchingCell(
        cup=Cup(
            (mouth[0], mouth[1], mouth[2]),
            (float(axis[0]), float(axis[1]), float(axis[2])),
            _number(cup, "radius", "cell.toml: cup"),
            _number(cup, "depth", "cell.toml: cup"),
            _number(cup, "wall", "cell.toml: cup"),
        ),
        table_top=_number(desk, "top", "cell.toml: table"),
        near_edge=_number(desk, "near_edge", "cell.toml: table"),
        ball_radius=_number(ball, "radius", "cell.toml: ball"),
        gravity=_number(ball, "gravity", "cell.toml: ball"),
    )


@lru_cache(maxsize=1)
def nominal_arm() -> ArmModel:
    """Return the arm of the package's own `services/motion/puma560.toml`."""
    return read_arm(
        files("petrobot.services.motion").joinpath("puma560.toml").read_text(encoding="utf-8")
    )


@lru_cache(maxsize=1)
def nominal_cell() -> CatchingCell:
    """Return the cell of the package's own `services/cell.toml`."""
    return read_cell(files("petrobot.services").joinpath("cell.toml").read_text(encoding="utf-8"))
