"""Sizes of the experiment, and its results as lines of JSON: a stored result is not measured
again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from msgspec import Struct

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
TASK = HERE / "catch_ball.toml"
"""The shipped task as it was when the experiment was registered: the faults are edits of it."""
CELL = ROOT / "services.toml"
PLANT = HERE / "plant.toml"
PROGRAMS = ("net", "tree", "machine")

Line = dict[str, Any]


class Size(Struct, frozen=True):
    """How much is measured. The training of the forecasts has 300 trials in both sizes, as a tenth
    of it would be another experiment."""

    trials: int
    """Trials for each design fault, and for each forecast change."""
    kills: int
    """Kills of each program."""
    learning: int
    """Trials of each learning policy and seed, in the plant."""
    learning_seeds: int
    """Number of seeds of each policy."""
    laboratory: int
    """Balls for each program and regime in the simulated laboratory."""
    training: int = 300


FULL = Size(1000, 200, 900, 10, 120)
TENTH = Size(100, 20, 900, 1, 12)


class Results:
    """The results of a folder, by part and key."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "results.jsonl"
        self._lines: dict[tuple[str, str], Line] = {}
        if self._path.exists():
            whole = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
            for line in whole:
                # an incomplete line was being written when the process was killed
                if line.endswith("\n"):
                    found = json.loads(line)
                    self._lines[found["part"], found["key"]] = found
            if whole and not whole[-1].endswith("\n"):
                self._path.write_text("".join(whole[:-1]), encoding="utf-8")

    def has(self, part: str, key: str) -> bool:
        """Return whether a result is there."""
        return (part, key) in self._lines

    def get(self, part: str, key: str) -> Line:
        """Return a result. Raises KeyError."""
        return self._lines[part, key]

    def of(self, part: str) -> list[Line]:
        """Return the results of a part, in the order of their keys."""
        return [line for (own, _), line in sorted(self._lines.items()) if own == part]

    def add(self, part: str, key: str, line: Line) -> None:
        """Store a result."""
        line = {"part": part, "key": key, **line}
        self._lines[part, key] = line
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def measure(
        self,
        part: str,
        work: Callable[..., Line],
        jobs: Iterable[tuple[str, tuple[Any, ...]]],
        workers: int,
    ) -> None:
        """Do the jobs (key, arguments of `work`) that have no result yet, in processes."""
        open_ = [(key, given) for key, given in jobs if not self.has(part, key)]
        if not open_:
            return
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            asked = {pool.submit(work, *given): key for key, given in open_}
            for done in as_completed(asked):
                self.add(part, asked[done], done.result())
                print(f"{part}: {asked[done]}", flush=True)


def keyed(names: Iterable[str], numbers: Iterable[int]) -> Iterator[tuple[str, str, int]]:
    """Yield key, name and number for each pair."""
    listed = list(numbers)
    for name in names:
        for number in listed:
            yield f"{name}/{number:04}", name, number
