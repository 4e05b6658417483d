"""Retroreflectors around the rover: echoes of the sensor gathered to places in the odometry frame.

An echo may be missing or false. A reflector stands still while the rover moves, so echoes that
agree on a place time and again are one, and an echo that stays alone is none.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from petrobot.services.mobile.model import Sensor
from petrobot.services.mobile.odometry import Pose

ECHOES: Final = struct.Struct("<hHhH")
"""TPDO1 of the sensor: bearing (0.1 mrad, left positive) and slant range (mm, 0: no echo),
twice."""
NEAR: Final = 0.25
"""m within which echoes are of one reflector."""
BELIEVED: Final = 4
"""Echoes that make a reflector."""
LONELY: Final = 1.5
"""s after which a place with fewer is forgotten."""
REMEMBERED: Final = 20.0
"""s after which a believed one is forgotten: odometry drifts, and what was heard long ago is not
where it seems."""
MOST: Final = 24
"""Places that are kept."""


@dataclass(slots=True)
class EchoSpot:
    """A spot that echoes came from: mean of the latest ones (m, odometry frame), how many, and when
    the last came (s)."""

    x: float
    y: float
    count: int
    last: float


def parse_echoes(data: bytes) -> list[tuple[float, float]]:
    """Bearings (rad) and slant ranges (m) in the sensor's frame, of its TPDO's data. Raises
    ValueError for what is none."""
    if len(data) != ECHOES.size:
        raise ValueError(
            f"TPDO of the reflector sensor has {len(data)} bytes, must have {ECHOES.size}"
        )
    b1, r1, b2, r2 = ECHOES.unpack(data)
    return [(b / 1e4, r / 1e3) for b, r in ((b1, r1), (b2, r2)) if r]


class ReflectorMap:
    """Places of reflectors of one rover."""

    def __init__(self, sensor: Sensor, reflector_height: float) -> None:
        self._forward = sensor.forward
        self._above = reflector_height - sensor.height
        self._places: list[EchoSpot] = []
        self.echoes = 0

    def take(self, now: float, pose: Pose, echoes: Sequence[tuple[float, float]]) -> None:
        """Echoes (bearing rad, slant range m) received at a pose."""
        for bearing, slant in echoes:
            if slant <= abs(self._above):
                continue
            self.echoes += 1
            level = math.sqrt(slant * slant - self._above * self._above)
            x, y = pose.floor(self._forward + level * math.cos(bearing), level * math.sin(bearing))
            self._note(now, x, y)
        patience = {True: REMEMBERED, False: LONELY}
        self._places = [p for p in self._places if now - p.last < patience[p.count >= BELIEVED]][
            -MOST:
        ]

    def believed(self, now: float) -> list[tuple[float, float, int, float]]:
        """Reflectors: x, y (m, odometry frame), the number of echoes, and how long ago the last one
        came (s)."""
        return [(p.x, p.y, p.count, now - p.last) for p in self._places if p.count >= BELIEVED]

    def _note(self, now: float, x: float, y: float) -> None:
        near = min(self._places, key=lambda p: math.hypot(p.x - x, p.y - y), default=None)
        if near is None or math.hypot(near.x - x, near.y - y) > NEAR:
            self._places.append(EchoSpot(x, y, 1, now))
            return
        near.count, near.last = near.count + 1, now
        part = 1.0 / min(near.count, 12)
        near.x += part * (x - near.x)
        near.y += part * (y - near.y)
