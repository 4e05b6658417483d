"""Run commands one after the other in the present folder, and print as JSON what each printed and
which files it left.

This is a separate process, since the folder is on a disk that exists only in its mount namespace.
Its argument is a JSON list of command lines, each a list.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path

from petrobot.coordinator.cli import main


def outcome(command: list[str], there: set[Path]) -> dict[str, object]:
    """Return exit code, standard error, and the files that were not `there` before; remove these
    files."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(command)
        except Exception as fault:
            code = -1
            said.write(f"Traceback: {type(fault).__name__}: {fault}")
    left = sorted(str(path) for path in Path().rglob("*") if path.is_file() and path not in there)
    for path in set(Path().iterdir()) - there:
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return {"code": code, "said": said.getvalue(), "left": left}


def run() -> None:
    """Run all commands."""
    there = set(Path().rglob("*"))
    print(json.dumps([outcome(command, there) for command in json.loads(sys.argv[1])]))


if __name__ == "__main__":
    run()
