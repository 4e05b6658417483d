"""The deadline and the memory of a whole analysis, which every part of it can ask.

Searches of state spaces may have limits of their own (`SearchLimits`). What follows them
(invariants, siphons, coverability trees, linear systems) may take exponentially long as well. These
parts ask `overtime()` in their loops and then stop as if their effort were used up, so the result
says "unknown" instead of coming late.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_OVERTIME: ContextVar[Callable[[], bool]] = ContextVar("overtime", default=lambda: False)
_MEMORY: ContextVar[int | None] = ContextVar("memory", default=None)


OUT_OF_MEMORY = (MemoryError, SystemError)
"""What Python raises when the memory is used up. Where none is left to unwind the frames of a
MemoryError, CPython loses it and raises SystemError instead ("error return without exception
set")."""


class OutOfTime(ArithmeticError):  # noqa: N818 - a fact about a computation
    """The time limit of the analysis passed before a number was known."""


def overtime() -> bool:
    """Return whether the time limit of this analysis has passed; False if it has none."""
    return _OVERTIME.get()()


def memory_limit() -> int | None:
    """Return how many bytes this analysis may hold; None if it has no limit."""
    return _MEMORY.get()


def keep_time(what: str) -> None:
    """Raise OutOfTime if the time limit has passed; `what` names what stays unknown."""
    if overtime():
        raise OutOfTime(f"{what}: unknown within the time limit")


@contextmanager
def until(
    due: float | None, clock: Callable[[], float] | None, memory: int | None = None
) -> Iterator[None]:
    """Give everything inside a deadline, `due` on this clock (s), None for none; and a limit of
    memory (bytes), None for the one outside."""
    if due is None or clock is None:
        yield
        return
    token = _OVERTIME.set(lambda: clock() > due)
    held = _MEMORY.set(_MEMORY.get() if memory is None else memory)
    try:
        yield
    finally:
        _MEMORY.reset(held)
        _OVERTIME.reset(token)
