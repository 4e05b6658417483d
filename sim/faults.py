"""Faults that the laboratory can inject: their kinds, when they begin, how long they last.

| kind | keys | what happens |
|---|---|---|
| drop_images | share, duration | that share of the images is lost |
| dead_camera | duration | no image at all |
| can_errors | share, duration | that share of the frames is lost, in both directions |
| bus_off | duration | no frame passes |
| drive_fault | joint | drive 1 to 6 trips (overcurrent) |
| slow_arm | factor | the joints reach this share of their speeds, until another factor comes |
| arm_power | duration | the arm-power chain is open |
| clear | | all lasting faults end |

`after` (s, default 0) delays each; a `duration` left out means until `clear`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct

from petrobot.services.comm.canopen.bus import Frame


class InjectedFault(Struct, frozen=True):
    """One fault: from `start` to `end` (s on the laboratory's clock); `value` is its share, factor
    or joint (from 1)."""

    kind: str
    start: float
    end: float
    value: float
    lasts: bool = True
    """Whether it lasts until its end, or happens once."""


class FaultKinds(Struct, frozen=True):
    """The faults of one laboratory: the keys of each, and the number of drives."""

    keys: Mapping[str, tuple[str, ...]]
    drives: int

    def read(self, now: float, arguments: Mapping[str, Any]) -> InjectedFault:
        """Return the fault that a caller asks for: its `kind` and keys. Raises ValueError that says
        what is wrong and what is expected."""
        kind = str(arguments.get("kind", ""))
        if kind not in self.keys:
            raise ValueError(f"unknown fault {kind!r}; the faults are {', '.join(self.keys)}")
        keys = self.keys[kind]
        unknown = sorted(set(arguments) - {*keys, "kind", "after"})
        if unknown:
            raise ValueError(
                f"{kind}: unknown key {unknown[0]!r}; the keys are {', '.join((*keys, 'after'))}"
            )
        after = _number(arguments, "after", 0.0, 0.0, math.inf)
        duration = _number(arguments, "duration", math.inf, 0.0, math.inf)
        value = 1.0
        if "share" in keys:
            value = _number(arguments, "share", 1.0, 0.0, 1.0)
        elif "factor" in keys:
            value = _number(arguments, "factor", None, 0.05, 1.0)
        elif "joint" in keys:
            value = _number(arguments, "joint", None, 1.0, float(self.drives))
            if value != int(value):
                raise ValueError(
                    f"joint: expected a whole number from 1 to {self.drives}, got {value!r}"
                )
        return InjectedFault(kind, now + after, now + after + duration, value, "duration" in keys)


CAMERA_FAULTS: Final[Mapping[str, tuple[str, ...]]] = {
    "drop_images": ("share", "duration"),
    "dead_camera": ("duration",),
    "clear": (),
}
BUS_FAULTS: Final[Mapping[str, tuple[str, ...]]] = {
    "can_errors": ("share", "duration"),
    "bus_off": ("duration",),
    "drive_fault": ("joint",),
}


def _number(
    arguments: Mapping[str, Any], key: str, default: float | None, low: float, high: float
) -> float:
    value = arguments.get(key, default)
    if value is None:
        raise ValueError(f"{key} is missing; give a number from {low:g} to {high:g}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{key}: expected a number from {low:g} to {high:g}, got {value!r}")
    return float(value)


class FaultPlan:
    """Planned faults and lasting faults. The given generator draws what is lost."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._coming: list[InjectedFault] = []
        self._lasting: list[InjectedFault] = []

    def add(self, fault: InjectedFault) -> None:
        """Plan a fault."""
        self._coming.append(fault)

    def begin(self, now: float) -> list[InjectedFault]:
        """Return the faults that have begun since the last call, in the order of their time;
        finished ones are forgotten."""
        begun = sorted((f for f in self._coming if f.start <= now), key=lambda f: f.start)
        if begun:
            self._coming = [f for f in self._coming if f.start > now]
        for fault in begun:
            if fault.kind == "clear":
                self._lasting.clear()
            elif fault.lasts:
                self._lasting.append(fault)
        if self._lasting:
            self._lasting = [f for f in self._lasting if f.end > now]
        return begun

    @property
    def none(self) -> bool:
        """Whether no fault is planned and none lasts."""
        return not (self._coming or self._lasting)

    def active(self, kind: str) -> bool:
        """Return whether a lasting fault of this kind is active."""
        return any(fault.kind == kind for fault in self._lasting)

    def image_lost(self) -> bool:
        """Return whether the image taken now is lost."""
        return bool(self._lasting) and (self.active("dead_camera") or self._lost("drop_images"))

    def frame_lost(self) -> bool:
        """Return whether the frame sent now is lost."""
        return bool(self._lasting) and (self.active("bus_off") or self._lost("can_errors"))

    def passed(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Return the frames sent now that are not lost."""
        return [frame for frame in frames if not self.frame_lost()] if self._lasting else frames

    def _lost(self, kind: str) -> bool:
        shares = [fault.value for fault in self._lasting if fault.kind == kind]
        return any(self._rng.random() < share for share in shares)
