"""What is wrong with a task file: every fault with its line, its key and its remedy, in one
error."""

from __future__ import annotations

from collections.abc import Sequence

from petrobot.coordinator.task.wording import Fault


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
