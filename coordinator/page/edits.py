"""Edit a task file's text: parts that were not edited keep every byte, their comments and their
order.

The page sends the whole document as plain JSON data. It is compared with the content of the text;
only values that differ are replaced in the text (tomlkit keeps the rest), and renamed tables keep
their position.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, MutableMapping, Sequence
from typing import Any

import tomlkit
from msgspec import Struct
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array, InlineTable, Item
from tomlkit.toml_document import TOMLDocument

LARGEST_SAFE_INTEGER = 2**53 - 1
_BARE_END = re.compile(r"(?<!\r)\n")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_FAULTS = (
    TOMLKitError,
    TypeError,
    ValueError,
    KeyError,
    IndexError,
    AttributeError,
    RecursionError,
)


class EditError(ValueError):
    """The text is not TOML, or the edit cannot be made."""


class Rename(Struct, frozen=True):
    """A renamed table: in the table at `path`, from `old` to `new`."""

    path: tuple[str, ...]
    old: str
    new: str


def parse(text: str) -> TOMLDocument:
    """Return the document of a text. Raises EditError."""
    try:
        return tomlkit.parse(text)
    except (TOMLKitError, ValueError, RecursionError) as fault:
        raise EditError(f"not TOML: {fault}") from fault


def plain(document: TOMLDocument) -> dict[str, Any]:
    """Return the document as JSON data; values that JSON cannot hold (dates, infinities, huge
    integers) become text."""
    value: dict[str, Any] = _json_value(document.unwrap())
    return value


def edited(text: str, wanted: Mapping[str, Any], renames: Sequence[Rename] = ()) -> str:
    """Return the text with its document changed to `wanted`, or the same bytes if they were equal.
    Raises EditError."""
    for rename in renames:
        text = _renamed(text, rename)
    document = parse(text)
    goal = _without_none(wanted)
    if _same(plain(document), goal):
        return text
    try:
        _make_equal(document, goal, ())
        result = _lines_as_in(text, tomlkit.dumps(document))
        written = plain(parse(result))
    except _FAULTS as fault:
        raise EditError(f"the edit cannot be written as TOML: {fault}") from fault
    if not _same(_without_empty(written), _without_empty(goal)):
        raise EditError("this file's layout is too unusual for the edit: make it by hand")
    return result


def _lines_as_in(text: str, result: str) -> str:
    """Return the result with the line ends of the text, if the text has only one kind."""
    return (
        _BARE_END.sub("\r\n", result) if "\r\n" in text and not _BARE_END.search(text) else result
    )


def _json_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _json_value(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_json_value(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int) and abs(value) > LARGEST_SAFE_INTEGER:
        return str(value)
    if isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(v) for key, v in value.items() if v is not None}
    if isinstance(value, (list, tuple)):
        return [_without_none(v) for v in value]
    return value


def _without_empty(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document without empty tables of elements: the header is removed with the last
    element."""
    kept = {key: value for key, value in document.items() if value != {}}
    if isinstance(kept.get("subnets"), Mapping):
        kept["subnets"] = {
            n: _without_empty(s) if isinstance(s, Mapping) else s
            for n, s in kept["subnets"].items()
        }
    return kept


def _same(left: Any, right: Any) -> bool:
    """Return whether values are equal as JSON: 1 and 1.0 are the same number, true is not a
    number."""
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        return left.keys() == right.keys() and all(_same(left[key], right[key]) for key in left)
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(_same, left, right))
    if isinstance(left, bool) != isinstance(right, bool):
        return False
    return bool(left == right)


def _value_of(item: Any) -> Any:
    return _json_value(item.unwrap() if hasattr(item, "unwrap") else item)


def _make_equal(
    table: MutableMapping[str, Any], wanted: Mapping[str, Any], path: tuple[str, ...]
) -> None:
    for key in [key for key in table if key not in wanted]:
        del table[key]
    for key, value in wanted.items():
        if key not in table:
            _put(table, key, value, (*path, key))
        elif not _same(_value_of(table[key]), value):
            _change(table, key, value, (*path, key))


def _put(table: MutableMapping[str, Any], key: str, value: Any, path: tuple[str, ...]) -> None:
    if isinstance(value, Mapping) and not isinstance(table, InlineTable) and _has_header(path):
        made = tomlkit.table(
            is_super_table=bool(value) and all(isinstance(v, Mapping) for v in value.values())
        )
        for inner, inner_value in value.items():
            _put(made, inner, inner_value, (*path, inner))
        table[key] = made
    else:
        table[key] = _item(value)


def _has_header(path: tuple[str, ...]) -> bool:
    """Return whether a new table gets its own [header]: `places.p`, `subnets.s.places.p`; arguments
    are written inline."""
    return len(path) <= 2 or (path[0] == "subnets" and len(path) <= 4)


def _is_element(path: tuple[str, ...]) -> bool:
    """Return whether a path leads to one element: a place, transition, event, variable or primitive
    task."""
    return len(path) == 2 or (path[0] == "subnets" and len(path) == 4)


def _change(table: MutableMapping[str, Any], key: str, value: Any, path: tuple[str, ...]) -> None:
    old = table[key]
    if isinstance(value, Mapping) and isinstance(old, MutableMapping):
        try:
            _make_equal(old, value, path)
        except _FAULTS:
            if not _is_element(path):
                raise
            # Its lines are not together (dotted keys): this element is written again.
            del table[key]
            _put(table, key, value, path)
    elif isinstance(value, list) and isinstance(old, Array):
        _change_array(old, value)
    elif isinstance(value, int) and not isinstance(value, bool) and isinstance(old, float):
        table[key] = float(value)
    else:
        table[key] = _item(value)


def _change_array(array: Array, wanted: list[Any]) -> None:
    """Change only the entries between the common head and the common tail."""
    have = [_value_of(entry) for entry in array]
    head = 0
    while head < min(len(have), len(wanted)) and _same(have[head], wanted[head]):
        head += 1
    tail = 0
    while tail < min(len(have), len(wanted)) - head and _same(have[-1 - tail], wanted[-1 - tail]):
        tail += 1
    middle = wanted[head : len(wanted) - tail]
    replaced = min(len(middle), len(have) - head - tail)
    for i in range(replaced):
        array[head + i] = _item(middle[i])
    for i in range(len(have) - tail - 1, head + replaced - 1, -1):
        del array[i]
    for i in range(replaced, len(middle)):
        array.insert(head + i, _item(middle[i]))


def _item(value: Any) -> Item:
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        for key, inner in value.items():
            inline[key] = _item(inner)
        return inline
    if isinstance(value, list):
        array = tomlkit.array()
        for entry in value:
            array.append(_item(entry))
        return array
    if isinstance(value, float) and value.is_integer() and abs(value) < LARGEST_SAFE_INTEGER:
        return tomlkit.item(float(value))
    made: Item = tomlkit.item(value)
    return made


def _renamed(text: str, rename: Rename) -> str:
    """Return the text with the table's headers renamed; unchanged if that is not possible in place
    (the table is then written again)."""
    goal = plain(parse(text))
    table: Any = goal
    for key in rename.path:
        table = table.get(key) if isinstance(table, dict) else None
    if not isinstance(table, dict) or rename.old not in table or rename.new in table:
        return text
    table[rename.new] = table.pop(rename.old)
    candidate = _header_pattern(rename).sub(
        lambda found: found[1] + _key(rename.new) + found[2], text
    )
    try:
        done = _same(plain(parse(candidate)), goal)
    except EditError:
        done = False
    return candidate if done else text


def _header_pattern(rename: Rename) -> re.Pattern[str]:
    def key(name: str) -> str:
        forms = [f'"{re.escape(name)}"', f"'{re.escape(name)}'"]
        return "(?:" + "|".join([re.escape(name), *forms] if _BARE.fullmatch(name) else forms) + ")"

    head = r"[ \t]*\.[ \t]*".join(key(part) for part in rename.path)
    return re.compile(rf"(?m)^([ \t]*\[[ \t]*{head}[ \t]*\.[ \t]*){key(rename.old)}([ \t]*[.\]])")


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else tomlkit.key(name).as_string()
