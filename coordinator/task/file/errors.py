"""What is wrong with a task file: every fault with its line, its key and its remedy, in one
error."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

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
    table = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            name = table = _bare(header[1])
        elif key := _KEY.match(line):
            name = f"{table}.{_bare(key[1])}".lstrip(".")
        else:
            continue
        lines.setdefault(name, number)
        while name := name.rpartition(".")[0]:
            implied.setdefault(name, number)
    return {**implied, **lines}


def line_of(key: str, lines: Mapping[str, int]) -> int:
    """The line of a key, or of the nearest table around it; 1 for what the file has no table for,
    where it may be added."""
    while key and key not in lines:
        key = key.rpartition(".")[0]
    return lines.get(key, 1)


def _bare(key: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in key.split("."))
