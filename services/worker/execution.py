"""One run of an action: its coroutine, the phase that it is in, and the CPU time that it took."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from typing import Any

from petrobot.services.action import Result, Wait
from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.worker.callables import describe, from_outside
from petrobot.services.worker.context import RunContext, never
from petrobot.services.worker.runs import Begin

STEPS = 10_000
"""How often a coroutine may go on without time passing before it is taken for an endless loop."""


class Phase(Enum):
    """Where a run is between its begin and its end."""

    NEW = auto()
    RUNNING = auto()
    COMPUTED = auto()
    """Its result waits for the declared computing time."""
    TAKING = auto()
    """Its result waits until the driver has taken all commands: one of them may be refused."""
    STOPPING = auto()
    """Its coroutine cleans up after a cancel."""
    SETTLING = auto()
    """Its coroutine is over; its device must come to a standstill."""


class Hung(BaseException):
    """Raised by the watchdog of lock step into code that has not come back for too long."""

    def __str__(self) -> str:
        return (
            "did not come back in time; an action waits with ctx.wait or ctx.sleep, and "
            "loops that do not end are faults"
        )


class Returned(Exception):  # noqa: N818 - not an error
    """The action is over; `value` is what it returned."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


@dataclass(eq=False)
class Execution:
    """State of one run; times in seconds on the cell's clock."""

    begin: Begin
    entry: ActionEntry
    phase: Phase = Phase.NEW
    context: RunContext | None = None
    coroutine: Coroutine[Wait, bool | None, Any] | None = None
    wait: Wait | None = None
    started: float = 0.0
    limit: float | None = None
    """When the phase is over at the latest."""
    ready_at: float = 0.0
    """When its computed result is out, or is given up because the driver takes no commands."""
    sent_before: int = 0
    """Number of the last command that its device was sent before it began."""
    cpu: float = 0.0
    result: Result | None = None
    cause: str = ""
    text: str = ""
    abandoned: bool = False
    """The action could not bring its device to a safe state itself: standing still is not
    enough."""
    stop_called: bool = False

    @property
    def over(self) -> bool:
        """Whether the action's own code has nothing more to do."""
        return self.coroutine is None

    @property
    def polls(self) -> bool:
        """Whether it waits for more than time."""
        waits = self.wait is not None and self.wait.ready is not never
        return waits or self.phase in (Phase.SETTLING, Phase.TAKING)

    def due(self) -> float | None:
        """When it is worth a look without anything coming in (s)."""
        if self.phase is Phase.NEW:
            return -math.inf
        times = [self.limit, self.wait.due if self.wait else None]
        if self.phase in (Phase.COMPUTED, Phase.TAKING):
            times.append(self.ready_at)
        return min((t for t in times if t is not None), default=None)

    def call(self, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
        """Call the action up to its first wait. Raises Returned when it is over, else whatever it
        raised."""
        returned = self._timed(lambda: function(self.context, **arguments))
        if not inspect.iscoroutine(returned):
            raise Returned(returned)
        self.coroutine = returned
        self.go_on(None)

    def look(self, now: float) -> None:
        """Let it go on if what it waits for is there or its time is over. Raises as `call` does."""
        if self.wait is None:
            return
        try:
            ready = self.wait.ready()
        except Exception as fault:
            self.go_on(fault)
            return
        if ready or (self.wait.due is not None and now >= self.wait.due):
            self.go_on(ready)

    def go_on(self, verdict: bool | BaseException | None) -> None:
        """Tell its wait the verdict (or raise it there), and run until it waits for something that
        is not there yet.

        Raises as `call` does.
        """
        for _ in range(STEPS):
            self.wait = self._resume(verdict)
            if not self.wait.ready():
                return
            verdict = True
        raise RuntimeError(f"went on {STEPS} times without time passing")

    def _resume(self, verdict: bool | BaseException | None) -> Wait:
        coroutine = self.coroutine
        assert coroutine is not None
        for _ in range(STEPS):
            try:
                if isinstance(verdict, BaseException):
                    wait: Any = self._timed(partial(coroutine.throw, verdict))
                else:
                    wait = self._timed(partial(coroutine.send, verdict))
            except StopIteration as returned:
                self.coroutine = self.wait = None
                raise Returned(returned.value) from None
            if isinstance(wait, Wait):
                return wait
            verdict = TypeError(
                f"awaits a {type(wait).__name__}; an action awaits only what its context gives it"
            )
        raise RuntimeError("awaits only what its context did not give it")

    def close(self) -> str:
        """End the coroutine for good; what it raised instead of ending, empty if it did not."""
        coroutine, self.coroutine, self.wait = self.coroutine, None, None
        try:
            if coroutine is not None:
                coroutine.close()
        except BaseException as fault:
            if from_outside(fault):
                raise
            return describe(fault)
        return ""

    def note(self, text: str) -> None:
        """Add to the text of its end."""
        self.text = f"{self.text}; {text}" if self.text else text

    def postpone(self, pause: float) -> None:
        """Move all its times by an operator's pause."""
        self.started += pause
        self.ready_at += pause
        self.limit = None if self.limit is None else self.limit + pause
        if self.context is not None:
            self.context.held += pause
        if self.wait is not None and self.wait.due is not None:
            self.wait.due += pause

    def _timed(self, function: Callable[[], Any]) -> Any:
        before = time.process_time()
        try:
            return function()
        finally:
            self.cpu += time.process_time() - before
