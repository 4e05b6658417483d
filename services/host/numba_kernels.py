"""Optional compilation of small numeric functions (kernels) with numba; without numba they run as
plain Python.

A kernel takes and returns floats and tuples of floats, and gives the same bits either way:
fast-math is off, so sums keep their order, and functions whose last digit differs between libraries
(hypot, powers) are not used in kernels. Compiled code is cached on disk beside the source or in the
user's cache. If neither can be written, kernels are not compiled, because every process would have
to compile them again. `PETROBOT_COMPILED=0` in the environment turns numba off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

SWITCH = "PETROBOT_COMPILED"
"""Environment variable: 0 turns numba off."""

try:
    if os.environ.get(SWITCH) == "0":
        raise ImportError(f"{SWITCH}=0")
    import numba

    COMPILED = True
except ImportError:
    COMPILED = False


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function compiled (at its first call, for its argument types), or the function
    itself without numba."""
    if not COMPILED:
        return function
    try:
        compiled: Callable[P, R] = numba.njit(cache=True)(function)
    except RuntimeError:  # no cache folder can be written
        return function
    return compiled


def packed(function: Callable[..., Any], numbers: Iterable[float]) -> Sequence[float]:
    """Return numbers in the form that a kernel reads fastest: a numpy array if compiled, else a
    tuple of floats.

    For numbers that seldom change and are read by index. A compiled function unpacks every element
    of a tuple at each call, but takes an array as it is.
    """
    if hasattr(function, "py_func"):
        array: Any = np.array(list(numbers), dtype=np.float64)
        return array  # type: ignore[no-any-return]
    return tuple(map(float, numbers))


def plain(function: Callable[P, R]) -> Callable[P, R]:
    """Return the Python function of a kernel, to compare the two."""
    source: Callable[P, R] = getattr(function, "py_func", function)
    return source
