"""Faults that the laboratory can be asked for: which there are, when they come, how long they stay.

| kind | keys | what happens |
|---|---|---|
| drop_images | share, duration | that share of the images is lost |
| dead_camera | duration | no image at all |
| can_errors | share, duration | that share of the frames is lost, both ways |
| bus_off | duration | no frame passes |
| drive_fault | joint | drive 1 to 6 trips (overcurrent) |
| slow_arm | factor | the joints reach this share of their speeds, until another factor comes |
| arm_power | duration | the arm-power chain is open |
| clear | | all faults that last are over |

`after` (s, default 0) delays each; a `duration` left out means until `clear`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from petrobot.services.comm.canopen.bus import Frame


@dataclass(frozen=True, slots=True)
class InjectedFault:
    """One fault: from `start` to `end` (s on the laboratory's clock); `value` is its share, factor
    or joint (from 1)."""

    kind: str
    start: float
    end: float
    value: float
    lasts: bool = True
    """Whether it goes on until its end, or happens once."""


@dataclass(frozen=True, slots=True)
class FaultKinds:
    """The faults of one laboratory: which keys each takes, and how many drives there are."""

    keys: Mapping[str, tuple[str, ...]]
    drives: int

    def read(self, now: float, kind: str, arguments: Mapping[str, Any]) -> InjectedFault:
        """A fault as a caller asks for it. Raises ValueError that says what is wrong and what
        fits."""
        if kind not in self.keys:
            raise ValueError(f"no fault is called {kind!r}; there are {', '.join(self.keys)}")
        keys = self.keys[kind]
        unknown = sorted(set(arguments) - {*keys, "after"})
        if unknown:
            raise ValueError(f"{kind} takes no {unknown[0]!r}, but {', '.join((*keys, 'after'))}")
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
                raise ValueError(f"joint is {value!r}: give a whole number from 1 to {self.drives}")
        return InjectedFault(kind, now + after, now + after + duration, value, "duration" in keys)


ARM_FAULTS: Final = FaultKinds(
    keys={
        "drop_images": ("share", "duration"),
        "dead_camera": ("duration",),
        "can_errors": ("share", "duration"),
        "bus_off": ("duration",),
        "drive_fault": ("joint",),
        "slow_arm": ("factor",),
        "arm_power": ("duration",),
        "clear": (),
    },
    drives=6,
)


def read_fault(now: float, kind: str, arguments: Mapping[str, Any]) -> InjectedFault:
    """A fault of the catching cell's as a caller asks for it. Raises ValueError that says what is
    wrong and what fits."""
    return ARM_FAULTS.read(now, kind, arguments)


def _number(
    arguments: Mapping[str, Any], key: str, default: float | None, low: float, high: float
) -> float:
    value = arguments.get(key, default)
    if value is None:
        raise ValueError(f"{key} is missing: give a number from {low:g} to {high:g}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{key} is {value!r}: give a number from {low:g} to {high:g}")
    return float(value)


class FaultPlan:
    """Faults to come and faults that last. Draws of what is lost come from the generator given."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._coming: list[InjectedFault] = []
        self._lasting: list[InjectedFault] = []

    def add(self, fault: InjectedFault) -> None:
        """Plan a fault."""
        self._coming.append(fault)

    def begin(self, now: float) -> list[InjectedFault]:
        """The faults whose time has come since the last call, in the order of their time; those
        over are forgotten."""
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
        """Whether a lasting fault of this kind goes on."""
        return any(fault.kind == kind for fault in self._lasting)

    def image_lost(self) -> bool:
        """Whether the image taken now is lost."""
        return bool(self._lasting) and (self.active("dead_camera") or self._lost("drop_images"))

    def frame_lost(self) -> bool:
        """Whether the frame sent now is lost."""
        return bool(self._lasting) and (self.active("bus_off") or self._lost("can_errors"))

    def passed(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """The frames sent now that are not lost."""
        return [frame for frame in frames if not self.frame_lost()] if self._lasting else frames

    def _lost(self, kind: str) -> bool:
        shares = [fault.value for fault in self._lasting if fault.kind == kind]
        return any(self._rng.random() < share for share in shares)
