"""Waiting in tests: for conditions, never for a guess at how long something takes, and never
without a limit."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

PATIENCE_S = 60.0
"""How long a wait may last unless it says otherwise (s): more than a busy machine needs, less than
a test may last."""


class Limit:
    """The limit of one wait: `while not condition and limit.left(): ...` ends, or fails and says
    what was awaited.

    The limit is `seconds` of the wall clock. In simulated time it is a number of `steps`, which no
    busy machine uses up.
    """

    def __init__(
        self, awaited: str, seconds: float = PATIENCE_S, *, steps: int | None = None
    ) -> None:
        self._awaited = awaited
        self._given = f"{seconds:g} s" if steps is None else f"{steps} steps"
        self._end = time.monotonic() + seconds
        self._steps = steps

    def left(self) -> bool:
        """True while the limit lasts; counts one step. Raises AssertionError when it is used up."""
        if self._steps is None:
            assert time.monotonic() < self._end, f"waited {self._given} in vain for {self._awaited}"
        else:
            assert self._steps > 0, f"waited {self._given} in vain for {self._awaited}"
            self._steps -= 1
        return True


async def beat(seconds: float = 0.005) -> None:
    """Let the loop go on for so long: between two looks at a condition, or as a storm draws it."""
    over = asyncio.Event()
    asyncio.get_running_loop().call_later(seconds, over.set)
    await over.wait()


async def until(
    condition: Callable[[], object], awaited: str = "a condition", seconds: float = PATIENCE_S
) -> None:
    """Wait in the event loop until the condition is true. Raises AssertionError, as `Limit`
    does."""
    limit = Limit(awaited, seconds)
    while not condition() and limit.left():
        await beat()


def wait_for(
    condition: Callable[[], T | None], *steps: Callable[[], object], awaited: str = "a condition"
) -> T:
    """Call the steps until the condition is true, without an event loop; return what it is then.
    Raises AssertionError, as `Limit` does."""
    limit, pause = Limit(awaited), threading.Event()
    while not (found := condition()) and limit.left():
        for step in steps:
            step()
        pause.wait(0.002)
    assert found
    return found
