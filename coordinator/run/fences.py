"""Devices that may still move although nobody here leads them: no run starts on one before it is
known to stand still."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

STOP_MARGIN: Final = 2.0
"""Seconds that a node's stop routine may take after a run's orphan time (docs/semantics.md,
cancel)."""
REBOOTED: Final = "rebooted"
FORGOTTEN: Final = "forgotten"
UNSURE: Final = frozenset({"lost", "no_answer", "not_accepted", "refused", REBOOTED, FORGOTTEN})
"""Causes after which a device may still be moving if executed = unknown.

The node has not said that the run is over, or cannot say how it ended. Or it is another process,
and the devices of the former one may be in the middle of their stop routines.
"""
FOR_GOOD: Final = math.inf


@dataclass(frozen=True, slots=True)
class Fence:
    """A device is kept free because of a run, until a time (s) or until its node says that the run
    is over."""

    run: str
    node: str
    until: float


class Fences:
    """By device."""

    def __init__(self) -> None:
        self._fences: dict[str, Fence] = {}

    def __contains__(self, device: str) -> bool:
        return device in self._fences

    def __len__(self) -> int:
        return len(self._fences)

    def __getitem__(self, device: str) -> Fence:
        return self._fences[device]

    def put(self, device: str, run: str, node: str, until: float) -> None:
        """Fence a device."""
        self._fences[device] = Fence(run, node, until)

    def after(self, cause: str, now: float, orphan_time: float | None) -> float:
        """Until when a device is fenced whose run ended for this cause.

        A node that was lost stops the run itself once it has missed its coordinator for the orphan
        time. One that was started again, or has forgotten the run, does not execute it any more.
        One that is there and does not say that the run has stopped can be waited for only.
        """
        if cause == "no_answer":
            return FOR_GOOD
        return now + STOP_MARGIN + (0.0 if cause in (REBOOTED, FORGOTTEN) else orphan_time or 0.0)

    def lift(self, run: str) -> list[str]:
        """The run is known to be over: gives the devices that are free by that."""
        devices = [device for device, fence in self._fences.items() if fence.run == run]
        for device in devices:
            del self._fences[device]
        return devices

    def rebooted(self, now: float, node: str) -> None:
        """The node is another process: the runs of the former one ended with it, at the latest by
        its devices' stop routines."""
        for device, fence in self._fences.items():
            if fence.node == node:
                self._fences[device] = Fence(fence.run, node, min(fence.until, now + STOP_MARGIN))

    def over(self, now: float) -> list[tuple[str, Fence]]:
        """Take out the fences whose time is over."""
        found = [(device, fence) for device, fence in self._fences.items() if fence.until <= now]
        for device, _ in found:
            del self._fences[device]
        return found

    def due(self) -> float | None:
        """When the next one is over, None if only a node can lift one."""
        soonest = min((fence.until for fence in self._fences.values()), default=FOR_GOOD)
        return soonest if soonest < FOR_GOOD else None
