"""The rover's CAN bus: two CiA 402 wheel drives in cyclic synchronous velocity mode and the
retroreflector sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia402 import (
    UNITS,
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    to_units,
)
from petrobot.sim.bus.canopen_node import CanopenNode
from petrobot.sim.bus.power_drive import POWERED, DriveBus, PowerDrive
from petrobot.sim.track.course import FloorPose
from petrobot.sim.track.rover import SLOT, RoverBody
from petrobot.sim.track.truth import SensorTruth

# --- wheel drives ---

SYNC_PATIENCE: Final = 5
"""Periods of 1006h without SYNC after which an enabled drive stops by itself: 100 ms at 50 Hz, 5 cm
at 0.5 m/s."""
_STATUSWORD, _POSITION, _VELOCITY, _TORQUE, _VOLTAGE, _MAX_SPEED, _TARGET = (
    (int(each), 0)
    for each in (
        ObjectIndex.STATUSWORD,
        ObjectIndex.POSITION,
        ObjectIndex.VELOCITY,
        ObjectIndex.TORQUE,
        ObjectIndex.DC_LINK_VOLTAGE,
        ObjectIndex.MAX_SPEED,
        ObjectIndex.TARGET_VELOCITY,
    )
)
_LONGEST: Final = 0.1
"""Time between two set points above which the slope limit allows no larger step (s)."""
_AT_REST: Final = 0.05
"""Speed below which a wheel counts as being at rest after a fault (rad/s)."""
_TURN: Final = 2.0 * math.pi
_HALF, _WHOLE = 1 << 31, 1 << 32


class WheelDrive(PowerDrive):
    """Drive of one wheel: speed set points, limited in slope and by the battery."""

    mode = OperationMode.CYCLIC_SYNCHRONOUS_VELOCITY

    def __init__(self, side: int, rover: RoverBody) -> None:
        """`side`: 0 left, 1 right; the node id is one more."""
        super().__init__(side + 1, "wheel_drive.eds", SYNC_PATIENCE)
        self.side = side
        self.limited = False
        """Whether the last set point was more than the drive can supply."""
        self._rover = rover
        self._wheel = rover.wheels[side]
        self._reference = 0.0
        self._ramp: float | None = None
        self._counted = 0
        self._speed = 0.0

    # Hooks of the CANopen node.
    def before_sending(self) -> None:
        """Update status, position, speed, torque and what depends on the battery."""
        values, rover = self.values, self._rover
        values[_STATUSWORD] = self.statusword()
        position = round(self._count() * (_TURN * UNITS / rover.truth.encoder_counts))
        values[_POSITION] = (position + _HALF) % _WHOLE - _HALF
        values[_VELOCITY] = to_units(self._speed)
        values[_TORQUE] = round(
            1000.0 * rover.torques[self.side] / rover.truth.settings["rated_torque"]
        )
        values[_VOLTAGE] = round(1000.0 * rover.voltage)
        values[_MAX_SPEED] = to_units(rover.top_speed)
        self.changed()

    def on_sync(self, now: float) -> None:
        """Read the encoder and take the next set point."""
        since, self._synced = now - self._synced, now
        counted, self._counted = self._counted, self._count()
        if since > 0.0:
            self._speed = (
                (self._counted - counted) * _TURN / self._rover.truth.encoder_counts / since
            )
        if self.state is DriveState.OPERATION_ENABLED:
            self._aim(self.values[_TARGET] / UNITS, min(since, _LONGEST))

    def _count(self) -> int:
        return math.floor(self._wheel.angle * self._rover.truth.encoder_counts / _TURN)

    def _aim(self, target: float, since: float) -> None:
        most = self._rover.top_speed
        self.limited = not -most <= target <= most
        target = min(max(target, -most), most)
        step = self._rover.truth.acceleration * since
        self._reference = min(max(target, self._reference - step), self._reference + step)
        self._wheel.target = self._reference

    # Hooks of the state machine.
    def begin(self, resumed: bool) -> None:
        """Continue at the speed that the wheel has."""
        self._reference = self._wheel.target = self._wheel.speed
        self._ramp = None
        self._wheel.braked = False

    def ramp_down(self, deceleration: float) -> None:
        self._ramp = deceleration

    def cut_power(self) -> None:
        self._reference = self._wheel.target = 0.0
        self._wheel.braked = True

    def flags(self) -> int:
        """Return whether set points are cut."""
        return StatusBit.INTERNAL_LIMIT if self.limited else 0

    def step(self, now: float) -> None:
        """Ramp down and watch SYNC; called once per slot."""
        if self.state not in POWERED:
            return
        if self.state is DriveState.OPERATION_ENABLED:
            if self.late(now):
                self.trip(DriveFault.SYNC_LOST)
            return
        change = (self._ramp or 0.0) * SLOT
        self._reference = math.copysign(max(abs(self._reference) - change, 0.0), self._reference)
        self._wheel.target = self._reference
        if (
            self.state is DriveState.FAULT_REACTION_ACTIVE
            and self._reference == 0.0
            and abs(self._wheel.speed) < _AT_REST
        ):
            self.ramp_ended()


class RoverBus(DriveBus[WheelDrive]):
    """Everything on the rover's bus except the master: drives 1 (left) and 2 (right), sensor 3.

    In each tick: `receive` the frames, then `step(now)`, then send what `drain` returns. Times are
    seconds on the caller's clock.
    """

    def __init__(self, rover: RoverBody, sensor: ReflectorSensor) -> None:
        super().__init__((WheelDrive(0, rover), WheelDrive(1, rover)), sensor)
        self.rover, self.sensor = rover, sensor
        self._watch_due = 0.0

    def receive(self, now: float, frame: Frame) -> None:
        self.rover.move_to(now)
        super().receive(now, frame)

    def step(self, now: float) -> None:
        """Run what rover and devices do on time."""
        if now < self._due - 1e-9:
            return
        self.rover.move_to(now)
        if now >= self._watch_due - 1e-9:
            self._watch_due = max(self._watch_due, now - SLOT) + SLOT
            for drive in self.drives:
                drive.step(now)
        for node in self._nodes:
            node.advance(now)
        self._due = min(self._watch_due, *[node.due() for node in self._nodes])


# --- sensor ---

SENSOR_NODE: Final = 3
"""Node id."""
ECHOES: Final = 2
"""Number of echoes in a TPDO."""
_ECHO: Final = 0x2010
_LEAST_RANGE: Final = 0.001
_BEARING_UNIT, _RANGE_UNIT = 1e-4, 1e-3


class Echo(NamedTuple):
    """Something bright: bearing (rad, to the left of the rover's heading) and slant range (m)."""

    bearing: float
    range: float


def look(
    truth: SensorTruth,
    pose: FloorPose,
    reflectors: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> list[Echo]:
    """Return the echoes of one turn of the sensor on a rover at `pose`, nearest first; `reflectors`
    are points (x, y) in m."""
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    x, y = pose.x + truth.forward * c, pose.y + truth.forward * s
    echoes: list[Echo] = []
    for there_x, there_y in reflectors:
        dx, dy = there_x - x, there_y - y
        ahead, aside = dx * c + dy * s, dy * c - dx * s
        level = math.hypot(ahead, aside)
        bearing, slant = math.atan2(aside, ahead), math.hypot(level, truth.below)
        if (
            abs(bearing) > truth.half_angle
            or slant > truth.range
            or truth.below > level * math.tan(truth.fan)
        ):
            continue
        if rng.random() >= truth.miss:
            noise = rng.standard_normal(2).tolist()
            bearing += truth.bearing_offset + truth.bearing_noise * noise[0]
            echoes.append(
                Echo(
                    _rounded(bearing, truth.step),
                    slant + truth.range_offset + truth.range_noise * noise[1],
                )
            )
    if truth.false and rng.random() < truth.false:
        bearing = float(rng.uniform(-truth.half_angle, truth.half_angle))
        echoes.append(Echo(_rounded(bearing, truth.step), float(rng.uniform(*truth.false_range))))
    return sorted(echoes, key=lambda echo: echo.range)


def _rounded(value: float, step: float) -> float:
    return round(value / step) * step


class ReflectorSensor(CanopenNode):
    """Measures and sends by its event timer (1800h:5, ms)."""

    def __init__(self, measure: Callable[[float], Sequence[Echo]]) -> None:
        """`measure` returns the echoes at a moment (s), nearest first."""
        super().__init__(SENSOR_NODE, "reflector_sensor.eds")
        self.dead = False
        """Whether it has become silent."""
        self._measure = measure
        self._next = 0.0

    def due(self) -> float:
        """Return when it measures or sends next."""
        return min(super().due(), self._next) if self.values[0x1800, 5] else super().due()

    def advance(self, now: float) -> None:
        """Measure when the event timer is due."""
        super().advance(now)
        timer = self.values[0x1800, 5] * 1e-3
        if timer and now >= self._next - 1e-9:
            self._next = max(self._next, now - timer) + timer
            if self.tpdo.on and not self.dead:
                self._show(self._measure(now))
                self.send_tpdo()
        if self.dead:
            self.outbox.clear()

    def _show(self, echoes: Sequence[Echo]) -> None:
        for number in range(ECHOES):
            bearing = distance = 0
            if number < len(echoes):
                bearing = round(echoes[number].bearing / _BEARING_UNIT)
                distance = round(max(echoes[number].range, _LEAST_RANGE) / _RANGE_UNIT)
            self.values[_ECHO, 2 * number + 1] = bearing
            self.values[_ECHO, 2 * number + 2] = distance
        self.changed()
