"""A cyclic driver and the actions that use it: both ends of the exchange of commands and states, as
sans-I/O machines, inline and across processes."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from msgspec import Struct, field

from petrobot.services.comm.protocol.messages import EMERGENCY_STOP as EMERGENCY_STOP, SEED
from petrobot.services.comm.protocol.plain import NotPlainError, plain
from petrobot.services.device import Driver, stop_at_once
from petrobot.services.worker.callables import RAISED, describe, log_fault, words_of

_log = logging.getLogger(__name__)

COMMAND, STOP = "command", "stop"
CLEAR_EMERGENCY = "clear_emergency"
"""Verb of the operator: accept commands again after `EMERGENCY_STOP` (which moves nothing by
itself)."""
IN_EMERGENCY = "emergency stop: clear it with `petrobot estop --clear` when the cell is safe"
NODE_SILENT = "node_silent"
NODE_IS_SILENT = (
    "the device's node was silent, so the device was stopped: look why the node stood still"
)
BARRED: Mapping[str, str] = {EMERGENCY_STOP: IN_EMERGENCY, NODE_SILENT: NODE_IS_SILENT}
"""By cause of the end of its runs: why a device accepts no commands, in words."""


class DeviceError(Exception):
    """A driver raised an exception, the cause of this one; the text says which and where. Its
    device was stopped if that was possible."""


class DeviceCommand(Struct, frozen=True):
    """A command of an action, or the stop routine."""

    number: int
    """Counts up from 1."""
    verb: str = COMMAND
    body: Mapping[str, Any] = field(default_factory=dict)


class DeviceState(Struct):
    """What the driver's end publishes at each cycle; only the newest one counts."""

    handled: int = 0
    refused: str = ""
    """Why the last command was refused; empty if it was not."""
    stopped: bool = False
    state: Mapping[str, Any] = field(default_factory=dict)
    refusal: tuple[int, str] = (0, "")
    """Number of the last command that was refused (0: none); the reason is kept beside it, so that
    a later command does not hide it."""
    barred: str = ""
    """Cause for which the device was stopped and accepts no commands (a key of `BARRED`); empty if
    it accepts them."""
    last_bar: tuple[int, str] = (0, "")
    """How often that has happened since its actions' end was linked, and the last cause: an end
    that was not scheduled may read no state of the time in which it was barred."""


@runtime_checkable
class Refusing(Protocol):
    """A device whose driver may refuse commands after they were sent."""

    @property
    def sent(self) -> int:
        """Number of the last command sent."""

    @property
    def age(self) -> float:
        """Seconds since the driver last published its state."""

    def refusal(self, since: int) -> str | None:
        """Return why a command after number `since` was refused whose refusal no action has read;
        empty if there is none, None while the driver still has commands to handle."""


class RemoteDriver:
    """The actions' end: implements `services.device.Remote` for them and
    `services.worker.runner.DeviceControl` for the runner.

    `post` sends a command; `take` receives each newer state. If the driver is in the same process,
    `expect` receives a function instead, so that a state is only made when it is read.
    """

    def __init__(self, post: Callable[[DeviceCommand], None], clock: Callable[[], float]) -> None:
        self._post = post
        self._clock = clock
        self._sent = 0
        self._seed: int | None = None
        self._seen = 0
        """Number of the last refused command whose refusal an action has read."""
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
        """Send a command, and return its number. Raises ConnectionError if the driver's process has
        ended."""
        return self._number(COMMAND, plain(body, "command"))

    @property
    def handled(self) -> int:
        """Number of the last command that the driver has handled."""
        return self._newest.handled

    @property
    def refused(self) -> str:
        """Why the last command was refused; empty if it was not. An action that reads the words
        decides what they mean; a refusal that it never reads ends its run in ERROR."""
        newest = self._newest
        if newest.refused:
            self._seen = newest.refusal[0]
        return newest.refused

    @property
    def sent(self) -> int:
        """Number of the last command sent."""
        return self._sent

    def refusal(self, since: int) -> str | None:
        """Implements `Refusing`."""
        newest = self._newest
        number, why = newest.refusal
        if number > max(since, self._seen):
            return why
        return "" if newest.handled >= self._sent else None

    @property
    def barred(self) -> str:
        """Cause for which the device accepts no commands, empty if it accepts them."""
        return self._newest.barred

    @property
    def last_bar(self) -> tuple[int, str]:
        """How often the device was stopped for such a cause, and the last one."""
        number, cause = self._newest.last_bar
        return number, cause

    @property
    def state(self) -> Mapping[str, Any]:
        """The driver's newest published state."""
        return self._newest.state

    @property
    def age(self) -> float:
        """Seconds since that state was published (inf before the first)."""
        return self._clock() - self._arrived

    def reseed(self, seed: int) -> None:
        """Tell the driver the seed of the mission run whose action begins."""
        if seed != self._seed:
            # A driver that accepts nothing now gets it with the next action.
            with contextlib.suppress(ConnectionError):
                self._post(DeviceCommand(self._sent, SEED, {"seed": seed}))
                self._seed = seed

    def stop(self, now: float) -> None:
        """Call the driver's stop routine."""
        self._number(STOP, {})

    def stopped(self) -> bool:
        """Return whether the device stands still after all that was sent to it."""
        return self._newest.handled >= self._sent and self._newest.stopped

    def take(self, state: DeviceState) -> None:
        """Accept a newer state."""
        self._taken, self._source, self._arrived = state, None, self._clock()

    def expect(self, source: Callable[[], DeviceState]) -> None:
        """Note that there is a newer state; `source` returns it."""
        self._source, self._arrived = source, self._clock()

    def _number(self, verb: str, body: Mapping[str, Any]) -> int:
        self._sent += 1
        self._post(DeviceCommand(self._sent, verb, body))
        return self._sent


class CyclicDriver:
    """The driver's end: passes it the commands in order, steps it, and publishes its state."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.refused = 0
        """Number of refused commands."""
        self._handled = 0
        self._refusal = (0, "")
        self._emergency = self._silent = False
        self._last_bar = (0, "")

    def emergency_stop(self, now: float) -> None:
        """Stop at once, and refuse every command until `clear_emergency`."""
        if not self._emergency:
            self._last_bar = (self._last_bar[0] + 1, EMERGENCY_STOP)
        self._emergency = True
        stop_at_once(self.driver, now)

    def clear_emergency(self) -> None:
        """Accept commands again; nothing moves until one arrives."""
        self._emergency = False

    def node_silent(self, now: float) -> None:
        """Stop, and refuse every command until `node_speaks`: with a silent node, nothing could
        stop the device."""
        if not self._silent:
            self._last_bar = (self._last_bar[0] + 1, NODE_SILENT)
        self._silent = True
        self.driver.stop(now)

    def node_speaks(self) -> None:
        """Accept commands again."""
        self._silent = False

    @property
    def barred(self) -> str:
        """Cause for which it refuses all commands; empty if it accepts them."""
        return EMERGENCY_STOP if self._emergency else NODE_SILENT if self._silent else ""

    def take(self, now: float, command: DeviceCommand) -> None:
        """Carry out a command; a refusal is published with the next state."""
        self._handled = command.number
        if command.verb == STOP:
            self.driver.stop(now)
            return
        if self.barred:
            self._refuse(command, BARRED[self.barred])
            return
        try:
            self.driver.command(now, command.body)
        except ValueError as fault:
            self._refuse(command, words_of(fault) or type(fault).__name__)
        except RAISED as fault:
            log_fault(_log, fault, "a driver failed on the command %.200r", command.body)
            self._refuse(command, describe(fault))

    def _refuse(self, command: DeviceCommand, why: str) -> None:
        if why != self._refusal[1]:  # an action that repeats its command must not fill the log
            _log.warning("command %.200r refused: %s", command.body, why)
        self.refused += 1
        self._refusal = (command.number, why)

    def step(self, now: float) -> DeviceState:
        """Do one cycle, and return the state after it."""
        self.driver.step(now)
        return self.state()

    def state(self) -> DeviceState:
        """The state to publish: plain data, also for actions in the same process. Raises
        NotPlainError with the line of the driver's `state`."""
        number, why = self._refusal
        refused = why if number == self._handled else ""
        # A driver that computes with numpy answers with a numpy bool, which no message carries.
        stopped = bool(self.driver.stopped())
        try:
            state = plain(self.driver.state(), "state")
            if not isinstance(state, dict):
                text = f"state: expected a dict, found a {type(state).__name__}"
                raise NotPlainError(text)
        except NotPlainError as fault:
            code = getattr(self.driver.state, "__code__", None)
            if code is None:
                raise
            place = f"{Path(code.co_filename).name}:{code.co_firstlineno}"
            raise NotPlainError(f"{fault}, returned by `state` ({place})") from None
        bars = (self.barred, self._last_bar)
        return DeviceState(self._handled, refused, stopped, state, self._refusal, *bars)

    def forget(self) -> None:
        """Start again with the numbers of a new actions' end."""
        self._handled, self._refusal, self._last_bar = 0, (0, ""), (0, "")


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
