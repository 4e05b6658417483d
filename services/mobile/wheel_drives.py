"""The CANopen master of the rover's bus: two wheel drives and the reflector sensor, on
`services.comm.canopen_master`.

A machine: frames in, frames out, times passed in. It knows neither track nor actions: each cycle it
is given two wheel speeds (rad/s) and says how far the wheels have turned. A sensor that falls
silent is reported, but stops nobody.
"""

from __future__ import annotations

from typing import Final

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import DataType, Mapped, SdoClient, Transfer
from petrobot.services.comm.canopen.cia402 import (
    SENT,
    VELOCITY_RECEIVED,
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
    Trouble,
    companion_transfers,
    pdo_transfers,
    unfit,
    usual_transfers,
)
from petrobot.services.mobile.reflectors import ECHOES

HEARTBEAT_PATIENCE: Final = 0.25
"""s of silence after which a node counts as lost (both ways)."""
SILENT_CYCLES: Final = 5
"""Cycles without a drive's TPDO after which it counts as lost."""
RESET_CYCLES: Final = 5
"""Cycles between two fault resets."""
STOP_CYCLES: Final = 40
"""Cycles that a drive is given to stop quickly before its power is taken away and its brake
holds."""
SENSOR_TIMER_MS: Final = 40
SENSOR_OBJECTS: Final = tuple(
    Mapped(0x2010, sub, DataType.INTEGER16 if sub % 2 else DataType.UNSIGNED16)
    for sub in range(1, 5)
)
"""Bearing and range of two echoes."""

_MODE: Final = OperationMode.CYCLIC_SYNCHRONOUS_VELOCITY
_TPDO: Final = canopen.pdo_struct(SENT)
_RPDO: Final = canopen.pdo_struct(VELOCITY_RECEIVED)
_HALF, _WHOLE = 1 << 31, 1 << 32


class WheelLink:
    """What the master knows of one wheel's drive."""

    def __init__(self, node: int, quick_stop: float) -> None:
        """`quick_stop` in rad/s^2."""
        self.node = node
        self.sdo = SdoClient(node)
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.limited = False
        """Whether the drive cuts its set points because the battery gives no more."""
        self.spoken = False
        self.silent = 0
        self.error_code = 0
        self._quick_stop = quick_stop
        self._power = Power(RESET_CYCLES, STOP_CYCLES)
        self._position: int | None = None
        self._turned = 0

    def transfers(self, cycle: float) -> list[Transfer]:
        """The configuration of this drive for a bus cycle of so many seconds, and what is read from
        it."""
        return [
            *usual_transfers(cycle, _MODE, HEARTBEAT_PATIENCE),
            Transfer(
                ObjectIndex.QUICK_STOP_DECELERATION,
                0,
                DataType.UNSIGNED32,
                to_units(self._quick_stop),
            ),
            *pdo_transfers(self.node, VELOCITY_RECEIVED),
        ]

    def wrong(self) -> str:
        """What makes the device at this node unfit, in words; empty if nothing."""
        return unfit(self.node, self.sdo.results, _MODE)

    def take(self, data: bytes) -> bool:
        """The drive's TPDO; says whether its status is another one. Raises ValueError for bytes
        that are none."""
        if len(data) != _TPDO.size:
            raise ValueError(
                f"TPDO of node {self.node} has {len(data)} bytes, must have {_TPDO.size}"
            )
        statusword, position, _ = _TPDO.unpack(data)
        before = self.state, self.limited
        self.state = state_of(statusword)
        self.limited = bool(statusword & StatusBit.INTERNAL_LIMIT)
        if self._position is not None:
            self._turned += (position - self._position + _HALF) % _WHOLE - _HALF
        self._position = position
        self.silent, self.spoken = 0, True
        return (self.state, self.limited) != before

    def turned(self) -> float:
        """rad that the wheel has turned since the last call."""
        turned, self._turned = self._turned, 0
        return from_units(turned)

    def frame(self, target: float, wanted: bool, resetting: bool) -> Frame:
        """The RPDO: a controlword that leads to where the master wants the drive, and the target
        speed (rad/s)."""
        word = self._power.word(self.state, wanted, resetting)
        return Frame(canopen.RPDO1_BASE + self.node, _RPDO.pack(word, to_units(target)))


class WheelMaster(CanopenMaster[WheelLink]):
    """Master of the wheels `left` and `right` (node ids) and of the reflector sensor `sensor`."""

    def __init__(self, left: int, right: int, sensor: int, cycle: float, quick_stop: float) -> None:
        """`cycle` s, `quick_stop` rad/s^2."""
        self.sensor = sensor
        self.echoes: list[bytes] = []
        """Data of the sensor's TPDOs since they were last taken."""
        wheels = {
            "left wheel": WheelLink(left, quick_stop),
            "right wheel": WheelLink(right, quick_stop),
        }
        transfers = companion_transfers(sensor, SENSOR_TIMER_MS, SENSOR_OBJECTS)
        companion = Companion(sensor, transfers, self._take_echoes, needed=False)
        super().__init__(
            wheels,
            (companion,),
            cycle,
            Supervision(SILENT_CYCLES, HEARTBEAT_PATIENCE, old_emergencies=True),
        )

    @property
    def sensor_alive(self) -> bool:
        """Whether the sensor's heartbeat has been heard of late."""
        return self.alive(self.sensor)

    def wheel(self, trouble: Trouble) -> str:
        """Which wheel a trouble is of, "" if of none."""
        return "" if trouble.axis is None else self.names[trouble.axis]

    def _take_echoes(self, data: bytes) -> None:
        if len(data) == ECHOES.size:
            self.echoes.append(data)


__all__ = ["MasterPhase", "Trouble", "WheelLink", "WheelMaster"]
