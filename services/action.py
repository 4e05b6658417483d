"""How to write a primitive action: its status, its result, and its context.

An action is a callable named by import path (`module:function`). Its first parameter is the
context; all others are keyword parameters of plain data. `def` actions compute and return. `async
def` actions may also wait, but only through their context, so the same code runs in a worker
process in real time and inline in a lock-step cell.

    async def locate(ctx: Context, *, timeout: float = 5.0) -> Result:
        image = await ctx.device.read(timeout)
        if image is None:
            return error("no_image", "the camera sent nothing")
        return success(point=[1.0, 0.2, 0.6])
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from typing_extensions import TypeVar

    Device = TypeVar("Device", covariant=True, default=Any)
else:
    from typing import TypeVar

    Device = TypeVar("Device", covariant=True)

Plain = None | bool | int | float | str | bytes | Sequence["Plain"] | Mapping[str, "Plain"]


class Status(StrEnum):
    """How a run ended (paper, section 4)."""

    SUCCESS = "success"
    """The specification was fully met."""
    FAILURE = "failure"
    """The specification was not fully met, but the task may continue on its normal branch."""
    ERROR = "error"
    """The specification was not met and error recovery is required."""


@dataclass(frozen=True, slots=True)
class Result:
    """What an action returns: its status, its values, and the reason if it is not SUCCESS.

    `values` are plain data; the task file's `out` says which of them go to which variable. `cause`
    is a short code that programs compare (`"ball_lost"`), `text` is for people: the page and
    `petrobot log` show it beside the run, also of a SUCCESS.
    """

    status: Status
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    deferred: bool = False
    """Whether the status is provisional: the task uses it now, and a later verdict may correct it
    once for the estimates."""
    executed: str = "yes"
    """Whether the action has acted on the world: "yes", "no" (an ERROR before anything began) or
    "unknown" (a link was lost meanwhile). Set it by `dataclasses.replace(result,
    executed="unknown")`; the `tries` of a place and conditions of a task depend on it."""


def success(text: str = "", /, **values: Any) -> Result:
    """Return SUCCESS: the specification was fully met."""
    if not issubclass(type(text), str):  # a value without its name
        raise TypeError(f"success: expected a text, found {text!r:.60}; write success(name=value)")
    return Result(Status.SUCCESS, values, text=text)


def failure(cause: str, text: str = "", **values: Any) -> Result:
    """Return FAILURE: the specification was not fully met; the task continues on its normal
    branch."""
    return Result(Status.FAILURE, values, cause, text)


def error(cause: str, text: str = "", **values: Any) -> Result:
    """Return ERROR: the specification was not met; the task continues on its error branch."""
    return Result(Status.ERROR, values, cause, text)


def provisional(result: Result) -> Result:
    """Return the result as a provisional one: the task uses it now, and a later verdict
    (`Context.verdict`, or the task's score) may correct its status once, for the estimates only.
    Without a verdict it stays as it is."""
    return replace(result, deferred=True)


class Cancelled(BaseException):
    """Raised in an action at its current wait when its run is cancelled. Clean up, and do not
    suppress it."""


class Wait:
    """What an action's coroutine yields: continue when `ready()` is true or when the clock reaches
    `due` (s; None: never).

    Awaiting it returns True if it was ready, False if its time was over. The runner sends that
    answer, so that `ready` is not called again after it was true (it may have consumed what it
    found). If the runner sends None, `ready` is called again.
    """

    __slots__ = ("awaited", "due", "ready")

    def __init__(self, ready: Callable[[], bool], due: float | None = None) -> None:
        self.ready = ready
        self.due = due
        self.awaited = False

    def __await__(self) -> Generator[Wait, bool | None, bool]:
        self.awaited = True
        verdict = yield self
        return self.ready() if verdict is None else verdict

    def __del__(self) -> None:
        """Warn of a wait that was dropped, as Python does of a coroutine."""
        if not self.awaited:
            text = "coroutine 'wait' or 'sleep' of the context was never awaited"
            warnings.warn(text, RuntimeWarning, stacklevel=2)


class CallFailed(Exception):  # noqa: N818 - what happened, not a class of errors
    """A service that the action needs answered ERROR; `result` is its answer."""

    def __init__(self, service: str, result: Result) -> None:
        super().__init__(service, result)
        self.service = service
        self.result = result

    def __str__(self) -> str:
        result = self.result
        return f"{self.service}: {result.status} {result.cause} {result.text}".rstrip()


class CommandRefused(Exception):  # noqa: N818 - as above
    """The driver refused a command, or did not handle it in time; the text says why. An action that
    does not catch this ends in ERROR, cause `command_refused`."""


class Context(Protocol[Device]):
    """What a run may use beside its arguments. Times are seconds on the cell's clock, which
    differs from host to host: send durations, never times.

    `Context[Scanner]` tells editors and type checkers the class of `ctx.device`; for a cyclic
    driver write `Context[Remote]`.
    """

    @property
    def now(self) -> float:
        """The cell's clock: simulated time in lock step, otherwise monotonic time (s). It stands
        still while the operator holds the run, so a pause uses up no timeout."""

    @property
    def run(self) -> str:
        """This run's id."""

    @property
    def device(self) -> Device:
        """The action's device: its driver, or a `Remote` of it if the driver is cyclic; None
        without a device."""

    async def command(
        self, body: Mapping[str, Any], timeout: float = 1.0, *, until: str = ""
    ) -> Mapping[str, Any]:
        """Send a command to the device's driver, and wait until the driver has accepted it; with
        `until`, also until `device.state[until]` is true. Return the state then.

        Raises CommandRefused with the driver's reason if it refuses, or if it has not handled the
        command after `timeout` seconds. Only the deadline of the run limits the wait for `until`.
        """

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> Wait:
        """Awaitable: True as soon as `ready()` is true, False after `timeout` seconds."""

    def sleep(self, seconds: float) -> Wait:
        """Awaitable: returns after this number of seconds of the cell's clock."""

    def publish(self, stream: str, values: Sequence[float]) -> None:
        """Send a set point to a stream. The receiver sees only the newest one. It is sent
        repeatedly until the run ends or withdraws it."""

    def withdraw(self, stream: str) -> None:
        """Stop sending the last set point of a stream; its receiver holds after three periods."""

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise a named internal event during the run."""

    def verdict(self, run: str, result: Result) -> None:
        """Give the verdict on an earlier run whose result was `provisional`: its status is
        corrected once, for the estimates only. `run` is the `ctx.run` of that run, on any node; of
        `result`, status, cause and text count."""

    def progress(self, fraction: float, **data: Any) -> None:
        """Report the progress of the run, 0 to 1, with plain data for people."""

    async def call(
        self, service: str, /, deadline: float | None = None, **arguments: Any
    ) -> Result:
        """Call any network service by its name, wherever it is; return its result, whatever its
        status. Raises ValueError or TypeError for arguments that cannot be sent."""

    async def get(self, name: str, default: Any = None) -> Any:
        """Read a global-memory variable; `default` if it was never written. Raises CallFailed if
        the memory cannot be reached."""

    async def get_versioned(self, name: str, default: Any = None) -> tuple[Any, int]:
        """Read a global-memory variable with its version, for `compare_and_set`; (`default`, 0) if
        it was never written. Raises CallFailed as `get`."""

    async def put(self, name: str, value: Any) -> int:
        """Write a global-memory variable; return its new version. Raises CallFailed if the memory
        cannot be reached or is full, or the value too large."""

    async def compare_and_set(self, name: str, version: int, value: Any) -> bool:
        """Write a global-memory variable if its version is still the given one (0: never written);
        return whether it was written. Raises CallFailed as `put`."""

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator of (seed, run, purpose): the same draws on every host."""
