"""Read TOML, and say of each fault where it is: tomllib tells no positions of keys, and of a text
that is not TOML only where it stopped reading."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

_HEADER = re.compile(r"\s*\[{1,2}([^\[\]]+)\]{1,2}\s*(?:#.*)?$")
_KEY = re.compile(r"""\s*([\w./\-"']+)\s*=""")

NOT_TOML = "not valid TOML"
"""Stands for the key of a fault that concerns the text as a whole."""
_TOO_LARGE = "needs more than 64 bits", "write a smaller number"
_ENDLESS = re.compile(r"\d{4301}")
LONGEST = 1_000
"""Most characters of a fault that are shown: the value in it may be a whole file."""


class InputError(Exception):
    """What the user gave cannot be used: the text says what, where, and the remedy. A command that
    ends with it prints the text."""

    exit_code = 2
    """Exit code of that command."""


class TomlError(ValueError):
    """A text that is not TOML: in which `line` (None: unknown), at which `key`, what was `found`,
    and the `remedy`."""

    def __init__(self, source: str, line: int | None, key: str, found: str, remedy: str) -> None:
        super().__init__(source, line, key, found, remedy)
        self.source, self.line, self.key, self.found, self.remedy = source, line, key, found, remedy

    def __str__(self) -> str:
        place = f"{self.source}:{self.line}" if self.line is not None else self.source
        return f"{place}: {self.key}: {self.found}; {self.remedy}"


def read_toml(text: str | bytes, source: str) -> dict[str, Any]:
    """Return the data of a TOML text; `source` names it in errors. Raises TomlError."""
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise not_utf8(error, source) from error
    text = text.removeprefix("\ufeff")  # some editors begin a file with a byte-order mark
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(source, *_syntax_fault(text, str(error))) from error
    except RecursionError as error:
        raise TomlError(source, None, NOT_TOML, "nested too deeply", "flatten it") from error
    except ValueError as error:  # Python reads no number of more than 4,300 digits
        lines = enumerate(text.splitlines(), 1)
        line = next((at for at, line in lines if _ENDLESS.search(line.replace("_", ""))), None)
        raise TomlError(source, line, "a number", *_TOO_LARGE) from error
    if key := _too_large(data, ""):
        raise TomlError(source, line_of(key, key_lines(text)), key, *_TOO_LARGE)
    return data


def shortened(fault: str) -> str:
    """Return the text of a fault without the middle of a very long one."""
    if len(fault) <= LONGEST:
        return fault
    return f"{fault[: LONGEST // 2]} ... {fault[-LONGEST // 2 :]}"


def not_utf8(error: UnicodeDecodeError, source: str) -> TomlError:
    """Return the fault of a text that is not UTF-8."""
    line = error.object.count(b"\n", 0, error.start) + 1
    return TomlError(source, line, "file", "is not UTF-8", "save it as UTF-8")


def _too_large(value: Any, key: str) -> str:
    """Return the key of the first whole number that TOML does not have (it has those of 64 bits),
    and no journal can store; tomllib accepts any. Empty if there is none."""
    if isinstance(value, dict):
        found = (_too_large(each, f"{key}.{name}") for name, each in value.items())
    elif isinstance(value, list):
        found = (_too_large(each, key) for each in value)
    else:
        too_large = isinstance(value, int) and not -(2**63) <= value < 2**63
        return key.removeprefix(".") if too_large else ""
    return next((each for each in found if each), "")


def key_lines(text: str) -> dict[str, int]:
    """Return the line on which each dotted key of a TOML text stands, as far as a look at the lines
    can tell.

    A table without a line of its own (`places`, where only `[places.free]` stands) has that of the
    first one in it.
    """
    lines: dict[str, int] = {}
    implied: dict[str, int] = {}
    for number, name in _keys(text):
        lines.setdefault(name, number)
        while name := name.rpartition(".")[0]:
            implied.setdefault(name, number)
    return {**implied, **lines}


def line_of(key: str, lines: Mapping[str, int]) -> int:
    """Return the line of a key, or of the nearest table around it; 1 for what the file has no table
    for, where it may be added."""
    while key and key not in lines:
        key = key.rpartition(".")[0]
    return lines.get(key, 1)


def _keys(text: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the dotted key of each header and each key that begins a line."""
    table = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            table = _bare(header[1])
            yield number, table
        elif key := _KEY.match(line):
            yield number, f"{table}.{_bare(key[1])}".lstrip(".")


def _bare(key: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in key.split("."))


def _syntax_fault(text: str, told: str) -> tuple[int, str, str, str]:
    """Return line, key, fault and remedy of a text that is not TOML, from what tomllib told. A key
    that is there twice is named with both its lines."""
    found = re.search(r"at line (\d+)", told)
    line = int(found[1]) if found else text.count("\n") + 1  # "at end of document"
    name = next((name for number, name in _keys(text) if number == line), "")
    first = next((number for number, own in _keys(text) if own == name), line)
    if first < line:
        return line, name, f"already written in line {first}", "drop one of the two, or rename it"
    why, remedy = _odd_line((*text.splitlines(), "")[line - 1])
    told = re.sub(r" \(at line \d+, column (\d+)\)", r" in column \1", told)
    return line, NOT_TOML, why or told, remedy or "see toml.io for the syntax"


def _odd_line(line: str) -> tuple[str, str]:
    """Return what is wrong with a line that is not TOML, and the remedy: a quote or brace that is
    not closed, or a word of Python; empty if it is something else."""
    closed = re.compile(r"""\"(?:\\.|[^\"\\])*\"|'[^']*'|#.*""")
    rest = closed.sub(lambda whole: " " * len(whole[0]), line)
    if opened := re.search("[\"']", rest):
        return f"the quote in column {opened.start() + 1} is not closed", "close it"
    if rest.count("{") > rest.count("}"):
        text = f"the brace in column {rest.index('{') + 1} is not closed in its line"
        return text, "write all of it in one line, or as a table of its own"
    if word := re.search(r"=\s*(True|False|None)\b", rest):
        return f"{word[1]} is Python", "write true or false, or leave the key out"
    if word := re.search(r"=\s*(?:\[(?:[^\]=]*,)?\s*)?([A-Za-z_]\w*)\s*(?=[,\]}]|$)", rest):
        return f"{word[1]} is a text without quotes", f'write "{word[1]}"'
    return "", ""
