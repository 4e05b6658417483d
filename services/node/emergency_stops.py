"""Devices of a node that are in emergency stop and accept no command, as the latch on disk says.

The node reads the latch, and so does each process that has a driver, because a node that is frozen,
or whose loop is blocked, can stop nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Sequence

from petrobot.services.host.emergency_latch import ALL, Cleared, Latch, LatchError, uptime
from petrobot.services.worker.remote import EMERGENCY_STOP, NODE_SILENT

_log = logging.getLogger(__name__)

LOOK = 0.25
"""Time between reads of the latch (s): `petrobot estop` sets it directly when the node does not
answer."""
NEVER = float("inf")
BEAT_EVERY = 0.2
"""Time between the pings of a node to its processes (s): they show that its loop runs, and the
answers that theirs do."""
SILENCE = 0.8
"""Time without a message of the node after which its processes stop their devices (s). With the
time that a stop takes to reach the drives, that is less than a second."""
AGAIN = 0.2
"""Time that a silent node gets after this process itself was not scheduled (s): its messages may
still have to be read."""
GUARD_LOOK = 0.05
"""Time between checks of the latch and of the node's silence, in a process (s)."""


class Guard:
    """Watches the latch and the messages of the node, in a process with a driver.

    Silence counts from the node's first beat or, if that comes earlier, from its first message that
    lets the device move: a node that freezes right after that may never have sent a beat. A process
    that was not scheduled for a while gives its node `AGAIN` seconds more.
    """

    def __init__(self, device: str, latch: Latch) -> None:
        self.due = 0.0
        """When to look next (s)."""
        self._device = device
        self._latch = latch
        self._heard = NEVER
        """When the node last sent a message (s)."""
        self._again = False
        """Whether the node was given more time since."""

    def heard(self, now: float, counts: bool) -> None:
        """Note a message of the node. With `counts`, its silence counts from now on."""
        if counts or self._heard < NEVER:
            self._heard, self._again = now, False

    def look(self, now: float) -> str:
        """Return why the device must stand still: EMERGENCY_STOP, NODE_SILENT, or empty. Call this
        when `due`, after reading the node's messages."""
        if now - self.due > SILENCE / 2 and self._heard < NEVER and not self._again:
            # Once only: a process that is late at every check must not wait for ever.
            self._heard, self._again = max(self._heard, now - SILENCE + AGAIN), True
        self.due = now + GUARD_LOOK
        stopped = self._latch.stopped()
        if self._device in stopped or ALL in stopped:
            return EMERGENCY_STOP
        return NODE_SILENT if now - self._heard >= SILENCE else ""


Write = Callable[[Callable[[], str], Callable[[str], None]], None]
"""Runs the first function away from the event loop, one after the other in their order, and passes
what it returns to the second, in the loop."""


def write_at_once(write: Callable[[], str], done: Callable[[str], None]) -> None:
    """Write here and now: for a process without an event loop."""
    done(write())


class EmergencyStops:
    """The devices of a node that are in emergency stop. Without a latch (lock step) they are
    forgotten with the process.

    A disk may need seconds for one sync, in which the node must answer its callers and its
    processes. So `in_order` writes, and what was ordered is reported by `done`, once it is on disk.
    """

    def __init__(
        self,
        devices: Iterable[str],
        latch: Latch | None = None,
        in_order: Write = write_at_once,
    ) -> None:
        self.due = 0.0 if latch is not None else NEVER
        """When to look next (s)."""
        self._devices = tuple(devices)
        self._latch = latch
        self._stopped: set[str] = set()
        self._in_order = in_order
        self._writing = 0
        """Number of writes that have not ended."""
        self._clearing: list[set[str]] = []
        """For each clearing that has not ended, its devices without those stopped since."""
        self.cleared, self._cleared_at, _ = Cleared() if latch is None else latch.cleared
        """How many stops were cleared, and when the last one was. A caller that knows of fewer
        slept through one."""
        self._counted = dict.fromkeys(self._devices, self.cleared)
        """How many stops were cleared when each device was last stopped or cleared by this node: if
        it was cleared with a later one, another process has cleared it."""

    def __contains__(self, device: str) -> bool:
        return device in self._stopped

    @property
    def names(self) -> tuple[str, ...]:
        """Devices in emergency stop."""
        return tuple(sorted(self._stopped))

    def since_cleared(self) -> float:
        """Return the time since the last stop was cleared (s)."""
        return uptime() - self._cleared_at

    def at_start(self) -> list[str]:
        """Return the devices that start in emergency stop: those of the latch, or all of them if
        the latch cannot be kept, because then one may have been lost."""
        unsure = self._latch is not None and not self._latch.kept
        if self._latch is not None and (moved := self._latch.moved_here(self._devices)):
            self.stop(moved, lambda why: None)
            return sorted(self._stopped.union(self.look(0.0)[0]))
        return self._add(self._devices) if unsure else self.look(0.0)[0]

    def look(self, now: float) -> tuple[list[str], list[str]]:
        """Return the devices that the latch has stopped since the last call, and those that another
        process has cleared, because this one did not answer. Perhaps only a process of the device
        saw that stop, or none did; so runs that began before it are active. None began later, since
        the node looks before each run."""
        if self._latch is None:
            return [], []
        self.due = now + LOOK if self._devices else NEVER
        cleared = self._latch.cleared  # before the devices: that is the order of clearing
        stopped = self._latch.stopped()
        # A name that this node does not have means all: `ALL`, or a device renamed while stopped.
        unknown = not stopped <= set(self._devices)
        on_disk = [d for d in self._devices if d in stopped or unknown]
        if (
            self._writing
        ):  # a file that lacks a device may be one that this node has not yet written
            return self._add(on_disk), []
        self._count(cleared)
        last = cleared.devices
        freed = [d for d, n in self._counted.items() if last.get(d, 0) > n and d not in on_disk]
        self._stopped.difference_update(freed)
        self._counted |= dict.fromkeys(freed, self.cleared)
        lost = self._stopped.difference(on_disk)
        if lost and cleared == self._latch.cleared:  # not being cleared at this moment
            self._store_again(self._latch, lost)
        return self._add(on_disk), freed

    def _store_again(self, latch: Latch, devices: Collection[str]) -> None:
        """Store a stop that the disk had no room for, or whose file was removed: this node knows of
        it, and its successor must."""

        def done(why: str) -> None:
            if not why:  # else it was reported when it was given, and the next look tries again
                names = ", ".join(sorted(devices))
                _log.warning("stored again that %s stopped in emergency", names)

        self._write(lambda: latch.stop(devices), done)

    def stop(self, devices: Collection[str], done: Callable[[str], None]) -> None:
        """Stop these devices. `done` receives why that could not be stored on disk; empty if it
        was."""
        self._add(devices)
        for clearing in self._clearing:
            clearing.difference_update(devices)
        if self._latch is None or not devices:
            done("")
            return
        # A clearing that has already begun does not mean this stop.
        self._counted |= dict.fromkeys(devices, self._latch.cleared.number)
        latch, stopped = self._latch, tuple(devices)

        def stored(why: str) -> None:
            if why:
                _log.error("an emergency stop could not be stored: %s", why)
                why = (
                    f"NOT STORED: {why}; the node tries again; if it ends before, the devices may "
                    "move: do not start it again before the cell is safe"
                )
            done(why)

        self._write(lambda: latch.stop(stopped), stored)

    def clear(self, devices: Sequence[str], done: Callable[[str], None]) -> None:
        """Let these devices accept commands again. `done` receives why not; empty if they do. What
        is still stopped on disk stays stopped, and so does what is stopped until `done`."""
        latch, freed = self._latch, set(devices)
        self._clearing.append(freed)

        def cleared(why: str) -> None:
            self._clearing = [one for one in self._clearing if one is not freed]
            if not why:
                if not self._stopped.isdisjoint(devices):
                    self._count(Cleared(self.cleared + 1, uptime()))
                if latch is not None:
                    self._count(latch.cleared)
                self._stopped.difference_update(freed)
                self._counted = dict.fromkeys(self._devices, self.cleared)
            done(why)

        if latch is None:
            cleared("")
        else:
            self._write(lambda: latch.clear(devices, self._devices), cleared)

    def _write(self, write: Callable[[], object], done: Callable[[str], None]) -> None:
        """Write in turn; `done` receives why that failed, or an empty text."""

        def attempt() -> str:
            try:
                write()
            except LatchError as fault:
                return str(fault)
            return ""

        def ended(why: str) -> None:
            self._writing -= 1
            done(why)

        self._writing += 1
        self._in_order(attempt, ended)

    def _count(self, found: Cleared) -> None:
        self.cleared, self._cleared_at = max((self.cleared, self._cleared_at), found[:2])

    def _add(self, devices: Iterable[str]) -> list[str]:
        fresh = [device for device in devices if device not in self._stopped]
        self._stopped.update(fresh)
        return fresh
