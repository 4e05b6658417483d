"""States, stimuli and instructions as plain data, and stimuli back, for journals and exports.

A record becomes a mapping of its fields; a field at its default is left out. Stimuli and
instructions carry their class name as `kind`. Reading checks every field against its annotation and
refuses what does not fit with a ValueError.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

from msgspec import NODEFAULT, Struct
from msgspec.structs import FieldInfo, fields

from petrobot.coordinator.engine.instructions import Instruction
from petrobot.coordinator.engine.state import State
from petrobot.coordinator.engine.stimuli import Point, Stimulus

Reader = Callable[[Any, str], Any]
_KINDS: Mapping[str, type] = {c.__name__: c for c in (*get_args(Stimulus), *get_args(Instruction))}


def to_plain(record: State | Stimulus | Instruction | Point) -> dict[str, Any]:
    """Return the record as plain data."""
    plain: dict[str, Any] = _plain(record)
    return plain


def stimulus_from_plain(data: Mapping[str, Any]) -> Stimulus:
    """Return the stimulus that `to_plain` described. Raises ValueError."""
    if not isinstance(data, Mapping) or not isinstance(data.get("kind"), str):
        raise ValueError("a record needs its `kind`")
    cls = _KINDS.get(data["kind"])
    if cls not in get_args(Stimulus):
        raise ValueError(
            f"{data['kind']!r} is none of {', '.join(c.__name__ for c in get_args(Stimulus))}"
        )
    given = {k: v for k, v in data.items() if k != "kind"}
    stimulus: Stimulus = _reader(cls)(given, data["kind"])
    return stimulus


def point_from_plain(data: Mapping[str, Any]) -> Point:
    """Return the point that `to_plain` described. Raises ValueError."""
    point: Point = _reader(Point)(data, "point")
    return point


def _plain(value: Any) -> Any:
    if isinstance(value, Struct):
        return _fields(value)
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, frozenset):
        return sorted(value)
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


@cache
def _described(cls: type[Struct]) -> tuple[FieldInfo, ...]:
    return fields(cls)


def _fields(record: Any) -> dict[str, Any]:
    name = type(record).__name__
    plain: dict[str, Any] = {"kind": name} if name in _KINDS else {}
    for f in _described(record.__class__):
        value = getattr(record, f.name)
        if value == f.default and type(value) is type(f.default):
            continue
        if f.default_factory is not NODEFAULT and not value:
            continue
        plain[f.name] = _plain(value)
    return plain


@cache
def _reader(hint: Any) -> Reader:
    """Return a function that reads a value with this annotation."""
    if hint is Any:
        return lambda value, where: value
    if get_origin(hint) in (Union, types.UnionType):
        return _union_reader(hint)
    if get_origin(hint) is not None:
        return _container_reader(get_origin(hint), get_args(hint))
    if isinstance(hint, type) and issubclass(hint, Struct):
        return _record_reader(hint)
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return _enum_reader(hint)
    return _scalar_reader(hint)


def _union_reader(hint: Any) -> Reader:
    inner = _reader(next(a for a in get_args(hint) if a is not type(None)))  # it is `X | None`
    return lambda value, where: None if value is None else inner(value, where)


def _container_reader(origin: Any, args: tuple[Any, ...]) -> Reader:
    item = _reader(args[0] if origin is tuple else args[-1])
    if issubclass(origin, Mapping):
        return lambda value, where: {
            k: item(v, f"{where}.{k}")
            for k, v in _of(value, Mapping, where).items()
            if _of(k, str, where) is k
        }
    return lambda value, where: origin(
        [item(v, f"{where}[{i}]") for i, v in enumerate(_of(value, list | tuple, where))]
    )


def _record_reader(cls: Any) -> Reader:
    hints = get_type_hints(cls)
    required = {f.name for f in fields(cls) if f.required}

    def read(value: Any, where: str) -> Any:
        data = _of(value, Mapping, where)
        unknown, missing = set(data) - set(hints), required - set(data)
        if unknown or missing:
            raise ValueError(f"{where}: unknown {sorted(unknown)}, missing {sorted(missing)}")
        return cls(**{k: _reader(hints[k])(v, f"{where}.{k}") for k, v in data.items()})

    return read


def _enum_reader(enum: type[StrEnum]) -> Reader:
    def read(value: Any, where: str) -> Any:
        try:
            return enum(value)
        except ValueError:
            raise ValueError(f"{where}: {value!r} is none of {', '.join(enum)}") from None

    return read


def _scalar_reader(kind: type) -> Reader:
    def read(value: Any, where: str) -> Any:
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            return float(value)
        if kind is int and isinstance(value, bool):
            raise ValueError(f"{where}: expected an integer, got {value!r}")
        return _of(value, kind, where)

    return read


def _of(value: Any, kind: Any, where: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{where}: {value!r} is no {getattr(kind, '__name__', kind)}")
    return value
