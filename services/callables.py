"""Actions as Python callables: arguments checked against their signature, what they raise described in one line."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

_OURS = {
    str(Path(__file__).with_name(name))
    for name in ("runner.py", "execution.py", "context.py", "outlets.py", "callables.py")
}


@lru_cache(maxsize=4096)
def _parameters(function: Callable[..., Any]) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Names of a callable's parameters after the context, those without default, and whether it takes any name."""
    parameters = list(inspect.signature(function).parameters.values())[1:]
    named = [p for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    needed = tuple(p.name for p in named if p.default is p.empty)
    return tuple(sorted(p.name for p in named)), needed, any(p.kind is p.VAR_KEYWORD for p in parameters)


def check_arguments(function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Raise TypeError that names the argument which does not fit and what would; the first parameter is the context."""
    names, needed, takes_any = _parameters(function)
    for name in arguments:
        if name not in names and not takes_any:
            raise TypeError(f"takes no argument {name!r}; it takes: {', '.join(names) or 'none'}")
    for name in needed:
        if name not in arguments:
            raise TypeError(f"needs the argument {name!r}; give it as args in services.toml or in the task")


def describe(fault: BaseException) -> str:
    """Type and message of an exception and the last three places of the action's own code that it came through."""
    frames = [f for f in traceback.extract_tb(fault.__traceback__) if f.filename not in _OURS][-3:]
    places = " < ".join(f"{f.name} ({Path(f.filename).name}:{f.lineno})" for f in reversed(frames))
    return f"{type(fault).__name__}: {fault}" + (f" in {places}" if places else "")
