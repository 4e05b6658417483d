"""The process of a cyclic driver: paced by absolute deadline, no user code of actions in it.

Commands of actions come and states go over a `NewestLink` to the device's worker; the node's orders come over its pipe. When
the worker is gone the stop routine is called; when the node is gone the device is stopped and the process ends.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import socket
import time
from typing import Any

from services.comm.plain import plain
from services.device import PICTURE, Driver, picture_of
from services.pipe import NewestLink, Pipe
from services.ports import ProcessPorts
from services.remote import CLEAR_EMERGENCY, EMERGENCY_STOP, CyclicDriver, DeviceCommand
from services.runner import STOP_LIMIT
from services.runs import Told, flat

LINKED = "linked"
"""What the node says when it has passed the link of a new worker."""
HALT = "halt"
"""Verb of the node's own stop order, answered when the device stands still."""
PRIORITY = 50
"""SCHED_FIFO priority, where the system permits it."""


def take_priority() -> bool:
    """Ask for real-time scheduling; False where it is not permitted (needs CAP_SYS_NICE or an rtprio limit)."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (PermissionError, OSError):
        return False
    return True


class DeviceLoop:
    """Steps one driver for as long as its node lives."""

    def __init__(self, driver: Driver, ports: ProcessPorts, node: Pipe, descriptors: socket.socket) -> None:
        """`descriptors` is the socket through which the node passes the link of each new worker."""
        assert driver.period
        self._descriptors = descriptors
        self._driver = driver
        self._cyclic = CyclicDriver(driver)
        self._period = driver.period
        self._ports = ports
        self._node = node
        self._worker: NewestLink | None = None
        self._stopping: dict[str, float] = {}
        self._overruns = 0
        self._latest = 0.0

    def run(self) -> None:
        """Step until the node is gone and the device stands still (or the stop routine's time is over)."""
        gc.collect()
        gc.freeze()
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
        with contextlib.suppress(OSError):
            self._driver.close()
        if self._worker is not None:
            self._worker.close()

    def _sleep_until(self, due: float) -> float:
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
            now = time.monotonic()
        self._latest = max(self._latest, now - due)
        return now

    def _next(self, due: float, now: float) -> float:
        """The next point of the grid. Missed cycles are left out: made up for in a burst, they would make a drive jump."""
        missed = max(0, math.floor((now - due) / self._period))
        self._overruns += missed
        return due + (missed + 1) * self._period

    def _cycle(self, now: float) -> None:
        if not self._node.closed:
            for items in self._node.read():
                self._obey(now, items)
        self._take_commands(now)
        self._ports.poll()
        state = self._cyclic.step(now)
        if self._worker is not None:
            self._worker.send([state.handled, state.refused, state.stopped, plain(state.state, "state")])
        for id_, until in list(self._stopping.items()):
            if state.stopped or now >= until:
                del self._stopping[id_]
                self._tell(id_, "stopped" if state.stopped else "moving")
        for name, data in self._ports.raised():
            self._node.post(["raised", "", name, data])

    def _take_commands(self, now: float) -> None:
        if self._worker is None:
            return
        for number, verb, body in self._worker.read():
            self._cyclic.take(now, DeviceCommand(number, verb, body))
        if self._worker.closed:
            self._driver.stop(now)
            self._worker.socket.close()
            self._worker = None

    def _obey(self, now: float, items: list[Any]) -> None:
        if items[0] == LINKED:
            self._attach()
        elif items[0] == "command":
            _, id_, verb = items
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
                self._tell(id_, "cleared")
            elif verb == "hold":
                self._tell(id_, self._driver.hold(now))
            elif verb == "release":
                self._driver.release(now)
                self._tell(id_, "released")
            elif verb == PICTURE:
                self._node.post(flat(Told(id_, PICTURE, picture_of(self._driver))))
            else:
                self._tell(id_, "up")

    def _attach(self) -> None:
        """A new worker: take the end of its link."""
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
        }
        self._node.post(flat(Told(id_, answer, data)))
