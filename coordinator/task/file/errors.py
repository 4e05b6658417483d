"""What is wrong with a task file: every fault with its line, its key and its remedy, in one
error."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence

from petrobot.coordinator.task.wording import Fault

_HEADER = re.compile(r"\s*\[{1,2}([^\[\]]+)\]{1,2}\s*(?:#.*)?$")
_KEY = re.compile(r"""\s*([\w.\-"']+)\s*=""")


class TaskFileError(ValueError):
    """A task file that cannot be used. `faults` are all that is wrong; `lines[i]` is the line of
    fault i (0: unknown)."""

    def __init__(self, source: str, faults: Sequence[Fault], lines: Sequence[int]) -> None:
        super().__init__(source, faults, lines)
        self.source = source
        self.faults = tuple(faults)
        self.lines = tuple(lines)

    def __str__(self) -> str:
        places = (f"{self.source}:{n}" if n else self.source for n in self.lines)
        return "\n".join(f"{at}: {fault}" for at, fault in zip(places, self.faults, strict=True))


def key_lines(text: str) -> dict[str, int]:
    """The line on which each dotted key of a TOML text stands, as far as a look at the lines can
    tell.

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


def syntax_fault(text: str, error: tomllib.TOMLDecodeError) -> tuple[Fault, int]:
    """What is wrong with a text that is not TOML, and its line. A key that is there twice is named
    with both its lines."""
    found = re.search(r"at line (\d+)", str(error))
    line = int(found[1]) if found else text.count("\n") + 1  # "at end of document"
    name = next((name for number, name in _keys(text) if number == line), "")
    first = next((number for number, own in _keys(text) if own == name), line)
    if first < line:
        return Fault(
            name, f"already written in line {first}", "drop one of the two, or rename it"
        ), line
    why, remedy = _syntax((*text.splitlines(), "")[line - 1])
    if why:
        return Fault("TOML", why, remedy), line
    return Fault("TOML", str(error), "see toml.io for the syntax"), line


def _syntax(line: str) -> tuple[str, str]:
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


def _keys(text: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the dotted key of each header and each key that begins a line."""
    table = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            table = _bare(header[1])
            yield number, table
        elif key := _KEY.match(line):
            yield number, f"{table}.{_bare(key[1])}".lstrip(".")


def line_of(key: str, lines: Mapping[str, int]) -> int:
    """The line of a key, or of the nearest table around it; 1 for what the file has no table for,
    where it may be added."""
    while key and key not in lines:
        key = key.rpartition(".")[0]
    return lines.get(key, 1)


def _bare(key: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in key.split("."))
