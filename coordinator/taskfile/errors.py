"""What is wrong with a task file: every fault with its line, its key and its remedy, in one error."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from coordinator.conditions.wording import Fault

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(?:#.*)?$")
_KEY = re.compile(r"""\s*([\w.\-"']+)\s*=""")


class TaskFileError(ValueError):
    """A task file that cannot be used. `faults` are all that is wrong; `lines[i]` is the line of fault i (0: unknown)."""

    def __init__(self, source: str, faults: Sequence[Fault], lines: Sequence[int]) -> None:
        self.source = source
        self.faults = tuple(faults)
        self.lines = tuple(lines)
        places = (f"{source}:{n}" if n else source for n in lines)
        super().__init__("\n".join(f"{place}: {fault}" for place, fault in zip(places, faults, strict=True)))


def key_lines(text: str) -> dict[str, int]:
    """The line on which each dotted key of a TOML text stands, as far as a look at the lines can tell."""
    lines: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            table = _bare(header[1])
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            name = _bare(key[1])
            lines.setdefault(f"{table}.{name}" if table else name, number)
    return lines


def line_of(key: str, lines: Mapping[str, int]) -> int:
    """The line of a key, or of the nearest table around it; 0 if there is none."""
    while key and key not in lines:
        key = key.rpartition(".")[0]
    return lines.get(key, 0)


def _bare(key: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in key.split("."))
