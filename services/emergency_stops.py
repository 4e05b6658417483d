"""Devices of a node that were stopped in an emergency and obey nobody, as the latch on disk says and keeps it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from services.comm.latch import ALL, Latch, LatchError

LOOK = 0.25
"""Seconds between looks at the latch: somebody may have set it in this node's place while it could not be asked."""
NEVER = float("inf")


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
        """Devices that come up stopped: by the latch, or all of them where none can be kept, since perhaps one was not."""
        unsure = self._latch is not None and not self._latch.kept
        return self._add(self._devices) if unsure else self.look(0.0)

    def look(self, now: float) -> list[str]:
        """Devices that the latch stops since the last look."""
        if self._latch is None:
            return []
        self.due = now + LOOK if self._devices else NEVER
        stopped = self._latch.stopped()
        return self._add(d for d in self._devices if d in stopped or ALL in stopped) if stopped else []

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
