"""The CANopen master of the rover's bus: configures, starts, enables and watches two wheel drives and the reflector sensor.

A machine: frames in, frames out, times passed in. It knows neither track nor actions: each cycle it is given two wheel speeds
(rad/s) and says how far the wheels have turned. A sensor that falls silent is reported, but stops nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from services.comm import canopen
from services.comm.canbus import Frame
from services.comm.canopen import Mapped, NmtCommand, NmtState, SdoClient, Transfer, Type
from services.comm.cia402 import (
    DEVICE_TYPE,
    ENABLING,
    SENT,
    VELOCITY_RECEIVED,
    Command,
    Fault,
    Mode,
    Object,
    State,
    StatusBit,
    fault_text,
    from_units,
    state_of,
    to_units,
)
from services.mobile.reflectors import ECHOES

MASTER_NODE: Final = 0x7F
"""Node id under which the master sends its own heartbeat."""
HEARTBEAT_MS: Final = 50
HEARTBEAT_PATIENCE_MS: Final = 250
HEARTBEAT_PATIENCE: Final = HEARTBEAT_PATIENCE_MS / 1e3
"""Silence after which a node counts as lost (both ways)."""
SILENT_CYCLES: Final = 5
"""Cycles without a drive's TPDO after which it counts as lost."""
RETRY: Final = 1.0
"""s before a failed configuration is tried again."""
SETTLE: Final = 0.05
"""s that nodes are given after a reset of their communication."""
RESET_CYCLES: Final = 5
"""Cycles between two fault resets."""
STOP_CYCLES: Final = 40
"""Cycles that a drive is given to stop quickly before its power is taken away and its brake holds."""
SENSOR_TIMER_MS: Final = 40
SENSOR_OBJECTS: Final = tuple(
    Mapped(0x2010, sub, Type.INTEGER16 if sub % 2 else Type.UNSIGNED16) for sub in range(1, 5)
)
"""Bearing and range of two echoes."""

_U8, _U16, _U32, _I8 = Type.UNSIGNED8, Type.UNSIGNED16, Type.UNSIGNED32, Type.INTEGER8
_TPDO: Final = canopen.pdo_struct(SENT)
_RPDO: Final = canopen.pdo_struct(VELOCITY_RECEIVED)
_MODE_BIT: Final = 1 << (Mode.CYCLIC_SYNCHRONOUS_VELOCITY - 1)
_HALF, _WHOLE = 1 << 31, 1 << 32
_MOVING: Final = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)


class Phase(Enum):
    """What the master is doing."""

    CONFIGURING = "configuring"
    STARTING = "starting"
    RUNNING = "running"
    """Both drives answer each SYNC."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that needs a reset: a short code (`drive_fault`, `power`, `bus`), the wheel or "", and the text."""

    cause: str
    wheel: str
    code: int
    text: str


class WheelLink:
    """What the master knows of one drive."""

    def __init__(self, name: str, node: int, quick_stop: float) -> None:
        self.name = name
        self.node = node
        self.sdo = SdoClient(node)
        self.state = State.NOT_READY_TO_SWITCH_ON
        self.limited = False
        self.spoken = False
        self.silent = 0
        self.error_code = 0
        self._quick_stop = quick_stop
        self._position: int | None = None
        self._turned = 0
        self._stopping = 0
        self._wait = 0

    def transfers(self, cycle: float) -> list[Transfer]:
        """The configuration of this drive for a bus cycle of so many seconds, and what is read from it."""
        return [
            Transfer(Object.DEVICE_TYPE, 0, _U32),
            Transfer(Object.SUPPORTED_MODES, 0, _U32),
            Transfer(Object.PRODUCER_HEARTBEAT, 0, _U16, HEARTBEAT_MS),
            Transfer(Object.CONSUMER_HEARTBEAT, 1, _U32, MASTER_NODE << 16 | HEARTBEAT_PATIENCE_MS),
            Transfer(Object.SYNC_PERIOD, 0, _U32, round(cycle * 1e6)),
            Transfer(Object.MODE, 0, _I8, Mode.CYCLIC_SYNCHRONOUS_VELOCITY),
            Transfer(Object.QUICK_STOP_DECELERATION, 0, _U32, to_units(self._quick_stop)),
            *canopen.map_pdo(Object.RPDO1, Object.RPDO1_MAPPING, canopen.RPDO1_BASE + self.node, 1, VELOCITY_RECEIVED),
            *canopen.map_pdo(Object.TPDO1, Object.TPDO1_MAPPING, canopen.TPDO1_BASE + self.node, 1, SENT),
        ]

    def wrong(self) -> str:
        """What makes the device at this node unfit, in words; empty if nothing."""
        device, modes = self.sdo.results[Object.DEVICE_TYPE, 0], self.sdo.results[Object.SUPPORTED_MODES, 0]
        if device != DEVICE_TYPE:
            return f"node {self.node} is no servo drive (object 1000h is {device:#010x}): check the node ids"
        if not modes & _MODE_BIT:
            return f"node {self.node} does not know cyclic synchronous velocity"
        return ""

    def take(self, data: bytes) -> None:
        """The drive's TPDO. Raises ValueError for bytes that are none."""
        if len(data) != _TPDO.size:
            raise ValueError(f"TPDO of node {self.node} has {len(data)} bytes, must have {_TPDO.size}")
        statusword, position, _ = _TPDO.unpack(data)
        self.state = state_of(statusword)
        self.limited = bool(statusword & StatusBit.INTERNAL_LIMIT)
        if self._position is not None:
            self._turned += (position - self._position + _HALF) % _WHOLE - _HALF
        self._position = position
        self.silent, self.spoken = 0, True

    def turned(self) -> float:
        """rad that the wheel has turned since the last call."""
        turned, self._turned = self._turned, 0
        return from_units(turned)

    def frame(self, speed: float, wanted: bool, resetting: bool) -> Frame:
        """The RPDO: a controlword that leads to where the master wants the drive, and the target speed (rad/s)."""
        self._stopping = 0 if wanted else self._stopping + 1
        word = self._command(wanted, resetting).word
        return Frame(canopen.RPDO1_BASE + self.node, _RPDO.pack(word, to_units(speed)))

    def _command(self, wanted: bool, resetting: bool) -> Command:
        if not wanted:
            brakes = self.state in _MOVING and self._stopping <= STOP_CYCLES
            return Command.QUICK_STOP if brakes else Command.DISABLE_VOLTAGE
        if self.state is State.FAULT:
            self._wait = (self._wait + 1) % RESET_CYCLES
            return Command.FAULT_RESET if resetting and self._wait == 1 else Command.DISABLE_VOLTAGE
        return ENABLING.get(self.state, Command.DISABLE_VOLTAGE)


class WheelMaster:
    """Master of the wheels `left` and `right` (node ids) and of the reflector sensor `sensor`."""

    def __init__(self, left: int, right: int, sensor: int, cycle: float, quick_stop: float) -> None:
        """`cycle` s, `quick_stop` rad/s^2."""
        self.cycle = cycle
        self.wheels = (WheelLink("left wheel", left, quick_stop), WheelLink("right wheel", right, quick_stop))
        self.sensor = sensor
        self.wanted = False
        """Whether the drives are to be enabled."""
        self.phase = Phase.CONFIGURING
        self.troubles: list[Trouble] = []
        self.echoes: list[Frame] = []
        """Frames of the sensor since they were last taken."""
        self._sensor_sdo = SdoClient(sensor)
        self._by_tpdo = {canopen.TPDO1_BASE + wheel.node: wheel for wheel in self.wheels}
        self._heard = dict.fromkeys((left, right, sensor), 0.0)
        self._begin_at: float | None = 0.0
        self._settled_at = 0.0
        self._beat_due = 0.0
        self._resetting = False
        self._now = 0.0

    @property
    def enabled(self) -> bool:
        """Whether both drives follow set points."""
        return self.phase is Phase.RUNNING and all(w.state is State.OPERATION_ENABLED for w in self.wheels)

    @property
    def limited(self) -> bool:
        """Whether a drive cuts its set points because the battery gives no more."""
        return any(wheel.limited for wheel in self.wheels)

    @property
    def sensor_alive(self) -> bool:
        """Whether the sensor's heartbeat has been heard of late."""
        return self._now - self._heard[self.sensor] <= HEARTBEAT_PATIENCE

    def reset(self, now: float) -> None:
        """Forget troubles, reset faults and enable; configure again if the bus was the trouble."""
        again = self.phase is not Phase.RUNNING or any(trouble.cause == "bus" for trouble in self.troubles)
        self.troubles.clear()
        self._resetting, self.wanted = True, True
        for wheel in self.wheels:
            wheel.error_code = 0
        if again:
            self.phase, self._begin_at = Phase.CONFIGURING, now

    def bus_lost(self, now: float, why: str) -> None:
        """The bus itself is gone: nothing is enabled any more; configure again when it is back."""
        self._report(Trouble("bus", "", 0, why))
        self.phase, self._begin_at = Phase.CONFIGURING, now + RETRY

    def receive(self, now: float, frame: Frame) -> None:
        """A frame off the bus; what cannot be understood is ignored."""
        wheel = self._by_tpdo.get(frame.id)
        if wheel is not None:
            try:
                wheel.take(frame.data)
            except ValueError:
                return  # not ours: silence will show
        elif frame.id == canopen.TPDO1_BASE + self.sensor:
            if len(frame.data) == ECHOES.size:
                self.echoes.append(frame)
        elif frame.id > canopen.HEARTBEAT_BASE:
            self._beat(now, frame)
        elif frame.id > canopen.SDO_REPLY_BASE:
            for client in self._clients:
                client.receive(frame)
        elif canopen.EMCY_BASE < frame.id < canopen.TPDO1_BASE:
            self._emergency(frame)

    def advance(self, now: float, speeds: Sequence[float]) -> list[Frame]:
        """Frames of one cycle: configuration, or set points (rad/s, left and right) and SYNC; heartbeat when due."""
        self._now = now
        frames: list[Frame] = []
        if now >= self._beat_due:
            self._beat_due = now + HEARTBEAT_MS / 1e3
            frames.append(canopen.heartbeat(MASTER_NODE, NmtState.OPERATIONAL))
        if self.phase is Phase.CONFIGURING:
            return frames + self._configure(now)
        self._supervise(now)
        pairs = zip(self.wheels, speeds, strict=True)
        frames += [wheel.frame(speed, self.wanted, self._resetting) for wheel, speed in pairs]
        frames.append(canopen.SYNC)
        return frames

    @property
    def _clients(self) -> tuple[SdoClient, ...]:
        return (self.wheels[0].sdo, self.wheels[1].sdo, self._sensor_sdo)

    def _configure(self, now: float) -> list[Frame]:
        if self._begin_at is not None:
            if now < self._begin_at:
                return []
            self._begin_at, self._settled_at = None, now + SETTLE
            for wheel in self.wheels:
                wheel.sdo.begin(wheel.transfers(self.cycle))
            self._sensor_sdo.begin(self._sensor_transfers())
            return [canopen.nmt(NmtCommand.RESET_COMMUNICATION)]
        if now < self._settled_at:
            return []
        if any(client.busy for client in self._clients):
            return [frame for client in self._clients for frame in client.advance(now)]
        return self._start(now)

    def _start(self, now: float) -> list[Frame]:
        """All transfers are over: start the nodes, or say what failed and try again later."""
        wrong = [wheel.sdo.failure for wheel in self.wheels if wheel.sdo.failure]
        wrong = wrong or [text for text in (wheel.wrong() for wheel in self.wheels) if text]
        if wrong:
            self._report(Trouble("bus", "", 0, "; ".join(wrong)))
            self._begin_at = now + RETRY
            return []
        self.phase = Phase.STARTING
        for wheel in self.wheels:
            wheel.silent, wheel.spoken = 0, False
        self._heard = dict.fromkeys(self._heard, now)
        return [canopen.nmt(NmtCommand.START)]

    def _sensor_transfers(self) -> list[Transfer]:
        cob_id = canopen.TPDO1_BASE + self.sensor
        return [
            Transfer(Object.PRODUCER_HEARTBEAT, 0, _U16, HEARTBEAT_MS),
            Transfer(Object.TPDO1, 5, _U16, SENSOR_TIMER_MS),
            *canopen.map_pdo(Object.TPDO1, Object.TPDO1_MAPPING, cob_id, 255, SENSOR_OBJECTS),
        ]

    def _supervise(self, now: float) -> None:
        """Silence, lost heartbeats, and the end of starting and of a reset."""
        for wheel in self.wheels:
            wheel.silent += 1
            if wheel.silent == SILENT_CYCLES + 1:
                self._report(Trouble("bus", wheel.name, 0, f"{wheel.name}: the drive is silent"))
            if wheel.state is State.FAULT and not self._resetting and wheel.spoken and wheel.silent <= 1:
                self._fault(wheel, wheel.error_code)
            if now - self._heard[wheel.node] > HEARTBEAT_PATIENCE:
                self._report(Trouble("bus", wheel.name, 0, f"{wheel.name}: the drive sends no heartbeat"))
        if self.phase is Phase.STARTING and all(wheel.spoken for wheel in self.wheels):
            self.phase = Phase.RUNNING
        if self._resetting and self.enabled:
            self._resetting = False

    def _beat(self, now: float, frame: Frame) -> None:
        node = frame.id - canopen.HEARTBEAT_BASE
        if node not in self._heard or len(frame.data) != 1:
            return
        self._heard[node] = now
        if frame.data[0] == NmtState.BOOT_UP and self.phase is not Phase.CONFIGURING and node != self.sensor:
            self._report(Trouble("bus", "", 0, f"node {node} has restarted"))

    def _emergency(self, frame: Frame) -> None:
        try:
            message = canopen.parse_emergency(frame)
        except ValueError:
            return
        for wheel in self.wheels:
            if wheel.node == message.node:
                wheel.error_code = message.code
                if message.code and self.phase is not Phase.CONFIGURING and not self._resetting:
                    self._fault(wheel, message.code)

    def _fault(self, wheel: WheelLink, code: int) -> None:
        cause = "power" if code == Fault.UNDERVOLTAGE else "drive_fault"
        text = f"{wheel.name}: {fault_text(code)}" if code else f"{wheel.name}: drive in fault"
        self._report(Trouble(cause, wheel.name, code, text))

    def _report(self, trouble: Trouble) -> None:
        """Keep it until a reset (the same one once), and let no wheel turn on."""
        self.wanted = False
        known = {(each.wheel, each.cause, each.code) for each in self.troubles}
        if (trouble.wheel, trouble.cause, trouble.code) not in known:
            self.troubles.append(trouble)
