"""The retroreflector sensor on the rover's bus: bearing and range of reflectors in view, misses and
false returns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from petrobot.sim.bus.canopen_node import CanopenNode
from petrobot.sim.track.elements import FloorPose
from petrobot.sim.track.truth import SensorTruth

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
