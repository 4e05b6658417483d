"""CANopen master of the arm's bus: six drives and the digital inputs, on top of
`services.comm.canopen.master`.

Sans-I/O: frames in, frames out, times passed in. It knows neither trajectories nor actions: each
cycle it receives six target angles (rad) and reports what the drives report.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import DataType, Mapped, SdoClient, Transfer
from petrobot.services.comm.canopen.cia402 import (
    ENABLING,
    RECEIVED,
    SENT,
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    from_units,
    state_of,
    to_units,
)
from petrobot.services.comm.canopen.master import (
    CanopenMaster,
    Companion,
    MasterPhase,
    Power,
    Supervision,
    companion_transfers,
    pdo_transfers,
    unfit,
    usual_transfers,
)

# --- One drive -----------------------------------------------------------------------------------

HEARTBEAT_PATIENCE: Final = 0.2
"""Seconds of silence after which a node counts as lost (both ways)."""
RESET_CYCLES: Final = 10
"""Cycles between two fault resets."""
STOP_CYCLES: Final = 125
"""Cycles that a drive has for its quick stop, before its power is switched off and its brake
holds."""
SPEED_POLL: Final = 1.0
"""Seconds between two reads of a drive's greatest speed."""
LIMITED_POLL: Final = 0.02
"""The same while a drive reports that it is too slow for its set points."""

_MODE: Final = OperationMode.CYCLIC_SYNCHRONOUS_POSITION
_U8, _U16, _U32, _I8, _I32 = (
    DataType.UNSIGNED8,
    DataType.UNSIGNED16,
    DataType.UNSIGNED32,
    DataType.INTEGER8,
    DataType.INTEGER32,
)
_TPDO: Final = canopen.pdo_struct(SENT)
_RPDO: Final = canopen.pdo_struct(RECEIVED)


class DriveSettings(Struct, frozen=True):
    """Configuration of one drive, in SI units."""

    lower: float
    upper: float
    quick_stop: float
    following_error: float = 0.10
    following_time: float = 0.04


class JointDriveLink:
    """The master's view of one drive: its configuration, what its TPDO reports, and the RPDO sent
    to it."""

    def __init__(self, node: int, settings: DriveSettings) -> None:
        self.node = node
        self.settings = settings
        self.sdo = SdoClient(node)
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.statusword = 0
        self.limited = False
        """Whether the drive cuts its set points because they are faster than it can move."""
        self.position = 0.0
        self.silent = 0
        self.spoken = False
        self.max_speed = 0.0
        self.error_code = 0
        self.controlword = 0
        self.asked = 0.2 * node  # Spread the reads of the six drives.
        """When its greatest speed was read last (s)."""
        self.reading = False
        """Whether that is being read."""
        self._taken = b""
        self._rpdo = canopen.RPDO1_BASE + node
        self._sent: tuple[int, float, Frame] | None = None
        self._power = Power(RESET_CYCLES, STOP_CYCLES)

    def transfers(self, cycle: float) -> list[Transfer]:
        """Return the SDO transfers that configure this drive for a bus cycle (s), and read what the
        master must know."""
        settings = self.settings
        return [
            *usual_transfers(cycle, _MODE, HEARTBEAT_PATIENCE),
            Transfer(ObjectIndex.MAX_SPEED, 0, _U32),
            Transfer(ObjectIndex.INTERPOLATION_PERIOD, 1, _U8, round(cycle * 1e3)),
            Transfer(ObjectIndex.INTERPOLATION_PERIOD, 2, _I8, -3),
            Transfer(ObjectIndex.SOFTWARE_LIMITS, 1, _I32, to_units(settings.lower)),
            Transfer(ObjectIndex.SOFTWARE_LIMITS, 2, _I32, to_units(settings.upper)),
            Transfer(
                ObjectIndex.FOLLOWING_ERROR_WINDOW, 0, _U32, to_units(settings.following_error)
            ),
            Transfer(
                ObjectIndex.FOLLOWING_ERROR_TIMEOUT, 0, _U16, round(settings.following_time * 1e3)
            ),
            Transfer(ObjectIndex.QUICK_STOP_DECELERATION, 0, _U32, to_units(settings.quick_stop)),
            *pdo_transfers(self.node, RECEIVED),
        ]

    def wrong(self) -> str:
        """Return in words why the device at this node does not fit; empty if it does. Stores its
        greatest speed."""
        wrong = unfit(self.node, self.sdo.results, _MODE)
        if not wrong:
            self.max_speed = from_units(self.sdo.results[ObjectIndex.MAX_SPEED, 0])
        return wrong

    def ask_speed(self, now: float, poll: float) -> list[Frame]:
        """Read the drive's greatest speed again `poll` s after the last time: drives may slow down
        by themselves."""
        if self.reading:
            if self.sdo.busy:
                return self.sdo.advance(now)
            self.reading = False
            self.max_speed = from_units(
                self.sdo.results.get((ObjectIndex.MAX_SPEED, 0), to_units(self.max_speed))
            )
        if now - self.asked < poll:
            return []
        self.asked, self.reading = now, True
        self.sdo.begin([Transfer(ObjectIndex.MAX_SPEED, 0, _U32)])
        return self.sdo.advance(now)

    def take(self, data: bytes) -> bool:
        """Process the drive's TPDO; return whether its status has changed. Raises ValueError for
        bytes of another length."""
        if data == self._taken and self.spoken:  # A drive at rest repeats itself.
            self.silent = 0
            return False
        if len(data) != _TPDO.size:
            raise ValueError(
                f"TPDO of node {self.node}: expected {_TPDO.size} bytes, got {len(data)}"
            )
        statusword, position, _ = _TPDO.unpack(data)
        other = statusword != self.statusword or not self.spoken
        if other:
            self.state, self.statusword = state_of(statusword), statusword
            self.limited = bool(statusword & StatusBit.INTERNAL_LIMIT)
        self.position = from_units(position)
        self.silent, self.spoken, self._taken = 0, True, data
        return other

    def frame(self, target: float, wanted: bool, resetting: bool) -> Frame:
        """Return the RPDO: the controlword that leads to the state that the master wants, and the
        target position (rad)."""
        if wanted and self.state is _ENABLED:
            self._power.stopping = 0
            word = _GO_ON
        else:
            word = self._power.word(self.state, wanted, resetting)
        self.controlword, sent = word, self._sent
        if sent is not None and target == sent[1] and word == sent[0]:
            return sent[2]  # the same object while neither value has changed
        frame = Frame(self._rpdo, _RPDO.pack(word, to_units(target)))
        self._sent = word, target, frame
        return frame


_ENABLED: Final = DriveState.OPERATION_ENABLED
_GO_ON: Final = ENABLING[_ENABLED].word
"""Controlword for a drive that follows its set points."""


# --- The master ----------------------------------------------------------------------------------

SILENT_CYCLES: Final = 10
"""Cycles without a drive's TPDO after which the drive counts as lost."""
INPUT_NODE: Final = 7
INPUT_TIMER_MS: Final = 100
INPUT_OBJECTS: Final = (Mapped(0x6000, 1, DataType.UNSIGNED8),)


class DriveMaster(CanopenMaster[JointDriveLink]):
    """Master of nodes 1 to 6 (drives, base to flange) and of node 7 (digital inputs)."""

    def __init__(
        self,
        settings: Sequence[DriveSettings],
        cycle: float,
        enable: bool = True,
        dry_run: bool = False,
    ) -> None:
        """`cycle` in seconds; with `enable` the drives are enabled as soon as all of them are
        present for the first time."""
        self.inputs: int | None = None
        drives = {
            f"joint {node}": JointDriveLink(node, each) for node, each in enumerate(settings, 1)
        }
        transfers = companion_transfers(INPUT_NODE, INPUT_TIMER_MS, INPUT_OBJECTS)
        companion = Companion(INPUT_NODE, transfers, self._take_inputs)
        super().__init__(
            drives,
            (companion,),
            cycle,
            Supervision(SILENT_CYCLES, HEARTBEAT_PATIENCE),
            enable=enable,
            dry_run=dry_run,
        )

    @property
    def positions(self) -> list[float]:
        """Joint angles that the drives last reported (rad)."""
        return [drive.position for drive in self.drives]

    @property
    def speeds(self) -> tuple[float, ...]:
        """Greatest speeds that the drives last reported (rad/s)."""
        return tuple([drive.max_speed for drive in self.drives])

    def give_up(
        self, why: str, cause: str = "drive_fault", code: int = DriveFault.FOLLOWING_ERROR
    ) -> None:
        """Stop the drives quickly in the next cycle: the joints do not follow, or in an
        emergency."""
        super().give_up(why, cause, code)

    def advance(self, now: float, targets: Sequence[float]) -> list[Frame]:
        """Return the frames of one cycle: configuration, or set points (rad) and SYNC, and now and
        then a read of a drive's greatest speed."""
        configuring = self.phase is MasterPhase.CONFIGURING
        targets = self.positions if self._dry_run else targets
        frames = super().advance(now, targets)
        if not configuring:
            poll = LIMITED_POLL if self.limited else SPEED_POLL
            for drive in self.drives:
                if drive.reading or now - drive.asked >= poll:
                    frames += drive.ask_speed(now, poll)
        return frames

    def _take_inputs(self, data: bytes) -> None:
        if data:
            self.inputs = data[0]
