"""A proof: a promised figure, how it is measured, when it holds, and the sources that it depends
on."""

from __future__ import annotations

import ast
import hashlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from msgspec import Struct

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "reports" / "proof"
"""Where the measuring commands leave their files."""
LOCK_STEP = (
    *("coordinator/engine", "coordinator/run", "coordinator/task"),
    *("coordinator/tasks/catch_ball.toml", "services.toml", "services/cell.toml"),
    *("services/action.py", "services/device.py", "services/vision", "services/motion"),
    *("services/worker", "services/node/inline_host.py", "services/node/lockstep.py"),
    *("services/comm/calls", "services/comm/lockstep", "services/comm/streams"),
    *("sim/catching", "sim/bus/canopen_node.py", "sim/bus/power_drive.py", "sim/faults.py"),
    "sim/laboratory_party.py",
)
"""What decides which balls are caught in lock step."""
SUFFIXES = (".py", ".toml", ".eds", ".js", ".css", ".html")

Result = Mapping[str, Any]


class FigureProof(Struct, frozen=True):
    """One promised figure.

    `chapter` is its table in docs/figures.md. `sources` are the folders and files whose change
    makes it stale. `alone` is true where other work on the machine would falsify it (speeds).
    `sample` is a short run of the same kind, as a digest of all its numbers: where that is still
    the same after a change of the sources, the figure is not measured again.
    """

    name: str
    chapter: str
    measure: Callable[[], Result]
    holds: Callable[[Result], bool]
    floor: str
    sources: Sequence[str]
    alone: bool = False
    sample: Callable[[], str] | None = None

    def fingerprint(self) -> str:
        """Return the hash of all sources that the figure depends on, without their comments,
        docstrings and layout. It differs between versions of Python."""
        digest = hashlib.sha256()
        for path in sorted({p for source in self.sources for p in _files(ROOT / source)}):
            place = path.relative_to(ROOT).as_posix()
            digest.update(place.encode() + _meaning(path))
        return digest.hexdigest()[:16]

    def holds_for(self, data: Mapping[str, Any]) -> bool:
        """Return whether a stored result is one of the present sources."""
        return self.fingerprint() in (data.get("sources"), data.get("same_at"))


def digest(result: object) -> str:
    """Return the hash of a result that JSON can write, with all its digits."""
    return hashlib.sha256(json.dumps(result, sort_keys=True).encode()).hexdigest()[:16]


def _files(base: Path) -> list[Path]:
    if base.is_file():
        return [base]
    return [p for p in base.rglob("*") if p.suffix in SUFFIXES and "__pycache__" not in p.parts]


@cache
def _meaning(path: Path) -> bytes:
    if path.suffix == ".toml":
        with path.open("rb") as file:
            return json.dumps(tomllib.load(file), sort_keys=True, default=str).encode()
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [one for one in body if not _says_nothing(one)]  # type: ignore[attr-defined]
    return ast.dump(tree).encode()


def _says_nothing(one: ast.stmt) -> bool:
    """Return whether a statement is only a text, such as a docstring."""
    return (
        isinstance(one, ast.Expr)
        and isinstance(one.value, ast.Constant)
        and isinstance(one.value.value, str)
    )


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
