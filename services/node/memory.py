"""The global memory: named values with a version, which every node can read, write and watch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgpack
from msgspec import Struct

from petrobot.services.action import Result, error, failure, success
from petrobot.services.comm.location_file import MEMORY_CALLS

VALUE_BYTES = 1 << 20
"""Largest value (bytes as msgpack). Its event may have twice the size."""
VARIABLES = 10_000
"""Largest number of variables."""
TOTAL_BYTES = 64 << 20
"""Largest size of all values together (bytes as msgpack)."""
NAME_LENGTH = 200


def event_name(variable: str) -> str:
    """Return the name of the event that carries a variable's new value."""
    return f"memory:{variable}"


class StoredValue(Struct, frozen=True):
    """A value, its version (1 after the first write), and its size in bytes."""

    value: Any
    version: int
    size: int


class GlobalMemory:
    """The variables. `call` answers the services `memory.*`; `changed(name, value, version)` is
    called at each change."""

    def __init__(self, changed: Callable[[str, Any, int], None]) -> None:
        self._changed = changed
        self._variables: dict[str, StoredValue] = {}
        self._bytes = 0
        answers = (self._get, self._put, self._compare_and_set, self._list)
        self._answers: dict[str, Callable[..., Result]] = dict(
            zip(MEMORY_CALLS, answers, strict=True)
        )

    def call(self, service: str, arguments: Mapping[str, Any]) -> Result:
        """Answer a call of one of `MEMORY_CALLS`. Bad arguments give ERROR with cause
        `bad_arguments`."""
        try:
            return self._answers[service](**arguments)
        except TypeError as fault:
            return error("bad_arguments", f"{service}: {str(fault).replace('GlobalMemory._', '')}")

    def values(self) -> Mapping[str, StoredValue]:
        """Return all variables, for people and reports."""
        return dict(self._variables)

    def _get(self, name: str) -> Result:
        variable = self._variables.get(_checked(name))
        if variable is None:
            return success(value=None, version=0)
        return success(value=variable.value, version=variable.version)

    def _put(self, name: str, value: Any) -> Result:
        return self._write(_checked(name), value)

    def _compare_and_set(self, name: str, version: int, value: Any) -> Result:
        present = self._variables.get(_checked(name))
        if not isinstance(version, int) or isinstance(version, bool):
            raise TypeError(
                f"version is {version!r}; give the integer that memory.get returned, or 0 for a "
                "variable that was never written"
            )
        current = present.version if present else 0
        if current != version:
            text = f"{name!r} has version {current}, not {version}"
            return failure(
                "changed", text, value=present.value if present else None, version=current
            )
        return self._write(name, value)

    def _list(self) -> Result:
        return success(
            versions={name: variable.version for name, variable in sorted(self._variables.items())}
        )

    def _write(self, name: str, value: Any) -> Result:
        size = len(msgpack.packb(value))
        present = self._variables.get(name)
        total = self._bytes + size - (present.size if present else 0)
        if size > VALUE_BYTES:
            return error(
                "too_large",
                f"{name!r} would take {size} bytes, the limit is {VALUE_BYTES}; store a file name",
            )
        if total > TOTAL_BYTES or (present is None and len(self._variables) >= VARIABLES):
            return error(
                "memory_full",
                f"no room for {name!r}: {len(self._variables)} variables, {self._bytes} bytes",
            )
        version = present.version + 1 if present else 1
        self._variables[name] = StoredValue(value, version, size)
        self._bytes = total
        self._changed(name, value, version)
        return success(version=version)


def _checked(name: Any) -> str:
    if not isinstance(name, str) or not 0 < len(name) <= NAME_LENGTH:
        raise TypeError(f"name is {name!r:.40}; give a text of 1 to {NAME_LENGTH} characters")
    return name
