"""The process of a cyclic driver. It steps the driver at absolute times and runs no action.

Commands of actions and the driver's states travel over a `NewestLink` to the device's worker,
orders of the node over its pipe. If the worker ends, the stop routine is called. If the node ends,
the device is stopped and the process ends. If the node is silent, or its latch shows an emergency
stop, the device is stopped and stays so.
"""

from __future__ import annotations

import gc
import logging
import math
import os
import socket
import time

from petrobot.services.comm.protocol.messages import SEED, Answer, Command, Event, Ping, Pong
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.device import PICTURE, Driver, picture_of, stop_at_once
from petrobot.services.node.emergency_stops import Guard
from petrobot.services.node.ports import ProcessPorts
from petrobot.services.worker.callables import RAISED, describe, log_fault
from petrobot.services.worker.pipe import NewestLink, Pipe
from petrobot.services.worker.remote import (
    BARRED,
    CLEAR_EMERGENCY,
    EMERGENCY_STOP,
    NODE_SILENT,
    CyclicDriver,
    DeviceCommand,
    DeviceError,
)
from petrobot.services.worker.runner import STOP_LIMIT

LINKED = "linked"
"""Message of the node after it has passed the link of a new worker."""
HALT = "halt"
"""Verb of the node's own stop order, answered when the device stands still."""
_log = logging.getLogger(__name__)
TELL_OVERRUN = 1.0
"""Delay after which an overdue driver is reported in the log (s)."""
PRIORITY = 50
"""SCHED_FIFO priority, where the system permits it."""


def take_priority() -> bool:
    """Request real-time scheduling. Return False if it is not permitted (it needs CAP_SYS_NICE or
    an rtprio limit)."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (PermissionError, OSError):
        return False
    return True


class DeviceLoop:
    """Steps one driver until its node ends."""

    def __init__(
        self,
        driver: Driver,
        ports: ProcessPorts,
        node: Pipe,
        descriptors: socket.socket,
        guard: Guard | None = None,
    ) -> None:
        """`descriptors` is the socket through which the node passes the link of each new worker."""
        assert driver.period
        self._descriptors = descriptors
        self._driver = driver
        self._cyclic = CyclicDriver(driver)
        self._period = driver.period
        self._ports = ports
        self._node = node
        self._guard = guard
        self._worker: NewestLink | None = None
        self._stopping: dict[str, float] = {}
        self._cleared: list[str] = []
        """Commands to be answered once the worker was sent the state."""
        self._overruns = 0
        self._latest = 0.0
        self._tell_due = 0.0

    def run(self) -> None:
        """Step until the node has ended and the device stands still, or the time of the stop
        routine has passed. Raises DeviceError."""
        gc.collect()
        gc.freeze()
        try:
            self._step_on()
        except RAISED as fault:
            self._stop_broken()
            raise DeviceError(f"its driver failed: {describe(fault)}") from fault
        finally:
            try:
                self._driver.close()
            except RAISED as fault:
                log_fault(_log, fault, "a driver failed while it was being closed")
            if self._worker is not None:
                self._worker.close()

    def _stop_broken(self) -> None:
        """Stop a device whose driver failed: step it, while that works, until the device stands
        still or the time has passed."""
        end = time.monotonic() + STOP_LIMIT
        try:
            stop_at_once(self._driver, time.monotonic())
            while (now := time.monotonic()) < end and not self._driver.stopped():
                self._driver.step(now)
                time.sleep(self._period)
        except RAISED as fault:
            _log.error("it could not be stopped either: %s", describe(fault))

    def _step_on(self) -> None:
        due, end = time.monotonic(), float("inf")
        while True:
            now = self._sleep_until(due)
            if self._node.closed and end == float("inf"):
                self._driver.stop(now)
                end = now + STOP_LIMIT
            self._cycle(now)
            if now >= end or (end < float("inf") and self._driver.stopped()):
                break
            due = self._next(due, time.monotonic())

    def _sleep_until(self, due: float) -> float:
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
            now = time.monotonic()
        self._latest = max(self._latest, now - due)
        return now

    def _next(self, due: float, now: float) -> float:
        """Return the time of the next cycle. Missed cycles are left out: a burst of cycles would
        make a drive jump."""
        missed = max(0, math.floor((now - due) / self._period))
        if missed:
            self._overruns += missed
            late = now - due - self._period
            self._latest = max(self._latest, late)
            if late >= TELL_OVERRUN and now >= self._tell_due:
                self._tell_due = now + 10 * TELL_OVERRUN
                _log.warning(
                    "a cycle of %g s took %.3f s: %d cycles were left out",
                    self._period,
                    now - due,
                    missed,
                )
        return due + (missed + 1) * self._period

    def _cycle(self, now: float) -> None:
        if not self._node.closed:
            for item in self._node.read():
                word = item[0] if isinstance(item, list) else ""
                if self._guard is not None:
                    self._guard.heard(now, word == LINKED or isinstance(item, Ping))
                if word == LINKED:
                    self._attach()
                elif isinstance(item, Ping):
                    self._node.post(Pong(item.number))
                elif isinstance(item, Command):
                    self._obey(now, item)
            if self._guard is not None and now >= self._guard.due:
                self._watch(now, self._guard)
        self._take_commands(now)
        self._ports.poll()
        if self._cyclic.barred:
            self._ports.withhold(self._cyclic.barred)
        state = self._cyclic.step(now)
        if self._worker is not None:
            self._worker.send(
                [
                    state.handled,
                    state.refused,
                    state.stopped,
                    state.state,
                    state.refusal,
                    state.barred,
                    state.last_bar,
                ]
            )
        while self._cleared:  # a call that follows the answer must not meet the state before
            self._tell(self._cleared.pop(0), "cleared")
        for id_, until in list(self._stopping.items()):
            if state.stopped or now >= until:
                del self._stopping[id_]
                self._tell(id_, "stopped" if state.stopped else "moving")
        for name, data in self._ports.raised():
            self._node.post(Event(name, "", 0, data))

    def _watch(self, now: float, guard: Guard) -> None:
        """Stop the device without an order of the node if the node is silent or the latch is
        set."""
        cause, before = guard.look(now), self._cyclic.barred
        if cause == EMERGENCY_STOP:
            if before != EMERGENCY_STOP:
                self._cyclic.emergency_stop(now)
        elif cause == NODE_SILENT:
            if not before:
                self._cyclic.node_silent(now)
        else:
            self._cyclic.node_speaks()
        if self._cyclic.barred != before:
            _log.warning(
                "%s",
                BARRED.get(self._cyclic.barred, "the node speaks again: commands are taken again"),
            )

    def _take_commands(self, now: float) -> None:
        if self._worker is None:
            return
        for number, verb, body in self._worker.read():
            if verb == SEED:
                self._ports.draws.reseed(body["seed"])
            else:
                self._cyclic.take(now, DeviceCommand(number, verb, body))
        if self._worker.closed:
            self._driver.stop(now)
            self._worker.socket.close()
            self._worker = None

    def _obey(self, now: float, command: Command) -> None:
        """Carry out a command of the node, and answer it."""
        id_, verb = command.id, command.verb
        if verb == HALT:
            self._driver.stop(now)
            self._stopping[id_] = now + STOP_LIMIT
        elif verb == "stop":
            self._driver.stop(now)
            self._tell(id_, "stopped" if self._driver.stopped() else "stopping")
        elif verb == EMERGENCY_STOP:
            self._cyclic.emergency_stop(now)
            self._tell(id_, "stopped" if self._driver.stopped() else "stopping")
        elif verb == CLEAR_EMERGENCY:
            self._cyclic.clear_emergency()
            self._cleared.append(id_)
        elif verb == "hold":
            self._tell(id_, self._driver.hold(now))
        elif verb == "release":
            self._driver.release(now)
            self._tell(id_, "released")
        elif verb == SEED:
            self._ports.draws.reseed(command.data[SEED])
            self._tell(id_, "seeded")
        elif verb == PICTURE:
            data = {"answer": PICTURE, **picture_of(self._driver)}
            self._node.report(Answer(id_, True, data))
        else:
            self._tell(id_, "up")

    def _attach(self) -> None:
        """Accept the link of a new worker."""
        _, found, _, _ = socket.recv_fds(self._descriptors, 1, 1)
        end = socket.socket(fileno=found[0])
        if self._worker is not None:
            self._worker.close()
        self._worker = NewestLink(end)
        self._cyclic.forget()

    def _tell(self, id_: str, answer: str) -> None:
        data = {
            "state": plain(self._driver.state(), "state"),
            "late_ms": round(1e3 * self._latest, 3),
            "overruns": self._overruns,
            "refused": self._cyclic.refused,
        }
        self._node.report(Answer(id_, True, {"answer": answer, **data}))
