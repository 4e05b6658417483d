"""The rover and its track as numbers, read from a file like `rover.toml`; SI units."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any, Self

from msgspec import Struct

from petrobot.services.host.toml_text import TomlError, read_toml

NOMINAL = "rover.toml"


class RoverFileError(ValueError):
    """A rover file lacks a key or has an impossible value; the message names file, key and what was
    expected."""


class _Table(Struct, frozen=True):
    """A table of positive numbers; every field is a key of it."""

    @classmethod
    def of(cls, tables: Mapping[str, Any], name: str, source: str) -> Self:
        """Read the table from a file's tables. Raises RoverFileError."""
        table = tables.get(name)
        if not isinstance(table, Mapping):
            raise RoverFileError(
                f"{source}: table [{name}] is missing; petrobot's own {NOMINAL} shows it"
            )
        return cls(**{key: _number(table, name, key, source) for key in cls.__struct_fields__})


class FloorSizes(_Table, frozen=True):
    """The contest's floor (m)."""

    square: float
    width: float
    radius: float
    reflector_height: float
    bar_length: float
    bar_width: float


class Wheels(_Table, frozen=True):
    """The differential drive: m, rad/s and rad/s^2 of a wheel, s."""

    wheel_radius: float
    track_width: float
    top_speed: float
    acceleration: float
    quick_stop: float
    wheel_lag: float


class BusLayout(_Table, frozen=True):
    """The CAN bus: period of SYNC (s) and node ids."""

    period: float
    left: float
    right: float
    sensor: float


class CameraModel(_Table, frozen=True):
    """The camera in front of the axle: m, rad down from the horizon, pixels, images/s."""

    forward: float
    height: float
    pitch: float
    width: float
    height_px: float
    focal_px: float
    rate: float
    principal_px: tuple[float, float]


class Sensor(_Table, frozen=True):
    """The retroreflector sensor in front of the axle: m, s, rad to each side."""

    forward: float
    height: float
    period: float
    half_angle: float
    range: float


class RoverModel(Struct, frozen=True):
    """All numbers of one rover."""

    track: FloorSizes
    wheels: Wheels
    bus: BusLayout
    camera: CameraModel
    sensor: Sensor


def read_rover(text: str, source: str = NOMINAL) -> RoverModel:
    """Read a rover from the text of a TOML file. Raises RoverFileError."""
    try:
        tables = read_toml(text, source)
    except TomlError as fault:
        raise RoverFileError(str(fault)) from fault
    return RoverModel(
        FloorSizes.of(tables, "track", source),
        Wheels.of(tables, "rover", source),
        BusLayout.of(tables, "bus", source),
        CameraModel.of(tables, "camera", source),
        Sensor.of(tables, "sensor", source),
    )


@lru_cache(maxsize=1)
def nominal_rover() -> RoverModel:
    """Return the rover that comes with petrobot."""
    return read_rover(
        files("petrobot.services.mobile").joinpath(NOMINAL).read_text(encoding="utf-8")
    )


def _number(table: Mapping[str, Any], name: str, key: str, source: str) -> Any:
    value = table.get(key)
    if key == "principal_px":
        if isinstance(value, list) and len(value) == 2 and all(_positive(v) for v in value):
            return float(value[0]), float(value[1])
        raise RoverFileError(
            f"{source}: [{name}] {key}: expected two positive numbers (column and row in "
            f"pixels), got {value!r}"
        )
    if value is None or not _positive(value):
        raise RoverFileError(f"{source}: [{name}] {key}: expected a positive number, got {value!r}")
    return float(value)


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value > 0
