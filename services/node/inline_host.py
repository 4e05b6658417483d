"""Hosts of runs: what a node needs of one (`Host`), and the host whose driver and actions run in
this process (`InlineHost`)."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, Protocol

from petrobot.services.action import Status
from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.protocol.messages import (
    SEED,
    Answer,
    Call,
    Cancel,
    Command,
    Executed,
    Outcome,
)
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.device import PICTURE, Driver, picture_of, stop_at_once
from petrobot.services.node.watchdog import UNWATCHED
from petrobot.services.worker.callables import RAISED, describe, log_fault
from petrobot.services.worker.context import Report
from petrobot.services.worker.remote import (
    BARRED,
    CLEAR_EMERGENCY,
    EMERGENCY_STOP,
    CyclicDriver,
    DeviceCommand,
    DeviceError,
    DirectDevice,
    RemoteDriver,
)
from petrobot.services.worker.runner import DeviceControl, Order, Runner, stop_reason

_log = logging.getLogger(__name__)

SLACK = 1e-6  # s: binary fractions of a period must not cost a whole tick


HOLD, RELEASE = Command("", "hold"), Command("", "release")
"""Orders that hold the runs of a process and release them."""


def stopped_by(verb: str) -> str:
    """Return the reason of a CANCEL that follows the command `stop` or `emergency_stop`."""
    return stop_reason("stopped" if verb == "stop" else verb, "by command")


def answer_of(id_: str, word: str, data: Mapping[str, Any]) -> Answer:
    """Return a host's answer to a command: the device's word, and data about it and its runs."""
    return Answer(id_, True, {"answer": word, **data})


class Host(Protocol):
    """Carries out the runs of one device, or of all actions that need none. Orders in, reports out;
    nothing blocks."""

    @property
    def idle(self) -> bool:
        """Whether `advance` does nothing and `reports` is empty until an order or a command
        comes."""

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""

    def command(self, now: float, command: Command) -> None:
        """Carry out an operator's `hold`, `release`, `stop`, `emergency_stop`, `clear_emergency`,
        `status` or `picture`. An Answer with its id follows; `answer` in its data is the device's
        reply."""

    def advance(self, now: float) -> None:
        """Do all that is due."""

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s)."""

    def reports(self) -> list[Report]:
        """What happened since the last call, in order."""

    def close(self, now: float) -> None:
        """Stop everything and let the device go."""


class InlineHost:
    """A host whose actions run in this process: in lock step, in a worker, and for services in the
    node's loop.

    Its device is a `driver` in this process, or one in another process reached by a `remote`, or
    none.
    """

    def __init__(
        self,
        actions: Mapping[str, ActionEntry],
        *,
        clock: Callable[[], float],
        driver: Driver | None = None,
        remote: DeviceControl | None = None,
        streams: Mapping[str, float] | None = None,
        substitutes: Mapping[str, Callable[..., Any]] | None = None,
        virtual: bool = False,
        reseed: Callable[[int], None] | None = None,
        device: str = "",
        watch: AbstractContextManager[None] = UNWATCHED,
    ) -> None:
        """`reseed` is called with the seed of each call, for the random draws of the driver.
        `device` is its name, for messages. `watch` is entered while actions are executed."""
        self._actions = actions
        self._device = f"device {device}: " if device else ""
        self._reseed, self._watch = reseed, watch
        self._driver = driver
        self._cyclic = CyclicDriver(driver) if driver is not None and driver.period else None
        self._remote = RemoteDriver(self._post, clock)
        self._outside = remote if isinstance(remote, RemoteDriver) else None
        self._bars = 0
        """How often the device was stopped and barred, as far as is known here."""
        self.failed = ""
        """Why the driver failed: what it raised, and where. Its runs have ended, and no other
        begins."""
        if self._cyclic is not None:
            self._remote.expect(self._cyclic.state)
        self._commands: list[DeviceCommand] = []
        # In lock step a device without actions waits for the mission's seed before its first step,
        # so that what it draws there differs between missions, too.
        unseeded = virtual and reseed is not None and not actions
        self._next_step: float | None = math.inf if unseeded else None
        self._told: list[Report] = []
        self._runner = Runner(
            actions,
            clock=clock,
            device=remote or self._control(),
            streams=streams,
            substitutes=substitutes,
            virtual=virtual,
            fenced=remote is not None,
        )

    def _control(self) -> DeviceControl | None:
        if self._driver is None:
            return None
        return self._remote if self._cyclic is not None else DirectDevice(self._driver)

    def _post(self, command: DeviceCommand) -> None:
        self._commands.append(command)

    def warm(self) -> None:
        """Import all actions now, so that no call has to wait for that. An import that fails is
        reported when the action is called."""
        for action in self._actions:
            with contextlib.suppress(ImportError):
                self._runner.load(action)

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""
        if self.failed and isinstance(order, Call):
            self._told.append(
                Outcome(order.id, Status.ERROR, {}, "not_ready", self.failed, Executed.NO)
            )
            return
        self._end_barred(now)  # a run that begins now is not ended by a stop that is over
        if self._reseed is not None and isinstance(order, Call):
            self._reseed(order.seed)
        held = self._runner.held and bool(self._runner.runs)
        with self._watch:
            self._runner.take(now, order)
        if held and not self._runner.runs:
            self._carry_out(now, "release")  # what was held was stopped before it began

    def command(self, now: float, command: Command) -> None:
        """Carry out an operator's command at once."""
        if not self.failed:
            try:
                word, data = self._carry_out(now, command.verb, command.data)
                self._told.append(answer_of(command.id, word, data))
                return
            except RAISED as fault:
                self._fail(now, fault)
        self._told.append(answer_of(command.id, "not ready", {"text": self.failed}))

    def bar(self, now: float, cause: str) -> None:
        """Stop the device and its runs without an order of the node, which may be frozen."""
        for run in self._runner.runs:
            self._runner.take(now, Cancel(run, stop_reason(cause, BARRED[cause])))
        try:
            self._stop_driver(now, cause)
        except RAISED as fault:
            self._fail(now, fault)

    def _fail(self, now: float, fault: BaseException) -> None:
        """End the runs of a driver that raised an exception, and try to stop its device. Raises
        DeviceError if it was the driver's first step, and no run waits: its node does not start."""
        self.failed = f"{self._device}its driver failed: {describe(fault)}"
        log_fault(_log, fault, "%s", self.failed)
        driver, self._driver, self._cyclic = self._driver, None, None
        starting = self._next_step is None and not self._runner.runs
        self._told += self._runner.reports()
        self._told += self._runner.give_up_all(now, self.failed)
        if driver is not None:
            with contextlib.suppress(*RAISED):
                stop_at_once(driver, now)
            if driver.period and starting:
                raise DeviceError(self.failed) from fault

    def _carry_out(
        self, now: float, verb: str, data: Mapping[str, Any] | None = None
    ) -> tuple[str, Mapping[str, Any]]:
        driver = self._driver
        if verb == SEED:
            if self._reseed is not None and data:
                self._reseed(data[SEED])
                if self._next_step == math.inf:
                    self._next_step = None
            return "seeded", {}
        if verb == "hold":
            answer = driver.hold(now) if driver else "held"
            if answer != "cannot hold":
                self._runner.take(now, HOLD)
            return answer, {}
        if verb == "release":
            if driver:
                driver.release(now)
            self._runner.take(now, RELEASE)
            return "released", {}
        if verb in ("stop", EMERGENCY_STOP):
            for run in self._runner.runs:
                self.take(now, Cancel(run, stopped_by(verb)))
            self._stop_driver(now, verb)
            return "stopped" if driver is None or driver.stopped() else "stopping", {}
        if verb == CLEAR_EMERGENCY:
            if self._cyclic:
                self._cyclic.clear_emergency()
            return "cleared", {}
        if verb == PICTURE:
            return PICTURE, picture_of(driver)
        found = {"runs": list(self._runner.runs), "fenced": self._runner.fenced}
        found["state"] = plain(driver.state(), "state") if driver else {}
        if self._cyclic:
            found["refused"] = self._cyclic.refused
        return "up", found

    def _stop_driver(self, now: float, verb: str) -> None:
        if self._cyclic is not None and verb == EMERGENCY_STOP:
            self._cyclic.emergency_stop(now)
        elif self._driver is not None and verb == EMERGENCY_STOP:
            stop_at_once(self._driver, now)
        elif self._driver is not None:
            self._driver.stop(now)

    @property
    def runs(self) -> tuple[str, ...]:
        """Ids of the runs that have not ended."""
        return self._runner.runs

    @property
    def polling(self) -> bool:
        """Whether a run waits for more than time, so that `advance` must be called often."""
        return self._runner.polling

    @property
    def idle(self) -> bool:
        """Whether there is neither a run nor a cyclic driver, nor anything to report."""
        return self._cyclic is None and not self._told and self._runner.idle

    def advance(self, now: float) -> None:
        """Advance the runs, then do the cycles of the driver that are due. Raises DeviceError if
        the driver fails at the first one."""
        if self.failed:
            return
        try:
            self._advance(now)
        except (
            RAISED
        ) as fault:  # code of actions is guarded where it is called: it was the driver's
            self._fail(now, fault)

    def _advance(self, now: float) -> None:
        self._end_barred(now)
        held = self._runner.held and bool(self._runner.runs)
        with self._watch:
            self._runner.advance(now)
        if held and not self._runner.runs:
            self._carry_out(now, "release")  # what was held is over
        if self._cyclic is None or self._driver is None or not self._driver.period:
            return
        due = now if self._next_step is None else self._next_step
        while due <= now + SLACK:
            commands, self._commands = self._commands, []
            for command in commands:
                self._cyclic.take(now, command)
            self._driver.step(now)
            self._remote.expect(self._cyclic.state)
            if self._next_step is None:
                _ = self._remote.state  # later ones are made when an action reads them
            due += self._driver.period
        self._next_step = due
        self._runner.commands_taken(now)

    def _end_barred(self, now: float) -> None:
        """End the runs if the device, whose driver is in another process, was stopped there."""
        if self._outside is None:
            return
        before, (self._bars, cause) = self._bars, self._outside.last_bar
        if barred := self._outside.barred or (cause if self._bars > before else ""):
            for run in self._runner.runs:
                self._runner.take(now, Cancel(run, stop_reason(barred, BARRED[barred])))

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s)."""
        if self.failed:
            return None
        due, step = self._runner.due(), self._next_step
        return step if due is None else due if step is None else min(due, step)

    def reports(self) -> list[Report]:
        """What happened since the last call, in order."""
        reports = self._runner.reports()
        if self._told:
            reports += self._told
            self._told = []
        return reports

    def close(self, now: float) -> None:
        """Run the stop routine, then close the driver."""
        if self._driver is not None:
            try:
                self._driver.stop(now)
                self._driver.close()
            except RAISED as fault:
                log_fault(_log, fault, "a driver failed while it was being closed")
