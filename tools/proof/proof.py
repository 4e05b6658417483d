"""A proof: a promised figure, how it is measured, when it holds, and the sources that it depends
on."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "reports" / "proof"
SUFFIXES = (".py", ".toml", ".eds", ".js", ".css", ".html")

Result = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class FigureProof:
    """One promised figure.

    `chapter` is its table in docs/figures.md. `sources` are the folders and files whose change
    makes it stale, without those in `apart`. `alone` is true where other work on the machine would
    falsify it (speeds).
    """

    name: str
    chapter: str
    measure: Callable[[], Result]
    holds: Callable[[Result], bool]
    floor: str
    sources: Sequence[str]
    apart: Sequence[str] = ()
    alone: bool = False

    @property
    def slug(self) -> str:
        """Return the name of its files."""
        return "".join(c if c.isalnum() or c in "+-" else "_" for c in self.name)

    def fingerprint(self) -> str:
        """Return the hash of all sources that the figure depends on."""
        digest = hashlib.sha256()
        for path in sorted({p for source in self.sources for p in _files(ROOT / source)}):
            place = path.relative_to(ROOT).as_posix()
            if not place.startswith(tuple(self.apart)):
                digest.update(place.encode() + path.read_bytes())
        return digest.hexdigest()[:16]


def _files(base: Path) -> list[Path]:
    if base.is_file():
        return [base]
    return [p for p in base.rglob("*") if p.suffix in SUFFIXES and "__pycache__" not in p.parts]


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module of this environment from the project's folder, and capture its output."""
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


def run_task(name: str, *arguments: str) -> dict[str, Any]:
    """Return the result of a `petrobot run`, stored under this name.

    Raises RuntimeError if the command fails for another reason than the task's outcome.
    """
    path = KEPT / f"{name}.run.json"
    done = command("petrobot.coordinator", "run", *arguments, "--quiet", "--json", str(path))
    if done.returncode not in (0, 1):
        raise RuntimeError(
            f"petrobot run {' '.join(arguments)}: exit {done.returncode}\n{done.stderr[-2000:]}"
        )
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result
