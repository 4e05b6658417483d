"""Devices of a node that were stopped in an emergency and obey nobody, as the latch on disk says
and keeps it.

The node looks at the latch, and so does each process that has a driver: a node that is frozen, or
whose loop is blocked, can stop nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from petrobot.services.host.emergency_latch import ALL, Latch, LatchError
from petrobot.services.worker.remote import EMERGENCY_STOP, NODE_SILENT

LOOK = 0.25
"""Seconds between looks at the latch: somebody may have set it in this node's place while it could
not be asked."""
NEVER = float("inf")
BEAT = "beat"
"""What a node says to its processes every `BEAT_EVERY` seconds, so that they know that its loop
runs."""
BEAT_EVERY = 0.2
SILENCE = 0.8
"""Seconds without any word of the node after which its processes stop their devices: with the time
that a stop takes to get to the drives that is less than a second."""
AGAIN = 0.2
"""Seconds that a silent node gets to be heard after this process itself stood still."""
GUARD_LOOK = 0.05
"""Seconds between looks of a process at the latch and at its node's silence."""


class Guard:
    """What a process with a driver watches by itself: the latch of its node, and whether its node
    speaks.

    Silence counts from the node's first beat on, or from its first word that lets the device move:
    a node that is frozen right after that may never have sent a beat. A process that was not
    scheduled itself for a while gives its node another moment: what that one said meanwhile still
    has to be read.
    """

    def __init__(self, device: str, latch: Latch) -> None:
        self.due = 0.0
        """When to look next (s)."""
        self._device = device
        self._latch = latch
        self._heard = NEVER
        """When the node last said something (s)."""
        self._again = False
        """Whether it has got another moment since."""

    def heard(self, now: float, counts: bool) -> None:
        """Note that the node has said something. With `counts` its silence counts from now on."""
        if counts or self._heard < NEVER:
            self._heard, self._again = now, False

    def look(self, now: float) -> str:
        """Cause for which the device must stand: EMERGENCY_STOP, NODE_SILENT, or empty. Call it
        when `due`, after reading."""
        if now - self.due > SILENCE / 2 and self._heard < NEVER and not self._again:
            # Once only: a process that is late at each look must not wait for ever.
            self._heard, self._again = max(self._heard, now - SILENCE + AGAIN), True
        self.due = now + GUARD_LOOK
        stopped = self._latch.stopped()
        if self._device in stopped or ALL in stopped:
            return EMERGENCY_STOP
        return NODE_SILENT if now - self._heard >= SILENCE else ""


class EmergencyStops:
    """`devices` are those of the node; without a latch (lock step) nothing outlives the process."""

    def __init__(self, devices: Iterable[str], latch: Latch | None = None) -> None:
        self.due = 0.0 if latch is not None else NEVER
        """When to look next (s)."""
        self._devices = tuple(devices)
        self._latch = latch
        self._stopped: set[str] = set()

    def __contains__(self, device: str) -> bool:
        return device in self._stopped

    @property
    def names(self) -> tuple[str, ...]:
        """Devices that obey nobody."""
        return tuple(sorted(self._stopped))

    def at_start(self) -> list[str]:
        """Devices that come up stopped: by the latch, or all of them where none can be kept, since
        perhaps one was not."""
        unsure = self._latch is not None and not self._latch.kept
        return self._add(self._devices) if unsure else self.look(0.0)

    def look(self, now: float) -> list[str]:
        """Devices that the latch stops since the last look."""
        if self._latch is None:
            return []
        self.due = now + LOOK if self._devices else NEVER
        stopped = self._latch.stopped()
        return (
            self._add(d for d in self._devices if d in stopped or ALL in stopped) if stopped else []
        )

    def stop(self, devices: Collection[str]) -> str:
        """These are stopped; gives why that is not kept on disk, empty if it is."""
        self._add(devices)
        try:
            if self._latch is not None and devices:
                self._latch.stop(devices)
        except LatchError as fault:
            return f"the stop will not outlive a restart of the node: {fault}"
        return ""

    def clear(self, devices: Sequence[str]) -> str:
        """These obey again; gives why not: what the disk still says to be stopped stays so."""
        try:
            if self._latch is not None:
                self._latch.clear(devices, self._devices)
        except LatchError as fault:
            return str(fault)
        self._stopped.difference_update(devices)
        return ""

    def _add(self, devices: Iterable[str]) -> list[str]:
        fresh = [device for device in devices if device not in self._stopped]
        self._stopped.update(fresh)
        return fresh
