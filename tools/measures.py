"""Measure the source: sizes, names, comments and the files on the main path, as a Markdown table.

    python -m tools.measures                 of this checkout
    python -m tools.measures REVISION ...    of revisions beside it (read from git's history)
    python -m tools.measures --walk          which files one run of an action really passes

Code lines are lines that are neither blank, comment nor docstring. A file serves one other file if
exactly one module imports it; commands of the command line, `__main__` and package files, which are
found by their names, are left out. The main path is what one action passes from the token that
enters its place to the firing that follows: its files are listed in docs/life-of-a-run.md. The walk
runs the robot that `petrobot new robot` writes, in real time, and notes every function call in each
process between two firings.
"""

from __future__ import annotations

import argparse
import ast
import io
import itertools
import os
import re
import statistics
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections import Counter
from pathlib import Path
from typing import Final

from msgspec import Struct, field

ROOT = Path(__file__).parents[1]
TOPS = ("coordinator", "services", "sim")
COLUMNS = 100


class Measures(Struct):
    """The counts of one checkout."""

    files: int = 0
    code: list[int] = field(default_factory=list)
    """Code lines of each file."""
    functions: list[int] = field(default_factory=list)
    """Code lines of each function."""
    comments: int = 0
    long: int = 0
    lines: int = 0
    folders: set[str] = field(default_factory=set)
    classes: Counter[str] = field(default_factory=Counter)
    serving_one: int = 0
    tests: int = 0

    def rows(self) -> list[tuple[str, str]]:
        """Return the measures with their names."""
        repeated = sum(1 for count in self.classes.values() if count > 1)
        return [
            ("code lines / files", f"{sum(self.code) / 1000:.1f}k / {self.files}"),
            ("folders with modules", str(len(self.folders))),
            ("file, median / most (code lines)", _median_most(self.code)),
            ("function, median / most (code lines)", _median_most(self.functions)),
            ("comment lines per 100 code lines", f"{100 * self.comments / sum(self.code):.1f}"),
            ("files that serve exactly one other file", str(self.serving_one)),
            ("class names defined more than once", f"{repeated} of {len(self.classes)}"),
            (f"lines over {COLUMNS} columns", f"{100 * self.long / self.lines:.1f} %"),
            ("lines of tests", f"{self.tests / 1000:.1f}k"),
        ]


def _median_most(sizes: list[int]) -> str:
    return f"{statistics.median(sizes):.0f} / {max(sizes)}"


def code_lines(text: str, tree: ast.Module) -> set[int]:
    """Return the numbers of the lines with code."""
    prose: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            prose |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    marks = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in marks and token.type != tokenize.ENDMARKER:
            held |= set(range(token.start[0], token.end[0] + 1))
    return held - prose


def measure(root: Path) -> Measures:
    """Count in a checkout."""
    found = Measures()
    imported: dict[str, set[str]] = {}
    names: dict[str, Path] = {}
    for top in TOPS:
        for path in sorted((root / top).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    for name, path in names.items():
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        held = code_lines(text, tree)
        found.files += 1
        found.code.append(len(held))
        found.comments += sum(1 for line in text.splitlines() if line.lstrip().startswith("#"))
        found.lines += text.count("\n")
        found.long += sum(1 for line in text.splitlines() if len(line) > COLUMNS)
        found.folders.add(str(path.parent))
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                found.classes[node.name] += 1
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                last = node.end_lineno or node.lineno
                found.functions.append(len(held & set(range(node.lineno, last + 1))))
        for target in imports(tree):
            imported.setdefault(target.removeprefix("petrobot."), set()).add(name)
    found.serving_one = sum(
        1
        for name, path in names.items()
        if len(imported.get(name, ())) == 1
        and path.name not in ("__init__.py", "__main__.py")
        and ".cli." not in name
    )
    for path in (root / "tests").rglob("*.py"):
        found.tests += path.read_text(encoding="utf-8").count("\n")
    return found


def imports(tree: ast.Module) -> set[str]:
    """Return the dotted names that a module imports: modules, and names from them."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def main_path() -> set[str]:
    """Return the files that docs/life-of-a-run.md names between the token and the firing."""
    page = ROOT / "docs" / "life-of-a-run.md"
    if not page.exists():
        return set()
    walked = page.read_text(encoding="utf-8").split("\n## ")[1]
    return set(re.findall(r"`((?:coordinator|services)/[\w/]+\.py)", walked))


NOTE_CALLS = """
import os, sys, threading, time

root, notes, files = os.environ["WALK_ROOT"] + "/", {}, {}

def note(frame, event, _):
    if event == "call":
        name = frame.f_code.co_filename
        if name not in files:
            files[name] = os.path.realpath(name).removeprefix(root)
        if files[name].startswith(("coordinator/", "services/")):
            if os.getpid() not in notes:
                notes[os.getpid()] = open(f"{os.environ['WALK_NOTES']}/{os.getpid()}", "w", 1)
            called = f"{time.monotonic()} {files[name]} {frame.f_code.co_name}"
            notes[os.getpid()].write(called + chr(10))

sys.setprofile(note)
threading.setprofile(note)
"""
"""Lies on the path as `sitecustomize`, so every Python process of the walk begins with it."""
FIRING = ("coordinator/engine/firing.py", "fire")
ACTION_TAKES: Final = 0.1
"""Least time between two firings with a run between them (s)."""


def walk() -> int:
    """Print the files that one run of an action passes, by process."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        (home / "sitecustomize.py").write_text(NOTE_CALLS, encoding="utf-8")
        (home / "notes").mkdir()
        petrobot = [sys.executable, "-m", "petrobot.coordinator"]
        command = [*petrobot, "new", "robot", "walker"]
        subprocess.run(command, cwd=home, check=True, capture_output=True, timeout=60)
        of_walk = {"PYTHONPATH": folder, "WALK_ROOT": str(ROOT), "WALK_NOTES": f"{home}/notes"}
        command = [*petrobot, "run", "walker.toml", "--up", "--no-page", "--quiet"]
        subprocess.run(
            command, cwd=home / "walker", env={**os.environ, **of_walk}, check=False, timeout=120
        )
        calls = [
            [
                (float(when), file, function)
                for when, file, function in map(str.split, path.read_text().splitlines())
            ]
            for path in sorted((home / "notes").iterdir())
        ]
    firings = sorted(when for process in calls for when, *what in process if tuple(what) == FIRING)
    begun, ended = next(
        pair for pair in itertools.pairwise(firings) if pair[1] - pair[0] > ACTION_TAKES
    )
    named, passed = main_path(), set[str]()
    for process in calls:
        here = dict.fromkeys(file for when, file, _ in process if begun <= when <= ended)
        if here:
            print("\nA process:", *(f"{'*' * (file in named):2}{file}" for file in here), sep="\n")
        passed |= here.keys()
    both = len(named & passed)
    print(f"\n{len(passed)} files; * {both} of the {len(named)} in docs/life-of-a-run.md")
    return 0


def at_revision(revision: str) -> Measures:
    """Measure a revision of the repository's history."""
    command = ["git", "-C", str(ROOT), "archive", revision, *TOPS, "tests"]
    packed = subprocess.run(command, check=True, capture_output=True).stdout
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(folder, filter="data")
        return measure(Path(folder))


def main() -> int:
    """Print the table, or the walk."""
    parser = argparse.ArgumentParser(description="Measure the source.")
    parser.add_argument("revisions", nargs="*", metavar="REVISION", help="compare with these")
    parser.add_argument(
        "--walk", action="store_true", help="list the files that one run of an action passes"
    )
    options = parser.parse_args()
    if options.walk:
        return walk()
    columns = {revision: at_revision(revision).rows() for revision in options.revisions}
    columns["now"] = measure(ROOT).rows()
    print("| | " + " | ".join(columns) + " |")
    print("|---|" + "---|" * len(columns))
    for number, (title, _) in enumerate(columns["now"]):
        print(f"| {title} | " + " | ".join(rows[number][1] for rows in columns.values()) + " |")
    if path := main_path():
        print(f"\nFiles from the token to the firing (docs/life-of-a-run.md): {len(path)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
