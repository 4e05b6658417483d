"""ROS messages as plain data: checks, the values at paths in them, and their definitions, read from
the user's files (.msg, .srv, .action), since they differ between distributions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from difflib import get_close_matches
from typing import Any

from msgspec import Struct

Message = dict[str, Any]
DEPTH, ITEMS, TABLES = 16, 20_000, 1_000
"""Limits of a message: deepest nesting, most items, and most lists and tables. A driver's state can
contain several such messages."""
LARGEST_VALUE = 65_536
"""Characters of the largest message that is kept for actions: what is kept is published each
cycle."""

# --- values and paths ---------------------------------------------------------------------------


def unfit(values: Any, most: int = LARGEST_VALUE, gaps: bool = False) -> str:
    """Return what is wrong with the values of a message, "" if they are finite, not longer than
    `most` characters and can be sent on.

    ROS messages have no null: rosbridge writes it for NaN and infinity. With `gaps` a message may
    have it: sensors report so what they do not measure, as the temperature of a battery.
    """
    if not isinstance(values, dict):
        return f"expected a message, found {str(values)[:60]!r}"
    tables = 0
    for count, (path, value) in enumerate(_items(values, "", 0)):
        tables += isinstance(value, dict | list)
        if count > ITEMS or tables > TABLES:
            return f"has more than {ITEMS} items, or {TABLES} lists and tables"
        if (value is None and not gaps) or (isinstance(value, float) and not math.isfinite(value)):
            return f"{path}: is not a finite number"
        if isinstance(value, int) and not -(2**63) <= value < 2**64:
            return f"{path}: {str(value)[:30]} does not fit into 64 bits"
        if path.count(".") > DEPTH and isinstance(value, dict | list):
            return f"{words(path)}: is nested more than {DEPTH} deep"
        if words(path) != path or (isinstance(value, str | bytes) and words(value) != value):
            return f"{words(path)}: is not Unicode text"
    return "" if len(str(values)) <= most else f"is longer than {most} characters"


def words(said: Any) -> str:
    """Return what a server says as a text that can be sent on."""
    return str(said).encode("utf-8", "backslashreplace").decode()


def _items(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for name, item in inner:
        here = f"{path}.{name}" if path else str(name)
        yield here, item
        if isinstance(item, dict | list) and depth <= DEPTH:
            yield from _items(item, here, depth + 1)


def pick(values: Any, path: str) -> Any:
    """Return the value at a path such as "pose.position.x" or "points.0". Raises ValueError, also
    for null."""
    found = values
    for name in path.split("."):
        try:
            found = found[int(name)] if isinstance(found, list) else found[name]
        except (KeyError, IndexError, TypeError, ValueError):
            has = list(found)[:12] if isinstance(found, dict) else f"a {type(found).__name__}"
            raise ValueError(f"{path}: there is no {name!r}, but {has}") from None
    if found is None:
        raise ValueError(f"{path}: is not a finite number")
    return found


def filled(base: Mapping[str, Any], values: Mapping[str, Any]) -> Message:
    """Return a copy of a message with the values set at their paths. Raises ValueError."""
    message = deepcopy(dict(base))
    for path, value in values.items():
        *tables, last = path.split(".")
        table = message
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ValueError(f"{path}: {name!r} is not a table")
        table[last] = value
    return message


def fits(message: Message, when: Mapping[str, Any]) -> bool:
    """Return whether a message has all these values at their paths. A list of two numbers is a
    range."""
    for path, wanted in when.items():
        try:
            found = pick(message, path)
        except ValueError:
            return False
        if isinstance(wanted, list) and isinstance(found, int | float):
            if not wanted[0] <= found <= wanted[1]:
                return False
        elif found != wanted:
            return False
    return True


# --- definitions --------------------------------------------------------------------------------

_NAME = re.compile(r"[a-z][a-z0-9_]*/(msg|srv|action)/[A-Z][A-Za-z0-9]*")
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<longest>\d+))?(?P<array>\[(?P<bound><=)?(?P<size>\d*)\])?\s+"
    r"(?P<name>[a-z]\w*)(?:\s+\S.*)?"
)
_CONSTANT = re.compile(r"[a-z]\w*(?:<=\d+)?\s+[A-Z]\w*\s*=.*")
_PARTS = {"msg": ("",), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
_BYTES = ("uint8", "byte", "char")
_FLOAT32 = 3.4028235e38
"""The largest float32."""
_INTEGERS = {
    **{f"int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
    **{f"uint{n}": (0, 2**n - 1) for n in (8, 16, 32, 64)},
    **dict.fromkeys(_BYTES, (0, 255)),
}
_RANGES: Mapping[str, tuple[float, float]] = {**_INTEGERS, "float32": (-_FLOAT32, _FLOAT32)}
BASIC: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(_INTEGERS, (int,)),
    **dict.fromkeys(("float32", "float64"), (int, float)),
    **dict.fromkeys(("string", "wstring"), (str,)),
    "bool": (bool,),
}
"""By basic type: the types of its values; the last one has the type's zero."""


class Field(Struct, frozen=True):
    """One field of a message."""

    type: str
    array: bool = False
    size: int | None = None
    """Length of the array: exactly, or at most if `bounded`; None for any."""
    bounded: bool = False
    longest: int | None = None
    """Bytes of the longest text; None for any."""


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
            size, longest = (int(found[n]) if found[n] else None for n in ("size", "longest"))
            full, array, bound = _full(found["type"], package), found["array"], found["bound"]
            parts[-1][found["name"]] = Field(full, bool(array), size, bool(bound), longest)
    names = _PARTS[kind]
    if len(parts) != len(names):
        raise ValueError(
            f"{source}: expected {len(names)} parts with --- between them, for {interface}"
        )
    return {f"{interface}.{n}" if n else interface: p for n, p in zip(names, parts, strict=True)}


def _full(name: str, package: str) -> str:
    *packages, last = name.split("/")
    return name if name in BASIC else f"{(packages or [package])[0]}/msg/{last}"


def faults(value: Any, kind: str, known: Definitions, path: str = "") -> list[str]:
    """Return what does not fit the definition of a message, or a basic type; nothing about messages
    without a definition."""
    if kind in BASIC:
        low, high = _RANGES.get(kind, (-math.inf, math.inf))
        odd = isinstance(value, float) and not math.isfinite(value)  # a float32 has them, too
        fit = type(value) in BASIC[kind] and (kind not in _RANGES or odd or low <= value <= high)
        return [] if fit else [f"{path}: expected {kind}, found {str(value)[:40]!r}"]
    if kind == "builtin_interfaces/msg/Time" and value == "now":  # rosbridge's word
        return []
    if not isinstance(value, dict):
        return [f"{path or kind}: expected a table ({kind}), found {str(value)[:40]!r}"]
    found, fields = [], known.get(kind, {})
    for name, item in value.items() if kind in known else ():
        here = f"{path}.{name}" if path else name
        if name in fields:
            found += _faults_of_field(item, fields[name], known, here)
        else:
            near = get_close_matches(name, fields, 1)
            says = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(fields)}"
            found.append(f"{here}: {kind} has no such field; {says}")
    return found


def _faults_of_field(value: Any, field: Field, known: Definitions, path: str) -> list[str]:
    if not field.array:
        if field.longest is not None and len(str(value).encode()) > field.longest:
            return [f"{path}: expected at most {field.longest} bytes, found {str(value)[:40]!r}"]
        return faults(value, field.type, known, path)
    if isinstance(value, str) and field.type in _BYTES:
        return []  # base64
    if not isinstance(value, list):
        return [f"{path}: expected a list of {field.type}, found {str(value)[:40]!r}"]
    size, many = field.size, len(value)
    if size is not None and (many > size if field.bounded else many != size):
        word = "at most" if field.bounded else "exactly"
        return [f"{path}: expected {word} {size} values, found {many}"]
    one = Field(field.type, longest=field.longest)
    each = (_faults_of_field(item, one, known, f"{path}.{n}") for n, item in enumerate(value))
    return [fault for found in each for fault in found]
