"""CANopen master of the rover's bus: two wheel drives and the reflector sensor, on top of
`services.comm.canopen.master`.

Sans-I/O: frames in, frames out, times passed in. It knows neither track nor actions: each cycle it
receives two wheel speeds (rad/s) and reports how far the wheels have turned. A silent sensor is
reported, but does not stop the rover.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    MasterPhase as MasterPhase,
    Power,
    Supervision,
    Trouble as Trouble,
    companion_transfers,
    pdo_transfers,
    unfit,
    usual_transfers,
)
from petrobot.services.mobile.reflectors import ECHOES

HEARTBEAT_PATIENCE: Final = 0.25
"""Seconds of silence after which a node counts as lost (both ways)."""
SILENT_CYCLES: Final = 5
"""Cycles without a drive's TPDO after which the drive counts as lost."""
RESET_CYCLES: Final = 5
"""Cycles between two fault resets."""
STOP_CYCLES: Final = 40
"""Cycles that a drive has for its quick stop, before its power is switched off and its brake
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
    """The master's view of one wheel's drive."""

    def __init__(self, node: int, quick_stop: float) -> None:
        """`quick_stop` in rad/s^2."""
        self.node = node
        self.sdo = SdoClient(node)
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.limited = False
        """Whether the drive cuts its set points because the battery cannot supply more."""
        self.spoken = False
        self.silent = 0
        self.error_code = 0
        self._quick_stop = quick_stop
        self._power = Power(RESET_CYCLES, STOP_CYCLES)
        self._position: int | None = None
        self._turned = 0

    def transfers(self, cycle: float) -> list[Transfer]:
        """Return the SDO transfers that configure this drive for a bus cycle (s), and read what the
        master must know."""
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
        """Return in words why the device at this node does not fit; empty if it does."""
        return unfit(self.node, self.sdo.results, _MODE)

    def take(self, data: bytes) -> bool:
        """Process the drive's TPDO; return whether its status has changed. Raises ValueError for
        bytes of another length."""
        if len(data) != _TPDO.size:
            raise ValueError(
                f"TPDO of node {self.node}: expected {_TPDO.size} bytes, got {len(data)}"
            )
        statusword, position, _ = _TPDO.unpack(data)
        before = self.state, self.limited
        self.state = state_of(statusword)
        self.limited = bool(statusword & StatusBit.INTERNAL_LIMIT)
        if self._position is not None:
            # The position counts modulo 2^32: take the difference as a signed 32-bit number.
            self._turned += (position - self._position + _HALF) % _WHOLE - _HALF
        self._position = position
        self.silent, self.spoken = 0, True
        return (self.state, self.limited) != before

    def turned(self) -> float:
        """Return the rad that the wheel has turned since the last call."""
        turned, self._turned = self._turned, 0
        return from_units(turned)

    def frame(self, target: float, wanted: bool, resetting: bool) -> Frame:
        """Return the RPDO: the controlword that leads to the state that the master wants, and the
        target speed (rad/s)."""
        word = self._power.word(self.state, wanted, resetting)
        return Frame(canopen.RPDO1_BASE + self.node, _RPDO.pack(word, to_units(target)))


class WheelMaster(CanopenMaster[WheelLink]):
    """Master of the wheels `left` and `right` (node ids) and of the reflector sensor `sensor`."""

    def __init__(
        self,
        left: int,
        right: int,
        sensor: int,
        cycle: float,
        quick_stop: float,
        dry_run: bool = False,
    ) -> None:
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
            dry_run=dry_run,
        )

    def advance(self, now: float, targets: Sequence[float]) -> list[Frame]:
        """Return the frames of one cycle; in a dry run with speeds of zero."""
        return super().advance(now, (0.0, 0.0) if self._dry_run else targets)

    @property
    def sensor_alive(self) -> bool:
        """Whether the sensor's heartbeat has been received recently."""
        return self.alive(self.sensor)

    def wheel(self, trouble: Trouble) -> str:
        """Return the wheel that a trouble belongs to, "" if none."""
        return "" if trouble.axis is None else self.names[trouble.axis]

    def _take_echoes(self, data: bytes) -> None:
        if len(data) == ECHOES.size:
            self.echoes.append(data)
