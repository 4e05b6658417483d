"""Message definitions as ROS 2 writes them (.msg, .srv, .action): read from the user's files, since
they differ between distributions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

_NAME = re.compile(r"[a-z][a-z0-9_]*/(msg|srv|action)/[A-Z][A-Za-z0-9]*")
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<size>\d*)\])?\s+"
    r"(?P<name>[a-z]\w*)(?:\s+\S.*)?"
)
_CONSTANT = re.compile(r"[a-z]\w*(?:<=\d+)?\s+[A-Z]\w*\s*=.*")
_PARTS = {"msg": ("",), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
_INTEGERS = {
    **{f"int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
    **{f"uint{n}": (0, 2**n - 1) for n in (8, 16, 32, 64)},
    "byte": (0, 255),
    "char": (0, 255),
}


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message."""

    type: str
    array: bool = False
    size: int | None = None
    """Length of the array: exactly, or at most if `bounded`; None for any."""
    bounded: bool = False


Definitions = Mapping[str, Mapping[str, Field]]
"""Fields by name, by message: "pkg/msg/Name", "pkg/action/Name.Goal"."""


def read(interface: str, text: str, source: str) -> dict[str, dict[str, Field]]:
    """Return the messages of one file. Raises ValueError with file, line and remedy."""
    if _NAME.fullmatch(interface) is None:
        raise ValueError(f"{interface!r}: expected a type such as nav2_msgs/action/NavigateToPose")
    package, kind, _ = interface.split("/")
    parts: list[dict[str, Field]] = [{}]
    for number, line in enumerate(text.splitlines(), 1):
        code = line.split("#")[0].strip()
        if code == "---":
            parts.append({})
        elif code and not _CONSTANT.fullmatch(code):
            found = _FIELD.fullmatch(code)
            if found is None:
                raise ValueError(f"{source}:{number}: expected `type name`, found {code!r:.60}")
            size = int(found["size"]) if found["size"] else None
            full = _full(found["type"], package)
            parts[-1][found["name"]] = Field(full, bool(found["array"]), size, bool(found["bound"]))
    names = _PARTS[kind]
    if len(parts) != len(names):
        raise ValueError(
            f"{source}: expected {len(names)} parts with --- between them, for {interface}"
        )
    return {f"{interface}.{n}" if n else interface: p for n, p in zip(names, parts, strict=True)}


def _full(name: str, package: str) -> str:
    if name in _INTEGERS or name in ("bool", "float32", "float64", "string", "wstring"):
        return name
    if name == "Header":
        return "std_msgs/msg/Header"
    parts = name.split("/")
    return name if len(parts) == 3 else "/".join([([package, *parts])[-2], "msg", parts[-1]])


def faults(value: Any, message: str, known: Definitions, path: str = "") -> list[str]:
    """Return what does not fit a message's definition; nothing about messages without one."""
    if not isinstance(value, dict):
        return [f"{path or message}: expected a table ({message}), found {str(value)[:40]!r}"]
    if message not in known:
        return []
    found = []
    for name, item in value.items():
        here = f"{path}.{name}" if path else name
        if name not in known[message]:
            near = get_close_matches(name, known[message], 1)
            says = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(known[message])}"
            found.append(f"{here}: {message} has no such field; {says}")
        else:
            found += _field_faults(item, known[message][name], known, here)
    return found


def _field_faults(value: Any, field: Field, known: Definitions, path: str) -> list[str]:
    if not field.array:
        return _value_faults(value, field.type, known, path)
    if isinstance(value, str) and field.type in ("uint8", "char", "byte"):
        return []  # base64
    if not isinstance(value, list):
        return [f"{path}: expected a list of {field.type}, found {str(value)[:40]!r}"]
    size, many = field.size, len(value)
    if size is not None and (many > size if field.bounded else many != size):
        word = "at most" if field.bounded else "exactly"
        return [f"{path}: expected {word} {size} values, found {many}"]
    return [
        fault
        for number, item in enumerate(value)
        for fault in _value_faults(item, field.type, known, f"{path}.{number}")
    ]


def _value_faults(value: Any, kind: str, known: Definitions, path: str) -> list[str]:
    if kind in _INTEGERS:
        low, high = _INTEGERS[kind]
        fits = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
    elif kind in ("float32", "float64"):
        fits = isinstance(value, int | float) and not isinstance(value, bool)
    elif kind == "bool":
        fits = isinstance(value, bool)
    elif kind in ("string", "wstring"):
        fits = isinstance(value, str)
    elif kind == "builtin_interfaces/msg/Time" and value == "now":
        fits = True  # rosbridge's word
    else:
        return faults(value, kind, known, path)
    return [] if fits else [f"{path}: expected {kind}, found {str(value)[:40]!r}"]
