"""Faults that the rover's laboratory can be asked for.

| kind | keys | what happens |
|---|---|---|
| drop_images | share, duration | that share of the images is lost |
| dead_camera | duration | no image at all |
| can_errors | share, duration | that share of the frames is lost, both ways |
| bus_off | duration | no frame passes |
| drive_fault | joint | drive 1 (left) or 2 (right) trips (overcurrent) |
| dead_sensor | duration | the reflector sensor says nothing |
| power | duration | the power chain is open: the brakes fall in |
| clear | | all faults that last are over |

`after` (s, default 0) delays each; a `duration` left out means until `clear`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from petrobot.sim.faults import Fault, FaultKinds

ROVER_FAULTS: Final = FaultKinds(
    keys={
        "drop_images": ("share", "duration"),
        "dead_camera": ("duration",),
        "can_errors": ("share", "duration"),
        "bus_off": ("duration",),
        "drive_fault": ("joint",),
        "dead_sensor": ("duration",),
        "power": ("duration",),
        "clear": (),
    },
    drives=2,
)


def read_rover_fault(now: float, kind: str, arguments: Mapping[str, Any]) -> Fault:
    """A fault as a caller asks for it. Raises ValueError that says what is wrong and what fits."""
    return ROVER_FAULTS.read(now, kind, arguments)
