"""Actions as Python callables: arguments checked against their signature, what they raise described in one line."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_OURS = {
    str(Path(__file__).with_name(name))
    for name in ("runner.py", "execution.py", "context.py", "outlets.py", "callables.py")
}


def check_arguments(function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Raise TypeError that names the argument which does not fit and what would; the first parameter is the context."""
    parameters = list(inspect.signature(function).parameters.values())[1:]
    names = sorted(p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD))
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for name in arguments:
        if name not in names and not takes_any:
            raise TypeError(f"takes no argument {name!r}; it takes: {', '.join(names) or 'none'}")
    for p in parameters:
        if p.default is p.empty and p.name in names and p.name not in arguments:
            raise TypeError(f"needs the argument {p.name!r}; give it as args in services.toml or in the task")


def describe(fault: BaseException) -> str:
    """Type and message of an exception and the last three places of the action's own code that it came through."""
    frames = [f for f in traceback.extract_tb(fault.__traceback__) if f.filename not in _OURS][-3:]
    places = " < ".join(f"{f.name} ({Path(f.filename).name}:{f.lineno})" for f in reversed(frames))
    return f"{type(fault).__name__}: {fault}" + (f" in {places}" if places else "")
