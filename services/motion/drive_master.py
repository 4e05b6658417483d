"""The CANopen master of the arm's bus: six drives and the digital inputs, on
`services.comm.canopen_master`.

A machine: frames in, frames out, times passed in. It knows neither trajectories nor actions: each
cycle it is given six targets (rad) and says what the drives say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import DataType, Mapped
from petrobot.services.comm.canopen.cia402 import DriveFault
from petrobot.services.comm.canopen.master import (
    CanopenMaster,
    Companion,
    MasterPhase,
    Supervision,
    Trouble,
    companion_transfers,
)
from petrobot.services.motion.drive_link import HEARTBEAT_PATIENCE, DriveLink, DriveSettings

SILENT_CYCLES: Final = 10
"""Cycles without a drive's TPDO after which it counts as lost."""
INPUT_TIMER_MS: Final = 100
INPUT_OBJECTS: Final = (Mapped(0x6000, 1, DataType.UNSIGNED8),)


class DriveMaster(CanopenMaster[DriveLink]):
    """Master of nodes 1 to 6 (drives, base to flange) and `inputs` (digital inputs)."""

    def __init__(
        self, settings: Sequence[DriveSettings], cycle: float, inputs: int = 7, enable: bool = True
    ) -> None:
        """`cycle` in seconds; with `enable` the drives are enabled as soon as they are there for
        the first time."""
        self.inputs: int | None = None
        drives = {f"joint {node}": DriveLink(node, each) for node, each in enumerate(settings, 1)}
        transfers = companion_transfers(inputs, INPUT_TIMER_MS, INPUT_OBJECTS)
        companion = Companion(inputs, transfers, self._take_inputs)
        super().__init__(
            drives,
            (companion,),
            cycle,
            Supervision(SILENT_CYCLES, HEARTBEAT_PATIENCE),
            enable=enable,
        )

    @property
    def positions(self) -> list[float]:
        """Joint angles as the drives last said (rad)."""
        return [drive.position for drive in self.drives]

    @property
    def speeds(self) -> tuple[float, ...]:
        """Greatest speeds as the drives last said (rad/s)."""
        return tuple([drive.max_speed for drive in self.drives])

    def give_up(
        self, why: str, cause: str = "drive_fault", code: int = DriveFault.FOLLOWING_ERROR
    ) -> None:
        """The servo itself stops the drives quickly, with the next cycle: they do not follow, or in
        an emergency."""
        super().give_up(why, cause, code)

    def advance(self, now: float, targets: Sequence[float]) -> list[Frame]:
        """Frames of one cycle: configuration, or set points (rad), SYNC and now and then the
        question how fast a drive goes."""
        configuring = self.phase is MasterPhase.CONFIGURING
        frames = super().advance(now, targets)
        if not configuring:
            hurry = self.limited
            for drive in self.drives:
                asked = drive.ask_speed(now, hurry)
                if asked:
                    frames += asked
        return frames

    def _take_inputs(self, data: bytes) -> None:
        if data:
            self.inputs = data[0]


__all__ = ["DriveMaster", "MasterPhase", "Trouble"]
