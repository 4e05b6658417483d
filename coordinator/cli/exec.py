"""How a command becomes another program: signals, exit code and terminal are that program's own,
and nothing is left behind."""

from __future__ import annotations

import os
import sys
from typing import NoReturn


def become(module: str, *arguments: str) -> NoReturn:
    """Replace this process by `python -m module arguments`. A child process would outlive a kill of
    its parent."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
