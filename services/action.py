"""How a primitive action is written: status, result, and the context through which alone it touches
the world.

An action is a callable named by import path (`module:function`). Its first parameter is the
context, all others are keyword parameters of plain data. `def` actions compute and return; `async
def` actions may also wait, but only through their context, so the same code runs in a warm worker
process on the wall clock and inline in a lock-step cell.

    async def locate(ctx: Context, *, timeout: float = 5.0) -> Result:
        image = await ctx.device.read(timeout)
        if image is None:
            return error("no_image", "the camera sent nothing")
        return success(point=[1.0, 0.2, 0.6])
"""

from __future__ import annotations

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
    """The specification was not fully met, but the task may go on along its normal branch."""
    ERROR = "error"
    """The specification was not met and error recovery is required."""


@dataclass(frozen=True, slots=True)
class Result:
    """What an action returns: its status, what it writes, and why when it is not SUCCESS.

    `values` are plain data; the task file's `out` says which of them go to which variable. `cause`
    is a short code that programs compare (`"ball_lost"`), `text` is for people.
    """

    status: Status
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    deferred: bool = False
    """The status is provisional: it routes the task now, and a later verdict may correct it once
    for the estimates."""
    executed: str = "yes"
    """Whether the world was touched: "yes", "no" (an ERROR before anything began) or "unknown" (a
    link was lost in between). `dataclasses.replace(result, executed="unknown")` sets it; a place's
    `tries` and the conditions of a task look at it."""


def success(**values: Any) -> Result:
    """The specification was fully met."""
    return Result(Status.SUCCESS, values)


def failure(cause: str, text: str = "", **values: Any) -> Result:
    """The specification was not fully met; the task goes on along its normal branch."""
    return Result(Status.FAILURE, values, cause, text)


def error(cause: str, text: str = "", **values: Any) -> Result:
    """The specification was not met; the task goes on along its error branch."""
    return Result(Status.ERROR, values, cause, text)


def provisional(result: Result) -> Result:
    """The same result, as far as is known yet: it routes the task now, and a later verdict
    (`Context.verdict`, or the task's score) may correct its status once, for the estimates alone.
    If none comes it stands."""
    return replace(result, deferred=True)


class Cancelled(BaseException):
    """Thrown into an action at its current wait when its run is cancelled; clean up and let it
    pass."""


class Wait:
    """What an action's coroutine yields: go on when `ready()` holds or when the clock reaches `due`
    (s; None: never).

    Awaiting it gives True if it was ready, False if its time was over. Who runs the action sends
    that verdict, so that `ready` is asked no more once it held (it may have taken what it found);
    sent None, it is asked again.
    """

    __slots__ = ("due", "ready")

    def __init__(self, ready: Callable[[], bool], due: float | None = None) -> None:
        self.ready = ready
        self.due = due

    def __await__(self) -> Generator[Wait, bool | None, bool]:
        verdict = yield self
        return self.ready() if verdict is None else verdict


class CallFailed(Exception):  # noqa: N818 - what happened, not a class of errors
    """A service that the action depends on answered ERROR; `result` says how."""

    def __init__(self, service: str, result: Result) -> None:
        super().__init__(f"{service}: {result.status} {result.cause} {result.text}".rstrip())
        self.result = result


class CommandRefused(Exception):  # noqa: N818 - as above
    """The driver refused a command, or did not take it in time; the text says why. An action that
    does not catch it ends in ERROR, cause `command_refused`."""


class Context(Protocol[Device]):
    """What a run may use besides its arguments. Times are seconds on the cell's clock; durations
    cross the wire, times never.

    `Context[Scanner]` says which driver `ctx.device` is, for editors and type checkers;
    `Context[Remote]` is that of a cyclic driver.
    """

    @property
    def now(self) -> float:
        """The cell's clock: simulated time in lock step, monotonic time otherwise (s). It stands
        still while the operator holds the run, so what is left of a timeout stays left."""

    @property
    def run(self) -> str:
        """This run's id."""

    @property
    def device(self) -> Device:
        """The handle of the action's device: its driver, or a `Remote` of it when the driver is
        cyclic; None without a device."""

    async def command(self, body: Mapping[str, Any], timeout: float = 1.0) -> None:
        """Send a command to the device's driver, and wait until the driver has taken it.

        Raises CommandRefused if the driver refuses it (its words), or if it has not taken it after
        `timeout` seconds.
        """

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> Wait:
        """Awaitable: True as soon as `ready()` holds, False after `timeout` seconds."""

    def sleep(self, seconds: float) -> Wait:
        """Awaitable: goes on after so many seconds of the cell's clock."""

    def publish(self, stream: str, values: Sequence[float]) -> None:
        """Send newest set point to a stream; whoever receives it sees only the newest. Repeated by
        the sender while the run goes on and stands by it."""

    def withdraw(self, stream: str) -> None:
        """Stop standing by the last set point of a stream; its receiver holds after three
        periods."""

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise a named internal event while the run goes on."""

    def verdict(self, run: str, status: Status, cause: str = "", text: str = "") -> None:
        """Judge an earlier run whose result was `provisional`: its status is corrected once, for
        the estimates alone. `run` is what that run's own context gave as `ctx.run`; on whichever
        node either of them lives."""

    def progress(self, fraction: float, **data: Any) -> None:
        """Tell the coordinator how far the run is, 0 to 1, with plain data for people to look
        at."""

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
