"""The numba extra: functions marked `jit` are compiled where numba is installed and run as they stand where it is not.

Only modules that numba makes worthwhile import this one, so nothing pays for importing numba without asking for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

try:
    import numba

    COMPILED = True
except ImportError:
    COMPILED = False

P = ParamSpec("P")
R = TypeVar("R")


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled (once a machine: the result is cached), or itself without numba."""
    if not COMPILED:
        return function
    compiled: Callable[P, R] = numba.njit(cache=True)(function)
    return compiled
