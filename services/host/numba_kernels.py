"""The numba extra for small kernels of numbers: compiled where numba is installed, run as they
stand where it is not.

A kernel takes and gives floats and tuples of floats, and gives the same bits either way: no fast
mathematics, so sums keep their order, and functions whose last place differs from library to
library (hypot, powers) do not occur in kernels. Compiled code is kept on disk beside the source or
in the user's cache; where neither can be written kernels are not compiled, since that would have to
be done anew in every process. `PETROBOT_COMPILED=0` in the environment leaves numba out.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

SWITCH = "PETROBOT_COMPILED"
"""Environment variable: 0 leaves numba out."""

try:
    if os.environ.get(SWITCH) == "0":
        raise ImportError(f"{SWITCH}=0")
    import numba

    COMPILED = True
except ImportError:
    COMPILED = False


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled, when it is first called with arguments of these types; or itself."""
    if not COMPILED:
        return function
    try:
        compiled: Callable[P, R] = numba.njit(cache=True)(function)
    except RuntimeError:  # there is nowhere to keep what is compiled
        return function
    return compiled


def packed(function: Callable[..., Any], numbers: Iterable[float]) -> Sequence[float]:
    """Numbers that a kernel reads by place and that seldom change, as its callers best hand them
    over: an array to a compiled one, which takes it as it is (many floats of a tuple are each taken
    apart), else a tuple of floats."""
    if hasattr(function, "py_func"):
        array: Any = np.array(list(numbers), dtype=np.float64)
        return array  # type: ignore[no-any-return]
    return tuple(map(float, numbers))


def plain(function: Callable[P, R]) -> Callable[P, R]:
    """What a kernel is compiled from, to compare the two."""
    source: Callable[P, R] = getattr(function, "py_func", function)
    return source
