"""The deadline of a whole analysis, which every part of it can ask.

Searches of state spaces have limits of their own (`SearchLimits`). What follows them (invariants,
siphons, coverability trees, linear systems) may take exponentially long as well. These parts ask
`overtime()` in their loops and then stop as if their effort were used up, so the result says
"unknown" instead of coming late.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_OVERTIME: ContextVar[Callable[[], bool]] = ContextVar("overtime", default=lambda: False)


OUT_OF_MEMORY = (MemoryError, SystemError)
"""What Python raises when the memory is used up. Where none is left to unwind the frames of a
MemoryError, CPython loses it and raises SystemError instead ("error return without exception
set")."""


class OutOfTime(ArithmeticError):  # noqa: N818 - a fact about a computation
    """The time limit of the analysis passed before a number was known."""


def overtime() -> bool:
    """Return whether the time limit of this analysis has passed; False if it has none."""
    return _OVERTIME.get()()


def keep_time(what: str) -> None:
    """Raise OutOfTime if the time limit has passed; `what` names what stays unknown."""
    if overtime():
        raise OutOfTime(f"{what}: unknown within the time limit")


@contextmanager
def until(due: float | None, clock: Callable[[], float] | None) -> Iterator[None]:
    """Give everything inside a deadline: `due` on this clock (s), None for none."""
    if due is None or clock is None:
        yield
        return
    token = _OVERTIME.set(lambda: clock() > due)
    try:
        yield
    finally:
        _OVERTIME.reset(token)
