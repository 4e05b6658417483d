"""A cyclic driver and the actions that use it, one command line apart: both ends as machines, inline and across processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from services.comm.plain import plain
from services.device import Driver, stop_at_once

COMMAND, STOP = "command", "stop"
EMERGENCY_STOP, CLEAR_EMERGENCY = "emergency_stop", "clear_emergency"
"""An operator's verbs: stop at once and obey no action any more; obey actions again (nothing moves by that alone)."""
IN_EMERGENCY = "emergency stop: clear it with `petrobot estop --clear` when the cell is safe"


@dataclass(frozen=True, slots=True)
class DeviceCommand:
    """From the actions' end: a command of an action, or the stop routine."""

    number: int
    """Counts up from 1."""
    verb: str = COMMAND
    body: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DeviceState:
    """From the driver's end, each cycle; only the newest counts."""

    handled: int = 0
    refused: str = ""
    """Why the last command was refused; empty if it was not."""
    stopped: bool = False
    state: Mapping[str, Any] = field(default_factory=dict)


class RemoteDriver:
    """The actions' end: implements `services.device.Remote` for them and `services.runner.DeviceControl` for the runner.

    `post` sends a command; `take` is given each newer state. Where the driver lives in the same process, `expect` is told
    instead where to get it: nothing is put together that nobody looks at.
    """

    def __init__(self, post: Callable[[DeviceCommand], None], clock: Callable[[], float]) -> None:
        self._post = post
        self._clock = clock
        self._sent = 0
        self._taken = DeviceState()
        self._source: Callable[[], DeviceState] | None = None
        self._arrived = -float("inf")

    @property
    def _newest(self) -> DeviceState:
        if self._source is not None:
            self._taken, self._source = self._source(), None
        return self._taken

    @property
    def handle(self) -> RemoteDriver:
        """What actions see as `ctx.device`."""
        return self

    def send(self, body: Mapping[str, Any]) -> int:
        """Send a command; gives its number. Raises ConnectionError when the driver's process is gone."""
        return self._number(COMMAND, plain(body, "command"))

    @property
    def handled(self) -> int:
        """Number of the last command that the driver has taken."""
        return self._newest.handled

    @property
    def refused(self) -> str:
        """Why the last command was refused; empty if it was not."""
        return self._newest.refused

    @property
    def state(self) -> Mapping[str, Any]:
        """The driver's newest published state."""
        return self._newest.state

    @property
    def age(self) -> float:
        """Seconds since that state was published (inf before the first)."""
        return self._clock() - self._arrived

    def stop(self, now: float) -> None:
        """Call the driver's stop routine."""
        self._number(STOP, {})

    def stopped(self) -> bool:
        """Whether the device stands still after all that was sent to it."""
        return self._newest.handled >= self._sent and self._newest.stopped

    def take(self, state: DeviceState) -> None:
        """A newer state came in."""
        self._taken, self._source, self._arrived = state, None, self._clock()

    def expect(self, source: Callable[[], DeviceState]) -> None:
        """A newer state is there; `source` gives it when it is wanted."""
        self._source, self._arrived = source, self._clock()

    def _number(self, verb: str, body: Mapping[str, Any]) -> int:
        self._sent += 1
        self._post(DeviceCommand(self._sent, verb, body))
        return self._sent


class CyclicDriver:
    """The driver's end: gives it the commands in order, steps it, and tells its state."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._handled = 0
        self._refused = ""
        self._emergency = False

    def emergency_stop(self, now: float) -> None:
        """Stop at once, and refuse every command until `clear_emergency`."""
        self._emergency = True
        stop_at_once(self.driver, now)

    def clear_emergency(self) -> None:
        """Take commands again; the device stays as it is until one comes."""
        self._emergency = False

    def take(self, now: float, command: DeviceCommand) -> None:
        """Carry out a command; what the driver refuses is told in the next state."""
        self._handled = command.number
        if command.verb == STOP:
            self.driver.stop(now)
            return
        if self._emergency:
            self._refused = IN_EMERGENCY
            return
        try:
            self.driver.command(now, command.body)
            self._refused = ""
        except (ValueError, KeyError, TypeError) as fault:
            self._refused = str(fault) or type(fault).__name__

    def step(self, now: float) -> DeviceState:
        """One cycle, and the state after it."""
        self.driver.step(now)
        return self.state()

    def state(self) -> DeviceState:
        """The state to publish."""
        return DeviceState(self._handled, self._refused, self.driver.stopped(), self.driver.state())

    def forget(self) -> None:
        """The actions' end is another one now: its numbers begin anew."""
        self._handled, self._refused = 0, ""


class DirectDevice:
    """A driver without period as the runner guards it: actions use the driver itself."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    @property
    def handle(self) -> Driver:
        """What actions see as `ctx.device`."""
        return self._driver

    def stop(self, now: float) -> None:
        """Call the stop routine."""
        self._driver.stop(now)

    def stopped(self) -> bool:
        """Whether it is known to stand still."""
        return self._driver.stopped()
