"""What the master knows of one drive: its configuration, what it says in its TPDO, and the RPDO
that it is sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import DataType, SdoClient, Transfer
from petrobot.services.comm.canopen.cia402 import (
    ENABLING,
    RECEIVED,
    SENT,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    from_units,
    state_of,
    to_units,
)
from petrobot.services.comm.canopen.master import Power, pdo_transfers, unfit, usual_transfers

HEARTBEAT_PATIENCE: Final = 0.2
"""s of silence after which a node counts as lost (both ways)."""
RESET_CYCLES: Final = 10
"""Cycles between two fault resets."""
STOP_CYCLES: Final = 125
"""Cycles that a drive is given to stop quickly and stand, before its power is taken away and its
brake holds."""
SPEED_POLL: Final = 1.0
"""Seconds between two looks at a drive's greatest speed."""
LIMITED_POLL: Final = 0.02
"""The same while a drive says that it is too slow for its set points."""

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


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What a drive is configured with: SI units."""

    lower: float
    upper: float
    quick_stop: float
    following_error: float = 0.10
    following_time: float = 0.04


class DriveLink:
    """What the master knows of one drive."""

    def __init__(self, node: int, settings: DriveSettings) -> None:
        self.node = node
        self.settings = settings
        self.sdo = SdoClient(node)
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.statusword = 0
        self.limited = False
        """Whether the drive cuts its set points because they are faster than it goes."""
        self.position = 0.0
        self.torque = 0.0
        self.silent = 0
        self.spoken = False
        self.max_speed = 0.0
        self.error_code = 0
        self.controlword = 0
        self._asked = 0.2 * node  # not all at once
        self._reading = False
        self._taken = b""
        self._rpdo = canopen.RPDO1_BASE + node
        self._sent: tuple[int, float, Frame] | None = None
        self._power = Power(RESET_CYCLES, STOP_CYCLES)

    def transfers(self, cycle: float) -> list[Transfer]:
        """The configuration of this drive for a bus cycle of so many seconds, and what is read from
        it."""
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
        """What makes the device at this node unfit, in words; empty if nothing. Takes over its
        greatest speed."""
        wrong = unfit(self.node, self.sdo.results, _MODE)
        if not wrong:
            self.max_speed = from_units(self.sdo.results[ObjectIndex.MAX_SPEED, 0])
        return wrong

    def ask_speed(self, now: float, hurry: bool) -> list[Frame]:
        """Read the drive's greatest speed again when it is time, sooner in a hurry: drives may slow
        down by themselves."""
        if self._reading:
            if self.sdo.busy:
                return self.sdo.advance(now)
            self._reading = False
            self.max_speed = from_units(
                self.sdo.results.get((ObjectIndex.MAX_SPEED, 0), to_units(self.max_speed))
            )
        if now - self._asked < (LIMITED_POLL if hurry else SPEED_POLL):
            return []
        self._asked, self._reading = now, True
        self.sdo.begin([Transfer(ObjectIndex.MAX_SPEED, 0, _U32)])
        return self.sdo.advance(now)

    def take(self, data: bytes) -> bool:
        """The drive's TPDO; says whether its status is another one. Raises ValueError for bytes
        that are none."""
        if data == self._taken and self.spoken:  # a drive at rest
            self.silent = 0
            return False
        if len(data) != _TPDO.size:
            raise ValueError(
                f"TPDO of node {self.node} has {len(data)} bytes, must have {_TPDO.size}"
            )
        statusword, position, torque = _TPDO.unpack(data)
        other = statusword != self.statusword or not self.spoken
        if other:
            self.state, self.statusword = state_of(statusword), statusword
            self.limited = bool(statusword & StatusBit.INTERNAL_LIMIT)
        self.position, self.torque = from_units(position), torque / 1e3
        self.silent, self.spoken, self._taken = 0, True, data
        return other

    def frame(self, target: float, wanted: bool, resetting: bool) -> Frame:
        """The RPDO: a controlword that leads to where the master wants the drive, and the target
        position (rad)."""
        if wanted and self.state is DriveState.OPERATION_ENABLED:
            self._power.stopping = 0
            self.controlword = _GO_ON
        else:
            self.controlword = self._power.word(self.state, wanted, resetting)
        return self._frame(self.controlword, target)

    def _frame(self, controlword: int, target: float) -> Frame:
        """The RPDO; the same object as before while neither of both changes."""
        sent = self._sent
        if sent is None or target != sent[1] or controlword != sent[0]:
            frame = Frame(self._rpdo, _RPDO.pack(controlword, to_units(target)))
            self._sent = sent = controlword, target, frame
        return sent[2]


_GO_ON: Final = ENABLING[DriveState.OPERATION_ENABLED].word
"""Controlword to a drive that follows its set points."""
